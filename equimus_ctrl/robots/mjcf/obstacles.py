"""What a MuJoCo model has that the compiled equations of motion cannot hold, and what its flags switch off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.form import Dynamics

SWITCHES = ("constraint", "equality", "frictionloss", "limit", "spring", "damper", "gravity", "clampctrl", "actuation")
"""Flags of an MJCF that the equations look at."""
DYNAMICS: dict[Any, Dynamics] = {
    mujoco.mjtDyn.mjDYN_NONE: "none",
    mujoco.mjtDyn.mjDYN_INTEGRATOR: "integrator",
    mujoco.mjtDyn.mjDYN_FILTER: "filter",
    mujoco.mjtDyn.mjDYN_FILTEREXACT: "filter",
    mujoco.mjtDyn.mjDYN_PID: "none",
    mujoco.mjtDyn.mjDYN_DCMOTOR: "none",
}
"""What the equations hold of MuJoCo's dynamics of actuators, and what comes between command and force there."""


def switched_off(model: Any) -> frozenset[str]:
    """Which of ``SWITCHES`` a MuJoCo model has off; what is a constraint is off where all constraints are."""
    found = {
        name
        for name in SWITCHES
        if int(model.opt.disableflags) & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    }
    return frozenset(found | ({"equality", "frictionloss", "limit"} if "constraint" in found else set()))


def obstacles(model: Any) -> list[str]:
    """What a MuJoCo model has that these equations cannot hold, a phrase each; none where they hold it all.

    Contacts are not looked at: whether there are any depends on what the robot does.
    """
    m, found = model, []
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball"}
    found += [f"{kinds[int(t)]} joint {m.joint(i).name or i!r}" for i, t in enumerate(m.jnt_type) if int(t) in kinds]
    found += [f"plastic spring of joint {m.joint(i).name!r}" for i in np.flatnonzero(m.jnt_plasticadr >= 0)]
    found += [f"plastic spring of tendon {m.tendon(int(i)).name!r}" for i in np.flatnonzero(m.tendon_plasticadr >= 0)]
    off = switched_off(m)
    wrapping = {int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)}
    for t in range(m.ntendon):
        path = m.wrap_type[m.tendon_adr[t] : m.tendon_adr[t] + m.tendon_num[t]]
        if wrapping & set(map(int, path)):
            found.append(f"tendon {m.tendon(t).name or t!r} that wraps around a geom")
    usable = {int(mujoco.mjtEq.mjEQ_JOINT): "joint", int(mujoco.mjtEq.mjEQ_TENDON): "tendon"}
    for e in range(m.neq) if "equality" not in off else ():
        if m.eq_active0[e] and int(m.eq_type[e]) not in usable:
            kind = mujoco.mjtEq(int(m.eq_type[e])).name.removeprefix("mjEQ_").lower()
            found.append(f"equality constraint {m.equality(e).name or e!r} of kind {kind}")
    found += list(_actuator_obstacles(m))
    for count, what in (("nflex", "a flex"), ("nplugin", "a plugin")):
        if getattr(m, count):
            found.append(what)
    if m.opt.density > 0 or m.opt.viscosity > 0:
        found.append("a fluid around it (density, viscosity)")
    for flag in ("OVERRIDE", "DIAGEXACT", "SLEEP"):
        if int(m.opt.enableflags) & int(getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}")):
            found.append(f'<flag {flag.lower()}="enable"/>')
    if int(m.opt.disableactuator):
        found.append("actuators that are switched off by group")
    return found


def _actuator_obstacles(m: Any) -> Iterator[str]:
    gains, biases, kinds = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtTrn
    simple = {
        (int(g), int(b)) for g in (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE) for b in (0, int(biases.mjBIAS_AFFINE))
    }
    simple |= {
        (int(gains.mjGAIN_PID), int(biases.mjBIAS_AFFINE)),
        (int(gains.mjGAIN_DCMOTOR), int(biases.mjBIAS_DCMOTOR)),
    }
    transmissions = {
        int(kind)
        for kind in (
            kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT, kinds.mjTRN_TENDON, kinds.mjTRN_SITE, kinds.mjTRN_SLIDERCRANK
        )
    }  # fmt: skip
    dynamics = {int(d) for d in DYNAMICS}
    for i in range(m.nactuator):
        who = f"actuator {m.actuator(i).name or i!r}"
        if int(m.actuator_trntype[i]) not in transmissions:
            yield f"{who} with the transmission {mujoco.mjtTrn(int(m.actuator_trntype[i])).name[6:].lower()}"
        elif m.actuator_plugin[i] >= 0:
            yield f"{who}, a plugin"
        elif int(m.actuator_gaintype[i]) == int(gains.mjGAIN_MUSCLE):
            yield f"muscle {m.actuator(i).name or i!r}"
        elif (int(m.actuator_gaintype[i]), int(m.actuator_biastype[i])) not in simple:
            gain = mujoco.mjtGain(int(m.actuator_gaintype[i])).name.removeprefix("mjGAIN_").lower()
            bias = mujoco.mjtBias(int(m.actuator_biastype[i])).name.removeprefix("mjBIAS_").lower()
            yield f"{who} with the gain {gain} and the bias {bias}"
        elif _winds(m, i):
            yield f"{who}, a servo of a direction, whose goal may be any of many turns"
        elif int(m.actuator_dyntype[i]) not in dynamics:
            yield f"{who} with the dynamics {mujoco.mjtDyn(int(m.actuator_dyntype[i])).name[6:].lower()}"


def _winds(m: Any, i: int) -> bool:
    """Whether MuJoCo takes the turn of an actuator's goal that is nearest."""
    site = int(m.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_SITE) and int(m.actuator_trnid[i, 1]) >= 0
    if not site or m.actuator_gear[int(m.actuator_outadr[i]), :3].any():
        return False
    if int(m.actuator_gaintype[i]) in (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR)):
        return bool(int(m.actuator_ctrlspec[i]) & 1)
    stiffness = m.actuator_biasprm[i, 1]
    return bool(stiffness and m.actuator_gainprm[i, 0] == -stiffness)
