"""Bodies that only joints of prescribed motion move, or none: what acts between them changes nothing and has to go.

MuJoCo's constraints are laws of accelerations: where all that they could move has a very large inertia, their forces
are as large, and the acceleration that they ask for takes the place of the one that is prescribed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.actuators import AWAY


def moved_bodies(model: Any, dofs: Iterable[int]) -> list[int]:
    """The bodies that some degrees of freedom of an ``MjModel`` move, by themselves or along with others."""
    moved: list[int] = []
    own = set(dofs)
    for b in range(1, model.nbody):
        first = int(model.body_dofadr[b])
        if own & set(range(first, first + int(model.body_dofnum[b]))) or int(model.body_parentid[b]) in moved:
            moved.append(b)
    return moved


def held_tendons(model: Any, joints: Sequence[str]) -> set[int]:
    """The tendons of an ``MjModel`` whose lengths hang on some joints alone."""
    data = mujoco.MjData(model)
    data.qpos[:] += AWAY
    mujoco.mj_forward(model, data)
    slopes = np.zeros((model.ntendon, model.nv))
    if model.ntendon:
        mujoco.mju_sparse2dense(slopes, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
    own = [int(model.joint(name).dofadr[0]) for name in joints]
    there, elsewhere = np.abs(slopes[:, own]).sum(axis=1), np.abs(np.delete(slopes, own, axis=1)).sum(axis=1)
    return set(np.flatnonzero((there > 0) & (elsewhere == 0)).tolist())


def loosen_held(spec: Any, joints: Sequence[str]) -> None:
    """Take what holds some joints of a specification, of hinges and slides alone, against each other or the room.

    Contacts and equalities between bodies that no other joint moves, and ends of tendons over these joints alone.

    Args:
        spec: MuJoCo's, changed.
        joints: names of those whose motion is prescribed.
    """
    model = spec.compile()
    own = {int(model.joint(name).dofadr[0]) for name in joints}
    held = set(range(model.nbody)) - set(moved_bodies(model, set(range(model.nv)) - own))
    tendons = held_tendons(model, joints)
    for equality in [e for e in spec.equalities if _is_held(model, e.id, held, own, tendons)]:
        spec.delete(equality)
    for tendon in spec.tendons:
        if tendon.id in tendons:
            tendon.limited, tendon.frictionloss = mujoco.mjtLimited.mjLIMITED_FALSE, 0.0
    for pair in list(spec.pairs):
        if {int(model.geom_bodyid[g[pair.id]]) for g in (model.pair_geom1, model.pair_geom2)} <= held:
            spec.delete(pair)
    _exclude_contacts(spec, model, held & {0, *(b for b in range(model.nbody) if model.body_geomnum[b])})


def _is_held(model: Any, index: int, held: set[int], own: set[int], tendons: set[int]) -> bool:
    """Whether an equality is between held bodies, joints (by their degrees of freedom) or tendons alone."""
    kinds = mujoco.mjtEq
    ends = [int(model.eq_obj1id[index]), int(model.eq_obj2id[index])]
    kind = int(model.eq_type[index])
    if kind == int(kinds.mjEQ_JOINT):
        return {int(model.jnt_dofadr[k]) for k in ends if k >= 0} <= own
    if kind == int(kinds.mjEQ_TENDON):
        return {k for k in ends if k >= 0} <= tendons
    if kind not in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
        return False
    if int(model.eq_objtype[index]) == int(mujoco.mjtObj.mjOBJ_SITE):
        ends = [int(model.site_bodyid[k]) for k in ends]
    return set(ends) <= held


def _exclude_contacts(spec: Any, model: Any, bodies: set[int]) -> None:
    """Let some bodies not touch each other; those without a name get one."""
    known = {own.name for own in spec.bodies}
    for body in spec.bodies:
        if body.id in bodies and not body.name:
            body.name = next(
                n for k in range(len(known) + 1) if (n := f"held {body.id + k * model.nbody}") not in known
            )
            known.add(body.name)
    names = {body.id: body.name for body in spec.bodies}
    there = {frozenset((own.bodyname1, own.bodyname2)) for own in spec.excludes}
    for pair in combinations(sorted(bodies), 2):
        first, second = (names[b] for b in pair)
        fixed = [model.body_weldid[b] == 0 for b in pair]
        if not all(fixed) and frozenset((first, second)) not in there:
            spec.add_exclude(bodyname1=first, bodyname2=second)
