"""Effects of joints that motors drive: drives that give way, forces that are off.

They are for MJCF robots. What MuJoCo has a field for goes there; the rest is stepped with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from equimus_ctrl.effects.base import parameter, register
from equimus_ctrl.effects.bodies import BodyEffect
from equimus_ctrl.effects.description import CURVE_POINTS, Curve, Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect, Parameters
from equimus_ctrl.effects.native import Draft, add_constant_force, add_ripple
from equimus_ctrl.effects.sizes import Share
from equimus_ctrl.effects.valves import ShapingEffect
from equimus_ctrl.types import Array

SOFT = 1.0
"""Frequency of a joint on its drive's spring below which the drive would not drive it [Hz]."""


@register
@dataclass(frozen=True)
class TorqueRipple(ForceEffect):
    """sine·sin(2π·x/period) + cosine·cos(2π·x/period): a motor's cogging, a gear's ripple.

    One harmonic of the torque that a motor's magnets and slots exert without current (Holtz & Springob, "Identification
    and compensation of torque ripple in high-precision permanent magnet motor drives", 1996).
    """

    name = "torque_ripple"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "a force that comes back along the way: a motor's cogging, a gear's ripple"
    mjcf_form = "`cogging` of a passive `dcmotor`"
    alike = False
    neutral = {"sine": 0.0, "cosine": 0.0}  # noqa: RUF012
    mjcf_sizes = (
        Share("sine", 0.02, 0.3, "either sign"),
        Share("cosine", 0.02, 0.3, "either sign"),
        Share("period", 0.1, 0.5),
    )
    sine: float = parameter("N·m", -1e3, 1e3, "of its part that is 0 where the coordinate is")
    cosine: float = parameter("N·m", -1e3, 1e3, "of its part that is greatest there")
    period: float = parameter("rad", 1e-3, 6.3, "way after which it comes back")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        # A fit finds a period where the guess is off by less than half a wave over what is covered.
        size = excitation.sizes("N·m")[1]
        return [
            {"sine": size, "cosine": size, "period": excitation.span / waves} for waves in np.arange(1.5, 12.6, 1.0)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        turn = 2 * math.pi * x / p["period"]
        return p["sine"] * ca.sin(turn) + p["cosine"] * ca.cos(turn)

    def write_mjcf(self, draft: Draft) -> str:
        return add_ripple(draft, self.location, self.sine, self.cosine, self.period, self.name)

    @classmethod
    def degenerate(cls, values: Mapping[str, float], excitation: Excitation) -> bool:
        return values["period"] > excitation.span  # less than one wave is any force of the coordinate

    @classmethod
    def sentence(cls, t: Description) -> str:
        size = t.quantity(math.hypot(t.value("sine"), t.value("cosine")), t.unit("sine"))
        return (
            f"A force of {size} at {t.the} comes back every {t['period']}, {t['sine']} times its sine and "
            f"{t['cosine']} times its cosine: cogging, or a gear's ripple."
        )


@register
@dataclass(frozen=True)
class ConstantForce(ForceEffect):
    """A constant generalised force."""

    name = "constant_force"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "a constant force: a drive's offset, a weight on a string"
    mjcf_form = "`biasprm` of the joint's actuator, or `cogging` of no period of a passive `dcmotor`"
    alike = False
    neutral = {"size": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("size", 0.003, 0.3, "either sign"),)
    size: float = parameter("N·m", -1e3, 1e3, "of the force")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return p["size"]

    def write_mjcf(self, draft: Draft) -> str:
        return add_constant_force(draft, self.location, self.size, self.name)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"A constant force on {t.the} of {t['size']}."


@register
@dataclass(frozen=True)
class DriveCompliance(BodyEffect):
    """A spring and a damper between a drive, which turns with the joint's armature, and its joint."""

    name = "joint_compliance"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "a drive that gives way: a belt, a flexible gear"
    mjcf_form = "a body and a joint of the rotor, and a `tendon` with `stiffness` and `damping`"
    in_torques = False
    mujoco_flags = ("damper", "spring")
    nothing = None
    weaker = 1
    alike = False
    exclusive = "compliance"
    mjcf_sizes = (
        Share("stiffness", 2.0, 100.0),
        Share("damping", 0.02, 0.3),
    )
    stiffness: float = parameter("N·m/rad", 1e-2, 1e7, "of the spring")
    damping: float = parameter("N·m·s/rad", 0.0, 1e4, "of its damper")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        stiff = excitation.force / excitation.span
        return [
            {"stiffness": hard * stiff, "damping": 0.02 * hard * excitation.force / excitation.speed}
            for hard in (3.0, 10.0, 30.0)
        ]

    def bounds(self, key: str, robot: Any) -> tuple[float, float]:
        # What gives way at less than SOFT is no drive any more.
        low, high = super().bounds(key, robot)
        least = robot.weights[self.location] * (2 * math.pi * SOFT) ** 2
        return (max(low, least), high) if key == "stiffness" else (low, min(high, least))

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_compliance(self.location, self.stiffness, self.damping, 0.0)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"Between {t.the} and its drive there is a spring of {t['stiffness']} with a damping of {t['damping']}: "
            "the drive gives way."
        )


@register
@dataclass(frozen=True)
class DrivePlay(BodyEffect):
    """Play between a drive, which turns with the joint's armature, and its joint: within it neither feels the other.

    Its ends are MuJoCo's limits of a tendon, as hard as the physics step can follow.
    """

    name = "drive_play"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "play between drive and joint"
    mjcf_form = "a body and a joint of the rotor, and a `tendon` with a `range`"
    in_torques = False
    mujoco_flags = ("constraint", "limit")
    alike = False
    exclusive = "compliance"
    mjcf_sizes = (Share("play", 0.002, 0.1),)
    play: float = parameter("rad", 0.0, 1.0, "way that the drive turns before its joint follows")

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_play(self.location, self.play)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Between {t.the} and its drive there is a play of {t['play']}."


@register
@dataclass(frozen=True)
class RotorInertia(BodyEffect):
    """−inertia·acceleration of the joint: what turns with a drive, whose gear counts it by its ratio squared.

    Only where the XML has no armature; one that it has is a parameter of the model (Siciliano et al., *Robotics*, 2009,
    chapter 7).
    """

    name = "rotor_inertia"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "an inertia that turns with the drive alone: a rotor behind a gear"
    mjcf_form = "`armature`"
    exclusive = "rotor_inertia"
    mjcf_sizes = (Share("inertia", 0.02, 0.5),)
    inertia: float = parameter("kg·m²", 0.0, 1e4, "of the rotor, at the joint")

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        return {**robot.places(), "joint": robot.joints_without_rotor}

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        # That which the joint's force would turn about its range at its speed.
        whole = excitation.scale("kg·m²")
        return [{"inertia": share * whole} for share in (0.03, 0.1, 0.3)]

    def changes(self, robot: Any) -> dict[str, float]:
        own = f"{self.location}.armature"
        return {own: robot.parameters()[own] + self.inertia}

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"With the drive of {t.the} turns an inertia of {t['inertia']} that the model does not have: a rotor."


@register
@dataclass(frozen=True)
class MotorDeadZone(ShapingEffect):
    """u' = sign(u)·max(|u| − threshold, 0).

    Tao & Kokotović, *Adaptive Control of Systems with Actuator and Sensor Nonlinearities*, 1996. Of drives whose
    command is a force or a speed: nothing is lost of a goal for where something is.
    """

    name = "motor_dead_zone"
    robots = ("mjcf",)
    summary = "small commands of either sign do nothing, and larger ones lose as much"
    mjcf_lacks = "MuJoCo's gains have no dead zone"
    exclusive = "motor_dead_zone"
    order = 0
    mjcf_sizes = (Share("threshold", 0.02, 0.3),)
    threshold: float = parameter("command", 0.0, 1e4, "size that a command loses, and below which it does nothing")

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        return {**robot.places(), "actuator": robot.motors}

    def shape(self, commands: Array, own: int) -> Array:
        given = commands[:, own]
        return np.asarray(np.sign(given) * np.maximum(np.abs(given) - self.threshold, 0.0))

    @classmethod
    def sentence(cls, t: Description) -> str:
        lose = t.one_or("loses", "each lose")
        return f"{t.at} {lose} the first {t['threshold']} of every command, of either sign: a dead zone."


@register
@dataclass(frozen=True)
class SupplySag(ShapingEffect):
    """u_i' = u_i·max(1 − drop·Σ_j |u_j|, 0): drives on one supply exert less, the more all of them ask for.

    A supply of inner resistance R has the voltage V₀ − R·Σ I_j under the currents I_j of its drives. The force of a
    motor that is fed a share of that voltage goes with it, and its current with the size of its command (Hughes &
    Drury, *Electric Motors and Drives*, 2019).

    Every drive counts by its command as the XML takes it, clipped to the range of the drive. What current belongs to
    it, τ/(gear ratio·torque constant), an XML driven by torques does not tell. From one voltage a drive draws about its
    power, and joints of one robot move about as fast as each other: so currents go with torques, and not with shares of
    each drive's own range, by which a small wrist would count as much as a shoulder.

    Only of robots all of whose drives, two or more, are motors with commands of one unit: a goal is no force, and
    forces and torques have no sum. It comes after a dead zone, and before delays, filters and limits of drives.
    """

    name = "supply_sag"
    robots = ("mjcf",)
    sits_at = ("base",)
    summary = "all drives exert less, the more all of them together ask of their supply"
    mjcf_lacks = "MuJoCo's actuators know their own commands alone"
    exclusive = "supply_sag"
    order = 1
    within_ranges = True
    mjcf_sizes = (Share("drop", 0.01, 0.15),)
    drop: float = parameter("1/command", 0.0, 1e4, "share of the force that is lost for each unit of all commands")

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        places = robot.places()
        return {**places, "base": places["base"] if len(robot.sharing) > 1 else ()}

    def columns(self, actuators: Sequence[str]) -> tuple[int, ...]:
        return tuple(range(len(actuators)))

    def shape(self, commands: Array, own: int) -> Array:
        return np.asarray(commands[:, own] * self._left(np.abs(commands).sum(axis=1)))

    def _left(self, total: Array) -> Array:
        """(n,) the share that is left of all forces, under totals (n,) of all commands."""
        return np.maximum(1.0 - self.drop * total, 0.0)

    @classmethod
    def sentence(cls, t: Description) -> str:
        (unit,) = {t.robot.command_unit(name) for name in t.robot.sharing}
        lost = t.scaled("drop", "%", 100.0)
        each = "unit" if unit == "1" else unit
        return f"All drives lose {lost} of their force for each {each} of all commands together: a supply that sags."

    def curves(self, robot: Any, excitation: Excitation) -> tuple[Curve, ...]:
        total = np.linspace(0.0, len(robot.sharing) * excitation.command, CURVE_POINTS)
        unit = robot.command_unit(robot.sharing[0])
        return (
            Curve("share of forces", "sum of all commands", unit, "what is left", "1", total, self._left(total), 1.0),
        )


@register
@dataclass(frozen=True)
class ActuatorGain(BodyEffect):
    """Forces of an actuator are ``factor`` times what they are taken to be."""

    name = "actuator_gain"
    robots = ("mjcf",)
    sits_at = ("actuator",)
    summary = "the drive exerts more or less force than its command says"
    mjcf_form = "`gainprm` and `biasprm`, or `gear`"
    in_torques = False  # all that is needed could be less at once, masses included: least squares would prefer it
    nothing = 1.0
    exclusive = "actuator_gain"
    mjcf_sizes = (Share("factor", 0.01, 0.3, "about one"),)
    factor: float = parameter("1", 0.1, 10.0, "on the forces")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"factor": factor} for factor in (0.95, 1.05, 0.8, 1.25)]

    @classmethod
    def depends(cls) -> set[str]:
        return {"cmd"}

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_gain(self.location, self.factor)

    @classmethod
    def sentence(cls, t: Description) -> str:
        side = "more" if t.value("factor") > 1 else "less"
        size = t.scaled("factor", "%", math.copysign(100.0, t.value("factor") - 1), 1.0)
        return f"{t.at} {t.one_or('exerts', 'exert')} {size} {side} force than the model says."


@register
@dataclass(frozen=True)
class TorqueSaturation(BodyEffect):
    """Forces of an actuator are no larger than ``level``, in either direction: a supply's voltage, a current limit."""

    name = "torque_saturation"
    robots = ("mjcf",)
    sits_at = ("actuator",)
    summary = "the drive's force stops growing at a level"
    mjcf_form = "`forcerange`"
    nothing = None
    weaker = 1
    exclusive = "torque_saturation"
    mjcf_sizes = (Share("level", 0.4, 0.97, "linear", "drive"),)
    level: float = parameter("N·m", 1e-6, 1e6, "the greatest force there is")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"level": share * excitation.drive} for share in (0.95, 0.85, 0.7, 0.55, 0.4)]

    @classmethod
    def depends(cls) -> set[str]:
        return {"cmd"}

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_limit(self.location, self.level)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"{t.actuation} {t.one_or('stops', 'stop')} growing at {t['level']}: a saturation."
