"""Which numbers of a model are free, between which bounds, and on what scale."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model, machine_of
from equimus_ctrl.types import Array

DEFAULT_KINDS = ("stiffness", "area", "rest_length", "damping")
"""What an actuator's bench values tell least: free by default, with the joints' damping."""

_FACTOR = {"stiffness": 3.0, "area": 3.0, "mass": 3.0, "inertia": 3.0, "damping": 10.0}
_SHARE = {"rest_length": 0.3, "radius": 0.3, "length": 0.1, "com": 0.5, "gravity": 0.02}
_AWAY = {"angle": 0.3, "tilt": 0.3, "com": 0.1, "damping": 1.0, "stiffness": 100.0, "base_mass": 1.0}
_UNIT = {
    "area": "m²", "rest_length": "m", "mass": "kg", "base_mass": "kg", "com": "m", "inertia": "kg·m²", "length": "m",
    "radius": "m", "angle": "rad", "tilt": "rad", "gravity": "m/s²", "command_low": "Pa", "command_high": "Pa",
}  # fmt: skip


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
    """

    name: str
    start: float
    low: float
    high: float
    unit: str
    also: tuple[str, ...] = ()
    size: float | None = None

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
    def scale(self) -> float:
        """The size of a change that counts: the number itself, or a tenth of its range where it is about zero."""
        return self.size or max(abs(self.start), 0.1 * min(self.high - self.low, 1e6))


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """The free numbers of a model, as a vector θ.

    Attributes:
        model: whose other numbers stay.
        free: which are free.
    """

    model: Model
    free: tuple[FreeParameter, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Dotted names, in the model's order."""
        return tuple(f.name for f in self.free)

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
        the stiffness changes in proportion, or the long valley of both together would be a bend that searches creep
        along.
        """
        moved = np.array(theta + change)
        place = {name: i for i, name in enumerate(self.names)}
        for name, i in place.items():
            owner, _, key = name.rpartition(".")
            k = place.get(f"{owner}.stiffness")
            if key in ("rest_length", "rest") and k is not None and moved[k] > 0:
                moved[i] = (theta[k] * moved[i] + theta[i] * change[k]) / moved[k]
        return np.clip(moved, self.low, self.high)

    def model_at(self, theta: Array) -> Model:
        """The model with these values (p,)."""
        values = {name: float(v) for f, v in zip(self.free, theta, strict=True) for name in (f.name, *f.also)}
        return self.model.with_parameters(values)


def unit_of(model: Model, name: str) -> str:
    """The SI unit of a model's parameter."""
    parts = name.split(".")
    machine = machine_of(model)
    if found := model.effect_parameters().get(name):
        effect, key = found
        return place_unit(model, str(effect.parameter_info()[key]["unit"]), effect.location)
    if machine is not None:
        return machine.unit(name)
    if parts[-1] in _UNIT:
        return _UNIT[parts[-1]]
    turning = parts[0] in model.morphology.joint_names
    return {"stiffness": ("N/m", "N·m/rad"), "damping": ("N·s/m", "N·m·s/rad")}[parts[-1]][turning]


def place_unit(model: Model, unit: str, place: str) -> str:
    """The unit of an effect's parameter at a place, see ``effects.base.parameter``: joints and actuators may differ."""
    joint, _, actuator = unit.partition(" | ")
    machine = machine_of(model)
    if machine is not None:
        return machine.turned(joint, place)
    return joint if place in model.morphology.joint_names or not actuator else actuator


def default_names(model: Model) -> list[str]:
    """What is least known: of a machine see ``Machine.default_names``, and all of the effects.

    Of a morphology stiffness, area, rest length and damping of every actuator and damping of every joint.
    """
    m, machine = model.morphology, machine_of(model)
    if machine is not None:
        return [*machine.default_names(), *model.effect_parameters()]
    names = [f"{a.name}.{key}" for key in DEFAULT_KINDS for a in m.actuators]
    names += [f"{joint.name}.damping" for joint in m.joints]
    return names + [name for name in model.parameters() if name not in m.parameters()]


def matching(model: Model, patterns: Sequence[str]) -> list[str]:
    """The parameter names that patterns such as ``*.damping`` mean, in the model's order.

    Raises:
        ConfigError: for a pattern that means none.
    """
    known = list(model.parameters())
    found: set[str] = set()
    for pattern in patterns:
        hits = fnmatch.filter(known, pattern)
        if not hits:
            raise ConfigError(unknown_name("parameter", pattern, known, model.name))
        found |= set(hits)
    return [name for name in known if name in found]


def default_bounds(model: Model, name: str) -> tuple[float, float]:
    """How far a number of this kind is believed to be off at most."""
    if found := model.effect_parameters().get(name):
        effect, key = found
        return effect.bounds(key, model.morphology)
    if (machine := machine_of(model)) is not None:
        return machine.bounds(name)
    value, kind = model.parameters()[name], name.split(".")[-1]
    if kind in _FACTOR and value > 0:
        return value / _FACTOR[kind], value * _FACTOR[kind]
    if kind in _SHARE and value > 0:
        return value * (1 - _SHARE[kind]), value * (1 + _SHARE[kind])
    away = _AWAY.get(kind, max(abs(value), 1.0))
    least = 0.0 if kind in _FACTOR else -math.inf
    return max(value - away, least), value + away


def free_parameters(
    model: Model,
    names: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fix: Sequence[str] = (),
) -> FreeParameters:
    """The numbers of a model that may change.

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
    values = model.parameters()
    free = []
    for name in chosen:
        low, high = bounds.get(name) or default_bounds(model, name)
        own = machine_of(model)
        if own is not None and low < 0 and own.has_parameters([name]) and own.positive(name):
            raise ConfigError(f"bounds of {name} are {low:g} to {high:g}, expected at least 0")
        size = None
        if (machine := machine_of(model)) is not None and values[name] == 0 and machine.has_parameters([name]):
            size = machine.size(name)
        free.append(FreeParameter(name, values[name], float(low), float(high), unit_of(model, name), size=size))
    return FreeParameters(model, tuple(free))
