"""What else could be at the end of a search: others in the parts' places, in fewer places, simpler ones, or none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.parameters import in_group

Kind = tuple[str, tuple[str, ...]]
"""What a part is: its law, or what it shares with those that exclude it, and where."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A part in a hypothesis that was fitted.

    Attributes:
        score: of the hypothesis.
        part: with its values there.
    """

    score: float
    part: Part


def contested(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The closest alternatives of each part, refitted beside the others from their present values; the best of all.

    Without the part the others converged elsewhere. An alternative that is fitted from there may end in another local
    minimum. Where fits have many local minima, more alternatives are tried, see ``in_place``.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis without one of its parts diverges.
    """
    if len(state.best.hypothesis) < 2 or search.settings.many_minima:
        return state
    for _ in range(search.settings.contests):
        state = _with_contenders(search, state, state)
        size = len(state.best.hypothesis)
        no_larger = [a for fits in state.alternatives for a in fits if len(a.hypothesis) <= size]
        top = min(no_larger, key=search.score, default=state.best)
        if not search.outdoes(top, state.best):
            break
        state = search.exchanged(replace(state, best=top))
    return state


def _with_contenders(search: HypothesisMoves, to: SearchState, contested: SearchState) -> SearchState:
    """A search's hypothesis with the closest alternatives of each part, refitted beside its other parts.

    They are those close enough to be fitted until converged, see ``SearchSettings.kept_share``.

    Args:
        search: that found it.
        to: the search, which gets these alternatives beside its own.
        contested: the search whose parts' alternatives are taken.
    """
    tried, alternatives = to.tried, []
    for k, fits in enumerate(contested.alternatives):
        gain = contested.without[k].deviance - contested.best.deviance
        most = contested.best.deviance + search.settings.kept_share * gain + search.settings.kept_gain
        close = sorted((a for a in fits if a.deviance <= most), key=search.score)
        closest = [replacement(a, contested.without[k]) for a in close]
        more, tried = _beside_others(search, replace(to, tried=tried), k, closest)
        alternatives.append((*to.alternatives[k], *more))
    return replace(to, alternatives=tuple(alternatives), tried=tried)


def _beside_others(
    search: HypothesisMoves, state: SearchState, k: int, closest: Sequence[Part | None]
) -> tuple[list[Fitted], SearchHistory]:
    """Alternatives of the k-th part, refitted from the values of a hypothesis' other parts.

    Args:
        search: that found the hypothesis.
        state: with the hypothesis.
        k: the part's place.
        closest: what could be there, the best first; those with more parameters than the hypothesis has are not taken.
    """
    best = state.best
    room = best.n_parameters - sum(p.candidate.n_parameters for j, p in enumerate(best.hypothesis) if j != k)
    parts = [part for part in closest if part is not None and part.candidate.n_parameters <= room]
    contenders = parts[: search.settings.contenders]
    hypotheses = [(*best.hypothesis[:k], part, *best.hypothesis[k + 1 :]) for part in contenders]
    return _all_refitted(search, state.tried, best, hypotheses)


def _all_refitted(
    search: HypothesisMoves, tried: SearchHistory, best: Fitted, hypotheses: Iterable[Hypothesis]
) -> tuple[list[Fitted], SearchHistory]:
    """Those of some hypotheses that can be fitted from where one is."""
    fits: list[Fitted] = []
    for hypothesis in hypotheses:
        more, tried = search.refitted(tried, best, hypothesis)
        fits += more
    return fits, tried


def in_place(
    search: HypothesisMoves, state: SearchState, k: int, margin: Callable[[Thresholds], float]
) -> tuple[list[Fitted], SearchHistory]:
    """Hypotheses with another part in the k-th one's place: ``state.alternatives[k]``.

    Where fits have many local minima, these are completed: a part that fitted about as well as the k-th one, beside
    whatever other parts, is fitted beside the final other parts too, from their present values.

    Args:
        search: that ended.
        state: the end.
        k: place of the part.
        margin: largest difference of score that counts as fitting about as well.

    Raises:
        BudgetSpent: where the budget ends.
    """
    alternatives = list(state.alternatives[k])
    if not search.settings.many_minima:
        return alternatives, state.tried
    parts = state.best.hypothesis
    others = _about_as_good(search, state, k, margin)
    allowed = [other for other in others if state.tried.allows([other.candidate])]
    hypotheses = [(*parts[:k], *parts[k + 1 :], other) for other in allowed]
    more, tried = _all_refitted(search, state.tried, state.best, hypotheses)
    return [*alternatives, *more], tried


def _about_as_good(
    search: HypothesisMoves, state: SearchState, k: int, margin: Callable[[Thresholds], float]
) -> list[Part]:
    """Parts B that fitted about as well as the k-th part A, one of each kind.

    B is in an alternative's place of A with a score within the margin of the final one; or A and B were both fitted
    beside the same kinds of other parts, with scores within the margin of each other. B is of no kind that the final
    hypothesis has.
    """
    parts = state.best.hypothesis
    replaced, others = _kind(parts[k]), {_kind(part) for j, part in enumerate(parts) if j != k}
    score = search.score(state.best)

    def within(difference: float) -> bool:
        return search.data.thresholds.decides(lambda t: difference < margin(t))

    good: dict[Kind, Part] = {}
    for alternative in state.alternatives[k]:
        new = [part for part in alternative.hypothesis if _kind(part) not in others]
        if len(new) == 1 and within(search.score(alternative) - score):
            good[_kind(new[0])] = new[0]
    for fits in ((*state.tried.fitted, *state.tried.imitations), search.fits_with_other_engine):
        for beside_same in _best_beside_same(search, fits).values():
            for kind, fit in beside_same.items():
                if (
                    replaced in beside_same
                    and kind not in others
                    and within(abs(fit.score - beside_same[replaced].score))
                ):
                    good.setdefault(kind, fit.part)
    good.pop(replaced, None)
    return list(good.values())


def _best_beside_same(search: HypothesisMoves, fits: Sequence[Fitted]) -> dict[tuple[Kind, ...], dict[Kind, _Fit]]:
    """For the kinds of other parts C that hypotheses have, for each kind of one part B beside them its best fit."""
    best: dict[tuple[Kind, ...], dict[Kind, _Fit]] = {}
    for fitted in sorted(fits, key=search.score):
        kinds = [_kind(part) for part in fitted.hypothesis]
        for place, part in enumerate(fitted.hypothesis):
            rest = tuple(sorted(kinds[:place] + kinds[place + 1 :]))
            best.setdefault(rest, {}).setdefault(kinds[place], _Fit(search.score(fitted), part))
    return best


def listed(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end, with alternatives of those parts that have none after others were rejected.

    None is listed that fits far worse than the end, so what stays far behind it is not fitted whole. Where fits have
    many local minima they are found among all hypotheses fitted, see ``in_place``.

    Raises:
        BudgetSpent: where the budget ends.
    """
    if search.settings.many_minima:
        return state
    tried, alternatives = state.tried, list(state.alternatives)
    for k, (part, without) in enumerate(zip(state.best.hypothesis, state.without, strict=True)):
        if not alternatives[k]:
            others, tried = search.challenge(tried, without, part.candidate.label, state.best)
            alternatives[k] = tuple(others)
    return replace(state, alternatives=tuple(alternatives), tried=tried)


def with_all_fitted(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end, with alternatives of its parts that some other step of the search has fitted, a wider law of one say.

    Of each the best fit.
    """
    alternatives = []
    for part, without, known in zip(state.best.hypothesis, state.without, state.alternatives, strict=True):
        there = {part.candidate.label, *(other.candidate.label for a in known if (other := replacement(a, without)))}
        more: dict[str, Fitted] = {}
        for fitted in sorted(state.tried.fitted, key=search.score):
            other = replacement(fitted, without)
            same_beside = len(fitted.hypothesis) == len(state.best.hypothesis) and without.labels < fitted.labels
            if other and same_beside and other.candidate.label not in there and state.tried.allows([other.candidate]):
                more.setdefault(other.candidate.label, fitted)
        alternatives.append((*known, *more.values()))
    return replace(state, alternatives=tuple(alternatives))


def narrowed(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The effect at the fewest places that is not distinguishable; the one at more places becomes an alternative.

    Not where fits have many local minima: deviances scatter by more than that.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis without one of its parts diverges.
    """
    if search.settings.many_minima:
        return state
    score = search.score(state.best)
    while True:
        state, moved = _in_fewer_places(search, state, score)
        if not moved:
            return state


def exchanged_beside_fewer(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end, or a better one that is reached through an effect at one place less.

    Beside what some effect has at a place too many, others may be no use: a lag of both valves takes part of what a
    delay of both sensors would explain. So where an effect loses next to nothing in fewer places, see
    ``Thresholds.fewer_places_share``, parts are exchanged from there. Not where fits have many local minima.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis without one of its parts diverges.
    """
    while not search.settings.many_minima:
        before = state.best
        for k, part in enumerate(state.best.hypothesis):
            fewer, tried = _all_refitted(search, state.tried, state.best, _hypotheses_in_fewer(search, state, k))
            state = replace(state, tried=tried)
            top = min(fewer, key=search.score, default=None)
            gain = state.without[k].deviance - state.best.deviance
            if top is None or not _nearly(search, top.deviance - state.best.deviance, gain):
                continue
            search.notify(f"with {part.candidate.label} at fewer places", state.best.label)
            better, tried = _best_beside(search, tried, top, k)
            state = replace(state, tried=tried)
            if better is not None and search.outdoes(better, before):
                state = search.exchanged(replace(state, best=better, without=(), alternatives=()))
                break
        else:
            return state
    return state


def _best_beside(
    search: HypothesisMoves, tried: SearchHistory, fitted: Fitted, k: int
) -> tuple[Fitted | None, SearchHistory]:
    """The best hypothesis with another part in the place of one of a hypothesis', but not of the k-th."""
    found: list[Fitted] = []
    parts = fitted.hypothesis
    for j, part in enumerate(parts):
        if j == k:
            continue
        rest, tried = search.refit(tried, fitted, (*parts[:j], *parts[j + 1 :]))
        others, tried = search.challenge(tried, rest, part.candidate.label, fitted)
        found += [o for o in others if len(o.hypothesis) <= len(parts) and not search.aliased(o)]
    return min(found, key=search.score, default=None), tried


def _nearly(search: HypothesisMoves, lost: float, gain: float) -> bool:
    return search.data.thresholds.decides(lambda t: lost < t.fewer_places_share * gain)


def _hypotheses_in_fewer(search: HypothesisMoves, state: SearchState, k: int) -> list[Hypothesis]:
    """A hypothesis with its k-th part at one place less."""
    hypothesis = state.best.hypothesis
    part = hypothesis[k]
    if part.candidate.each or part.candidate.own or part.candidate.absent:
        return []
    return [
        (*hypothesis[:k], Part(smaller, part.values), *hypothesis[k + 1 :])
        for smaller in search.allowed_candidates(state.tried)
        if smaller.effect is part.candidate.effect
        and not smaller.each
        and not smaller.absent
        and len(smaller.locations) == len(part.candidate.locations) - 1
        and set(smaller.locations) < set(part.candidate.locations)
    ]


def _in_fewer_places(search: HypothesisMoves, state: SearchState, score: float) -> tuple[SearchState, bool]:
    """A search with one of its effects in one place less, if one fits as well, and whether one does."""
    for k in range(len(state.best.hypothesis)):
        fits = _hypotheses_in_fewer(search, state, k)
        fewer, tried = _all_refitted(search, state.tried, state.best, fits)
        state = replace(state, tried=tried)
        top = min(fewer, key=search.score, default=None)
        if top is None or not indistinguishable(search, top, score) or not search.accepts(state.without[k], top):
            continue
        moved = _with_contenders(search, search.moved(state, top), state)
        alternatives = [*moved.alternatives[:k], (state.best, *state.alternatives[k]), *moved.alternatives[k + 1 :]]
        return replace(moved, alternatives=tuple(alternatives)), True
    return state, False


def indistinguishable(search: HypothesisMoves, fitted: Fitted, score: float) -> bool:
    """Whether a hypothesis fits as well as one with a score, or better: its score, a BIC, is higher by less than δ.

    δ is ``Thresholds.indistinguishable``. It is asked where a hypothesis is to take another's place. What is listed as
    not distinguishable may differ by more, see ``Scoring.equally_good``.
    """
    more = search.score(fitted) - score
    return search.data.thresholds.decides(lambda t: more < t.indistinguishable)


def simplified(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The simplest of effects that exclude each other at some places, unless a richer one is needed.

    Such as Coulomb friction in the place of Stribeck friction, or one size for all joints in the place of one each.
    Where the cost has many kinks, searches rank such pairs at random.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a simpler hypothesis diverges.
    """
    hypothesis = state.best.hypothesis
    for k, part in enumerate(hypothesis):
        for simpler in simpler_laws(search, state, part):
            fit = (*hypothesis[:k], simpler, *hypothesis[k + 1 :])
            simple, tried = search.refit(state.tried, state.best, fit)
            state = replace(state, tried=tried)
            if not search.accepts(simple, state.best):
                return simplified(search, search.moved(state, simple))
    return state


def simpler_laws(search: HypothesisMoves, state: SearchState, part: Part) -> list[Part]:
    """Laws of fewer parameters at a part's places that it excludes or tends to, with its values of what both have.

    Args:
        search: whose candidates they are.
        state: with the part; what is another of its parts takes no place.
        part: see above.
    """
    rich, found = part.candidate, list[Part]()
    present = state.best.labels
    for candidate in search.allowed_candidates(state.tried):
        if candidate.absent:  # the others stand for these, see ``_in_groups_of``
            continue
        excluded = candidate.effect.exclusive == rich.effect.exclusive is not None
        reached = candidate.effect.name in rich.effect.tends_to and candidate.label not in present
        other = _in_groups_of(rich, candidate)
        same = (excluded or reached) and candidate.locations == rich.locations
        if same and other.n_parameters < rich.n_parameters:
            common = {**other.guesses[len(other.guesses) // 2], **_shared_values(part, candidate)}
            own = {in_group(name, group): common[name] for name, group in other.own}
            found.append(Part(other, {**common, **own, **_shared_values(part, other)}))
    return found


def _in_groups_of(rich: Candidate, simple: Candidate) -> Candidate:
    """A candidate with sizes of its own in those groups of trials in which another has values of its own."""
    groups = dict.fromkeys(group for _, group in rich.own)
    if not groups and not rich.absent:
        return simple
    return replace(simple, own=tuple((name, group) for name in simple.sizes for group in groups), absent=rich.absent)


def pruned(search: HypothesisMoves, state: SearchState) -> SearchState:
    """Laws with their own parameters at each place, at those places alone that need them.

    A place is needed where its parameters differ from those of no effect by more than the acceptance threshold, by
    Wald's statistic δᵀC⁻¹δ, which the gain −2Δln L without them is to second order. What is left has to fit as well.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a smaller hypothesis diverges.
    """
    for k, part in enumerate(state.best.hypothesis):
        needed = _needed_places(search, state.best, k)
        if not needed or len(needed) == len(part.candidate.locations):
            continue
        hypothesis = state.best.hypothesis
        fewer = (*hypothesis[:k], part.narrowed(needed), *hypothesis[k + 1 :])
        simple, tried = search.refit(state.tried, state.best, fewer)
        state = replace(state, tried=tried)
        if not search.accepts(simple, state.best):
            return pruned(search, search.moved(state, simple))
    return state


def _needed_places(search: HypothesisMoves, fitted: Fitted, k: int) -> tuple[str, ...]:
    """Of the k-th part those places whose own parameters are needed; all where a part has the same at each."""
    part = fitted.hypothesis[k]
    end = part.candidate.fades_to()
    if not part.candidate.each or not end:
        return part.candidate.locations
    first = fitted.fit.parameters.free[: len(search.data.free.free)]
    start = len(first) + sum(p.candidate.n_parameters for p in fitted.hypothesis[:k])
    needed = []
    for place in part.candidate.locations:
        own = [i for i, p in enumerate(part.candidate.parameters) if p.places == (place,) and p.name in end]
        rows = [start + i for i in own]
        away = np.array([part.values[part.candidate.parameters[i].name] for i in own])
        away -= np.array([end[part.candidate.parameters[i].name] for i in own])
        statistic = fitted.fit.uncertainty.statistic(rows, away)
        if not statistic > 0:
            continue
        count = len(part.candidate.effect.parameter_info())
        if search.data.thresholds.decides(partial(_exceeds, search, statistic, count)):
            needed.append(place)
    return tuple(needed)


def _exceeds(search: HypothesisMoves, statistic: float, count: int, thresholds: Thresholds) -> bool:
    return statistic > search.threshold(count, thresholds)


def _shared_values(part: Part, other: Candidate) -> dict[str, float]:
    """Values of a part for another candidate at its places, of parameters that both have; means where it has one."""
    rich, shared = part.candidate.effect, dict[str, float]()
    taken = rich.tends_to.get(other.effect.name, {})
    for own in other.parameters:
        alike = (taken[own.key],) if own.key in taken else rich.special_cases.get(own.key, (own.key,))
        values = [
            part.values[p.name]
            for p in part.candidate.parameters
            if p.key in alike and p.group == own.group and set(p.places) & set(own.places)
        ]
        if values:
            shared[own.name] = float(np.mean(values))
    return shared


def without_parts(
    search: HypothesisMoves,
    state: SearchState,
    places: Sequence[int],
    fewer: Mapping[int, tuple[str, ...]] | None = None,
) -> SearchState:
    """The search's end without some parts, and without those that are accepted no more then.

    Args:
        search: that ended.
        state: the end.
        places: of the parts.
        fewer: of those the ones that stay at some of their locations, with these.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where what is left diverges.
    """
    stay = dict(fewer or {})
    while places:
        hypothesis = enumerate(state.best.hypothesis)
        kept = tuple(p.narrowed(stay[k]) if k in stay else p for k, p in hypothesis if k in stay or k not in places)
        stay = {}
        fit, tried = search.refit(state.tried, state.best, kept) if kept else (state.base, state.tried)
        state = search.moved(replace(state, tried=tried), fit)
        pairs = enumerate(state.without)
        places = [k for k, without in pairs if not search.accepts(without, state.best)][:1]
    return state


def replacement(alternative: Fitted, without: Fitted) -> Part | None:
    """The one part that a hypothesis has beside those of another; None where that is not one."""
    more = [part for part in alternative.hypothesis if part.candidate.label not in without.labels]
    return more[0] if len(more) == 1 else None


def _kind(part: Part) -> Kind:
    effect = part.candidate.effect
    return effect.exclusive or effect.name, part.candidate.locations
