"""Physics that no catalogue holds: what a diagnosis has to call unexplained.

These are written as a user would write effects, but they stand in a register of their own and must never come into
``effects.REGISTRY``. Those with a force along one coordinate alone are plain ``ForceEffect``s; the others see the
whole motion and the clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from equimus_ctrl.effects.base import Effect, parameter
from equimus_ctrl.effects.force import ForceEffect, Parameters
from equimus_ctrl.effects.sizes import Share, Size
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import ElasticActuator, elastic_of

OUTSIDE: dict[str, type[Effect]] = {}
"""Name → class of everything from outside the catalogue."""


def _outside_catalogue(cls: type[Effect]) -> type[Effect]:
    cls.check_class()
    OUTSIDE[cls.name] = cls
    return cls


@dataclass(frozen=True, eq=False)
class Motion:
    """What such physics can depend on, as CasADi expressions, by name of joint or actuator.

    Attributes:
        robot: that moves.
        time: since the trial's start [s].
        x: angle of a joint [rad] or length of an actuator [m].
        rate: its derivative.
        pressure: of each actuator [Pa].
    """

    robot: Robot
    time: ca.SX
    x: Mapping[str, ca.SX]
    rate: Mapping[str, ca.SX]
    pressure: Mapping[str, ca.SX]

    def actuator(self, name: str) -> ElasticActuator:
        """The actuator called ``name``."""
        return elastic_of(self.robot).actuators[self.robot.actuator_names.index(name)]


@dataclass(frozen=True)
class MotionEffect(Effect):
    """Physics that sees the whole motion."""

    side = "force"

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        """Joint → torque [N·m], actuator → force [N], positive where they would increase its coordinate."""
        raise NotImplementedError


@_outside_catalogue
@dataclass(frozen=True)
class SquareDrag(MotionEffect):
    """−drag·|v|·v at a joint."""

    name = "square_drag"
    sits_at = ("joint",)
    summary = "drag that grows with the square of the speed"
    leg_sizes = (
        Size("drag", 0.02, 0.5, "as the hip's damping at 1 rad/s at most", at="hip"),
        Size("drag", 0.006, 0.15, "twice the knee's damping at 1 rad/s at most", at="knee"),
    )
    drag: float = parameter("N·m·s²/rad²", 0.0, 10.0, "torque at 1 rad/s")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        rate = at.rate[self.location]
        return {self.location: -self.drag * ca.fabs(rate) * rate}


@_outside_catalogue
@dataclass(frozen=True)
class CrossSpring(MotionEffect):
    """A spring across both joints, such as a hose along the leg, of energy ½·stiffness·(q₁·q₂)²."""

    name = "cross_spring"
    sits_at = ("joint",)
    summary = "a spring that couples the joints"
    leg_sizes = (Size("stiffness", 2e-3, 0.15, "a twentieth of the hip's own at a knee of 1 rad at most"),)
    stiffness: float = parameter("N·m/rad³", 0.0, 10.0, "of the coupling")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        first, second = at.robot.joint_names[:2]
        both = at.x[first] * at.x[second]
        return {first: -self.stiffness * both * at.x[second], second: -self.stiffness * both * at.x[first]}


@_outside_catalogue
@dataclass(frozen=True)
class RoughSpot(ForceEffect):
    """Dry friction of size friction·exp(−((q − centre)/width)²)."""

    name = "rough_spot"
    sits_at = ("joint",)
    summary = "dry friction about one angle only"
    neutral = {"friction": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("friction", 3e-3, 0.15, "as dry friction, in a part of the range", at="hip"),
        Size("friction", 1e-3, 0.05, "as dry friction, in a part of the range", at="knee"),
        Size("centre", 1.35, 1.65, "where the hip often passes", "linear", "hip"),
        Size("centre", 0.2, 0.8, "where the knee often passes", "linear", "knee"),
        Size("width", 0.05, 0.2, "a fraction of the range"),
    )
    mjcf_sizes = (
        Share("friction", 0.02, 0.5),
        Share("centre", 0.25, 0.75, "linear", "range"),
        Share("width", 0.05, 0.15),
    )
    friction: float = parameter("N·m", 0.0, 10.0, "at the centre of the spot")
    centre: float = parameter("rad", -3.2, 3.2, "angle of the spot")
    width: float = parameter("rad", 0.01, 3.2, "of the spot")

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return p["friction"] * ca.exp(-(((x - p["centre"]) / p["width"]) ** 2))


@_outside_catalogue
@dataclass(frozen=True)
class AngleDamping(ForceEffect):
    """−damping·((q − centre)/width)²·v."""

    name = "angle_damping"
    sits_at = ("joint",)
    summary = "damping that grows away from one angle"
    neutral = {"damping": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("damping", 0.05, 1.0, "up to twice the hip's own", at="hip"),
        Size("damping", 0.015, 0.25, "up to four times the knee's own", at="knee"),
        Size("centre", 1.2, 1.7, "within the hip's range", "linear", "hip"),
        Size("centre", 0.0, 0.9, "within the knee's range", "linear", "knee"),
        Size("width", 0.2, 0.4, "half the range"),
    )
    mjcf_sizes = (
        Share("damping", 0.02, 0.5),
        Share("centre", 0.25, 0.75, "linear", "range"),
        Share("width", 0.2, 0.4),
    )
    damping: float = parameter("N·m·s/rad", 0.0, 10.0, "at one width from the centre")
    centre: float = parameter("rad", -3.2, 3.2, "angle without it")
    width: float = parameter("rad", 0.01, 3.2, "where it has its size")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: object, p: Parameters) -> ca.SX:
        return -p["damping"] * ((x - p["centre"]) / p["width"]) ** 2 * rate


@_outside_catalogue
@dataclass(frozen=True)
class Cogging(ForceEffect):
    """size·sin(2π q/pitch): a torque that repeats along the angle; MJCF robots have it in their catalogue."""

    name = "cogging"
    sits_at = ("joint",)
    summary = "a torque that repeats with the angle"
    neutral = {"size": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("size", 1e-3, 0.1, "from below the noise to 2° of hip", at="hip"),
        Size("size", 4e-4, 0.03, "from below the noise to 2° of knee", at="knee"),
        Size("pitch", 0.12, 0.35, "once to several times within the range"),
    )
    size: float = parameter("N·m", 0.0, 10.0, "amplitude")
    pitch: float = parameter("rad", 0.01, 3.2, "angle of one repetition")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: object, p: Parameters) -> ca.SX:
        return p["size"] * ca.sin(2 * ca.pi * x / p["pitch"])


@_outside_catalogue
@dataclass(frozen=True)
class StiffnessDrift(MotionEffect):
    """An actuator's stiffness grows or falls by a share of itself each second of the trial."""

    name = "stiffness_drift"
    sits_at = ("actuator",)
    summary = "stiffness that drifts with time"
    leg_sizes = (Size("share", 6e-4, 0.03, "0.7 to 36 % within a trial", "either sign"),)
    share: float = parameter("1/s", -0.5, 0.5, "change each second")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        own = at.actuator(self.location)
        stretch = at.x[self.location] - own.rest_length
        return {self.location: -own.stiffness * self.share * at.time * stretch}


@_outside_catalogue
@dataclass(frozen=True)
class PeriodicTorque(MotionEffect):
    """size·sin(2π·frequency·t) from the trial's start on."""

    name = "periodic_torque"
    sits_at = ("joint",)
    summary = "a disturbance that repeats with time"
    leg_sizes = (
        Size("size", 2e-3, 0.1, "from below the noise to 2° of hip", at="hip"),
        Size("size", 8e-4, 0.04, "from below the noise to 3° of knee", at="knee"),
        Size("frequency", 0.3, 3.0, "slow enough to move the leg, several periods a trial"),
    )
    mjcf_sizes = (
        Share("size", 0.003, 0.3),
        Share("frequency", 0.1, 1.0),
    )
    size: float = parameter("N·m", 0.0, 10.0, "amplitude")
    frequency: float = parameter("Hz", 0.01, 50.0, "of the disturbance")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        return {self.location: self.size * ca.sin(2 * ca.pi * self.frequency * at.time)}


@_outside_catalogue
@dataclass(frozen=True)
class PressureGrowth(MotionEffect):
    """The rest length grows with the square of the pressure: stiffness·growth·(P/10 kPa)²."""

    name = "pressure_growth"
    sits_at = ("actuator",)
    summary = "rest length that depends on the command"
    leg_sizes = (
        Size("growth", 1e-4, 6e-3, "at 30 kPa nine times this", at="maa"),
        Size("growth", 2.5e-4, 2e-2, "at 15 kPa twice this, and BAA is softer", at="baa"),
    )
    growth: float = parameter("m", 0.0, 0.1, "lengthening at 10 kPa")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        own = at.actuator(self.location)
        return {self.location: own.stiffness * self.growth * (at.pressure[self.location] / 1e4) ** 2}


@_outside_catalogue
@dataclass(frozen=True)
class PressureDamping(MotionEffect):
    """An actuator is damped the more, the harder it is inflated: −damping·(P/10 kPa)·l̇."""

    name = "pressure_damping"
    sits_at = ("actuator",)
    summary = "damping that grows with the pressure"
    leg_sizes = (Size("damping", 0.8, 20.0, "up to the actuators' own at 10 kPa"),)
    damping: float = parameter("N·s/m", 0.0, 1e3, "at 10 kPa")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        return {self.location: -self.damping * at.pressure[self.location] / 1e4 * at.rate[self.location]}


@_outside_catalogue
@dataclass(frozen=True)
class Leak(MotionEffect):
    """Air passes between the actuators: both pressures move by a share of their difference towards each other."""

    name = "leak"
    sits_at = ("actuator",)
    summary = "a leak between the actuators"
    leg_sizes = (Size("share", 3e-3, 0.12, "0.3 to 12 % of the difference"),)
    share: float = parameter("1", 0.0, 0.5, "of the pressure difference that is lost")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        first, second = at.robot.actuator_names[:2]
        exchanged = self.share * (at.pressure[first] - at.pressure[second])
        areas = {name: at.actuator(name).area for name in (first, second)}
        return {first: -areas[first] * exchanged, second: areas[second] * exchanged}


@_outside_catalogue
@dataclass(frozen=True)
class Fade(MotionEffect):
    """An actuator that warms up weakens: its force falls by share·(1 − e^(−t/time_constant))."""

    name = "fade"
    sits_at = ("actuator",)
    summary = "force that fades slowly during a trial"
    leg_sizes = (
        Size("share", 6e-3, 0.35, "0.6 to 35 % of the force"),
        Size("time_constant", 2.0, 10.0, "slower than the leg, within a trial"),
    )
    share: float = parameter("1", 0.0, 0.9, "lost in the end")
    time_constant: float = parameter("s", 0.1, 1e3, "of the fading")

    def forces(self, at: Motion) -> dict[str, ca.SX]:
        own = at.actuator(self.location)
        lost = self.share * (1 - ca.exp(-at.time / self.time_constant))
        return {self.location: -lost * own.area * at.pressure[self.location]}


def acts_on(effect: Effect, robot: Robot) -> tuple[str, ...]:
    """The joints and actuators on which an effect exerts a force."""
    if not isinstance(effect, MotionEffect):
        return (effect.location,)
    names = (*robot.joint_names, *robot.actuator_names)
    symbols = {name: ca.SX.sym(name) for name in names}
    return tuple(effect.forces(Motion(robot, ca.SX.sym("t"), symbols, symbols, symbols)))
