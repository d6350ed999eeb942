"""Hidden states where a shooting interval begins inside a recording: those that the motion before it leads to.

What no sensor shows (how far a compliant drive is ahead of its joint, states of laws) hangs on the motion before. It
follows its own equations dz/dt = g(q, v, z, u) along the motion that was recorded, and under the commands that were, as
an input-driven observer does. One pass serves the intervals that are simulated together. It begins with the recording,
in long ones ``REMEMBERED`` to twice that before a start: these are passed through twice. What has arrived of the
commands is followed from the recording's start on. So that what an interval starts with depends on no other, a pass
stops on a grid alone. Units are those of ``lane_functions``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.following import CARRIED, STRIDE, first_carried
from equimus_ctrl.effects.sensors import OFFSET, SCALE, SENSOR_DELAY, hermite, hermite_rate
from equimus_ctrl.engines.lane_begin import clear, go_on_with_commands, prepared, same_as_previous
from equimus_ctrl.engines.lane_functions import (
    BOUNDED,
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    N_STATES,
    QUICK_INSIDE,
    ROW_FROM,
    ROW_PART,
    ROW_PRESSURE,
    ROW_RATE,
    ROW_START,
    ROW_SUM,
    ROW_X,
    Layout,
    fill_row,
    lane_keep,
    lane_rates,
    lane_start,
)
from equimus_ctrl.engines.lane_steps import MOST_PARTS, ROUNDING, limit_parts
from equimus_ctrl.engines.limits import REMEMBERED
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def alike(first: Array, second: Array) -> bool:
    """Whether two sensors (4,) show the same but for their play."""
    same: bool = (
        first[OFFSET] == second[OFFSET]
        and first[SCALE] == second[SCALE]
        and first[SENSOR_DELAY] == second[SENSOR_DELAY]
    )
    return same


@njit(cache=True, nogil=True, error_model="numpy")
def put_recorded(
    robot: Layout,
    w: Array,
    times: Array,
    motion: Array,
    sensor: Array,
    row: int,
    at: Array,
    bend: Array,
    bends: float,
    until: float,
) -> None:
    """Put all lanes' joints where they were recorded to be.

    Args:
        robot: see ``lane_functions``.
        w: work array.
        times: (n,) of the recorded motion [s].
        motion: (3, n, nj) positions, rates and accelerations then, as the sensors show them.
        sensor: (k, nj, 4), see ``effects.sensors.OFFSET``.
        row: of the motion, at or before the instants.
        at: (LANES,) instants, one a lane [s].
        bend: (2 nj·LANES) by how much an interval starts elsewhere than it was recorded.
        bends: how long before it the motion bends there [s]; 0 where it does not.
        until: when the interval starts [s].
    """
    k, last = len(sensor), len(times) - 2
    for j in range(robot[N_JOINTS]):
        q, v = 0.0, 0.0
        for l in range(LANES):  # noqa: E741
            own, before = min(l, k - 1), max(min(l, k - 1) - 1, 0)
            # What lanes have in common is worked out once.
            if l == 0 or at[l] != at[l - 1] or not alike(sensor[own, j], sensor[before, j]):
                t, i = at[l] + sensor[own, j, SENSOR_DELAY], row
                while i < last and times[i + 1] <= t:
                    i += 1
                s, h = t - times[i], times[i + 1] - times[i]
                a = motion[2, i, j]
                jerk = (motion[2, i + 1, j] - a) / h
                q = motion[0, i, j] + s * (motion[1, i, j] + s * (0.5 * a + s * jerk / 6.0))
                v = motion[1, i, j] + s * (a + s * 0.5 * jerk)
                q, v = (q - sensor[own, j, OFFSET]) / sensor[own, j, SCALE], v / sensor[own, j, SCALE]
            w[(robot[ROW_X] + j) * LANES + l], w[(robot[ROW_X] + robot[N_JOINTS] + j) * LANES + l] = q, v
    if bends == 0.0:
        return
    for l in range(LANES):  # noqa: E741
        share = 1.0 - (until - at[l]) / bends
        for j in range(robot[N_JOINTS] if share > 0.0 else 0):
            off, faster = bend[j * LANES + l], bend[(robot[N_JOINTS] + j) * LANES + l]
            w[(robot[ROW_X] + j) * LANES + l] += hermite(0.0, 0.0, off, faster, bends, share)
            w[(robot[ROW_X] + robot[N_JOINTS] + j) * LANES + l] += hermite_rate(0.0, 0.0, off, faster, bends, share)


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_part(
    robot: Layout,
    w: Array,
    drive: Array,
    begun: float,
    dt: float,
    times: Array,
    motion: Array,
    sensor: Array,
    row: int,
    bend: Array,
    bends: float,
    until: float,
) -> None:
    """One Runge–Kutta step of the hidden states over each lane's own part of a step that has begun; see ``advance``."""
    at = np.empty(LANES)
    below, part = 2 * robot[N_JOINTS], robot[ROW_PART]
    z, begun_with = robot[ROW_X] + below, robot[ROW_START] + below
    total, rates = robot[ROW_SUM] + below, robot[ROW_RATE] + below
    for i in range(robot[N_STATES] * LANES):
        w[begun_with * LANES + i] = w[z * LANES + i]
        w[total * LANES + i] = 0.0
    for stage in range(4):
        into = 0.0 if stage == 0 else 1.0 if stage == 3 else 0.5
        if stage != 2:  # both in the middle see the same motion and commands
            for l in range(LANES):  # noqa: E741
                share = w[robot[ROW_FROM] * LANES + l] + into * w[part * LANES + l]
                at[l] = begun + share * dt
                for i in range(robot[N_ACTUATORS]):
                    mean, slope = drive[0, i * LANES + l], drive[1, i * LANES + l]
                    w[(robot[ROW_PRESSURE] + i) * LANES + l] = mean + (share - 0.5) * slope
            put_recorded(robot, w, times, motion, sensor, row, at, bend, bends, until)
        lane_rates(robot, w)
        weight = 1.0 if stage == 0 or stage == 3 else 2.0
        h = 0.5 * dt if stage < 2 else dt
        for i in range(robot[N_STATES]):
            for l in range(LANES):  # noqa: E741
                rate = w[(rates + i) * LANES + l]
                w[(total + i) * LANES + l] += weight * rate
                w[(z + i) * LANES + l] = w[(begun_with + i) * LANES + l] + h * w[part * LANES + l] * rate
    for i in range(robot[N_STATES]):
        for l in range(LANES):  # noqa: E741
            change = dt / 6.0 * w[part * LANES + l] * w[(total + i) * LANES + l]
            w[(z + i) * LANES + l] = w[(begun_with + i) * LANES + l] + change


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_step(
    robot: Layout,
    w: Array,
    drive: Array,
    begun: float,
    dt: float,
    times: Array,
    motion: Array,
    sensor: Array,
    row: int,
    bend: Array,
    bends: float,
    until: float,
) -> None:
    """One step of the hidden states, in as short parts as their rates ask for; see ``lane_steps.step``."""
    fill_row(w, robot[ROW_FROM], 0.0)
    fill_row(w, robot[ROW_PART], 1.0)
    limited = robot[QUICK_INSIDE] and limit_parts(robot, w, dt)
    for part in range(MOST_PARTS):
        hidden_part(robot, w, drive, begun, dt, times, motion, sensor, row, bend, bends, until)
        if not limited:
            break
        left = 0.0
        for l in range(LANES):  # noqa: E741
            reached = w[robot[ROW_FROM] * LANES + l] + w[robot[ROW_PART] * LANES + l]
            w[robot[ROW_FROM] * LANES + l] = reached if reached < 1.0 - ROUNDING else 1.0
            left += 1.0 - w[robot[ROW_FROM] * LANES + l]
        if left == 0.0:
            break
        # The last part takes all that is left.
        limit_parts(robot, w, dt if part < MOST_PARTS - 2 else 0.0)
    if robot[BOUNDED]:
        lane_keep(robot, w)


@njit(cache=True, nogil=True, error_model="numpy")
def follow_recorded(
    robot: Layout,
    w: Array,
    drive: Array,
    begun: float,
    dt: float,
    times: Array,
    motion: Array,
    sensor: Array,
    row: int,
    bend: Array,
    bends: float,
    until: float,
) -> int:
    """Steps of the hidden states along the recorded motion; the row of the motion at or before their end.

    Args:
        robot: see ``lane_functions``.
        w: work array.
        drive: (steps, 2, na·LANES) mean and slope of the pressures over each step [Pa].
        begun: when they begin [s].
        dt: [s].
        times: as in ``put_recorded``, as what follows.
        motion: as there.
        sensor: as there.
        row: as there.
        bend: as there.
        bends: as there.
        until: as there.
    """
    for s in range(len(drive)):
        here = begun + s * dt
        while row < len(times) - 2 and times[row + 1] <= here:
            row += 1
        hidden_step(robot, w, drive[s], here, dt, times, motion, sensor, row, bend, bends, until)
    return row


@njit(cache=True, nogil=True, error_model="numpy")
def hidden_starts(
    robot: Layout,
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    sensor: Array,
    recorded_times: Array,
    recorded: Array,
    reading: float,
    q0: Array,
    v0: Array,
    start: Array,
    dt: float,
    linear: NDArray[np.bool_],
    out: Array,
) -> None:
    """The hidden states where trials of one recording start.

    Just before a start, over the time over which it is read off the recording, the recorded motion bends to where the
    trial starts: so what is hidden fits to that, and changes smoothly with it.

    Args:
        robot: see ``lane_functions``.
        parameters: (k, np) parameter vectors, k ≤ LANES.
        times: as in ``run_trials``, as what is not named here.
        commands: as there.
        before: as there.
        valve: as there.
        follow: as there.
        first: (k, na) what integrators of commands begin with at the recording's start.
        sensor: as there.
        recorded_times: (n,) of the recorded motion [s].
        recorded: (3, n, nj) positions, rates and accelerations then, as the sensors show them.
        reading: over how long a start is read off [s].
        q0: as there.
        v0: as there.
        start: as there.
        dt: as there.
        linear: as there.
        out: (trials, nz·LANES) written, of trials that start after the recording does.
    """
    k, begun, stride = len(sensor), times[0], STRIDE * dt
    size = STRIDE + math.ceil(min(reading, REMEMBERED / 2) / dt) + 1
    drive, history = np.empty((size, 2, robot[N_ACTUATORS] * LANES)), np.empty((size, 2, robot[N_ACTUATORS]))
    bend, kept, at = np.zeros(2 * robot[N_JOINTS] * LANES), np.empty(robot[N_STATES] * LANES), np.empty(LANES)
    w, similar = prepared(robot, parameters), same_as_previous(commands, before, valve, follow)
    columns = np.empty((k, robot[N_ACTUATORS], len(times)))
    early, carried = np.empty((k, robot[N_ACTUATORS], CARRIED)), np.empty((k, robot[N_ACTUATORS], CARRIED))
    for l in range(k):  # noqa: E741
        for i in range(robot[N_ACTUATORS]):
            columns[l, i] = commands[l, :, i]
            first_carried(before[l, i], follow[l, i], first[l, i], early[l, i])
            if l > 0 and first[l, i] != first[l - 1, i]:
                similar[l, i] = False
    period, place, early_place, row = -1, 0, 0, 0
    z = robot[ROW_X] + 2 * robot[N_JOINTS]
    for trial in np.argsort(start):
        until = start[trial]
        if not until > begun:
            continue
        bends = min(reading, until - begun, REMEMBERED / 2)
        own_period = max(int((until - begun) / REMEMBERED) - 1, 0)
        if own_period != period:
            period, place = own_period, int(own_period * REMEMBERED / stride)
            for passed in range(early_place, place):
                go_on_with_commands(
                    robot, drive[:STRIDE], times, columns, before, valve, follow, begun + passed * stride, dt,
                    similar, linear, early, history,
                )  # fmt: skip
            early_place = place
            carried[:] = early
            at[:] = begun + place * stride
            row = max(min(np.searchsorted(recorded_times, at[0], side="right") - 1, len(recorded_times) - 2), 0)
            clear(robot, w, at[0] - begun)
            put_recorded(robot, w, recorded_times, recorded, sensor, row, at, bend, 0.0, until)
            lane_start(robot, w)
        last = int((until - bends - begun) / stride)
        while place <= last:
            # Whole strides, which lead on to the next trial, too; then to this trial's start.
            leads_on, here = place < last, begun + place * stride
            steps = STRIDE if leads_on else min(max(math.ceil((until - here) / dt - 1e-9), 1), size)
            step = dt if leads_on else (until - here) / steps
            piece, going = drive[:steps], carried if leads_on else carried.copy()
            go_on_with_commands(
                robot, piece, times, columns, before, valve, follow, here, step, similar, linear, going, history
            )
            if leads_on:
                row = follow_recorded(
                    robot, w, piece, here, step, recorded_times, recorded, sensor, row, bend, 0.0, until
                )
                place += 1
                continue
            for i in range(robot[N_STATES] * LANES):
                kept[i] = w[z * LANES + i]
            at[:] = until
            put_recorded(robot, w, recorded_times, recorded, sensor, row, at, bend, 0.0, until)
            for l in range(LANES):  # noqa: E741
                own = min(l, k - 1)
                for j in range(robot[N_JOINTS]):
                    bend[j * LANES + l] = q0[trial, own, j] - w[(robot[ROW_X] + j) * LANES + l]
                    faster = v0[trial, own, j] - w[(robot[ROW_X] + robot[N_JOINTS] + j) * LANES + l]
                    bend[(robot[N_JOINTS] + j) * LANES + l] = faster
            follow_recorded(robot, w, piece, here, step, recorded_times, recorded, sensor, row, bend, bends, until)
            break
        for i in range(robot[N_STATES] * LANES):
            out[trial, i] = w[z * LANES + i]
            w[z * LANES + i] = kept[i]


@njit(cache=True, nogil=True, error_model="numpy")
def put_hidden(robot: Layout, w: Array, states: Array) -> None:
    """Put hidden states (nz·LANES) into the lanes, where they are numbers."""
    z = robot[ROW_X] + 2 * robot[N_JOINTS]
    for i in range(robot[N_STATES] * LANES):
        if not np.isnan(states[i]):
            w[z * LANES + i] = states[i]
