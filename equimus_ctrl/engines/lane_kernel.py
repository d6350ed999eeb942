"""The batch kernel: many parameter sets, side by side in lanes, through one trial.

The classical Runge–Kutta method of order four on a fixed grid. Dry friction is held over each step and corrected at its
end by the impulses that velocity-level Coulomb friction asks for: a box-constrained complementarity problem, solved by
projected Gauss–Seidel from the last step's friction. While something slides the held friction is exact and the method
keeps its order; where it sticks, velocities are zero to the solver's residual and angles do not drift. Where it turns
within a step, the correction counts from the instant of the turn, so that a turn costs an error of the step squared.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.effects.command import followed_history
from equimus_ctrl.effects.sensors import sample
from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ACTUATORS,
    N_JOINTS,
    N_LIMITS,
    N_ROWS,
    N_STATES,
    ROW_BOUND,
    ROW_DELASSUS,
    ROW_DEPTHS,
    ROW_GAPS,
    ROW_PHI,
    ROW_PRESSED,
    ROW_PRESSURE,
    ROW_PUSH,
    ROW_RATE,
    ROW_SLIP,
    ROW_SPAN,
    ROW_START,
    ROW_SUM,
    ROW_X,
    WORK_ROWS,
    lane_depths,
    lane_friction,
    lane_motion,
    lane_rest,
    prepare_lane,
)
from equimus_ctrl.engines.lane_steps import N_STATE, grip_limits, lane_stops, press_as_asked, step
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.types import Array

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
    follow: Array,
    first: Array,
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
        if l < k and not (l > 0 and _same(commands, before, valve, follow, first, l)):
            followed_history(times, commands[own], before[own], valve[own], follow[own], first[own], start, dt, history)
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
    follow: Array,
    first: Array,
    sensor: Array,
    q0: Array,
    v0: Array,
    rubbing: Array,
    moving: bool,
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
        follow: (k, na, 6), see ``effects.command.FOLLOW_KIND``.
        first: (k, na) what integrators of commands begin with.
        sensor: (k, nj, 4), see ``effects.sensors``.
        q0: (k, nj) angles at the start [rad].
        v0: (k, nj) velocities there [rad/s].
        rubbing: rows where any has dry friction.
        moving: whether joints moved before the start as they do there; else they stood still.
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
    begin_block(w, drive, parameters, times, commands, before, valve, follow, first, q0, v0, start, dt)
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
            sample(q, v, start, dt, sensor[l, j], out_times, y, v[0] if moving else 0.0)
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
    follow: Array,
    first: Array,
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
        follow: (1, na, 6).
        first: (1, na).
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
    begin_block(w, drive, parameters, times, commands, before, valve, follow, first, q0, v0, start, dt)
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
def _same(commands: Array, before: Array, valve: Array, follow: Array, first: Array, l: int) -> bool:  # noqa: E741
    """Whether a lane has the pressures of the one before it."""
    return bool(
        np.array_equal(valve[l], valve[l - 1])
        and np.array_equal(follow[l], follow[l - 1])
        and np.array_equal(first[l], first[l - 1])
        and np.array_equal(before[l], before[l - 1])
        and np.array_equal(commands[l], commands[l - 1])
    )


@njit(cache=True, nogil=True, error_model="numpy")
def lanes_of(parameters: Array) -> Array:
    """A work array with one parameter set (np,) in all lanes."""
    w = np.zeros(WORK_ROWS * LANES)
    for l in range(LANES):  # noqa: E741
        prepare_lane(parameters, w, l)
    return w


@njit(cache=True, nogil=True, error_model="numpy")
def put_states(w: Array, begin: int, q: Array, v: Array, z: Array, pressure: Array, pressed: Array) -> int:
    """Put some of many states into the lanes, with what their pressed limits do; lanes to spare repeat the last.

    Returns:
        How many states were put.
    """
    here = min(LANES, len(q) - begin)
    for l in range(LANES):  # noqa: E741
        k = begin + min(l, here - 1)
        for j in range(N_JOINTS):
            w[(ROW_X + j) * LANES + l] = q[k, j]
            w[(ROW_X + N_JOINTS + j) * LANES + l] = v[k, j]
            w[(ROW_START + N_JOINTS + j) * LANES + l] = v[k, j]
        for i in range(N_STATES):
            w[(ROW_X + 2 * N_JOINTS + i) * LANES + l] = z[k, i]
        for i in range(N_ACTUATORS):
            w[(ROW_PRESSURE + i) * LANES + l] = pressure[k, i]
        for i in range(N_LIMITS):
            w[(ROW_PRESSED + i) * LANES + l] = pressed[k, i]
    grip_limits(w)
    return here


@njit(cache=True, nogil=True, error_model="numpy")
def field(
    parameters: Array, q: Array, v: Array, z: Array, pressure: Array, pressed: Array, side: Array, out: Array
) -> None:
    """Accelerations and rates of the effects' states at many states.

    Args:
        parameters: (np,).
        q: (n, nj).
        v: (n, nj).
        z: (n, nz).
        pressure: (n, na).
        pressed: (n, nl) 1 where a limit is pressed.
        side: (n, nr) the sign of each rubbing rate, against which dry friction acts in full; 0 for none.
        out: (n, nj + nz) written.
    """
    w = lanes_of(parameters)
    rubs = np.any(side != 0.0)
    for begin in range(0, len(q), LANES):
        here = put_states(w, begin, q, v, z, pressure, pressed)
        if rubs:
            lane_friction(w)
        for l in range(LANES):  # noqa: E741
            for r in range(N_ROWS):
                bound = w[(ROW_BOUND + r) * LANES + l] if rubs else 0.0
                w[(ROW_PHI + r) * LANES + l] = -side[begin + min(l, here - 1), r] * bound
        lane_motion(w)
        for l in range(here):  # noqa: E741
            for i in range(N_JOINTS + N_STATES):
                out[begin + l, i] = w[(ROW_RATE + N_JOINTS + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def rubbing_field(parameters: Array, q: Array, v: Array, z: Array, pressure: Array, pressed: Array, out: Array) -> None:
    """What dry friction does at many states: M⁻¹Gᵀ column by column, GM⁻¹Gᵀ, the rates Gv and the greatest friction.

    Args:
        parameters: (np,).
        q: as in ``field``, as what is not named here.
        v: as there.
        z: as there.
        pressure: as there.
        pressed: as there.
        out: (n, nj·nr + nr·nr + 2 nr) written.
    """
    w = lanes_of(parameters)
    for begin in range(0, len(q), LANES):
        here = put_states(w, begin, q, v, z, pressure, pressed)
        lane_friction(w)
        for l in range(here):  # noqa: E741
            for i in range(out.shape[1]):
                out[begin + l, i] = w[(ROW_PUSH + i) * LANES + l]


@njit(cache=True, nogil=True, error_model="numpy")
def limit_gaps(
    parameters: Array, q: Array, v: Array, z: Array, pressure: Array, pressed: Array, depths: Array, out: Array
) -> None:
    """How far many states are beyond each limit, and what is above 0 where it would be pressed.

    Args:
        parameters: (np,).
        q: as in ``field``, as what is not named here.
        v: as there.
        z: as there.
        pressure: as there.
        pressed: as there.
        depths: (n, nl) written: below 0 short of a limit.
        out: (n, nl) written.
    """
    w = lanes_of(parameters)
    for begin in range(0, len(q), LANES):
        here = put_states(w, begin, q, v, z, pressure, pressed)
        lane_depths(w)
        lane_stops(w)
        for l in range(here):  # noqa: E741
            for i in range(N_LIMITS):
                depths[begin + l, i] = w[(ROW_DEPTHS + i) * LANES + l]
                out[begin + l, i] = w[(ROW_GAPS + i) * LANES + l]
