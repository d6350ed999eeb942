"""Laws put into fields of a ``mujoco.MjModel`` that has them: a spring of a joint, a constant force of a drive."""

from __future__ import annotations

from typing import Any


def add_spring(model: Any, joint: str, stiffness: float, rest: float) -> bool:
    """Add −stiffness·(x − rest) to a joint's own spring; whether it has one that can take it.

    Two springs −k₁(x − r₁) − k₂(x − r₂) are one, of stiffness k₁ + k₂ at rest at (k₁r₁ + k₂r₂)/(k₁ + k₂). Not where
    springs are switched off, where the joint's own is no straight line about another place, or where it yields.

    Args:
        model: a ``mujoco.MjModel``, changed in place.
        joint: its name, a hinge or a slide.
        stiffness: of the spring [N·m/rad or N/m].
        rest: where it exerts nothing [rad or m].
    """
    import mujoco

    own = model.joint(joint)
    place, j = int(own.qposadr[0]), own.id
    curved = model.jnt_stiffnesspoly[j].any() and model.qpos_spring[place] != rest
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_SPRING)
    if off or curved or model.jnt_springyield[j] > 0:
        return False
    before = float(model.jnt_stiffness[j])
    if stiffness > 0:
        both = before + stiffness
        model.qpos_spring[place] = (before * float(model.qpos_spring[place]) + stiffness * rest) / both
        model.jnt_stiffness[j] = both
    return True


def add_constant_force(model: Any, joint: str, force: float) -> bool:
    """Add a constant force to the bias of a drive at a joint; whether there is one that can take it.

    The bias b₀ of a drive with gear g exerts g·b₀ whatever its command; limits of the drive's force move along with it,
    for the constant is not the drive's. Not where the joint limits what reaches it, nor at a drive with a law of its
    own.

    Args:
        model: a ``mujoco.MjModel``, changed in place.
        joint: its name, a hinge or a slide.
        force: along it [N·m or N].
    """
    import mujoco

    j = model.joint(joint).id
    if int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION) or model.jnt_actfrclimited[j]:
        return False
    at_joints = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)  # one and the same for these
    gains = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
    none, affine = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
    for a in range(model.nactuator):
        here = int(model.actuator_trntype[a]) in at_joints and int(model.actuator_trnid[a, 0]) == j
        plain = int(model.actuator_gaintype[a]) in gains and int(model.actuator_biastype[a]) in (none, affine)
        gear = float(model.actuator_gear[a, 0])
        switched_off = int(model.opt.disableactuator) >> int(model.actuator_group[a]) & 1
        if not here or not plain or not gear or switched_off:
            continue
        if int(model.actuator_biastype[a]) == none:
            model.actuator_biasprm[a] = 0.0
            model.actuator_biastype[a] = affine
        model.actuator_biasprm[a, 0] += force / gear
        if model.actuator_forcelimited[a]:
            model.actuator_forcerange[a] += force / gear
        return True
    return False
