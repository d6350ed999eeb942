"""Effects that are another robot: masses, stops and a base that are not where the model has them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol, Self, TypeVar

import numpy as np

from equimus_ctrl.effects.base import Effect, parameter, register
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.effects.sizes import Share, Size


class Robot(Protocol):
    """What these effects need of a morphology."""

    @property
    def tilt(self) -> float:
        """Angle of gravity [rad]."""
        ...

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """A copy with some parameters replaced."""
        ...

    def with_payload(self, place: str, mass: float) -> Self:
        """A copy that carries a point mass [kg]."""
        ...

    def middle(self, joint: str) -> float:
        """The angle of a joint that lies between its lower and its upper side [rad]."""
        ...

    def with_stop(self, joint: str, side: Literal["lower", "upper"], stop: tuple[float, float, float]) -> Self:
        """A copy with another stop: angle [rad], stiffness [N·m/rad], damping [N·m·s/rad]."""
        ...


R = TypeVar("R")


@dataclass(frozen=True)
class BodyEffect(Effect):
    """An effect that changes the morphology; a subclass writes ``changes``, or ``changed`` for other changes.

    One whose changes are all among what an XML of the robot holds says so by ``mjcf_form``.
    """

    side = "force"
    simulated = True
    mjcf_lacks = "its class does not say that an XML holds what it changes"

    def changes(self, robot: Robot) -> dict[str, float]:
        """Parameter name → new value, see ``Morphology.with_parameters``."""
        raise NotImplementedError

    def changed(self, robot: Any, modelled: Any) -> Any:
        """The robot that this effect makes.

        Args:
            robot: with the effects before this one.
            modelled: without any.
        """
        return robot.with_parameters(self.changes(robot))

    def write_mjcf(self, draft: Draft) -> str:
        return "" if self.mjcf_form else self.mjcf_lacks  # the robot that it makes is what is written


@register
@dataclass(frozen=True)
class PayloadMass(BodyEffect):
    """A point mass: the link's mass, centre and inertia become those of both together.

    On a robot with elastic actuators it sits at a link's tip, on an MJCF robot at a site or at the centre of
    mass of a body.
    """

    name = "payload_mass"
    robots = ("elastic", "mjcf")
    sits_at = ("foot", "link")
    summary = "mass that is not in the model, at a link's tip"
    mjcf_form = "`inertial` of the body"
    alike = False
    exclusive = "payload"
    leg_sizes = (Size("mass", 0.01, 0.3, "up to three times the calf's own; other numbers take up most of it"),)
    mjcf_sizes = (Share("mass", 0.01, 0.5),)
    mass: float = parameter("kg", 0.0, 100.0, "of the payload")

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_payload(self.location, self.mass)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"At {t.robot.carrying_point(t.places[0])} sits a mass of {t['mass']} that is not in the model."


@register
@dataclass(frozen=True)
class PayloadOffCentre(BodyEffect):
    """A point mass beside a link's centre of mass: what an arm carries sticks out of it.

    The link's mass, centre and inertia become those of both together.
    """

    name = "payload_off_centre"
    robots = ("mjcf",)
    sits_at = ("link",)
    summary = "mass that is not in the model, beside a link's centre"
    mjcf_form = "`inertial` of the body"
    alike = False
    exclusive = "payload"
    mjcf_sizes = (
        Share("mass", 0.02, 0.5),
        *(Share(axis, 0.02, 0.2, "either sign", "none") for axis in "xyz"),
    )
    mass: float = parameter("kg", 0.0, 100.0, "of the payload")
    x: float = parameter("m", -2.0, 2.0, "from the link's centre of mass along its body's first axis")
    y: float = parameter("m", -2.0, 2.0, "along the second")
    z: float = parameter("m", -2.0, 2.0, "along the third")

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_payload(self.location, self.mass, (self.x, self.y, self.z))

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        ways = [side * excitation.reach for side in (1.0, -1.0, 0.3, -0.3)]
        places = [{**dict.fromkeys("xyz", 0.0), axis: way} for axis in "xyz" for way in ways]
        return [{"mass": 0.1 * excitation.mass, **place} for place in places]

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"On {t.places[0]} sits a mass of {t['mass']} that is not in the model, {t['x']}, {t['y']} and {t['z']} "
            "from its centre of mass along its axes."
        )


class EndEffect(BodyEffect):
    """What acts on a point at an end of an MJCF robot, which has one of a kind at most.

    The point is a site, or where the XML has none the centre of mass of a body that carries no other.
    """

    sits_at = ("foot", "link")

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        places: Mapping[str, tuple[str, ...]] = robot.ends
        return places

    def slot(self, robot: Any) -> str:
        return str(robot.name)


@register
@dataclass(frozen=True)
class SpringTether(EndEffect):
    """stiffness·(anchor − p): a spring of no free length from a point p of the robot to a point of the room.

    On the joints it exerts Jᵀ·stiffness·(anchor − p), J = ∂p/∂q (virtual work; Siciliano et al., *Robotics*, 2009,
    chapter 3). p is a site, or where the XML has none the centre of mass of a body that carries no other. What does
    not move p, as a part of the anchor across a planar arm's plane, recordings cannot tell; of a single hinge they tell
    only stiffness times anchor. A robot has one at most.
    """

    name = "spring_tether"
    robots = ("mjcf",)
    summary = "a spring to a point in the room: a hose, a cable, a balancer"
    mjcf_form = "a spatial `tendon` with `stiffness`"
    alike = False
    exclusive = "spring_tether"
    mujoco_flags = ("spring",)
    mjcf_sizes: ClassVar[tuple[Share, ...]] = (
        Share("stiffness", 0.1, 3.0),
        *(Share(axis, 0.2, 0.8, "either sign", "none") for axis in "xyz"),
    )
    stiffness: float = parameter("N/m", 0.0, 1e5, "of the spring")
    x: float = parameter("m", -10.0, 10.0, "of its end in the room, along the model's first axis")
    y: float = parameter("m", -10.0, 10.0, "along the second")
    z: float = parameter("m", -10.0, 10.0, "along the third")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        way = 2.0 * excitation.roams
        force = excitation.force * excitation.span / excitation.roams  # at that point, by virtual work
        stiffness = 0.1 * force / way
        middle = dict(zip("xyz", excitation.middle, strict=True))
        return [{"stiffness": stiffness, **middle, axis: middle[axis] + side} for axis in "xyz" for side in (way, -way)]

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_tether(self.location, self.stiffness, (self.x, self.y, self.z))

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"A spring of {t['stiffness']} pulls {t.places[0]} towards the point {t['x']}, {t['y']} and {t['z']} along "
            "the model's axes: a hose, a cable or a balancer that is not in the model."
        )


DISTANCES = np.array([0.5, 1.0, 2.0, 4.0])
"""Of a spring's end in the room from its other end, in twice the way that this one roams, where fits begin."""
FREE = (0.3, 0.6, 0.9)
"""Of that distance the free lengths."""


@register
@dataclass(frozen=True)
class TetherWithFreeLength(SpringTether):
    """stiffness·(1 − length/|anchor − p|)·(anchor − p): a spring that is free of force at a length of its own.

    From a point p of the robot to a point of the room, pulling where it is longer and pushing where it is shorter, as
    MuJoCo's tendons do (documentation, *Modeling*, ``springlength``); see ``SpringTether``. Across a planar arm's plane
    recordings tell how far the point is, not on which side.
    """

    name = "tether_with_free_length"
    mjcf_form = "a spatial `tendon` with `stiffness` and `springlength`"
    summary = "the same with a length at which it is free of force: a coil spring, an elastic cord"
    even = ("x", "y", "z")
    mjcf_sizes = (*SpringTether.mjcf_sizes, Share("length", 0.1, 0.5, "linear", "none"))
    length: float = parameter("m", 0.0, 10.0, "at which it is free of force")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        without = super().guesses(excitation)
        return [{**own, "length": share * excitation.roams} for share in (1.0, 0.2) for own in without]

    @classmethod
    def begun_at(cls, simpler: Mapping[str, float], guesses: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
        """With the same force where its end is mostly, from a point near or far, hardly or far beyond its length."""
        middle = np.array([[guess[axis] for axis in "xyz"] for guess in guesses]).mean(axis=0)
        pull = simpler["stiffness"] * (np.array([simpler[axis] for axis in "xyz"]) - middle)
        size, way = float(np.linalg.norm(pull)), 2.0 * max(guess["length"] for guess in guesses)
        found = [{**simpler, "length": way / 10}]
        for distance in way * DISTANCES:
            anchor = dict(zip("xyz", (middle + distance * pull / max(size, 1e-300)).tolist(), strict=True))
            for share in FREE:
                length = share * distance
                found.append({"stiffness": size / (distance - length), **anchor, "length": length})
        return [{key: one[key] for key in guesses[0]} for one in found]

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_tether(self.location, self.stiffness, (self.x, self.y, self.z), self.length)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"A spring of {t['stiffness']}, free of force at a length of {t['length']}, lies between {t.places[0]} and "
            f"the point {t['x']}, {t['y']} and {t['z']} along the model's axes: it is not in the model."
        )


HIGHEST = 0.1
"""A surface so far above the lowest place of what touches it, as a share of what that rises, is none: the measured
motion goes through it, by more than sensors' zeros or lengths of links are usually wrong."""


@register
@dataclass(frozen=True)
class PlaneContact(EndEffect):
    """A level plane in the room, a table or a floor, below which a point p of the robot cannot go.

    n·p ≥ height, n against the model's gravity. On the joints it exerts Jᵀ·n·f, J = ∂p/∂q, f ≥ 0, without friction: one
    of MuJoCo's soft contacts (documentation, *Computation*, "Constraint model") as hard as the XML's step allows (a
    time constant of two steps, critically damped) with MuJoCo's default impedance. p is a site, or where the XML has
    none the centre of mass of a body that carries no other; nothing else touches the plane. A robot has one at most,
    and none without gravity.
    """

    name = "plane_contact"
    robots = ("mjcf",)
    summary = "a table or a floor that is not in the model"
    mjcf_form = "a plane, a small sphere and a contact `pair` of both"
    alike = False
    nothing = None
    weaker = -1
    in_torques = False  # a contact's force follows from less than a millimetre, which measured angles do not show
    exclusive = "plane_contact"
    mujoco_flags = ("contact", "constraint")
    height: float = parameter("m", -10.0, 10.0, "of the plane, from the room's origin against gravity")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        # No measured motion goes through the plane; below all of it the plane does nothing.
        return [{"height": excitation.lowest + share * excitation.rises} for share in (0.0, 0.02, HIGHEST)]

    @classmethod
    def degenerate(cls, values: Mapping[str, float], excitation: Excitation) -> bool:
        return values["height"] > excitation.lowest + HIGHEST * excitation.rises

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_surface(self.location, self.height)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"At {t.places[0]} the robot touches a level surface at a height of {t['height']}: a table or a floor that "
            "is not in the model."
        )


@register
@dataclass(frozen=True)
class GravityTilt(BodyEffect):
    """Gravity turned by ``angle`` against the base."""

    name = "gravity_tilt"
    robots = ("elastic", "mjcf")
    sits_at = ("base",)
    summary = "the base is not level"
    mjcf_form = "`gravity`"
    leg_sizes = (Size("angle", 0.015, 0.3, "1° to 17°; stiffness and rest lengths take up most of it", "either sign"),)
    mjcf_sizes = (Share("angle", 0.005, 0.15, "either sign", "none"),)
    angle: float = parameter("rad", -1.6, 1.6, "of gravity, from the base's downward axis")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"angle": angle} for angle in (0.03, -0.03, 0.15, -0.15)]

    def changes(self, robot: Robot) -> dict[str, float]:
        return {"tilt": robot.tilt + self.angle}

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"The base is not level: gravity leans by {t['angle']} against the model's."


@register
@dataclass(frozen=True)
class JointStop(BodyEffect):
    """A joint's end stop at another place, or softer or harder: it replaces the modelled one on the side it lies on.

    That is the lower side where its angle is below the middle of the modelled range, else the upper. A stop that is not
    modelled counts as half a turn from the one that is; a joint without any has its middle where it hangs straight
    down with all that carries it. One joint can have one of these on each side.
    """

    name = "joint_stop"
    sits_at = ("joint",)
    summary = "an end stop at another place or softer than modelled"
    mjcf_form = "`range`, `solreflimit` and `solimplimit` of the joint or of a fixed `tendon` over it"
    nothing = None
    alike = False
    exclusive = "joint_stop"
    leg_sizes = (
        Size("angle", 1.6, 1.75, "where the hip often comes, far inside its modelled stop", "linear", "hip"),
        Size("angle", -0.02, 0.35, "above the modelled stop at -0.035 rad", "linear", "knee"),
        Size("stiffness", 2.0, 100.0, "a rubber to half the modelled stop"),
        Size("damping", 0.02, 0.5, "at most half the modelled stop's"),
    )
    angle: float = parameter("rad", -6.3, 6.3, "where it begins")
    stiffness: float = parameter("N·m/rad", 0.0, 1e4, "of its spring")
    damping: float = parameter("N·m·s/rad", 0.0, 100.0, "of its damper, while it is pressed")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        places = [excitation.low + share * excitation.span for share in (0.02, 0.1, 0.25, 0.75, 0.9, 0.98)]
        slope = excitation.force / excitation.span
        return [
            {"angle": angle, "stiffness": hard * slope, "damping": 0.1 * hard * excitation.force / excitation.speed}
            for angle in places
            for hard in (3.0, 30.0)
        ]

    @classmethod
    def fades_to(cls) -> Mapping[str, float]:
        return {"stiffness": 0.0, "damping": 0.0}  # short of the stop that it replaces

    @classmethod
    def degenerate(cls, values: Mapping[str, float], excitation: Excitation) -> bool:
        # Softer than what holds the joint anyway it stops nothing: a spring that sets in.
        return values["stiffness"] * excitation.span < excitation.force

    def slot(self, robot: Any) -> str:
        return f"{self.location}, {self._side(robot)} side"

    def bounds(self, key: str, robot: Any) -> tuple[float, float]:
        low, high = super().bounds(key, robot)
        if key != "angle":
            return low, high
        middle = robot.middle(self.location)
        # The middle itself belongs to the upper side.
        return (low, math.nextafter(middle, low)) if self._side(robot) == "lower" else (middle, high)

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_stop(self.location, self._side(modelled), (self.angle, self.stiffness, self.damping))

    def _side(self, robot: Robot) -> Literal["lower", "upper"]:
        return "lower" if self.angle < robot.middle(self.location) else "upper"

    @classmethod
    def sentence(cls, t: Description) -> str:
        place, robot = t.places[0], t.robot
        joint, lower = robot.joint(place), t.value("angle") < robot.middle(place)
        side, modelled = ("lower", joint.lower) if lower else ("upper", joint.upper)
        instead = "which the model does not have" if modelled is None else f"not at {t.quantity(modelled.angle, 'rad')}"
        return (
            f"The {side} stop of the {place} begins at {t['angle']}, {instead}, with a stiffness of {t['stiffness']} "
            f"and a damping of {t['damping']}."
        )


def changed_bodies(effects: Sequence[Effect], robot: R) -> R:
    """The robot that these effects make of one."""
    changed = robot
    for effect in effects:
        if isinstance(effect, BodyEffect):
            changed = effect.changed(changed, robot)
    return changed
