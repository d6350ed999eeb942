"""Which explanations a diagnosis leaves beside the one that it gives, for experiments to decide between."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.results import Equivalent, Finding
from equimus_ctrl.diagnosis.richer_laws import as_its_own, holds
from equimus_ctrl.diagnosis.screening import Screened, screen_strengths
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.smallest_sizes import FAR, is_near, near_threshold, resized
from equimus_ctrl.models.model import Model

MOST = 8
"""So many are kept: each holds residuals of all trials."""
GUESSES = 500
"""Simulated at most, for what candidates change beside what was found."""
MOST_LOOKED_AT = 16
"""So many effects that may hide beside it: some of them the recordings exclude."""
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


def strengths_beside(search: Search, end: SearchState, known: bool) -> Sequence[Screened]:
    """What candidates change beside a search's end, whatever else is free moved along.

    Of a robot with so many that their guesses are more than ``GUESSES``, only those that the search simulated: a torque
    domain rules out the others.

    Args:
        search: that ended there.
        end: of the search.
        known: whether only what the search has simulated already is wanted.
    """
    if known:
        return () if end.best.hypothesis else end.tried.first
    few = sum(len(candidate.guesses) for candidate in search.pool) <= GUESSES
    pool = search.pool if few else [s.candidate for s in end.tried.first]

    def strengths(some: Sequence[Candidate]) -> list[Screened]:
        found = screen_strengths(search.data, end.best, some)
        return [s for s in found if len(s.hypothesis) > len(end.best.hypothesis)]  # those that take no part's place

    return near_threshold(strengths(pool), search.threshold, strengths)


def hidden(search: Search, end: SearchState, strengths: Sequence[Screened]) -> tuple[Hypothesis, ...]:
    """What may hide beside the end: effects more, and richer laws in its parts' places, of sizes that are given.

    Effects stand at the size at which they alone would change predictions by half of what is not distinguished, see
    ``just_below``. Richer laws stand at each size that they have, the strongest first: by how much they fit worse is
    seen by fitting them, see ``rivals``.

    Args:
        search: that ended there.
        end: of the search.
        strengths: of effects more, see ``strengths_beside``.
    """
    best, level = end.best, search.equally_good(search.data.thresholds) / 2
    parts = just_below(search.data.free.model, strengths, level)
    return (*with_richer_laws(search, best), *((*best.hypothesis, part) for part in parts[:MOST_LOOKED_AT]))


def with_richer_laws(search: Search, best: Fitted) -> Iterator[Hypothesis]:
    """Richer laws in the place of a hypothesis' parts, with what the simpler law lacks given at each of its guesses."""
    for k, part in enumerate(best.hypothesis):
        rest = (*best.hypothesis[:k], *best.hypothesis[k + 1 :])
        for candidate in search.pool:
            if not holds(candidate, part.candidate):
                continue
            own = as_its_own(candidate, part.candidate)
            if own == {p.key for p in candidate.parameters}:  # it lacks nothing that could be given
                continue
            begun = candidate.effect.begun_at(part.values, candidate.guesses)
            for values in {
                tuple(v for key, v in one.items() if key not in own): one for one in reversed(begun)
            }.values():
                given = {**candidate.given, **{key: value for key, value in values.items() if key not in own}}
                law = replace(candidate, guesses=(), given=given)
                yield (*rest, Part(law, {p.name: values[p.name] for p in law.parameters}))


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
        if not is_near(s, level, FAR):
            continue
        values = resized(s, level)
        size, guessed = abs(values[key] - nothing), np.abs([guess[key] - nothing for guess in s.candidate.guesses])
        if size <= guessed.max() and _can_be(s, values, key, model):
            given = replace(s.candidate, guesses=(), given={**s.candidate.given, **values})
            found.append((size / float(np.median(guessed)), Part(given, {})))
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
