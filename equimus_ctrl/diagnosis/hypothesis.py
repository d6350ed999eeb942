"""Hypotheses: what is taken to be missing from a model, where, and with which values; and what is free in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.identification.parameters import (
    FreeParameter,
    FreeParameters,
    default_bounds,
    free_parameters,
    in_group,
    unit_of,
)
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class OwnParameter:
    """A parameter that a candidate adds.

    Attributes:
        name: the effect's own name of it; where each place has its own, the place's before that, as ``elbow.damping``.
        key: the effect's own name of it.
        places: where it acts.
        group: of trials in which it has this value of its own; "" for all others.
    """

    name: str
    key: str
    places: tuple[str, ...]
    group: str = ""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect at one place, or one law at several: with the same parameters, or with its own at each.

    Attributes:
        effect: its class.
        locations: where.
        guesses: parameter sets to begin from, by the names of ``common``.
        each: whether each place has parameters of its own, as friction in all joints of an arm has.
        most: upper bounds of parameters that recordings set, beside the effect's own, by key: a delay near the length
            of a shooting interval would stand for anything.
        own: parameters that have a value of their own in a group of trials, each with the group.
        absent: groups of trials in which it does not act.
        given: parameters of the effect that are not estimated, by key: where a spline's knots are, say.
        least: lower bounds that recordings set, as ``most``: what a delay shorter than that is, they do not show.
    """

    effect: type[Effect]
    locations: tuple[str, ...]
    guesses: tuple[Mapping[str, float], ...]
    each: bool = False
    most: Mapping[str, float] = field(default_factory=dict)
    own: tuple[tuple[str, str], ...] = ()
    absent: tuple[str, ...] = ()
    given: Mapping[str, float] = field(default_factory=dict)
    least: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def common(self) -> tuple[OwnParameter, ...]:
        """What it adds in all groups of trials, in order."""
        keys = [key for key in self.effect.parameter_info() if key not in self.given]
        if not self.each:
            return tuple(OwnParameter(key, key, self.locations) for key in keys)
        return tuple(OwnParameter(f"{place}.{key}", key, (place,)) for place in self.locations for key in keys)

    @cached_property
    def parameters(self) -> tuple[OwnParameter, ...]:
        """What it adds, in order: those of all groups of trials, then those of one."""
        by_name = {p.name: p for p in self.common}
        own = (replace(by_name[name], name=in_group(name, group), group=group) for name, group in self.own)
        return (*self.common, *own)

    def in_each_group(self, common: Mapping[str, float]) -> dict[str, float]:
        """Values of all parameters, by those of ``common``: what has one of its own in a group has the common one."""
        own = {in_group(name, group): common[name] for name, group in self.own}
        return {p.name: {**common, **own}[p.name] for p in self.parameters}

    @property
    def label(self) -> str:
        """Such as ``dead_zone:baa``; ``a+b`` with the same parameters, ``a,b`` with its own at each."""
        text = f"{self.effect.name}:{(',' if self.each else '+').join(self.locations)}"
        own = "".join(f" [{in_group(name, group)}]" for name, group in self.own)
        return text + own + "".join(f" [not in {group}]" for group in self.absent)

    @property
    def n_parameters(self) -> int:
        """How many parameters it adds."""
        return len(self.parameters)

    def at(self, values: Mapping[str, float], location: str) -> dict[str, float]:
        """The effect's own parameters at one of its places."""
        known = {**self.given, **{own.key: values[own.name] for own in self.common if location in own.places}}
        return {key: known[key] for key in self.effect.parameter_info()}

    def attached(self, values: Mapping[str, float]) -> tuple[Effect, ...]:
        """The effects with these values."""
        return tuple(self.effect(location, **self.at(values, location)) for location in self.locations)

    def grows_from(self) -> dict[str, float]:
        """The value at which it does nothing of each parameter that scales it; empty where there is none."""
        nothing, first = self.effect.grows_from(), next(iter(self.effect.parameter_info()))
        return {} if nothing is None else {own.name: nothing for own in self.parameters if own.key == first}

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the parameters that scale it, in all groups of trials; none where none does."""
        return tuple(own.name for own in self.common if own.name in self.grows_from())

    def fades_to(self) -> dict[str, float]:
        """``Effect.fades_to`` of all its parameters."""
        end = self.effect.fades_to()
        return {own.name: end[own.key] for own in self.parameters if own.key in end}

    def alone(self, location: str) -> Candidate:
        """The same effect at one of its places."""
        here = {p.name: p.key for p in self.common if location in p.places}
        guesses = tuple({key: guess[name] for name, key in here.items()} for guess in self.guesses)
        own = tuple((here[name], group) for name, group in self.own if name in here)
        return replace(self, locations=(location,), guesses=guesses, each=False, own=own)

    def narrowed(self, locations: tuple[str, ...]) -> Candidate:
        """The same law at fewer of the places that have parameters of their own."""
        if len(locations) == 1:
            return self.alone(locations[0])
        kept = [own.name for own in self.common if set(own.places) & set(locations)]
        guesses = tuple({name: guess[name] for name in kept} for guess in self.guesses)
        own = tuple((name, group) for name, group in self.own if name in kept)
        return replace(self, locations=locations, guesses=guesses, own=own)


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

    def narrowed(self, locations: tuple[str, ...]) -> Part:
        """The same at fewer of the places that have parameters of their own."""
        smaller = self.candidate.narrowed(locations)
        if len(locations) > 1:
            return Part(smaller, {o.name: self.values[o.name] for o in smaller.parameters})
        here = [p for p in self.candidate.parameters if locations[0] in p.places]
        return Part(smaller, {in_group(p.key, p.group): self.values[p.name] for p in here})


Hypothesis = tuple[Part, ...]
"""All that is taken to be missing from a model."""


def model_of(model: Model, hypothesis: Sequence[Part]) -> Model:
    """The model with the hypothesis' effects.

    Raises:
        ConfigError: where two effects exclude each other.
    """
    whole = replace(model, effects=(*model.effects, *(e for part in hypothesis for e in part.effects)))
    if not any(part.candidate.own or part.candidate.absent for part in hypothesis):
        return whole
    values: dict[str, dict[str, float]] = {}
    for part, prefix_of in zip(hypothesis, _prefixes(whole, hypothesis), strict=True):
        candidate, nothing = part.candidate, part.candidate.grows_from()
        for p in candidate.parameters:
            for group in candidate.absent if p.name in nothing and not p.group else (p.group,) if p.group else ():
                value = part.values[p.name] if p.group else nothing[p.name]
                values.setdefault(group, {}).update({prefix_of[place] + p.key: value for place in p.places})
    return whole.with_groups(values)


def _prefixes(whole: Model, hypothesis: Sequence[Part]) -> list[dict[str, str]]:
    """For each part, by its places, what its parameters' dotted names begin with in the model with all of them."""
    prefixes = whole.effect_prefixes()
    left = prefixes[len(prefixes) - sum(len(part.candidate.locations) for part in hypothesis) :]
    found = []
    for part in hypothesis:
        own, left = left[: len(part.candidate.locations)], left[len(part.candidate.locations) :]
        found.append(dict(zip(part.candidate.locations, own, strict=True)))
    return found


def given_names(model: Model, hypothesis: Sequence[Part]) -> tuple[str, ...]:
    """Dotted names of the parameters of a hypothesis' last part that are given, in the model with it."""
    (*_, prefix_of) = _prefixes(model_of(model, hypothesis), hypothesis)
    return tuple(prefix_of[place] + key for place in prefix_of for key in hypothesis[-1].candidate.given)


def beside(robot: Robot, part: Part, hypothesis: Hypothesis) -> Hypothesis:
    """What of a hypothesis can stay beside another part: what has no effect in one of its exclusive slots.

    Of a law with its own parameters at each place those places stay at which it is not excluded.

    Args:
        robot: as it is modelled.
        part: that comes.
        hypothesis: that it comes to.
    """
    taken = _slots(robot, part.effects)
    kept: list[Part] = []
    for old in hypothesis:
        free = tuple(e.location for e in old.effects if not taken & _slots(robot, [e]))
        if len(free) == len(old.candidate.locations):
            kept.append(old)
        elif free and old.candidate.each:
            kept.append(old.narrowed(free))
    return tuple(kept)


def _slots(robot: Robot, effects: Iterable[Effect]) -> set[tuple[str, str]]:
    return {slot for effect in effects if (slot := effect.exclusive_slot(robot)) is not None}


def with_part(model: Model, hypothesis: Hypothesis, part: Part) -> Hypothesis:
    """The hypothesis with one more part, without what that excludes, see ``beside``.

    Raises:
        ConfigError: where an effect of the model itself excludes it.
    """
    whole = (*beside(model.robot, part, hypothesis), part)
    model_of(model, whole)  # raises where they do not go together
    return whole


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
    found = list(free.free)
    for part, prefix_of in zip(hypothesis, _prefixes(whole, hypothesis), strict=True):
        for p in part.candidate.parameters:
            value = part.values[p.name]
            names = [prefix_of[place] + p.key for place in p.places]
            bounds = [default_bounds(whole, name) for name in names]
            low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
            low = max(low, part.candidate.least.get(p.key, low))
            high = min(high, max(part.candidate.most.get(p.key, high), value))
            size = abs(value) or None
            start = float(np.clip(value, low, high))
            unit, also = unit_of(whole, names[0]), tuple(names[1:])
            found.append(FreeParameter(names[0], start, low, high, unit, also, size, p.group))
    return FreeParameters(whole, tuple(found))
