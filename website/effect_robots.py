"""The laws of effects that are another robot: what that robot exerts, or how it moves, beside the model."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from effect_law import CHANGED, Law

from equimus_ctrl.effects import Effect, Excitation
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

POSES = 81
RIGID = 100.0
"""What exerts so many times the torque that holds the robot is a constraint: the motion that it stops is drawn."""
PLAIN, CROSS = 1.0, 0.5
"""Rate of the other joints while one is looked at [rad/s], and their angle [rad]."""


def at_rest(effect: Effect, robot: Any) -> Law:
    """What another robot of springs exerts at rest on the joint that this changes most, over that joint's angle."""
    pose = np.array([robot.middle(joint) for joint in robot.joint_names])
    spans = [np.linspace(low, high, POSES) for low, high in zip(*robot.joint_range, strict=True)]

    def torques(own: Any, joint: int) -> Array:
        poses = np.tile(pose, (POSES, 1))
        poses[:, joint] = spans[joint]
        kinematics = Kinematics(own, nominal_model().phase)
        return np.array([kinematics.rest_torque(q)[0][joint] for q in poses])

    now, exerts = changed_bodies([effect], robot), ("torque at rest", "N·m")
    laws = [
        Law(effect, "at rest", spans[j], "joint angle", "rad", *(torques(own, j) for own in (now, robot)), *exerts)
        for j in range(len(pose))
    ]
    return max(laws, key=lambda own: own.strength)


def other_robot(effect: Effect, robot: MjcfRobot, seen: Excitation) -> Law:
    """What another robot does, in MuJoCo: see the module."""
    model, now = robot.mujoco_model(), changed_bodies([effect], robot).mujoco_model()
    if now.nv > model.nv:
        return _moved(effect, model, now, seen)
    needed = float(np.abs(_needed(model, "qpos", np.linspace(seen.low, seen.high, POSES), 0)).max())
    strongest = None
    for probe in (_at_angles, _at_rates, _at_accelerations, _at_commands):
        strongest = max(probe(effect, model, now, seen), key=lambda own: own.strength)
        if strongest.strength > CHANGED * needed:
            break
    assert strongest is not None
    rigid = float(np.abs(strongest.values - strongest.without).max()) > RIGID * needed
    return _moved(effect, model, now, seen) if rigid else strongest


def _at_angles(effect: Effect, model: Any, now: Any, seen: Excitation) -> list[Law]:
    span = np.linspace(seen.low, seen.high, POSES)
    return _added(effect, model, now, "at rest", "qpos", span, "joint angle", "rad")


def _at_rates(effect: Effect, model: Any, now: Any, seen: Excitation) -> list[Law]:
    span = np.linspace(-seen.speed, seen.speed, POSES)
    return _added(effect, model, now, "other joint at 1 rad/s", "qvel", span, "rate", "rad/s")


def _at_accelerations(effect: Effect, model: Any, now: Any, seen: Excitation) -> list[Law]:
    span = np.linspace(-1.0, 1.0, POSES) * seen.speed**2
    return _added(effect, model, now, "from rest", "qacc", span, "acceleration", "rad/s²")


def _added(
    effect: Effect, model: Any, now: Any, shown: str, name: str, along: Array, axis: str, unit: str
) -> list[Law]:
    """What the effect exerts on each joint: what need not be exerted any more where it does."""
    found = []
    for joint in range(model.nv):
        added = _needed(model, name, along, joint) - _needed(now, name, along, joint)
        found.append(Law(effect, shown, along, axis, unit, added, np.zeros(len(along)), "torque on the joint", "N·m"))
    return found


def _needed(model: Any, name: str, along: Array, joint: int) -> Array:
    """(n,) the generalised force at a joint that a motion needs, by inverse dynamics [N·m]."""
    data, found = mujoco.MjData(model), []
    for value in along:
        data.qpos[:], data.qvel[:], data.qacc[:] = CROSS, 0.0, 0.0
        if name == "qvel":
            data.qvel[:] = PLAIN
        getattr(data, name)[joint] = value
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse[joint])
    return np.array(found)


def _at_commands(effect: Effect, model: Any, now: Any, seen: Excitation) -> list[Law]:
    """What each drive exerts over its command."""
    span = np.linspace(-seen.command, seen.command, POSES)

    def exerts(own: Any, drive: int) -> Array:
        data, found = mujoco.MjData(own), []
        for value in span:
            data.ctrl[drive] = value
            mujoco.mj_forward(own, data)
            found.append(data.actuator_force[drive])
        return np.array(found)

    return [
        Law(effect, "", span, "command", "N·m", exerts(now, k), exerts(model, k), "drive's torque", "N·m")
        for k in range(model.nu)
    ]


def _moved(effect: Effect, model: Any, now: Any, seen: Excitation) -> Law:
    """How the effect's joint moves, or the first where it sits at none, under a torque of the first drive that swings.

    The robot begins at rest. It hangs straight down where what it gains turns with a joint, else it falls from a pose.
    """
    steps, begins = round(seen.duration / 2 / model.opt.timestep), 0.0 if now.nv > model.nv else CROSS
    motions = []
    for own in (now, model):
        data, motion = mujoco.MjData(own), []
        places = [own.joint(model.joint(k).name).qposadr[0] for k in range(model.njnt)]
        data.qpos[places] = begins
        for step in range(steps):
            data.ctrl[0] = 0.1 * seen.command * math.sin(2 * math.pi * step * own.opt.timestep)
            mujoco.mj_step(own, data)
            motion.append(data.qpos[places].copy())
        motions.append(np.array(motion).T)
    time = np.arange(1, steps + 1) * model.opt.timestep
    shown = "under a torque that swings at 1 Hz"
    joints = [model.joint(k).name for k in range(model.njnt)]
    own = joints.index(effect.location) if effect.location in joints else 0
    return Law(effect, shown, time, "time", "s", motions[0][own], motions[1][own], "joint angle", "rad")
