"""Where the batch kernel begins: constants of parameter sets, the state at a start, and what arrives of the commands.

Units are those of ``lane_functions``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.following import go_on, own_followed_history
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    ROW_CONSTANTS,
    ROW_TIME,
    ROW_X,
    WORK_ROWS,
    Layout,
    lane_start,
    prepare_lane,
)
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def prepared(robot: Layout, parameters: Array) -> Array:
    """A work array with the constants of up to LANES parameter sets (k, np); lanes to spare repeat the last."""
    w = np.zeros(robot[WORK_ROWS] * LANES)
    for l in range(LANES):  # noqa: E741
        prepare_lane(robot, parameters[min(l, len(parameters) - 1)], w, l)
    return w


@njit(cache=True, nogil=True, error_model="numpy")
def same_as_previous(commands: Array, before: Array, valve: Array, follow: Array) -> NDArray[np.bool_]:
    """(k, na) whether what reaches a lane's valve, and what it makes of it, is as in the lane before it."""
    same = np.zeros(before.shape, dtype=np.bool_)
    for l in range(1, len(commands)):  # noqa: E741
        for i in range(before.shape[1]):
            same[l, i] = (
                before[l, i] == before[l - 1, i]
                and np.array_equal(valve[l, i], valve[l - 1, i])
                and np.array_equal(follow[l, i], follow[l - 1, i])
                and np.array_equal(commands[l, :, i], commands[l - 1, :, i])
            )
    return same


@njit(cache=True, nogil=True, error_model="numpy")
def clear(robot: Layout, w: Array, time: float) -> None:
    """Clear all of the work array but the constants, a time after the recording began [s]."""
    for i in range(robot[ROW_CONSTANTS] * LANES):
        w[i] = 0.0
    for l in range(LANES):  # noqa: E741
        w[robot[ROW_TIME] * LANES + l] = time


@njit(cache=True, nogil=True, error_model="numpy")
def begin_trial(
    robot: Layout,
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
    clear(robot, w, start - times[0])
    for l in range(LANES):  # noqa: E741
        own = min(l, k - 1)
        for j in range(robot[N_JOINTS]):
            w[(robot[ROW_X] + j) * LANES + l] = q0[own, j]
            w[(robot[ROW_X] + robot[N_JOINTS] + j) * LANES + l] = v0[own, j]
    lane_start(robot, w)
    put_commands(robot, drive, times, commands, before, valve, follow, first, start, dt, same, linear)


@njit(cache=True, nogil=True, error_model="numpy")
def put_commands(
    robot: Layout,
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
    """What arrives of the commands over the steps from a start on, into drive (steps, 2, na·LANES).

    What an actuator of several lanes in a row follows in the same way is worked out once; lanes to spare have what the
    last has. The other arguments are those of ``begin_trial``.
    """
    k, steps = len(commands), len(drive)
    own = np.zeros((robot[N_ACTUATORS], LANES), dtype=np.int64)  # which of the different histories is a lane's
    for i in range(robot[N_ACTUATORS]):
        for l in range(1, LANES):  # noqa: E741
            other = l < k and not (same[l, i] and first[l, i] == first[l - 1, i])
            own[i, l] = own[i, l - 1] + (1 if other else 0)
    histories = np.empty((own.max() + 1 if own.size else 0, steps, 2, robot[N_ACTUATORS]))
    for i in range(robot[N_ACTUATORS]):
        for l in range(k):  # noqa: E741
            if l == 0 or own[i, l] > own[i, l - 1]:
                own_followed_history(
                    times, commands[l], before[l], valve[l], follow[l], first[l], start, dt, i, histories[own[i, l]],
                    linear,
                )  # fmt: skip
        for s in range(steps):
            for part in range(2):
                for l in range(LANES):  # noqa: E741
                    drive[s, part, i * LANES + l] = histories[own[i, l], s, part, i]


@njit(cache=True, nogil=True, error_model="numpy")
def go_on_with_commands(
    robot: Layout,
    drive: Array,
    times: Array,
    columns: Array,
    before: Array,
    valve: Array,
    follow: Array,
    start: float,
    dt: float,
    alike: NDArray[np.bool_],
    linear: NDArray[np.bool_],
    carried: Array,
    history: Array,
) -> None:
    """``put_commands`` piece by piece, see ``effects.command.go_on``.

    Args:
        robot: see ``lane_functions``.
        drive: (steps, 2, na·LANES) written, as there.
        times: as there, as what is not named here.
        columns: (k, na, n) commands.
        before: as there.
        valve: as there.
        follow: as there.
        start: of the piece [s].
        dt: as there.
        alike: (k, na) whether all of a lane's is as in the lane before it.
        linear: as there.
        carried: (k, na, ``CARRIED``) replaced; of lanes that are alike the first counts.
        history: (≥ steps, 2, na) room.
    """
    k, steps = len(columns), len(drive)
    for i in range(robot[N_ACTUATORS]):
        lane = 0
        while lane < k:
            go_on(
                times, columns[lane, i], before[lane, i], valve[lane, i], follow[lane, i], start, dt, i, linear[i],
                carried[lane, i], history[:steps],
            )  # fmt: skip
            end = lane + 1
            while end < k and alike[end, i]:
                end += 1
            last = end if end < k else LANES  # lanes to spare have what the last has
            for s in range(steps):
                for part in range(2):
                    for l in range(lane, last):  # noqa: E741
                        drive[s, part, i * LANES + l] = history[s, part, i]
            lane = end
