"""Forces of any shape, by which a diagnosis asks whether a named law is the right one. Never named themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca

from equimus_ctrl.effects.base import parameter
from equimus_ctrl.effects.force import ForceEffect, Parameters

PIECES: tuple[Callable[[ca.SX], ca.SX], ...] = (
    lambda s: s**3 / 6,
    lambda s: (-3 * s**3 + 12 * s**2 - 12 * s + 4) / 6,
    lambda s: (3 * s**3 - 24 * s**2 + 60 * s - 44) / 6,
    lambda s: (4 - s) ** 3 / 6,
)
"""A cubic B-spline on each of the four intervals between its knots 0, 1, …, 4 (de Boor, "A practical guide to splines",
1978)."""


@dataclass(frozen=True)
class SmoothForce(ForceEffect):
    """−force·Σ cₖ Bₖ(u)·(1 or rate/speed), Bₖ uniform cubic B-splines of u = x or rate, from ``low`` on ``width`` wide.

    Beyond that u is taken to be at its end. It is not part of the catalogue: ``diagnosis.smooth_laws`` fits it beside
    a hypothesis, and whatever it explains no named law does.
    """

    name = "smooth_force"
    robots = ("elastic", "mjcf")
    sits_at = ("joint",)
    summary = "a force of any smooth shape over the angle or the speed"
    alike = False
    neutral = dict.fromkeys(("c1", "c2", "c3", "c4", "c5", "c6"), 0.0)
    c1: float = parameter("1", -10.0, 10.0, "of the first spline")
    c2: float = parameter("1", -10.0, 10.0, "of the second")
    c3: float = parameter("1", -10.0, 10.0, "of the third")
    c4: float = parameter("1", -10.0, 10.0, "of the fourth")
    c5: float = parameter("1", -10.0, 10.0, "of the fifth")
    c6: float = parameter("1", -10.0, 10.0, "of the sixth")
    over_rate: float = parameter("1", 0.0, 1.0, "1 where u is the rate, 0 where it is x")
    times_rate: float = parameter("1", 0.0, 1.0, "1 where it is times rate/speed, 0 where it is not")
    low: float = parameter("1", -1e6, 1e6, "least u [rad or rad/s]")
    width: float = parameter("1", 1e-9, 1e6, "greatest u less that [rad or rad/s]")
    speed: float = parameter("rad/s", 1e-9, 1e6, "by which the rate is divided")
    force_scale: float = parameter("N·m", 0.0, 1e9, "size of the force that a coefficient of 1 stands for")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        u = x + p["over_rate"] * (rate - x)
        total = sum(
            (p[key] * spline for key, spline in zip(cls.neutral, splines(u, p["low"], p["width"]), strict=True))
        )
        return -p["force_scale"] * total * (1 + p["times_rate"] * (rate / p["speed"] - 1))


@dataclass(frozen=True)
class SmoothFriction(ForceEffect):
    """Dry friction of a size between whose values force·cₖ ≥ 0 at knots x₁ < x₂ < … it is linear in x.

    Beyond these it is what it is at the nearest. It is not part of the catalogue either, see
    ``diagnosis.friction_over_angle``.
    """

    name = "smooth_friction"
    robots = ("elastic", "mjcf")
    sits_at = ("joint",)
    summary = "dry friction whose size is any function of the angle"
    alike = False
    neutral = dict.fromkeys((f"c{k}" for k in range(1, 13)), 0.0)
    c1: float = parameter("1", 0.0, 10.0, "at the first knot")
    c2: float = parameter("1", 0.0, 10.0, "at the second knot")
    c3: float = parameter("1", 0.0, 10.0, "at the third knot")
    c4: float = parameter("1", 0.0, 10.0, "at the fourth knot")
    c5: float = parameter("1", 0.0, 10.0, "at the fifth knot")
    c6: float = parameter("1", 0.0, 10.0, "at the sixth knot")
    c7: float = parameter("1", 0.0, 10.0, "at the seventh knot")
    c8: float = parameter("1", 0.0, 10.0, "at the eighth knot")
    c9: float = parameter("1", 0.0, 10.0, "at the ninth knot")
    c10: float = parameter("1", 0.0, 10.0, "at the tenth knot")
    c11: float = parameter("1", 0.0, 10.0, "at the eleventh knot")
    c12: float = parameter("1", 0.0, 10.0, "at the twelfth knot")
    x1: float = parameter("1", -1e6, 1e6, "first knot [rad or m]")
    x2: float = parameter("1", -1e6, 1e6, "second knot [rad or m]")
    x3: float = parameter("1", -1e6, 1e6, "third knot [rad or m]")
    x4: float = parameter("1", -1e6, 1e6, "fourth knot [rad or m]")
    x5: float = parameter("1", -1e6, 1e6, "fifth knot [rad or m]")
    x6: float = parameter("1", -1e6, 1e6, "sixth knot [rad or m]")
    x7: float = parameter("1", -1e6, 1e6, "seventh knot [rad or m]")
    x8: float = parameter("1", -1e6, 1e6, "eighth knot [rad or m]")
    x9: float = parameter("1", -1e6, 1e6, "ninth knot [rad or m]")
    x10: float = parameter("1", -1e6, 1e6, "tenth knot [rad or m]")
    x11: float = parameter("1", -1e6, 1e6, "eleventh knot [rad or m]")
    x12: float = parameter("1", -1e6, 1e6, "twelfth knot [rad or m]")
    force_scale: float = parameter("N·m", 0.0, 1e9, "size of the friction that a coefficient of 1 stands for")

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        knots, values = [p[f"x{k}"] for k in range(1, 13)], [p[key] for key in cls.neutral]
        size = values[0]
        for (begin, end), (low, high) in zip(pairwise(knots), pairwise(values), strict=True):
            size += (high - low) * ca.fmin(ca.fmax((x - begin) / (end - begin), 0), 1)
        return p["force_scale"] * size


def splines(u: ca.SX, low: ca.SX, width: ca.SX) -> list[ca.SX]:
    """The uniform cubic B-splines that do not vanish from ``low`` on ``width`` wide, at u, each an expression."""
    count = len(SmoothForce.neutral)
    inside = ca.fmin(ca.fmax((u - low) / width, 0), 1) * (count - 3)
    found = []
    for k in range(count):
        s, value = inside - (k - 3), ca.SX(0)
        for i, piece in enumerate(PIECES):
            value = ca.if_else(ca.logic_and(s >= i, s <= i + 1), piece(s), value)
        found.append(value)
    return found
