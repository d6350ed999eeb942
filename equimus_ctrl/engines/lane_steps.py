"""Steps of the batch kernel: the classical Runge–Kutta method of order four, cut where joint stops change.

What is pressed is held over a part of a step, so that the motion is smooth there; where a stop is hit or left the part
ends, and where one is pressed parts are as short as its transients ask for.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.engines.lane_functions import (
    BOUNDED,
    LANES,
    N_ACTUATORS,
    N_LIMITS,
    N_STATE,
    QUICK_INSIDE,
    ROW_BEGIN,
    ROW_DEPTHS,
    ROW_DT,
    ROW_END,
    ROW_FROM,
    ROW_GAPS,
    ROW_GRIP,
    ROW_H,
    ROW_INTO,
    ROW_MEAN,
    ROW_PART,
    ROW_PRESSED,
    ROW_QUICK,
    ROW_SIXTH,
    ROW_SLOPE,
    ROW_START,
    ROW_SUM,
    ROW_WEIGHT,
    ROW_X,
    SHORT,
    SOFT_LIMITS,
    Layout,
    bare,
    copy_rows,
    fill_row,
    lane_depths,
    lane_drive,
    lane_gaps,
    lane_grips,
    lane_keep,
    lane_motion,
    lane_push,
    lane_quickness,
    lane_reach,
    lane_sum,
    lane_whole_step,
)
from equimus_ctrl.engines.limits import MOST_DIVISOR, PRESSED
from equimus_ctrl.types import Array

MOST_CUTS = 6
"""How often a lane's step can be cut where stops change; a joint that bounces more often within it is not resolved."""
MOST_PARTS = 128
"""In how many parts a step is taken at most; the last is then the rest."""
BRACKETINGS = 20
SHARPNESS = 1e-11
"""Share of a step to within which the instant is found at which a stop changes."""
ROUNDING = 1e-12
"""A share of a step that is no longer left."""


@bare
def any_above_zero(w: Array, row: int, rows: int) -> bool:
    """Whether any number of some rows is above 0; all are looked at, which goes in vectors."""
    begin, found = row * LANES, 0
    for i in range(rows * LANES):
        found |= w[begin + i] > 0.0
    return found > 0


@bare
def beyond_limits(robot: Layout, w: Array) -> bool:
    """Whether a coordinate is beyond its limit in any lane: what is not cannot be pressed."""
    if robot[N_LIMITS] == 0:
        return False
    lane_depths(robot, w)
    return any_above_zero(w, robot[ROW_DEPTHS], robot[N_LIMITS])


@bare
def anything_pressed(robot: Layout, w: Array) -> bool:
    """Whether a limit is pressed in any lane."""
    return any_above_zero(w, robot[ROW_PRESSED], robot[N_LIMITS])


@bare
def grip_limits(robot: Layout, w: Array, pressed: bool) -> None:
    """Write what the limits do in the state in ROW_X, where any is pressed, else nothing."""
    if pressed:
        lane_grips(robot, w)
    else:
        grip = robot[ROW_GRIP] * LANES
        for i in range(2 * robot[N_LIMITS] * LANES):
            w[grip + i] = 0.0


@bare
def lane_stops(robot: Layout, w: Array) -> None:
    """From state, pressure, friction and pressed limits: ROW_GAPS, above 0 where a limit would be pressed."""
    if robot[SOFT_LIMITS]:
        grip_limits(robot, w, anything_pressed(robot, w))
        lane_motion(robot, w)
    lane_gaps(robot, w)


@bare
def press_as_asked(robot: Layout, w: Array) -> None:
    """Let those limits be pressed that the state asks for, each as if by itself."""
    for i in range(robot[N_LIMITS] * LANES):
        w[robot[ROW_PRESSED] * LANES + i] = 0.0
    if not beyond_limits(robot, w):
        return
    lane_stops(robot, w)
    for i in range(robot[N_LIMITS] * LANES):
        w[robot[ROW_PRESSED] * LANES + i] = 1.0 if w[robot[ROW_GAPS] * LANES + i] > 0.0 else 0.0


@bare
def advance_at_once(robot: Layout, w: Array, dt: float) -> None:
    """``advance`` with nothing pressed, of a robot whose whole step is one function."""
    fill_row(w, robot[ROW_INTO], 1.0)
    lane_drive(robot, w)
    fill_row(w, robot[ROW_DT], dt)
    grip_limits(robot, w, False)
    lane_whole_step(robot, w)


@bare
def advance(robot: Layout, w: Array, drive: Array, dt: float, pressed: bool, follow: bool = False) -> None:
    """One Runge–Kutta step from ROW_START over each lane's own part of the grid's step.

    Args:
        robot: see ``lane_functions``.
        w: work array; ROW_FROM and ROW_PART say where the part begins and how long it is, as shares of the step.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: the grid's step [s].
        pressed: whether any limit is pressed.
        follow: whether stops follow the state within the step; those pressed are held else.
    """
    n, mean, slope = robot[N_STATE], robot[ROW_MEAN] * LANES, robot[ROW_SLOPE] * LANES
    for i in range(robot[N_ACTUATORS] * LANES):
        w[mean + i], w[slope + i] = drive[0, i], drive[1, i]
    if robot[SHORT] and not follow and not pressed:
        advance_at_once(robot, w, dt)
        return
    copy_rows(w, robot[ROW_START], robot[ROW_X], n)
    total = robot[ROW_SUM] * LANES
    for i in range(n * LANES):
        w[total + i] = 0.0
    grip_limits(robot, w, pressed)
    for stage in range(4):
        fill_row(w, robot[ROW_INTO], 0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)
        lane_drive(robot, w)
        if follow:
            press_as_asked(robot, w)
            grip_limits(robot, w, anything_pressed(robot, w))
        elif pressed:
            grip_limits(robot, w, True)
        lane_motion(robot, w)
        fill_row(w, robot[ROW_WEIGHT], 1.0 if stage == 0 or stage == 3 else 2.0)
        lane_sum(robot, w)
        if stage < 3:
            fill_row(w, robot[ROW_H], 0.5 * dt if stage < 2 else dt)
            lane_push(robot, w)
    fill_row(w, robot[ROW_SIXTH], dt / 6.0)
    lane_reach(robot, w)


@bare
def stops_change(robot: Layout, w: Array, pressed: bool) -> bool:
    """Whether any lane's state asks for other limits to be pressed than those held; then it writes ROW_GAPS."""
    if not (pressed or beyond_limits(robot, w)):
        return False
    lane_stops(robot, w)
    worst = 0.0
    for i in range(robot[N_LIMITS] * LANES):
        asked = (1.0 - 2.0 * w[robot[ROW_PRESSED] * LANES + i]) * w[robot[ROW_GAPS] * LANES + i]
        worst = asked if asked > worst else worst
    return worst > 0.0


@bare
def limit_parts(robot: Layout, w: Array, dt: float) -> bool:
    """Give each lane the part of the step that is left to it, or less where a pressed stop has faster transients.

    Reads the state in ROW_X; ROW_FROM says where each lane is, and ROW_PART is written.

    Returns:
        Whether any lane was given less.
    """
    lane_quickness(robot, w)
    limited = False
    for l in range(LANES):  # noqa: E741
        left = 1.0 - w[robot[ROW_FROM] * LANES + l]
        pressed = 0.0
        for r in range(robot[N_LIMITS]):
            pressed += w[(robot[ROW_PRESSED] + r) * LANES + l]
        wanted = w[robot[ROW_QUICK] * LANES + l] * dt * left / PRESSED
        if (robot[QUICK_INSIDE] or pressed > 0.0) and wanted > 1.0:
            left /= min(math.ceil(wanted), MOST_DIVISOR)
            limited = True
        w[robot[ROW_PART] * LANES + l] = left
    return limited


@njit(cache=True, nogil=True, error_model="numpy")
def find_changes(
    robot: Layout, w: Array, drive: Array, dt: float, pressed: bool, side: NDArray[np.int64], allowed: NDArray[np.bool_]
) -> None:
    """Shorten the parts of lanes whose stops change within them to just behind the first change, and go there.

    The instants are found by regula falsi (Anderson and Björck) on the motion itself, so that the method keeps its
    order and predictions are smooth in parameters even where a joint hits a stop.

    Args:
        robot: see ``lane_functions``.
        w: work array; the parts' ends are in ROW_X and ROW_GAPS.
        drive: (2, na·LANES) [Pa].
        dt: the grid's step [s].
        pressed: whether any limit is pressed.
        side: (LANES,) written: which stop changes there, −1 where none does.
        allowed: (LANES,) whether a lane's step may still be cut.
    """
    left, right, at_left, at_right = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    last = w[robot[ROW_GAPS] * LANES : (robot[ROW_GAPS] + robot[N_LIMITS]) * LANES].copy()
    copy_rows(w, robot[ROW_X], robot[ROW_END], robot[N_STATE])
    copy_rows(w, robot[ROW_START], robot[ROW_X], robot[N_STATE])
    lane_stops(robot, w)
    sought = False
    for l in range(LANES):  # noqa: E741
        side[l] = -1
        soonest = 2.0
        for r in range(robot[N_LIMITS]):
            sign = 1.0 - 2.0 * w[(robot[ROW_PRESSED] + r) * LANES + l]
            before, after = sign * w[(robot[ROW_GAPS] + r) * LANES + l], sign * last[r * LANES + l]
            if after > 0.0 and allowed[l]:
                crossing = before / (before - after) if before < 0.0 else 0.0
                if crossing < soonest:
                    soonest, side[l] = crossing, r
                    at_left[l], at_right[l] = before, after
        left[l] = right[l] = w[robot[ROW_PART] * LANES + l]
        if side[l] >= 0:
            left[l] = 0.0
            right[l] *= 1.0 if soonest > 0.0 else 0.0
            sought = sought or left[l] < right[l]
    part = w[robot[ROW_PART] * LANES : (robot[ROW_PART] + 1) * LANES].copy()
    for l in range(LANES):  # noqa: E741
        w[robot[ROW_PART] * LANES + l] = right[l]
    for _ in range(BRACKETINGS):
        if not sought:
            break
        for l in range(LANES):  # noqa: E741
            if left[l] < right[l]:
                # Just behind the crossing, so that the search ends with a state in which the stop has changed.
                tried = right[l] - at_right[l] * (right[l] - left[l]) / (at_right[l] - at_left[l])
                tried += 0.5 * SHARPNESS * part[l]
                w[robot[ROW_PART] * LANES + l] = tried if left[l] < tried < right[l] else 0.5 * (left[l] + right[l])
        advance(robot, w, drive, dt, pressed)
        lane_stops(robot, w)
        sought = False
        for l in range(LANES):  # noqa: E741
            if not left[l] < right[l]:
                continue
            sign = 1.0 - 2.0 * w[(robot[ROW_PRESSED] + side[l]) * LANES + l]
            found, tried = sign * w[(robot[ROW_GAPS] + side[l]) * LANES + l], w[robot[ROW_PART] * LANES + l]
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
        w[robot[ROW_PART] * LANES + l] = right[l]
    advance(robot, w, drive, dt, pressed)
    for l in range(LANES):  # noqa: E741
        if side[l] < 0:
            for i in range(robot[N_STATE]):
                w[(robot[ROW_X] + i) * LANES + l] = w[(robot[ROW_END] + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def finish_step(robot: Layout, w: Array, drive: Array, dt: float) -> None:
    """Take the rest of a step, of which each lane has gone over its first part, its stops held, to ROW_X.

    Where a stop changes the lane's part ends, and where one is pressed parts are as short as its transients ask for.

    Args:
        robot: see ``lane_functions``.
        w: work array; as ``advance`` leaves it.
        drive: (2, na·LANES) [Pa].
        dt: the grid's step [s].
    """
    copy_rows(w, robot[ROW_START], robot[ROW_BEGIN], robot[N_STATE])
    side, cuts = np.empty(LANES, dtype=np.int64), np.zeros(LANES, dtype=np.int64)
    for part in range(MOST_PARTS):
        for l in range(LANES):  # noqa: E741
            side[l] = -1
        pressed = anything_pressed(robot, w)
        if stops_change(robot, w, pressed):
            find_changes(robot, w, drive, dt, pressed, side, cuts < MOST_CUTS)
        copy_rows(w, robot[ROW_X], robot[ROW_START], robot[N_STATE])
        left = 0.0
        for l in range(LANES):  # noqa: E741
            begun = w[robot[ROW_FROM] * LANES + l] + w[robot[ROW_PART] * LANES + l]
            w[robot[ROW_FROM] * LANES + l] = begun if begun < 1.0 - ROUNDING else 1.0
            left += 1.0 - w[robot[ROW_FROM] * LANES + l]
            if side[l] >= 0:
                cuts[l] += 1
                w[(robot[ROW_PRESSED] + side[l]) * LANES + l] = 1.0 - w[(robot[ROW_PRESSED] + side[l]) * LANES + l]
        if left == 0.0:
            break
        # The last part takes all that is left: over no time nothing is too fast.
        limit_parts(robot, w, dt if part < MOST_PARTS - 2 else 0.0)
        advance(robot, w, drive, dt, anything_pressed(robot, w))
    copy_rows(w, robot[ROW_BEGIN], robot[ROW_START], robot[N_STATE])


@njit(cache=True, nogil=True, error_model="numpy")
def step(robot: Layout, w: Array, drive: Array, dt: float) -> None:
    """One step of the grid from ROW_X, whose state stays in ROW_START, dry friction held.

    Args:
        robot: see ``lane_functions``.
        w: work array.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: [s].
    """
    copy_rows(w, robot[ROW_X], robot[ROW_START], robot[N_STATE])
    fill_row(w, robot[ROW_FROM], 0.0)
    fill_row(w, robot[ROW_PART], 1.0)
    pressed = anything_pressed(robot, w)
    limited = (robot[QUICK_INSIDE] or pressed) and limit_parts(robot, w, dt)
    advance(robot, w, drive, dt, pressed)
    if limited or stops_change(robot, w, pressed):
        finish_step(robot, w, drive, dt)
    if robot[BOUNDED]:
        lane_keep(robot, w)
