"""Closed loops of MJCF robots in machine code: a command from each sample on, and physics steps until the next one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.command import history_on
from equimus_ctrl.effects.sensors import sample
from equimus_ctrl.engines.mjcf_kernel import run_mjcf
from equimus_ctrl.engines.tracking_law import tracking_command
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def command_sample(
    k: int,
    steps: NDArray[np.int64],
    sensor: Array,
    noise: Array,
    start: float,
    dt: float,
    reference: Array,
    feed: Array,
    stiffness: Array,
    damping: Array,
    smoothing: float,
    period: float,
    memory: Array,
    low: Array,
    high: Array,
    out_q: Array,
    out_v: Array,
    asked: Array,
    given: Array,
) -> None:
    """What the law commands at a sample, by what the sensors show then.

    Args:
        k: the sample.
        steps: (n + 1,) physics steps at which samples begin, and the last one ends.
        sensor: (nj, 4), see ``effects.sensors.OFFSET``.
        noise: (n, nj) of the sensors [rad or m].
        start: of the motion [s].
        dt: physics step [s].
        reference: (n, nj) of the joints [rad or m].
        feed: (n, na) fed forward.
        stiffness: (na, nj) of the law, see ``types.FeedbackLaw``, as what follows.
        damping: (na, nj).
        smoothing: [s].
        period: between commands [s].
        memory: (2, nj) see ``tracking_law.ERROR``, replaced.
        low: (na,) lowest commands.
        high: (na,) highest.
        out_q: (steps + 1, nj) where the joints are so far [rad or m].
        out_v: (steps + 1, nj) their rates.
        asked: (n, na) written at k: what the law asks for.
        given: (n, na) written at k: the same within the range.
    """
    nj, known = out_q.shape[1], steps[k] + 1
    measured, now, shown = np.empty(nj), np.empty(1), np.empty(1)
    now[0] = start + steps[k] * dt
    for j in range(nj):
        sample(out_q[:known, j], out_v[:known, j], start, dt, sensor[j], now, shown)
        measured[j] = shown[0] + noise[k, j]
    tracking_command(reference[k], measured, feed[k], stiffness, damping, smoothing, period, memory, asked[k])
    for i in range(len(low)):
        given[k, i] = min(max(asked[k, i], low[i]), high[i])


@njit(cache=True, nogil=True, error_model="numpy")
def advance_sample(
    k: int,
    steps: NDArray[np.int64],
    times: Array,
    reach: Array,
    before: Array,
    valve: Array,
    carried: Array,
    start: float,
    step: int,
    model: int,
    data: int,
    places: NDArray[np.int64],
    laws: Array,
    loss: Array,
    fastest: Array,
    states: Array,
    qpos: Array,
    qvel: Array,
    control: Array,
    applied: Array,
    frictionloss: Array,
    driven: Array,
    dt: float,
    act: Array,
    out_q: Array,
    out_v: Array,
    ctrl: Array,
    whole: Array,
) -> bool:
    """Physics steps from a sample to the next; whether all was still sound.

    Args:
        k: the sample.
        steps: (n + 1,) see ``command_sample``.
        times: (n,) of the commands [s].
        reach: (na, n) what reaches the valves of the commands so far.
        before: (na,) the same before the first.
        valve: (na, 6), see ``effects.command.DELAY``.
        carried: (na, 2) what is behind each valve, and a cursor, at the sample; replaced by those at the next one.
        start: of the motion [s].
        step: see ``mjcf_kernel.run_mjcf``, as what is not named here.
        model: as there.
        data: as there.
        places: as there.
        laws: as there.
        loss: as there.
        fastest: as there.
        states: as there.
        qpos: as there.
        qvel: as there.
        control: as there.
        applied: as there.
        frictionloss: as there.
        driven: as there.
        dt: as there.
        act: as there.
        out_q: (steps + 1, nj) written from the sample to the next one: where the joints are.
        out_v: (steps + 1, nj) their rates.
        ctrl: (steps, na) written: what has arrived of the commands, the mean over each step.
        whole: (steps + 1, …) written, or (0, …).
    """
    first, last = steps[k], steps[k + 1]
    na, nj = len(reach), out_q.shape[1]
    out, none, still = np.empty((last - first, 2, na)), np.empty((last - first + 1, 0)), np.empty((0, nj))
    for i in range(na):
        carried[i, 0], cursor = history_on(
            times[: k + 1], reach[i, : k + 1], before[i], valve[i], start + first * dt, dt, i, False, carried[i, 0],
            int(carried[i, 1]), out,
        )  # fmt: skip
        carried[i, 1] = cursor
        for s in range(last - first):
            ctrl[first + s, i] = out[s, 0, i]
    kept = whole[:0]
    if len(whole) > 0:
        kept = whole[first : last + 1]
    sound = run_mjcf(
        step, model, data, places, laws, loss, fastest, ctrl[first:last], still, states, qpos, qvel, control, applied,
        frictionloss, driven, dt, np.empty((0, 2), dtype=np.int64), none, none, out_q[first : last + 1],
        out_v[first : last + 1], act, kept,
    )  # fmt: skip
    return bool(sound == last - first + 1)


@njit(cache=True, nogil=True, error_model="numpy")
def follow_samples(
    first: int,
    last: int,
    steps: NDArray[np.int64],
    times: Array,
    sensor: Array,
    noise: Array,
    start: float,
    of_law: Any,
    of_steps: Any,
    out_q: Array,
    out_v: Array,
    asked: Array,
    given: Array,
    reach: Array,
    before: Array,
    valve: Array,
    carried: Array,
    ctrl: Array,
    whole: Array,
) -> int:
    """Samples one by one where nothing acts on the value of commands; the one at which all is lost, or the end.

    Args:
        first: sample.
        last: the one after the last.
        steps: see ``command_sample``, as ``times``, ``sensor``, ``noise``, ``start`` and what is written.
        times: as there.
        sensor: as there.
        noise: as there.
        start: as there.
        of_law: from ``reference`` to ``high`` there.
        of_steps: from ``step`` to ``act`` of ``advance_sample``.
        out_q: as there.
        out_v: as there.
        asked: as there.
        given: as there.
        reach: see ``advance_sample``, as what follows.
        before: as there.
        valve: as there.
        carried: as there.
        ctrl: as there.
        whole: as there.
    """
    reference, feed, stiffness, damping, smoothing, period, memory, low, high = of_law
    (
        step, model, data, places, laws, loss, fastest, states, qpos, qvel, control, applied, frictionloss, driven, dt,
        act,
    ) = of_steps  # fmt: skip
    for k in range(first, last):
        command_sample(
            k, steps, sensor, noise, start, dt, reference, feed, stiffness, damping, smoothing, period, memory, low,
            high, out_q, out_v, asked, given,
        )  # fmt: skip
        for i in range(len(reach)):
            reach[i, k] = given[k, i]
        if not advance_sample(
            k, steps, times, reach, before, valve, carried, start, step, model, data, places, laws, loss, fastest,
            states, qpos, qvel, control, applied, frictionloss, driven, dt, act, out_q, out_v, ctrl, whole,
        ):  # fmt: skip
            return k
    return last
