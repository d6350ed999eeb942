"""What an effect is: one piece of physics with a place, named parameters, units and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from numbers import Real
from typing import Any, ClassVar, Literal, TypeVar, get_args

from equimus_ctrl.effects.description import Curve, Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.effects.sizes import LAWS, WHOLES, Share, Size
from equimus_ctrl.errors import ConfigError, unknown_name

Side = Literal["command", "force", "measurement"]
Robots = Literal["elastic", "mjcf"]
KINDS: Mapping[Robots, str] = {"elastic": "a robot with elastic actuators", "mjcf": "an MJCF robot"}
"""Kind of robots → what a message calls one of them."""


def parameter(unit: str, low: float, high: float, doc: str) -> Any:
    """A dataclass field for an effect's parameter.

    Args:
        unit: SI.
        low: the least that it can be.
        high: the most.
        doc: what it means, in a few words.
    """
    return field(metadata={"unit": unit, "low": low, "high": high, "doc": doc})


@dataclass(frozen=True)
class Effect:
    """Base of all effects; a subclass names its parameters as dataclass fields made with ``parameter``.

    Engines simulate what derives from ``ValveEffect``, ``ShapingEffect``, ``BodyEffect``, ``ForceEffect`` or
    ``SensorEffect``; of anything else they have no law (``simulated``).

    Where an effect does nothing is said once. A ``ForceEffect`` names its ``neutral`` parameter values; any other names
    in ``nothing`` the value of its first parameter. ``grows_from`` and ``fades_to`` follow from these.

    A class has to say ``name``, ``sits_at`` and ``summary``; its base says ``side``. ``robots``, ``alike``,
    ``exclusive``, ``delays``, ``discontinuous``, ``even``, ``special_cases``, ``tends_to``, ``mjcf_form``, the sizes of
    a proof and the methods it says where the default is not right. Of a ``ForceEffect`` ``rubs``, ``loads``,
    ``dry``, ``scales``, ``own_equations`` and, with dry friction, ``mujoco_flags`` follow from the methods that it has,
    whatever it says.

    Attributes:
        location: the joint, actuator or body it sits at.

    Raises:
        ConfigError: where a parameter lies outside its bounds.
    """

    name: ClassVar[str]
    side: ClassVar[Side]
    sits_at: ClassVar[tuple[str, ...]]
    """Kinds of places: joint, actuator, link, foot, base."""
    summary: ClassVar[str]
    alike: ClassVar[bool] = True
    """Whether it is also tried at all places of a kind with the same parameters, as of parts of one make."""
    nothing: ClassVar[float | None] = 0.0
    """The value of the first parameter at which the effect does nothing; None where there is none (``grows_from``)."""
    weaker: ClassVar[Literal[-1, 0, 1]] = 0
    """Where that is None: whether a larger (1) or a smaller (−1) value makes its influence less; 0 where it depends."""
    discontinuous: ClassVar[tuple[str, ...]] = ()
    """Discontinuous parameters: the predictions are piecewise constant in them, so fits scan a grid.

    The grid is θ·exp(w) for w evenly spaced between ±w₀ (``diagnosis.fitting``): it suits positive parameters alone. A
    lower bound below 0 is refused, and a guess of 0 would stay at 0.
    """
    even: ClassVar[tuple[str, ...]] = ()
    """Parameters in which predictions may be even about a value, where derivatives say nothing of them and fits stay.

    So fits begin beside it, too. Such is where a tether ends across the plane in which an arm moves.
    """
    simulated: ClassVar[bool] = False
    """Whether engines have its kind of law; True of the classes that effects derive from."""
    rubs: ClassVar[bool] = False
    """Whether it has dry friction of its own (``ForceEffect.dry_friction``)."""
    loads: ClassVar[bool] = False
    """Whether it has dry friction that grows with a drive's force (``ForceEffect.friction_of_load``)."""
    dry: ClassVar[bool] = False
    """Whether it has dry friction, of its own or that grows."""
    robots: ClassVar[tuple[str, ...]] = ("elastic",)
    """Kinds of robots that can have it: ``elastic`` (morphologies with elastic actuators), ``mjcf`` (MuJoCo's XML)."""
    mujoco_flags: ClassVar[tuple[str, ...]] = ()
    """Flags of an MJCF file that must not be switched off for it to do anything."""
    delays: ClassVar[bool] = False
    """Whether its parameters in seconds say how late something is; a law's own times, of creep, say, do not."""
    in_torques: ClassVar[bool] = True
    """Whether inverse dynamics along the measured motion show it: not what moves without being measured, and not what
    scales all forces, as masses do."""
    own_equations: ClassVar[bool] = False
    """Whether equations of motion are compiled for robots that have it, beside those of robots without: it has states
    of its own, or acts on a coordinate of its own."""
    exclusive: ClassVar[str | None] = None
    """Of effects that share this word one place can have only one; see ``slot``."""
    special_cases: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parameter of a law that it excludes → its own that all have that value where it is that law. Where there is none
    of these, both call it by the same name."""
    tends_to: ClassVar[Mapping[str, Mapping[str, str]]] = {}
    """Name of another law that it tends to towards an end of a parameter's range → that law's parameter → its own."""
    leg_sizes: ClassVar[tuple[Size, ...]] = ()
    """What a proof draws on the nominal leg: a size for each parameter at each place; none where it draws it not."""
    leg_alike: ClassVar[bool] = False
    """Whether a proof also draws it with the same parameters at several places of the leg."""
    mjcf_sizes: ClassVar[tuple[Share, ...]] = ()
    """What a proof draws on MJCF robots: a share for each parameter; none where it draws it not."""

    mjcf_form: ClassVar[str] = ""
    """What of MuJoCo's holds its law in an XML, see ``write_mjcf``; empty where nothing does."""
    mjcf_lacks: ClassVar[str] = "MuJoCo has no such law"
    """Why nothing does, a phrase."""

    location: str

    def __init_subclass__(cls) -> None:
        # What is made of another effect is another, of which nobody has said how large it is.
        super().__init_subclass__()
        for key in ("leg_sizes", "mjcf_sizes"):
            if key not in vars(cls):
                setattr(cls, key, ())

    def __post_init__(self) -> None:
        for key, meta in self.parameter_info().items():
            value = getattr(self, key)
            if not isinstance(value, Real):
                raise ConfigError(f"effect {self.name} at {self.location!r}: {key} is {value!r}, expected a number")
            if not (math.isfinite(value) and meta["low"] <= value <= meta["high"]):
                unit = "" if meta["unit"] == "1" else f" {meta['unit']}"
                raise ConfigError(
                    f"effect {self.name} at {self.location!r}: {key} is {value:g}{unit}, expected {meta['low']:g} to "
                    f"{meta['high']:g}{unit}"
                )

    def slot(self, robot: Any) -> str:
        """The place that ``exclusive`` means, on a robot (a ``robots.base.Robot``)."""
        return self.location

    def exclusive_slot(self, robot: Any) -> tuple[str, str] | None:
        """The slot of a robot that it takes: ``exclusive`` and ``slot``; None where it excludes nothing."""
        return None if self.exclusive is None else (self.exclusive, self.slot(robot))

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        """Kind of place → names of those on a robot (a ``robots.base.Robot``) at which it can sit.

        ``sits_at`` says which of the kinds are its own.
        """
        places: Mapping[str, tuple[str, ...]] = robot.places()
        return places

    @classmethod
    def depends(cls) -> set[str] | None:
        """On what the force that it adds depends: ``pos``, ``vel``, ``cmd``, ``past``; None where it adds none.

        A diagnosis compares this with the coordinates of an unstructured residual force at the same place: where they
        agree the force restates the effect (``diagnosis.confounding.restates``). With None no force ever does. That
        holds of all that changes what other terms of the model are made of: of masses, stops and gravity, and of
        commands before they arrive, dead zone, coupling, saturation and threshold included, though these are static
        maps of the command. Effects that scale or bound a drive's force itself say ``{"cmd"}``.
        """
        return None

    def bounds(self, key: str, robot: Any) -> tuple[float, float]:
        """Between what a parameter can vary on a robot while all else about the effect stays."""
        meta = self.parameter_info()[key]
        return float(meta["low"]), float(meta["high"])

    @classmethod
    def begun_at(cls, simpler: Mapping[str, float], guesses: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
        """Parameter sets from which it is fitted in the place of a law that is a special case of it.

        The first is the nearest to that law.

        Args:
            simpler: values of that law's parameters.
            guesses: see ``guesses``.
        """
        same = {own: value for key, value in simpler.items() for own in cls.special_cases.get(key, (key,))}
        return [{**guess, **same} for guess in guesses]

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        """Parameter sets from which a search for this effect can begin, from weak to strong and of each kind it has.

        By default all combinations of a few values that go with the parameters' units; a class that knows better says
        so. Values outside a parameter's bounds are dropped.
        """
        choices = []
        for meta in cls.parameter_info().values():
            low, high = float(meta["low"]), float(meta["high"])
            values = excitation.sizes(meta["unit"])
            if not values:
                least = max(low, 1e-4 * high)
                values = tuple(least * (high / least) ** share for share in (0.2, 0.4, 0.6, 0.8))
            if low < 0:
                values = (*values, *(-v for v in values))
            choices.append([v for v in values if low <= v <= high] or [0.5 * (low + high)])
        return [dict(zip(cls.parameter_info(), values, strict=True)) for values in product(*choices)]

    @classmethod
    def grows_from(cls) -> float | None:
        """The value of the first parameter at which the effect does nothing; None where there is no such value."""
        return cls.nothing

    @classmethod
    def fades_to(cls) -> Mapping[str, float]:
        """Parameter → value towards which its influence vanishes, about in proportion; empty where it does not."""
        nothing = cls.grows_from()
        return {} if nothing is None else {next(iter(cls.parameter_info())): nothing}

    @classmethod
    def as_sum(cls, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        """Other effects that at the same place together are the same law: their names and parameters; none by default.

        Args:
            values: of its own parameters.
        """
        return {}

    @classmethod
    def degenerate(cls, values: Mapping[str, float], excitation: Excitation) -> bool:
        """Whether these parameter values strain its law so far that any generalised force would fit as well.

        A diagnosis then accepts it only where it leaves nothing unexplained.
        """
        return False

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        """Whether with these values of its parameters it would rightly be called by a simpler effect's name."""
        return False

    @classmethod
    def sentence(cls, t: Description) -> str:
        """What a report says of it where it was found; by default its summary with all numbers."""
        what = cls.summary[:1].upper() + cls.summary[1:].rstrip(".")
        return f"{what}, at {t.at}: {t.numbers}."

    def curves(self, robot: Any, excitation: Excitation) -> tuple[Curve, ...]:
        """What a report draws of it; by default none, and it draws what follows from the law.

        Args:
            robot: as it is modelled.
            excitation: what recordings show of the effect's place.
        """
        return ()

    def write_mjcf(self, draft: Draft) -> str:
        """Write it into what MuJoCo's XML has; why it does not hold all of it, a phrase, empty where it does.

        Args:
            draft: from which an XML is written. Effects of commands' values come first, in the order in which they act.
        """
        return self.mjcf_lacks

    @classmethod
    def check_class(cls) -> None:
        """Raise ConfigError where the class does not say all that an effect must."""
        who = f"effect class {cls.__name__}"
        for key in ("name", "side", "sits_at", "summary"):
            if not hasattr(cls, key):
                raise ConfigError(f"{who}: lacks {key!r}")
        if not (isinstance(cls.name, str) and cls.name.isidentifier()):
            raise ConfigError(f"{who}: name is {cls.name!r}, expected a plain name of letters, digits and '_'")
        if not (isinstance(cls.sits_at, tuple) and cls.sits_at and set(cls.sits_at) <= set(PLACES)):
            raise ConfigError(f"{who}: sits_at is {cls.sits_at!r}, expected a tuple of {', '.join(PLACES)}")
        if cls.side not in get_args(Side):
            raise ConfigError(f"{who}: side is {cls.side!r}, expected {' or '.join(get_args(Side))}")
        if not set(cls.robots) or not set(cls.robots) <= set(get_args(Robots)):
            raise ConfigError(f"{who}: robots is {cls.robots!r}, expected a tuple of {', '.join(get_args(Robots))}")
        if "__dataclass_fields__" not in vars(cls):
            raise ConfigError(f"{who}: is no dataclass; put @dataclass(frozen=True) between it and @register")
        bare = [f.name for f in fields(cls) if f.name != "location" and not {"low", "high"} <= set(f.metadata)]
        if bare or not cls.parameter_info():
            what = f"{bare[0]!r} is not" if bare else "it has none"
            raise ConfigError(f"{who}: parameters are made with parameter(unit, low, high, doc), {what}")
        cls._check_discontinuous(who)
        for key in cls.even:
            if key not in cls.parameter_info():
                raise ConfigError(unknown_name("even parameter", key, cls.parameter_info(), who))
        cls._check_sizes(who)

    @classmethod
    def _check_discontinuous(cls, who: str) -> None:
        info = cls.parameter_info()
        for key in cls.discontinuous:
            if key not in info:
                raise ConfigError(unknown_name("discontinuous parameter", key, info, who))
            if info[key]["low"] < 0:
                raise ConfigError(
                    f"{who}: discontinuous parameter {key!r} has a lower bound of {info[key]['low']:g}, expected at "
                    "least 0: the grid of its values is spaced evenly in its logarithm"
                )

    @classmethod
    def _check_sizes(cls, who: str) -> None:
        for key, sizes in (("leg_sizes", cls.leg_sizes), ("mjcf_sizes", cls.mjcf_sizes)):
            for size in sizes:
                name = f"{who}: {key} of {size.parameter!r}"
                if size.law not in LAWS:
                    raise ConfigError(f"{name}: law is {size.law!r}, expected {', '.join(LAWS)}")
                if isinstance(size, Share) and size.of not in WHOLES:
                    raise ConfigError(f"{name}: is a share of {size.of!r}, expected {', '.join(WHOLES)}")
                if not (size.low < size.high and (size.low > 0 or size.law == "linear")):
                    raise ConfigError(f"{name}: from {size.low:g} to {size.high:g}, expected 0 < low < high")
            named = {size.parameter for size in sizes}
            if sizes and named != set(cls.parameter_info()):
                odd = sorted(named ^ set(cls.parameter_info()))[0]
                raise ConfigError(
                    f"{who}: {key} are for {', '.join(sorted(named))}, expected one for each parameter and no other "
                    f"({odd!r})"
                )

    @classmethod
    def parameter_info(cls) -> dict[str, Mapping[str, Any]]:
        """Parameter name → unit, low, high, doc."""
        return {f.name: f.metadata for f in fields(cls) if f.metadata}

    def parameters(self) -> dict[str, float]:
        """Parameter name → value."""
        return {key: float(getattr(self, key)) for key in self.parameter_info()}


REGISTRY: dict[str, type[Effect]] = {}
RESERVED = ("smooth_force", "smooth_friction")
"""Names of laws that are fitted beside effects and never named, see ``effects.smooth``."""


def catalogue(robots: Robots) -> dict[str, type[Effect]]:
    """Name → class of all registered effects that a kind of robots can have."""
    return {name: cls for name, cls in sorted(REGISTRY.items()) if robots in cls.robots}


PLACES = ("joint", "actuator", "link", "foot", "base")
E = TypeVar("E", bound="type[Effect]")


def register(cls: E) -> E:
    """Class decorator: make an effect known by its name.

    Raises:
        ConfigError: where the class is no whole effect, or its name is another's, or one of ``RESERVED``.
    """
    cls.check_class()
    if cls.name in RESERVED:
        raise ConfigError(
            f"effect class {cls.__name__}: name is {cls.name!r}, which is kept for a diagnosis; expected another"
        )
    if cls.name in REGISTRY:
        raise ConfigError(f"effect {cls.name}: there is one of that name already, in {REGISTRY[cls.name].__module__}")
    REGISTRY[cls.name] = cls
    return cls


def make(name: str, location: str, parameters: Mapping[str, float], where: str = "") -> Effect:
    """An effect by name.

    Raises:
        ConfigError: for an unknown effect or parameter, a missing one, or a value outside its bounds.
    """
    if name not in REGISTRY:
        raise ConfigError(unknown_name("effect", name, REGISTRY, where))
    cls = REGISTRY[name]
    info = cls.parameter_info()
    prefix = f"{where}: " if where else ""
    for key in parameters:
        if key not in info:
            raise ConfigError(unknown_name("parameter", key, info, f"{prefix}effect {name}"))
    missing = [key for key in info if key not in parameters]
    if missing:
        raise ConfigError(f"{prefix}effect {name} at {location!r} lacks {missing[0]!r} [{info[missing[0]]['unit']}]")
    values = {key: float(value) for key, value in parameters.items()}
    return cls(location, **values)


def parse(text: str) -> Effect:
    """An effect from ``name:location:parameter=value,…``, as it is written on a command line.

    Raises:
        ConfigError: where the text is not of that form or names something unknown.
    """
    parts = text.split(":")
    form = "expected name:location:parameter=value, such as transport_delay:baa:delay=0.1"
    if len(parts) != 3:
        raise ConfigError(f"effect {text!r}: {form}")
    values: dict[str, float] = {}
    for item in filter(None, parts[2].split(",")):
        key, equals, value = item.partition("=")
        if key.strip() in values:
            raise ConfigError(f"effect {text!r}: {key.strip()!r} is given twice; {form}")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            raise ConfigError(f"effect {text!r}: {item!r} is not parameter=number; {form}") from None
        if not equals:
            raise ConfigError(f"effect {text!r}: {item!r} is not parameter=number; {form}")
    return make(parts[0].strip(), parts[1].strip(), values)


def check_locations(effects: Sequence[Effect], places: Mapping[str, Sequence[str]], where: str) -> None:
    """Raise ConfigError where an effect sits at something the robot does not have.

    Args:
        effects: all effects of one robot.
        places: kind of place (see ``Effect.sits_at``) → names of those the robot has.
        where: what the message starts with.
    """
    for effect in effects:
        known = [name for kind in effect.sits_at for name in places[kind]]
        if effect.location not in known:
            kinds = " or ".join(effect.sits_at)
            raise ConfigError(unknown_name(kinds, effect.location, known, f"{where}: effect {effect.name}"))


def check_exclusive(effects: Sequence[Effect], robot: Any, where: str) -> None:
    """Raise ConfigError where two effects at one place exclude each other.

    Args:
        effects: all effects of one robot, each at a place it has.
        robot: the robot.
        where: what the message starts with.
    """
    taken: dict[tuple[str, str], str] = {}
    for effect in effects:
        if (slot := effect.exclusive_slot(robot)) is None:
            continue
        if slot in taken:
            raise ConfigError(
                f"{where}: {slot[1]!r} has two effects that exclude each other, {taken[slot]} and {effect.name}"
            )
        taken[slot] = effect.name


def check_robots(effects: Sequence[Effect], kind: Robots, where: str) -> None:
    """Raise ConfigError where an effect is not one of robots of a kind."""
    for effect in effects:
        if kind not in effect.robots:
            raise ConfigError(
                f"{where}: {KINDS[kind]} cannot have effect {effect.name} (it can: {', '.join(catalogue(kind))})"
            )


def require_simulated(effects: Sequence[Effect], who: str) -> None:
    """Raise ConfigError where there is an effect of which no engine has the law, see ``Effect.simulated``."""
    for effect in effects:
        if not effect.simulated:
            names = ", ".join(name for name, cls in sorted(REGISTRY.items()) if cls.simulated)
            raise ConfigError(f"{who} does not simulate effect {effect.name} at {effect.location!r} (it does: {names})")
