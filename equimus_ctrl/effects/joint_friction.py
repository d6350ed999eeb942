"""Effects of joints that motors drive: what opposes their motion.

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
from equimus_ctrl.effects.description import CURVE_POINTS, Curve, Description
from equimus_ctrl.effects.drives import ConstantForce
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import CoulombFriction, ForceEffect, Parameters
from equimus_ctrl.effects.memory import presliding
from equimus_ctrl.effects.native import Draft, add_constant_force, add_friction, add_presliding_friction
from equimus_ctrl.effects.sizes import Share

UNLIKE = 1.3
"""Least factor between two sizes of dry friction, as forwards and backwards, that are called different."""
MOVED = 0.1
"""For so long a joint counts as having moved before a trial as it does at its start [s]."""


@register
@dataclass(frozen=True)
class ViscousFriction(ForceEffect):
    """−damping·rate."""

    name = "viscous_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "friction in proportion to speed"
    mjcf_form = "`damping`"
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
    mjcf_form = "the second coefficient of `damping`"
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


class _OverTime(ForceEffect):
    """Viscous friction that changes with the time since the recording began, the law's only state."""

    robots = ("mjcf",)
    sits_at = ("joint",)
    exclusive = "friction_drift"
    mjcf_lacks = "MuJoCo has no damping that changes with time"
    n_states = 1

    @classmethod
    def damping(cls, time: ca.SX, p: Parameters) -> ca.SX:
        """What there is of it at a time since the recording began [N·m·s/rad or N·s/m]."""
        raise NotImplementedError

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -cls.damping(z[0], p) * rate

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        return (ca.SX(1),)

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (ca.SX(0),)

    @classmethod
    def start_state(cls, x: ca.SX, rate: ca.SX, time: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (time,)

    @classmethod
    def depends(cls) -> set[str]:
        return {"vel", "time"}

    def curves(self, robot: Any, excitation: Excitation) -> tuple[Curve, ...]:
        """What it adds to viscous friction, over a recording."""
        time, at = np.linspace(0.0, excitation.lasts, CURVE_POINTS), ca.SX.sym("time")
        p = {key: ca.SX(value) for key, value in self.parameters().items()}
        values = np.array(ca.Function("damping", [at], [self.damping(at, p)])(time[None])).ravel()
        unit = robot.place_unit("N·m·s/rad", self.location)
        what = ("time since the recording began", "s", "change of the viscous friction", unit)
        return (Curve("viscous friction over time", *what, time, values),)


@register
@dataclass(frozen=True)
class FrictionDrift(_OverTime):
    """−slope·t·rate, t the time since the recording began: viscous friction that changes while it lasts.

    Friction of gears falls as their grease warms up, within minutes to hours, and what is viscous in it most
    (Bittencourt, Wernholt, Sander-Tavallaey & Brogårdh, "An extended friction model to capture load and temperature
    effects in robot joints", 2010). A recording much shorter than that shows the beginning of it, which is a line; one
    that shows more is for ``friction_warmup``. What there is at t = 0 is the model's own viscous friction, so a slope
    may have either sign.
    """

    name = "friction_drift"
    summary = "viscous friction that drifts with the time since the recording began"
    neutral = {"slope": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("slope", 0.01, 0.5),)  # upwards: friction that falls below none would drive the joint
    slope: float = parameter("N·m·s/rad/s", -1e4, 1e4, "change of the torque for each speed, each second")

    @classmethod
    def damping(cls, time: ca.SX, p: Parameters) -> ca.SX:
        return p["slope"] * time

    @classmethod
    def sentence(cls, t: Description) -> str:
        more = "grows" if t.value("slope") > 0 else "falls"
        size = t.scaled("slope", t.unit("slope"), math.copysign(1.0, t.value("slope")))
        return f"Viscous friction at {t.the} {more} while a recording lasts, by {size}{t.one_or('', ' each')}."


@register
@dataclass(frozen=True)
class FrictionWarmup(_OverTime):
    """−size·exp(−t/time_constant)·rate, t the time since the recording began: friction that fades as a joint warms up.

    A joint that works settles at a temperature in about an exponential, and its friction goes with that (Bittencourt et
    al., 2010, see ``friction_drift``, which is the beginning of it). Warm, what is left is the model's own viscous
    friction.
    """

    name = "friction_warmup"
    summary = "viscous friction that fades exponentially while the joint warms up"
    tends_to = {ViscousFriction.name: {"damping": "size"}}  # noqa: RUF012
    neutral = {"size": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("size", 0.01, 0.5), Share("time_constant", 0.2, 1.0, of="recording"))
    size: float = parameter("N·m·s/rad", 0.0, 1e4, "torque for each speed that is lost from the beginning until warm")
    time_constant: float = parameter("s", 0.1, 1e4, "of the warming up")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"size": size, "time_constant": share * excitation.lasts}
            for size in excitation.sizes("N·m·s/rad")
            for share in (0.25, 1.0)
        ]

    @classmethod
    def damping(cls, time: ca.SX, p: Parameters) -> ca.SX:
        return p["size"] * ca.exp(-time / p["time_constant"])

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"Viscous friction at {t.the} falls by {t['size']}{t.one_or('', ' each')} until warm, with a time constant "
            f"of {t['time_constant']} from the start of a recording on."
        )


@register
@dataclass(frozen=True)
class AsymmetricDamping(ForceEffect):
    """−difference·|rate|/2: damping that is larger by ``difference`` forwards than backwards."""

    name = "asymmetric_damping"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "viscous friction that differs between the two directions"
    mjcf_lacks = "MuJoCo's polynomials of damping are odd in the speed"
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
    mjcf_form = "`frictionloss` and a constant force, see `constant_force`"
    alike = False
    exclusive = "dry friction"
    special_cases = {"friction": ("forward", "backward")}  # noqa: RUF012
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
    def as_sum(cls, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        forward, backward = values["forward"], values["backward"]
        return {
            CoulombFriction.name: {"friction": (forward + backward) / 2},
            ConstantForce.name: {"size": (backward - forward) / 2},
        }

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return (p["backward"] - p["forward"]) / 2

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return (p["forward"] + p["backward"]) / 2

    def write_mjcf(self, draft: Draft) -> str:
        # Friction of the mean size, and what is left of the difference between the directions.
        told = add_constant_force(draft, self.location, (self.backward - self.forward) / 2, self.name)
        if not told:
            add_friction(draft, self.location, (self.forward + self.backward) / 2)
        return told

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return max(values.values()) < UNLIKE * min(values.values())

    @classmethod
    def sentence(cls, t: Description) -> str:
        sizes = f"{t['forward']} forwards and {t['backward']} backwards"
        unit = t.unit("forward")
        mean, rest = ((t.value("backward") + sign * t.value("forward")) / 2 for sign in (1, -1))
        same = f"dry friction of {t.quantity(mean, unit)} with a constant force of {t.quantity(rest, unit)}"
        return f"Dry friction at {t.the} differs between directions: {sizes}. That is the same as {same}."


@register
@dataclass(frozen=True)
class DahlFriction(ForceEffect):
    """−friction·z, dz/dt = (rate − |rate|·z)/distance: dry friction that gives way like a spring before it slides.

    Its stiffness after a reversal is friction/distance (Dahl, *A solid friction model*, 1968). Of legs' actuators it is
    ``hysteresis``. Where a recording starts nobody has seen the way before: z is what a long motion at the rate of
    then, of ``MOVED`` seconds from rest, makes of it.
    """

    name = "dahl_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction with presliding: it builds up over a distance (Dahl)"
    mjcf_form = "`lugre` of a passive `dcmotor`"
    exclusive = "dry friction"
    n_states = 1
    quick_states = True
    neutral = {"friction": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("friction", 0.01, 0.3), Share("distance", 0.01, 0.1))
    friction: float = parameter("N·m", 0.0, 100.0, "size after a long way in one direction")
    distance: float = parameter("rad", 1e-3, 10.0, "over which it builds up")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"friction": size, "distance": share * excitation.span}
            for size in excitation.sizes("N·m")
            for share in (0.01, 0.05)
        ]

    @classmethod
    def depends(cls) -> set[str]:
        """Of what forces at joints are shown over, the speed: after a distance it is dry friction."""
        return {"vel"}

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["friction"] * z[0]

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        return (presliding(rate, z[0], p["distance"]),)

    def write_mjcf(self, draft: Draft) -> str:
        return add_presliding_friction(draft, self.location, self.friction, self.distance, self.name)

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (ca.SX(0),)

    @classmethod
    def start_state(cls, x: ca.SX, rate: ca.SX, time: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (ca.sign(rate) * (1 - ca.exp(-MOVED * ca.fabs(rate) / p["distance"])),)

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return values["distance"] < 2 * float(cls.parameter_info()["distance"]["low"])

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Dry friction at {t.the} of {t['friction']}{t.one_or('', ' each')} that builds up over {t['distance']}."


@register
@dataclass(frozen=True)
class LoadFriction(ForceEffect):
    """Dry friction of size share·|force of the drive|, beside any other: a gear's losses."""

    name = "load_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction in proportion to the drive's force"
    mjcf_lacks = "MuJoCo's frictionloss is a constant"
    exclusive = "load friction"
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
class DirectionalLoadFriction(ForceEffect):
    """Dry friction of size drive·|τ| while a drive's force τ drives the joint, backdrive·|τ| while it brakes it.

    A gear that loses another share when it is driven backwards (Wang & Kim, "Directional efficiency in geared
    transmissions", ICRA 2015). Of servos Duclusaud et al. tell apart what comes from the motor and from outside (M5 in
    "Extended friction models for the physics simulation of servo actuators", 2024). What opposes the motion is between
    −drive·τ and backdrive·τ, at rest too: that is −(drive − backdrive)/2·τ and dry friction of size
    (drive + backdrive)/2·|τ|.
    """

    name = "directional_load_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction in proportion to the drive's force, another share when it is driven backwards"
    mjcf_lacks = "MuJoCo's frictionloss is a constant"
    alike = False
    exclusive = "load friction"
    special_cases = {"share": ("drive", "backdrive")}  # noqa: RUF012
    in_torques = False  # in part it is a gain: least squares would prefer it to noise, with smaller masses
    neutral = {"drive": 0.0, "backdrive": 0.0}  # noqa: RUF012
    mjcf_sizes = (Share("drive", 0.02, 0.2), Share("backdrive", 0.1, 0.6))
    drive: float = parameter("1", 0.0, 1.0, "of the drive's force while it drives")
    backdrive: float = parameter("1", 0.0, 1.0, "of it while it brakes")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        few, many = 0.05, 0.2
        return [{"drive": few, "backdrive": many}, {"drive": many, "backdrive": few}]

    @classmethod
    def friction_of_load(cls, load: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return (p["drive"] + p["backdrive"]) / 2 * load

    @classmethod
    def force_of_drive(cls, drive: ca.SX, p: Parameters) -> ca.SX:
        return -(p["drive"] - p["backdrive"]) / 2 * drive

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return max(values.values()) < UNLIKE * min(values.values())

    @classmethod
    def sentence(cls, t: Description) -> str:
        drive, backdrive = (t.scaled(key, "%", 100.0) for key in ("drive", "backdrive"))
        return (
            f"Dry friction at {t.the} of {drive} of the drive's force while that drives, and of {backdrive} while it "
            "is driven backwards: a gear's losses."
        )


@register
@dataclass(frozen=True)
class PositionDependentFriction(ForceEffect):
    """Dry friction of size friction + more·(1 + cos(x − angle))/2: it is largest at one angle of a turn.

    The first harmonic of friction that depends on where teeth and bearings are (Armstrong-Hélouvry, Dupont & Canudas de
    Wit, "A survey of models, analysis tools and compensation methods for the control of machines with friction", 1994).
    """

    name = "position_dependent_friction"
    robots = ("mjcf",)
    sits_at = ("joint",)
    summary = "dry friction that is larger at some angles than at others"
    mjcf_lacks = "MuJoCo's frictionloss is a constant"
    alike = False
    exclusive = "dry friction"
    neutral = {"friction": 0.0, "more": 0.0}  # noqa: RUF012
    mjcf_sizes = (
        Share("friction", 0.003, 0.1),
        Share("more", 0.03, 0.3),
        Share("angle", -3.0, 3.0, "linear", "none"),
    )
    friction: float = parameter("N·m", 0.0, 100.0, "size of the friction where it is least")
    more: float = parameter("N·m", 0.0, 100.0, "how much more it is half a turn from there")
    angle: float = parameter("rad", -3.2, 3.2, "where it is largest")

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        """As of any force, but of joints the hinges alone."""
        places = super().places_on(robot)
        return {**places, "joint": tuple(name for name in places["joint"] if not robot.slides(name))}

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        quarters = (0.0, math.pi / 2, math.pi, -math.pi / 2)
        sizes = excitation.sizes("N·m")[1:]
        return [{"friction": size, "more": size, "angle": angle} for size in sizes for angle in quarters]

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return p["friction"] + p["more"] * (1 + ca.cos(x - p["angle"])) / 2

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return values["more"] < (UNLIKE - 1) * values["friction"]

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"Dry friction at {t.the} that depends on its angle: {t['friction']} where it is least, {t['more']} more "
            f"at {t['angle']}, where it is largest."
        )
