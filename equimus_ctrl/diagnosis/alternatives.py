"""What else could be at the end of a search: others in the parts' places, in fewer places, simpler ones, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from equimus_ctrl.diagnosis.candidates import Part
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis_moves import Ended, Moves, Searched

Kind = tuple[str, tuple[str, ...]]
"""What a part is: its law, or what it shares with those that exclude it, and where."""
ALIKE = 10.0
"""Hypotheses with as many numbers whose deviances differ by less than this cannot be told apart (odds of 150 to 1)."""
CONTESTS, CONTENDERS = 2, 2
"""How often the best so many of each part's rivals are fitted beside the other parts."""


def contested(
    search: Moves, best: Fitted, without: tuple[Fitted, ...], rivals: tuple[tuple[Fitted, ...], ...]
) -> Ended:
    """The nearest rivals of each of several parts fitted beside the others where these are now; the best of all.

    Without the part the others went elsewhere, and a rival that is fitted beside them from there may end in a
    local minimum of its own. Where fits have many, rivals are looked at more widely, see ``in_place``.
    """
    if len(best.hypothesis) < 2 or search.settings.many_minima:
        return best, without, rivals
    for _ in range(CONTESTS):
        rivals = tuple((*own, *_beside_others(search, best, k, without[k], own)) for k, own in enumerate(rivals))
        same_size = [r for own in rivals for r in own if len(r.hypothesis) <= len(best.hypothesis)]
        top = min(same_size, key=search.score, default=best)
        if search.score(top) >= search.score(best) - 1.0:
            break
        best, without, rivals = search.exchanged(top)
    return best, without, rivals


def _beside_others(search: Moves, best: Fitted, k: int, without: Fitted, rivals: Sequence[Fitted]) -> list[Fitted]:
    """The nearest rivals of a part, refitted from where a hypothesis' other parts are.

    Args:
        search: that found it.
        best: the hypothesis.
        k: the part's place.
        without: what the rivals were added to.
        rivals: with another in the part's place.
    """
    others = (instead(rival, without) for rival in sorted(rivals, key=search.score))
    room = best.n_parameters - sum(p.candidate.n_parameters for j, p in enumerate(best.hypothesis) if j != k)
    nearest = [other for other in others if other is not None and other.candidate.n_parameters <= room]
    beside = (best.hypothesis[:k], best.hypothesis[k + 1 :])
    return [
        fitted for other in nearest[:CONTENDERS] for fitted in search.refitted(best, (*beside[0], other, *beside[1]))
    ]


def in_place(search: Moves, found: Searched, k: int, margin: float) -> list[Fitted]:
    """Hypotheses with another in a part's place.

    Where fits may end in one of many valleys, what fitted about as well in the part's place beside any other parts
    is fitted beside those of the end too, from where they are.

    Args:
        search: that ended.
        found: the end.
        k: place of the part.
        margin: what the score of one that fits about as well may lack.
    """
    rivals = list(found.rivals[k])
    if not search.settings.many_minima:
        return rivals
    parts = found.best.hypothesis
    own, rest = _kind(parts[k]), {_kind(part) for j, part in enumerate(parts) if j != k}
    near = search.score(found.best) + margin
    others: dict[Kind, Part] = {}
    for rival in rivals:
        left = [part for part in rival.hypothesis if _kind(part) not in rest]
        if len(left) == 1 and search.score(rival) < near:
            others[_kind(left[0])] = left[0]
    met = [known for fitted in (search.fitted, search.otherwise) for known in _beside_the_same(search, fitted).values()]
    for known in met:
        for kind, (score, part) in known.items():
            if own in known and kind not in rest and abs(score - known[own][0]) < margin:
                others.setdefault(kind, part)
    others.pop(own, None)
    for other in others.values():
        if search.allows([other.candidate.label]):
            rivals += search.refitted(found.best, (*parts[:k], *parts[k + 1 :], other))
    return rivals


def _beside_the_same(search: Moves, fits: Sequence[Fitted]) -> dict[tuple[Kind, ...], dict[Kind, tuple[float, Part]]]:
    """For kinds of parts that were fitted together what else was fitted beside them, its best score and itself."""
    found: dict[tuple[Kind, ...], dict[Kind, tuple[float, Part]]] = {}
    for fitted in sorted(fits, key=search.score):
        kinds = [_kind(part) for part in fitted.hypothesis]
        for place, part in enumerate(fitted.hypothesis):
            rest = tuple(sorted(kinds[:place] + kinds[place + 1 :]))
            found.setdefault(rest, {}).setdefault(kinds[place], (search.score(fitted), part))
    return found


def listed(search: Moves, found: Searched) -> Searched:
    """The end with others in the places of those parts for which none are known, after others were withdrawn.

    Where fits have many local minima they are found among all that was fitted, see ``in_place``.
    """
    if search.settings.many_minima:
        return found
    parts = zip(found.best.hypothesis, found.without, found.rivals, strict=True)
    rivals = [own or tuple(search.challenge(without, part.candidate.label)) for part, without, own in parts]
    return replace(found, rivals=tuple(rivals))


def narrowed(search: Moves, found: Searched) -> Searched:
    """Effects in the fewest places that fit as well (a deviance of ALIKE); the one of more places is a rival then.

    Not where fits have many local minima: deviances scatter by more than that.
    """
    if search.settings.many_minima:
        return found
    limit = search.score(found.best) + ALIKE
    while (least := _in_fewer_places(search, found, limit)) is not None:
        found = least
    return found


def _in_fewer_places(search: Moves, found: Searched, limit: float) -> Searched | None:
    hypothesis = found.best.hypothesis
    for k, part in enumerate(hypothesis):
        kind, sites = part.candidate.effect, part.candidate.locations
        fewer = [
            fitted
            for own in search.left
            if own.effect is kind and len(own.locations) == len(sites) - 1 and set(own.locations) < set(sites)
            for fitted in search.refitted(found.best, (*hypothesis[:k], Part(own, part.values), *hypothesis[k + 1 :]))
        ]
        least = min(fewer, key=search.score, default=None)
        if least is None or search.score(least) >= limit or not search.believed(found.without[k], least):
            continue
        moved = search.moved(found, least)
        rivals = [tuple(_beside_others(search, least, j, found.without[j], own)) for j, own in enumerate(found.rivals)]
        rivals[k] = (found.best, *found.rivals[k])
        return replace(moved, rivals=tuple(rivals))
    return None


def simplified(search: Moves, found: Searched) -> Searched:
    """The simplest of effects that exclude each other in a place, unless a richer one is needed.

    Such as dry friction without what it is more at rest: searches with many kinks rank them by chance.
    """
    hypothesis = found.best.hypothesis
    for k, part in enumerate(hypothesis):
        own = part.candidate
        for other in search.left:
            same = other.effect.exclusive == own.effect.exclusive is not None and other.locations == own.locations
            if not same or other.n_parameters >= own.n_parameters:
                continue
            begins = [dict(guess) for guess in other.guesses]
            shared = {key: part.values[key] for key in begins[0] if key in part.values}
            values = {**begins[len(begins) // 2], **shared}
            simple = search.refit(found.best, (*hypothesis[:k], Part(other, values), *hypothesis[k + 1 :]))
            if not search.believed(simple, found.best):
                return simplified(search, search.moved(found, simple))
    return found


def less(search: Moves, found: Searched, places: Sequence[int]) -> Searched:
    """The search's end without some parts, and without those that are believed no more then."""
    while places:
        kept = tuple(p for k, p in enumerate(found.best.hypothesis) if k not in places)
        found = search.moved(found, search.refit(found.best, kept) if kept else found.base)
        pairs = enumerate(found.without)
        places = [k for k, without in pairs if not search.believed(without, found.best)][:1]
    return found


def instead(rival: Fitted, without: Fitted) -> Part | None:
    """The one part that a hypothesis has beside those of another; None where that is not one."""
    rest = without.labels
    more = [part for part in rival.hypothesis if part.candidate.label not in rest]
    return more[0] if len(more) == 1 else None


def _kind(part: Part) -> Kind:
    effect = part.candidate.effect
    return effect.exclusive or effect.name, part.candidate.locations
