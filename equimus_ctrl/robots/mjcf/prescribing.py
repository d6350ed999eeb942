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
from equimus_ctrl.robots.mjcf.actuators import is_muscle, moments_away, peak_force
from equimus_ctrl.robots.mjcf.free_base import columns_of, part, positions, sequence_for
from equimus_ctrl.robots.mjcf.held_bodies import loosen_held
from equimus_ctrl.types import Array

HEAVY = 1e12
"""Armature of a prescribed joint, in units of the inertia that it moves in the file's own pose: gravity then makes it
drift by 1e-8 of a turn or metre in a minute at most."""
AT_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
LEAST = 1e-9
"""Inertia that a joint moves at least [kg·m² or kg]."""
GROUPS = 31
"""MuJoCo's groups of actuators, each of which a file may switch off."""


def motor_of(joint: str) -> str:
    """What the motor is called that moves a joint as it is prescribed."""
    return f"{joint} prescribed"


def chosen(name: str, spec: Any, patterns: Sequence[str], what: str) -> tuple[str, ...]:
    """The joints of a specification that some names or patterns fit, in its order.

    Args:
        name: of the robot, for messages.
        spec: MuJoCo's.
        patterns: such as ``base_*``.
        what: is done with them, for messages.

    Raises:
        ModelError: for one that fits none.
    """
    known = [own.name for own in spec.joints if own.name]
    for pattern in patterns:
        if not fnmatch.filter(known, pattern):
            raise ModelError(unknown_name("joint", pattern, known, f"{name}: {what}"))
    return tuple(own for own in known if any(fnmatch.fnmatchcase(own, p) for p in patterns))


def recorded_columns(joints: Sequence[str], turns: Mapping[str, str]) -> tuple[str, ...]:
    """The positions that are recorded of prescribed joints; of a free base its pose, see ``free_base.POSE``.

    Args:
        joints: their names.
        turns: free joint among these → axes of the hinges that take its place.
    """
    return tuple(name for own in joints for name in (columns_of(own) if own in turns else (own,)))


def prescribed_positions(where: str, joints: Sequence[str], turns: Mapping[str, str], recorded: Array) -> Array:
    """(n, np) positions of prescribed joints, of what was recorded of them [rad or m].

    Args:
        where: it was recorded, for messages.
        joints: as in ``recorded_columns``.
        turns: as there.
        recorded: (n, nc) these columns.

    Raises:
        ConfigError: for what is no pose of a free base, or one that its hinges cannot follow.
    """
    columns, parts = recorded_columns(joints, turns), []
    for own in joints:
        names = columns_of(own) if own in turns else (own,)
        given = recorded[:, [columns.index(name) for name in names]]
        parts.append(positions(where, own, turns[own], given) if own in turns else given)
    return np.column_stack(parts)


def suited_turns(
    joints: Sequence[str], turns: Mapping[str, str], recorded: Sequence[tuple[str, Array]]
) -> dict[str, str]:
    """Free joint → axes of hinges that stay clear of gimbal lock in some recordings, see ``free_base.sequence_for``.

    Args:
        joints: as in ``recorded_columns``.
        turns: as there.
        recorded: each recording's name, and (n, nc) these columns.
    """
    columns, found = recorded_columns(joints, turns), {}
    for base in turns:
        places = [columns.index(name) for name in columns_of(base)]
        found[base] = sequence_for(base, [(name, values[:, places]) for name, values in recorded])
    return found


def prescribe(spec: Any, names: Sequence[str], turns: Mapping[str, str]) -> None:
    """Let some joints of a specification move as motors of theirs say, whatever acts on them.

    What drives, brakes, holds or ends them alone goes: it changes nothing, or would fight with the motion that is
    prescribed, see ``held_bodies``. So do keyframes and sensors.

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
    for own in _idle(spec, joints):
        spec.delete(own)
    _free_of_their_own(spec, joints)
    loosen_held(spec, joints)
    heavy = {name: HEAVY * max(own, LEAST) for name, own in zip(joints, _inertias(spec, joints), strict=True)}
    group = next(k for k in range(GROUPS) if not spec.option.disableactuator >> k & 1)
    for name in joints:
        spec.joint(name).armature = heavy[name]
        motor = spec.add_actuator(name=motor_of(name), target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor.gear[:] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        motor.gainprm[0], motor.group, motor.delay, motor.nsample = heavy[name], group, 0.0, 0


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
    own = [int(model.joint(name).dofadr[0]) for name in joints]
    rows = np.abs(moments_away(model))[[int(model.actuator_outadr[i]) for i in range(model.nactuator)]]
    chosen = (rows[:, own].sum(axis=1) > 0) & (np.delete(rows, own, axis=1).sum(axis=1) == 0)
    # One at a joint may have a gear of 0.
    at = [int(actuator.trntype) in AT_JOINTS and actuator.target in joints for actuator in spec.actuators]
    return [actuator for actuator, *idle in zip(spec.actuators, chosen, at, strict=True) if any(idle)]


def _free_of_their_own(spec: Any, joints: Sequence[str]) -> None:
    """Take away what brakes, pulls and ends some joints; of a range that counts in the file the numbers stay."""
    model = spec.compile()
    for name in joints:
        joint = spec.joint(name)
        if not model.jnt_limited[model.joint(name).id]:
            joint.range = [0.0, 0.0]
        joint.damping, joint.stiffness, joint.frictionloss = [0.0] * 3, [0.0] * 3, 0.0
        joint.springdamper, joint.armature = [0.0, 0.0], 0.0
        joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _inertias(spec: Any, joints: Sequence[str]) -> Array:
    """(n,) inertia that each joint moves in the file's own pose [kg·m² or kg]."""
    model = spec.compile()
    return _moved_by_each(model)[[int(model.joint(name).dofadr[0]) for name in joints]]


def _moved_by_each(model: Any) -> Array:
    """(nv,) inertia that each degree of freedom moves in the file's own pose [kg·m² or kg]."""
    data, whole = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, whole)
    return np.diag(whole).copy()


def ease_solver(model: Any, joints: Sequence[str]) -> None:
    """Let MuJoCo's solver judge what is left by the inertia of the other joints.

    It ends where that is small in units of the mean inertia of all, beside which contacts and dry friction of the
    others would be next to nothing.

    Args:
        model: an ``mujoco.MjModel``, changed in its solvers' tolerances.
        joints: that are prescribed.
    """
    inertia = _moved_by_each(model)
    others = np.delete(inertia, [int(model.joint(name).dofadr[0]) for name in joints])
    share = float(others.mean() / inertia.mean())
    model.opt.tolerance *= share
    model.opt.noslip_tolerance *= share
