"""Where the batch kernel begins: constants of parameter sets, the state at a start, and what arrives of the commands.

Units are those of ``lane_functions``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.command import followed_history
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    ROW_CONSTANTS,
    ROW_TIME,
    ROW_X,
    WORK_ROWS,
    lane_start,
    prepare_lane,
)
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def prepared(parameters: Array) -> Array:
    """A work array with the constants of up to LANES parameter sets (k, np); lanes to spare repeat the last."""
    w = np.zeros(WORK_ROWS * LANES)
    for l in range(LANES):  # noqa: E741
        prepare_lane(parameters[min(l, len(parameters) - 1)], w, l)
    return w


@njit(cache=True, nogil=True, error_model="numpy")
def same_as_previous(commands: Array, before: Array, valve: Array, follow: Array) -> NDArray[np.bool_]:
    """(k,) whether what reaches a lane's valves, and what they make of it, is as in the lane before it."""
    same = np.zeros(len(commands), dtype=np.bool_)
    for l in range(1, len(commands)):  # noqa: E741
        same[l] = (
            np.array_equal(valve[l], valve[l - 1])
            and np.array_equal(follow[l], follow[l - 1])
            and np.array_equal(before[l], before[l - 1])
            and np.array_equal(commands[l], commands[l - 1])
        )
    return same


@njit(cache=True, nogil=True, error_model="numpy")
def clear(w: Array, time: float) -> None:
    """Clear all of the work array but the constants, a time after the recording began [s]."""
    for i in range(ROW_CONSTANTS * LANES):
        w[i] = 0.0
    for l in range(LANES):  # noqa: E741
        w[ROW_TIME * LANES + l] = time


@njit(cache=True, nogil=True, error_model="numpy")
def begin_trial(
    w: Array,
    drive: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    q0: Array,
    v0: Array,
    start: float,
    dt: float,
    same: NDArray[np.bool_],
    linear: NDArray[np.bool_],
) -> None:
    """Put the lanes of the work array w at a start, and the pressures into drive (steps, 2, na·LANES).

    The other arguments are those of ``run_trials``, for one trial, and what ``same_as_previous`` says of the lanes.
    """
    k = len(q0)
    clear(w, start - times[0])
    for l in range(LANES):  # noqa: E741
        own = min(l, k - 1)
        for j in range(N_JOINTS):
            w[(ROW_X + j) * LANES + l] = q0[own, j]
            w[(ROW_X + N_JOINTS + j) * LANES + l] = v0[own, j]
    lane_start(w)
    put_commands(drive, times, commands, before, valve, follow, first, start, dt, same, linear)


@njit(cache=True, nogil=True, error_model="numpy")
def put_commands(
    drive: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    start: float,
    dt: float,
    same: NDArray[np.bool_],
    linear: NDArray[np.bool_],
) -> None:
    """What arrives of the commands over the steps from a start on, into drive (steps, 2, na·LANES)."""
    k, steps = len(commands), len(drive)
    history = np.empty((steps, 2, N_ACTUATORS))
    l = 0  # noqa: E741
    while l < k:
        followed_history(times, commands[l], before[l], valve[l], follow[l], first[l], start, dt, history, linear)
        # Lanes that follow with the same pressures get them at once, and lanes to spare those of the last.
        end = l + 1
        while end < k and same[end] and np.array_equal(first[end], first[end - 1]):
            end += 1
        last = end if end < k else LANES
        for s in range(steps):
            for part in range(2):
                for i in range(N_ACTUATORS):
                    value = history[s, part, i]
                    for m in range(i * LANES + l, i * LANES + last):
                        drive[s, part, m] = value
        l = end  # noqa: E741
