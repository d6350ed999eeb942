"""Explanations that are known from an earlier diagnosis, and a search that begins at them.

A search proposes what gains most to first order beside what it has; a law that holds a joint still gains little so, and
is never fitted. Where recordings so far left an explanation, a search in these and further ones may not miss it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.estimates import Named
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, model_of
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState, begun_at
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class Known:
    """An explanation and where its fit ended.

    Attributes:
        effects: each with the values of its parameters at each of its places.
        parameters: of the model without them that were free, by dotted name, in the unit of each.
        model: with both.
        possible: whether it was one by itself; else it may have hidden beside what was found, or came near to what had
            no name.
    """

    effects: tuple[tuple[Named, Mapping[str, Mapping[str, float]]], ...]
    parameters: Mapping[str, float]
    model: Model
    possible: bool = True


def with_known(search: Search, end: SearchState, known: Sequence[Known]) -> Iterator[SearchState]:
    """The steps of a search that goes on where one ended, or at what is known where that fits better.

    What is known is fitted to what the search has, as it is and with its effects in the places of the end's parts. What
    the search came to is kept unless the other one's end is better; all fits are there to be listed beside it.

    Args:
        search: that ended.
        end: of it.
        known: explanations from before.

    Raises:
        BudgetSpent: where the budget ends.
    """
    fits = _fitted(search, end, known)
    swapped, tried = _swapped(search, end, known)
    end = replace(end, tried=tried.having(*fits))
    yield end
    best = min((*fits, *swapped), key=search.score, default=end.best)
    if not search.score(best) < search.score(end.best):
        return
    if not best.hypothesis:
        yield replace(begun_at(best), tried=end.tried, stopped=end.stopped)
        return
    if not search.accepts(end.base, best):
        return
    try:
        begun = _beginning(search, end, best)
        for after in search.steps(begun):
            begun = after
    except SimulationDiverged:  # so it cannot be what happened
        return
    if search.score(begun.best) < search.score(end.best):
        yield begun


def _swapped(search: Search, end: SearchState, known: Sequence[Known]) -> tuple[list[Fitted], SearchHistory]:
    """The end with effects of what was possible before in the places of its parts, one at a time.

    Where fits have many local minima, that is seen from all that was fitted, see ``alternatives.in_place``.
    """
    tried, found, parts = end.tried, list[Fitted](), end.best.hypothesis
    if search.settings.many_minima:
        return found, tried
    others = {
        part.candidate.label: part
        for one in known
        if one.possible
        for part in hypothesis_of(one, search.pool) or ()
        if part.candidate.label not in end.best.labels and tried.allows([part.candidate])
    }
    for k in range(len(parts)):
        for other in others.values():
            more, tried = search.refitted(tried, end.best, (*parts[:k], *parts[k + 1 :], other))
            found += more
    return found, tried


def _beginning(search: Search, end: SearchState, start: Fitted) -> SearchState:
    """A hypothesis without what it does not need, beside all that was tried before."""
    begun = search.beginning(end.base, start)
    fitted = tuple(dict.fromkeys((*end.tried.fitted, *begun.tried.fitted)))
    rejected = end.tried.rejected | begun.tried.rejected
    return replace(begun, tried=replace(begun.tried, fitted=fitted, rejected=rejected))


def _fitted(search: Search, end: SearchState, known: Sequence[Known]) -> list[Fitted]:
    """What is known fitted in a few steps, and the best of it until converged."""
    data, found = search.data, list[Fitted]()
    noise, steps = white_noise(end.best.fit.residuals), search.settings.long_steps
    for one in known:
        hypothesis = hypothesis_of(one, search.pool)
        if hypothesis is None or len(hypothesis) > search.settings.most_parts:
            continue
        if not end.tried.allows(part.candidate for part in hypothesis):
            continue
        begins = [
            (data.theta_of(theta, hypothesis), [s.start for s in data.segments])
            for theta in (_theta(data, one), end.base.fit.theta)
        ]
        try:
            model_of(data.free.model, hypothesis)
            found.append(data.coarse_fit(hypothesis, begins, noise, steps))
        except (ConfigError, SimulationDiverged):  # so it cannot be what happened
            continue
    best = min(found, key=search.score, default=None)
    if best is None:
        return found
    try:
        return [data.converge(best), *(own for own in found if own is not best)]
    except SimulationDiverged:
        return [own for own in found if own is not best]


def _theta(data: Data, known: Known) -> Array:
    """(p,) where the parameters without effects were, as far as they were free."""
    free = data.free
    values = [known.parameters.get(own.name, start) for own, start in zip(free.free, free.start, strict=True)]
    inside: Array = np.clip(np.array(values), free.low, free.high)
    return inside


def hypothesis_of(known: Known, pool: Sequence[Candidate]) -> Hypothesis | None:
    """What is known by the candidates of a pool; None where one of its effects is not among them.

    A law with its own parameters at each of several places is its parts where the pool does not have it.
    """
    parts: list[Part] = []
    for named, values in known.effects:
        own = _part(pool, named, values)
        several = [own] if own else [_part(pool, Named(named.effect, (at,)), values) for at in named.locations]
        if not (own or named.each) or None in several:
            return None
        parts += [part for part in several if part is not None]
    return tuple(parts)


def _part(pool: Sequence[Candidate], named: Named, values: Mapping[str, Mapping[str, float]]) -> Part | None:
    for candidate in pool:
        if (candidate.effect.name, candidate.locations, candidate.each) == (named.effect, named.locations, named.each):
            common = {own.name: values[own.places[0]][own.key] for own in candidate.common}
            return Part(candidate, candidate.in_each_group(common))
    return None
