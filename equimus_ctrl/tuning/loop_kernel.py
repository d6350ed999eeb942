"""The closed-loop kernel: the PID on a perturbed leg with valves and a sensor, as one compiled function.

It is ``simulate.run`` with a ``MujocoPlant`` and a ``PidController``, on the exact reduced model; a test holds the two
together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.controllers.pid_kernel import blend, pid_command, pid_start
from equimus_ctrl.effects.command import advance_pressure
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
def run_loop(
    plant: Array,
    nominal: Array,
    valve: Array,
    gains: Array,
    lengths: bool,
    feedforward: bool,
    start_time: float,
    reference: Array,
    q0: Array,
    v0: Array,
    before: Array,
    low: Array,
    high: Array,
    control_dt: float,
    steps: int,
    noise: Array,
    out_q: Array,
    out_command: Array,
) -> int:
    """Track ``reference`` from rest.

    Args:
        plant: parameter vector of the leg that is simulated.
        nominal: parameter vector of the leg the controller computes with.
        valve: (na, 4), see ``effects.command.advance_pressure``.
        gains: (7, nz), see ``pid_start``.
        lengths: whether channels are actuator lengths, else joint angles.
        feedforward: whether the controller adds the static pressures.
        start_time: of the bumpless blend [s].
        reference: (n, nj) at each control instant [rad].
        q0: (nj,) pose at the start [rad].
        v0: (nj,) joint velocities there [rad/s].
        before: (na,) command in force before the start [Pa].
        low: (na,) lowest command [Pa].
        high: (na,) highest command [Pa].
        control_dt: control period, also the sensor's [s].
        steps: physics steps in each control period.
        noise: (n, nj) added to each measurement [rad].
        out_q: (n, nj) written: true angles at each control instant [rad].
        out_command: (n, na) written: command from each control instant on [Pa].

    Returns:
        n where all is well, else the control step in which the simulation diverged.
    """
    n = len(reference)
    c = prepare(plant)
    c_nominal = prepare(nominal)
    area = actuator_areas(c)
    dt = control_dt / steps
    still = np.empty(N_JOINTS)
    for j in range(N_JOINTS):
        still[j] = 0.0
    q = joint_tuple(q0)
    v = joint_tuple(v0)
    tau = joint_tuple(still)
    pressure = np.empty(N_ACTUATORS)
    force = np.empty(N_ACTUATORS)
    cursor = np.empty(N_ACTUATORS, dtype=np.int64)
    for i in range(N_ACTUATORS):
        pressure[i] = before[i]
        cursor[i] = -1
    times = np.empty(n)
    state = np.empty((3, gains.shape[1]))
    y = np.empty(N_JOINTS)
    r = np.empty(N_JOINTS)
    offset = np.empty(N_JOINTS)
    for k in range(n):
        now = k * control_dt
        for j in range(N_JOINTS):
            out_q[k, j] = q[j]
            y[j] = q[j] + noise[k, j]
        if k == 0:
            pid_start(y, before, gains, lengths, feedforward, c_nominal, state)
            for j in range(N_JOINTS):
                offset[j] = y[j] - reference[0, j]
        weight = blend(now, start_time)
        for j in range(N_JOINTS):
            r[j] = reference[k, j] + weight * offset[j]
        pid_command(r, y, gains, lengths, feedforward, low, high, control_dt, c_nominal, state, out_command[k])
        times[k] = now
        for s in range(steps):
            t = now + s * dt
            for i in range(N_ACTUATORS):
                pressure[i], mean, _, cursor[i] = advance_pressure(
                    times[: k + 1], out_command[: k + 1, i], before[i], cursor[i], t, dt, pressure[i], valve[i]
                )
                force[i] = area[i] * mean
            q, v = rk4(q, v, actuator_tuple(force), tau, dt, c)
            for j in range(N_JOINTS):
                if not abs(v[j]) < MAX_SPEED:
                    return k
    return n
