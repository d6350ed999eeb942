"""The open-loop kernel: one recorded command history through one parameter set."""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.effects.command import lag, mean_command
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.model_functions import (
    N_ACTUATORS,
    N_JOINTS,
    actuator_areas,
    actuator_tuple,
    joint_tuple,
    prepare,
    rk4,
)
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def hermite(x0: float, v0: float, x1: float, v1: float, dt: float, share: float) -> float:
    """Cubic through both ends and their slopes, at a share of the step."""
    s2 = share * share
    s3 = s2 * share
    return (
        (2.0 * s3 - 3.0 * s2 + 1.0) * x0
        + (s3 - 2.0 * s2 + share) * dt * v0
        + (3.0 * s2 - 2.0 * s3) * x1
        + (s3 - s2) * dt * v1
    )


@njit(cache=True, nogil=True, error_model="numpy")
def run_trial(
    p: Array,
    valve: Array,
    times: Array,
    commands: Array,
    before: Array,
    q0: Array,
    v0: Array,
    dt: float,
    out_times: Array,
    out_q: Array,
) -> int:
    """Integrate one trial from times[0] on and sample the joint angles at ``out_times``.

    Args:
        p: parameter vector.
        valve: (na, 3) transport delay, filling and venting time constants [s].
        times: (n,) from when each command holds [s].
        commands: (n, na) [Pa].
        before: (na,) command in force before, long enough for the pressure to have settled [Pa].
        q0: (nj,) first angles [rad].
        v0: (nj,) first velocities [rad/s].
        dt: physics step [s].
        out_times: (m,) ascending, none before times[0] [s].
        out_q: (m, nj) written [rad].

    Returns:
        m where all is well, else the index of the first sample that could not be had (divergence).
    """
    c = prepare(p)
    area = actuator_areas(c)
    q = joint_tuple(q0)
    v = joint_tuple(v0)
    tau = joint_tuple(np.zeros(N_JOINTS))
    pressure = before.copy()
    force = np.zeros(N_ACTUATORS)
    cursor = np.full(N_ACTUATORS, -1)
    start = times[0]
    k, m = 0, len(out_times)
    step = 0
    while k < m:
        t = start + step * dt
        for i in range(N_ACTUATORS):
            a = t - valve[i, 0]
            target, cursor[i] = mean_command(times, commands[:, i], before[i], cursor[i], a, a + dt)
            pressure[i], mean = lag(pressure[i], target, valve[i, 1], valve[i, 2], dt)
            force[i] = area[i] * mean
        f = actuator_tuple(force)
        q_next, v_next = rk4(q, v, f, tau, dt, c)
        for j in range(N_JOINTS):
            if not abs(v_next[j]) < MAX_SPEED:
                return k
        while k < m and out_times[k] <= t + dt:
            share = (out_times[k] - t) / dt
            for j in range(N_JOINTS):
                out_q[k, j] = hermite(q[j], v[j], q_next[j], v_next[j], dt, share)
            k += 1
        q, v = q_next, v_next
        step += 1
    return k
