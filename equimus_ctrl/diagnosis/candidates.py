"""Candidates: every known effect at every place, with initial sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot


def candidates(
    model: Model, segments: Sequence[Segment], registry: Mapping[str, type[Effect]] = REGISTRY
) -> list[Candidate]:
    """All effects at all places of a robot that recordings could show."""
    robot, excitation = model.robot, excitation_of(model, segments)
    found: dict[tuple[str, tuple[str, ...]], Candidate] = {}
    for name in sorted(registry):
        cls = registry[name]
        if not cls.simulated or robot.traits.catalogue not in cls.robots:
            continue
        for group in location_groups(cls, robot):
            tried = (_within(cls, g) for site in group for g in cls.guesses(excitation[site]))
            guesses = {tuple(g.items()): g for g in tried}
            usable = [g for g in guesses.values() if _attaches(model, cls, group, g)]
            if usable:
                found.setdefault((name, group), Candidate(cls, group, tuple(usable)))
    return list(found.values())


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


def _within(cls: type[Effect], values: Mapping[str, float]) -> Mapping[str, float]:
    """Values within the effect's bounds: sizes that follow from hardly any motion may lie beyond."""
    info = cls.parameter_info()
    return {key: float(np.clip(v, info[key]["low"], info[key]["high"])) for key, v in values.items()}


def _attaches(model: Model, cls: type[Effect], locations: tuple[str, ...], values: Mapping[str, float]) -> bool:
    try:
        replace(model, effects=tuple(cls(location, **values) for location in locations))
    except ConfigError:
        return False
    return True
