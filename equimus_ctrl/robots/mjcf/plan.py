"""What a MuJoCo XML says of an MJCF robot: its joints, its actuators, and every number that can be changed."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as made
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.actuators import drive_parameters, drives_of
from equimus_ctrl.robots.mjcf.editing import name_actuators
from equimus_ctrl.robots.mjcf.entries import SLIDING, Axis, Drive, ModelParameter, Tie, setter
from equimus_ctrl.robots.mjcf.free_base import columns_of
from equimus_ctrl.robots.mjcf.held_bodies import moved_bodies
from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.robots.mjcf.prescribing import motor_of, prescribe
from equimus_ctrl.robots.mjcf.unmeasured import check_drives, ties_of
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class Assets:
    """What a model is made of beside its XML, compared by what it is, so that plans can be kept.

    Attributes:
        files: that the XML names.
        prescribed: joints whose motion is an input.
        turns: free joint among them → axes of the hinges that take its place.
        unmeasured: joints that no column tells of and that move by themselves.
    """

    files: Mapping[str, bytes]
    prescribed: tuple[str, ...] = ()
    turns: Mapping[str, str] = made(default_factory=dict)
    unmeasured: tuple[str, ...] = ()

    def __hash__(self) -> int:
        return hash((tuple(sorted(self.files)), self.prescribed, self.unmeasured))


@dataclass(frozen=True, eq=False)
class Plan:
    """What a file says of an MJCF robot.

    Attributes:
        base: MuJoCo's model of it, not to be changed.
        joints: all of them, but for those that are prescribed or not measured.
        prescribed: joints whose motion is an input.
        unmeasured: joints that no column tells of, with what ties them to others, see ``unmeasured.ties_of``.
        drives: all actuators, but for those by which prescribed joints are moved.
        bodies: names of those that move.
        sites: names of those that move.
        parameters: by dotted name.
        tilt_axis: (3,) about which gravity can be turned.
        weights: joint → inertia that it moves by itself, where the file has it [kg·m² or kg].
    """

    base: Any
    joints: tuple[Axis, ...]
    prescribed: tuple[Axis, ...]
    unmeasured: tuple[tuple[Axis, Tie | None], ...]
    drives: tuple[Drive, ...]
    bodies: tuple[str, ...]
    sites: tuple[str, ...]
    parameters: Mapping[str, ModelParameter]
    tilt_axis: Array
    weights: Mapping[str, float]


def _compiled(xml: str, assets: Assets, name: str) -> Any:
    try:
        with quietly(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Inertia matrix")  # of numbers that are told by ``_check``
            return spec_of(xml, assets).compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ModelError(f"{name}: MuJoCo cannot load it ({reason})") from None


def spec_of(xml: str, assets: Assets) -> Any:
    """MuJoCo's specification of a file."""
    with quietly():  # what is wrong with a number is told in a sentence
        spec = mujoco.MjSpec.from_string(xml, assets=dict(assets.files))
    name_actuators(spec)
    for body in spec.bodies:
        body.simple = False  # what is balanced now may be unbalanced by a payload
    if assets.prescribed:
        prescribe(spec, assets.prescribed, assets.turns)
    return spec


@lru_cache(maxsize=32)
def plan_of(name: str, xml: str, assets: Assets) -> Plan:
    """What a file says.

    Raises:
        ModelError: where MuJoCo cannot load it, or it is no robot of hinges and slides.
    """
    base = _compiled(xml, assets, name)
    _check(base, name, xml, math.inf if assets.prescribed else LARGEST)
    every = _joints(base, name)
    motors = [base.actuator(k).name for k in range(base.nactuator)] if assets.prescribed else []
    moved = sorted((j for j in every if motor_of(j.name) in motors), key=lambda j: motors.index(motor_of(j.name)))
    prescribed = tuple(replace(joint, range=_kept_range(base, joint)) for joint in moved)
    beside = [joint for joint in every if joint.name in assets.unmeasured]
    joints = tuple(joint for joint in every if joint not in moved and joint not in beside)
    if moved and base.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        raise ModelError(
            f"{name}: the XML switches actuators off, expected them on where the motion of joints is prescribed; leave "
            '<flag actuation="disable"/> out'
        )
    if not joints:
        if beside:
            raise ModelError(f"{name}: no joint is left that is measured and not prescribed, expected one at least")
        raise ModelError(f"{name}: the motion of all joints is prescribed, expected one at least that moves by itself")
    others = [motor_of(joint.name) for joint in prescribed]
    if beside:
        check_drives(base, name, joints, others)
    drives = drives_of(base, name, joints, others)
    unmeasured = tuple(ties_of(base, name, [joint.name for joint in (*joints, *prescribed)], beside))
    free = (*joints, *beside)
    moves = moved_bodies(base, (joint.dof for joint in free))
    bodies = tuple(n for b in moves if (n := base.body(b).name) and base.body_mass[b] > 0)
    sites = tuple(
        s.name for s in (base.site(i) for i in range(base.nsite)) if s.name and base.site_bodyid[s.id] in moves
    )
    axis = _tilt_axis(base, joints)
    parameters = [*_body_parameters(base, bodies), *_joint_parameters(base, free), *drive_parameters(base, drives)]
    size = float(np.linalg.norm(base.opt.gravity))
    down = np.array(base.opt.gravity)

    def turned(model: Any, angle: float) -> None:
        across = np.cross(axis, down) / max(size, 1e-300)
        now = float(np.linalg.norm(model.opt.gravity))
        model.opt.gravity[:] = now * (math.cos(angle) * down / max(size, 1e-300) + math.sin(angle) * across)

    def heavy(model: Any, value: float) -> None:
        model.opt.gravity[:] *= value / max(float(np.linalg.norm(model.opt.gravity)), 1e-300)

    if size > 0:
        parameters += [ModelParameter("gravity", size, "m/s²", heavy)]
    parameters += [ModelParameter("tilt", 0.0, "rad", turned)]
    named, weights = {n.name: n for n in parameters}, _weights(base, free)
    return Plan(base, joints, prescribed, unmeasured, drives, bodies, sites, named, axis, weights)


SHORTEST, LONGEST = 1e-6, 0.1
"""Physics steps that are none [s]."""
ELEMENTS = ("flexcomp", "flex", "composite", "plugin")


def _check(base: Any, name: str, xml: str, largest: float) -> None:
    """Raise ModelError for what neither engine takes, or values that cannot be.

    Args:
        base: MuJoCo's model.
        name: of the robot.
        xml: of it.
        largest: size of a number; what moves prescribed joints is as stiff as it has to be.
    """
    if base.nflex or base.nplugin:
        for number, line in enumerate(xml.splitlines(), 1):
            if (element := next((e for e in ELEMENTS if f"<{e}" in line), None)) is not None:
                raise ModelError(
                    f"{name}: line {number} of the XML has <{element}>, which neither engine takes; expected rigid "
                    "bodies on hinges and slides"
                )
        raise ModelError(f"{name}: has a flex or a plugin, which neither engine takes; expected rigid bodies")
    if not SHORTEST <= base.opt.timestep <= LONGEST:
        raise ModelError(f"{name}: timestep is {base.opt.timestep:g} s, expected {SHORTEST:g} to {LONGEST:g} s")
    for key in ("gravity", "wind", "density", "viscosity"):
        value = np.asarray(getattr(base.opt, key))
        if not np.all(np.abs(value) <= LARGEST):
            what = "three finite numbers" if value.ndim else "a finite number"
            raise ModelError(f"{name}: {key} is {value.tolist()}, expected {what} up to {LARGEST:g}")
    for prefix, kind in _CHECKED.items():
        for field in dir(base):
            values = getattr(base, field) if field.startswith(prefix) and not field.endswith(DERIVED) else None
            if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or not len(values):
                continue
            most = math.inf if field.endswith(ENDLESS) else largest
            least = 0.0 if field.endswith(NOT_NEGATIVE) else -most
            wrong = ~((values >= least) & (values <= most))
            if wrong.any():
                row = int(np.argmax(wrong.reshape(len(values), -1).any(axis=1)))
                found = float(values[row][wrong[row]].flat[0])
                whose = f"{field.removeprefix(f'{prefix}_')} of {kind} {_owner(base, prefix, kind, row)!r}"
                span = "" if math.isnan(found) else f" from {least:g} to {most:g}"
                raise ModelError(f"{name}: {whose} is {found:g}, expected a number{span}")
    for prefix, field in _DIRECTIONS:
        sizes = np.linalg.norm(getattr(base, f"{prefix}_{field}"), axis=1)
        for row in np.flatnonzero(~(np.abs(sizes - 1) < ROUNDED)).tolist():
            owner = _owner(base, prefix, _CHECKED[prefix], row)
            raise ModelError(
                f"{name}: {field} of {_CHECKED[prefix]} {owner!r} cannot be normalised, expected numbers of usual size"
            )


LARGEST = float(mujoco.mjMAXVAL)
"""MuJoCo takes a state beyond it for one that has diverged; no number of a robot's is so large."""
ENDLESS = ("range", "limited", "springyield", "user")
"""What may be without end."""
ROUNDED = 1e-6
"""By so much the length of what MuJoCo has normalised may differ from 1."""
_DIRECTIONS = (("jnt", "axis"), ("body", "quat"), ("body", "iquat"), ("site", "quat"))
NOT_NEGATIVE = ("frictionloss", "armature")
"""What MuJoCo takes below 0, where it means nothing or no robot."""
DERIVED = ("invweight0", "M0", "length0", "acc0", "lengthrange", "subtreemass", "rgba", "rbound", "aabb")
"""What MuJoCo works out of other parameters, which are listed in their place, or is only seen."""
_CHECKED = {
    "jnt": "joint", "dof": "joint", "qpos": "joint", "body": "body", "site": "site", "geom": "geom",
    "tendon": "tendon", "actuator": "actuator", "eq": "equality", "key": "keyframe",
}  # fmt: skip
"""What MuJoCo's fields of numbers begin with → whose they are."""


def _owner(base: Any, prefix: str, kind: str, row: int) -> str:
    """The name of whose number it is; its place in the file where it has none."""
    if prefix == "dof":
        row = int(base.dof_jntid[row])
    elif prefix == "qpos":
        row = int(np.searchsorted(base.jnt_qposadr, row, side="right")) - 1
    name: str = getattr(base, kind)(row).name
    return name or f"{kind} {row}"


def _joints(base: Any, name: str) -> tuple[Axis, ...]:
    kinds = mujoco.mjtJoint
    found = []
    for i in range(base.njnt):
        joint, kind = base.joint(i), int(base.jnt_type[i])
        if kind not in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
            if kind == int(kinds.mjJNT_FREE):
                raise ModelError(_free(base, name, i))
            raise ModelError(f"{name}: joint {joint.name or i!r} is a ball joint, expected hinges and slides alone")
        if not joint.name:
            raise ModelError(f"{name}: joint {i} has no name, by which a recording's columns could be identified")
        limited = bool(base.jnt_limited[i])
        low, high = (float(v) for v in base.jnt_range[i]) if limited else (-math.inf, math.inf)
        slides = kind == int(kinds.mjJNT_SLIDE)
        found.append(Axis(joint.name, i, int(base.jnt_qposadr[i]), int(base.jnt_dofadr[i]), slides, (low, high)))
    if not found:
        raise ModelError(f"{name}: has no joint")
    return tuple(found)


def _kept_range(base: Any, joint: Axis) -> tuple[float, float]:
    """Where the file lets a prescribed joint be, which no longer ends its motion, see ``prescribing``."""
    low, high = (float(end) for end in base.jnt_range[joint.index])
    return (low, high) if low < high else (-math.inf, math.inf)


def _free(base: Any, name: str, index: int) -> str:
    """What to do about a free joint: of a base, and where there is a robot without its body of a loose object."""
    joint, body = base.joint(index).name, int(base.jnt_bodyid[index])
    measured = "it gets a name, by which --prescribe takes its measured pose where recordings tell of it"
    if joint:
        columns = ", ".join(f"pos.{own}" for own in columns_of(joint))
        measured = f"its pose measured ({columns}) and taken as it is from recordings by --prescribe {joint}"
    loose = ""
    if any(int(base.body_rootid[other]) != int(base.body_rootid[body]) for other in base.jnt_bodyid):
        own = base.body(body).name or "BODY, for which its body needs a name"
        loose = f"; a loose object in the scene is left out by --ignore {own}"
    return (
        f"{name}: joint {joint or index!r} is a free joint, expected hinges and slides alone: the base has to be "
        f"fixed, or {measured}{loose}"
    )


def _weights(base: Any, joints: Sequence[Axis]) -> dict[str, float]:
    data = mujoco.MjData(base)
    mujoco.mj_forward(base, data)
    whole = np.zeros((base.nv, base.nv))
    mujoco.mj_fullM(base, data, whole)
    return {joint.name: float(whole[joint.dof, joint.dof]) for joint in joints}


def _tilt_axis(base: Any, joints: Sequence[Axis]) -> Array:
    """A horizontal axis about which turning gravity matters to the first joint for which it does."""
    data = mujoco.MjData(base)
    mujoco.mj_kinematics(base, data)
    down = np.array(base.opt.gravity)
    size = np.linalg.norm(down)
    if size > 0:
        down /= size
        for joint in joints:
            own = data.xaxis[joint.index]
            axis = np.cross(down, own) if joint.slides else own - down * (down @ own)
            if np.linalg.norm(axis) > 0.1:
                return np.asarray(axis / np.linalg.norm(axis))
    return np.array([0.0, 1.0, 0.0])


def _body_parameters(base: Any, bodies: Sequence[str]) -> list[ModelParameter]:
    found = []
    for name in bodies:
        b = base.body(name).id
        found.append(ModelParameter(f"{name}.mass", float(base.body_mass[b]), "kg", setter("body", name, "body_mass")))
        moments = np.array(base.body_inertia[b])
        share = moments / max(float(moments.max()), 1e-300)

        def inertia(model: Any, value: float, name: str = name, shape: Array = share) -> None:
            model.body_inertia[model.body(name).id] = value * shape

        if moments.max() > 0:
            found.append(ModelParameter(f"{name}.inertia", float(moments.max()), "kg·m²", inertia))
            found += [ModelParameter(f"{name}.{kind}", 0.0, "1", _together) for kind in SHAPE]
        for k, axis in enumerate("xyz"):
            found.append(
                ModelParameter(
                    f"{name}.com_{axis}", float(base.body_ipos[b, k]), "m", setter("body", name, "body_ipos", k)
                )
            )
    return found


def _together(model: Any, value: float) -> None:
    """Numbers that say only together what they change, see ``inertia.reshape_inertias``."""


def _joint_parameters(base: Any, joints: Sequence[Axis]) -> list[ModelParameter]:
    found = []
    for joint in joints:
        d = joint.dof
        rows = [
            ("damping", base.dof_damping[d], "N·m·s/rad", "dof_damping"),
            ("quadratic_damping", base.dof_dampingpoly[d, 0], "N·m·s²/rad²", "dof_dampingpoly"),
            ("armature", base.dof_armature[d], "kg·m²", "dof_armature"),
            ("frictionloss", base.dof_frictionloss[d], "N·m", "dof_frictionloss"),
            ("stiffness", base.jnt_stiffness[joint.index], "N·m/rad", "jnt_stiffness"),
            ("springref", base.qpos_spring[joint.position], "rad", "qpos_spring"),
        ]
        for key, value, unit, array in rows:
            write = setter("joint", joint.name, array, *((0,) if array == "dof_dampingpoly" else ()))
            unit_here = SLIDING.get(unit, unit) if joint.slides else unit
            found.append(ModelParameter(f"{joint.name}.{key}", float(value), unit_here, write))
    return found
