"""One frozen description of a planar robot driven by linear elastic actuators.

Both engines are made from it: the MJCF with 3-2-1 elements and the exact reduced-coordinate Lagrangian.

Plane and angles: x to the right, y down, gravity along +y. A link's frame has its origin at the joint that
carries the link and its first axis along the link; an angle turns x towards y. A joint angle is measured from
its parent's frame; the base frame is the world's. Units are SI.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from numbers import Real
from typing import Literal, TypeVar

import numpy as np

from equimus_ctrl.errors import ModelError, nearest, unknown_name
from equimus_ctrl.types import Array, frozen_array

Phase = Literal["swing", "stance"]
"""Swing: the base is fixed. Stance: the foot is pinned, the base translates and keeps its orientation."""

BASE = "base"
RESERVED = (BASE, "world")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ModelError(message)


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def _check_finite(owner: str, **values: float) -> None:
    for key, value in values.items():
        _require(_is_finite(value), f"{owner}: {key} is {value}, expected a finite number")


def _check_least(owner: str, least: float, **values: float) -> None:
    _check_finite(owner, **values)
    for key, value in values.items():
        _require(value >= least, f"{owner}: {key} is {value:g}, expected at least {least:g}")


def _check_positive(owner: str, **values: float) -> None:
    _check_finite(owner, **values)
    for key, value in values.items():
        _require(value > 0, f"{owner}: {key} is {value:g}, expected more than 0")


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
        _check_least(f"point on {self.body}", 0.0, radius=self.radius)
        _check_finite(f"point on {self.body}", angle=self.angle)

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
        _check_finite("joint stop", angle=self.angle)
        _check_least("joint stop", 0.0, stiffness=self.stiffness, damping=self.damping)


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
        _check_positive(f"link {self.name!r}", length=self.length, mass=self.mass)
        _check_finite(f"link {self.name!r}", com=self.com)
        _check_least(f"link {self.name!r}", 0.0, inertia=self.inertia)

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
        _check_least(f"joint {self.name!r}", 0.0, damping=self.damping)
        if self.lower and self.upper:
            _require(
                self.lower.angle < self.upper.angle,
                f"joint {self.name!r}: the lower stop at {self.lower.angle:g} rad is not below "
                f"the upper one at {self.upper.angle:g} rad",
            )
        if self.at is not None:
            _require(
                self.at.body == self.parent,
                f"joint {self.name!r}: sits on {self.at.body!r} but its parent is {self.parent!r}",
            )


@dataclass(frozen=True)
class ElasticActuator:
    """A linear elastic actuator that lengthens under pressure.

    The force that pushes its ends apart is  area·P − stiffness·(l − rest_length) − damping·dl/dt.

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
        _check_positive(owner, rest_length=self.rest_length, area=self.area)
        _check_least(owner, 0.0, mass=self.mass, stiffness=self.stiffness, damping=self.damping)


@dataclass(frozen=True)
class Morphology:
    """A planar tree of links with elastic actuators across them.

    Attributes:
        name: what the robot is called.
        links: in any order.
        joints: one for each link, parents before children; their order is the order of every angle vector.
        actuators: their order is the order of every command vector.
        foot: the link whose tip is the foot.
        base_mass: moves only in stance [kg].
        gravity: [m/s²].
        tilt: angle by which gravity leans from +y towards −x, as when the base is turned by it [rad].
        command_low: lowest pressure [Pa].
        command_high: highest pressure [Pa].

    Raises:
        ModelError: for a name used twice, a link without a joint, a closed skeleton loop, or an actuator that
            no joint can lengthen.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    actuators: tuple[ElasticActuator, ...]
    foot: str
    base_mass: float = 0.0
    gravity: float = 9.8
    tilt: float = 0.0
    command_low: float = 0.0
    command_high: float = 50e3

    def __post_init__(self) -> None:
        for key in ("links", "joints", "actuators"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        _check_least(self.name, 0.0, base_mass=self.base_mass)
        _check_finite(self.name, gravity=self.gravity, tilt=self.tilt)
        _check_finite(self.name, command_low=self.command_low, command_high=self.command_high)
        _require(
            self.command_low < self.command_high,
            f"{self.name}: the lowest command {self.command_low:g} Pa is not below the highest, "
            f"{self.command_high:g} Pa",
        )
        _require(bool(self.links), f"{self.name}: a morphology needs at least one link")
        _require(bool(self.actuators), f"{self.name}: a morphology needs at least one actuator")
        names = [item.name for group in (self.links, self.joints, self.actuators) for item in group]
        for name in names:
            _require(names.count(name) == 1, f"{self.name}: the name {name!r} is used twice")
            _require(name not in RESERVED, f"{self.name}: the name {name!r} is taken; it means the ground")
            _require(name.isidentifier(), f"{self.name}: {name!r} is not a plain name of letters, digits and '_'")
        self._check_tree()
        self._check_actuators()

    def _check_tree(self) -> None:
        link_names = {link.name for link in self.links}
        reached = {BASE}
        carried: dict[str, str] = {}
        for joint in self.joints:
            for body in (joint.parent, joint.child):
                if not (body in link_names or (body == BASE and body == joint.parent)):
                    raise ModelError(unknown_name("link", body, link_names, f"{self.name}: joint {joint.name!r}"))
            if joint.child in carried:
                raise ModelError(
                    f"{self.name}: link {joint.child!r} is carried by both joint {carried[joint.child]!r} and joint "
                    f"{joint.name!r}; a closed skeleton loop is not supported, each link hangs on one joint"
                )
            _require(
                joint.parent in reached,
                f"{self.name}: joint {joint.name!r} hangs on {joint.parent!r} before any joint carries that link; "
                "list parents first (a closed skeleton loop is not supported)",
            )
            carried[joint.child] = joint.name
            reached.add(joint.child)
        for link in self.links:
            _require(link.name in carried, f"{self.name}: link {link.name!r} hangs on no joint")
        if self.foot not in link_names:
            raise ModelError(unknown_name("link", self.foot, link_names, f"{self.name}: foot"))

    def _check_actuators(self) -> None:
        bodies = {BASE} | {link.name for link in self.links}
        for actuator in self.actuators:
            owner = f"{self.name}: actuator {actuator.name!r}"
            for point in (actuator.origin, actuator.insertion):
                if point.body not in bodies:
                    raise ModelError(unknown_name("body", point.body, bodies, owner))
            _require(
                actuator.origin.body != actuator.insertion.body,
                f"{owner} has both ends on {actuator.origin.body!r}, so no joint moves it; "
                "its ends must be on two different bodies",
            )
            _require(
                not self._lies_on_pivot(actuator.origin, actuator.insertion)
                and not self._lies_on_pivot(actuator.insertion, actuator.origin),
                f"{owner} has an end on the only joint between its two bodies, so its length never changes; "
                "move that end off the joint",
            )

    def _lies_on_pivot(self, point: Point, other: Point) -> bool:
        """Whether ``point`` sits on the one joint that separates its body from the other point's."""
        here, there = self.chain(point.body), self.chain(other.body)
        between = [joint for joint in (*here, *there) if (joint in here) != (joint in there)]
        if len(between) != 1:
            return False
        joint = between[0]
        x, y = point.xy
        at = self.joint_point(joint).xy if point.body == joint.parent else (0.0, 0.0)
        return math.hypot(x - at[0], y - at[1]) < 1e-9

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in the order of every angle vector."""
        return tuple(joint.name for joint in self.joints)

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Actuator names in the order of every command vector."""
        return tuple(actuator.name for actuator in self.actuators)

    @property
    def joint_range(self) -> tuple[Array, Array]:
        """(low, high), each (n_joints,): where the stops begin [rad], ±inf where there is none."""
        low = [j.lower.angle if j.lower else -math.inf for j in self.joints]
        high = [j.upper.angle if j.upper else math.inf for j in self.joints]
        return frozen_array(low, 1), frozen_array(high, 1)

    def without_stops(self) -> Morphology:
        """The same robot with joints that turn freely."""
        return replace(self, joints=tuple(replace(joint, lower=None, upper=None) for joint in self.joints))

    def link(self, name: str) -> Link:
        """The link called ``name``."""
        return self.links[[link.name for link in self.links].index(name)]

    def middle(self, joint: str) -> float:
        """The angle of a joint that lies between its lower and its upper side [rad].

        The middle of its stops; a quarter turn from the one where there is but one; and without any, where it hangs
        straight down with all that carries it.
        """
        j = self.joint(joint)
        if j.lower and j.upper:
            return (j.lower.angle + j.upper.angle) / 2
        if j.lower:
            return j.lower.angle + math.pi / 2
        if j.upper:
            return j.upper.angle - math.pi / 2
        return math.pi / 2 + self.tilt if j.parent == BASE else 0.0

    def with_payload(self, place: str, mass: float) -> Morphology:
        """A copy with a point mass [kg] at the tip of a link, or at the foot: the last link's tip."""
        link = self.link(self.foot if place == "foot" else place)
        whole = link.mass + mass
        com = (link.mass * link.com + mass * link.length) / whole
        inertia = link.inertia + link.mass * (link.com - com) ** 2 + mass * (link.length - com) ** 2
        own = {"mass": whole, "com": com, "inertia": inertia}
        return self.with_parameters({f"{link.name}.{key}": value for key, value in own.items()})

    def with_stop(self, joint: str, side: Literal["lower", "upper"], stop: tuple[float, float, float]) -> Morphology:
        """A copy in which a joint's stop is another, or is where there was none.

        Args:
            joint: whose.
            side: which.
            stop: angle [rad], stiffness [N·m/rad], damping [N·m·s/rad].
        """
        joints = [replace(j, **{side: JointStop(*stop)}) if j.name == joint else j for j in self.joints]  # type: ignore[arg-type]
        return replace(self, joints=tuple(joints))

    def joint(self, name: str) -> Joint:
        """The joint called ``name``."""
        return self.joints[self.joint_names.index(name)]

    def chain(self, body: str) -> tuple[Joint, ...]:
        """The joints between the base and ``body``, from the base outwards."""
        by_child = {joint.child: joint for joint in self.joints}
        path: list[Joint] = []
        while body != BASE:
            path.append(by_child[body])
            body = by_child[body].parent
        return tuple(reversed(path))

    def joint_point(self, joint: Joint) -> Point:
        """Where on its parent ``joint`` sits."""
        if joint.at is not None:
            return joint.at
        return Point(joint.parent, 0.0 if joint.parent == BASE else self.link(joint.parent).length)

    def parameters(self) -> dict[str, float]:
        """Every number of the morphology by its dotted name, such as ``maa.stiffness`` or ``hip.lower.angle``."""
        return dict(self._parameters)

    def has_parameters(self, names: Iterable[str]) -> bool:
        """Whether all of these are names of ``parameters()``."""
        return all(name in self._parameters for name in names)

    @cached_property
    def _parameters(self) -> dict[str, float]:
        return dict(_walk(self))

    def with_parameters(self, values: Mapping[str, float]) -> Morphology:
        """A copy with some of ``parameters()`` replaced.

        Raises:
            ModelError: for a name that does not exist or a value that cannot be.
        """
        known = self._parameters
        for name in values:
            if name not in known:
                owner = name.partition(".")[0]
                likely = [key for key in known if key.startswith(owner + ".")] or list(known)
                raise ModelError(
                    f"{self.name}: there is no parameter {name!r}{nearest(name, known)} (known: {', '.join(likely)})"
                )
            _require(isinstance(values[name], Real), f"{self.name}: {name} is {values[name]!r}, expected a number")
        return _replaced(self, "", values)


_Part = Morphology | Link | Joint | JointStop | ElasticActuator | Point
_P = TypeVar("_P", bound=_Part)


def _children(part: _Part, prefix: str) -> Iterator[tuple[str, str, _Part]]:
    """(field, prefix of the child's parameters, child) for the parts nested in ``part``."""
    for item in fields(part):
        value = getattr(part, item.name)
        if isinstance(value, JointStop | Point):
            yield item.name, f"{prefix}{item.name}.", value
        elif isinstance(value, tuple):
            for child in value:
                yield item.name, f"{child.name}.", child


def _walk(part: _Part, prefix: str = "") -> Iterator[tuple[str, float]]:
    for item in fields(part):
        value = getattr(part, item.name)
        if isinstance(value, Real):
            yield prefix + item.name, float(value)
    for _, child_prefix, child in _children(part, prefix):
        yield from _walk(child, child_prefix)


def _replaced(part: _P, prefix: str, values: Mapping[str, float]) -> _P:
    changes: dict[str, object] = {}
    for item in fields(part):
        value = getattr(part, item.name)
        if prefix + item.name in values:
            changes[item.name] = float(values[prefix + item.name])
        elif isinstance(value, JointStop | Point):
            if (child := _replaced(value, f"{prefix}{item.name}.", values)) is not value:
                changes[item.name] = child
        elif isinstance(value, tuple):
            children = tuple(_replaced(child, f"{child.name}.", values) for child in value)
            if any(new is not old for new, old in zip(children, value, strict=True)):
                changes[item.name] = children
    return replace(part, **changes) if changes else part  # type: ignore[arg-type]  # mypy cannot follow it so far


def pack(morphology: Morphology) -> Array:
    """The numbers of a morphology in the fixed order of ``models.symbolic``'s parameter vector, shape (n,).

    Two morphologies of the same structure (see ``structure``) have vectors of the same meaning; a stop that is
    absent becomes one at infinity.
    """
    none = {"lower": (-math.inf, 0.0, 0.0), "upper": (math.inf, 0.0, 0.0)}
    out = [morphology.gravity, morphology.tilt, morphology.base_mass]
    for joint in morphology.joints:
        link = morphology.link(joint.child)
        at = morphology.joint_point(joint)
        out += [at.radius, at.angle, joint.damping]
        for side in ("lower", "upper"):
            stop = getattr(joint, side)
            out += none[side] if stop is None else (stop.angle, stop.stiffness, stop.damping)
        out += [link.length, link.mass, link.com, link.inertia]
    for a in morphology.actuators:
        out += [a.origin.radius, a.origin.angle, a.insertion.radius, a.insertion.angle]
        out += [a.mass, a.stiffness, a.damping, a.rest_length, a.area]
    return np.array(out, dtype=np.float64)


def structure(morphology: Morphology) -> tuple[tuple[int, ...], tuple[tuple[int, int], ...], int]:
    """What the equations' form depends on: parents of the joints, bodies of each actuator, the foot's body.

    Bodies are numbered by the joint that carries them; −1 is the base.
    """
    index = {joint.child: i for i, joint in enumerate(morphology.joints)} | {BASE: -1}
    parents = tuple(index[joint.parent] for joint in morphology.joints)
    spans = tuple((index[a.origin.body], index[a.insertion.body]) for a in morphology.actuators)
    return parents, spans, index[morphology.foot]
