"""The batch kernel: many parameter sets, side by side in lanes, through one trial.

The classical Runge–Kutta method of order four on a fixed grid. Dry friction is held over each step and corrected at its
end by the impulses that velocity-level Coulomb friction asks for: a box-constrained complementarity problem, solved by
projected Gauss–Seidel from the last step's friction. While something slides the held friction is exact and the method
keeps its order; where it sticks, velocities are zero to the solver's residual and angles do not drift. Where it turns
within a step, the correction counts from the instant of the turn, so that a turn costs an error of the step squared.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.sensors import sample
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    N_ROWS,
    N_STATES,
    ROW_BEGIN,
    ROW_BOUND,
    ROW_DELASSUS,
    ROW_END,
    ROW_FROM,
    ROW_GAPS,
    ROW_PART,
    ROW_PHI,
    ROW_PRESSED,
    ROW_PRESSURE,
    ROW_PUSH,
    ROW_QUICK,
    ROW_RATE,
    ROW_SLIP,
    ROW_SPAN,
    ROW_START,
    ROW_SUM,
    ROW_X,
    WORK_ROWS,
    lane_friction,
    lane_motion,
    lane_quickness,
    lane_rest,
    lane_stops,
    prepare_lane,
)
from equimus_ctrl.engines.limits import MAX_SPEED, MOST_DIVISOR, PRESSED
from equimus_ctrl.types import Array

N_STATE = 2 * N_JOINTS + N_STATES
MOST_CUTS = 6
"""How often a lane's step can be cut where stops change; a joint that bounces more often within it is not resolved."""
MOST_PARTS = 128
"""In how many parts a step is taken at most; the last is then what is left."""
BRACKETINGS = 20
SHARPNESS = 1e-11
"""Share of a step to within which the instant is found at which a stop changes."""
ROUNDING = 1e-12
"""A share of a step that is no longer left."""
NOTHING = 1e-100
"""Angles and rates smaller than this are none."""
MOST_SWEEPS = 100
RESIDUAL = 1e-9
"""Rate [rad/s or m/s] below which friction is taken as found."""
SLIDING = 1e-6
"""Rate [rad/s or m/s] above which something slides, and may turn."""


@njit(cache=True, nogil=True, error_model="numpy")
def correct_friction(w: Array, dt: float, rubbing: Array) -> None:
    """Find the friction that the step's end asks for, and change angles and velocities by what is new in it.

    Args:
        w: work array.
        dt: [s].
        rubbing: rows where any lane has dry friction.
    """
    lane_friction(w)
    for i in range(N_ROWS * LANES):
        w[ROW_SUM * LANES + i] = w[ROW_PHI * LANES + i]
    # What changes with a turn does so from then on; with nothing that turns, from the start of the step.
    for r in rubbing:
        for l in range(LANES):  # noqa: E741
            before, after = w[(ROW_SPAN + r) * LANES + l], w[(ROW_SLIP + r) * LANES + l]
            turns = before * after < 0.0 and abs(before) > SLIDING
            w[(ROW_SPAN + r) * LANES + l] = dt * after / (after - before) if turns else dt
    # Each lane stops when its own friction is found, whatever the others do; the rows of the start are free by now.
    sought, worst = ROW_START * LANES, (ROW_START + 1) * LANES
    for l in range(LANES):  # noqa: E741
        w[sought + l] = 1.0
    for _ in range(MOST_SWEEPS):
        for l in range(LANES):  # noqa: E741
            w[worst + l] = 0.0
        for r in rubbing:
            own = (ROW_DELASSUS + r * (N_ROWS + 1)) * LANES
            for l in range(LANES):  # noqa: E741
                bound = w[(ROW_BOUND + r) * LANES + l]
                old = w[(ROW_PHI + r) * LANES + l]
                # An actuator without a lever arm cannot rub.
                span = w[(ROW_SPAN + r) * LANES + l]
                push = w[(ROW_SLIP + r) * LANES + l] / (w[own + l] * span) if w[own + l] > 0.0 else 0.0
                new = min(max(old - push, -bound), bound) if w[sought + l] > 0.0 else old
                w[(ROW_PHI + r) * LANES + l] = new
                w[ROW_RATE * LANES + l] = (new - old) * span
                w[worst + l] = max(w[worst + l], abs(new - old) * span * w[own + l])
            for s in rubbing:
                for l in range(LANES):  # noqa: E741
                    w[(ROW_SLIP + s) * LANES + l] += (
                        w[(ROW_DELASSUS + s + r * N_ROWS) * LANES + l] * w[ROW_RATE * LANES + l]
                    )
        left = 0.0
        for l in range(LANES):  # noqa: E741
            w[sought + l] = 1.0 if w[worst + l] > RESIDUAL else 0.0
            left += w[sought + l]
        if left == 0.0:
            break
    for r in rubbing:
        for j in range(N_JOINTS):
            for l in range(LANES):  # noqa: E741
                span = w[(ROW_SPAN + r) * LANES + l]
                more = (w[(ROW_PHI + r) * LANES + l] - w[(ROW_SUM + r) * LANES + l]) * span
                change = w[(ROW_PUSH + j + r * N_JOINTS) * LANES + l] * more
                w[(ROW_X + j) * LANES + l] += 0.5 * span * change
                w[(ROW_X + N_JOINTS + j) * LANES + l] += change


@njit(cache=True, nogil=True, error_model="numpy")
def copy_rows(w: Array, source: int, target: int, rows: int) -> None:
    """Copy whole rows within the work array."""
    for i in range(rows * LANES):
        w[target * LANES + i] = w[source * LANES + i]


@njit(cache=True, nogil=True, error_model="numpy")
def press_as_asked(w: Array) -> None:
    """Let those stops be pressed that the state asks for."""
    lane_stops(w)
    for i in range(2 * N_JOINTS * LANES):
        w[ROW_PRESSED * LANES + i] = 1.0 if w[ROW_GAPS * LANES + i] > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def advance(w: Array, drive: Array, dt: float, follow: bool) -> None:
    """One Runge–Kutta step from ROW_START over each lane's own part of the grid's step.

    Args:
        w: work array; ROW_FROM and ROW_PART say where the part begins and how long it is, as shares of the step.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: the grid's step [s].
        follow: whether stops follow the state within the step; those pressed are held else.
    """
    copy_rows(w, ROW_START, ROW_X, N_STATE)
    for i in range(N_STATE * LANES):
        w[ROW_SUM * LANES + i] = 0.0
    for stage in range(4):
        into = 0.0 if stage == 0 else 1.0 if stage == 3 else 0.5
        for i in range(N_ACTUATORS):
            for l in range(LANES):  # noqa: E741
                share = w[ROW_FROM * LANES + l] + into * w[ROW_PART * LANES + l] - 0.5
                w[(ROW_PRESSURE + i) * LANES + l] = drive[0, i * LANES + l] + share * drive[1, i * LANES + l]
        if follow:
            press_as_asked(w)
        copy_rows(w, ROW_X + N_JOINTS, ROW_RATE, N_JOINTS)
        lane_motion(w)
        weight = 1.0 if stage == 0 or stage == 3 else 2.0
        h = 0.5 * dt if stage < 2 else dt
        for i in range(N_STATE):
            for l in range(LANES):  # noqa: E741
                rate = w[(ROW_RATE + i) * LANES + l]
                w[(ROW_SUM + i) * LANES + l] += weight * rate
                w[(ROW_X + i) * LANES + l] = w[(ROW_START + i) * LANES + l] + h * w[ROW_PART * LANES + l] * rate
    for i in range(N_STATE):
        for l in range(LANES):  # noqa: E741
            change = dt / 6.0 * w[ROW_PART * LANES + l] * w[(ROW_SUM + i) * LANES + l]
            reached = w[(ROW_START + i) * LANES + l] + change
            # Processors are many times slower with the denormal numbers that speeds at rest decay into.
            w[(ROW_X + i) * LANES + l] = 0.0 if abs(reached) < NOTHING else reached


@njit(cache=True, nogil=True, error_model="numpy")
def anything_pressed(w: Array) -> bool:
    """Whether a stop is pressed in any lane."""
    pressed = 0.0
    for i in range(2 * N_JOINTS * LANES):
        pressed += w[ROW_PRESSED * LANES + i]
    return pressed > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def stops_change(w: Array) -> bool:
    """Whether any lane's state asks for other stops to be pressed than those held; writes ROW_GAPS."""
    lane_stops(w)
    worst = 0.0
    for i in range(2 * N_JOINTS * LANES):
        asked = (1.0 - 2.0 * w[ROW_PRESSED * LANES + i]) * w[ROW_GAPS * LANES + i]
        worst = asked if asked > worst else worst
    return worst > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def limit_parts(w: Array, dt: float) -> bool:
    """Give each lane the part of the step that is left to it, or less where the push of a pressed stop is faster.

    Reads the state in ROW_X; ROW_FROM says where each lane is, and ROW_PART is written.

    Returns:
        Whether any lane was given less.
    """
    lane_quickness(w)
    limited = False
    for l in range(LANES):  # noqa: E741
        left = 1.0 - w[ROW_FROM * LANES + l]
        pressed = 0.0
        for r in range(2 * N_JOINTS):
            pressed += w[(ROW_PRESSED + r) * LANES + l]
        wanted = w[ROW_QUICK * LANES + l] * dt * left / PRESSED
        if pressed > 0.0 and wanted > 1.0:
            left /= min(math.ceil(wanted), MOST_DIVISOR)
            limited = True
        w[ROW_PART * LANES + l] = left
    return limited


@njit(cache=True, nogil=True, error_model="numpy")
def find_changes(w: Array, drive: Array, dt: float, side: NDArray[np.int64], allowed: NDArray[np.bool_]) -> None:
    """Shorten the parts of lanes whose stops change within them to just behind the first change, and go there.

    The instants are found by regula falsi (Anderson and Björck) on the motion itself, so that the method keeps its
    order and predictions are smooth in parameters even where a joint hits a stop.

    Args:
        w: work array; the parts' ends are in ROW_X and ROW_GAPS.
        drive: (2, na·LANES) [Pa].
        dt: the grid's step [s].
        side: (LANES,) written: which stop changes there, −1 where none does.
        allowed: (LANES,) whether a lane's step may still be cut.
    """
    left, right, at_left, at_right = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    last = w[ROW_GAPS * LANES : (ROW_GAPS + 2 * N_JOINTS) * LANES].copy()
    copy_rows(w, ROW_X, ROW_END, N_STATE)
    copy_rows(w, ROW_START, ROW_X, N_STATE)
    lane_stops(w)
    sought = False
    for l in range(LANES):  # noqa: E741
        side[l] = -1
        soonest = 2.0
        for r in range(2 * N_JOINTS):
            sign = 1.0 - 2.0 * w[(ROW_PRESSED + r) * LANES + l]
            before, after = sign * w[(ROW_GAPS + r) * LANES + l], sign * last[r * LANES + l]
            if after > 0.0 and allowed[l]:
                crossing = before / (before - after) if before < 0.0 else 0.0
                if crossing < soonest:
                    soonest, side[l] = crossing, r
                    at_left[l], at_right[l] = before, after
        left[l] = right[l] = w[ROW_PART * LANES + l]
        if side[l] >= 0:
            left[l] = 0.0
            right[l] *= 1.0 if soonest > 0.0 else 0.0
            sought = sought or left[l] < right[l]
    part = w[ROW_PART * LANES : (ROW_PART + 1) * LANES].copy()
    for l in range(LANES):  # noqa: E741
        w[ROW_PART * LANES + l] = right[l]
    for _ in range(BRACKETINGS):
        if not sought:
            break
        for l in range(LANES):  # noqa: E741
            if left[l] < right[l]:
                # Just behind the crossing, so that the search ends with a state in which the stop has changed.
                tried = right[l] - at_right[l] * (right[l] - left[l]) / (at_right[l] - at_left[l])
                tried += 0.5 * SHARPNESS * part[l]
                w[ROW_PART * LANES + l] = tried if left[l] < tried < right[l] else 0.5 * (left[l] + right[l])
        advance(w, drive, dt, False)
        lane_stops(w)
        sought = False
        for l in range(LANES):  # noqa: E741
            if not left[l] < right[l]:
                continue
            sign = 1.0 - 2.0 * w[(ROW_PRESSED + side[l]) * LANES + l]
            found, tried = sign * w[(ROW_GAPS + side[l]) * LANES + l], w[ROW_PART * LANES + l]
            if found > 0.0:
                behind = found * (right[l] - tried) / (at_right[l] - found) if at_right[l] > found else right[l]
                shrink = 1.0 - found / at_right[l]
                at_left[l] *= shrink if shrink > 0.0 else 0.5
                right[l], at_right[l] = tried, found
                if min(behind, right[l] - left[l]) < SHARPNESS * part[l]:
                    left[l] = right[l]
            else:
                shrink = 1.0 - found / at_left[l] if at_left[l] < 0.0 else 0.0
                at_right[l] *= shrink if shrink > 0.0 else 0.5
                left[l], at_left[l] = tried, found
            sought = sought or left[l] < right[l]
    for l in range(LANES):  # noqa: E741
        w[ROW_PART * LANES + l] = right[l]
    advance(w, drive, dt, False)
    for l in range(LANES):  # noqa: E741
        if side[l] < 0:
            for i in range(N_STATE):
                w[(ROW_X + i) * LANES + l] = w[(ROW_END + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def finish_step(w: Array, drive: Array, dt: float) -> None:
    """Take the rest of a step, of which each lane has gone over its first part, its stops held, to ROW_X.

    Where a stop changes the lane's part ends, and where one is pressed parts are as short as its push is fast.

    Args:
        w: work array; as ``advance`` leaves it.
        drive: (2, na·LANES) [Pa].
        dt: the grid's step [s].
    """
    copy_rows(w, ROW_START, ROW_BEGIN, N_STATE)
    side, cuts = np.empty(LANES, dtype=np.int64), np.zeros(LANES, dtype=np.int64)
    for part in range(MOST_PARTS):
        for l in range(LANES):  # noqa: E741
            side[l] = -1
        if stops_change(w):
            find_changes(w, drive, dt, side, cuts < MOST_CUTS)
        copy_rows(w, ROW_X, ROW_START, N_STATE)
        left = 0.0
        for l in range(LANES):  # noqa: E741
            begun = w[ROW_FROM * LANES + l] + w[ROW_PART * LANES + l]
            w[ROW_FROM * LANES + l] = begun if begun < 1.0 - ROUNDING else 1.0
            left += 1.0 - w[ROW_FROM * LANES + l]
            if side[l] >= 0:
                cuts[l] += 1
                w[(ROW_PRESSED + side[l]) * LANES + l] = 1.0 - w[(ROW_PRESSED + side[l]) * LANES + l]
        if left == 0.0:
            break
        limit_parts(w, dt if part < MOST_PARTS - 2 else 0.0)
        advance(w, drive, dt, False)
    copy_rows(w, ROW_BEGIN, ROW_START, N_STATE)


@njit(cache=True, nogil=True, error_model="numpy")
def step(w: Array, drive: Array, dt: float) -> None:
    """One step of the grid from ROW_X, whose state stays in ROW_START, dry friction held.

    Args:
        w: work array.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: [s].
    """
    copy_rows(w, ROW_X, ROW_START, N_STATE)
    for l in range(LANES):  # noqa: E741
        w[ROW_FROM * LANES + l], w[ROW_PART * LANES + l] = 0.0, 1.0
    limited = anything_pressed(w) and limit_parts(w, dt)
    advance(w, drive, dt, False)
    if limited or stops_change(w):
        finish_step(w, drive, dt)


@njit(cache=True, nogil=True, error_model="numpy")
def run_lanes(w: Array, drive: Array, dt: float, rubbing: Array, out: Array) -> None:
    """Integrate all lanes over a grid.

    Args:
        w: work array with state and constants.
        drive: (steps, 2, na·LANES) mean and slope of the pressures over each step [Pa].
        dt: [s].
        rubbing: rows where any lane has dry friction.
        out: (steps + 1, r·LANES) written: the first r rows of the state on the grid.
    """
    steps = len(drive)
    press_as_asked(w)
    for k in range(steps + 1):
        for i in range(out.shape[1]):
            out[k, i] = w[ROW_X * LANES + i]
        if k == steps:
            break
        step(w, drive[k], dt)
        if len(rubbing) > 0:
            correct_friction(w, dt, rubbing)


@njit(cache=True, nogil=True, error_model="numpy")
def begin_block(
    w: Array,
    drive: Array,
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    q0: Array,
    v0: Array,
    start: float,
    dt: float,
) -> None:
    """Put parameter sets at rest into the work array w and their pressures into drive (steps, 2, na·LANES).

    The other arguments are those of ``run_block``.
    """
    k, steps = len(parameters), len(drive)
    history = np.empty((steps, 2, N_ACTUATORS))
    for l in range(LANES):  # noqa: E741
        # Lanes without a set of their own repeat the last.
        own = min(l, k - 1)
        prepare_lane(parameters[own], w, l)
        for j in range(N_JOINTS):
            w[(ROW_X + j) * LANES + l] = q0[own, j]
            w[(ROW_X + N_JOINTS + j) * LANES + l] = v0[own, j]
        if l < k and not (l > 0 and _same(commands, before, valve, l)):
            pressure_history(times, commands[own], before[own], valve[own], start, dt, history)
        for s in range(steps):
            for i in range(N_ACTUATORS):
                drive[s, 0, i * LANES + l] = history[s, 0, i]
                drive[s, 1, i * LANES + l] = history[s, 1, i]
    lane_rest(w)


@njit(cache=True, nogil=True, error_model="numpy")
def run_block(
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    sensor: Array,
    q0: Array,
    v0: Array,
    rubbing: Array,
    start: float,
    dt: float,
    steps: int,
    out_times: Array,
    out: Array,
    reached: Array,
) -> None:
    """Up to LANES parameter sets through one trial: valves, motion and sensors.

    Args:
        parameters: (k, np) parameter vectors, k ≤ LANES.
        times: (n,) from when each command holds [s].
        commands: (k, n, na) what reaches the valves [Pa].
        before: (k, na) in force before [Pa].
        valve: (k, na, 6), see ``effects.valves``.
        sensor: (k, nj, 4), see ``effects.sensors``.
        q0: (k, nj) angles at the start [rad].
        v0: (k, nj) velocities there [rad/s].
        rubbing: rows where any has dry friction.
        start: of the motion [s].
        dt: physics step [s].
        steps: how many.
        out_times: (m,) ascending [s].
        out: (k, m, nj) written: measured angles [rad].
        reached: (k,) written: m where all is well, else the index of the first sample that could not be had.
    """
    k, m = len(parameters), len(out_times)
    w = np.zeros(WORK_ROWS * LANES)
    drive = np.empty((steps, 2, N_ACTUATORS * LANES))
    begin_block(w, drive, parameters, times, commands, before, valve, q0, v0, start, dt)
    grid = np.empty((steps + 1, 2 * N_JOINTS * LANES))
    run_lanes(w, drive, dt, rubbing, grid)
    q, v = np.empty(steps + 1), np.empty(steps + 1)
    y = np.empty(m)
    for l in range(k):  # noqa: E741
        reached[l] = m
        for j in range(N_JOINTS):
            for s in range(steps + 1):
                q[s] = grid[s, j * LANES + l]
                v[s] = grid[s, (N_JOINTS + j) * LANES + l]
            sample(q, v, start, dt, sensor[l, j], out_times, y)
            for i in range(m):
                out[l, i, j] = y[i]
            for s in range(steps + 1):
                if not abs(v[s]) < MAX_SPEED:
                    lost = start + (s - 1) * dt + sensor[l, j, 2]
                    reached[l] = min(reached[l], np.searchsorted(out_times, lost, side="right"))
                    break


@njit(cache=True, nogil=True, error_model="numpy")
def run_inner(
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    q0: Array,
    v0: Array,
    rubbing: Array,
    start: float,
    dt: float,
    states: Array,
    pressures: Array,
) -> None:
    """One parameter set through one trial, with what no sensor shows.

    Args:
        parameters: (1, np), as all arrays that are handed in those of ``run_block`` for one set.
        times: (n,) [s].
        commands: (1, n, na) [Pa].
        before: (1, na) [Pa].
        valve: (1, na, 6).
        q0: (1, nj) [rad].
        v0: (1, nj) [rad/s].
        rubbing: rows with dry friction.
        start: of the motion [s].
        dt: physics step [s].
        states: (steps + 1, 2 nj + nz) written: angles, velocities and effect states on the grid.
        pressures: (steps, 2, na) written: mean and slope over each step [Pa].
    """
    w = np.zeros(WORK_ROWS * LANES)
    drive = np.empty((len(pressures), 2, N_ACTUATORS * LANES))
    begin_block(w, drive, parameters, times, commands, before, valve, q0, v0, start, dt)
    grid = np.empty((len(states), N_STATE * LANES))
    run_lanes(w, drive, dt, rubbing, grid)
    for s in range(len(states)):
        for i in range(N_STATE):
            states[s, i] = grid[s, i * LANES]
    for s in range(len(pressures)):
        for i in range(N_ACTUATORS):
            pressures[s, 0, i] = drive[s, 0, i * LANES]
            pressures[s, 1, i] = drive[s, 1, i * LANES]


@njit(cache=True, nogil=True, error_model="numpy")
def _same(commands: Array, before: Array, valve: Array, l: int) -> bool:  # noqa: E741
    """Whether a lane has the pressures of the one before it."""
    return bool(
        np.array_equal(valve[l], valve[l - 1])
        and np.array_equal(before[l], before[l - 1])
        and np.array_equal(commands[l], commands[l - 1])
    )
