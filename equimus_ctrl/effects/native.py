"""Laws written into what MuJoCo has of its own: fields of joints, tendons and actuators, and passive devices.

A passive device is MuJoCo's ``dcmotor`` without a command (``input="none"``). It exerts, along a joint or a tendon, a
cogging torque, the friction of the LuGre model, or, its terminals shorted, what a spring and a damper in series exert:
with torque constant K, resistance R and inductance L its current i follows L·di/dt = −R·i − K·v, and its force K·i is
that of a spring K²/L in series with a damper K²/R (MuJoCo, *XML reference*, ``actuator/dcmotor``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

HARD = 0.9999
"""Impedance of dry friction: what a rubbing joint at rest creeps is this near to nothing."""
GROUPS = range(31)
"""Of actuators, that can be switched off; those of others never are."""
LIMITED = "the file limits what drives exert on the joint, and what is written would count as one of them"
OFF = "the file switches actuators off, and what is written would be one of them"


@dataclass
class Draft:
    """A model that is to become MuJoCo's XML, with the numbers that effects are written into.

    Attributes:
        model: a ``mujoco.MjModel``, changed by effects.
        edits: what is done to the ``mujoco.MjSpec`` with these numbers in it, in turn.
        lost: actuator → what a dead zone takes from its commands, by the limits of its force; so nothing with a memory
            may stand between both.
    """

    model: Any
    edits: list[Callable[[Any], None]] = field(default_factory=list)
    lost: dict[str, float] = field(default_factory=dict)

    def joint(self, place: str) -> int | None:
        """Index of a joint; None of an actuator with a length of its own."""
        import mujoco

        found = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, place)
        return None if found < 0 else int(found)

    def tendon(self, actuator: str) -> int:
        """Index of the tendon whose length is an actuator's own."""
        return int(self.model.actuator(actuator).trnid[0])


def switched_off(model: Any, group: int) -> bool:
    """Whether an ``MjModel`` has the actuators of a group switched off: of no group beyond ``GROUPS``, as MuJoCo."""
    return group in GROUPS and bool(int(model.opt.disableactuator) >> group & 1)


def unused(wanted: str, elements: Iterable[Any]) -> str:
    """A name that none of an ``MjSpec``'s elements has: as wanted, or with the next free number."""
    taken = {own.name for own in elements}
    return next(w for k in count(1) if (w := wanted if k == 1 else f"{wanted} {k}") not in taken)


def harden(model: Any, dof: int) -> None:
    """Make dry friction at a degree of freedom stop it within a step, not within MuJoCo's usual tenths of seconds."""
    model.dof_solref[dof] = -1.0, -1.0 / model.opt.timestep
    model.dof_solimp[dof] = HARD, HARD, 1e-3, 0.5, 2.0


def add_friction(draft: Draft, place: str, size: float) -> None:
    """Add dry friction to a joint's own, or along an actuator's length; it holds what it stops.

    Args:
        draft: changed in place.
        place: a joint or an actuator with a length of its own.
        size: [N·m or N].
    """
    model, joint = draft.model, draft.joint(place)
    if joint is None:
        tendon = draft.tendon(place)
        model.tendon_frictionloss[tendon] += size
        model.tendon_solref_fri[tendon] = -1.0, -1.0 / model.opt.timestep
        model.tendon_solimp_fri[tendon] = HARD, HARD, 1e-3, 0.5, 2.0
        return
    dof = int(model.jnt_dofadr[joint])
    model.dof_frictionloss[dof] += size
    harden(model, dof)


def add_spring(draft: Draft, joint: str, stiffness: float, rest: float) -> str:
    """Add −stiffness·(x − rest) to a joint's own spring; why it cannot take it, where it cannot.

    Two springs −k₁(x − r₁) − k₂(x − r₂) are one, of stiffness k₁ + k₂ at rest at (k₁r₁ + k₂r₂)/(k₁ + k₂). Not where
    springs are switched off, where the joint's own is no straight line about another place, or where it yields.

    Args:
        draft: changed in place.
        joint: its name, a hinge or a slide.
        stiffness: of the spring [N·m/rad or N/m].
        rest: where it exerts nothing [rad or m].
    """
    import mujoco

    model = draft.model
    own = model.joint(joint)
    place, j = int(own.qposadr[0]), own.id
    if int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_SPRING):
        return "the file switches springs off"
    if model.jnt_stiffnesspoly[j].any() and model.qpos_spring[place] != rest:
        return "the joint has a nonlinear spring about another place"
    if model.jnt_springyield[j] > 0:
        return "the joint has a spring that yields"
    before = float(model.jnt_stiffness[j])
    if stiffness > 0:
        both = before + stiffness
        model.qpos_spring[place] = (before * float(model.qpos_spring[place]) + stiffness * rest) / both
        model.jnt_stiffness[j] = both
    return ""


def add_cubic_spring(draft: Draft, actuator: str, cubic: float, centre: float) -> str:
    """Give the length of an actuator a spring −cubic·(x − centre)³; why it cannot take it, where it cannot.

    Args:
        draft: changed in place.
        actuator: with a length of its own, which has no other spring in MuJoCo's tendon.
        cubic: [N/m³].
        centre: [m].
    """
    model, tendon = draft.model, draft.tendon(actuator)
    if model.tendon_stiffness[tendon] or model.tendon_stiffnesspoly[tendon].any():
        return "its length has a spring already"
    model.tendon_stiffnesspoly[tendon] = 0.0, cubic
    model.tendon_lengthspring[tendon] = centre
    return ""


def add_constant_force(draft: Draft, joint: str, force: float, name: str) -> str:
    """Add a constant force to a joint; why it cannot take it, where it cannot.

    It goes to the bias of a drive at the joint where there is one that can take it: the bias b₀ of a drive with gear g
    exerts g·b₀ whatever its command; limits of the drive's force move along with it, for the constant is not the
    drive's. Else it is a passive device, its cogging torque of no period.

    Args:
        draft: changed in place.
        joint: its name, a hinge or a slide.
        force: along it [N·m or N].
        name: of the effect, for the device.
    """
    import mujoco

    model = draft.model
    if told := _undriven(draft, joint):
        return told
    j = model.joint(joint).id
    at_joints = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)  # one and the same for these
    gains = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
    none, affine = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
    for a in range(model.nactuator):
        here = int(model.actuator_trntype[a]) in at_joints and int(model.actuator_trnid[a, 0]) == j
        plain = int(model.actuator_gaintype[a]) in gains and int(model.actuator_biastype[a]) in (none, affine)
        gear = float(model.actuator_gear[a, 0])
        if not here or not plain or not gear or switched_off(model, int(model.actuator_group[a])):
            continue
        if int(model.actuator_biastype[a]) == none:
            model.actuator_biasprm[a] = 0.0
            model.actuator_biastype[a] = affine
        model.actuator_biasprm[a, 0] += force / gear
        if model.actuator_forcelimited[a]:
            model.actuator_forcerange[a] += force / gear
        return ""
    return add_device(draft, joint, name, cogging=(abs(force), 0.0, math.copysign(math.pi / 2, force)))


def add_ripple(draft: Draft, joint: str, sine: float, cosine: float, period: float, name: str) -> str:
    """Give a joint sine·sin(2π·x/period) + cosine·cos(2π·x/period), see ``add_device``."""
    size, phase = math.hypot(sine, cosine), math.atan2(cosine, sine)
    return add_device(draft, joint, name, cogging=(size, 2 * math.pi / period, phase))


def add_presliding_friction(draft: Draft, place: str, size: float, way: float, name: str) -> str:
    """Give a place −size·z, dz/dt = (rate − |rate|·z)/way, see ``add_device``.

    That is the LuGre model (Canudas de Wit, Olsson, Åström & Lischinsky, "A new model for control of systems with
    friction", 1995) with a bristle size/way stiff and undamped, as strong at rest as while it slides.
    """
    return add_device(draft, place, name, lugre=(size / way, 0.0, size, size, 0.0)) if size else ""


def add_relaxing_spring(draft: Draft, place: str, stiffness: float, time_constant: float, name: str) -> str:
    """Give a place a spring in series with a damper of stiffness·time_constant, free of force at first.

    See ``add_device``.
    """
    if not stiffness:
        return ""
    resistance = 1.0 / (stiffness * time_constant)
    return add_device(draft, place, name, constant=1.0, resistance=resistance, lag=time_constant)


def add_device(
    draft: Draft,
    place: str,
    name: str,
    *,
    constant: float = 0.0,
    resistance: float = 1.0,
    lag: float = 0.0,
    cogging: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lugre: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> str:
    """Put a passive device along a joint or an actuator's length; why it cannot be there, where it cannot.

    Args:
        draft: changed in place.
        place: a joint or an actuator with a length of its own.
        name: of the device, behind that of its place.
        constant: torque constant [N·m/A or N/A]; 0 where nothing turns into a current.
        resistance: [Ω].
        lag: inductance over resistance [s].
        cogging: amplitude [N·m or N], waves [1/rad or 1/m] and phase [rad].
        lugre: stiffness and damping of the bristle, sliding and static friction, Stribeck velocity.
    """
    import mujoco

    if told := _undriven(draft, place):
        return told
    model, joint = draft.model, draft.joint(place)
    none = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
    kind = mujoco.mjtTrn.mjTRN_TENDON if joint is None else mujoco.mjtTrn.mjTRN_JOINT
    target = model.tendon(draft.tendon(place)).name if joint is None else place
    group = next(g for g in range(len(GROUPS) + 1) if not switched_off(model, g))

    def put(spec: Any) -> None:
        own = spec.add_actuator(
            name=unused(f"{place} {name}", spec.actuators), trntype=kind, target=target, group=group
        )
        # Nothing of the file's defaults for actuators is to describe it.
        own.gear, own.damping, own.armature = [1.0, *[0.0] * 5], [0.0] * 3, 0.0
        own.ctrllimited = own.forcelimited = own.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        own.ctrlrange, own.forcerange, own.actrange = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        own.delay, own.nsample, own.interp = 0.0, 0, 0
        own.gainprm, own.biasprm, own.dynprm = [0.0] * 10, [0.0] * 10, [0.0] * 10
        more = {"inductance": [0.0, lag], "cogging": cogging, "lugre": lugre}
        own.set_to_dcmotor([constant, 0.0], resistance, ctrlspec=none, **more)

    draft.edits.append(put)
    return ""


def _undriven(draft: Draft, place: str) -> str:
    """Why no actuator may exert a force of its own along a place; empty where one may."""
    import mujoco

    model, joint = draft.model, draft.joint(place)
    if int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION):
        return OFF
    limited = model.tendon_actfrclimited[draft.tendon(place)] if joint is None else model.jnt_actfrclimited[joint]
    return LIMITED if limited else ""


def limit_rate(draft: Draft, actuator: str, rate: float) -> str:
    """Have a motor's command change no faster than a rate [of its unit/s]; why it cannot, where it cannot.

    The motor becomes a ``dcmotor`` whose current is regulated, its gear what the motor makes of a unit of its command.

    Args:
        draft: changed in place.
        actuator: whose force is its command times a gain, and no more.
        rate: of the command.
    """
    import mujoco

    model = draft.model
    a = model.actuator(actuator).id
    if actuator in draft.lost:
        return "MuJoCo limits rates before forces are bounded, by which the dead zone before it is written"
    if int(model.actuator_dyntype[a]):
        return "its actuator has a filter, and MuJoCo's have no limit of their rate"

    def slow(spec: Any) -> None:
        own = spec.actuator(actuator)
        own.gear = [float(own.gear[0] * own.gainprm[0]), *[0.0] * 5]
        own.gainprm, own.biasprm, own.dynprm = [0.0] * 10, [0.0] * 10, [0.0] * 10
        torque = int(mujoco.mjtCtrlInput.mjINPUT_FF)
        own.set_to_dcmotor([1.0, 0.0], 1.0, controller=[0.0, 0.0, 0.0, rate, 0.0, 0.0], ctrlspec=torque)

    draft.edits.append(slow)
    return ""


def filter_command(draft: Draft, actuator: str, time_constant: float) -> str:
    """Have an actuator's command pass a first-order filter; why it cannot, where it cannot."""
    import mujoco

    model = draft.model
    a = model.actuator(actuator).id
    if actuator in draft.lost:
        return "MuJoCo filters commands before forces are bounded, by which the dead zone before it is written"
    if int(model.actuator_dyntype[a]):
        return "its actuator has a filter of its own"
    model.actuator_dyntype[a] = mujoco.mjtDyn.mjDYN_FILTEREXACT
    model.actuator_dynprm[a, 0] = time_constant
    # Else the force at a step is that of a filter which has not seen its command.
    model.actuator_actearly[a] = 1
    return ""


def lose_first(draft: Draft, actuator: str, threshold: float) -> str:
    """Have the first part of an actuator's commands do nothing: a bias takes it away, and no force is below 0.

    Args:
        draft: changed in place.
        actuator: whose force is its command times a gain, and no more.
        threshold: [unit of the command].
    """
    import mujoco

    model = draft.model
    a = model.actuator(actuator).id
    gain = float(model.actuator_gainprm[a, 0])
    most = float(model.actuator_ctrlrange[int(model.actuator_ctrladr[a]), 1])
    model.actuator_biastype[a] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_biasprm[a] = 0.0
    model.actuator_biasprm[a, 0] = -gain * threshold
    model.actuator_forcelimited[a], model.actuator_forcerange[a] = 1, (0.0, gain * most)
    draft.lost[actuator] = threshold
    return ""


def bound_command(draft: Draft, actuator: str, level: float) -> str:
    """Have an actuator's commands, less what a dead zone takes, stop at a level; why they cannot, where they cannot."""
    model = draft.model
    c = int(model.actuator_ctrladr[model.actuator(actuator).id])
    low, high = (float(end) for end in model.actuator_ctrlrange[c])
    most = min(level + draft.lost.get(actuator, 0.0), high)
    if not most > low:
        return "the level is no more than the lowest command, and MuJoCo's ranges are wider than nothing"

    def bound(spec: Any) -> None:
        spec.actuator(actuator).ctrlrange = low, most

    draft.edits.append(bound)
    return ""
