"""What random MuJoCo trees can have, by name, how it is drawn, and whether it acts."""

from __future__ import annotations

from copy import copy
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.types import Array

# In these tables "{a:b}" stands for a number drawn between a and b, in the units of a hinge: rad, N·m.
_LIMIT = {"range": "{-0.3:-0.05} {0.05:0.3}"}
_TIGHT = {"range": "{-0.15:-0.03} {0.03:0.15}"}
OWN = "{0.02:0.06} {0.5:1.5}", "{0:0.6} {0.8:0.99} {0.05:0.3} {0.2:0.8} {1:4}"
_SOLVER = _LIMIT | {"solreflimit": OWN[0], "solimplimit": OWN[1], "margin": "{0:0.05}"}
_DAMPING = {"damping": "{0.1:0.3} {0.05:0.2} {0.02:0.1}"}
JOINT: dict[str, dict[str, str]] = {
    "armature": {"armature": "{0.01:0.05}"},
    "joint_spring": {"stiffness": "{1:4}", "springref": "{-0.5:0.5}"},
    "joint_spring_poly": {"stiffness": "{2:4} {-0.6:0.9} {0.6:3}", "springref": "{-0.5:0.5}"},
    "joint_damping_poly": _DAMPING,
    "joint_limit": _LIMIT,
    "joint_limit_solver": _SOLVER,
    "joint_limit_direct": _LIMIT | {"solreflimit": "{-900:-200} {-60:-15}"},
    "actuatorgravcomp": {"actuatorgravcomp": "true", "actuatorfrcrange": "{-0.6:-0.2} {0.2:0.6}"},
    "joint_actuatorfrcrange": {"actuatorfrcrange": "{-0.8:-0.2} {0.2:0.8}"},
    "joint_friction": {"frictionloss": "{0.1:0.4}"},
}
TENDON: dict[str, dict[str, str]] = {
    "spring": {"stiffness": "{2:5} {-0.5:1} {0:2}", "springlength": "{-0.1:-0.02} {0.02:0.1}"},
    "damping": _DAMPING,
    "limit": _TIGHT,
    "limit_solver": _SOLVER | _TIGHT,
    "armature": {"armature": "{0.02:0.08}"},
    "actuatorfrcrange": {"actuatorfrcrange": "{-0.6:-0.2} {0.2:0.6}"},
    "friction": {"frictionloss": "{0.1:0.3}"},
}
_PD = 'kp="{3:8}" kv="{0.2:0.6}"'
_GENERAL = 'gainprm="{1:2}" biastype="affine" biasprm="{-0.3:0.3} {-2:-1} {-0.3:-0.1}" dynprm="{0.03:0.2}" dyntype='
_MOTOR = 'resistance="{0.8:1.5}" motorconst="{0.3:0.5}"'
_CONTROL = 'controller="{5:9} {2:5} {0.2:0.5} {1:2} {0.05:0.1} {1:2}"'
_HEAT, _BRISTLE = 'thermal="{2:5} {0.1:0.3} 0 {0.004:0.02} 25 20"', 'lugre="{20:60} {0.1:0.4} {0.1:0.3} 0.35 {0.2:0.5}"'
LAW: dict[str, str] = {
    "motor": "motor",
    "position": f"position {_PD}",
    "position_dampratio": 'position kp="{3:8}" dampratio="{0.4:1}"',
    "position_timeconst": f'position {_PD} timeconst="{{0.02:0.1}}"',
    "velocity": 'velocity kv="{0.4:1}"',
    "intvelocity": f"intvelocity {_PD}",
    "damper": 'damper kv="{0.3:0.8}" ctrlrange="0 2"',
    "cylinder": 'cylinder timeconst="{0.05:0.2}" area="{0.5:1}" bias="{-0.5:0.5} {-1:0} {-0.3:0}"',
    "affine": 'general gaintype="affine" gainprm="{1:2} {-0.5:0.5} {-0.2:0}" biastype="affine" biasprm="0.2 -1 -0.3"',
    "filter": f'general {_GENERAL}"filter"',
    "filterexact": f'general {_GENERAL}"filterexact"',
    "integrator": f'general {_GENERAL}"integrator"',
    "pid": f"pid {_PD}",
    "pid_integral": f'pid {_PD} ki="{{2:6}}" input="pos"',
    "pid_imax": f'pid {_PD} ki="{{2:6}}" imax="{{0.03:0.1}}" input="pos vel ff"',
    "pid_slew": f'pid {_PD} ki="{{2:6}}" slewmax="{{1:3}}" input="pos ff"',
    "pid_feedforward": f'pid {_PD} input="vel ff"',
    "dcmotor": f"dcmotor {_MOTOR}",
    "dcmotor_inductance": f'dcmotor {_MOTOR} inductance="0 {{0.004:0.02}}"',
    "dcmotor_saturation": f'dcmotor {_MOTOR} inductance="{{0.005:0.02}} 0" saturation="{{0.5:1}} 0 {{20:60}}"',
    "dcmotor_cogging": f'dcmotor {_MOTOR} cogging="{{0.1:0.4}} 6 {{-1:1}}"',
    "dcmotor_thermal": f"dcmotor {_MOTOR} {_HEAT}",
    "dcmotor_lugre": f"dcmotor {_MOTOR} {_BRISTLE}",
    "dcmotor_passive": f'dcmotor {_MOTOR} input="none" cogging="{{0.1:0.4}} 5 {{-1:1}}"',
    "dcmotor_controller": f'dcmotor {_MOTOR} input="pos vel ff voltage" {_CONTROL}',
    "dcmotor_everything": f'dcmotor {_MOTOR} input="pos" {_CONTROL} inductance="0 {{0.01:0.02}}" {_HEAT} {_BRISTLE}',
}
AT = ("joint", "jointinparent", "fixed_tendon", "spatial_tendon", "site", "refsite", "slidercrank")
_STATES = ("filter", "filterexact", "integrator")
EXTRA: dict[str, tuple[str, tuple[str, ...]]] = {
    "ctrlrange": ("", ("motor", "position", "velocity", "cylinder", "filter", "pid_integral", "dcmotor")),
    "forcerange": ('forcerange="{-0.8:-0.3} {0.3:0.8}"', ("motor", "position", "velocity", "pid", "affine")),
    "actrange": ('actrange="{-0.4:-0.1} {0.1:0.4}"', (*_STATES, "intvelocity")),
    "actearly": ('actearly="true"', _STATES),
    "delay": (
        'nsample="80" delay="{0.005|0.015|0.04}"',
        ("motor", "position", "filter", "pid_slew", "pid", "dcmotor", "velocity"),
    ),
    "actuator_damping": ('damping="{0.05:0.2} {0.02:0.1} {0.02:0.1}"', tuple(LAW)),
    "actuator_armature": ('armature="{0.01:0.04}"', tuple(LAW)),
    "gear": ('gear="{0.6:2}"', tuple(LAW)),
}
"""What an actuator may have, and the laws among which one is looked for to have it."""

FRICTION = ("joint_friction", "fixed_tendon_friction", "spatial_tendon_friction")
FEATURES: tuple[str, ...] = (
    *("branches", "two_joints", "welded_body", "slide", "ref", "gravity_oblique", "gravcomp", *JOINT),
    *(f"{kind}_tendon_{part}" for kind in ("fixed", "spatial") for part in TENDON),
    *("joint_equality", "joint_equality_solver", "tendon_equality"),
    *(*LAW, *(f"at_{place}" for place in AT), *EXTRA),
)
"""What ``random_tree`` can draw, named after MJCF; springs of tendons have a dead band, ``at_…`` are transmissions.

Every tree has oblique axes and frames, joints off the body's origin, linear damping, and a linear spring at each slide.
"""
ALL = FEATURES
SMOOTH = tuple(name for name in FEATURES if name not in FRICTION)
"""All without dry friction."""

_OFF: dict[str, str] = {
    "gravcomp": "body_gravcomp", "armature": "dof_armature", "joint_spring": "jnt_stiffness",
    "joint_spring_poly": "jnt_stiffnesspoly", "joint_damping_poly": "dof_dampingpoly", "joint_limit": "jnt_limited",
    "joint_limit_solver": "jnt_limited", "joint_limit_direct": "jnt_limited", "actuatorgravcomp": "jnt_actgravcomp",
    "joint_actuatorfrcrange": "jnt_actfrclimited", "joint_friction": "dof_frictionloss",
    "ctrlrange": "actuator_ctrllimited", "forcerange": "actuator_forcelimited", "actearly": "actuator_actearly",
    "delay": "actuator_delay", "actuator_damping": "actuator_damping", "actuator_armature": "actuator_armature",
}  # fmt: skip
"""Feature → the model's field that is set to zero to see whether the feature acts; of tendons below."""
_TENDON_OFF = {"spring": "stiffnesspoly", "damping": "dampingpoly", "limit": "limited", "limit_solver": "limited",
               "armature": "armature", "actuatorfrcrange": "actfrclimited", "friction": "frictionloss"}  # fmt: skip
_PARTS: dict[str, list[tuple[str, int, float]]] = {
    "pid_imax": [("dynprm", 0, 0.0)], "pid_slew": [("dynprm", 1, 1e9)], "dcmotor_saturation": [("dynprm", 1, 0.0)],
    "dcmotor_cogging": [("biasprm", 0, 0.0)], "dcmotor_thermal": [("gainprm", 2, 0.0)],
    "dcmotor_controller": [("dynprm", 7, 1e9), ("dynprm", 8, 0.0), ("gainprm", 7, 0.0)],
}  # fmt: skip
"""Law → entries of the actuator's parameters without which a part of the law does not act; by default all of it."""

LEAST = 1e-2
"""A feature acts where q̈ or ȧ differ by this without it [rad/s², m/s², 1/s]."""
SAMPLES = 60
SPATIAL = int(mujoco.mjtTendon.mjTENDON_SPATIAL)


def acting_in(model: Any, states: Array, ctrl: Array) -> set[str]:
    """As ``acting``: each feature is taken out of a copy of the model, to see whether ``SAMPLES`` states miss it."""
    rows = np.linspace(0, len(states) - 1, SAMPLES).astype(int)

    def rates(own: Any) -> tuple[Array, Array]:
        data, found, act = mujoco.MjData(own), np.empty((SAMPLES, own.nv + own.na)), np.empty((SAMPLES, own.na))
        for k, row in enumerate(rows):
            mujoco.mj_setState(own, data, states[row], mujoco.mjtState.mjSTATE_FULLPHYSICS)
            data.ctrl[:] = ctrl[row]
            mujoco.mj_forward(own, data)
            found[k], act[k] = np.concatenate([data.qacc, data.act_dot]), data.act
        return found, act

    whole, act = rates(model)
    structure = {
        "branches": len(set(model.body_parentid[1:])) < model.nbody - 1,
        "two_joints": (model.body_jntnum > 1).any(),
        "welded_body": (model.body_jntnum[1:] == 0).any(),
        "slide": (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE).any(),
        "ref": model.qpos0.any(),
        "gravity_oblique": model.opt.gravity[:2].any(),
        "gear": (np.abs(model.actuator_gear[:, 0]) % 1).any(),
    }
    seen = {name for name, there in structure.items() if there}
    for i in np.flatnonzero(model.actuator_actlimited):
        if np.isin(act[:, model.actuator_actadr[i]], model.actuator_actrange[i]).any():
            seen.add("actrange")
    for feature in set(FEATURES) - set(structure) - {"actrange"}:
        least = 1e-8 if feature == "actearly" else LEAST
        copies = _without(model, feature)
        if copies and all(np.abs(rates(own)[0] - whole).max() > least for own in copies):
            seen.add(feature)
    return seen


def _without(model: Any, feature: str) -> list[Any]:
    """Copies of the model without a feature, or without one part of it each; none where the model has it not."""
    if feature in LAW or feature.startswith("at_"):
        names = [model.actuator(i).name.split(":")[:2] for i in range(model.nactuator)]
        on = [i for i, name in enumerate(names) if feature.removeprefix("at_") in name]
        copies = [copy(model) for _ in (_PARTS.get(feature, [None]) if on else [])]
        for own, part in zip(copies, _PARTS.get(feature, []), strict=False):
            getattr(own, f"actuator_{part[0]}")[on, part[1]] = part[2]
        for own in copies if feature not in _PARTS else []:
            own.actuator_group[on], own.opt.disableactuator = 30, 1 << 30
        return copies
    kind, tendon, name = feature.partition("_tendon_")
    field, where = _OFF.get(feature, ""), np.array(True)
    if tendon:
        field = f"tendon_{_TENDON_OFF[name]}"
        where = (model.tendon_type == SPATIAL) == (kind == "spatial")
    elif feature == "joint_spring":
        where = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    elif "equality" in feature:
        joint = mujoco.mjtEq.mjEQ_JOINT if feature.startswith("joint") else mujoco.mjtEq.mjEQ_TENDON
        field, where = "eq_active0", (model.eq_type == joint)
    if not field:
        return []
    if "limit" in feature or "equality" in feature:
        ref = model.eq_solref if field[0] == "e" else model.tendon_solref_lim if tendon else model.jnt_solref
        style = np.where(ref[:, 0] < 0, "direct", np.where((ref == (0.02, 1)).all(1), "", "solver"))
        where = where & (style == (feature.split("_")[-1] if feature.endswith(("direct", "solver")) else ""))
    own = copy(model)
    values = getattr(own, field)
    chosen = np.broadcast_to(where.reshape(-1, *[1] * (values.ndim - 1)) if where.ndim else where, values.shape)
    found = bool(values[chosen].any())
    values[chosen] = 0
    return [own] if found else []
