"""Hypotheses: what is taken to be missing from a model, where, and with which values; and what is free in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.identification.parameters import (
    FreeParameter,
    FreeParameters,
    default_bounds,
    free_parameters,
    unit_of,
)
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect at one place, or with the same parameters at several.

    Attributes:
        effect: its class.
        locations: where.
        guesses: parameter sets to begin from.
    """

    effect: type[Effect]
    locations: tuple[str, ...]
    guesses: tuple[Mapping[str, float], ...]

    @property
    def label(self) -> str:
        """Such as ``dead_zone:baa``."""
        return f"{self.effect.name}:{'+'.join(self.locations)}"

    @property
    def n_parameters(self) -> int:
        """How many parameters it adds."""
        return len(self.effect.parameter_info())

    def attached(self, values: Mapping[str, float]) -> tuple[Effect, ...]:
        """The effects with these values."""
        return tuple(self.effect(location, **values) for location in self.locations)


@dataclass(frozen=True, eq=False)
class Part:
    """A candidate with values: one piece of missing physics in a hypothesis.

    Attributes:
        candidate: what and where.
        values: of its parameters.
    """

    candidate: Candidate
    values: Mapping[str, float]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """To be attached to a model."""
        return self.candidate.attached(self.values)


Hypothesis = tuple[Part, ...]
"""All that is taken to be missing from a model."""


def model_of(model: Model, hypothesis: Sequence[Part]) -> Model:
    """The model with the hypothesis' effects.

    Raises:
        ConfigError: where two effects exclude each other.
    """
    return replace(model, effects=(*model.effects, *(e for part in hypothesis for e in part.effects)))


def excluded_by(robot: Robot, part: Part, hypothesis: Hypothesis) -> Hypothesis:
    """The parts of a hypothesis that cannot stay beside another: those with an effect in one of its exclusive slots.

    Args:
        robot: as it is modelled.
        part: that comes.
        hypothesis: that it comes to.
    """
    taken = _slots(robot, part)
    return tuple(old for old in hypothesis if taken & _slots(robot, old))


def _slots(robot: Robot, part: Part) -> set[tuple[str, str]]:
    return {slot for effect in part.effects if (slot := effect.exclusive_slot(robot)) is not None}


def with_part(model: Model, hypothesis: Hypothesis, part: Part) -> Hypothesis:
    """The hypothesis with one more part, without those that it excludes.

    Raises:
        ConfigError: where an effect of the model itself excludes it.
    """
    excluded = excluded_by(model.robot, part, hypothesis)
    kept = (*(old for old in hypothesis if old not in excluded), part)
    model_of(model, kept)  # raises where they do not go together
    return kept


def refined(hypothesis: Hypothesis, values: Array) -> Hypothesis:
    """The hypothesis with the values (k,) of all its parameters in their order."""
    left = [float(v) for v in values]
    parts = []
    for part in hypothesis:
        own = dict(zip(part.values, left, strict=False))
        left = left[len(own) :]
        parts.append(Part(part.candidate, own))
    return tuple(parts)


def default_free_parameters(
    model: Model,
    names: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fix: Sequence[str] = (),
) -> FreeParameters:
    """The parameters to estimate, see ``free_parameters``; bounds of damping are narrow where it is known well.

    Damping d > 0 of the model then stays between d/f and d·f, f being ``RobotTraits.damping_known_within``.
    """
    chosen = free_parameters(model, names, bounds, fix)
    if (within := model.robot.traits.damping_known_within) is None:
        return chosen
    known = dict(bounds or {})
    own = model.robot.parameters()
    for f in chosen.free:
        if f.name.endswith(".damping") and f.name in own and own[f.name] > 0:
            known.setdefault(f.name, (own[f.name] / within, own[f.name] * within))
    return free_parameters(model, names, known, fix)


def parameters_of(free: FreeParameters, hypothesis: Hypothesis) -> FreeParameters:
    """What is free in a model with a hypothesis' effects: what is free without them, and their own parameters.

    Args:
        free: of the model without them.
        hypothesis: with values to start from.
    """
    whole = model_of(free.model, hypothesis)
    prefixes = whole.effect_prefixes()[len(free.model.effects) :]
    found = list(free.free)
    for part in hypothesis:
        own, prefixes = prefixes[: len(part.effects)], prefixes[len(part.effects) :]
        for key, value in part.values.items():
            names = [prefix + key for prefix in own]
            bounds = [default_bounds(whole, name) for name in names]
            low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
            size = abs(value) or None
            start = float(np.clip(value, low, high))
            found.append(FreeParameter(names[0], start, low, high, unit_of(whole, names[0]), tuple(names[1:]), size))
    return FreeParameters(whole, tuple(found))
