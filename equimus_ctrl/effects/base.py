"""What an effect is: one piece of physics with a place, named parameters, units and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any, ClassVar, Literal

from equimus_ctrl.errors import ConfigError, unknown_name

Side = Literal["command", "force", "measurement"]


def parameter(unit: str, low: float, high: float, doc: str) -> Any:
    """A dataclass field for an effect's parameter: its unit, its bounds and what it means."""
    return field(metadata={"unit": unit, "low": low, "high": high, "doc": doc})


@dataclass(frozen=True)
class Effect:
    """Base of all effects; a subclass names its parameters as dataclass fields made with ``parameter``.

    Attributes:
        location: the joint, actuator or body it sits at.

    Raises:
        ConfigError: where a parameter lies outside its bounds.
    """

    name: ClassVar[str]
    side: ClassVar[Side]
    sits_at: ClassVar[str]
    summary: ClassVar[str]
    exclusive: ClassVar[str | None] = None
    """Of effects that share this word one place can have only one."""

    location: str

    def __post_init__(self) -> None:
        for key, meta in self.parameter_info().items():
            value = getattr(self, key)
            if not isinstance(value, Real):
                raise ConfigError(f"effect {self.name} at {self.location!r}: {key} is {value!r}, expected a number")
            if not (math.isfinite(value) and meta["low"] <= value <= meta["high"]):
                raise ConfigError(
                    f"effect {self.name} at {self.location!r}: {key} is {value:g} {meta['unit']}, "
                    f"expected {meta['low']:g} to {meta['high']:g} {meta['unit']}"
                )

    @classmethod
    def parameter_info(cls) -> dict[str, Mapping[str, Any]]:
        """Parameter name → unit, low, high, doc."""
        return {f.name: f.metadata for f in fields(cls) if f.metadata}

    def parameters(self) -> dict[str, float]:
        """Parameter name → value."""
        return {key: float(getattr(self, key)) for key in self.parameter_info()}


REGISTRY: dict[str, type[Effect]] = {}


def register(cls: type[Effect]) -> type[Effect]:
    """Class decorator: make an effect known by its name."""
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


def check_locations(effects: Sequence[Effect], joints: Sequence[str], actuators: Sequence[str], where: str) -> None:
    """Raise ConfigError where an effect sits at something the robot does not have."""
    places = {"actuator": actuators, "joint": joints}
    for effect in effects:
        known = places[effect.sits_at]
        if effect.location not in known:
            raise ConfigError(unknown_name(effect.sits_at, effect.location, known, f"{where}: effect {effect.name}"))
    taken: dict[tuple[str, str], str] = {}
    for effect in effects:
        if effect.exclusive is None:
            continue
        slot = (effect.exclusive, effect.location)
        if slot in taken:
            raise ConfigError(
                f"{where}: {effect.location!r} has two effects that exclude each other, {taken[slot]} and {effect.name}"
            )
        taken[slot] = effect.name
