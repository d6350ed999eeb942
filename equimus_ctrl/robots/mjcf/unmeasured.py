"""Joints that no column of a recording tells of, and that move by themselves: passive, or tied to others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.robots.mjcf.actuators import moments_away
from equimus_ctrl.robots.mjcf.entries import Axis, Tie
from equimus_ctrl.types import Array


def ties_of(base: Any, name: str, joints: Sequence[str], unmeasured: Sequence[Axis]) -> list[tuple[Axis, Tie | None]]:
    """Unmeasured joints, those that begin anywhere first, then those that a tie puts where others are, in that order.

    Args:
        base: MuJoCo's model.
        name: of the robot, for messages.
        joints: names of those whose motion is known: measured, or prescribed.
        unmeasured: the others.

    Raises:
        ModelError: for joints that are tied in a ring, or against the direction of a tie that is no line.
    """
    own, left = {axis.name: axis for axis in unmeasured}, dict[str, Tie]()
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for e in range(base.neq) if not base.opt.disableflags & off else ():
        if base.eq_active0[e] and int(base.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            for follower, tie in _both_ways(base, name, e, own):
                left.setdefault(follower, tie)
    found: list[tuple[Axis, Tie | None]] = [(axis, None) for axis in unmeasured if axis.name not in left]
    known = {*joints, *(axis.name for axis, _ in found)}
    while left:
        ready = [follower for follower, tie in left.items() if tie.leader is None or tie.leader in known]
        if not ready:
            raise ModelError(f"{name}: unmeasured joints {', '.join(left)} are tied to each other alone")
        found += [(own[follower], left.pop(follower)) for follower in ready]
        known |= set(ready)
    return found


def _both_ways(base: Any, name: str, index: int, own: dict[str, Axis]) -> list[tuple[str, Tie]]:
    """The unmeasured joint that follows another by an equality, as the file has it or the other way round."""
    first, second = int(base.eq_obj1id[index]), int(base.eq_obj2id[index])
    names = [base.joint(k).name if k >= 0 else None for k in (first, second)]
    zeros = [float(base.qpos0[base.jnt_qposadr[k]]) if k >= 0 else 0.0 for k in (first, second)]
    along = [float(c) for c in base.eq_data[index, :5]]
    if names[1] is None:
        return [(str(names[0]), Tie(None, (zeros[0], 0.0), (along[0],)))] if names[0] in own else []
    if names[0] in own:
        return [(str(names[0]), Tie(names[1], (zeros[0], zeros[1]), tuple(along)))]
    if names[1] not in own:
        return []
    if any(along[2:]) or not along[1]:
        raise ModelError(
            f"{name}: the equality of {names[0]} and {names[1]} has the polynomial {along} in {names[1]}, which is not "
            f"measured; expected a line, or the equality the other way round"
        )
    back = (-along[0] / along[1], 1.0 / along[1])
    return [(str(names[1]), Tie(names[0], (zeros[1], zeros[0]), back))]


def tied(
    unmeasured: Sequence[tuple[Axis, Tie | None]], names: Sequence[str], position: Array, velocity: Array, beside: Array
) -> tuple[Array, Array]:
    """Positions and rates (…, n + nu) of joints with those of unmeasured ones behind them.

    Args:
        unmeasured: see ``ties_of``.
        names: of the others.
        position: (…, n) theirs [rad or m].
        velocity: (…, n) [rad/s or m/s].
        beside: (…, 2 nl) positions and rates of unmeasured joints without a tie.
    """
    loose, order = np.asarray(beside).shape[-1] // 2, list(names)
    q, v = [position, beside[..., :loose]], [velocity, beside[..., loose:]]
    whole, rates = (np.concatenate(parts, axis=-1) for parts in (q, v))
    order += [axis.name for axis, tie in unmeasured if tie is None]
    for axis, tie in unmeasured:
        if tie is None:
            continue
        leader = 0 if tie.leader is None else order.index(tie.leader)
        own, rate = tie.follow(whole[..., leader], rates[..., leader])
        whole, rates = (np.concatenate([all_, one[..., None]], axis=-1) for all_, one in ((whole, own), (rates, rate)))
        order.append(axis.name)
    return whole, rates


def check_drives(base: Any, name: str, joints: Sequence[Axis], but: Sequence[str]) -> None:
    """Raise ModelError for an actuator, but for some, that acts on none of the measured joints."""
    acts = np.abs(moments_away(base)[:, [axis.dof for axis in joints]]).sum(axis=1)
    for i in range(base.nactuator):
        if not acts[int(base.actuator_outadr[i])] and (own := base.actuator(i).name) not in but:
            raise ModelError(
                f"{name}: actuator {own!r} acts on no joint that is measured, expected none on unmeasured joints "
                "alone; one that was not recorded is left out by --ignore"
            )
