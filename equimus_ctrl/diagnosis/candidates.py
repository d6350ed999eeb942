"""Candidates: every known effect at every place, with initial sizes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.hypothesis import Candidate, OwnParameter
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.segments import DELAY_SHARE, Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot

BETWEEN_ROWS = 0.5
"""Shortest one where commands go along lines, as a share of the time between rows: a command that is held from row to
row in place of that comes so much later in the mean, and recordings do not show what it does between them."""


def candidates(
    model: Model, segments: Sequence[Segment], registry: Mapping[str, type[Effect]] = REGISTRY
) -> list[Candidate]:
    """All effects at all places of a robot that recordings could show.

    A law of all joints comes twice: with the same parameters at each, for joints built alike, and, of a robot that
    nothing holds in place (``RobotTraits.held_in_place``), with its own at each, for joints that are not.
    """
    robot, excitation = model.robot, excitation_of(model, segments)
    least_time, most_time = _shortest_delay(segments), _longest_delay(model, segments)
    found: dict[str, Candidate] = {}
    for name in sorted(registry):
        cls = registry[name]
        if not cls.simulated or robot.traits.catalogue not in cls.robots:
            continue
        times = [key for key, info in cls.parameter_info().items() if cls.delays and info["unit"] == "s"]
        most = dict.fromkeys(times, most_time)
        least = dict.fromkeys(times, least_time) if least_time > 0 else {}
        for group in location_groups(cls, robot):
            of_places = [
                [_within(cls, guess, least, most) for guess in cls.guesses(excitation[site])] for site in group
            ]
            for each in (False, True) if len(group) > 1 and not robot.traits.held_in_place else (False,):
                candidate = Candidate(cls, group, (), each, most, least=least)
                tried = _own_of_each(candidate, of_places) if each else [g for own in of_places for g in own]
                guesses = {tuple(guess.items()): guess for guess in tried}
                usable = tuple(guess for guess in guesses.values() if _attaches(model, candidate, guess))
                if usable:
                    found.setdefault(candidate.label, replace(candidate, guesses=usable))
    return list(found.values())


def _longest_delay(model: Model, segments: Sequence[Segment]) -> float:
    """What delays and lags can last where trials are cut into shooting intervals [s]: a share of these.

    A delay as long as an interval takes all that the interval shows from before its start, where there is nothing.
    """
    if model.robot.traits.held_in_place:
        return math.inf
    longest = max(float(s.trial.sample_times[-1] - s.trial.start) for s in segments)
    return DELAY_SHARE * longest


def _shortest_delay(segments: Sequence[Segment]) -> float:
    """What delays and lags last at least that all recordings could show [s], see ``BETWEEN_ROWS``; 0 of held commands.

    Delays of less are no physics: a stiff servo whose goal comes late by the time t is as one with friction of t times
    its stiffness in proportion to speed.
    """
    if not all(s.trial.linear for s in segments):
        return 0.0
    return BETWEEN_ROWS * max(float(np.median(np.diff(s.trial.times))) for s in segments)


def _own_of_each(candidate: Candidate, guesses: Sequence[Sequence[Mapping[str, float]]]) -> list[dict[str, float]]:
    """Guesses of a law with its own parameters at each place: the same choice of each place's own guesses."""
    return [
        {own.name: of_place[own.key] for own, of_place in _by_parameter(candidate, row)}
        for row in zip(*guesses, strict=False)
    ]


def _by_parameter(
    candidate: Candidate, row: Sequence[Mapping[str, float]]
) -> list[tuple[OwnParameter, Mapping[str, float]]]:
    place = dict(zip(candidate.locations, row, strict=True))
    return [(own, place[own.places[0]]) for own in candidate.parameters]


def location_groups(cls: type[Effect], robot: Robot) -> list[tuple[str, ...]]:
    """Where an effect is tried on a robot: at each place by itself, and with the same parameters at all of a kind."""
    places, found = cls.places_on(robot), list[tuple[str, ...]]()
    for kind in cls.sits_at:
        # The last link's tip is the foot: one place is not to have two names.
        twice = robot.foot_link if kind == "link" and "foot" in cls.sits_at else None
        sites = [site for site in places[kind] if site != twice]
        found += [(site,) for site in sites]
        if cls.alike and len(sites) > 1 and kind in ("joint", "actuator"):
            found.append(tuple(sites))
    return found


def _within(
    cls: type[Effect], values: Mapping[str, float], least: Mapping[str, float], most: Mapping[str, float]
) -> Mapping[str, float]:
    """Values within the effect's bounds and those of the recordings: sizes from hardly any motion may lie beyond."""
    info = cls.parameter_info()
    low = {key: max(info[key]["low"], least.get(key, -math.inf)) for key in values}
    high = {key: min(info[key]["high"], most.get(key, math.inf)) for key in values}
    return {key: float(np.clip(v, low[key], high[key])) for key, v in values.items()}


def _attaches(model: Model, candidate: Candidate, values: Mapping[str, float]) -> bool:
    try:
        replace(model, effects=candidate.attached(values))
    except ConfigError:
        return False
    return True
