"""The law by which an MJCF robot's joints track references, and what is fed forward, of the nominal robot in MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from equimus_ctrl.engines.mjcf_realised import Realised, realise
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, FeedbackLaw

FEWEST = 2.0
"""Samples in the time constant of the filter of the error's rate."""
SINGULAR = 1e-6
"""Of torques by commands, the share of the largest below which a joint has no drive."""
NUDGE = 1e-5
"""By which coordinates and rates are moved to see what that changes [rad or m, rad/s or m/s]."""
NEWTON, LARGEST_STEP = 20, 0.2
"""Steps in which a balance is found, and their largest size [rad or m]."""


def law_at(model: Model, pose: Array, frequency: float, period: float) -> FeedbackLaw:
    """The law with which joints go back to their reference.

    With ω = 2πf, the joint-space inertia M and the torques by commands G of the model in a pose, joints that all have a
    drive go back like critically damped second-order systems, K = G⁺ M ω², D = 2 G⁺ M ω. Where there are fewer drives
    than joints, K and D are those of the linear-quadratic regulator of the sampled robot about the pose that minimises
    Σ ‖e‖² + ‖M⁻¹ G u‖²/ω⁴, which with all drives gives natural frequencies of f as well (Anderson & Moore, *Optimal
    Control*, 1990). The error's rate is filtered over two samples or more, and over an eighth of 1/ω at least.

    Args:
        model: the nominal one.
        pose: (nj,) [rad or m].
        frequency: f [Hz].
        period: between commands [s].

    Raises:
        ConfigError: where a drive is a servo, which tracks by itself, there is none, or no regulator holds the pose.
    """
    robot = mjcf_of(model.robot)
    if servos := [drive.name for drive in robot.actuators if drive.servo]:
        raise ConfigError(f"{robot.name}: {servos[0]} is a servo, which tracks by itself")
    if not robot.actuators:
        raise ConfigError(f"{robot.name} has no actuator, so it cannot track references")
    own = realise(model)
    inertia, by_command = inertia_and_gains(own, pose)
    omega, smoothing = 2 * np.pi * frequency, max(FEWEST * period, 0.125 / (2 * np.pi * frequency))
    if np.linalg.matrix_rank(by_command, SINGULAR * np.abs(by_command).max()) == len(pose):
        back = np.linalg.pinv(by_command) @ inertia
        return FeedbackLaw(back * omega**2, back * (2 * omega), smoothing)
    stiffness, damping = _needed_by_motion(own, pose)
    nj, na = by_command.shape
    inverse = np.linalg.inv(inertia)
    whole = np.zeros((2 * nj + na, 2 * nj + na))
    whole[:nj, nj : 2 * nj] = np.eye(nj)
    whole[nj : 2 * nj] = np.hstack([-inverse @ stiffness, -inverse @ damping, inverse @ by_command])
    stepped = expm(whole * period)
    a, b = stepped[: 2 * nj, : 2 * nj], stepped[: 2 * nj, 2 * nj :]
    error = np.diag(np.repeat([1.0, 0.0], nj))
    effort = by_command.T @ inverse.T @ inverse @ by_command / omega**4
    try:
        p = solve_discrete_are(a, b, error, effort)
    except (np.linalg.LinAlgError, ValueError):
        raise ConfigError(f"{robot.name} has {na} actuators for {nj} joints, and no feedback holds its pose") from None
    gains = np.linalg.solve(effort + b.T @ p @ b, b.T @ p @ a)
    return FeedbackLaw(gains[:, :nj], gains[:, nj:], smoothing)


def by_acceleration(model: Model, pose: Array) -> Array:
    """(na, nj) G⁺ M, commands by accelerations of the joints, in a pose (nj,)."""
    inertia, by_command = inertia_and_gains(realise(model), pose)
    return np.asarray(np.linalg.pinv(by_command) @ inertia)


def balanced(model: Model, reference: Array) -> Array:
    """A reference (n, nj) whose joints without a drive are where the others balance them, each near the row before.

    Where all joints have a drive it stays as it is.

    Args:
        model: the nominal one.
        reference: [rad or m].
    """
    own = realise(model)
    _, by_command = inertia_and_gains(own, reference[0])
    sizes = np.abs(by_command).max(axis=1, initial=0.0)
    free = np.flatnonzero(sizes <= SINGULAR * sizes.max())
    if not len(free):
        return reference
    found, still, data = np.array(reference), np.zeros(reference.shape[1]), mujoco.MjData(own.mujoco)
    for k, row in enumerate(found):
        row[free] = found[max(k - 1, 0), free]
        for _ in range(NEWTON):
            lacking, slope = _needed(own, data, row, still, still)[free], np.empty((len(free), len(free)))
            for i, j in enumerate(free):
                moved = row.copy()
                moved[j] += NUDGE
                slope[:, i] = (_needed(own, data, moved, still, still)[free] - lacking) / NUDGE
            change = np.linalg.lstsq(slope, -lacking, rcond=SINGULAR)[0]
            row[free] += np.clip(change, -LARGEST_STEP, LARGEST_STEP)
            if np.abs(change).max() < NUDGE**2:
                break
    return found


def fed_forward(model: Model, times: Array, reference: Array) -> Array:
    """(n, na) commands under which a model would follow a reference (n, nj) at instants (n,), by inverse dynamics.

    Each is held until the next, so it is that for the middle between both. Rates and accelerations are differences of
    the reference. Drives count by their gains, what passes slowly through them as if it had arrived; effects that
    MuJoCo has no field for do not count.
    """
    own = realise(model)
    data = mujoco.MjData(own.mujoco)
    rate = np.gradient(reference, times, axis=0)
    acceleration = np.gradient(rate, times, axis=0)
    _, by_command = inertia_and_gains(own, reference[0])
    middles = [0.5 * (own_motion + np.vstack([own_motion[1:], own_motion[-1:]])) for own_motion in
               (reference, rate, acceleration)]  # fmt: skip
    torques = [_needed(own, data, *row) for row in zip(*middles, strict=True)]
    return np.asarray(np.array(torques) @ np.linalg.pinv(by_command).T)


def inertia_and_gains(own: Realised, pose: Array) -> tuple[Array, Array]:
    """(nj, nj) inertia of the joints in a pose (nj,), and (nj, na) torques by commands there."""
    at, dofs, drives = own.places.T
    data = mujoco.MjData(own.mujoco)
    data.qpos[at] = pose
    mujoco.mj_forward(own.mujoco, data)
    whole, still = np.zeros((own.mujoco.nv, own.mujoco.nv)), data.qfrc_actuator[drives].copy()
    mujoco.mj_fullM(own.mujoco, data, whole)
    columns = [np.zeros((len(drives), 0))]
    for drive in own.robot.actuators:
        some = 1.0 if drive.range[1] > 0 else -1.0
        some = float(np.clip(some, *drive.range))
        commands = data.ctrl if drive.state is None else data.act
        place = drive.control if drive.state is None else drive.state
        commands[place] = some
        mujoco.mj_forward(own.mujoco, data)
        columns.append(((data.qfrc_actuator[drives] - still) / some)[:, None])
        commands[place] = 0.0
    return np.asarray(whole[np.ix_(dofs, dofs)]), np.hstack(columns)


@quietly()
def _needed(own: Realised, data: mujoco.MjData, q: Array, v: Array, a: Array) -> Array:
    """(nj,) torques that a motion needs, nothing lost between drives and joints [N·m or N]."""
    at, dofs, _ = own.places.T
    data.qpos[at], data.qvel[dofs], data.qacc[dofs] = q, v, a
    for place, dof, joint in own.rotors:
        data.qpos[place], data.qvel[dof], data.qacc[dof] = q[joint], v[joint], a[joint]
    mujoco.mj_inverse(own.mujoco, data)
    found = np.array(data.qfrc_inverse[dofs])
    for _, dof, joint in own.rotors:
        found[joint] += data.qfrc_inverse[dof]
    return found


def _needed_by_motion(own: Realised, pose: Array) -> tuple[Array, Array]:
    """(nj, nj) each, how torques that are needed at rest change with positions and with rates."""
    data, still, nj = mujoco.MjData(own.mujoco), np.zeros(len(pose)), len(pose)
    by_position, by_rate = np.empty((2, nj, nj))
    for j, nudge in enumerate(NUDGE * np.eye(nj)):
        ends = [_needed(own, data, pose + s * nudge, still, still) for s in (1, -1)]
        by_position[:, j] = (ends[0] - ends[1]) / (2 * NUDGE)
        ends = [_needed(own, data, pose, s * nudge, still) for s in (1, -1)]
        by_rate[:, j] = (ends[0] - ends[1]) / (2 * NUDGE)
    return by_position, by_rate
