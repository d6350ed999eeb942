"""The closed-loop kernel: the PID on robots with all their effects, up to LANES of them side by side.

It is ``loop.run`` with a ``MujocoPlant`` and a ``PidController``, on the exact reduced model; a test holds the two
together. As in the plant, pressures are held at their mean over a step, and what joint stops exert follows the state
within it. What a lane does depends on no other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.controllers.pid_kernel import blend, pid_command, pid_start, static_feed
from equimus_ctrl.effects.command import advance_pressure
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, follow, read, recall
from equimus_ctrl.effects.shaping import shape_command
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ROWS,
    N_STATE,
    ROW_FROM,
    ROW_PART,
    ROW_PRESSURE,
    ROW_START,
    ROW_X,
    WORK_ROWS,
    Layout,
    copy_rows,
    fill_row,
    lane_start,
    prepare_lane,
)
from equimus_ctrl.engines.lane_kernel import correct_friction
from equimus_ctrl.engines.lane_steps import advance
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.model_functions import N_ACTUATORS, N_JOINTS
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def start_lanes(robot: Layout, parameters: Array, q0: Array, pressure: Array) -> Array:
    """The work array of robots that have long been at rest; lanes without a robot of their own repeat the last.

    Args:
        robot: see ``lane_functions``.
        parameters: (k, np) parameter vectors of structure and laws, k ≤ LANES.
        q0: (k, nj) poses [rad].
        pressure: (na,) [Pa].
    """
    w = np.zeros(robot[WORK_ROWS] * LANES)
    for l in range(LANES):  # noqa: E741
        own = min(l, len(parameters) - 1)
        prepare_lane(robot, parameters[own], w, l)
        for j in range(N_JOINTS):
            w[(robot[ROW_X] + j) * LANES + l] = q0[own, j]
        for i in range(N_ACTUATORS):
            w[(robot[ROW_PRESSURE] + i) * LANES + l] = pressure[i]
    lane_start(robot, w)
    return w


@njit(cache=True, nogil=True, error_model="numpy")
def step_lanes(robot: Layout, w: Array, drive: Array, dt: float, rubbing: Array) -> None:
    """One Runge–Kutta step of all lanes.

    Args:
        robot: see ``lane_functions``.
        w: work array.
        drive: (2, na·LANES) mean and slope of the pressures over the step [Pa].
        dt: [s].
        rubbing: rows where any lane has dry friction.
    """
    copy_rows(w, robot[ROW_X], robot[ROW_START], robot[N_STATE])
    fill_row(w, robot[ROW_FROM], 0.0)
    fill_row(w, robot[ROW_PART], 1.0)
    advance(robot, w, drive, dt, False, True)
    if robot[N_ROWS] > 0 and len(rubbing) > 0:
        correct_friction(robot, w, dt, rubbing)


@njit(cache=True, nogil=True, error_model="numpy")
def run_loop(
    robot: Layout,
    first: int,
    last: int,
    w: Array,
    nominal: Array,
    valve: Array,
    sensor: Array,
    shaping: Array,
    gains: Array,
    lengths: bool,
    feedforward: bool,
    start_time: float,
    late_start: float,
    times: Array,
    reference: Array,
    shown: Array,
    late: Array,
    planned: Array,
    surplus: Array,
    noise: Array,
    command_before: Array,
    reached_before: Array,
    low: Array,
    high: Array,
    control_dt: float,
    steps: int,
    rubbing: Array,
    pressure: Array,
    cursor: Array,
    memory: Array,
    offset: Array,
    past: Array,
    held: Array,
    out_q: Array,
    out_command: Array,
    reaches: Array,
    sound: Array,
) -> None:
    """Take k robots from control instant ``first`` to just before ``last``, without the motion after each instant.

    Called with 0 and n + 1 it tracks the whole reference from rest. Called one instant at a time, it lets the caller
    say in between what of the newest command reaches the valves.

    Args:
        robot: see ``lane_functions``.
        first: control instant to begin with.
        last: where to stop, at most n + 1; instant n only ends the motion.
        w: work array, see ``start_lanes``.
        nominal: constants of the robot that the controller computes with, see ``compiled.prepared``.
        valve: (k, na, 6), see ``effects.command.advance_pressure``.
        sensor: (k, nj, 4), see ``effects.sensors``.
        shaping: (m, 3), see ``effects.shaping.shape_command``.
        gains: (k, 7, nz), see ``pid_start``.
        lengths: whether channels are actuator lengths, else joint angles.
        feedforward: whether the controller adds the static pressures, where nothing is planned.
        start_time: of the bumpless blend [s].
        late_start: of that in the later reference [s].
        times: (n,) control instants [s].
        reference: (n, nj) at each of them [rad].
        shown: (k, n, nj) what the sensors show of it and (k, n, na) what is fed forward where that is planned, see
            ``controllers.inverse`` [rad, Pa]; n is 0 where it is not.
        late: (k, n, nj) as ``shown`` of a robot that is late [rad].
        planned: see ``shown``.
        surplus: (k, na) see ``pid_start``, where it is planned [Pa].
        noise: (n, nj) added to each measurement [rad].
        command_before: (na,) in force before the start [Pa].
        reached_before: (na,) what of it reached the valves [Pa].
        low: (na,) lowest command [Pa].
        high: (na,) highest command [Pa].
        control_dt: control period, also the sensor's [s].
        steps: physics steps in each control period.
        rubbing: rows where any robot has dry friction.
        pressure: (k, na) kept: behind the valves [Pa].
        cursor: (k, na) kept: see ``effects.command.advance_pressure``.
        memory: (k, 3, nz) kept: the controllers' state.
        offset: (k, nj) kept: first measured pose minus first reference [rad].
        past: (k, nj, b, 2) kept: see ``effects.sensors.recall``; b = 1 where no sensor remembers.
        held: (k, nj) kept: what sensors with play show [rad].
        out_q: (k, n, nj) written: true angles at each control instant [rad].
        out_command: (k, n, na) written: command from each control instant on [Pa].
        reaches: (k, na, n) written: what of it reaches the valves [Pa].
        sound: (k,) kept: n where all is well, else the control step in which the simulation diverged.
    """
    k, n, back = len(valve), len(times), past.shape[2]
    dt = control_dt / steps
    y, r, behind = np.empty(N_JOINTS), np.empty(N_JOINTS), np.empty(N_JOINTS)
    fed = np.empty(N_ACTUATORS)
    arriving, drive = np.empty(N_ACTUATORS), np.zeros((2, N_ACTUATORS * LANES))
    drive[0] = w[robot[ROW_PRESSURE] * LANES : (robot[ROW_PRESSURE] + N_ACTUATORS) * LANES]
    for now in range(first, last):
        for s in range(steps if now > 0 else 0):
            at = times[now - 1] + s * dt
            for l in range(k):  # noqa: E741
                for i in range(N_ACTUATORS):
                    pressure[l, i], mean, _, cursor[l, i] = advance_pressure(
                        times[:now], reaches[l, i, :now], reached_before[i], cursor[l, i], at, dt, pressure[l, i],
                        valve[l, i],
                    )  # fmt: skip
                    drive[0, i * LANES + l] = mean
            step_lanes(robot, w, drive, dt, rubbing)
            newest = (now - 1) * steps + s + 1
            for l in range(k):  # noqa: E741
                for j in range(N_JOINTS):
                    q, v = w[(robot[ROW_X] + j) * LANES + l], w[(robot[ROW_X] + N_JOINTS + j) * LANES + l]
                    if not abs(v) < MAX_SPEED:
                        sound[l] = min(sound[l], now - 1)
                    if back > 1:
                        past[l, j, newest % back, 0], past[l, j, newest % back, 1] = q, v
                        seen = recall(past[l, j], newest, sensor[l, j, SENSOR_DELAY] / dt, dt)
                        held[l, j] = follow(held[l, j], seen, sensor[l, j, PLAY])
        if now == n:
            break
        weight, later = blend(times[now], start_time), blend(times[now], late_start)
        running = 0
        for l in range(k):  # noqa: E741
            if sound[l] < n:
                continue
            running += 1
            for j in range(N_JOINTS):
                q = w[(robot[ROW_X] + j) * LANES + l]
                out_q[l, now, j] = q
                if sensor[l, j, PLAY] > 0.0:
                    q = held[l, j]
                elif sensor[l, j, SENSOR_DELAY] > 0.0:
                    q = recall(past[l, j], now * steps, sensor[l, j, SENSOR_DELAY] / dt, dt)
                y[j] = read(sensor[l, j], q) + noise[now, j]
            if planned.shape[1] > 0:
                if now == 0:
                    pid_start(y, surplus[l], gains[l], lengths, nominal, memory[l])
                for j in range(N_JOINTS):
                    r[j], behind[j] = shown[l, now, j], late[l, now, j]
                for i in range(N_ACTUATORS):
                    fed[i] = planned[l, now, i]
            else:
                if now == 0:
                    static_feed(y, feedforward, nominal, fed)
                    for i in range(N_ACTUATORS):
                        fed[i] = command_before[i] - fed[i]
                    pid_start(y, fed, gains[l], lengths, nominal, memory[l])
                    for j in range(N_JOINTS):
                        offset[l, j] = y[j] - reference[0, j]
                for j in range(N_JOINTS):
                    r[j] = reference[now, j] + weight * offset[l, j]
                    behind[j] = reference[now, j] + later * offset[l, j]
                static_feed(r, feedforward, nominal, fed)
            pid_command(
                r, behind, y, fed, gains[l], lengths, low, high, control_dt, nominal, memory[l], out_command[l, now]
            )  # fmt: skip
            shape_command(shaping, out_command[l, now], arriving)
            for i in range(N_ACTUATORS):
                reaches[l, i, now] = arriving[i]
        if running == 0:
            break
