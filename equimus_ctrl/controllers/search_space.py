"""What a tuning may change of a controller's settings: numbers by name, each with its range, scale and first value."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, PlantSpec

Scale = Literal["log", "linear"]

Table = Mapping[str, Any]
"""What a settings file holds."""

Growth = Callable[[Table, Model, Sequence[Array], Sequence[float]], Sequence[float]]
"""(settings, a robot, poses (nj,) [rad or m], factors on all gains) → of each factor the largest |eigenvalue| of the
sampled loops of the controller, which knows the nominal model, and that robot about those poses."""


@dataclass(frozen=True)
class Range:
    """Where a number is looked for.

    Attributes:
        low: least.
        high: most.
        start: where the search begins.
        scale: ``"log"``, of numbers that matter by their factors, or ``"linear"``.

    Raises:
        ConfigError: for a range that is none.
    """

    low: float
    high: float
    start: float
    scale: Scale = "log"

    def __post_init__(self) -> None:
        if self.scale not in get_args(Scale):
            raise ConfigError(unknown_name("scale", str(self.scale), get_args(Scale)))
        least = "0 < low" if self.scale == "log" else "low"
        positive = self.low > 0 or self.scale == "linear"
        if not (positive and -math.inf < self.low <= self.start <= self.high < math.inf) or self.low == self.high:
            raise ConfigError(
                f"low {self.low:g}, start {self.start:g}, high {self.high:g}; expected {least} ≤ start ≤ high"
            )


@dataclass(frozen=True)
class Narrowing:
    """What a study says of a number that a controller declares; None where it leaves that as it is.

    Attributes:
        low: least.
        high: most.
        start: where the search begins; else the declared start, or what is nearest to it.
    """

    low: float | None = None
    high: float | None = None
    start: float | None = None

    def of(self, own: Range) -> Range:
        """The narrower range.

        Raises:
            ConfigError: where it reaches beyond the declared one, or is none.
        """
        low = own.low if self.low is None else self.low
        high = own.high if self.high is None else self.high
        for key, value in (("low", low), ("high", high)):
            if not own.low <= value <= own.high:
                raise ConfigError(f"{key} is {value:g}, expected {own.low:g} to {own.high:g}")
        return Range(low, high, min(max(own.start, low), high) if self.start is None else self.start, own.scale)


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """What is searched of a controller's settings on one robot.

    Attributes:
        ranges: name → range; a name with dots lies in tables within the settings.
        first: settings beside those searched.
        made: what the settings file holds of ``first`` and the values that are searched; by default each value stands
            under its name.
        growth: of the controller's linearised sampled loops; None where there are none to look at.
    """

    ranges: Mapping[str, Range]
    first: Table = field(default_factory=dict)
    made: Callable[[Table, Mapping[str, float]], dict[str, Any]] = field(
        default=lambda first, values: _with(first, values)
    )
    growth: Growth | None = None

    def settings(self, values: Mapping[str, float]) -> dict[str, Any]:
        """What the settings file holds of values by name, which are taken to six digits: what is tried is written."""
        return self.made(self.first, {name: float(f"{value:.6g}") for name, value in values.items()})

    def narrowed(self, search: Mapping[str, Narrowing], settings: Table) -> SearchSpace:
        """What a study leaves of it.

        Args:
            search: name → narrower range.
            settings: what stands beside what is searched; a number that is declared is no longer searched then.

        Raises:
            ConfigError: for a name that is not declared, a range beyond the declared one, or where nothing is left.
        """
        for name in search:
            if name not in self.ranges:
                raise ConfigError(unknown_name("setting", name, self.ranges, "search"))
        fixed = _flat(settings)
        ranges = {}
        for name, own in self.ranges.items():
            if name in fixed:
                if name in search:
                    raise ConfigError(f"search.{name}: settings say {fixed[name]!r} of it; expected one of both")
                continue
            try:
                ranges[name] = search[name].of(own) if name in search else own
            except ConfigError as error:
                raise ConfigError(f"search.{name}: {error}") from None
        if not ranges:
            raise ConfigError(f"settings leave nothing to search of {', '.join(self.ranges)}")
        return replace(self, ranges=ranges, first=_with(self.first, fixed))


Search = Mapping[str, Range] | Callable[[PlantSpec, Array], SearchSpace]
"""What a controller declares: ranges of its settings, or what makes the space of a plant and a first pose (nj,)."""


def space_of(search: Search, spec: PlantSpec, pose: Array) -> SearchSpace:
    """What a controller declares, on one robot.

    Args:
        search: what its entry says.
        spec: of the plant.
        pose: (nj,) where the robot begins [rad or m].

    Raises:
        ControllerError: where it cannot drive the robot.
    """
    return search(spec, pose) if callable(search) else SearchSpace(search)


def _flat(table: Table, before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= _flat(value, f"{before}{key}.") if isinstance(value, Mapping) else {before + key: value}
    return found


def _with(table: Table, values: Mapping[str, Any]) -> dict[str, Any]:
    """A table with values by dotted names in their places."""
    found = dict(table)
    for name, value in values.items():
        key, dot, rest = name.partition(".")
        found[key] = _with(found.get(key, {}), {rest: value}) if dot else value
    return found
