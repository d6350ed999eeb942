"""The parts of a planar robot with elastic actuators: points, stops, links, joints and actuators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.errors import ModelError

BASE = "base"


def require(condition: bool, message: str) -> None:
    """Raise ModelError unless a condition holds."""
    if not condition:
        raise ModelError(message)


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def check_finite(owner: str, **values: float) -> None:
    """Raise ModelError unless values are finite."""
    for key, value in values.items():
        require(_is_finite(value), f"{owner}: {key} is {value}, expected a finite number")


def check_least(owner: str, least: float, **values: float) -> None:
    """Raise ModelError unless values are finite and at least ``least``."""
    check_finite(owner, **values)
    for key, value in values.items():
        require(value >= least, f"{owner}: {key} is {value:g}, expected at least {least:g}")


def check_positive(owner: str, **values: float) -> None:
    """Raise ModelError unless values are finite and more than 0."""
    check_finite(owner, **values)
    for key, value in values.items():
        require(value > 0, f"{owner}: {key} is {value:g}, expected more than 0")


def checked_poses(owner: str, poses: Mapping[str, Any], joints: int) -> dict[str, tuple[float, ...]]:
    """Keyframes, each an angle of every joint [rad].

    Raises:
        ModelError: where one is not.
    """
    for name, angles in poses.items():
        given = list(angles) if isinstance(angles, list | tuple | np.ndarray) else [None]
        require(
            len(given) == joints and all(_is_finite(angle) for angle in given),
            f"{owner}: pose {name!r} is {angles!r}, expected one finite angle in rad for each of {joints} joints",
        )
    return {name: tuple(float(angle) for angle in angles) for name, angles in poses.items()}


def checked_scenarios(owner: str, scenarios: Mapping[str, Any]) -> dict[str, dict[str, float | str]]:
    """Options of scenarios by name.

    Raises:
        ModelError: where they are no table of numbers and texts.
    """
    for name, options in scenarios.items():
        plain = isinstance(options, Mapping) and all(isinstance(value, int | float | str) for value in options.values())
        require(plain, f"{owner}: scenario {name!r} is {options!r}, expected a table of its options")
    return {name: dict(options) for name, options in scenarios.items()}


@dataclass(frozen=True)
class Point:
    """A point fixed to a body, in polar coordinates of the body's frame.

    Attributes:
        body: a link's name, or ``"base"``.
        radius: distance from the frame's origin [m].
        angle: direction, from the body's first axis [rad].
    """

    body: str
    radius: float
    angle: float = 0.0

    def __post_init__(self) -> None:
        check_least(f"point on {self.body}", 0.0, radius=self.radius)
        check_finite(f"point on {self.body}", angle=self.angle)

    @classmethod
    def cartesian(cls, body: str, x: float, y: float) -> Point:
        """The point at (x, y) [m] of the body's frame."""
        return cls(body, math.hypot(x, y), math.atan2(y, x))

    @property
    def xy(self) -> tuple[float, float]:
        """Cartesian coordinates in the body's frame [m]."""
        return self.radius * math.cos(self.angle), self.radius * math.sin(self.angle)


@dataclass(frozen=True)
class JointStop:
    """A one-sided spring and damper: tau = stiffness·depth − damping·rate, never pulling.

    Attributes:
        angle: where it begins [rad].
        stiffness: [N·m/rad].
        damping: [N·m·s/rad], acting only while the stop is pressed.
    """

    angle: float
    stiffness: float = 200.0
    damping: float = 1.0

    def __post_init__(self) -> None:
        check_finite("joint stop", angle=self.angle)
        check_least("joint stop", 0.0, stiffness=self.stiffness, damping=self.damping)


@dataclass(frozen=True)
class Link:
    """A rigid link.

    Attributes:
        name: unique name.
        length: from its joint to its tip [m].
        mass: [kg].
        com: centre of mass, along the link from its joint [m].
        inertia: about the centre of mass [kg·m²].
    """

    name: str
    length: float
    mass: float
    com: float
    inertia: float

    def __post_init__(self) -> None:
        check_positive(f"link {self.name!r}", length=self.length, mass=self.mass)
        check_finite(f"link {self.name!r}", com=self.com)
        check_least(f"link {self.name!r}", 0.0, inertia=self.inertia)

    @classmethod
    def rod(cls, name: str, length: float, mass: float) -> Link:
        """A thin uniform rod: centre of mass at half the length, inertia mL²/12."""
        return cls(name, length, mass, length / 2, mass * length**2 / 12)


@dataclass(frozen=True)
class Joint:
    """A hinge that carries ``child`` on ``parent``.

    Attributes:
        name: unique name.
        parent: a link's name, or ``"base"``.
        child: the link it carries.
        damping: viscous damping [N·m·s/rad].
        lower: stop at the lower end, or None.
        upper: stop at the upper end, or None.
        at: where on the parent; None means the parent's tip (the origin, on the base).
    """

    name: str
    parent: str
    child: str
    damping: float = 0.0
    lower: JointStop | None = None
    upper: JointStop | None = None
    at: Point | None = None

    def __post_init__(self) -> None:
        check_least(f"joint {self.name!r}", 0.0, damping=self.damping)
        if self.lower and self.upper:
            require(
                self.lower.angle < self.upper.angle,
                f"joint {self.name!r}: the lower stop at {self.lower.angle:g} rad is not below "
                f"the upper one at {self.upper.angle:g} rad",
            )
        if self.at is not None:
            require(
                self.at.body == self.parent,
                f"joint {self.name!r}: sits on {self.at.body!r} but its parent is {self.parent!r}",
            )


@dataclass(frozen=True)
class ElasticActuator:
    """A linear elastic actuator that lengthens under pressure.

    Its force, positive where it lengthens, is  area·P − stiffness·(l − rest_length) − damping·dl/dt.

    Attributes:
        name: unique name.
        origin: one end.
        insertion: the other end.
        mass: spread evenly along it [kg].
        stiffness: [N/m].
        damping: [N·s/m].
        rest_length: [m].
        area: force per pressure [m²].
    """

    name: str
    origin: Point
    insertion: Point
    mass: float
    stiffness: float
    damping: float
    rest_length: float
    area: float

    def __post_init__(self) -> None:
        owner = f"actuator {self.name!r}"
        check_positive(owner, rest_length=self.rest_length, area=self.area)
        check_least(owner, 0.0, mass=self.mass, stiffness=self.stiffness, damping=self.damping)
