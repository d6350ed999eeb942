"""One frozen description of a planar robot driven by linear elastic actuators.

Both engines are made from it: the MJCF with 3-2-1 elements and the exact reduced-coordinate Lagrangian.

Plane and angles: x to the right, y down, gravity along +y. A link's frame has its origin at the joint that
carries the link and its first axis along the link; an angle turns x towards y. A joint angle is measured from
its parent's frame; the base frame is the world's. Units are SI.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, cached_property
from numbers import Real
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from equimus_ctrl.errors import ConfigError, ModelError, nearest, unknown_name
from equimus_ctrl.robots.base import Need, Robot, RobotTraits
from equimus_ctrl.robots.elastic.form import ElasticForm
from equimus_ctrl.robots.elastic.parts import (
    BASE,
    ElasticActuator,
    Joint,
    JointStop,
    Link,
    Point,
    check_finite,
    check_least,
    checked_poses,
    checked_scenarios,
    require,
)
from equimus_ctrl.robots.elastic.traits import TRAITS
from equimus_ctrl.robots.mechanics import Channel, Mechanics
from equimus_ctrl.types import Array, frozen_array

__all__ = [
    "BASE", "BUILT_IN", "ElasticActuator", "Joint", "JointStop", "Link", "Morphology", "Phase", "Point", "elastic_of",
    "pack", "structure",
]  # fmt: skip

Phase = Literal["swing", "stance"]
"""Swing: the base is fixed. Stance: the foot is pinned, the base translates and keeps its orientation."""

RESERVED = (BASE, "world")

VARYING = ("stiffness", "area", "damping", "rest_length")
"""Of actuators that are built alike."""
DEFAULT_KINDS = ("stiffness", "area", "rest_length", "damping")
"""The least certain of an actuator's bench values: free by default, with the joints' damping."""
_FACTOR = {"stiffness": 3.0, "area": 3.0, "mass": 3.0, "inertia": 3.0, "damping": 10.0}
_SHARE = {"rest_length": 0.3, "radius": 0.3, "length": 0.1, "com": 0.5, "gravity": 0.02}
_AWAY = {"angle": 0.3, "tilt": 0.3, "com": 0.1, "damping": 1.0, "stiffness": 100.0, "base_mass": 1.0}
_UNIT = {
    "area": "m²", "rest_length": "m", "mass": "kg", "base_mass": "kg", "com": "m", "inertia": "kg·m²", "length": "m",
    "radius": "m", "angle": "rad", "tilt": "rad", "gravity": "m/s²", "command_low": "Pa", "command_high": "Pa",
}  # fmt: skip


@dataclass(frozen=True, repr=False)
class Morphology(Robot):
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
        poses: keyframes, name → the joints' angles [rad]; the first is ``home``.
        scenarios: see ``scenario_options``.

    Raises:
        ModelError: for a name used twice, a link without a joint, a closed skeleton loop, or an actuator that
            no joint can lengthen.
    """

    traits: ClassVar[RobotTraits] = TRAITS

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
    poses: Mapping[str, tuple[float, ...]] = field(default_factory=dict, compare=False)
    scenarios: Mapping[str, Mapping[str, float | str]] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        for key in ("links", "joints", "actuators"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        check_least(self.name, 0.0, base_mass=self.base_mass)
        check_finite(self.name, gravity=self.gravity, tilt=self.tilt)
        check_finite(self.name, command_low=self.command_low, command_high=self.command_high)
        require(
            self.command_low < self.command_high,
            f"{self.name}: the lowest command {self.command_low:g} Pa is not below the highest, "
            f"{self.command_high:g} Pa",
        )
        require(bool(self.links), f"{self.name}: a morphology needs at least one link")
        require(bool(self.actuators), f"{self.name}: a morphology needs at least one actuator")
        names = [item.name for group in (self.links, self.joints, self.actuators) for item in group]
        for name in names:
            require(names.count(name) == 1, f"{self.name}: the name {name!r} is used twice")
            require(name not in RESERVED, f"{self.name}: the name {name!r} is taken; it means the ground")
            require(name.isidentifier(), f"{self.name}: {name!r} is not a plain name of letters, digits and '_'")
        self._check_tree()
        self._check_actuators()
        object.__setattr__(self, "poses", checked_poses(self.name, self.poses, len(self.joints)))
        object.__setattr__(self, "scenarios", checked_scenarios(self.name, self.scenarios))

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
            require(
                joint.parent in reached,
                f"{self.name}: joint {joint.name!r} hangs on {joint.parent!r} before any joint carries that link; "
                "list parents first (a closed skeleton loop is not supported)",
            )
            carried[joint.child] = joint.name
            reached.add(joint.child)
        for link in self.links:
            require(link.name in carried, f"{self.name}: link {link.name!r} hangs on no joint")
        if self.foot not in link_names:
            raise ModelError(unknown_name("link", self.foot, link_names, f"{self.name}: foot"))

    def _check_actuators(self) -> None:
        bodies = {BASE} | {link.name for link in self.links}
        for actuator in self.actuators:
            owner = f"{self.name}: actuator {actuator.name!r}"
            for point in (actuator.origin, actuator.insertion):
                if point.body not in bodies:
                    raise ModelError(unknown_name("body", point.body, bodies, owner))
            require(
                actuator.origin.body != actuator.insertion.body,
                f"{owner} has both ends on {actuator.origin.body!r}, so no joint moves it; "
                "its ends must be on two different bodies",
            )
            require(
                not self._lies_on_pivot(actuator.origin, actuator.insertion)
                and not self._lies_on_pivot(actuator.insertion, actuator.origin),
                f"{owner} has an end on the only joint between its two bodies, so its length never changes; "
                "move that end off the joint",
            )

    def _between(self, body: str, other: str) -> list[Joint]:
        """The joints that move one body against the other."""
        here, there = self.chain(body), self.chain(other)
        return [joint for joint in (*here, *there) if (joint in here) != (joint in there)]

    def _on_pivot(self, point: Point, joint: Joint) -> bool:
        """Whether ``point`` sits where ``joint`` turns, on either of its bodies."""
        if point.body not in (joint.parent, joint.child):
            return False
        x, y = point.xy
        at = self.joint_point(joint).xy if point.body == joint.parent else (0.0, 0.0)
        return math.hypot(x - at[0], y - at[1]) < 1e-9

    def _lies_on_pivot(self, point: Point, other: Point) -> bool:
        """Whether ``point`` sits on the one joint that separates its body from the other point's."""
        between = self._between(point.body, other.body)
        return len(between) == 1 and self._on_pivot(point, between[0])

    @property
    def joint_range(self) -> tuple[Array, Array]:
        """(low, high), each (n_joints,): where the stops begin [rad], ±inf where there is none."""
        low = [j.lower.angle if j.lower else -math.inf for j in self.joints]
        high = [j.upper.angle if j.upper else math.inf for j in self.joints]
        return frozen_array(low, 1), frozen_array(high, 1)

    def places(self) -> dict[str, tuple[str, ...]]:
        """Kind of place → names of those an effect can sit at."""
        return {
            "joint": self.joint_names,
            "actuator": self.actuator_names,
            "link": tuple(link.name for link in self.links),
            "foot": ("foot",),
            "base": (BASE,),
        }

    @property
    def foot_link(self) -> str:
        """The link whose tip is the foot."""
        return self.foot

    def carrying_point(self, place: str) -> str:
        """In words where a payload at a link or foot sits."""
        return "the foot" if place == "foot" else f"the tip of the {place}"

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
        for name, value in values.items():
            require(isinstance(value, Real), f"{self.name}: {name} is {value!r}, expected a number")
        taken: set[str] = set()
        changed = _replaced(self, "", values, {name.partition(".")[0] for name in values}, taken)
        if len(taken) < len(values):
            known = self._parameters
            name = next(name for name in values if name not in known)
            owner = name.partition(".")[0]
            likely = [key for key in known if key.startswith(owner + ".")] or list(known)
            raise ModelError(
                f"{self.name}: there is no parameter {name!r}{nearest(name, known)} (known: {', '.join(likely)})"
            )
        return changed

    def unit(self, name: str) -> str:
        """The SI unit of a parameter."""
        parts = name.split(".")
        if parts[-1] in _UNIT:
            return _UNIT[parts[-1]]
        turning = parts[0] in self.joint_names
        return {"stiffness": ("N/m", "N·m/rad"), "damping": ("N·s/m", "N·m·s/rad")}[parts[-1]][turning]

    def bounds(self, name: str) -> tuple[float, float]:
        """(low, high): between what a parameter can plausibly be, by its kind."""
        value, kind = self._parameters[name], name.split(".")[-1]
        if kind in _FACTOR and value > 0:
            return value / _FACTOR[kind], value * _FACTOR[kind]
        if kind in _SHARE and value > 0:
            return value * (1 - _SHARE[kind]), value * (1 + _SHARE[kind])
        away = _AWAY.get(kind, max(abs(value), 1.0))
        least = 0.0 if kind in _FACTOR else -math.inf
        return max(value - away, least), value + away

    def default_names(self) -> list[str]:
        """Stiffness, area, rest length and damping of every actuator, and damping of every joint."""
        names = [f"{a.name}.{key}" for key in DEFAULT_KINDS for a in self.actuators]
        return names + [f"{joint.name}.damping" for joint in self.joints]

    def varying(self) -> list[tuple[str, tuple[str, ...]]]:
        """As of any robot: numbers of the actuators, damping of the joints, masses with inertias."""
        own = [(key, (f"{a.name}.{key}",)) for a in self.actuators for key in VARYING]
        own += [("damping", (f"{joint.name}.damping",)) for joint in self.joints]
        return own + [("mass", (f"{link.name}.mass", f"{link.name}.inertia")) for link in self.links]

    def place_unit(self, unit: str, place: str) -> str:
        """The unit of something at a joint or actuator, see ``Robot.place_unit``."""
        joint, _, actuator = unit.partition(" | ")
        return joint if place in self.joint_names or not actuator else actuator

    def driven_joints(self, actuator: str) -> frozenset[str]:
        """The joints between an actuator's ends; on one on whose pivot an end sits it has no lever arm."""
        own = self.actuators[self.actuator_names.index(actuator)]
        ends = own.origin, own.insertion
        between = self._between(ends[0].body, ends[1].body)
        return frozenset(joint.name for joint in between if not any(self._on_pivot(end, joint) for end in ends))

    def command_unit(self, actuator: str) -> str:
        """Of an actuator's command: a pressure."""
        return "Pa"

    def length_unit(self, actuator: str) -> str:
        """Of an actuator's length."""
        return "m"

    @property
    def command_limits(self) -> tuple[Array, Array]:
        """(low, high), each (na,): of the pressures [Pa]."""
        n = len(self.actuators)
        return frozen_array(np.full(n, self.command_low)), frozen_array(np.full(n, self.command_high))

    @property
    def keyframes(self) -> Mapping[str, Array]:
        """As of any robot: its ``poses``."""
        return {name: frozen_array(angles, 1) for name, angles in self.poses.items()}

    @property
    def scenario_options(self) -> Mapping[str, Mapping[str, str]]:
        """As of any robot: its ``scenarios``."""
        return {name: {key: str(value) for key, value in own.items()} for name, own in self.scenarios.items()}

    @property
    def offers(self) -> frozenset[Need]:
        """As of any robot."""
        return frozenset[Need](("lengths", "inverse"))

    def mechanics(self) -> Mechanics:
        everywhere = np.arange(len(self.joints))
        named = {"joint": self.joint_names, "actuator": self.actuator_names}
        channels = tuple(Channel(actuator=i) for i in range(len(self.actuators)))
        return Mechanics(structure(self), pack(self), everywhere, everywhere, named, channels)

    def to_dict(self) -> dict[str, Any]:
        """What a model file says of it: a built-in by its name with what differs, else all of it."""
        base = next((name for name, make in BUILT_IN.items() if self._is_like(make())), None)
        if base is None:
            whole = {key: value for key, value in asdict(self).items() if value or key not in ("poses", "scenarios")}
            return {"morphology": _without_none(whole)}
        reference = BUILT_IN[base]().parameters()
        changed = {key: value for key, value in self._parameters.items() if value != reference[key]}
        return {"morphology": base, "parameters": changed}

    def _is_like(self, other: Morphology) -> bool:
        """Whether the two differ in nothing but their name and parameters."""
        if other.parameters().keys() != self._parameters.keys():
            return False
        if (other.poses, other.scenarios) != (self.poses, self.scenarios):
            return False
        return replace(other.with_parameters(self._parameters), name=self.name) == self


BUILT_IN: dict[str, Callable[[], Morphology]] = {}
"""The robots that model files know by name; ``robots.elastic.leg`` puts them there."""


def elastic_of(robot: Robot) -> Morphology:
    """A robot as what it has to be where elastic actuators are needed.

    Raises:
        ConfigError: where it has none.
    """
    if not isinstance(robot, Morphology):
        raise ConfigError(f"{robot.name}: has no elastic actuators, which this is for; expected a robot that has")
    return robot


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value


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


@cache
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(item.name for item in fields(kind))


def _replaced(part: _P, prefix: str, values: Mapping[str, float], owners: Set[str], taken: set[str]) -> _P:
    """A part with values by their dotted names; ``owners`` are what these begin with, ``taken`` gets those used."""
    changes: dict[str, object] = {}
    kind: type = type(part)
    for name in _field_names(kind):
        value = getattr(part, name)
        key = prefix + name
        if isinstance(value, tuple):
            children = [
                _replaced(child, f"{child.name}.", values, owners, taken) if child.name in owners else child
                for child in value
            ]
            if any(new is not old for new, old in zip(children, value, strict=True)):
                changes[name] = tuple(children)
        elif isinstance(value, JointStop | Point):
            if (child := _replaced(value, f"{key}.", values, owners, taken)) is not value:
                changes[name] = child
        elif key in values and isinstance(value, Real):
            changes[name] = float(values[key])
            taken.add(key)
    return replace(part, **changes) if changes else part  # type: ignore[arg-type]  # mypy cannot follow it so far


def pack(morphology: Morphology) -> Array:
    """The parameters of a morphology in the fixed order of ``models.elastic_equations``'s parameter vector, shape (n,).

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


def structure(morphology: Morphology) -> ElasticForm:
    """What the form of a morphology's equations depends on."""
    index = {joint.child: i for i, joint in enumerate(morphology.joints)} | {BASE: -1}
    parents = tuple(index[joint.parent] for joint in morphology.joints)
    spans = tuple((index[a.origin.body], index[a.insertion.body]) for a in morphology.actuators)
    return ElasticForm(parents, spans, index[morphology.foot])
