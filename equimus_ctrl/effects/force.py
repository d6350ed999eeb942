"""Effects that exert a generalised force: a joint torque or a force along an actuator, as CasADi expressions.

The one law of each effect is written over scalars: x is the joint's position [rad or m] or the actuator's length [m],
rate its derivative, z the effect's own states. Forces count positive where they would increase x. An effect may also
scale what an actuator makes of its pressure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, cast

import casadi as ca
import numpy as np

from equimus_ctrl.effects.base import REGISTRY, Effect, Robots, parameter, register
from equimus_ctrl.effects.description import CURVE_MARGIN, CURVE_POINTS, Curve, Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.native import Draft, add_cubic_spring, add_friction, add_spring
from equimus_ctrl.effects.sizes import Share, Size
from equimus_ctrl.errors import FAILURES, ConfigError

Parameters = Mapping[str, ca.SX]

LEAST_LEFT = 0.2
"""A length-dependent area grows to five times itself at most, however short its actuator becomes."""

PROBE, REST, LOAD = (0.73, -1.9, 1.9), 0.47, 1.3
"""Some x, rate, speed, rest length and load at which a law is asked whether its neutral parameters switch it off."""


@dataclass(frozen=True)
class ForceEffect(Effect):
    """An effect that exerts a generalised force along one coordinate x.

    A subclass overrides ``force``, ``dry_friction``, ``friction_of_load``, ``force_of_drive`` or ``more_area``;
    ``rubs``, ``loads`` and ``scales`` say which of these beside ``force``, and are found out by themselves.
    """

    side = "force"
    simulated = True
    n_states: ClassVar[int] = 0
    begins_anywhere: ClassVar[bool] = False
    """Whether its states are between −1 and 1, and no recording shows the way that led to them where it starts."""
    quick_states: ClassVar[bool] = False
    """Whether its states may be faster than steps that follow the motion: then steps are divided as they ask for."""
    scales: ClassVar[bool] = False
    """Whether it has a ``more_area`` of its own."""
    mujoco_field: ClassVar[tuple[str, int | None] | None] = None
    """Field of a degree of freedom in ``mujoco.MjModel`` that its only parameter is added to, and the entry there."""
    neutral: ClassVar[Mapping[str, float]]
    """Parameter values with which the effect does nothing; the others may be anything."""

    def __init_subclass__(cls) -> None:
        # The compiled engine has one set of parameters for each law and place.
        super().__init_subclass__()
        cls.rubs = cls.dry_friction.__func__ is not ForceEffect.dry_friction.__func__  # type: ignore[attr-defined]
        cls.own_equations = cls.n_states > 0
        cls.scales = cls.more_area.__func__ is not ForceEffect.more_area.__func__  # type: ignore[attr-defined]
        cls.loads = any(
            getattr(cls, own).__func__ is not getattr(ForceEffect, own).__func__
            for own in ("friction_of_load", "force_of_drive")
        )
        cls.dry = cls.rubs or cls.loads
        if cls.dry:
            cls.mujoco_flags = ("constraint", "frictionloss")
        if cls.exclusive is None and hasattr(cls, "name"):
            cls.exclusive = cls.name

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        """Kind of place → names of those at which forces can act, see ``robots.base.Robot.force_places``."""
        places: Mapping[str, tuple[str, ...]] = robot.force_places()
        return places

    @classmethod
    def grows_from(cls) -> float | None:
        return cls.neutral.get(next(iter(cls.parameter_info())))

    @classmethod
    def fades_to(cls) -> Mapping[str, float]:
        return cls.neutral

    @classmethod
    def check_class(cls) -> None:
        """As of any effect; its expressions are also formed once, and must be nothing with the neutral parameters."""
        super().check_class()
        who = f"effect class {cls.__name__}"
        info = cls.parameter_info()
        if not set(cls.sits_at) <= {"joint", "actuator"}:
            raise ConfigError(f"{who}: sits_at is {cls.sits_at!r}, but a force acts at a joint or an actuator")
        if cls.scales and set(cls.sits_at) != {"actuator"}:
            raise ConfigError(f"{who}: sits_at is {cls.sits_at!r}, but only an actuator has an area that may change")
        if cls.loads and "elastic" in cls.robots:
            raise ConfigError(f"{who}: robots is {cls.robots!r}, but only an MJCF robot has friction of loads")
        begins_at_rest = cls.start_state.__func__ is ForceEffect.start_state.__func__  # type: ignore[attr-defined]
        if "elastic" in cls.robots and not begins_at_rest:
            raise ConfigError(
                f"{who}: robots is {cls.robots!r}, but only an MJCF robot has start_state: legs start after a long "
                "rest, with rest_state"
            )
        if not getattr(cls, "neutral", None) or not set(cls.neutral) <= set(info):
            raise ConfigError(f"{who}: neutral must give values of some of {', '.join(info)} that switch it off")
        x, rate, speed = ca.SX.sym("x"), ca.SX.sym("rate"), ca.SX.sym("speed")
        z = ca.SX.sym("z", cls.n_states)
        p = {key: ca.SX.sym(key) for key in info}
        states = ca.vertsplit(z) if cls.n_states else []
        try:
            rates, rests = list(cls.state_rate(x, rate, states, p)), list(cls.rest_state(x, p))
            begins = list(cls.start_state(x, rate, ca.SX.sym("time"), p))
            most, more = cls.greatest_friction(x, speed, ca.SX(LOAD), p), cls.more_area(x, ca.SX(REST), p)
            force = cls.force(x, rate, states, p) + cls.force_of_drive(ca.SX(LOAD), p)
            terms = (force, most, more)
            symbols = [x, rate, speed, z, ca.vertcat(*p.values())]
            law = ca.Function("law", symbols, [*map(ca.SX, terms), ca.vertcat(*rates), ca.vertcat(*rests)])
        except FAILURES as error:
            reason = (str(error).strip() or "no reason given").splitlines()[-1]
            raise ConfigError(
                f"{who}: its law is no CasADi expression of its arguments, with casadi.if_else for conditions "
                f"({type(error).__name__}: {reason})"
            ) from error
        if not len(rates) == len(rests) == len(begins) == cls.n_states:
            raise ConfigError(
                f"{who}: state_rate gives {len(rates)} and rest_state {len(rests)} values, expected n_states = "
                f"{cls.n_states} each"
                if len(begins) == len(rests)
                else f"{who}: start_state gives {len(begins)} values, expected n_states = {cls.n_states}"
            )
        idle = [cls.neutral.get(key, meta["high"]) for key, meta in info.items()]
        if any(float(size) != 0.0 for size in law(*PROBE, ca.DM.ones(cls.n_states) * 0.41, idle)[:3]):
            raise ConfigError(f"{who}: it still exerts a force with its neutral parameters {dict(cls.neutral)}")

    def curves(self, robot: Any, excitation: Excitation) -> tuple[Curve, ...]:
        """The effective area over the length, of an effect that scales it; of others no curve of its own."""
        if not self.scales:
            return ()
        rest = next(a for a in robot.actuators if a.name == self.location).rest_length
        margin = CURVE_MARGIN * excitation.span
        x = np.linspace(excitation.low - margin, excitation.high + margin, CURVE_POINTS)
        length, p = ca.SX.sym("length"), {key: ca.SX(value) for key, value in self.parameters().items()}
        share = 1 + ca.SX(self.more_area(length, ca.SX(rest), p))
        area = np.array(ca.Function("area", [length], [share])(x[None, :])).ravel()
        what = "area, share of that at the rest length"
        return (Curve("area against the length", "length", "m", what, "1", x, area, 1.0, True),)

    def write_mjcf(self, draft: Draft) -> str:
        return "" if self.mujoco_field is not None else super().write_mjcf(draft)  # the field holds it

    @classmethod
    def depends(cls) -> set[str]:
        """On what its force depends: ``pos``, ``vel``, ``cmd``; with states of its own it is the ``past`` alone.

        Dry friction depends on the direction of the speed.
        """
        x, rate, p = ca.SX.sym("x"), ca.SX.sym("rate"), {key: ca.SX.sym(key) for key in cls.parameter_info()}
        z = [ca.SX.sym(f"z{k}") for k in range(cls.n_states)]
        total, drive = cls.sliding_force(x, rate, z, ca.SX(LOAD), p), ca.SX.sym("drive")
        area = ca.SX(cls.more_area(x, ca.SX(1), p))
        if z and ca.depends_on(total, ca.vertcat(*z)):
            return {"past"}
        found = {name for name, symbol in (("pos", x), ("vel", rate)) if ca.depends_on(total, symbol)}
        found |= {"cmd"} if ca.depends_on(ca.SX(cls.force_of_drive(drive, p)), drive) else set()
        return found | {"pos", "cmd"} if ca.depends_on(area, x) else found

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        """The generalised force [N·m] or [N]."""
        return ca.SX(0)

    @classmethod
    def greatest_friction(cls, x: ca.SX, speed: ca.SX, load: ca.SX, p: Parameters) -> ca.SX:
        """``dry_friction`` + ``friction_of_load`` under a drive's force of a size ``load`` ≥ 0 [N·m] or [N]."""
        return ca.SX(cls.dry_friction(x, speed, p)) + ca.SX(cls.friction_of_load(load, speed, p))

    @classmethod
    def sliding_force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], drive: ca.SX, p: Parameters) -> ca.SX:
        """All that it exerts while x moves: ``force`` + ``force_of_drive`` − ``greatest_friction``·sign(rate).

        [N·m or N]; ``drive`` is the drive's force, positive where it would increase x.
        """
        opposing = cls.greatest_friction(x, ca.fabs(rate), ca.fabs(drive), p) * ca.sign(rate)
        return ca.SX(cls.force(x, rate, z, p)) + ca.SX(cls.force_of_drive(drive, p)) - opposing

    @classmethod
    def more_area(cls, x: ca.SX, rest: ca.SX, p: Parameters) -> ca.SX:
        """Relative increase of an actuator's effective area at length x [1]; rest is its rest length [m]."""
        return ca.SX(0)

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        """dz/dt, one for each state."""
        return ()

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        """The states after a long rest at x."""
        return ()

    @classmethod
    def start_state(cls, x: ca.SX, rate: ca.SX, time: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        """The states where a recording starts, or what is known of one; by default those after a long rest at x.

        Args:
            x: there.
            rate: there.
            time: since the recording began [s].
            p: parameters.
        """
        return cls.rest_state(x, p)

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        """The greatest friction there can be at a sliding speed ≥ 0 [N·m] or [N]; solved at velocity level."""
        return ca.SX(0)

    @classmethod
    def friction_of_load(cls, load: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        """How much more dry friction there can be under a drive's force of a size ≥ 0 [N·m] or [N]."""
        return ca.SX(0)

    @classmethod
    def force_of_drive(cls, drive: ca.SX, p: Parameters) -> ca.SX:
        """What it adds to a drive's force, positive where that would increase x [N·m] or [N]."""
        return ca.SX(0)


@register
@dataclass(frozen=True)
class CoulombFriction(ForceEffect):
    """Dry friction: −friction·sign(rate) while sliding, whatever holds the coordinate at rest up to that size."""

    name = "coulomb_friction"
    robots = ("elastic", "mjcf")
    sits_at = ("joint", "actuator")
    summary = "dry friction"
    mjcf_form = "`frictionloss` of the joint, or of the tendon that is an actuator's length"
    exclusive = "dry friction"
    neutral = {"friction": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("friction", 1.2e-3, 0.1, "from far below the noise to 2° of hip", at="hip"),
        Size("friction", 5e-4, 0.03, "from far below the noise to 2° of knee", at="knee"),
        Size("friction", 0.012, 1.0, "the joints' sizes over moment arms of 6 to 10 cm", at="actuator"),
    )
    leg_alike = True
    mjcf_sizes = (Share("friction", 0.003, 0.3),)
    friction: float = parameter("N·m | N", 0.0, 100.0, "size of the friction while sliding and before")

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return p["friction"]

    def write_mjcf(self, draft: Draft) -> str:
        add_friction(draft, self.location, self.friction)
        return ""

    @classmethod
    def sentence(cls, t: Description) -> str:
        if t.places[0] in t.robot.joint_names:
            return f"Dry friction at {t.the} of {t['friction']}{t.one_or('', ' each')}."
        return f"Dry friction along {t.at} of {t['friction']}{t.one_or('', ' each')}."


@register
@dataclass(frozen=True)
class StribeckFriction(ForceEffect):
    """Dry friction of size friction + breakaway/(1 + (rate/velocity)²) (Hess and Soom, 1990)."""

    name = "stribeck_friction"
    robots = ("elastic", "mjcf")
    sits_at = ("joint",)
    summary = "static friction above the sliding one"
    mjcf_lacks = "MuJoCo's frictionloss is a constant, and LuGre's curve falls otherwise and yields before it slides"
    exclusive = "dry friction"
    neutral = {"friction": 0.0, "breakaway": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("friction", 8e-4, 0.07, "a little less than dry friction alone", at="hip"),
        Size("friction", 3e-4, 0.025, "a little less than dry friction alone", at="knee"),
        Size("breakaway", 1e-3, 0.08, "about as much again", at="hip"),
        Size("breakaway", 4e-4, 0.025, "about as much again", at="knee"),
        Size("velocity", 0.03, 0.3, "within the joints' speeds, which reach 1 to 3 rad/s"),
    )
    mjcf_sizes = (
        Share("friction", 0.003, 0.2),
        Share("breakaway", 0.01, 0.3),
        Share("velocity", 0.02, 0.3),
    )
    friction: float = parameter("N·m", 0.0, 100.0, "size while sliding fast")
    breakaway: float = parameter("N·m", 0.0, 100.0, "how much more it is at rest")
    velocity: float = parameter("rad/s", 1e-3, 10.0, "speed at which half of that is gone")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"friction": size, "breakaway": size, "velocity": speed}
            for size in excitation.sizes("N·m")
            for speed in excitation.sizes("rad/s")
        ]

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Parameters) -> ca.SX:
        return p["friction"] + p["breakaway"] / (1 + (speed / p["velocity"]) ** 2)

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return values["breakaway"] < values["friction"] / 3

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"Dry friction at {t.the} of {t['friction']} in fast motion and {t['breakaway']} more at rest, half of it "
            f"gone at {t['velocity']}: static friction above the sliding one."
        )


@register
@dataclass(frozen=True)
class ParallelSpring(ForceEffect):
    """A spring beside the joint: −stiffness·(x − rest)."""

    name = "parallel_spring"
    robots = ("elastic", "mjcf")
    sits_at = ("joint",)
    summary = "an unmodelled spring: a hose, a cable"
    mjcf_form = "`stiffness` and `springref` of the joint"
    alike = False
    exclusive = "parallel_spring"
    neutral = {"stiffness": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("stiffness", 0.1, 3.0, "up to the hip's own; the actuators' take up most of it", at="hip"),
        Size("stiffness", 6e-3, 0.25, "0.8 to 30 % of the knee's own", at="knee"),
        Size("rest", 1.0, 2.0, "about the hip's middle", "linear", "hip"),
        Size("rest", 0.0, 1.0, "about the knee's middle", "linear", "knee"),
    )
    mjcf_sizes = (
        Share("stiffness", 0.01, 0.5),
        Share("rest", 0.0, 1.0, "linear", "range"),
    )
    stiffness: float = parameter("N·m/rad", 0.0, 100.0, "of the spring")
    rest: float = parameter("rad", -6.3, 6.3, "angle at which it pulls nowhere")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"stiffness": size, "rest": rest}
            for size in excitation.sizes("N·m/rad")
            for rest in (excitation.low, excitation.high)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["stiffness"] * (x - p["rest"])

    def write_mjcf(self, draft: Draft) -> str:
        return add_spring(draft, self.location, self.stiffness, self.rest)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"A spring of {t['stiffness']} beside {t.the} that is not in the model, at rest at {t['rest']}."


@register
@dataclass(frozen=True)
class NonlinearStiffness(ForceEffect):
    """A cubic spring: −cubic·(x − centre)³, stiffening where cubic > 0, softening where it is below."""

    name = "nonlinear_stiffness"
    sits_at = ("actuator",)
    summary = "stiffening or softening"
    mjcf_form = "the third coefficient of `stiffness` of the tendon that is the actuator's length"
    alike = False
    exclusive = "nonlinear_stiffness"
    neutral = {"cubic": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("cubic", 1e3, 1e5, "0.03 N to 2.7 N at 3 cm from the centre", "either sign"),
        Size("centre", 0.20, 0.27, "within the stroke", "linear", "maa"),
        Size("centre", 0.24, 0.33, "within the stroke", "linear", "baa"),
    )
    cubic: float = parameter("N/m³", -1e6, 1e6, "force for each cube of the lengthening")
    centre: float = parameter("m", 0.0, 10.0, "length about which it stiffens")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"cubic": sign * size, "centre": excitation.low + share * excitation.span}
            for size in excitation.sizes("N/m³")
            for sign in (1.0, -1.0)
            for share in (0.15, 0.5, 0.85)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["cubic"] * (x - p["centre"]) ** 3

    def write_mjcf(self, draft: Draft) -> str:
        return add_cubic_spring(draft, self.location, self.cubic, self.centre)

    @classmethod
    def sentence(cls, t: Description) -> str:
        cubic = t.value("cubic")
        what = "stiffens" if cubic > 0 else "softens"
        return (
            f"The spring of {t.at} {what} away from a length of {t['centre']}: by {t['cubic']} times the cube of "
            f"the way, {t.quantity(abs(cubic) * 0.03**3, 'N')} at 30 mm."
        )


@register
@dataclass(frozen=True)
class NarrowingArea(ForceEffect):
    """Length-dependent effective area s/(1 + loss·(x/l₀ − 1)) at length x, s being that at the rest length l₀.

    With loss 1 the actuator keeps its volume.
    """

    name = "narrowing_area"
    sits_at = ("actuator",)
    summary = "the area that pressure acts on shrinks as the actuator lengthens"
    mjcf_lacks = "MuJoCo's gains are straight lines of the length"
    exclusive = "narrowing_area"
    neutral = {"loss": 0.0}  # noqa: RUF012
    leg_sizes = (Size("loss", 0.05, 1.2, "to a little more than a bag that keeps its volume"),)
    loss: float = parameter(
        "1", -1.5, 3.0, "share of the area lost for a share of the rest length gained; below 0 it grows"
    )

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"loss": loss} for loss in (0.2, 0.5, 1.0, 2.0, -0.2, -0.5)]

    @classmethod
    def more_area(cls, x: ca.SX, rest: ca.SX, p: Parameters) -> ca.SX:
        left = 1 + p["loss"] * (x / rest - 1)
        return 1 / ca.fmax(left, LEAST_LEFT) - 1

    @classmethod
    def sentence(cls, t: Description) -> str:
        loss = t.value("loss")
        what = f"{t.one_or('shrinks', 'shrink')} as {t.one_or('it lengthens', 'they lengthen')}"
        if loss < 0:
            what = f"{t.one_or('grows', 'grow')} with {t.one_or('its length', 'their lengths')}"
        area = t.one_or(f"The area of {t.at}", f"The areas of {t.at}")
        return (
            f"{area} {what}: near the rest length by {t['loss']} times the share of length gained, by "
            f"{100 * abs(1 - 1 / (1 + loss / 5)):.0f} % at a fifth more."
        )


def force_effects(effects: Sequence[Effect]) -> tuple[ForceEffect, ...]:
    """Those of a model's effects that exert a force, in their order."""
    return tuple(effect for effect in effects if isinstance(effect, ForceEffect))


def laws_of(effects: Sequence[Effect]) -> tuple[type[ForceEffect], ...]:
    """The force laws that a model's effects have, each once, by name; see ``models.augmented``."""
    return tuple(sorted({type(effect) for effect in force_effects(effects)}, key=lambda law: law.name))


def force_laws(robots: Robots = "elastic") -> tuple[type[ForceEffect], ...]:
    """All registered effects that exert a force and that a kind of robots can have, by name."""
    return _forces_among(tuple(REGISTRY.values()), robots)


@lru_cache(maxsize=16)
def _forces_among(classes: tuple[type[Effect], ...], robots: Robots) -> tuple[type[ForceEffect], ...]:
    found = (cls for cls in classes if issubclass(cls, ForceEffect) and robots in cls.robots)
    return tuple(sorted(cast("list[type[ForceEffect]]", list(found)), key=lambda cls: cls.name))


def laws_with(effects: Sequence[Effect], robots: Robots) -> tuple[type[ForceEffect], ...]:
    """All force laws of a kind of robots, and those of some effects.

    Laws with states of their own, and laws outside the catalogue, only where one of the effects has them.
    """
    return _usual_and(force_laws(robots), laws_of(effects))


def all_laws_and(effects: Sequence[Effect], robots: Robots) -> tuple[type[ForceEffect], ...]:
    """All force laws of a kind of robots, and those outside the catalogue that some effects have."""
    return _and(force_laws(robots), laws_of(effects))


@lru_cache(maxsize=256)
def _usual_and(
    catalogue: tuple[type[ForceEffect], ...], own: tuple[type[ForceEffect], ...]
) -> tuple[type[ForceEffect], ...]:
    return _and(tuple(law for law in catalogue if not law.n_states), own)


@lru_cache(maxsize=256)
def _and(some: tuple[type[ForceEffect], ...], others: tuple[type[ForceEffect], ...]) -> tuple[type[ForceEffect], ...]:
    return tuple(sorted({*some, *others}, key=lambda law: law.name))
