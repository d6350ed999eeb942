"""The parameters of a MuJoCo model in the order in which its equations take them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from equimus_ctrl.robots.mjcf.form import (
    FAR,
    FRICTION,
    N_COUPLING,
    N_DRIVE,
    N_FLOAT,
    N_JOINT,
    N_LINK,
    N_SURFACE,
    N_TENDON,
    N_TETHER,
    N_TOUCH,
    TENDON_FRICTION,
    TreeForm,
)
from equimus_ctrl.robots.mjcf.parts import SOLIMP, Coupling
from equimus_ctrl.robots.mjcf.reading import quaternion_matrix
from equimus_ctrl.types import Array

LEAST, MOST = 1e-4, 0.9999
"""Between these MuJoCo keeps impedances (mjMINIMP, mjMAXIMP)."""
TINY = 1e-15
SHARP = 2000.0
"""Rate of the motion at the ends of a play, critically damped [1/s]."""
Drive = tuple[float, float, float, float]
Tether = tuple[float, float, Array, Array]
"""Of a spring to a point of the room: stiffness, free length, the point in its body's frame, that in the room."""
Touch = tuple[Array, Array, float, float]
"""Of a surface in the room: the point in its body's frame that touches it, the way up, its height, how hard it is."""
USUAL = 0.02, 1.0
"""What MuJoCo takes where only one of a reference's two values is positive."""


def pack(
    form: TreeForm,
    model: Any,
    drives: Mapping[int, Drive] | None = None,
    tethers: Mapping[int, Tether] | None = None,
    touches: Mapping[int, Touch] | None = None,
    couplings: Sequence[Coupling] = (),
) -> Array:
    """(n,) the parameters of an ``mujoco.MjModel`` of a form, in the order of ``TreeForm.layout``.

    Args:
        form: of its equations.
        model: whose.
        drives: joint → inertia of a drive that turns by itself, stiffness and damping of its spring, and their play.
        tethers: body → a spring to a point of the room; one link has one at most.
        touches: body → the surface that it may touch; there is one at most.
        couplings: friction over two links.
    """
    off = form.off
    parts = [np.zeros(3) if "gravity" in off else np.array(model.opt.gravity), *_bodies(form, model)]
    parts += [_joints(form, model).ravel(), _tendons(form, model).ravel()]
    for limit in form.limits:
        own = "jnt" if limit.kind == "joint" else "tendon"
        tail = "" if limit.kind == "joint" else "_lim"
        weight = model.dof_invweight0 if limit.kind == "joint" else model.tendon_invweight0
        parts += [
            getattr(model, f"{own}_range")[limit.index],
            getattr(model, f"{own}_margin")[limit.index : limit.index + 1],
            _reference(
                getattr(model, f"{own}_solref{tail}")[limit.index], getattr(model, f"{own}_solimp{tail}")[limit.index]
            ),
            weight[limit.index : limit.index + 1],
        ]
    for e in form.equalities:
        weight = model.dof_invweight0 if e.kind == "joint" else model.tendon_invweight0
        weights = [weight[k] for k in (e.first, e.second) if k >= 0]
        parts += [model.eq_data[e.index, :5], _reference(model.eq_solref[e.index], model.eq_solimp[e.index])]
        parts += [np.array([sum(weights)])]
    parts += [_actuator(form, model, i) for i in range(len(form.actuators))]
    if form.flexible:
        parts.append(_drives(form, model, drives or {}).ravel())
    if form.tethered:
        parts.append(_tethers(form, tethers or {}).ravel())
    if form.surfaced:
        parts += _touches(form, model, touches or {})
    if form.coupled:
        parts.append(_couplings(form, couplings).ravel())
    parts += [model.jnt_actfrcrange[j] for j, _ in form.clamped]
    parts += [model.tendon_actfrcrange[t] for t in form.clamped_tendons]
    return np.concatenate(parts)


@lru_cache(maxsize=64)
def _frames(form: TreeForm) -> tuple[Any, Any, Array, Array]:
    bodies = np.array([b for b, *_ in form.bodies], dtype=np.int64)
    links = np.array([link for _, link, *_ in form.bodies], dtype=np.int64)
    places = np.array([place for *_, place, _ in form.bodies]).reshape(-1, 3)
    turns = np.array([turn for *_, turn in form.bodies]).reshape(-1, 3, 3)
    return bodies, links, places, turns


def _bodies(form: TreeForm, model: Any) -> list[Array]:
    """Mass, first moment and inertia about the link's origin, of all bodies fixed to a link together."""
    bodies, links, places, turns = _frames(form)
    mass = np.asarray(model.body_mass[bodies])
    own = np.array([quaternion_matrix(model.body_iquat[b]) for b in bodies]).reshape(-1, 3, 3)
    axes = turns @ own
    centre = places + np.einsum("bij,bj->bi", turns, model.body_ipos[bodies])
    inertia = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia[bodies], axes)
    square = (centre**2).sum(axis=1)[:, None, None] * np.eye(3) - centre[:, :, None] * centre[:, None, :]
    inertia += mass[:, None, None] * square
    six = inertia[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    rows = np.column_stack([mass, mass[:, None] * centre, six])
    whole = np.zeros((len(form.links), N_LINK))
    np.add.at(whole, links, rows)
    floats = np.zeros((len(form.links), N_FLOAT))
    np.add.at(floats, links, model.body_gravcomp[bodies][:, None] * rows[:, :N_FLOAT])
    return [whole.ravel(), floats[list(form.floats)].ravel()]


def _driven(form: TreeForm, model: Any, kind: str, n: int) -> Array:
    """(n, 4) armature and damping that actuators give to joints or tendons, see MuJoCo's ``actuator_armature``."""
    found = np.zeros((n, 4))
    for a in form.actuators:
        if a.transmission == kind:
            i = a.index
            own = [model.actuator_armature[i], model.actuator_damping[i], *model.actuator_dampingpoly[i]]
            found[a.target] += a.gear[0] ** 2 * np.array(own)
    return found


def _joints(form: TreeForm, model: Any) -> Array:
    n = len(form.links)
    rows = np.empty((n, N_JOINT))
    rows[:, 0], rows[:, 1], rows[:, 2:4] = model.dof_armature, model.dof_damping, model.dof_dampingpoly
    rows[:, :4] += _driven(form, model, "joint", n)
    rows[:, 4], rows[:, 5:7], rows[:, 7] = model.jnt_stiffness, model.jnt_stiffnesspoly, model.qpos_spring
    rows[:, FRICTION] = model.dof_frictionloss
    _switch(rows, form, FRICTION)
    return rows


def _tendons(form: TreeForm, model: Any) -> Array:
    n = len(form.tendons)
    rows = np.empty((n, N_TENDON))
    if n == 0:
        return rows
    rows[:, 0], rows[:, 1], rows[:, 2:4] = model.tendon_armature, model.tendon_damping, model.tendon_dampingpoly
    rows[:, :4] += _driven(form, model, "tendon", n)
    rows[:, 4], rows[:, 5:7], rows[:, 7:9] = (
        model.tendon_stiffness, model.tendon_stiffnesspoly, model.tendon_lengthspring
    )  # fmt: skip
    rows[:, TENDON_FRICTION] = model.tendon_frictionloss
    _switch(rows, form, TENDON_FRICTION)
    return rows


def _drives(form: TreeForm, model: Any, drives: Mapping[int, Drive]) -> Array:
    rows = np.zeros((len(form.links), N_DRIVE))
    rows[:, 1] = 1.0  # of drives that do not turn by themselves
    for joint, (inertia, stiffness, damping, play) in drives.items():
        inverse = 1 / inertia + float(model.dof_invweight0[joint])
        hard, dull = (SHARP**2 / inverse, 2 * SHARP / inverse) if play > 0 else (0.0, 0.0)
        rows[joint] = 1.0, inertia, stiffness, damping, play / 2, hard, dull, inverse
    return rows


def _tethers(form: TreeForm, tethers: Mapping[int, Tether]) -> Array:
    rows = np.zeros((len(form.links), N_TETHER))
    for body, link, place, turn in form.hooks:
        if body in tethers and "spring" not in form.off:
            stiffness, length, point, anchor = tethers[body]
            rows[link] = [stiffness, length, *(np.array(place) + np.array(turn).reshape(3, 3) @ point), *anchor]
    return rows


def _touches(form: TreeForm, model: Any, touches: Mapping[int, Touch]) -> list[Array]:
    own, rows = np.zeros(N_SURFACE), np.zeros((len(form.links), N_TOUCH))
    for body, link, place, turn in form.hooks:
        if body in touches:
            point, up, height, hard = touches[body]
            own[4:10] = _reference(np.array([hard, 1.0]), np.array(SOLIMP))
            own[:3], own[3], own[10] = up, height, model.body_invweight0[body, 0]
            rows[link] = [1.0, *(np.array(place) + np.array(turn).reshape(3, 3) @ point)]
    return [own, rows.ravel()]


def _couplings(form: TreeForm, couplings: Sequence[Coupling]) -> Array:
    rows, names = np.zeros((len(form.coupled), N_COUPLING)), [link.name for link in form.links]
    for own in couplings:
        row = rows[form.coupled.index((names.index(own.joint), names.index(own.other)))]
        if own.friction > 0 and "frictionloss" not in form.off:
            row[:2] = own.sign, own.friction
        if "damper" not in form.off:
            row[2 if own.sign > 0 else 3] = own.damping
    return rows


def _switch(rows: Array, form: TreeForm, friction: int) -> None:
    if "damper" in form.off:
        rows[:, 1:4] = 0.0
    if "spring" in form.off:
        rows[:, 4:7] = 0.0
    if "frictionloss" in form.off:
        rows[:, friction] = 0.0


def _reference(solref: Array, solimp: Array) -> Array:
    """Stiffness, damping, impedance at no violation and at the width, width, midpoint."""
    first, second = solref if (solref[0] > 0) == (solref[1] > 0) else USUAL
    least, most = np.clip(solimp[:2], LEAST, MOST)
    width, middle = max(float(solimp[2]), 0.0), float(np.clip(solimp[3], LEAST, MOST))
    if least == most or width <= TINY:
        least = most = (least + most) / 2
    wide = float(np.clip(solimp[1], LEAST, MOST))
    if first > 0:
        stiffness, damping = 1 / max(TINY, (wide * first * second) ** 2), 2 / max(TINY, wide * first)
    else:
        stiffness, damping = -first / wide**2, -second / wide
    return np.array([stiffness, damping, least, most, max(width, TINY), middle])


def _actuator(form: TreeForm, model: Any, i: int) -> Array:
    """Of a gain and a bias: three parameters each, lowest and highest force, then command.

    Of a controller or a motor: MuJoCo's gain, bias and dynamics parameters, ten each, lowest and highest force, then
    those of up to four commands.
    """
    own = form.actuators[i]
    k = own.index
    force = model.actuator_forcerange[k] if model.actuator_forcelimited[k] else (-FAR, FAR)
    bounds = np.array([commands_between(form, model, i, n) for n in range(len(own.inputs))]).reshape(-1, 2)
    # What follows a command by itself is kept between its own bounds before it gets here.
    first = 0 if own.dynamics == "none" else 1
    bounds[:first] = -FAR, FAR
    if own.law == "affine":
        bias = np.zeros(3) if int(model.actuator_biastype[k]) == 0 else model.actuator_biasprm[k, :3]
        rows = np.concatenate([model.actuator_gainprm[k, :3], bias, force, bounds[0]])
        rows[:6] *= "actuation" not in form.off
        return rows
    given = (model.actuator_gainprm[k], model.actuator_biasprm[k], model.actuator_dynprm[k])
    rows = np.concatenate([*(part[:10] for part in given), force, np.full(8, FAR)])
    rows[32 : 32 + bounds.size] = bounds.ravel()
    return rows


def commands_between(form: TreeForm, model: Any, i: int, n: int = 0) -> tuple[float, float]:
    """Between what the n-th command of an actuator is kept."""
    k = int(model.actuator_ctrladr[form.actuators[i].index]) + n
    if not form.actuators[i].inputs or not model.actuator_ctrllimited[k] or "clampctrl" in form.off:
        return -FAR, FAR
    return float(model.actuator_ctrlrange[k, 0]), float(model.actuator_ctrlrange[k, 1])
