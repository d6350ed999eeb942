"""The laws of what happens between a command and the pressure in an actuator, as compiled functions.

Where commands are no pressures, as of motors, "pressure" is the command as it arrives at the actuator, in the unit of
that actuator's commands, which then takes the place of Pa.

They stand here once and are called by every engine, one physics step at a time. A step needs of the pressure its mean
and its slope: the line P(s) ≈ mean + slope·(s/dt − ½) has the same integral and the same first moment over the step as
the pressure itself, so that changes anywhere within a step count by when they come.

What is called at every step is compiled into its callers (``inline``): else each call counts references to its arrays,
which takes longer than the law.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.relaxation import relax, relax_along
from equimus_ctrl.types import Array

DELAY, FILL, VENT, RATE, FLOW, POWER = range(6)
"""A valve (6,): transport delay [s], time constants of filling and venting [s], greatest rate [Pa/s], greatest rate of
filling at a command of ``REFERENCE`` [Pa/s], power of the command with which that grows."""

PARTS = 16
"""Of a line between two commands, in which a filling flow that follows the command counts as constant."""

REFERENCE = 1e4
"""The command at which a filling flow is named [Pa]."""


@njit(cache=True, nogil=True, error_model="numpy")
def _filling(target: float, valve: Array) -> float:
    """The greatest rate of filling at a command [Pa/s]."""
    if valve[FLOW] == math.inf:
        return math.inf
    flow: float = valve[FLOW] * (max(target, 0.0) / REFERENCE) ** valve[POWER]
    return flow


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _fastest(pressure: float, target: float, valve: Array) -> float:
    """The greatest rate towards a command through a valve (6,), see ``DELAY`` [Pa/s]."""
    rate: float = valve[RATE]
    if target > pressure and valve[FLOW] < math.inf:
        rate = min(rate, _filling(target, valve))
    return rate


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def advance_pressure(
    times: Array, values: Array, before: float, cursor: int, start: float, dt: float, pressure: float, valve: Array
) -> tuple[float, float, float, int]:
    """One physics step of an actuator's pressure behind its valve.

    Args:
        times: (n,) ascending instants from which each command holds [s].
        values: (n,) commands [Pa].
        before: the command in force before times[0] [Pa].
        cursor: index of the last instant at or before the delayed ``start``, or anything not above it; −1 for none.
        start: of the step, before the transport delay is taken off [s].
        dt: [s].
        pressure: at the start [Pa].
        valve: (6,), see ``DELAY``.

    Returns:
        (pressure at the end, its mean over the step, its slope over the step [Pa], the cursor to hand in next).
    """
    n = len(times)
    at = start - valve[DELAY]
    end = at + dt
    while cursor + 1 < n and times[cursor + 1] <= at:
        cursor += 1
    target = values[cursor] if cursor >= 0 else before
    k = cursor
    if pressure == target and not (k + 1 < n and times[k + 1] < end):
        return pressure, pressure, 0.0, cursor
    begin = at
    area, moment = 0.0, 0.0
    while True:
        last = not (k + 1 < n and times[k + 1] < end)
        until = end if last else times[k + 1]
        span = until - at
        fastest = _fastest(pressure, target, valve)
        pressure, piece, first = relax(pressure, target, valve[FILL], valve[VENT], fastest, span)
        area += piece
        moment += first + (at - begin) * piece
        if last:
            break
        at = until
        k += 1
        target = values[k]
    mean = area / dt
    return pressure, mean, 12.0 * (moment / (dt * dt) - 0.5 * mean), cursor


@njit(cache=True, nogil=True, error_model="numpy")
def advance_along(
    times: Array, values: Array, before: float, cursor: int, start: float, dt: float, pressure: float, valve: Array
) -> tuple[float, float, float, int]:
    """``advance_pressure`` under commands that go along a line from each row to the next.

    Before the first row ``before`` is in force, from the last row on what stands there. All is exact but a filling
    flow, which is that at the command in the middle of each of the ``PARTS`` of a line.
    """
    n = len(times)
    begin = start - valve[DELAY]
    end, at = begin + dt, begin
    while cursor + 1 < n and times[cursor + 1] <= at:
        cursor += 1
    k = cursor
    area, moment = 0.0, 0.0
    while True:
        until = times[k + 1] if k + 1 < n and times[k + 1] < end else end
        target, slope = before if k < 0 else values[k], 0.0
        if 0 <= k < n - 1:
            whole = times[k + 1] - times[k]
            slope = (values[k + 1] - values[k]) / whole
            target += slope * (at - times[k])
            if valve[FLOW] < math.inf:
                until = min(until, at + whole / PARTS)
        span = until - at
        rise = min(valve[RATE], _filling(target + 0.5 * slope * span, valve))
        pressure, piece, first = relax_along(pressure, target, slope, valve[FILL], valve[VENT], rise, valve[RATE], span)
        area += piece
        moment += first + (at - begin) * piece
        if until == end:
            break
        at = until
        if k + 1 < n and until == times[k + 1]:
            k += 1
    mean = area / dt
    return pressure, mean, 12.0 * (moment / (dt * dt) - 0.5 * mean), cursor


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def advance(
    times: Array,
    values: Array,
    before: float,
    cursor: int,
    start: float,
    dt: float,
    pressure: float,
    valve: Array,
    linear: bool,
) -> tuple[float, float, float, int]:
    """One step of ``advance_pressure``, or of ``advance_along`` where the commands go along lines."""
    if linear:
        return advance_along(times, values, before, cursor, start, dt, pressure, valve)
    return advance_pressure(times, values, before, cursor, start, dt, pressure, valve)


@njit(cache=True, nogil=True, error_model="numpy")
def remembers(valve: Array) -> bool:
    """Whether the pressure behind a valve (6,) hangs on more than the command that last arrived there."""
    return bool(valve[FILL] > 0.0 or valve[VENT] > 0.0 or valve[RATE] < math.inf or valve[FLOW] < math.inf)


@njit(cache=True, nogil=True, error_model="numpy")
def settled(times: Array, values: Array, before: float, start: float, valve: Array, linear: bool) -> tuple[float, int]:
    """The pressure behind a valve at a start, settled under ``before`` until the first command, and the cursor."""
    if not start > times[0]:
        return before, -1
    if not remembers(valve):
        cursor = np.searchsorted(times, start - valve[DELAY], side="right") - 1
        return (values[cursor] if cursor >= 0 else before), cursor
    pressure, _, _, cursor = advance(times, values, before, -1, times[0], start - times[0], before, valve, linear)
    return pressure, cursor


@njit(cache=True, nogil=True, error_model="numpy")
def own_history(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    start: float,
    dt: float,
    i: int,
    linear: bool,
    out: Array,
) -> None:
    """``pressure_history`` of one actuator i."""
    column = np.empty(len(times))
    for k in range(len(times)):
        column[k] = commands[k, i]
    pressure, cursor = settled(times, column, before[i], start, valve[i], linear)
    history_on(times, column, before[i], valve[i], start, dt, i, linear, pressure, cursor, out)


@njit(cache=True, nogil=True, error_model="numpy")
def history_on(
    times: Array,
    column: Array,
    before: float,
    valve: Array,
    start: float,
    dt: float,
    i: int,
    linear: bool,
    pressure: float,
    cursor: int,
    out: Array,
) -> tuple[float, int]:
    """The same from a pressure and a cursor on, of a column of commands (n,) and a valve (6,); both at the end."""
    n = len(times)
    for s in range(len(out)):
        at = start + s * dt - valve[DELAY]
        while cursor + 1 < n and times[cursor + 1] <= at:
            cursor += 1
        held = not linear and not (cursor + 1 < n and times[cursor + 1] < at + dt)
        if held and pressure == (column[cursor] if cursor >= 0 else before):
            out[s, 0, i], out[s, 1, i] = pressure, 0.0  # as ``advance_pressure`` has it, several times as fast
            continue
        pressure, out[s, 0, i], out[s, 1, i], cursor = advance(
            times, column, before, cursor, start + s * dt, dt, pressure, valve, linear
        )
    return pressure, cursor


@njit(cache=True, nogil=True, error_model="numpy")
def pressure_history(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    start: float,
    dt: float,
    out: Array,
    linear: bool = False,
) -> None:
    """The pressures of all actuators over a grid of physics steps, settled under ``before`` until the first command.

    Args:
        times: (n,) ascending instants from which each command holds [s].
        commands: (n, na) [Pa].
        before: (na,) in force before times[0] [Pa].
        valve: (na, 6), see ``advance_pressure``.
        start: of the first step [s]; where it comes after times[0], the pressures have moved until then.
        dt: [s].
        out: (steps, 2, na) written: mean and slope over each step [Pa].
        linear: commands go along a line from each row to the next, in place of being held.
    """
    for i in range(commands.shape[1]):
        own_history(times, commands, before, valve, start, dt, i, linear, out)


@njit(cache=True, nogil=True, error_model="numpy")
def mixed_history(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    start: float,
    dt: float,
    out: Array,
    linear: NDArray[np.bool_],
) -> None:
    """``pressure_history`` where (na,) ``linear`` says of each actuator whether its commands go along a line."""
    for i in range(commands.shape[1]):
        own_history(times, commands, before, valve, start, dt, i, linear[i], out)


@njit(cache=True, nogil=True, error_model="numpy")
def pressure_rollouts(first: Array, arriving: Array, valve: Array, dt: float, means: Array, ends: Array) -> None:
    """The pressures of many rollouts from one start, commands being given as they arrive at the valves.

    Args:
        first: (na,) behind the valves at the start [Pa].
        arriving: (n, steps, na) what reaches the valves, each held over its step [Pa].
        valve: (na, 6), see ``DELAY``; delays take no part.
        dt: a part of a step [s].
        means: (n, steps·parts, na) written: the mean over each part [Pa].
        ends: (n, steps + 1, na) written: when steps begin and end [Pa].
    """
    n, steps, na = arriving.shape
    parts = means.shape[1] // steps
    for run in range(n):
        for i in range(na):
            pressure = first[i]
            ends[run, 0, i] = pressure
            for k in range(steps):
                target = arriving[run, k, i]
                for part in range(k * parts, (k + 1) * parts):
                    fastest = _fastest(pressure, target, valve[i])
                    pressure, area, _ = relax(pressure, target, valve[i, FILL], valve[i, VENT], fastest, dt)
                    means[run, part, i] = area / dt
                ends[run, k + 1, i] = pressure
