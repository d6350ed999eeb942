"""The PID law, compiled for a robot structure; the controller and the tuner both call it.

Channels are actuator lengths or joint angles. With z the channel coordinate of a pose, r the (blended) reference
pose, l the same of a robot whose commands act as late as may be, y the measured one:

    x = z(y), no less than the lesser of z(r) and z(l) and no more than the greater
    D ← D + dt/(T_f + dt)·(Δ(c x − z(y))/dt − D)
    w = k_p (b x − z(y)) + I
    P = clip(P_fed + map(w + k_d D))
    S = clip(P_fed + map(w)) − (P_fed + map(w))
    I ← I + dt k_i (x − z(y)) + (dt/T_t) unmap(S)     where k_i > 0

By how much a robot is behind r at a start because its commands act later than is known is no error of the model's, and
feedback that answers it drives the robot past where it is to be; nor is it to pull back a robot that is on time. So
errors count from the nearer of r and l, and between them there is none (a dead zone). Once the start is over l is r.
P_fed are not held back.

S is by how much a limit cuts the command off. The derivative has no part in it: it passes the measurements' noise on,
of which a limit cuts off one side, and the integral would gather the mean of that.

map turns a channel's effort into pressures: force/area for a length, the least-norm pressures of the joint torques for
angles. P_fed are the static pressures of the reference, or come from ``controllers.inverse``. Two-degree-of-freedom
form, derivative filter and back-calculation follow Åström & Hägglund, "Advanced PID Control" (2006).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.engines.model_functions import (
    N_ACTUATORS,
    N_JOINTS,
    actuator_areas,
    actuator_lengths,
    actuator_tuple,
    joint_tuple,
    pressure_torque,
    static_pressure,
    torque_pressure,
)
from equimus_ctrl.types import Array

INTEGRAL, DERIVATIVE, PREVIOUS = 0, 1, 2
KP, KI, KD, FILTER, TRACKING, WEIGHT_P, WEIGHT_D = 0, 1, 2, 3, 4, 5, 6


@njit(cache=True, nogil=True, error_model="numpy")
def blend(elapsed: float, duration: float) -> float:
    """Weight of the first measured pose in the reference: 1 at the start, 0 after ``duration`` (minimum jerk)."""
    if elapsed >= duration:
        return 0.0
    s = elapsed / duration
    return 1.0 - s * s * s * (10.0 + s * (6.0 * s - 15.0))


@njit(cache=True, nogil=True, error_model="numpy")
def channel_values(q: Array, lengths: bool, c: Array, z: Array) -> None:
    """Write the channel coordinates of pose q: actuator lengths [m] or the joint angles themselves [rad]."""
    if lengths:
        values = actuator_lengths(joint_tuple(q), c)
        for i in range(N_ACTUATORS):
            z[i] = values[i]
    else:
        for i in range(N_JOINTS):
            z[i] = q[i]


@njit(cache=True, nogil=True, error_model="numpy")
def efforts_to_pressures(w: Array, q: Array, lengths: bool, c: Array, out: Array) -> None:
    """Write map(w) [Pa]: w are forces [N] along the actuators or joint torques [N·m] at pose q."""
    if lengths:
        area = actuator_areas(c)
        for i in range(N_ACTUATORS):
            out[i] = w[i] / area[i]
    else:
        values = torque_pressure(joint_tuple(q), joint_tuple(w), c)
        for i in range(N_ACTUATORS):
            out[i] = values[i]


@njit(cache=True, nogil=True, error_model="numpy")
def pressures_to_efforts(pressure: Array, q: Array, lengths: bool, c: Array, out: Array) -> None:
    """Write unmap(P): forces [N] along the actuators or joint torques [N·m] at pose q."""
    if lengths:
        area = actuator_areas(c)
        for i in range(N_ACTUATORS):
            out[i] = pressure[i] * area[i]
    else:
        values = pressure_torque(joint_tuple(q), actuator_tuple(pressure), c)
        for i in range(N_JOINTS):
            out[i] = values[i]


@njit(cache=True, nogil=True, error_model="numpy")
def static_feed(q: Array, feedforward: bool, c: Array, out: Array) -> None:
    """Write the pressures that hold pose q at rest (na,) [Pa]; none where there is no feed-forward."""
    values = static_pressure(joint_tuple(q), c)
    for i in range(N_ACTUATORS):
        out[i] = values[i] if feedforward else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def pid_start(y: Array, surplus: Array, gains: Array, lengths: bool, c: Array, state: Array) -> None:
    """Write the state from which the first command equals the one in force (bumpless start).

    Args:
        y: (nj,) first measured angles [rad].
        surplus: (na,) of the pressures in force over those fed forward [Pa].
        gains: (7, nz) rows k_p, k_i, k_d, T_f, T_t, b, c.
        lengths: whether channels are actuator lengths.
        c: the nominal model's constants.
        state: (3, nz) rows integral, derivative, previous c x − z(y).
    """
    nz = state.shape[1]
    z = np.empty(nz)
    effort = np.empty(nz)
    channel_values(y, lengths, c, z)
    pressures_to_efforts(surplus, y, lengths, c, effort)
    for i in range(nz):
        state[INTEGRAL, i] = effort[i] - gains[KP, i] * (gains[WEIGHT_P, i] - 1.0) * z[i]
        state[DERIVATIVE, i] = 0.0
        state[PREVIOUS, i] = (gains[WEIGHT_D, i] - 1.0) * z[i]


@njit(cache=True, nogil=True, error_model="numpy")
def pid_command(
    r: Array,
    late: Array,
    y: Array,
    fed: Array,
    gains: Array,
    lengths: bool,
    low: Array,
    high: Array,
    dt: float,
    c: Array,
    state: Array,
    command: Array,
) -> None:
    """One control step: write the next command (na,) [Pa] and advance ``state`` (see ``pid_start``).

    Args:
        r: (nj,) reference of what is measured [rad].
        late: (nj,) l, the same of a robot whose commands act as late as may be [rad].
        y: (nj,) measured angles [rad].
        fed: (na,) fed forward [Pa].
        gains: see ``pid_start``.
        lengths: whether channels are actuator lengths.
        low: (na,) lowest command [Pa].
        high: (na,) highest command [Pa].
        dt: control period [s].
        c: the nominal model's constants.
        state: advanced.
        command: (na,) written [Pa].
    """
    nz = state.shape[1]
    x, zl, zy, w, full = np.empty(nz), np.empty(nz), np.empty(nz), np.empty(nz), np.empty(nz)
    asked, steady = np.empty(N_ACTUATORS), np.empty(N_ACTUATORS)
    channel_values(r, lengths, c, x)
    channel_values(late, lengths, c, zl)
    channel_values(y, lengths, c, zy)
    for i in range(nz):
        x[i] = min(max(zy[i], min(x[i], zl[i])), max(x[i], zl[i]))
        weighted = gains[WEIGHT_D, i] * x[i] - zy[i]
        slope = (weighted - state[PREVIOUS, i]) / dt
        state[PREVIOUS, i] = weighted
        state[DERIVATIVE, i] += dt / (gains[FILTER, i] + dt) * (slope - state[DERIVATIVE, i])
        w[i] = gains[KP, i] * (gains[WEIGHT_P, i] * x[i] - zy[i]) + state[INTEGRAL, i]
        full[i] = w[i] + gains[KD, i] * state[DERIVATIVE, i]
    efforts_to_pressures(full, y, lengths, c, asked)
    efforts_to_pressures(w, y, lengths, c, steady)
    for i in range(N_ACTUATORS):
        command[i] = min(max(fed[i] + asked[i], low[i]), high[i])
        wanted = fed[i] + steady[i]
        steady[i] = min(max(wanted, low[i]), high[i]) - wanted
    pressures_to_efforts(steady, y, lengths, c, w)
    for i in range(nz):
        share = min(dt / gains[TRACKING, i], 1.0) if gains[TRACKING, i] > 0.0 else 1.0
        if gains[KI, i] > 0.0:
            state[INTEGRAL, i] += dt * gains[KI, i] * (x[i] - zy[i]) + share * w[i]
