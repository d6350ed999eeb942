"""An MJCF robot made of another file: joints that are held, actuators and loose objects that are left out, motors.

What is not measured cannot be compared, and what was not recorded commands nothing. A joint that is held, such as a
gripper's, is part of the body before it then; an actuator that is left out exerts nothing. A loose object, a body with
a free joint that the robot may push, goes with all that names it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError, unknown_name
from equimus_ctrl.robots.mjcf.free_base import SEQUENCES, free_joints
from equimus_ctrl.robots.mjcf.prescribing import AT_JOINTS, chosen
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class Edits:
    """What is made of a file.

    Attributes:
        lock: joint → where it is held [rad or m].
        ignore: actuators and loose objects that are left out.
        motors: whether each joint without an actuator gets a motor of its name, whose command is its force [N·m or N].
        prescribe: joints whose motion was measured and is taken as it is, see ``prescribing``; of a robot their names,
            else also patterns.
        unmeasured: joints that no column tells of and that move by themselves, see ``unmeasured``; named alike.
        turns: free joint among these → axes of the hinges that take its place, as the recordings ask for.
    """

    lock: Mapping[str, float] = field(default_factory=dict)
    ignore: tuple[str, ...] = ()
    motors: bool = False
    prescribe: tuple[str, ...] = ()
    turns: Mapping[str, str] = field(default_factory=dict)
    unmeasured: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.lock or self.ignore or self.motors or self.prescribe or self.unmeasured)

    def to_dict(self) -> dict[str, Any]:
        """What a model file says of them."""
        said: dict[str, Any] = {
            "lock": dict(self.lock), "ignore": list(self.ignore), "motors": self.motors,
            "prescribe": list(self.prescribe), "unmeasured": list(self.unmeasured),
        }  # fmt: skip
        return {key: value for key, value in said.items() if value}


def edited(name: str, xml: str, assets: Mapping[str, bytes], edits: Edits) -> tuple[str, Edits]:
    """The XML of a robot with some edits, and these with names in the place of patterns.

    What is prescribed is left as it is there.

    Args:
        name: of the robot, for messages.
        xml: of it.
        assets: files that it names.
        edits: what is done.

    Raises:
        ModelError: for a joint, an actuator or an object that does not exist, or a joint that something else needs.
    """
    spec = mujoco.MjSpec.from_string(xml, assets=dict(assets))
    name_actuators(spec)
    try:
        _ignore(name, spec, edits.ignore)
        for joint, value in edits.lock.items():
            _lock(name, spec, joint, value)
        prescribed = chosen(name, spec, edits.prescribe, "prescribe")
        unmeasured = chosen(name, spec, edits.unmeasured, "unmeasured")
        if both := [joint for joint in unmeasured if joint in prescribed]:
            raise ModelError(f"{name}: {both[0]} is prescribed and unmeasured, expected one of both")
        free = [joint for joint in free_joints(spec) if joint in prescribed]
        edits = replace(edits, prescribe=prescribed, turns=dict.fromkeys(free, SEQUENCES[0]), unmeasured=unmeasured)
        if edits == Edits(prescribe=prescribed, turns=edits.turns, unmeasured=unmeasured):
            return xml, edits
        if edits.motors:
            driven = {own.target for own in spec.actuators if int(own.trntype) in AT_JOINTS} | {
                *prescribed,
                *unmeasured,
            }
            for own in spec.joints:
                if own.name not in driven and own.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                    motor = spec.add_actuator(name=own.name, target=own.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                    motor.set_to_motor()
        spec.compile()
        return str(spec.to_xml()), edits
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        what = ", ".join([*edits.lock, *edits.ignore]) or "motors added"
        raise ModelError(f"{name}: MuJoCo cannot load it with {what} changed ({reason})") from None


def name_actuators(spec: Any) -> None:
    """Give actuators without a name that of their joint, where no other has it."""
    taken = {own.name for own in spec.actuators}
    for own in spec.actuators:
        if not own.name and int(own.trntype) in AT_JOINTS and own.target not in taken:
            own.name = own.target
            taken.add(own.target)


def loose_objects(spec: Any) -> list[Any]:
    """Bodies with a free joint."""
    free = mujoco.mjtJoint.mjJNT_FREE
    return [body for body in spec.bodies[1:] if any(joint.type == free for joint in body.joints)]


def _ignore(name: str, spec: Any, ignored: Sequence[str]) -> None:
    """Leave actuators and loose objects out; a name that both have is the actuator's."""
    actuators, objects = [own.name for own in spec.actuators], [own.name for own in loose_objects(spec)]
    for own in ignored:
        if own in actuators or own in objects:
            continue
        if spec.body(own) is not None:
            raise ModelError(
                f"{name}: ignore: body {own!r} has no free joint, expected a loose object or an actuator; a joint that "
                "was not measured is held by --lock"
            )
        known = [known for known in (*actuators, *objects) if known]
        raise ModelError(unknown_name("actuator or loose object", own, known, f"{name}: ignore"))
    # Actuators first: those of an object go with it.
    for own in sorted(dict.fromkeys(ignored), key=lambda own: own not in actuators):
        spec.compile()  # of a specification that is compiled MuJoCo cuts keyframes to what stays
        # Geoms, sites, sensors, equalities, pairs and tendons of an object go with it.
        spec.delete(spec.actuator(own) if own in actuators else spec.body(own))


def _lock(name: str, spec: Any, joint: str, value: float) -> None:
    """Hold a joint: its body turned or moved to where it is then, and the joint gone with its actuators."""
    known = [own.name for own in spec.joints]
    if joint not in known:
        raise ModelError(unknown_name("joint", joint, known, f"{name}: lock"))
    if not math.isfinite(value):
        raise ModelError(f"{name}: lock: {joint} is {value:g}, expected a finite position")
    own = spec.joint(joint)
    if own.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise ModelError(f"{name}: lock: {joint} is no hinge or slide")
    model = spec.compile()
    body, j = own.parent, model.joint(joint).id
    b = int(model.jnt_bodyid[j])
    position, turn = _moved(model, b, j, value)
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = position, turn
    for actuator in [a for a in spec.actuators if int(a.trntype) in AT_JOINTS and a.target == joint]:
        spec.delete(actuator)
    for sensor in [s for s in spec.sensors if s.objname == joint]:
        spec.delete(sensor)
    for equality in [e for e in spec.equalities if joint in (e.name1, e.name2)]:
        spec.delete(equality)
    for key in list(spec.keys):
        spec.delete(key)
    spec.delete(own)


def _moved(model: Any, body: int, joint: int, value: float) -> tuple[Array, Array]:
    """(position, quaternion) of a body in its parent's frame where its joint is at a value."""
    way = value - float(model.qpos0[model.jnt_qposadr[joint]])
    axis, anchor = np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
    position, quat = np.array(model.body_pos[body]), np.array(model.body_quat[body])
    if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
        step = np.empty(3)
        mujoco.mju_rotVecQuat(step, axis * way, quat)
        return position + step, quat
    turned, before, after, whole = np.empty(4), np.empty(3), np.empty(3), np.empty(4)
    mujoco.mju_axisAngle2Quat(turned, axis, way)
    mujoco.mju_mulQuat(whole, quat, turned)
    mujoco.mju_rotVecQuat(before, anchor, quat)
    mujoco.mju_rotVecQuat(after, anchor, whole)
    return position + before - after, whole


def lock_of(text: str) -> tuple[str, float]:
    """``JOINT`` or ``JOINT=VALUE`` as a joint and where it is held; at 0 by default.

    Raises:
        ModelError: where the value is no number.
    """
    joint, equals, number = text.partition("=")
    try:
        return joint.strip(), float(number) if equals else 0.0
    except ValueError:
        raise ModelError(f"--lock {text!r}: expected JOINT or JOINT=POSITION, such as gripper=0.2") from None
