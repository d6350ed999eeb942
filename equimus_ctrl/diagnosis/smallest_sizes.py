"""The smallest sizes at which effects would be accepted beside a hypothesis."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.findings import named_candidate
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.results import Detectable
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.models.model import Model

ROUNDS = 3
"""So often sizes are looked at again at the smallest detectable ones that were found."""
NEAR, FAR = 1.5, 10.0
"""Factors of χ² from the threshold within which a size is not looked at again, and beyond which nothing is said of it:
what a large change of parameters cancels does not show by the curvature that a small one leaves."""
MOST_CHANGED = 30.0
"""Factor by which a size changes from one round to the next at most."""


def smallest_sizes(
    model: Model, screened: Sequence[Screened], threshold: Callable[[int], float]
) -> tuple[Detectable, ...]:
    """The smallest size of each effect that would be accepted, to first order.

    χ² of its change beyond the free parameters, ``Screened.strength``, grows with the square of the size. So from the
    guess of size a whose strength s is nearest to the acceptance threshold the smallest size is a·√(threshold/s); inf
    where no guess is within a factor ``FAR`` of it. Of an effect without a size it is the weakest guess that would be
    accepted; nan where none would.

    Args:
        model: at whose places the effects are.
        screened: each candidate alone.
        threshold: acceptance threshold of an effect with so many parameters.
    """
    smallest = []
    for s in screened:
        if s.candidate.each or s.candidate.absent:  # of which each place, and all groups, are candidates by themselves
            continue
        size, least = smallest_size(s, threshold(s.candidate.n_parameters)), threshold(s.candidate.n_parameters)
        if s.candidate.grows_from() and not is_near(s, least, FAR):
            size = math.inf
        key = next(iter(s.candidate.effect.parameter_info()))
        unit = s.candidate.effect.parameter_info()[key]["unit"]
        unit_there = place_unit(model, unit, s.candidate.locations[0])
        named = named_candidate(s.candidate)
        smallest.append(Detectable(named, key, size, unit_there))
    return tuple(smallest)


def smallest_size(screened: Screened, threshold: float) -> float:
    """The value of the first parameter at which the change alone would be accepted, from the closest guess."""
    key, nothing = next(iter(screened.candidate.effect.parameter_info())), screened.candidate.effect.grows_from()
    values = np.array([guess[key] for guess in screened.tried])
    strength = np.maximum(screened.strength, 1e-300)
    if nothing is not None:
        nearest = int(np.argmin(np.abs(np.log(strength / threshold))))
        return float(abs(values[nearest] - nothing) * math.sqrt(threshold / strength[nearest]))
    seen = strength >= threshold
    if not seen.any():
        return math.nan
    return float(values[seen][np.argmin(strength[seen])])


def near_threshold(
    screened: Sequence[Screened],
    threshold: Callable[[int], float],
    strengths: Callable[[Sequence[Candidate]], Sequence[Screened]],
) -> list[Screened]:
    """Candidates at guesses whose strengths are near the acceptance threshold, for a law need not be linear.

    Args:
        screened: each candidate alone.
        threshold: acceptance threshold of an effect with so many parameters.
        strengths: screens candidates.
    """
    candidates = {s.candidate.label: s.candidate for s in screened}
    found = {s.candidate.label: s for s in screened}
    for _ in range(ROUNDS):
        again = [
            replace(s.candidate, guesses=(resized(s, threshold(s.candidate.n_parameters)),))
            for s in found.values()
            if s.candidate.grows_from()
            and s.candidate.fades_to()
            and not s.candidate.each
            and not s.candidate.absent
            and not is_near(s, threshold(s.candidate.n_parameters))
        ]
        if not again:
            break
        found |= {s.candidate.label: replace(s, candidate=candidates[s.candidate.label]) for s in strengths(again)}
    return list(found.values())


def is_near(screened: Screened, threshold: float, factor: float = NEAR) -> bool:
    """Whether a guess is so strong that its size says how large the smallest detectable one is."""
    return bool(np.any(np.abs(np.log(np.maximum(screened.strength, 1e-300) / threshold)) < math.log(factor)))


def resized(screened: Screened, threshold: float) -> dict[str, float]:
    """The guess whose strength is nearest to the threshold, all that its influence is in proportion to made smaller."""
    nearest = int(np.argmin(np.abs(np.log(np.maximum(screened.strength, 1e-300) / threshold))))
    values = dict(screened.tried[nearest])
    ends = screened.candidate.fades_to()
    factor = math.sqrt(threshold / max(float(screened.strength[nearest]), 1e-300))
    factor = float(np.clip(factor, 1 / MOST_CHANGED, MOST_CHANGED))
    return {**values, **{name: end + factor * (values[name] - end) for name, end in ends.items()}}
