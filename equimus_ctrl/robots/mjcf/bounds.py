"""Between what bounds parameters of MJCF robots are looked for, and which changes of them count."""

from __future__ import annotations

from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.robots.mjcf.plan import Plan

_FACTOR = {
    "mass": 3.0, "inertia": 3.0, "kp": 3.0, "kv": 10.0, "gain": 2.0, "gravity": 1.02, "stiffness": 10.0,
    "damping": 10.0, "quadratic_damping": 10.0, "armature": 10.0, "frictionloss": 10.0, "force_limit": 3.0,
    "time_constant": 10.0, "delay": 3.0, "force": 3.0, "activation_time": 10.0, "deactivation_time": 10.0,
}  # fmt: skip
_AWAY = dict.fromkeys(SHAPE, 0.5) | {"com_x": 0.1, "com_y": 0.1, "com_z": 0.1, "tilt": 0.3, "springref": 1.0}
QUICK = {"damping": 100.0, "quadratic_damping": 100.0, "frictionloss": 100.0, "stiffness": 1e4, "armature": 10.0}
"""Upper bound of a joint's parameter that is 0 in the file: this multiple of what causes an acceleration of 1."""
RUBS = ("damping", "quadratic_damping", "frictionloss")
"""Kinds of a joint's parameters that a file often has for want of better ones: what it says bounds them nowhere."""
POSITIVE = frozenset(_FACTOR) - {"gain"}
"""Kinds of parameters that are at least 0."""


def bounds_of(plan: Plan, value: float, name: str) -> tuple[float, float]:
    """Default bounds (lowest, highest) of a free parameter.

    Args:
        plan: of the robot.
        value: of the parameter.
        name: of it.
    """
    kind, place = plan.parameters[name].kind, name.rpartition(".")[0]
    at_joint = place in plan.weights
    if kind in RUBS and at_joint:
        return 0.0, max(value * _FACTOR[kind], plan.weights[place] * QUICK[kind])
    if kind in _FACTOR and (value > 0 or (value and kind not in POSITIVE)):
        ends = value / _FACTOR[kind], value * _FACTOR[kind]
        return min(ends), max(ends)
    away = _AWAY.get(kind, max(abs(value), 1.0))
    if kind in QUICK and at_joint:
        away = plan.weights[place] * QUICK[kind]
    return (max(value - away, 0.0) if kind in POSITIVE else value - away), value + away


def size_of(plan: Plan, value: float, name: str) -> float | None:
    """Of a change of a joint's number that counts: what it takes for an acceleration of 1 rad/s² or m/s² there.

    Of others that are not 0 it is the number itself, and None is returned.

    Args:
        plan: of the robot.
        value: of the parameter.
        name: of it.
    """
    place, _, kind = name.rpartition(".")
    if value and (kind not in RUBS or place not in plan.weights):
        return None
    return max(abs(value), plan.weights.get(place, 1.0))
