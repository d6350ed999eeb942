"""What follows a command that has arrived: filters, integrators and slewed commands, as compiled functions.

Units are those of ``effects.command``, whose valves the commands come through first.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.command import DELAY, advance, history_on, own_history, remembers, settled
from equimus_ctrl.effects.relaxation import decay_moments
from equimus_ctrl.types import Array

DIRECT, FILTERED, INTEGRATED, SLEWED = 0, 1, 2, 3
"""What follows a command u: a = u, da/dt = (u − a)/number, da/dt = u, |da/dt| ≤ number."""

FOLLOW_KIND, FOLLOW_NUMBER, FOLLOW_LOW, FOLLOW_HIGH, FOLLOW_LEAST, FOLLOW_MOST = range(6)
"""A follower (6,): its kind (``DIRECT`` to ``SLEWED``), time constant [s] or greatest rate, between what the command
counts, between what the follower stays."""

CARRIED = 3
"""Numbers of an actuator that ``go_on`` carries along."""

STRIDE = 64
"""Steps of a pass through a recording from one point of its grid to the next."""


@njit(cache=True, nogil=True, error_model="numpy")
def follow_history(follow: Array, value: float, dt: float, own: int, out: Array) -> float:
    """Put what follows a command in the place of the command, over a grid of physics steps.

    Exact for a command that is a line over each step: da/dt = (u − a)/τ, or da/dt = u; as near to |da/dt| ≤ rate as a
    line over each step can be.

    Args:
        follow: (6,), see ``FOLLOW_KIND``.
        value: of the follower at the start.
        dt: [s].
        own: the actuator's column.
        out: (steps, 2, na) mean and slope of the command over each step, replaced by those of the follower.

    Returns:
        The follower's value at the end.
    """
    kind, number = follow[FOLLOW_KIND], follow[FOLLOW_NUMBER]
    low, high, least, most = follow[FOLLOW_LOW], follow[FOLLOW_HIGH], follow[FOLLOW_LEAST], follow[FOLLOW_MOST]
    for s in range(len(out)):
        mean, slope = out[s, 0, own], out[s, 1, own]
        if mean - 0.5 * abs(slope) < low or mean + 0.5 * abs(slope) > high:
            first, last = min(max(mean - 0.5 * slope, low), high), min(max(mean + 0.5 * slope, low), high)
            mean, slope = 0.5 * (first + last), last - first
        if kind >= INTEGRATED:
            # Integrated or slewed: one line, or one up to where a bound or the command is met, and that from there on.
            if kind == INTEGRATED:
                ahead, goal = mean * dt, most if mean > 0.0 else least
            else:
                goal = mean + 0.5 * slope
                ahead = number * dt if goal > value else -number * dt
            way = goal - value
            x = 1.0 if abs(way) >= abs(ahead) else (way / ahead if ahead != 0.0 else 0.0)
            end = value + ahead * x
            middle = x * (value + 0.5 * ahead * x) + (1.0 - x) * end
            moment = x * x * (0.5 * value + ahead * x / 3.0) + 0.5 * (1.0 - x * x) * end
            rise = 12.0 * (moment - 0.5 * middle)
            if kind == INTEGRATED and x == 1.0:
                middle -= dt * slope / 12.0
        elif number <= 0.0:
            end, middle, rise = mean + 0.5 * slope, mean, slope
        else:
            x, behind = dt / number, number * slope / dt
            decay, area, moment = decay_moments(x)
            off = value - (mean - 0.5 * slope - behind)
            end = mean + 0.5 * slope - behind + off * decay
            middle = mean - behind + off * area
            rise = slope + 12.0 * off * (moment - 0.5 * area)
        if end < least or end > most or value < least or value > most:
            end, start = min(max(end, least), most), min(max(value, least), most)
            middle, rise = 0.5 * (start + end), end - start
        out[s, 0, own], out[s, 1, own] = middle, rise
        value = end
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _first_of(before: float, follow: Array, first: float) -> float:
    """What follows a command when commands begin: of an integrator its first value, else settled under ``before``."""
    value = before
    if follow[FOLLOW_KIND] == INTEGRATED:
        value = first
    else:
        value = min(max(value, follow[FOLLOW_LOW]), follow[FOLLOW_HIGH])
        value = min(max(value, follow[FOLLOW_LEAST]), follow[FOLLOW_MOST])
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _follower_at(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: float,
    start: float,
    dt: float,
    own: int,
    linear: bool,
) -> float:
    """What follows an actuator's command at a start: an integrator's first value, or what it came to until then.

    Arguments are those of ``followed_history``; ``follow`` (6,), ``first`` and ``linear`` are the actuator's own, and
    ``own`` is its column.
    """
    if follow[FOLLOW_KIND] == INTEGRATED:
        return first
    value = _first_of(before[own], follow, first)
    if start > times[0]:
        steps = max(math.ceil((start - times[0]) / dt), 1)
        early = np.empty((steps, 2, commands.shape[1]))
        part = (start - times[0]) / steps
        own_history(times, commands, before, valve, times[0], part, own, linear, early)
        value = follow_history(follow, value, part, own, early)
    return float(value)


@njit(cache=True, nogil=True, error_model="numpy")
def own_followed_history(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    start: float,
    dt: float,
    i: int,
    out: Array,
    linear: NDArray[np.bool_],
) -> None:
    """``followed_history`` of one actuator i."""
    own_history(times, commands, before, valve, start, dt, i, linear[i], out)
    if follow[i, FOLLOW_KIND] != DIRECT:
        value = _follower_at(times, commands, before, valve, follow[i], first[i], start, dt, i, linear[i])
        follow_history(follow[i], value, dt, i, out)


@njit(cache=True, nogil=True, error_model="numpy")
def first_carried(before: float, follow: Array, first: float, carried: Array) -> None:
    """What ``go_on`` carries along, when the commands begin.

    Args:
        before: command in force before.
        follow: (6,), see ``FOLLOW_KIND``.
        first: value of an integrator.
        carried: (``CARRIED``,) written.
    """
    carried[0], carried[1], carried[2] = before, -1.0, _first_of(before, follow, first)


@njit(cache=True, nogil=True, error_model="numpy")
def go_on(
    times: Array,
    column: Array,
    before: float,
    valve: Array,
    follow: Array,
    start: float,
    dt: float,
    i: int,
    linear: bool,
    carried: Array,
    out: Array,
) -> None:
    """``followed_history`` of one actuator i, piece by piece: each goes on where the one before ended.

    Args:
        times: (n,) as there.
        column: (n,) its commands.
        before: in force before times[0].
        valve: (6,), see ``DELAY``.
        follow: (6,), see ``FOLLOW_KIND``.
        start: of the piece, the first at times[0] [s].
        dt: [s].
        i: its column in what is written.
        linear: its commands go along a line from each row to the next.
        carried: (``CARRIED``,) pressure behind the valve, cursor and what follows, at the start; replaced by those at
            the end.
        out: (steps, 2, na) written.
    """
    pressure, cursor = history_on(times, column, before, valve, start, dt, i, linear, carried[0], int(carried[1]), out)
    carried[0], carried[1] = pressure, cursor
    if follow[FOLLOW_KIND] != DIRECT:
        carried[2] = follow_history(follow, carried[2], dt, i, out)


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    starts: Array,
    dt: float,
    linear: NDArray[np.bool_],
    out: Array,
) -> None:
    """What integrators of commands have come to at some starts, of those that began with the commands.

    One pass leads to all. It stops on a grid alone, so that what is found for a start depends on no other.

    Args:
        times: as in ``followed_history``, as what is not named here.
        commands: as there.
        before: as there.
        valve: as there.
        follow: as there.
        first: (na,) values of the integrators at times[0].
        starts: (m,) [s].
        dt: longest steps in which they are followed [s].
        linear: as there.
        out: (m, na) written where an actuator integrates its command.
    """
    carried, piece, span = np.empty(CARRIED), np.empty((STRIDE, 2, len(first))), STRIDE * dt
    for i in range(len(first)):
        if follow[i, FOLLOW_KIND] != INTEGRATED:
            continue
        column, place = commands[:, i].copy(), 0
        first_carried(before[i], follow[i], first[i], carried)
        for m in np.argsort(starts):
            while times[0] + (place + 1) * span <= starts[m]:
                here = times[0] + place * span
                go_on(times, column, before[i], valve[i], follow[i], here, dt, i, linear[i], carried, piece)
                place += 1
            here, last = times[0] + place * span, carried.copy()
            if starts[m] > here:
                steps = min(max(math.ceil((starts[m] - here) / dt - 1e-9), 1), STRIDE)
                part = (starts[m] - here) / steps
                go_on(times, column, before[i], valve[i], follow[i], here, part, i, linear[i], last, piece[:steps])
            out[m, i] = last[2]


@njit(cache=True, nogil=True, error_model="numpy")
def followed_history(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    start: float,
    dt: float,
    out: Array,
    linear: NDArray[np.bool_],
) -> None:
    """``pressure_history``, and what follows the commands in their place.

    Args:
        times: as there, as what is not named here.
        commands: as there.
        before: as there.
        valve: as there.
        follow: (na, 6), see ``FOLLOW_KIND``.
        first: (na,) values of the integrators at the start.
        start: of the first step [s].
        dt: [s].
        out: (steps, 2, na) written.
        linear: (na,) whether an actuator's commands go along a line from each row to the next; else they are held.
    """
    for i in range(commands.shape[1]):
        own_followed_history(times, commands, before, valve, follow, first, start, dt, i, out, linear)


@njit(cache=True, nogil=True, error_model="numpy")
def arrived(
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    start: float,
    dt: float,
    at: Array,
    out: Array,
    linear: NDArray[np.bool_],
) -> None:
    """What has arrived of the commands at given instants: that of ``followed_history``, not its mean over a step.

    A command counts from the instant on at which it comes.

    Args:
        times: as in ``followed_history``, as what is not named here.
        commands: as there.
        before: as there.
        valve: as there.
        follow: as there.
        first: as there.
        start: of the motion [s].
        dt: longest steps in which what follows the commands is followed [s].
        at: (m,) ascending, none before the start [s].
        out: (m, na) written.
        linear: as there.
    """
    column, piece = np.empty(len(times)), np.empty((1, 2, commands.shape[1]))
    for i in range(commands.shape[1]):
        for k in range(len(times)):
            column[k] = commands[k, i]
        follows, now = follow[i, FOLLOW_KIND] != DIRECT, start
        at_once = not follows and not remembers(valve[i])
        pressure, cursor = settled(times, column, before[i], start, valve[i], linear[i])
        value = pressure
        if follows:
            value = _follower_at(times, commands, before, valve, follow[i], first[i], start, dt, i, linear[i])
        for k in range(len(at)):
            span = at[k] - now
            if span > 0.0:
                # What follows a command takes it for a line over each of the parts.
                parts = max(math.ceil(span / dt - 1e-9), 1) if follows else 1
                for part in range(parts):
                    pressure, piece[0, 0, i], piece[0, 1, i], cursor = advance(
                        times,
                        column,
                        before[i],
                        cursor,
                        now + part * span / parts,
                        span / parts,
                        pressure,
                        valve[i],
                        linear[i],
                    )
                    value = follow_history(follow[i], value, span / parts, i, piece) if follows else pressure
                now = at[k]
            if at_once:
                there = now - valve[i, DELAY]
                last = np.searchsorted(times, there, side="right") - 1
                value = column[last] if last >= 0 else before[i]
                if linear[i] and 0 <= last < len(times) - 1:
                    share = (there - times[last]) / (times[last + 1] - times[last])
                    value += share * (column[last + 1] - column[last])
            out[k, i] = value
