"""Joints whose motion was measured and is taken as it is: what is made of a robot's specification for them.

The equations of motion of all joints stay as they are. A prescribed joint gets an armature A that is very large beside
the inertia it moves, and a motor of the same gain, whose command is an acceleration a:

    (M + A) q̈ + … = A a,  so that  q̈ = a (1 + O(M/A)),

and all other joints move as if it moved so by itself. Its position and rate at a start are given too. Both engines
solve such a system to the last digits: in LᵀDL or L D Lᵀ a large entry of the diagonal alone costs no accuracy.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError, unknown_name
from equimus_ctrl.robots.mjcf.actuators import is_muscle, peak_force
from equimus_ctrl.robots.mjcf.free_base import part
from equimus_ctrl.types import Array

HEAVY = 1e12
"""Armature of a prescribed joint, in units of the inertia that it moves in the file's own pose: gravity then makes it
drift by 1e-8 of a turn or metre in a minute at most."""
AT_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
AWAY = 0.3
"""From the file's own pose, where moment arms might vanish [rad or m]."""
LEAST = 1e-9
"""Inertia that a joint moves at least [kg·m² or kg]."""


def motor_of(joint: str) -> str:
    """What the motor is called that moves a joint as it is prescribed."""
    return f"{joint} prescribed"


def chosen(name: str, spec: Any, patterns: Sequence[str]) -> tuple[str, ...]:
    """The joints of a specification that some names or patterns fit, in its order.

    Args:
        name: of the robot, for messages.
        spec: MuJoCo's.
        patterns: such as ``base_*``.

    Raises:
        ModelError: for one that fits none.
    """
    known = [own.name for own in spec.joints if own.name]
    for pattern in patterns:
        if not fnmatch.filter(known, pattern):
            raise ModelError(unknown_name("joint", pattern, known, f"{name}: prescribe"))
    return tuple(own for own in known if any(fnmatch.fnmatchcase(own, p) for p in patterns))


def prescribe(spec: Any, names: Sequence[str], turns: Mapping[str, str]) -> None:
    """Let some joints of a specification move as motors of theirs say, whatever acts on them.

    What drives, brakes, holds or ends them alone goes: it changes nothing, or would fight with the motion that is
    prescribed. So do keyframes and sensors.

    Args:
        spec: MuJoCo's, changed.
        names: of the joints.
        turns: free joint → axes of the hinges that take its place, see ``free_base``.
    """
    _hold_muscles(spec)
    for own in (*spec.keys, *spec.sensors):
        spec.delete(own)
    joints: list[str] = []
    for name in names:
        joints += part(spec, name, turns[name]) if name in turns else [name]
    held = [e for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT]
    for own in [e for e in held if e.name1 in joints and e.name2 in (*joints, "")]:
        spec.delete(own)
    for own in _idle(spec, joints):
        spec.delete(own)
    for name in joints:
        joint = spec.joint(name)
        joint.damping, joint.stiffness, joint.frictionloss = [0.0] * 3, [0.0] * 3, 0.0
        joint.springdamper, joint.armature = [0.0, 0.0], 0.0
        joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    heavy = {name: HEAVY * max(own, LEAST) for name, own in zip(joints, _inertias(spec, joints), strict=True)}
    for name in joints:
        spec.joint(name).armature = heavy[name]
        motor = spec.add_actuator(name=motor_of(name), target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor.gear[:] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        motor.gainprm[0] = heavy[name]


def _hold_muscles(spec: Any) -> None:
    """Write down how far muscles go and how strong they are, which MuJoCo works out of all joints of a robot."""
    if not any(own.gaintype == mujoco.mjtGain.mjGAIN_MUSCLE for own in spec.actuators):
        return
    model = spec.compile()
    for own in spec.actuators:
        if is_muscle(model, own.id):
            own.lengthrange = model.actuator_lengthrange[own.id]
            own.gainprm[2] = own.biasprm[2] = peak_force(model, own.id)


def _idle(spec: Any, joints: Sequence[str]) -> list[Any]:
    """The actuators that act on some joints alone, as thrusters on a base do."""
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] += AWAY
    mujoco.mj_forward(model, data)
    moments = np.zeros((model.nout, model.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    own = {int(model.joint(name).dofadr[0]) for name in joints}
    others = [d for d in range(model.nv) if d not in own]
    rows = moments[[int(model.actuator_outadr[i]) for i in range(model.nactuator)]]
    acts_there, acts_elsewhere = (np.abs(rows[:, where]).sum(axis=1) > 0 for where in (sorted(own), others))
    chosen = np.flatnonzero(acts_there & ~acts_elsewhere)
    return [actuator for i, actuator in enumerate(spec.actuators) if i in chosen]


def _inertias(spec: Any, joints: Sequence[str]) -> Array:
    """(n,) inertia that each joint moves in the file's own pose [kg·m² or kg]."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    return np.array([whole[d, d] for d in (int(model.joint(name).dofadr[0]) for name in joints)])


def ease_solver(model: Any, joints: Sequence[str]) -> None:
    """Let MuJoCo's solver judge forces by the inertia of the other joints: it ends where they are small beside it.

    Args:
        model: an ``mujoco.MjModel``, changed in ``stat.meaninertia``.
        joints: that are prescribed.
    """
    own = {int(model.joint(name).dofadr[0]) for name in joints}
    others = [d for d in range(model.nv) if d not in own]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    model.stat.meaninertia = float(np.mean([whole[d, d] for d in others]))
