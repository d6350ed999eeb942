"""Which explanations a diagnosis leaves beside the one that it gives, for experiments to decide between."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from equimus_ctrl.diagnosis.findings import smallest_size
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Part
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.results import Equivalent, Finding
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.models.model import Model

MOST = 8
"""So many are kept: each holds residuals of all trials."""
MOST_NEAREST = 3
"""So many of those that come nearest to what has no name."""


def left_by(
    search: Search,
    end: SearchState,
    equivalent: Sequence[Sequence[Equivalent]],
    undetermined: Sequence[Finding],
) -> tuple[Fitted, ...]:
    """What fits as well as the end, and the end without those of its parts whose parameters are not identified.

    Args:
        search: that ended there.
        end: of the search.
        equivalent: for each part what fits as well in its place.
        undetermined: findings that are not named.
    """
    doubtful = {id(part) for finding in undetermined for part in (finding.part, finding.law)}
    without = [fit for part, fit in zip(end.best.hypothesis, end.without, strict=False) if id(part) in doubtful]
    others = sorted((own.fitted for others in equivalent for own in others), key=search.score)
    unlike = {fit.labels: fit for fit in reversed((*without, *others)) if fit.labels != end.best.labels}
    return tuple(reversed(unlike.values()))[:MOST]


def nearest_to(search: Search, end: SearchState, unexplained: Sequence[Unexplained]) -> tuple[Fitted, ...]:
    """Of what was fitted with one part more, there where something is missing that has no name, the best.

    Args:
        search: that ended there.
        end: of the search.
        unexplained: what has no name.
    """
    places = {own.location for own in unexplained}
    places |= {place for own in unexplained if isinstance(own, ResidualForce) for place in own.places}
    found: dict[frozenset[str], Fitted] = {}
    for fitted in sorted(end.tried.fitted, key=search.score):
        more = [part for part in fitted.hypothesis if part.candidate.label not in end.best.labels]
        larger = fitted.labels > end.best.labels and len(more) == 1
        if larger and places & set(more[0].candidate.locations):
            found.setdefault(fitted.labels, fitted)
    return tuple(found.values())[:MOST_NEAREST]


def just_below(model: Model, screened: Sequence[Screened], threshold: Callable[[int], float]) -> tuple[Part, ...]:
    """Effects at the smallest size at which they would have been seen: those of which the recordings say least.

    That is by how many times the median of its guesses, which are sizes that it has, an effect has to be as large. One
    that would have to be larger than all of them is not looked at, nor one without a size.

    Args:
        model: at whose places the effects are.
        screened: each candidate alone.
        threshold: acceptance threshold of an effect with so many parameters.
    """
    found: list[tuple[float, Part]] = []
    for s in screened:
        nothing = s.candidate.effect.grows_from()
        if s.candidate.each or s.candidate.absent or nothing is None:
            continue
        key = next(iter(s.candidate.effect.parameter_info()))
        sizes = np.array([guess[key] - nothing for guess in s.tried])
        size = smallest_size(s, threshold(s.candidate.n_parameters))
        nearest = int(np.argmin(np.abs(np.log(np.maximum(np.abs(sizes), 1e-300) / max(size, 1e-300)))))
        values = {**s.tried[nearest], key: nothing + math.copysign(size, sizes[nearest])}
        if size <= np.abs(sizes).max() and _can_be(s, values, key, model):
            found.append((size / float(np.median(np.abs(sizes))), Part(s.candidate, values)))
    found.sort(key=lambda own: -own[0])
    return tuple(part for _, part in found[:MOST])


def _can_be(screened: Screened, values: Mapping[str, float], key: str, model: Model) -> bool:
    """Whether a value of an effect's size is within its bounds at all of its places."""
    effects = screened.candidate.attached({**values, key: screened.tried[0][key]})
    bounds = [effect.bounds(key, model.robot) for effect in effects]
    return all(low <= values[key] <= high for low, high in bounds)
