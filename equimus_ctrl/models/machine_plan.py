"""What a MuJoCo XML says of a machine: its joints, its actuators, and every number that can be changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.types import Array

FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Dynamics of actuators that commands alone tell the state of."""
SLIDING = {
    "rad": "m", "rad/s": "m/s", "N·m": "N", "N·m/rad": "N/m", "N·m·s/rad": "N·s/m", "N·m·s²/rad²": "N·s²/m²",
    "kg·m²": "kg",
}  # fmt: skip
"""Units of a hinge → those of a slide."""


Write = Callable[[Any, float], None]


@dataclass(frozen=True)
class Number:
    """One number of a machine.

    Attributes:
        name: dotted.
        value: in the file.
        unit: SI.
        write: sets it in an ``mujoco.MjModel``.
    """

    name: str
    value: float
    unit: str
    write: Write

    @property
    def kind(self) -> str:
        """What follows the dot."""
        return self.name.rpartition(".")[2]


@dataclass(frozen=True)
class Axis:
    """One joint of a machine.

    Attributes:
        name: its name.
        index: of the joint in MuJoCo's model.
        position: its place in qpos.
        dof: its place in qvel.
        slides: whether it is a slide, else a hinge.
        range: its ends [rad or m]; ±inf where it has none.
    """

    name: str
    index: int
    position: int
    dof: int
    slides: bool
    range: tuple[float, float]


@dataclass(frozen=True)
class Drive:
    """One actuator of a machine.

    Attributes:
        name: its name.
        index: of the actuator in MuJoCo's model.
        joint: name of the joint it drives.
        servo: whether its force depends on where its joint is, so that its command is a goal.
        unit: of its command.
        range: of its commands.
        state: place of what it follows its command with, a first-order filter's value, among MuJoCo's activations; None
            where it follows at once.
    """

    name: str
    index: int
    joint: str
    servo: bool
    unit: str
    range: tuple[float, float]
    state: int | None = None


@dataclass(frozen=True)
class Assets:
    """Files by name, compared by what they are, so that plans can be kept."""

    files: Mapping[str, bytes]

    def __hash__(self) -> int:
        return hash(tuple(sorted(self.files)))


@dataclass(frozen=True, eq=False)
class Plan:
    """What a file says of a machine.

    Attributes:
        base: MuJoCo's model of it, not to be changed.
        joints: all of them.
        drives: all actuators.
        bodies: names of those that move.
        sites: names of those that move.
        numbers: dotted name → number.
        tilt_axis: (3,) about which gravity can be turned.
        weights: joint → inertia that it moves by itself, where the file has it [kg·m² or kg].
    """

    base: Any
    joints: tuple[Axis, ...]
    drives: tuple[Drive, ...]
    bodies: tuple[str, ...]
    sites: tuple[str, ...]
    numbers: Mapping[str, Number]
    tilt_axis: Array
    weights: Mapping[str, float]


def _compiled(xml: str, assets: Assets, name: str) -> Any:
    try:
        return spec_of(xml, assets).compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ModelError(f"{name}: MuJoCo cannot load it ({reason})") from None


def spec_of(xml: str, assets: Assets) -> Any:
    """MuJoCo's specification of a file."""
    spec = mujoco.MjSpec.from_string(xml, assets=dict(assets.files))
    for body in spec.bodies:
        body.simple = False  # what is balanced now may be unbalanced by a payload
    return spec


@lru_cache(maxsize=32)
def plan_of(name: str, xml: str, assets: Assets) -> Plan:
    """What a file says.

    Raises:
        ModelError: where MuJoCo cannot load it, or it is no machine of hinges and slides.
    """
    base = _compiled(xml, assets, name)
    joints = _joints(base, name)
    drives = _drives(base, name, joints)
    moves = [b for b in range(1, base.nbody) if base.body_dofnum[b] or base.body_weldid[b]]
    bodies = tuple(n for b in moves if (n := base.body(b).name) and base.body_mass[b] > 0)
    sites = tuple(
        s.name for s in (base.site(i) for i in range(base.nsite)) if s.name and base.site_bodyid[s.id] in moves
    )
    axis = _tilt_axis(base)
    numbers = [*_body_numbers(base, bodies), *_joint_numbers(base, joints), *_drive_numbers(base, drives)]
    size = float(np.linalg.norm(base.opt.gravity))
    down = np.array(base.opt.gravity)

    def turned(model: Any, angle: float) -> None:
        across = np.cross(axis, down) / max(size, 1e-300)
        now = float(np.linalg.norm(model.opt.gravity))
        model.opt.gravity[:] = now * (math.cos(angle) * down / max(size, 1e-300) + math.sin(angle) * across)

    def heavy(model: Any, value: float) -> None:
        model.opt.gravity[:] *= value / max(float(np.linalg.norm(model.opt.gravity)), 1e-300)

    if size > 0:
        numbers += [Number("gravity", size, "m/s²", heavy)]
    numbers += [Number("tilt", 0.0, "rad", turned)]
    return Plan(base, joints, drives, bodies, sites, {n.name: n for n in numbers}, axis, _weights(base, joints))


def _joints(base: Any, name: str) -> tuple[Axis, ...]:
    kinds = mujoco.mjtJoint
    found = []
    for i in range(base.njnt):
        joint, kind = base.joint(i), int(base.jnt_type[i])
        if kind not in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
            what = "free" if kind == int(kinds.mjJNT_FREE) else "ball"
            raise ModelError(
                f"{name}: joint {joint.name or i!r} is a {what} joint, expected hinges and slides alone: the base has "
                "to be fixed"
            )
        if not joint.name:
            raise ModelError(f"{name}: joint {i} has no name, by which a recording's columns could be told")
        limited = bool(base.jnt_limited[i])
        low, high = (float(v) for v in base.jnt_range[i]) if limited else (-math.inf, math.inf)
        slides = kind == int(kinds.mjJNT_SLIDE)
        found.append(Axis(joint.name, i, int(base.jnt_qposadr[i]), int(base.jnt_dofadr[i]), slides, (low, high)))
    if not found:
        raise ModelError(f"{name}: has no joint")
    return tuple(found)


def _drives(base: Any, name: str, joints: Sequence[Axis]) -> tuple[Drive, ...]:
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    found = []
    for i in range(base.nu):
        actuator = base.actuator(i)
        told = f"{name}: actuator {actuator.name or i!r}"
        if not actuator.name:
            raise ModelError(f"{told} has no name, by which a recording's columns could be told")
        if int(base.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            raise ModelError(f"{told} does not drive a joint, expected motor, position or general actuators at joints")
        dynamics = int(base.actuator_dyntype[i])
        if dynamics not in (int(mujoco.mjtDyn.mjDYN_NONE), *FILTERS):
            raise ModelError(
                f"{told} has a state that recordings do not tell (dyntype), expected none or a first-order filter of "
                "its command (filter, filterexact)"
            )
        holds = int(base.actuator_history[i, 0]) * float(base.opt.timestep)
        if base.actuator_delay[i] > holds * (1 + 1e-9):
            raise ModelError(
                f"{told} has a delay of {base.actuator_delay[i]:g} s, and a buffer (nsample) that holds {holds:g} s of "
                "commands, expected as much as the delay at least"
            )
        gain, kind = int(base.actuator_gaintype[i]), int(base.actuator_biastype[i])
        if gain != int(gains.mjGAIN_FIXED) or kind not in (int(biases.mjBIAS_NONE), int(biases.mjBIAS_AFFINE)):
            raise ModelError(
                f"{told} is neither a motor nor a servo: expected a fixed gain and no bias or an affine one"
            )
        axis = next(a for a in joints if a.index == int(base.actuator_trnid[i, 0]))
        bias = base.actuator_biasprm[i]
        affine = kind == int(biases.mjBIAS_AFFINE)
        servo = bool(affine and bias[1] != 0)
        place, push = ("m", "N") if axis.slides else ("rad", "N·m")
        unit = place if servo else push if not affine and base.actuator_gainprm[i, 0] == 1 else "1"
        if affine and not servo and bias[2] != 0:
            unit = f"{place}/s"
        limited = bool(base.actuator_ctrllimited[i])
        low, high = (float(v) for v in base.actuator_ctrlrange[i]) if limited else (-math.inf, math.inf)
        state = int(base.actuator_actadr[i]) if dynamics in FILTERS else None
        found.append(Drive(actuator.name, i, axis.name, servo, unit, (low, high), state))
    if not found:
        raise ModelError(f"{name}: has no actuator")
    return tuple(found)


def _weights(base: Any, joints: Sequence[Axis]) -> dict[str, float]:
    data = mujoco.MjData(base)
    mujoco.mj_forward(base, data)
    whole = np.zeros((base.nv, base.nv))
    mujoco.mj_fullM(base, data, whole)
    return {joint.name: float(whole[joint.dof, joint.dof]) for joint in joints}


def _tilt_axis(base: Any) -> Array:
    """A horizontal axis about which turning gravity matters to the first joint for which it does."""
    data = mujoco.MjData(base)
    mujoco.mj_kinematics(base, data)
    down = np.array(base.opt.gravity)
    size = np.linalg.norm(down)
    if size > 0:
        down /= size
        for i in range(base.njnt):
            own = data.xaxis[i]
            slides = int(base.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            axis = np.cross(down, own) if slides else own - down * (down @ own)
            if np.linalg.norm(axis) > 0.1:
                return np.asarray(axis / np.linalg.norm(axis))
    return np.array([0.0, 1.0, 0.0])


def _setter(kind: str, name: str, array: str, *entry: int) -> Write:
    """Sets one entry of an array; by name, for models with rotors have other indices."""

    def write(model: Any, value: float) -> None:
        getattr(model, array)[(_index(model, kind, name, array), *entry)] = value

    return write


def _index(model: Any, kind: str, name: str, array: str) -> int:
    part = getattr(model, kind)(name)
    if array.startswith("dof_"):
        return int(part.dofadr[0])
    return int(part.qposadr[0]) if array.startswith("qpos_") else int(part.id)


def _body_numbers(base: Any, bodies: Sequence[str]) -> list[Number]:
    found = []
    for name in bodies:
        b = base.body(name).id
        found.append(Number(f"{name}.mass", float(base.body_mass[b]), "kg", _setter("body", name, "body_mass")))
        moments = np.array(base.body_inertia[b])
        share = moments / max(float(moments.max()), 1e-300)

        def inertia(model: Any, value: float, name: str = name, shape: Array = share) -> None:
            model.body_inertia[model.body(name).id] = value * shape

        if moments.max() > 0:
            found.append(Number(f"{name}.inertia", float(moments.max()), "kg·m²", inertia))
        for k, axis in enumerate("xyz"):
            found.append(
                Number(f"{name}.com_{axis}", float(base.body_ipos[b, k]), "m", _setter("body", name, "body_ipos", k))
            )
    return found


def _joint_numbers(base: Any, joints: Sequence[Axis]) -> list[Number]:
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
            write = _setter("joint", joint.name, array, *((0,) if array == "dof_dampingpoly" else ()))
            told = SLIDING.get(unit, unit) if joint.slides else unit
            found.append(Number(f"{joint.name}.{key}", float(value), told, write))
    return found


def _drive_numbers(base: Any, drives: Sequence[Drive]) -> list[Number]:
    found = []
    for drive in drives:
        i = drive.index
        gain, bias = float(base.actuator_gainprm[i, 0]), base.actuator_biasprm[i]
        slides = int(base.jnt_type[int(base.actuator_trnid[i, 0])]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        push, place = ("N", "m") if slides else ("N·m", "rad")
        if drive.servo and math.isclose(float(bias[1]), -gain):

            def stiff(model: Any, value: float, name: str = drive.name) -> None:
                k = model.actuator(name).id
                model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 1] = value, -value

            found.append(Number(f"{drive.name}.kp", gain, f"{push}/{place}", stiff))
        elif not drive.servo and bias[2] != 0 and math.isclose(float(bias[2]), -gain):

            def follows(model: Any, value: float, name: str = drive.name) -> None:
                k = model.actuator(name).id
                model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 2] = value, -value

            found.append(Number(f"{drive.name}.kv", gain, f"{push}·s/{place}", follows))
        else:
            unit = f"{push}/{drive.unit}" if drive.unit not in ("1", push) else "1" if drive.unit == push else push
            found.append(
                Number(f"{drive.name}.gain", gain, unit, _setter("actuator", drive.name, "actuator_gainprm", 0))
            )
        if f"{drive.name}.kv" not in {n.name for n in found} and (bias[2] != 0 or drive.servo):

            def damped(model: Any, value: float, name: str = drive.name) -> None:
                model.actuator_biasprm[model.actuator(name).id, 2] = -value

            found.append(Number(f"{drive.name}.kv", -float(bias[2]), f"{push}·s/{place}", damped))
        if drive.state is not None:
            write = _setter("actuator", drive.name, "actuator_dynprm", 0)
            found.append(Number(f"{drive.name}.time_constant", float(base.actuator_dynprm[i, 0]), "s", write))
        if base.actuator_delay[i] > 0:
            write = _setter("actuator", drive.name, "actuator_delay")
            found.append(Number(f"{drive.name}.delay", float(base.actuator_delay[i]), "s", write))
        if base.actuator_forcelimited[i] and math.isclose(*np.abs(base.actuator_forcerange[i])):

            def limit(model: Any, value: float, name: str = drive.name) -> None:
                model.actuator_forcerange[model.actuator(name).id] = -value, value

            found.append(Number(f"{drive.name}.force_limit", float(base.actuator_forcerange[i, 1]), push, limit))
    return found
