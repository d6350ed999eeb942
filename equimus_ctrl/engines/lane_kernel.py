"""The batch kernel: many parameter sets, side by side in lanes, through one trial.

A trial is what the sensors show (``measure``) of a motion on a fixed grid (``run_lanes``) under what arrives of the
commands (``lane_begin``), its hidden states being as the recorded motion before it left them (``lane_hidden``). Its
steps are in ``lane_steps``, the dry friction at their ends is in ``lane_dry_friction``. What the same equations of
motion say at many states that belong to no trial is told by ``field``, ``rubbing_field`` and ``limit_gaps``. Units are
those of ``lane_functions``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, SPED_UP, STOOD, earlier, hermite, inner, read, sample
from equimus_ctrl.engines.lane_begin import begin_trial, prepared, same_as_previous
from equimus_ctrl.engines.lane_dry_friction import correct_friction as correct_friction
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    N_LIMITS,
    N_ROWS,
    N_STATE,
    N_STATES,
    ROW_BOUND,
    ROW_DEPTHS,
    ROW_GAPS,
    ROW_PER_IMPULSE,
    ROW_PHI,
    ROW_PRESSED,
    ROW_PRESSURE,
    ROW_RATE,
    ROW_START,
    ROW_X,
    Layout,
    lane_depths,
    lane_friction,
    lane_motion,
)
from equimus_ctrl.engines.lane_hidden import hidden_starts as hidden_starts
from equimus_ctrl.engines.lane_hidden import put_hidden
from equimus_ctrl.engines.lane_steps import anything_pressed, grip_limits, lane_stops, press_as_asked, step
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def run_lanes(robot: Layout, w: Array, drive: Array, dt: float, rubbing: Array, out: Array) -> None:
    """Integrate all lanes over a grid.

    Args:
        robot: see ``lane_functions``.
        w: work array with state and constants.
        drive: (steps, 2, na·LANES) mean and slope of the pressures over each step [Pa].
        dt: [s].
        rubbing: rows where any lane has dry friction.
        out: (steps + 1, r·LANES) written: the first r rows of the state on the grid.
    """
    steps, x = len(drive), robot[ROW_X] * LANES
    press_as_asked(robot, w)
    for k in range(steps + 1):
        for i in range(out.shape[1]):
            out[k, i] = w[x + i]
        if k == steps:
            break
        step(robot, w, drive[k], dt)
        if len(rubbing) > 0:
            correct_friction(robot, w, dt, rubbing)


@njit(cache=True, nogil=True, error_model="numpy")
def measure(
    robot: Layout,
    grid: Array,
    start: float,
    dt: float,
    sensor: Array,
    moving: int,
    shown: Array,
    times: Array,
    out: Array,
    reached: Array,
) -> None:
    """What the sensors of k lanes say of motions on a grid.

    Args:
        robot: see ``lane_functions``.
        grid: (n, 2 nj·LANES) angles and velocities.
        start: of the grid [s].
        dt: of the grid [s].
        sensor: (k, nj, 4), see ``effects.sensors.OFFSET``.
        moving: how joints moved before the start, see ``STOOD``.
        shown: (nj,) what sensors showed at the start [rad or m]; nan where nobody knows.
        times: (m,) ascending [s].
        out: (k, m, nj) written: measured positions [rad or m].
        reached: (k,) written: m where all is well, else the index of the first sample that could not be had.
    """
    k, n = len(sensor), len(grid)
    q, v = np.empty(n), np.empty(n)
    reached[:] = len(times)
    for j in range(robot[N_JOINTS]):
        place, speeds = j * LANES, (robot[N_JOINTS] + j) * LANES
        together = True
        for l in range(k):  # noqa: E741
            equal = sensor[l, j, SENSOR_DELAY] == sensor[0, j, SENSOR_DELAY]
            together = together and sensor[l, j, PLAY] == 0.0 and equal
        if together:
            measure_together(robot, grid, j, start, dt, sensor, moving, times, out)
        for l in range(k):  # noqa: E741
            sound = 0
            while sound < n and abs(grid[sound, speeds + l]) < MAX_SPEED:
                sound += 1
            if not together:
                for s in range(n):
                    q[s], v[s] = grid[s, place + l], grid[s, speeds + l]
                before = v[0] if moving > STOOD else 0.0
                faster = (v[1] - v[0]) / dt if moving == SPED_UP else 0.0
                sample(q, v, start, dt, sensor[l, j], times, out[l, :, j], before, shown[j], faster)
            if sound < n:
                lost = start + (sound - 1) * dt + sensor[l, j, SENSOR_DELAY]
                reached[l] = min(reached[l], np.searchsorted(times, lost, side="right"))


@njit(cache=True, nogil=True, error_model="numpy")
def measure_together(
    robot: Layout, grid: Array, j: int, start: float, dt: float, sensor: Array, moving: int, times: Array, out: Array
) -> None:
    """What ``effects.sensors.sample`` says of a joint in all lanes at once, of sensors with one delay and no play."""
    k, n = len(sensor), len(grid)
    place, speeds, sensor_delay = j * LANES, (robot[N_JOINTS] + j) * LANES, sensor[0, j, SENSOR_DELAY]
    angles = np.empty(LANES)
    for i in range(len(times)):
        at = (times[i] - sensor_delay - start) / dt
        s = min(int(at), n - 2) if at > 0.0 else 0
        for l in range(LANES):  # noqa: E741
            q, v = grid[s, place + l], grid[s, speeds + l]
            if at > 0.0:
                angles[l] = hermite(q, v, grid[s + 1, place + l], grid[s + 1, speeds + l], dt, at - s)
            else:
                before = v if moving > STOOD else 0.0
                faster = (grid[1, speeds + l] - v) / dt if moving == SPED_UP else 0.0
                angles[l] = earlier(q, before, faster, at * dt)
        for l in range(k):  # noqa: E741
            out[l, i, j] = read(sensor[l, j], angles[l])


@njit(cache=True, nogil=True, error_model="numpy")
def measure_inner(robot: Layout, grid: Array, start: float, dt: float, times: Array, out: Array) -> None:
    """True positions and rates of k lanes at given times (m,), and states of laws where these are wanted too.

    They are written to out (k, m, 2 nj) or (k, m, 2 nj + nz); see ``measure``. States go along lines between steps.
    """
    n = len(grid)
    q, v = np.empty(n), np.empty(n)
    for l in range(len(out)):  # noqa: E741
        for j in range(robot[N_JOINTS]):
            for s in range(n):
                q[s], v[s] = grid[s, j * LANES + l], grid[s, (robot[N_JOINTS] + j) * LANES + l]
            inner(q, v, start, dt, times, out[l, :, j], out[l, :, robot[N_JOINTS] + j])
        for i in range(len(times)):
            place = max((times[i] - start) / dt, 0.0)
            s = min(int(place), n - 2)
            for z in range(2 * robot[N_JOINTS], out.shape[2]):
                begin, end = grid[s, z * LANES + l], grid[s + 1, z * LANES + l]
                out[l, i, z] = begin + (place - s) * (end - begin)


@njit(cache=True, nogil=True, error_model="numpy")
def run_trials(
    robot: Layout,
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    sensor: Array,
    q0: Array,
    v0: Array,
    rubbing: Array,
    moving: NDArray[np.int64],
    shown: Array,
    start: Array,
    dt: float,
    steps: Array,
    out_times: Array,
    place: Array,
    out: Array,
    reached: Array,
    linear: NDArray[np.bool_],
    motion: Array,
    hidden: Array,
) -> None:
    """Up to LANES parameter sets through trials of one history of commands: valves, motion and sensors.

    Args:
        robot: see ``lane_functions``.
        parameters: (k, np) parameter vectors, k ≤ LANES.
        times: (n,) from when each command holds [s].
        commands: (k, n, na) what reaches the valves [Pa or unit of the commands].
        before: (k, na) in force before.
        valve: (k, na, 6), see ``effects.command.DELAY``.
        follow: (k, na, 6), see ``effects.command.FOLLOW_KIND``.
        first: (trials, k, na) what integrators of commands begin with.
        sensor: (k, nj, 4), see ``effects.sensors.OFFSET``.
        q0: (trials, k, nj) positions at the starts [rad or m].
        v0: (trials, k, nj) velocities there [rad/s or m/s].
        rubbing: rows where any has dry friction.
        moving: (trials,) how joints moved before the starts, see ``STOOD``.
        shown: (trials, nj) what sensors showed at the starts [rad or m]; nan where nobody knows.
        start: (trials,) of the motion [s].
        dt: physics step [s].
        steps: (trials,) how many.
        out_times: (m,) of all trials, ascending in each [s].
        place: (trials + 1,) where in ``out_times`` each begins, and its end.
        out: (k, m, nj) written: measured positions [rad or m].
        reached: (trials, k) written: how many samples a trial has where all is well, else the index of the first that
            could not be had.
        linear: (na,) whether an actuator's commands go along a line from each instant to the next; else they are held.
        motion: (k, m, 2 nj) or (k, m, 2 nj + nz) written, see ``measure_inner``; with m = 0 they are not wanted.
        hidden: (trials, nz·LANES) states where trials start, see ``hidden_starts``; those that are nan, and all with no
            rows, start as if nothing had been before.
    """
    most = steps.max()
    w, same = prepared(robot, parameters), same_as_previous(commands, before, valve, follow)
    drive = np.empty((most, 2, robot[N_ACTUATORS] * LANES))
    grid = np.empty((most + 1, motion.shape[2] * LANES))
    for trial in range(len(start)):
        n, low, high = steps[trial], place[trial], place[trial + 1]
        sampled = out_times[low:high]
        own = drive[:n]
        at = start[trial]
        begin_trial(
            robot,
            w,
            own,
            times,
            commands,
            before,
            valve,
            follow,
            first[trial],
            q0[trial],
            v0[trial],
            at,
            dt,
            same,
            linear,
        )
        if len(hidden) > 0:
            put_hidden(robot, w, hidden[trial])
        run_lanes(robot, w, own, dt, rubbing, grid[: n + 1])
        own_out, own_reached = out[:, low:high], reached[trial]
        measure(robot, grid[: n + 1], at, dt, sensor, moving[trial], shown[trial], sampled, own_out, own_reached)
        if motion.shape[1] > 0:
            measure_inner(robot, grid[: n + 1], at, dt, sampled, motion[:, low:high])


@njit(cache=True, nogil=True, error_model="numpy")
def run_inner(
    robot: Layout,
    parameters: Array,
    times: Array,
    commands: Array,
    before: Array,
    valve: Array,
    follow: Array,
    first: Array,
    q0: Array,
    v0: Array,
    rubbing: Array,
    start: float,
    dt: float,
    states: Array,
    pressures: Array,
    linear: NDArray[np.bool_],
    hidden: Array,
) -> None:
    """One parameter set through one trial, with what no sensor shows.

    Args:
        robot: see ``lane_functions``.
        parameters: (1, np), as all arrays that are handed in those of ``run_trials`` for one set and trial.
        times: (n,) [s].
        commands: (1, n, na).
        before: (1, na).
        valve: (1, na, 6).
        follow: (1, na, 6).
        first: (1, na).
        q0: (1, nj).
        v0: (1, nj).
        rubbing: rows with dry friction.
        start: of the motion [s].
        dt: physics step [s].
        states: (steps + 1, 2 nj + nz) written: positions, velocities and effect states on the grid.
        pressures: (steps, 2, na) written: mean and slope over each step of what the forces are made of.
        linear: as there.
        hidden: as there.
    """
    w = prepared(robot, parameters)
    drive = np.empty((len(pressures), 2, robot[N_ACTUATORS] * LANES))
    same = same_as_previous(commands, before, valve, follow)
    begin_trial(robot, w, drive, times, commands, before, valve, follow, first, q0, v0, start, dt, same, linear)
    if len(hidden) > 0:
        put_hidden(robot, w, hidden[0])
    grid = np.empty((len(states), robot[N_STATE] * LANES))
    run_lanes(robot, w, drive, dt, rubbing, grid)
    for s in range(len(states)):
        for i in range(robot[N_STATE]):
            states[s, i] = grid[s, i * LANES]
    for s in range(len(pressures)):
        for i in range(robot[N_ACTUATORS]):
            pressures[s, 0, i] = drive[s, 0, i * LANES]
            pressures[s, 1, i] = drive[s, 1, i * LANES]


@njit(cache=True, nogil=True, error_model="numpy")
def put_states(
    robot: Layout, w: Array, begin: int, q: Array, v: Array, z: Array, pressure: Array, pressed: Array
) -> int:
    """Put some of many states into the lanes, with what their pressed limits do; lanes to spare repeat the last.

    Returns:
        How many states were put.
    """
    here = min(LANES, len(q) - begin)
    for l in range(LANES):  # noqa: E741
        k = begin + min(l, here - 1)
        for j in range(robot[N_JOINTS]):
            w[(robot[ROW_X] + j) * LANES + l] = q[k, j]
            w[(robot[ROW_X] + robot[N_JOINTS] + j) * LANES + l] = v[k, j]
            w[(robot[ROW_START] + j) * LANES + l] = q[k, j]
            w[(robot[ROW_START] + robot[N_JOINTS] + j) * LANES + l] = v[k, j]
        for i in range(robot[N_STATES]):
            w[(robot[ROW_X] + 2 * robot[N_JOINTS] + i) * LANES + l] = z[k, i]
        for i in range(robot[N_ACTUATORS]):
            w[(robot[ROW_PRESSURE] + i) * LANES + l] = pressure[k, i]
        for i in range(robot[N_LIMITS]):
            w[(robot[ROW_PRESSED] + i) * LANES + l] = pressed[k, i]
    grip_limits(robot, w, anything_pressed(robot, w))
    return here


@njit(cache=True, nogil=True, error_model="numpy")
def field(
    robot: Layout,
    parameters: Array,
    q: Array,
    v: Array,
    z: Array,
    pressure: Array,
    pressed: Array,
    side: Array,
    out: Array,
) -> None:
    """Accelerations and rates of the effects' states at many states.

    Args:
        robot: see ``lane_functions``.
        parameters: (np,).
        q: (n, nj).
        v: (n, nj).
        z: (n, nz).
        pressure: (n, na).
        pressed: (n, nl) 1 where a limit is pressed.
        side: (n, nr) the sign of each rubbing rate, against which dry friction acts in full; 0 for none.
        out: (n, nj + nz) written.
    """
    w = prepared(robot, parameters.reshape(1, -1))
    rubs = np.any(side != 0.0)
    for begin in range(0, len(q), LANES):
        here = put_states(robot, w, begin, q, v, z, pressure, pressed)
        if rubs:
            lane_friction(robot, w)
        for l in range(LANES):  # noqa: E741
            for r in range(robot[N_ROWS]):
                bound = w[(robot[ROW_BOUND] + r) * LANES + l] if rubs else 0.0
                w[(robot[ROW_PHI] + r) * LANES + l] = -side[begin + min(l, here - 1), r] * bound
        lane_motion(robot, w)
        for l in range(here):  # noqa: E741
            for i in range(robot[N_JOINTS] + robot[N_STATES]):
                out[begin + l, i] = w[(robot[ROW_RATE] + robot[N_JOINTS] + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def rubbing_field(
    robot: Layout, parameters: Array, q: Array, v: Array, z: Array, pressure: Array, pressed: Array, out: Array
) -> None:
    """What dry friction does at many states: M⁻¹Gᵀ column by column, GM⁻¹Gᵀ, the rates Gv and the greatest friction.

    Args:
        robot: see ``lane_functions``.
        parameters: (np,).
        q: as in ``field``, as what is not named here.
        v: as there.
        z: as there.
        pressure: as there.
        pressed: as there.
        out: (n, nj·nr + nr·nr + 2 nr) written.
    """
    w = prepared(robot, parameters.reshape(1, -1))
    for begin in range(0, len(q), LANES):
        here = put_states(robot, w, begin, q, v, z, pressure, pressed)
        lane_friction(robot, w)
        for l in range(here):  # noqa: E741
            for i in range(out.shape[1]):
                out[begin + l, i] = w[(robot[ROW_PER_IMPULSE] + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def limit_gaps(
    robot: Layout,
    parameters: Array,
    q: Array,
    v: Array,
    z: Array,
    pressure: Array,
    pressed: Array,
    depths: Array,
    out: Array,
) -> None:
    """How far many states are beyond each limit, and what is above 0 where it would be pressed.

    Args:
        robot: see ``lane_functions``.
        parameters: (np,).
        q: as in ``field``, as what is not named here.
        v: as there.
        z: as there.
        pressure: as there.
        pressed: as there.
        depths: (n, nl) written: below 0 short of a limit.
        out: (n, nl) written.
    """
    w = prepared(robot, parameters.reshape(1, -1))
    for begin in range(0, len(q), LANES):
        here = put_states(robot, w, begin, q, v, z, pressure, pressed)
        lane_depths(robot, w)
        lane_stops(robot, w)
        for l in range(here):  # noqa: E741
            for i in range(robot[N_LIMITS]):
                depths[begin + l, i] = w[(robot[ROW_DEPTHS] + i) * LANES + l]
                out[begin + l, i] = w[(robot[ROW_GAPS] + i) * LANES + l]
