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
    N_JOINTS,
    N_LIMITS,
    N_STATES,
    QUICK_INSIDE,
    ROW_BEGIN,
    ROW_DEPTHS,
    ROW_DT,
    ROW_END,
    ROW_FROM,
    ROW_GAPS,
    ROW_GRIP,
    ROW_MEAN,
    ROW_PART,
    ROW_PRESSED,
    ROW_PRESSURE,
    ROW_QUICK,
    ROW_RATE,
    ROW_SLOPE,
    ROW_START,
    ROW_SUM,
    ROW_X,
    SHORT,
    SOFT_LIMITS,
    lane_depths,
    lane_gaps,
    lane_grips,
    lane_keep,
    lane_motion,
    lane_quickness,
    lane_whole_step,
)
from equimus_ctrl.engines.limits import MOST_DIVISOR, NOTHING, PRESSED
from equimus_ctrl.types import Array

N_STATE = 2 * N_JOINTS + N_STATES
MOST_CUTS = 6
"""How often a lane's step can be cut where stops change; a joint that bounces more often within it is not resolved."""
MOST_PARTS = 128
"""In how many parts a step is taken at most; the last is then the rest."""
BRACKETINGS = 20
SHARPNESS = 1e-11
"""Share of a step to within which the instant is found at which a stop changes."""
ROUNDING = 1e-12
"""A share of a step that is no longer left."""


@njit(cache=True, nogil=True, error_model="numpy")
def copy_rows(w: Array, source: int, target: int, rows: int) -> None:
    """Copy whole rows within the work array."""
    for i in range(rows * LANES):
        w[target * LANES + i] = w[source * LANES + i]


@njit(cache=True, nogil=True, error_model="numpy")
def beyond_limits(w: Array) -> bool:
    """Whether a coordinate is beyond its limit in any lane: what is not cannot be pressed."""
    if N_LIMITS == 0:
        return False
    lane_depths(w)
    for i in range(N_LIMITS * LANES):  # noqa: SIM110
        if w[ROW_DEPTHS * LANES + i] > 0.0:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def anything_pressed(w: Array) -> bool:
    """Whether a limit is pressed in any lane."""
    for i in range(N_LIMITS * LANES):  # noqa: SIM110
        if w[ROW_PRESSED * LANES + i] > 0.0:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def grip_limits(w: Array, pressed: bool) -> None:
    """Write what the limits do in the state in ROW_X, where any is pressed, else nothing."""
    if pressed:
        lane_grips(w)
    else:
        for i in range(2 * N_LIMITS * LANES):
            w[ROW_GRIP * LANES + i] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def lane_stops(w: Array) -> None:
    """From state, pressure, friction and pressed limits: ROW_GAPS, above 0 where a limit would be pressed."""
    if SOFT_LIMITS:
        grip_limits(w, anything_pressed(w))
        lane_motion(w)
    lane_gaps(w)


@njit(cache=True, nogil=True, error_model="numpy")
def press_as_asked(w: Array) -> None:
    """Let those limits be pressed that the state asks for, each as if by itself."""
    for i in range(N_LIMITS * LANES):
        w[ROW_PRESSED * LANES + i] = 0.0
    if not beyond_limits(w):
        return
    lane_stops(w)
    for i in range(N_LIMITS * LANES):
        w[ROW_PRESSED * LANES + i] = 1.0 if w[ROW_GAPS * LANES + i] > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def advance_at_once(w: Array, drive: Array, dt: float) -> None:
    """``advance`` with nothing pressed, of a robot whose whole step is one function."""
    for i in range(N_ACTUATORS):
        for l in range(LANES):  # noqa: E741
            mean, slope = drive[0, i * LANES + l], drive[1, i * LANES + l]
            end = w[ROW_FROM * LANES + l] + w[ROW_PART * LANES + l] - 0.5
            w[(ROW_MEAN + i) * LANES + l], w[(ROW_SLOPE + i) * LANES + l] = mean, slope
            w[(ROW_PRESSURE + i) * LANES + l] = mean + end * slope
    for l in range(LANES):  # noqa: E741
        w[ROW_DT * LANES + l] = dt
    grip_limits(w, False)
    lane_whole_step(w)


@njit(cache=True, nogil=True, error_model="numpy")
def advance(w: Array, drive: Array, dt: float, pressed: bool, follow: bool = False) -> None:
    """One Runge–Kutta step from ROW_START over each lane's own part of the grid's step.

    Args:
        w: work array; ROW_FROM and ROW_PART say where the part begins and how long it is, as shares of the step.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: the grid's step [s].
        pressed: whether any limit is pressed.
        follow: whether stops follow the state within the step; those pressed are held else.
    """
    if SHORT and not follow and not pressed:
        advance_at_once(w, drive, dt)
        return
    copy_rows(w, ROW_START, ROW_X, N_STATE)
    for i in range(N_STATE * LANES):
        w[ROW_SUM * LANES + i] = 0.0
    grip_limits(w, pressed)
    for stage in range(4):
        into = 0.0 if stage == 0 else 1.0 if stage == 3 else 0.5
        for i in range(N_ACTUATORS):
            for l in range(LANES):  # noqa: E741
                share = w[ROW_FROM * LANES + l] + into * w[ROW_PART * LANES + l] - 0.5
                w[(ROW_PRESSURE + i) * LANES + l] = drive[0, i * LANES + l] + share * drive[1, i * LANES + l]
        if follow:
            press_as_asked(w)
            grip_limits(w, anything_pressed(w))
        elif pressed:
            grip_limits(w, True)
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
            w[(ROW_X + i) * LANES + l] = 0.0 if abs(reached) < NOTHING else reached


@njit(cache=True, nogil=True, error_model="numpy")
def stops_change(w: Array, pressed: bool) -> bool:
    """Whether any lane's state asks for other limits to be pressed than those held; then it writes ROW_GAPS."""
    if not (pressed or beyond_limits(w)):
        return False
    lane_stops(w)
    worst = 0.0
    for i in range(N_LIMITS * LANES):
        asked = (1.0 - 2.0 * w[ROW_PRESSED * LANES + i]) * w[ROW_GAPS * LANES + i]
        worst = asked if asked > worst else worst
    return worst > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def limit_parts(w: Array, dt: float) -> bool:
    """Give each lane the part of the step that is left to it, or less where a pressed stop has faster transients.

    Reads the state in ROW_X; ROW_FROM says where each lane is, and ROW_PART is written.

    Returns:
        Whether any lane was given less.
    """
    lane_quickness(w)
    limited = False
    for l in range(LANES):  # noqa: E741
        left = 1.0 - w[ROW_FROM * LANES + l]
        pressed = 0.0
        for r in range(N_LIMITS):
            pressed += w[(ROW_PRESSED + r) * LANES + l]
        wanted = w[ROW_QUICK * LANES + l] * dt * left / PRESSED
        if (QUICK_INSIDE or pressed > 0.0) and wanted > 1.0:
            left /= min(math.ceil(wanted), MOST_DIVISOR)
            limited = True
        w[ROW_PART * LANES + l] = left
    return limited


@njit(cache=True, nogil=True, error_model="numpy")
def find_changes(
    w: Array, drive: Array, dt: float, pressed: bool, side: NDArray[np.int64], allowed: NDArray[np.bool_]
) -> None:
    """Shorten the parts of lanes whose stops change within them to just behind the first change, and go there.

    The instants are found by regula falsi (Anderson and Björck) on the motion itself, so that the method keeps its
    order and predictions are smooth in parameters even where a joint hits a stop.

    Args:
        w: work array; the parts' ends are in ROW_X and ROW_GAPS.
        drive: (2, na·LANES) [Pa].
        dt: the grid's step [s].
        pressed: whether any limit is pressed.
        side: (LANES,) written: which stop changes there, −1 where none does.
        allowed: (LANES,) whether a lane's step may still be cut.
    """
    left, right, at_left, at_right = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    last = w[ROW_GAPS * LANES : (ROW_GAPS + N_LIMITS) * LANES].copy()
    copy_rows(w, ROW_X, ROW_END, N_STATE)
    copy_rows(w, ROW_START, ROW_X, N_STATE)
    lane_stops(w)
    sought = False
    for l in range(LANES):  # noqa: E741
        side[l] = -1
        soonest = 2.0
        for r in range(N_LIMITS):
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
        advance(w, drive, dt, pressed)
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
    advance(w, drive, dt, pressed)
    for l in range(LANES):  # noqa: E741
        if side[l] < 0:
            for i in range(N_STATE):
                w[(ROW_X + i) * LANES + l] = w[(ROW_END + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def finish_step(w: Array, drive: Array, dt: float) -> None:
    """Take the rest of a step, of which each lane has gone over its first part, its stops held, to ROW_X.

    Where a stop changes the lane's part ends, and where one is pressed parts are as short as its transients ask for.

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
        pressed = anything_pressed(w)
        if stops_change(w, pressed):
            find_changes(w, drive, dt, pressed, side, cuts < MOST_CUTS)
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
        # The last part takes all that is left: over no time nothing is too fast.
        limit_parts(w, dt if part < MOST_PARTS - 2 else 0.0)
        advance(w, drive, dt, anything_pressed(w))
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
    pressed = anything_pressed(w)
    limited = (QUICK_INSIDE or pressed) and limit_parts(w, dt)
    advance(w, drive, dt, pressed)
    if limited or stops_change(w, pressed):
        finish_step(w, drive, dt)
    if BOUNDED:
        lane_keep(w)
