"""Reading the form of a MuJoCo model's equations off an ``mujoco.MjModel``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.robots.mjcf.form import (
    ActuatorForm,
    EqualityForm,
    LimitForm,
    LinkForm,
    SpotForm,
    TendonForm,
    Transmission,
    TreeForm,
)
from equimus_ctrl.robots.mjcf.frames import Frame, shortened, snapped
from equimus_ctrl.robots.mjcf.obstacles import DYNAMICS, obstacles, switched_off
from equimus_ctrl.types import Array

INPUTS = {1: "pos", 2: "vel", 4: "ff", 8: "voltage"}
"""Bits of MuJoCo's ``actuator_ctrlspec`` of pid and dcmotor."""


def next_hinges(model: Any) -> tuple[tuple[int, int], ...]:
    """Pairs of joints, hinges both, of which the second is the only one that the first carries next."""
    carried = [np.flatnonzero(model.dof_parentid == dof) for dof in range(model.nv)]
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    pairs = [(dof, int(own[0])) for dof, own in enumerate(carried) if len(own) == 1]
    joints = [(int(model.dof_jntid[first]), int(model.dof_jntid[second])) for first, second in pairs]
    return tuple(pair for pair in joints if all(int(model.jnt_type[joint]) == hinge for joint in pair))


def form_of(
    model: Any, flexible: bool = False, tethered: bool = False, surfaced: bool = False, coupled: bool = False
) -> TreeForm:
    """The form of an ``mujoco.MjModel``.

    Args:
        model: whose.
        flexible: whether drives of its joints may turn by themselves.
        tethered: whether springs to points of the room may hang on it.
        surfaced: whether a point of it may touch a level surface in the room.
        coupled: whether friction may act over two hinges that follow each other.

    Raises:
        ModelError: where it has what the equations cannot hold.
    """
    if wrong := obstacles(model):
        raise ModelError(f"the equations cannot hold {wrong[0]}")
    off = switched_off(model)
    links, frames = _links(model)
    moving = tuple(
        (b, link, snapped(place), snapped(turn)) for b, (link, place, turn) in enumerate(frames) if link >= 0
    )
    bodies = tuple(own for own in moving if model.body_mass[own[0]] > 0 or model.body_inertia[own[0]].max() > 0)
    tendons = tuple(_tendon(model, t, frames) for t in range(model.ntendon))
    limits: list[LimitForm] = []
    if "limit" not in off:
        limits += [
            LimitForm("joint", j, float(model.jnt_solimp[j, 4])) for j in range(model.njnt) if model.jnt_limited[j]
        ]
        limits += [
            LimitForm("tendon", t, float(model.tendon_solimp_lim[t, 4]))
            for t in range(model.ntendon)
            if model.tendon_limited[t]
        ]
    return TreeForm(
        links,
        bodies,
        tendons,
        tuple(limits),
        () if "equality" in off else tuple(_equalities(model)),
        tuple(_actuator(model, i, frames) for i in range(model.nactuator)),
        () if "frictionloss" in off else tuple(int(t) for t in np.flatnonzero(model.tendon_frictionloss > 0)),
        tuple((int(j), bool(model.jnt_actgravcomp[j])) for j in np.flatnonzero(model.jnt_actfrclimited)),
        tuple(int(t) for t in np.flatnonzero(model.tendon_actfrclimited)),
        tuple(sorted({link for b, link, *_ in bodies if model.body_gravcomp[b] != 0})),
        off,
        flexible,
        moving if tethered or surfaced else (),
        tethered,
        surfaced,
        next_hinges(model) if coupled else (),
    )


def quaternion_matrix(quaternion: Array) -> Array:
    """(3, 3) of a unit quaternion (4,)."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def _upright(axis: Array) -> Array:
    """(3, 3) a rotation whose third column is an axis; its entries are 0 and ±1 where that can be."""
    z = np.array(snapped(axis / np.linalg.norm(axis)))
    x = np.roll(np.eye(3)[int(np.argmax(np.abs(z)))], 1)
    x = x - z * (z @ x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _links(m: Any) -> tuple[tuple[LinkForm, ...], list[Frame]]:
    """The links, and for each body the link that it is fixed to and its frame there."""
    links: list[LinkForm] = []
    frames: list[Frame] = [(-1, np.zeros(3), np.eye(3))]
    for b in range(1, m.nbody):
        link, place, turn = frames[int(m.body_parentid[b])]
        place = place + turn @ m.body_pos[b]
        turn = turn @ quaternion_matrix(m.body_quat[b])
        for j in range(int(m.body_jntadr[b]), int(m.body_jntadr[b]) + int(m.body_jntnum[b])):
            slides = int(m.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            stand, anchor = _upright(m.jnt_axis[j]), np.zeros(3) if slides else np.array(m.jnt_pos[j])
            links.append(
                LinkForm(
                    m.joint(j).name,
                    link,
                    snapped(place + turn @ anchor),
                    snapped(turn @ stand),
                    slides,
                    float(m.qpos0[m.jnt_qposadr[j]]),
                )
            )
            link, turn = len(links) - 1, stand.T
            place = -turn @ anchor
        frames.append((link, place, turn))
    return shortened(links, frames)


def _spot(m: Any, site: int, frames: Sequence[Frame]) -> SpotForm:
    link, place, turn = frames[int(m.site_bodyid[site])]
    own = turn @ quaternion_matrix(m.site_quat[site])
    return SpotForm(link, snapped(place + turn @ m.site_pos[site]), snapped(own))


def _tendon(m: Any, t: int, frames: Sequence[Frame]) -> TendonForm:
    path = range(int(m.tendon_adr[t]), int(m.tendon_adr[t]) + int(m.tendon_num[t]))
    if int(m.wrap_type[path[0]]) == int(mujoco.mjtWrap.mjWRAP_JOINT):
        return TendonForm(m.tendon(t).name, t, joints=tuple((int(m.wrap_objid[k]), float(m.wrap_prm[k])) for k in path))
    branches: list[tuple[float, list[SpotForm]]] = [(1.0, [])]
    for k in path:
        if int(m.wrap_type[k]) == int(mujoco.mjtWrap.mjWRAP_PULLEY):
            branches.append((float(m.wrap_prm[k]), []))
        else:
            branches[-1][1].append(_spot(m, int(m.wrap_objid[k]), frames))
    return TendonForm(m.tendon(t).name, t, branches=tuple((divisor, tuple(s)) for divisor, s in branches if len(s) > 1))


def _equalities(m: Any) -> Iterator[EqualityForm]:
    for e in range(m.neq):
        if not m.eq_active0[e]:
            continue
        first, second = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
        joint = int(m.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT)
        rest = [
            0.0 if k < 0 else float(m.qpos0[m.jnt_qposadr[k]] if joint else m.tendon_length0[k])
            for k in (first, second)
        ]
        yield EqualityForm(
            "joint" if joint else "tendon", first, second, e, (rest[0], rest[1]), float(m.eq_solimp[e, 4])
        )


def _actuator(m: Any, i: int, frames: Sequence[Frame]) -> ActuatorForm:
    kinds, (first, second) = mujoco.mjtTrn, (int(k) for k in m.actuator_trnid[i])
    kind = int(m.actuator_trntype[i])
    spots: tuple[SpotForm, ...] = ()
    transmission: Transmission = "joint"
    if kind == int(kinds.mjTRN_TENDON):
        transmission = "tendon"
    elif kind == int(kinds.mjTRN_SLIDERCRANK):
        transmission, spots = "crank", (_spot(m, first, frames), _spot(m, second, frames))
    elif kind == int(kinds.mjTRN_SITE):
        transmission = "site" if second < 0 else "between"
        spots = tuple(_spot(m, k, frames) for k in (first, second) if k >= 0)
    law: Literal["affine", "pid", "dcmotor"] = "affine"
    gain, spec = int(m.actuator_gaintype[i]), int(m.actuator_ctrlspec[i])
    inputs: tuple[str, ...] = ("command",)
    states: tuple[str, ...] = ()
    own = m.actuator_dynprm[i]
    dynamics = DYNAMICS[mujoco.mjtDyn(int(m.actuator_dyntype[i]))]
    if gain in (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR)):
        law = "pid" if gain == int(mujoco.mjtGain.mjGAIN_PID) else "dcmotor"
        inputs = tuple(name for bit, name in INPUTS.items() if spec & bit)
        integral = m.actuator_gainprm[i, 0 if law == "pid" else 5] > 0
        slewed = own[1 if law == "pid" else 7] > 0
        dynamics = "slew" if slewed and inputs else "none"
        further = (("temperature", own[2] > 0), ("bristle", own[5] > 0), ("current", own[0] > 0))
        states = ("integral",) if integral else ()
        states += tuple(name for name, there in further if there) if law == "dcmotor" else ()
    return ActuatorForm(
        m.actuator(i).name,
        i,
        transmission,
        first,
        spots,
        tuple(float(g) for g in m.actuator_gear[int(m.actuator_outadr[i])]),
        float(m.actuator_cranklength[i]),
        gain == int(mujoco.mjtGain.mjGAIN_AFFINE),
        dynamics,
        bool(m.actuator_actlimited[i]),
        law,
        int(m.actuator_ctrladr[i]),
        inputs,
        states,
        law == "dcmotor" and bool(m.actuator_gainprm[i, 7] > 0),
    )
