"""Which parameters of a model are estimated, within which bounds, and on what scale."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


def in_group(name: str, group: str) -> str:
    """A parameter's name in a group of trials; "" for all of them."""
    return f"{name} in {group}" if group else name


@dataclass(frozen=True)
class FreeParameter:
    """One number that may change.

    Attributes:
        name: dotted, see ``Model.parameters``.
        start: where a search begins.
        low: lower bound.
        high: upper bound.
        unit: SI.
        also: other parameters of the model that have the same value.
        size: the size of a change that counts, where it is known better than ``scale`` guesses.
        group: of trials in which it has this value, others having their own; "" for all.
    """

    name: str
    start: float
    low: float
    high: float
    unit: str
    also: tuple[str, ...] = ()
    size: float | None = None
    group: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise ConfigError(f"bounds of {self.name} are {self.low:g} to {self.high:g}, expected finite numbers")
        if not self.low < self.high:
            raise ConfigError(f"bounds of {self.name} are {self.low:g} to {self.high:g}, expected the lower one first")
        if not self.low <= self.start <= self.high:
            raise ConfigError(
                f"{self.name} is {self.start:g} {self.unit} in the model, outside its bounds {self.low:g} to "
                f"{self.high:g}; widen the bounds or change the model"
            )

    @property
    def label(self) -> str:
        """For people, unlike any other's."""
        return in_group(self.name, self.group)

    @property
    def scale(self) -> float:
        """The size of a change that counts: the number itself, or a tenth of its range where it is about zero."""
        return self.size or max(abs(self.start), 0.1 * min(self.high - self.low, 1e6))


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """The parameters to estimate, as a vector θ.

    Attributes:
        model: whose other parameters stay.
        free: which are free.
    """

    model: Model
    free: tuple[FreeParameter, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Dotted names, in the model's order, with the group of trials where there is one."""
        return tuple(f.label for f in self.free)

    @property
    def start(self) -> Array:
        """(p,) the model's own values."""
        return np.array([f.start for f in self.free])

    @property
    def low(self) -> Array:
        """(p,) lower bounds."""
        return np.array([f.low for f in self.free])

    @property
    def high(self) -> Array:
        """(p,) upper bounds."""
        return np.array([f.high for f in self.free])

    @property
    def scale(self) -> Array:
        """(p,) sizes of changes that count."""
        return np.array([f.scale for f in self.free])

    def moved(self, theta: Array, change: Array) -> Array:
        """(p,) θ after a change (p,) within bounds, along which elastic forces change evenly.

        An actuator's force is stiffness·rest_length − stiffness·length: the rest length goes such that its product with
        the stiffness changes in proportion. Else both together would form a long curved minimum of the cost, along
        which searches progress slowly.
        """
        moved = np.array(theta + change)
        place = {(f.name, f.group): i for i, f in enumerate(self.free)}
        for (name, group), i in place.items():
            owner, _, key = name.rpartition(".")
            k = place.get((f"{owner}.stiffness", group))
            if key in ("rest_length", "rest") and k is not None and moved[k] > 0:
                moved[i] = (theta[k] * moved[i] + theta[i] * change[k]) / moved[k]
        return np.clip(moved, self.low, self.high)

    def at(self, point: Array) -> Array:
        """(p,) θ at a point (p,) in units of the scale, within bounds.

        A bound that goes there and back may come out beyond itself by the last bit.
        """
        return np.clip(point * self.scale, self.low, self.high)

    def held(self, place: int, value: float) -> FreeParameters:
        """All but one of them, which has a value in the model [unit of the parameter]."""
        own = self.free[place]
        values = dict.fromkeys((own.name, *own.also), value)
        model = self.model.with_groups({own.group: values}) if own.group else self.model.with_parameters(values)
        return FreeParameters(model, self.free[:place] + self.free[place + 1 :])

    def model_at(self, theta: Array) -> Model:
        """The model with these values (p,)."""
        values: dict[str, dict[str, float]] = {"": {}}
        for f, value in zip(self.free, theta, strict=True):
            values.setdefault(f.group, {}).update(dict.fromkeys((f.name, *f.also), float(value)))
        model = self.model.with_parameters(values.pop(""))
        return model.with_groups(values) if values else model


BASE = "base_parameters"


def unit_of(model: Model, name: str) -> str:
    """The SI unit of a model's parameter."""
    if found := model.effect_parameters().get(name):
        effect, key = found
        return place_unit(model, str(effect.parameter_info()[key]["unit"]), effect.location)
    return model.robot.unit(name)


def place_unit(model: Model, unit: str, place: str) -> str:
    """The unit of an effect's parameter at a place, see ``effects.base.parameter``: joints and actuators may differ."""
    return model.robot.place_unit(unit, place)


def default_names(model: Model) -> list[str]:
    """What is least known: see ``Robot.default_names``; and all parameters of the effects."""
    return [*model.robot.default_names(), *model.effect_parameters()]


def matching(model: Model, patterns: Sequence[str]) -> list[str]:
    """The parameter names that patterns such as ``*.damping`` mean, in the model's order.

    ``base_parameters`` means the identifiable inertial (base) parameters, see ``Robot.base_names``.

    Raises:
        ConfigError: for a pattern that means none.
    """
    known = list(model.parameters())
    found: set[str] = set()
    for pattern in patterns:
        hits = model.robot.base_names() if pattern == BASE else fnmatch.filter(known, pattern)
        if not hits and pattern == BASE:
            raise ConfigError(f"{model.name}: {BASE} exist for MJCF robots alone; expected names such as {known[0]}")
        if not hits:
            names = [*known, BASE] if model.robot.base_names() else known
            raise ConfigError(unknown_name("parameter", pattern, names, model.name))
        found |= set(hits)
    return [name for name in known if name in found]


def default_bounds(model: Model, name: str) -> tuple[float, float]:
    """Default bounds (lowest, highest) of a free parameter of this kind."""
    if found := model.effect_parameters().get(name):
        effect, key = found
        return effect.bounds(key, model.robot)
    return model.robot.bounds(name)


def free_parameters(
    model: Model,
    names: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fix: Sequence[str] = (),
) -> FreeParameters:
    """The parameters of a model to estimate.

    Args:
        model: where they start.
        names: which, patterns such as ``maa.*`` allowed; ``default_names`` where None.
        bounds: (low, high) of some; ``default_bounds`` of the others.
        fix: names or patterns of what stays as it is all the same.

    Raises:
        ConfigError: where nothing is free, for a name that does not exist, bounds of a number that is not free or that
            are none, or a start outside its bounds.
    """
    kept = matching(model, fix) if fix else []
    wanted = default_names(model) if names is None else matching(model, names)
    chosen = [name for name in wanted if name not in kept]
    if not chosen:
        raise ConfigError(f"{model.name}: no parameter is free, so there is nothing to identify")
    bounds = bounds or {}
    for name in bounds:
        if name not in chosen:
            raise ConfigError(unknown_name("free parameter", name, chosen, "bounds"))
    values, robot = model.parameters(), model.robot
    free = []
    for name in chosen:
        low, high = bounds.get(name) or default_bounds(model, name)
        own = robot.has_parameters([name])
        if own and low < 0 and robot.positive(name):
            raise ConfigError(f"bounds of {name} are {low:g} to {high:g}, expected at least 0")
        size = robot.size(name) if own else None
        free.append(FreeParameter(name, values[name], float(low), float(high), unit_of(model, name), size=size))
    return FreeParameters(model, tuple(free))
