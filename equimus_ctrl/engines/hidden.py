"""What the motion before a trial's start left of hidden states, for kernels in lanes; see ``engines.lane_hidden``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.following import FOLLOW_KIND, FOLLOW_LEAST, FOLLOW_MOST, INTEGRATED, integrate
from equimus_ctrl.effects.sensors import behind
from equimus_ctrl.engines.encoding import Encoded
from equimus_ctrl.engines.lane_equations import Lanes
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.augmented import slots_of, unknown_states
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.recordings.smoothing import RecordedMotion
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Lead:
    """The motion of a recording as kernels take it, nothing where none is needed.

    Attributes:
        times: (n,) [s].
        motion: (3, n, nv) positions, rates and accelerations of the coordinates, as the sensors show them.
        reading: over how long a start is read off [s].
        integrals: (k, na) what integrators of commands begin with at the start of the recording.
    """

    times: Array
    motion: Array
    reading: float
    integrals: Array


@dataclass(frozen=True, eq=False)
class Commands:
    """What of k models' commands takes part, as in ``run_trials``."""

    commands: Array
    before: Array
    valve: Array
    follow: Array


def recorded_of(trials: Sequence[Trial]) -> RecordedMotion | None:
    """The motion that trials of one history have in common; None where none of them begins inside of it."""
    return next((trial.led for trial in trials if trial.led is not None), None)


def first_activations(coded: Encoded, rows: slice, trial: Trial, position: Array) -> Array:
    """(k, na) what integrators of commands begin with: the trial's, else where their actuators are.

    Args:
        coded: models.
        rows: which of them.
        trial: what is done.
        position: (k, nj) joint coordinates at the start, see ``Trial.begun``.
    """
    follow = coded.follow[rows]
    found = np.zeros(follow.shape[:2])
    if trial.activation is not None:
        found[:, : len(trial.activation)] = trial.activation
    elif (follow[:, :, FOLLOW_KIND] == INTEGRATED).any():
        lengths = actuator_lengths(coded.form, coded.models[0].phase)
        moved = coded.mechanics[0].starts
        for row, own, q in zip(found, coded.mechanics[rows], position, strict=True):
            along = np.array(lengths(q[moved], own.parameters)).ravel()
            row[:] = along[[channel.actuator for channel in own.channels]]
    return np.clip(found, follow[:, :, FOLLOW_LEAST], follow[:, :, FOLLOW_MOST])


@lru_cache(maxsize=32)
def actuator_lengths(form: Structure, phase: Phase) -> ca.Function:
    """(q, p) → lengths (na,)."""
    m = build(form, phase)
    return ca.Function("lengths", [m.q, m.p], [m.lengths])


def lead(
    coded: Encoded, rows: slice, trials: Sequence[Trial], given: Commands, sensor: Array, first: Array, dt: float
) -> Lead:
    """What leads to the starts of trials of one history of commands.

    Args:
        coded: models.
        rows: which of them.
        trials: what is done.
        given: their commands.
        sensor: (k, nv, 4) of the coordinates, see ``effects.sensors.OFFSET``.
        first: (trials, k, na) what integrators of commands begin with at the starts; of those that began before, what
            they came to since is written.
        dt: longest steps in which they are followed [s].
    """
    own, recorded, none = coded.mechanics[0], recorded_of(trials), np.zeros(0)
    integrates = given.follow[:, :, FOLLOW_KIND] == INTEGRATED
    integrals = np.zeros(integrates.shape)
    nothing = Lead(none, np.empty((3, 0, len(own.starts))), 0.0, integrals)
    if recorded is None or not (integrates.any() or coded.lanes.n_states > 0):
        return nothing
    robot, motion = coded.models[0].robot, recorded.motion
    if integrates.any():
        q = np.tile(motion.position[0], (len(sensor), 1))
        q[:, own.starts] = behind(sensor, q[:, own.starts])
        integrals = first_activations(coded, rows, replace(trials[0], activation=None), q)
        led = [i for i, trial in enumerate(trials) if trial.led is not None and trial.activation is None]
        first[led] = _integrated(robot, [trials[i] for i in led], given, integrals, dt, first[led])
    columns = np.stack([motion.position, motion.velocity, motion.acceleration])[:, :, own.starts]
    return Lead(motion.times, np.ascontiguousarray(columns), recorded.reading, integrals)


def led_states(
    lanes: Lanes,
    parameters: Array,
    times: Array,
    given: Commands,
    sensor: Array,
    led: Lead,
    start: tuple[Array, Array, Array],
    dt: float,
    linear: NDArray[np.bool_],
) -> Array:
    """(trials, nz·LANES) hidden states where trials of one history start; no rows where nothing leads there.

    Those of trials that start with the recording are nan: they begin as if nothing had been before.

    Args:
        lanes: equations of the models.
        parameters: (k, np) of up to LANES models.
        times: (n,) from when each command holds [s].
        given: their commands.
        sensor: (k, nv, 4), see ``lead``.
        led: what leads there.
        start: (trials,) when they start [s], and (trials, k, nv) with which coordinates and rates.
        dt: longest steps in which states are followed [s].
        linear: (na,) see ``run_trials``.
    """
    if lanes.n_states == 0 or not len(led.times):
        return np.empty((0, 0))
    at, q0, v0 = start
    found = np.empty((len(at), lanes.n_states * LANES))
    lanes.kernel.hidden_starts(
        lanes.robot, parameters, times, given.commands, given.before, given.valve, given.follow, led.integrals, sensor,
        led.times, led.motion, led.reading, q0, v0, at, dt, linear, found,
    )  # fmt: skip
    found[at <= times[0]] = np.nan
    return found


def with_unknown(coded: Encoded, rows: slice, hidden: Array, unknown: Array) -> Array:
    """``led_states`` with those states of effects that begin anywhere as numbers say.

    Args:
        coded: models.
        rows: which of them.
        hidden: what ``led_states`` found.
        unknown: (trials, k, nm) numbers of any size, whose tanh the states of each model's effects are, in the order
            of ``models.augmented.unknown_states``; those behind the last one say nothing.
    """
    states = [_unknown_states(coded, model) for model in coded.models[rows]]
    if not unknown.shape[2] or not any(states):
        return hidden
    count = coded.lanes.n_states
    found = hidden.copy() if len(hidden) else np.full((len(unknown), count * LANES), np.nan)
    by_lane = found.reshape(len(found), count, LANES)
    for lane, own in enumerate(states):
        given = min(len(own), unknown.shape[2])
        by_lane[:, own[:given], lane] = np.tanh(unknown[:, lane, :given])
    return found


def _unknown_states(coded: Encoded, model: Model) -> list[int]:
    """Rows of a model's hidden states that begin anywhere; the robot's own states come before those of laws."""
    slots, places = slots_of(coded.form, coded.laws), coded.mechanics[0].law_places
    own = coded.lanes.n_states - sum(slot.law.n_states for slot in slots)
    return [own + k for k in unknown_states(slots, model.effects, places["joint"], places["actuator"])]


def _integrated(robot: Robot, trials: Sequence[Trial], given: Commands, begun: Array, dt: float, first: Array) -> Array:
    """(trials, k, na) what integrators came to by the starts of trials of one history; of others ``first``."""
    found, starts = first.copy(), np.array([trial.start for trial in trials], dtype=np.float64)
    for lane in range(first.shape[1] if len(trials) else 0):
        out = first[:, lane].copy()
        integrate(
            trials[0].times, given.commands[lane], given.before[lane], given.valve[lane], given.follow[lane],
            begun[lane], starts, dt, trials[0].lines(robot), out,
        )  # fmt: skip
        found[:, lane] = out
    return found
