"""A morphology as an MJCF file: closed elements, joint stops and keyframes are in it, so plain MuJoCo needs no help.

``models.mjcf.build_spec`` puts every joint at 0, where the ends of elements do not meet, and leaves joint stops to
``compile_with_stops``, for their forces are shares of what the compiled model would need. Here all of it is in the XML:
bodies stand in the initial pose with each joint's position there as its ``ref``, so a model that is reset has closed
elements, and limits have the numbers that the compiled model gives them.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings, build_spec, compile_with_stops, place, stop_tendon, stops_differ
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array


def closed_spec(morphology: Morphology, phase: Phase, settings: SolverSettings, position: Array) -> mujoco.MjSpec:
    """The MjSpec of a morphology whose initial pose is a given one with all elements closed, its joint stops in it.

    Args:
        morphology: of the robot.
        phase: base fixed (swing) or foot pinned (stance).
        settings: of the solver; ``softness`` is left at 1, for no file holds it.
        position: (nj,) the initial pose [rad].
    """
    spec = build_spec(morphology, phase, settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    place(model, data, Kinematics(morphology, phase), position)
    for body in spec.bodies:
        for joint in body.joints:
            _begin_at(body, joint, float(data.qpos[model.joint(joint.name).qposadr[0]]))
    model = compile_with_stops(spec, morphology)
    for joint in morphology.joints:
        if joint.lower is None and joint.upper is None:
            continue
        spec.joint(joint.name).solref_limit = model.jnt_solref[model.joint(joint.name).id]
        if joint.upper and stops_differ(joint):
            name = stop_tendon(joint.name)
            spec.tendon(name).solref_limit = model.tendon_solref_lim[model.tendon(name).id]
    return spec


def add_keyframes(
    spec: mujoco.MjSpec, model: mujoco.MjModel, morphology: Morphology, phase: Phase, poses: Mapping[str, Array]
) -> None:
    """Add keyframes in which the elements are closed.

    Args:
        spec: of the morphology, see ``closed_spec``; changed in place.
        model: made of it.
        morphology: of the robot.
        phase: see ``closed_spec``.
        poses: name → (nj,) [rad].
    """
    kinematics, data = Kinematics(morphology, phase), mujoco.MjData(model)
    for name, position in poses.items():
        mujoco.mj_resetData(model, data)
        place(model, data, kinematics, np.asarray(position))
        spec.add_key(name=name, qpos=data.qpos)


def _begin_at(body: mujoco.MjsBody, joint: mujoco.MjsJoint, value: float) -> None:
    """Put a body where one of its joints, at its origin, would put it, and call that position the joint's own there."""
    axis = np.array(joint.axis, dtype=np.float64)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        way = np.empty(3)
        mujoco.mju_rotVecQuat(way, axis * value, np.array(body.quat))
        body.pos = np.array(body.pos) + way
    else:
        turn, turned = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, axis, value)
        mujoco.mju_mulQuat(turned, np.array(body.quat), turn)
        body.quat = turned
    joint.ref = value
