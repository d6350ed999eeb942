"""What else could be at the end of a search: others in the parts' places, in fewer places, simpler ones, or none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from equimus_ctrl.diagnosis.candidates import Part
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves, SearchHistory, SearchState
from equimus_ctrl.diagnosis.policy import Thresholds

Kind = tuple[str, tuple[str, ...]]
"""What a part is: its law, or what it shares with those that exclude it, and where."""
CONTESTS, CONTENDERS = 2, 2
"""How often, and how many of each part's best alternatives are fitted beside the other parts."""


def contested(search: HypothesisMoves, found: SearchState) -> SearchState:
    """The closest alternatives of each part, refitted beside the others from their present values; the best of all.

    Without the part the others converged elsewhere. An alternative that is fitted from there may end in another local
    minimum. Where fits have many local minima, more alternatives are tried, see ``in_place``.
    """
    if len(found.best.hypothesis) < 2 or search.settings.many_minima:
        return found
    for _ in range(CONTESTS):
        found = _with_contenders(search, found, found)
        size = len(found.best.hypothesis)
        same_size = [r for own in found.alternatives for r in own if len(r.hypothesis) <= size]
        top = min(same_size, key=search.score, default=found.best)
        if search.score(top) >= search.score(found.best) - 1.0:
            break
        found = search.exchanged(replace(found, best=top))
    return found


def _with_contenders(search: HypothesisMoves, to: SearchState, contested: SearchState) -> SearchState:
    """A search's hypothesis with the closest alternatives of each part, refitted beside its other parts.

    Args:
        search: that found it.
        to: the search, which gets these alternatives beside its own.
        contested: the search whose parts' alternatives are taken.
    """
    tried, alternatives = to.tried, []
    for k, own in enumerate(contested.alternatives):
        more, tried = _beside_others(search, tried, to.best, k, contested.without[k], own)
        alternatives.append((*to.alternatives[k], *more))
    return replace(to, alternatives=tuple(alternatives), tried=tried)


def _beside_others(
    search: HypothesisMoves, tried: SearchHistory, best: Fitted, k: int, without: Fitted, alternatives: Sequence[Fitted]
) -> tuple[list[Fitted], SearchHistory]:
    """The closest alternatives of a part, refitted from the values of a hypothesis' other parts.

    Args:
        search: that found it.
        tried: so far.
        best: the hypothesis.
        k: the part's place.
        without: the hypothesis that the alternatives were added to.
        alternatives: with another in the part's place.
    """
    others = (replacement(alternative, without) for alternative in sorted(alternatives, key=search.score))
    room = best.n_parameters - sum(p.candidate.n_parameters for j, p in enumerate(best.hypothesis) if j != k)
    nearest = [other for other in others if other is not None and other.candidate.n_parameters <= room]
    fits = [(*best.hypothesis[:k], other, *best.hypothesis[k + 1 :]) for other in nearest[:CONTENDERS]]
    return _all_refitted(search, tried, best, fits)


def _all_refitted(
    search: HypothesisMoves, tried: SearchHistory, best: Fitted, hypotheses: Iterable[tuple[Part, ...]]
) -> tuple[list[Fitted], SearchHistory]:
    """Those of some hypotheses that can be fitted from where one is."""
    found: list[Fitted] = []
    for hypothesis in hypotheses:
        more, tried = search.refitted(tried, best, hypothesis)
        found += more
    return found, tried


def in_place(
    search: HypothesisMoves, found: SearchState, k: int, margin: Callable[[Thresholds], float]
) -> tuple[list[Fitted], SearchHistory]:
    """Hypotheses with another in a part's place.

    Where fits have many local minima, alternatives that fitted about as well beside other parts are fitted beside the
    final ones too, from their present values.

    Args:
        search: that ended.
        found: the end.
        k: place of the part.
        margin: largest difference of score that counts as fitting about as well.
    """
    alternatives = list(found.alternatives[k])
    if not search.settings.many_minima:
        return alternatives, found.tried
    parts = found.best.hypothesis
    own, rest = _kind(parts[k]), {_kind(part) for j, part in enumerate(parts) if j != k}
    score = search.score(found.best)

    def within(away: float) -> bool:
        return search.data.thresholds.decides(lambda t: away < margin(t))

    others: dict[Kind, Part] = {}
    for alternative in alternatives:
        left = [part for part in alternative.hypothesis if _kind(part) not in rest]
        if len(left) == 1 and within(search.score(alternative) - score):
            others[_kind(left[0])] = left[0]
    met = [
        known
        for fitted in (found.tried.fitted, search.fits_with_other_engine)
        for known in _beside_the_same(search, fitted).values()
    ]
    for known in met:
        for kind, (fit, part) in known.items():
            if own in known and kind not in rest and within(abs(fit - known[own][0])):
                others.setdefault(kind, part)
    others.pop(own, None)
    allowed = [other for other in others.values() if found.tried.allows([other.candidate.label])]
    hypotheses = [(*parts[:k], *parts[k + 1 :], other) for other in allowed]
    more, tried = _all_refitted(search, found.tried, found.best, hypotheses)
    return [*alternatives, *more], tried


def _beside_the_same(
    search: HypothesisMoves, fits: Sequence[Fitted]
) -> dict[tuple[Kind, ...], dict[Kind, tuple[float, Part]]]:
    """For kinds of parts that were fitted together what else was fitted beside them, its best score and itself."""
    found: dict[tuple[Kind, ...], dict[Kind, tuple[float, Part]]] = {}
    for fitted in sorted(fits, key=search.score):
        kinds = [_kind(part) for part in fitted.hypothesis]
        for place, part in enumerate(fitted.hypothesis):
            rest = tuple(sorted(kinds[:place] + kinds[place + 1 :]))
            found.setdefault(rest, {}).setdefault(kinds[place], (search.score(fitted), part))
    return found


def listed(search: HypothesisMoves, found: SearchState) -> SearchState:
    """The end, with alternatives of those parts that have none after others were rejected.

    Where fits have many local minima they are found among all hypotheses fitted, see ``in_place``.
    """
    if search.settings.many_minima:
        return found
    tried, alternatives = found.tried, list(found.alternatives)
    for k, (part, without) in enumerate(zip(found.best.hypothesis, found.without, strict=True)):
        if not alternatives[k]:
            own, tried = search.challenge(tried, without, part.candidate.label)
            alternatives[k] = tuple(own)
    return replace(found, alternatives=tuple(alternatives), tried=tried)


def narrowed(search: HypothesisMoves, found: SearchState) -> SearchState:
    """The effect at the fewest places that is not distinguishable; the one at more places becomes an alternative.

    Not where fits have many local minima: deviances scatter by more than that.
    """
    if search.settings.many_minima:
        return found
    score = search.score(found.best)
    while True:
        found, moved = _in_fewer_places(search, found, score)
        if not moved:
            return found


def _in_fewer_places(search: HypothesisMoves, found: SearchState, score: float) -> tuple[SearchState, bool]:
    """A search with one of its effects in one place less, if one fits as well, and whether one does."""
    hypothesis = found.best.hypothesis
    for k, part in enumerate(hypothesis):
        kind, sites = part.candidate.effect, part.candidate.locations
        smaller = [
            own
            for own in search.allowed_candidates(found.tried)
            if own.effect is kind and len(own.locations) == len(sites) - 1 and set(own.locations) < set(sites)
        ]
        fits = [(*hypothesis[:k], Part(own, part.values), *hypothesis[k + 1 :]) for own in smaller]
        fewer, tried = _all_refitted(search, found.tried, found.best, fits)
        found = replace(found, tried=tried)
        least = min(fewer, key=search.score, default=None)
        if least is None or not indistinguishable(search, least, score) or not search.accepts(found.without[k], least):
            continue
        moved = _with_contenders(search, search.moved(found, least), found)
        alternatives = [*moved.alternatives[:k], (found.best, *found.alternatives[k]), *moved.alternatives[k + 1 :]]
        return replace(moved, alternatives=tuple(alternatives)), True
    return found, False


def indistinguishable(search: HypothesisMoves, fitted: Fitted, score: float) -> bool:
    """Whether a hypothesis is not distinguishable from one with a score, or better."""
    more = search.score(fitted) - score
    return search.data.thresholds.decides(lambda t: more < t.indistinguishable)


def simplified(search: HypothesisMoves, found: SearchState) -> SearchState:
    """The simplest of effects that exclude each other at a place, unless a richer one is needed.

    Such as Coulomb friction in the place of Stribeck friction. Where the cost has many kinks, searches rank such pairs
    at random.
    """
    hypothesis = found.best.hypothesis
    for k, part in enumerate(hypothesis):
        own = part.candidate
        for other in search.allowed_candidates(found.tried):
            same = other.effect.exclusive == own.effect.exclusive is not None and other.locations == own.locations
            if not same or other.n_parameters >= own.n_parameters:
                continue
            begins = [dict(guess) for guess in other.guesses]
            shared = {key: part.values[key] for key in begins[0] if key in part.values}
            values = {**begins[len(begins) // 2], **shared}
            fit = (*hypothesis[:k], Part(other, values), *hypothesis[k + 1 :])
            simple, tried = search.refit(found.tried, found.best, fit)
            found = replace(found, tried=tried)
            if not search.accepts(simple, found.best):
                return simplified(search, search.moved(found, simple))
    return found


def without_parts(search: HypothesisMoves, found: SearchState, places: Sequence[int]) -> SearchState:
    """The search's end without some parts, and without those that are accepted no more then."""
    while places:
        kept = tuple(p for k, p in enumerate(found.best.hypothesis) if k not in places)
        fit, tried = search.refit(found.tried, found.best, kept) if kept else (found.base, found.tried)
        found = search.moved(replace(found, tried=tried), fit)
        pairs = enumerate(found.without)
        places = [k for k, without in pairs if not search.accepts(without, found.best)][:1]
    return found


def replacement(alternative: Fitted, without: Fitted) -> Part | None:
    """The one part that a hypothesis has beside those of another; None where that is not one."""
    rest = without.labels
    more = [part for part in alternative.hypothesis if part.candidate.label not in rest]
    return more[0] if len(more) == 1 else None


def _kind(part: Part) -> Kind:
    effect = part.candidate.effect
    return effect.exclusive or effect.name, part.candidate.locations
