"""Inertias of bodies that stay physically consistent whatever their parameters are.

A body's pseudo-inertia [[Σ, h], [hᵀ, m]] (Wensing, Kim & Slotine, "Linear matrix inequalities for physically
consistent inertial parameter identification", 2018) is positive definite where its mass m and the second moments Σ_c
about its centre of mass are, for Σ_c is its Schur complement. Mass and centre are numbers by themselves; Σ_c is

    Σ_c = S½ E Eᵀ S½

with S the file's own second moments along its principal axes, times the size of the inertia over the file's, and E
upper triangular with the diagonal exp(d1), exp(d2), exp(−d1 − d2) and s12, s13, s23 above it. These are the
log-Cholesky parameters of Rucker & Wensing, "Smooth parameterization of rigid-body inertia", 2022, about the centre of
mass and relative to the file's own values, with the size as a factor of its own. Any values are physically consistent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.types import Array

SHAPE = "inertia_d1", "inertia_d2", "inertia_s12", "inertia_s13", "inertia_s23"
"""Kinds of a body's parameters that say how its mass is spread about its centre; 0 as in the file."""


def reshape_inertias(model: Any, shapes: Mapping[str, Sequence[float]]) -> None:
    """Spread masses otherwise about their centres in an ``mujoco.MjModel``.

    Args:
        model: is changed.
        shapes: body → (5,) in the order of ``SHAPE``.
    """
    if not shapes:
        return
    bodies = [int(model.body(name).id) for name in shapes]
    moments = model.body_inertia[bodies]
    second = np.maximum(moments.sum(axis=1, keepdims=True) / 2 - moments, 0.0)
    d1, d2, s12, s13, s23 = np.array(list(shapes.values())).T
    none = np.zeros(len(bodies))
    rows = [[np.exp(d1), s12, s13], [none, np.exp(d2), s23], [none, none, np.exp(-d1 - d2)]]
    root = np.sqrt(second)[:, :, None] * np.moveaxis(np.array(rows), -1, 0)
    spread = root @ root.swapaxes(1, 2)
    turn = np.array([_turn(model, b) for b in bodies])
    whole = np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3) - spread
    _put(model, bodies, turn @ whole @ turn.swapaxes(1, 2))


def add_mass(model: Any, place: str, mass: float, beside: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
    """A point mass at a site or at the centre of mass of a body, or so far beside it along the body's axes [m]."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, place)
    if site >= 0:
        b, at = int(model.site_bodyid[site]), np.array(model.site_pos[site])
    else:
        b = int(model.body(place).id)
        at = np.array(model.body_ipos[b])
    at += np.array(beside)
    own, com = float(model.body_mass[b]), np.array(model.body_ipos[b])
    if mass == 0:
        return
    turn = _turn(model, b)
    middle = (own * com + mass * at) / (own + mass)
    whole = turn @ np.diag(model.body_inertia[b]) @ turn.T
    for m, arm in ((own, com - middle), (mass, at - middle)):
        whole += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    _put(model, [b], whole[None])
    model.body_mass[b], model.body_ipos[b] = own + mass, middle


def _turn(model: Any, b: int) -> Array:
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[b])
    return flat.reshape(3, 3)


def _put(model: Any, bodies: Sequence[int], central: Array) -> None:
    """Give bodies central inertias (n, 3, 3) in their own axes."""
    moments, axes = np.linalg.eigh(central)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    for b, own in zip(bodies, axes, strict=True):
        mujoco.mju_mat2Quat(model.body_iquat[b], own.ravel())
    model.body_inertia[bodies] = moments
