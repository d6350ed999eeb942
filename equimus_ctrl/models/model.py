"""A model: a robot, the phase it is in, and the effects attached to it; and its file format.

A model file is TOML:

    format = "equimus-ctrl/model/1"
    name = "my_leg"
    morphology = "nominal_leg"      # or a [morphology] table that spells one out
    phase = "swing"                 # or "stance"

    [parameters]                    # any of the morphology's parameters, by dotted name
    "maa.stiffness" = 280.0

    [[effects]]
    effect = "transport_delay"
    location = "baa"
    delay = 0.1
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from typing import Any, get_args, get_origin, get_type_hints

from equimus_ctrl.effects import base as effects_base
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.errors import ConfigError, ModelError, nearest, unknown_name
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, elastic_of
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.shown import Short, listed

FORMAT = "equimus-ctrl/model/1"

GroupValues = tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
"""For each group of trials the parameters that are others there, by dotted name."""


@dataclass(frozen=True, repr=False)
class Model(Short):
    """A robot with effects attached.

    Attributes:
        robot: what is driven.
        effects: what is attached to it.
        phase: base fixed (swing) or foot pinned (stance).
        by_group: parameters that are others in some groups of trials, as of another unit of the robot, or on another
            day; no model file holds them, see ``in_group``.

    Raises:
        ConfigError: where an effect sits at something the robot does not have, or two exclude each other.
    """

    robot: Robot
    effects: tuple[Effect, ...] = ()
    phase: Phase = "swing"
    by_group: GroupValues = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(self.effects))
        if self.phase not in get_args(Phase):
            raise ConfigError(unknown_name("phase", str(self.phase), get_args(Phase), self.robot.name))
        self.robot.check(self.effects)

    def told(self) -> str:
        """Joints, actuators and effects."""
        robot, effects = self.robot, [f"{own.name} at {own.location}" for own in self.effects]
        parts = (
            listed(robot.joint_names, "joint"),
            listed(robot.actuator_names, "actuator"),
            listed(effects, "effect"),
        )
        return f" {self.name}: {', '.join(parts)}" + (f", {self.phase}" if self.phase != "swing" else "")

    @property
    def name(self) -> str:
        """The robot's name."""
        return self.robot.name

    @property
    def morphology(self) -> Morphology:
        """The robot where it has to have elastic actuators.

        Raises:
            ConfigError: where it has none.
        """
        return elastic_of(self.robot)

    def parameters(self) -> dict[str, float]:
        """Every number by its dotted name: the robot's, and those of effects as ``baa.transport_delay.delay``.

        Where a place has several effects of one name, those after the first are numbered: ``knee.joint_stop#2.angle``.
        """
        values = self.robot.parameters()
        return values | {name: float(getattr(e, key)) for name, (e, key) in self.effect_parameters().items()}

    def effect_parameters(self) -> dict[str, tuple[Effect, str]]:
        """Dotted name → the effect whose parameter it is, and which."""
        found: dict[str, tuple[Effect, str]] = {}
        for effect, prefix in zip(self.effects, self.effect_prefixes(), strict=True):
            found |= {prefix + key: (effect, key) for key in effect.parameter_info()}
        return found

    def effect_prefixes(self) -> list[str]:
        """For each effect what its parameters' dotted names begin with, the last dot included."""
        count: dict[str, int] = {}
        prefixes = []
        for effect in self.effects:
            label = f"{effect.location}.{effect.name}"
            count[label] = count.get(label, 0) + 1
            prefixes.append(f"{label}." if count[label] == 1 else f"{label}#{count[label]}.")
        return prefixes

    def with_parameters(self, values: Mapping[str, float]) -> Model:
        """A copy with some of ``parameters()`` replaced.

        Raises:
            ModelError: for a name that does not exist or a value that cannot be.
            ConfigError: for an effect's value outside its bounds.
        """
        left = dict(values)
        effects = []
        for effect, prefix in zip(self.effects, self.effect_prefixes(), strict=True):
            own = {key: left.pop(prefix + key) for key in effect.parameter_info() if prefix + key in left}
            effects.append(replace(effect, **own) if own else effect)  # type: ignore[arg-type]
        if not left:
            return replace(self, effects=tuple(effects))
        if not self.robot.has_parameters(left):
            known = self.parameters()
            wrong = next(name for name in left if name not in known)
            raise ModelError(unknown_name("parameter", wrong, known, self.name))
        return replace(self, robot=self.robot.with_parameters(left), effects=tuple(effects))

    def in_group(self, group: str) -> Model:
        """The model as it is in a group of trials."""
        own = dict(self.by_group).get(group, ())
        return replace(self.with_parameters(dict(own)), by_group=()) if self.by_group else self

    def with_groups(self, values: Mapping[str, Mapping[str, float]]) -> Model:
        """A copy with other values of some parameters in some groups of trials, beside those that it has there."""
        known = {group: dict(own) for group, own in self.by_group}
        whole = {group: known.get(group, {}) | dict(values.get(group, {})) for group in {**known, **values}}
        return replace(self, by_group=tuple((group, tuple(own.items())) for group, own in whole.items() if own))


def nominal_model() -> Model:
    """The nominal leg without effects."""
    return Model(nominal_leg())


def model_from_dict(
    data: Mapping[str, Any], where: str = "model", read_mjcf: Callable[[str, Edits], MjcfRobot] | None = None
) -> Model:
    """A model from what a model file holds.

    Args:
        data: the file's table.
        where: what messages start with.
        read_mjcf: gives the robot of an MJCF file that is named in it.

    Raises:
        ConfigError: for an unknown key, a wrong type or an unknown name, in one sentence that starts with ``where``.
        ModelError: for a morphology that cannot be.
    """
    try:
        if "mjcf" in data:
            return _mjcf_from_dict(data, where, read_mjcf)
        return _model_from_dict(data, where)
    except (ConfigError, ModelError) as error:
        if str(error).startswith(f"{where}: "):
            raise
        raise type(error)(f"{where}: {error}") from None


def _mjcf_from_dict(data: Mapping[str, Any], where: str, read_mjcf: Callable[[str, Edits], MjcfRobot] | None) -> Model:
    known = ("format", "name", "mjcf", "lock", "ignore", "motors", "prescribe", "unmeasured", "parameters", "effects")
    for key in data:
        if key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
    if data.get("format", FORMAT) != FORMAT:
        raise ConfigError(f"{where}: format is {data['format']!r}, expected {FORMAT!r}")
    if not isinstance(data["mjcf"], str) or read_mjcf is None:
        raise ConfigError(f"{where}: mjcf is {data['mjcf']!r}, expected the name of an MJCF file")
    robot = read_mjcf(data["mjcf"], _edits(data, where)).with_parameters(
        _numbers(data.get("parameters", {}), f"{where}: parameters")
    )
    name = data.get("name", robot.name)
    if not isinstance(name, str):
        raise ConfigError(f"{where}: name is {name!r}, expected a text")
    if not name.strip():
        raise ConfigError(f"{where}: name is {name!r}, expected one that can be read, or none")
    return Model(replace(robot, name=name), tuple(_effect(e, where) for e in _tables(data.get("effects", []), where)))


def _edits(data: Mapping[str, Any], where: str) -> Edits:
    lock, motors = _numbers(data.get("lock", {}), f"{where}: lock"), data.get("motors")
    ignore, prescribe, unmeasured = (data.get(key, []) for key in ("ignore", "prescribe", "unmeasured"))
    kinds = ("ignore", ignore, "actuators and loose objects"), ("prescribe", prescribe, "joints")
    for key, names, what in (*kinds, ("unmeasured", unmeasured, "joints")):
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ConfigError(f"{where}: {key} is {names!r}, expected a list of names of {what}")
    if not isinstance(motors, bool | None):
        raise ConfigError(f"{where}: motors is {motors!r}, expected true or false")
    return Edits(lock, tuple(ignore), bool(motors), tuple(prescribe), unmeasured=tuple(unmeasured))


def _model_from_dict(data: Mapping[str, Any], where: str) -> Model:
    known = ("format", "name", "morphology", "phase", "parameters", "effects")
    for key in data:
        if key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
    if data.get("format", FORMAT) != FORMAT:
        raise ConfigError(f"{where}: format is {data['format']!r}, expected {FORMAT!r}")
    described = data.get("morphology", "nominal_leg")
    if isinstance(described, str):
        if described not in MORPHOLOGIES:
            raise ConfigError(unknown_name("morphology", described, MORPHOLOGIES, where))
        morphology = MORPHOLOGIES[described]()
    elif isinstance(described, Mapping):
        morphology = _build(Morphology, described, f"{where}: morphology")
    else:
        raise ConfigError(f"{where}: morphology is {described!r}, expected a name or a table")
    parameters = _numbers(data.get("parameters", {}), f"{where}: parameters")
    morphology = morphology.with_parameters(parameters)
    if "name" in data:
        if not str(data["name"]).strip():
            raise ConfigError(f"{where}: name is {data['name']!r}, expected one that can be read, or none")
        morphology = _build(Morphology, {**_shallow(morphology), "name": data["name"]}, where)
    phase = data.get("phase", "swing")
    if phase not in get_args(Phase):
        raise ConfigError(unknown_name("phase", str(phase), get_args(Phase), where))
    return Model(morphology, tuple(_effect(e, where) for e in _tables(data.get("effects", []), where)), phase)


def model_to_dict(model: Model) -> dict[str, Any]:
    """What a model file of ``model`` holds; ``model_from_dict`` gives the same model back."""
    data: dict[str, Any] = {"format": FORMAT, "name": model.name}
    if model.robot.traits.has_stance:
        data["phase"] = model.phase
    data |= model.robot.to_dict()
    data["effects"] = [{"effect": e.name, "location": e.location, **e.parameters()} for e in model.effects]
    return data


def _shallow(part: Any) -> dict[str, Any]:
    return {f.name: getattr(part, f.name) for f in fields(part)}


def _tables(value: Any, where: str) -> list[Mapping[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, Mapping) for item in value):
        raise ConfigError(f"{where}: effects is {value!r}, expected [[effects]] tables")
    return value


def _effect(data: Mapping[str, Any], where: str) -> Effect:
    for key in ("effect", "location"):
        if not isinstance(data.get(key), str):
            raise ConfigError(f"{where}: an [[effects]] table lacks {key!r}")
    rest = {key: value for key, value in data.items() if key not in ("effect", "location")}
    return effects_base.make(data["effect"], data["location"], _numbers(rest, f"{where}: {data['effect']}"), where)


def _numbers(data: Any, where: str) -> dict[str, float]:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: {data!r} is not a table of numbers")
    for key, value in data.items():
        if isinstance(value, Mapping):
            raise ConfigError(
                f'{where}: {key!r} is a table; put a dotted name in quotes, such as "maa.stiffness" = 280'
            )
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{where}: {key} is {value!r}, expected a number")
    return dict(data)


def _build(cls: Any, data: Mapping[str, Any], where: str) -> Any:
    """A frozen dataclass from a table, its nested dataclasses and tuples of them included."""
    hints = get_type_hints(cls)
    names = [f.name for f in fields(cls)]
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key not in names:
            raise ConfigError(f"{where}: there is no key {key!r}{nearest(key, names)} (known: {', '.join(names)})")
        values[key] = _convert(hints[key], value, f"{where}: {key}")
    for f in fields(cls):
        if f.name not in values and f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(f"{where}: {f.name!r} is missing")
    return cls(**values)


def _convert(hint: Any, value: Any, where: str) -> Any:
    if is_dataclass(value):
        return value
    if get_origin(hint) is tuple:
        item_type = get_args(hint)[0]
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where} is {value!r}, expected a list of tables")
        return tuple(_convert(item_type, item, f"{where}[{i}]") for i, item in enumerate(value))
    if get_origin(hint) is Mapping:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where} is {value!r}, expected a table")
        return value
    options = [t for t in get_args(hint) if t is not type(None)]
    if value is None and options:
        return None
    target = options[0] if options else hint
    if is_dataclass(target):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where} is {value!r}, expected a table")
        return _build(target, value, where)
    if target is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if target is str and isinstance(value, str):
        return value
    raise ConfigError(f"{where} is {value!r}, expected {'a number' if target is float else 'a text'}")
