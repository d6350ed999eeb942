"""Effects of joints that motors drive: friction of many kinds, drives that give way, forces that are off.

They are for MJCF robots. What MuJoCo has a field for goes there; the rest is stepped with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from equimus_ctrl.effects.base import parameter, register
from equimus_ctrl.effects.bodies import BodyEffect
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect, Parameters
from equimus_ctrl.effects.native import add_constant_force
from equimus_ctrl.effects.sizes import Share

SOFT = 1.0
"""Frequency of a joint on its drive's spring below which the drive would not drive it [Hz]."""


UNLIKE = 1.3
"""Least factor between dry friction forwards and backwards that is called different."""


@register
@dataclass(frozen=True)
class ViscousFriction(ForceEffect):
    """−damping·rate."""

    name = "viscous_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "friction in proportion to speed"
    mujoco_field = ("dof_damping", None)
    mujoco_flags = ("damper",)
    neutral = {"damping": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("damping", 0.003, 0.5),)
    damping: float = parameter("N·m·s/rad", 0.0, 1e4, "torque for each speed")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["damping"] * rate

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Friction at {t.the} in proportion to speed, of {t['damping']}{t.one_or('', ' each')}."


@register
@dataclass(frozen=True)
class QuadraticDamping(ForceEffect):
    """−drag·rate·|rate|."""

    name = "quadratic_damping"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "drag that grows with the square of speed"
    mujoco_field = ("dof_dampingpoly", 0)
    mujoco_flags = ("damper",)
    neutral = {"drag": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("drag", 0.003, 0.5),)
    drag: float = parameter("N·m·s²/rad²", 0.0, 1e4, "torque for each square of speed")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["drag"] * rate * ca.fabs(rate)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"A drag at {t.the} that grows with the square of speed, of {t['drag']}{t.one_or('', ' each')}."


@register
@dataclass(frozen=True)
class AsymmetricDamping(ForceEffect):
    """−difference·|rate|/2: damping that is larger by ``difference`` forwards than backwards."""

    name = "asymmetric_damping"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "viscous friction that differs between the two directions"
    alike = False
    neutral = {"difference": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("difference", 0.01, 0.5, "either sign"),)
    difference: float = parameter("N·m·s/rad", -1e4, 1e4, "of the damping forwards over that backwards")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["difference"] * ca.fabs(rate) / 2

    @classmethod
    def sentence(cls, t: Description) -> str:
        more = "forwards" if t.value("difference") > 0 else "backwards"
        size = t.scaled("difference", t.unit("difference"), math.copysign(1.0, t.value("difference")))
        return f"Viscous friction at {t.the} is larger {more}, by {size}."


@register
@dataclass(frozen=True)
class AsymmetricFriction(ForceEffect):
    """Dry friction of size ``forward`` where rate > 0 and ``backward`` where rate < 0."""

    name = "asymmetric_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction that differs between the two directions"
    alike = False
    exclusive = "dry friction"
    neutral = {"forward": 0.0, "backward": 0.0}  # noqa: RUF012
    mjcf_sizes = (
        Share("forward", 0.003, 0.3),
        Share("backward", 0.003, 0.3),
    )
    forward: float = parameter("N·m", 0.0, 100.0, "size of the friction of forward motion")
    backward: float = parameter("N·m", 0.0, 100.0, "of backward motion")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"forward": size * share, "backward": size * (2 - share)}
            for size in excitation.sizes("N·m")
            for share in (0.5, 0.9, 1.1, 1.5)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return (p["backward"] - p["forward"]) / 2

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return (p["forward"] + p["backward"]) / 2

    def write_mjcf(self, mujoco_model: Any) -> bool:
        # Friction of the mean size, and what is left of the difference between the directions.
        if not add_constant_force(mujoco_model, self.location, (self.backward - self.forward) / 2):
            return False
        mujoco_model.dof_frictionloss[mujoco_model.joint(self.location).dofadr[0]] += (self.forward + self.backward) / 2
        return True

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return max(values.values()) < UNLIKE * min(values.values())

    @classmethod
    def sentence(cls, t: Description) -> str:
        sizes = f"{t['forward']} forwards and {t['backward']} backwards"
        return f"Dry friction at {t.the} differs between directions: {sizes}."


@register
@dataclass(frozen=True)
class LoadFriction(ForceEffect):
    """Dry friction of size share·|force of the drive|, beside any other: a gear's losses."""

    name = "load_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction in proportion to the drive's force"
    neutral = {"share": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("share", 0.01, 0.4),)
    share: float = parameter("1", 0.0, 1.0, "of the drive's force")

    @classmethod
    def friction_of_load(cls, load: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return p["share"] * load

    @classmethod
    def sentence(cls, t: Description) -> str:
        share = t.scaled("share", "%", 100.0)
        return f"Dry friction at {t.the} of {share} of the drive's force: a gear's losses."


@register
@dataclass(frozen=True)
class ConstantForce(ForceEffect):
    """A constant generalised force."""

    name = "constant_force"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "a constant force: a drive's offset, a weight on a string"
    alike = False
    neutral = {"size": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("size", 0.003, 0.3, "either sign"),)
    size: float = parameter("N·m", -1e3, 1e3, "of the force")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return p["size"]

    def write_mjcf(self, mujoco_model: Any) -> bool:
        return add_constant_force(mujoco_model, self.location, self.size)

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
    in_torques = False
    mujoco_flags = ("damper", "spring")
    nothing = None
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
class ActuatorGain(BodyEffect):
    """Forces of an actuator are ``factor`` times what they are taken to be."""

    name = "actuator_gain"
    robots = ("mjcf",)
    sits_at = ("actuator",)
    summary = "the drive exerts more or less force than its command says"
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
    nothing = None
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
