"""How joints may have moved that were not measured: by the model, along what was measured of the others.

Where they begin is fitted; this is where a fit begins, and what predictions without a fit take.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from scipy.optimize import root

from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.smoothing import smoothed, together
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array, PrescribedMotion, Recording


def with_supposed(recording: Recording, robot: Robot) -> Recording:
    """A recording with how unmeasured joints may have moved in it; itself where there are none.

    Joints with a tie are where it puts them. The others begin at rest, where the forces on them are in balance nearest
    to the file's pose, and then move by the model while the measured joints move as measured.

    Args:
        recording: of the robot.
        robot: with the model's parameters.
    """
    if not robot.unmeasured_names or recording.supposed is not None or recording.joints != robot.joint_names:
        return recording
    own = mjcf_of(robot)
    measured = smoothed(recording.name, recording.joints, recording.time, np.asarray(recording.position))
    known = measured if recording.prescribed is None else together(measured, recording.prescribed)
    beside = np.zeros((len(recording.time), 0))
    if own.loose_count:
        beside = _simulated(own, recording, known)
    q, v = own.with_unmeasured(known.position, known.velocity, beside)
    n = len(known.joints)
    acceleration = np.gradient(v[:, n:], recording.time, axis=0)
    found = PrescribedMotion(
        own.unmeasured_names, known.times, q[:, n:], v[:, n:], acceleration, np.zeros(len(own.unmeasured_names))
    )
    return replace(recording, supposed=found)


def _along_measured(robot: MjcfRobot) -> MjcfRobot:
    """The robot whose measured joints are prescribed, and whose unmeasured ones move by themselves."""
    given = replace(robot.edits, prescribe=(*robot.edits.prescribe, *robot.joint_names), unmeasured=())
    bare = MjcfRobot(robot.name, robot.xml, robot.assets, robot.source, given)
    return replace(bare, values={name: v for name, v in robot.values.items() if name in bare.plan.parameters})


def _simulated(robot: MjcfRobot, recording: Recording, known: PrescribedMotion) -> Array:
    """(n, 2 nl) positions and rates of unmeasured joints without a tie while all others move as they are known to."""
    along = _along_measured(robot)
    order = [known.joints.index(name) for name in along.prescribed_names]
    motion = PrescribedMotion(
        along.prescribed_names, known.times, known.position[:, order], known.velocity[:, order],
        known.acceleration[:, order], known.noise[order],
    )  # fmt: skip
    taken = [recording.actuators.index(name) for name in along.actuator_names]
    command, before = np.asarray(recording.command)[:, taken], np.asarray(recording.command_before)[taken]
    loose = robot.unmeasured_names[: robot.loose_count]
    start = _at_rest(along, robot, known, before)
    everything, _ = robot.with_unmeasured(known.position[0], known.velocity[0], np.append(start, np.zeros(len(loose))))
    names = [*known.joints, *robot.unmeasured_names]
    rest = np.array([everything[names.index(name)] for name in along.joint_names])
    trial = Trial(
        recording.name, known.times, command, before, float(known.times[0]), rest, known.times, linear=recording.linear,
        inner=True, prescribed=motion,
    )  # fmt: skip
    (found,) = simulate_mjcf([Model(along)], [trial], threads=1)
    columns = [along.joint_names.index(name) for name in loose]
    still = np.concatenate([start, np.zeros(len(loose))])
    if found.motion is None or not found.sound.all():
        return np.tile(still, (len(known.times), 1))
    nj = len(along.joint_names)
    return np.asarray(found.motion[0][:, [*columns, *(nj + c for c in columns)]])


def _at_rest(along: MjcfRobot, robot: MjcfRobot, known: PrescribedMotion, command: Array) -> Array:
    """(nl,) where forces on unmeasured joints without a tie are in balance, all others being where they begin."""
    model = along.mujoco_model()
    data = mujoco.MjData(model)
    names = robot.unmeasured_names[: robot.loose_count]
    places = np.array([(int(model.joint(n).qposadr[0]), int(model.joint(n).dofadr[0])) for n in names])
    everything = [*known.joints, *robot.unmeasured_names]
    at = np.array([int(model.joint(name).qposadr[0]) for name in everything])
    beginning = np.array(model.qpos0[places[:, 0]])

    def forces(position: Array) -> Array:
        still = np.append(position, np.zeros(len(position)))
        data.qpos[at] = robot.with_unmeasured(known.position[0], np.zeros(len(known.joints)), still)[0]
        data.qvel[:] = 0.0
        data.ctrl[: len(command)] = command
        mujoco.mj_forward(model, data)
        return np.asarray((data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias)[places[:, 1]])

    found = root(forces, beginning)
    low, high = np.array([axis.range for axis, tie in robot.plan.unmeasured if tie is None]).T
    return np.asarray(np.clip(found.x if found.success else beginning, low, high))
