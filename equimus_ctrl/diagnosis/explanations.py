"""Which explanations a diagnosis leaves beside the one that it gives, for experiments to decide between."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.findings import smallest_size
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.results import Equivalent, Finding
from equimus_ctrl.diagnosis.richer_laws import holds
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.models.model import Model

MOST = 8
"""So many are kept: each holds residuals of all trials."""
MOST_HIDDEN = 4
"""So many effects that may hide beside it."""
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


def hidden(search: Search, end: SearchState) -> tuple[Hypothesis, ...]:
    """What may hide beside the end: effects more, and richer laws in its parts' places, of sizes that are given.

    Effects stand at the size at which they alone would change predictions by half of what is not distinguished, see
    ``just_below``. Richer laws stand at each size that they have, the strongest first: by how much they fit worse is
    seen by fitting them, see ``rivals``.

    Args:
        search: that ended there.
        end: of the search.
    """
    t, best = search.data.thresholds, end.best
    known = end.tried.screened.get(best.labels, ())
    beside = [s for s in known if len(s.hypothesis) > len(best.hypothesis)]  # those that take no part's place
    parts = just_below(search.data.free.model, beside, search.equally_good(t) / 2)
    return (*_richer(search, best), *((*best.hypothesis, part) for part in parts[:MOST_HIDDEN]))


def _richer(search: Search, best: Fitted) -> Iterator[Hypothesis]:
    """Richer laws in the place of a hypothesis' parts, with what the simpler law lacks given at each of its guesses."""
    for k, part in enumerate(best.hypothesis):
        rest = (*best.hypothesis[:k], *best.hypothesis[k + 1 :])
        for candidate in search.pool:
            if not holds(candidate, part.candidate):
                continue
            alike = candidate.effect.special_cases
            own = {name: value for key, value in part.values.items() for name in alike.get(key, (key,))}
            lacking = [p.key for p in candidate.parameters if p.key not in own]
            given = [{key: guess[key] for key in lacking} for guess in reversed(candidate.guesses)]
            for sizes in {tuple(sizes.values()): sizes for sizes in given if sizes}.values():
                yield (*rest, Part(replace(candidate, guesses=(), given={**candidate.given, **sizes}), own))


def just_below(model: Model, screened: Sequence[Screened], level: float) -> tuple[Part, ...]:
    """Effects of given size that change predictions by a level of χ²: those first of which the recordings say least.

    That is by how many times the median of its guesses, which are sizes that it has, an effect has to be as large. One
    that would have to be larger than all of them is not looked at, nor one without a size; and at each place the same
    effect once, alone or with others.

    Args:
        model: at whose places the effects are.
        screened: each candidate alone.
        level: of χ², beyond what the free parameters can do.
    """
    found: list[tuple[float, Part]] = []
    for s in screened:
        nothing = s.candidate.effect.grows_from()
        if s.candidate.each or s.candidate.absent or nothing is None:
            continue
        key = next(iter(s.candidate.effect.parameter_info()))
        sizes = np.array([guess[key] - nothing for guess in s.tried])
        size = smallest_size(s, level)
        nearest = int(np.argmin(np.abs(np.log(np.maximum(np.abs(sizes), 1e-300) / max(size, 1e-300)))))
        values = {**s.tried[nearest], key: nothing + math.copysign(size, sizes[nearest])}
        if size <= np.abs(sizes).max() and _can_be(s, values, key, model):
            given = replace(s.candidate, guesses=(), given={**s.candidate.given, **values})
            found.append((size / float(np.median(np.abs(sizes))), Part(given, {})))
    found.sort(key=lambda own: -own[0])
    kept, there = list[Part](), set[tuple[str, str]]()
    for _, part in found:
        own = {(part.candidate.effect.name, place) for place in part.candidate.locations}
        if not own & there:
            kept.append(part)
            there |= own
    return tuple(kept)


def _can_be(screened: Screened, values: Mapping[str, float], key: str, model: Model) -> bool:
    """Whether a value of an effect's size is within its bounds at all of its places."""
    effects = screened.candidate.attached({**values, key: screened.tried[0][key]})
    bounds = [effect.bounds(key, model.robot) for effect in effects]
    return all(low <= values[key] <= high for low, high in bounds)
