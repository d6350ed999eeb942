"""Experiments one after the other: explanations after each trial, which is worth making, and when there is an end.

A diagnosis of all trials so far leaves explanations (``rivals``). A trial that distinguishes them is designed and made,
and all trials are diagnosed again. What a diagnosis no longer leaves is fitted to the same trials once more: that shows
by how much the trial spoke against it, and whether that is what was predicted.

Designed trials are fitted but for their ends, which are held out: the search decides between explanations by what is
fitted, and recordings from before hardly show what a trial was designed to show, so they cannot judge it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from equimus_ctrl.diagnosis.holdout import EVERY, LAST, Holdout, choose_holdout, end_of
from equimus_ctrl.diagnosis.known import Known
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import MOST_HIDDEN, Rival, Rivals, refitted_to
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.experiments.power import margin
from equimus_ctrl.experiments.results import Pair
from equimus_ctrl.shown import counted
from equimus_ctrl.types import Recording

End = Literal["resolved", "inseparable", "trials", "seconds"]
"""Why there is no further trial: one explanation is left, nothing more can be distinguished within the limits, or the
budget of trials or of seconds is spent."""
WORTH = 0.5
"""Pairs that a trial is expected to settle, to be worth making."""


UNLIKELY = 0.05
"""Largest chance of what counts as not foreseen, see ``unforeseen``."""


@dataclass(frozen=True)
class Explanation:
    """What is said of an explanation after a diagnosis.

    Attributes:
        label: its effects and their places; with their sizes where these are given rather than estimated.
        behind: by how much its score, −2 ln L and Schwarz's cost of its parameters, is above that of the first.
        left: whether the diagnosis leaves it.
        accepted: whether it was taken for possible; else see ``Rival.accepted``.
    """

    label: str
    behind: float
    left: bool
    accepted: bool


@dataclass(frozen=True)
class Belief:
    """The explanations after a diagnosis, and by how much each is behind the first.

    Attributes:
        verdict: of the diagnosis.
        explanations: the one that it names first, the others that it leaves, and those that it no longer leaves.
    """

    verdict: str
    explanations: tuple[Explanation, ...]

    @property
    def left(self) -> tuple[Explanation, ...]:
        """Those that the diagnosis leaves."""
        return tuple(own for own in self.explanations if own.left)

    def __str__(self) -> str:
        first, *others = self.left
        told = f"{self.verdict}: {first.label}"
        if others:
            told += "; not distinguished from " + ", ".join(f"{own.label} ({own.behind:+.3g})" for own in others)
        if gone := [own for own in self.explanations if not own.left]:
            told += "; no longer left: " + ", ".join(f"{own.label} ({own.behind:+.3g})" for own in gone)
        return told

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        told = [{**asdict(own), "behind": _finite(own.behind)} for own in self.explanations]
        return {"verdict": self.verdict, "explanations": told}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Belief:
        """What ``to_dict`` wrote down."""
        told = [{**own, "behind": _or_infinite(own["behind"])} for own in data["explanations"]]
        return cls(data["verdict"], tuple(Explanation(**own) for own in told))


def label_of(rival: Rival) -> str:
    """The label of an explanation; where sizes are given, with these, for one of another size is another."""
    sizes = [f"{key} {value:.3g}" + (f" {unit}" if unit != "1" else "") for key, value, unit in rival.given_sizes]
    return f"{rival.label} ({', '.join(sizes)})" if sizes else rival.label


def known_from(before: Rivals | None) -> tuple[Known, ...]:
    """Where a diagnosis with one trial more may begin: at each explanation that was left before it.

    Args:
        before: these; None where there was no diagnosis.
    """
    found = list[Known]()
    if before is None:
        return ()
    for rival in before.rivals:
        effects = iter(rival.model.effects[len(before.model.effects) :])
        values = [(named, {at: next(effects).parameters() for at in named.locations}) for named in rival.effects]
        parameters = dict(zip(rival.parameters.names, map(float, rival.theta), strict=True))
        found.append(Known(tuple(values), parameters, rival.model, rival.accepted and not rival.given))
    return tuple(found)


def no_longer_left(before: Rivals | None, diagnosis: Diagnosis, now: Rivals) -> tuple[Rival, ...]:
    """The explanations from before a trial that a diagnosis with it does not leave, fitted to what it fitted.

    Args:
        before: that were left; None where there was no diagnosis.
        diagnosis: with the trial.
        now: that it leaves.
    """
    if before is None:
        return ()
    labels, found = {label_of(rival) for rival in now.rivals}, list[Rival]()
    for rival in before.rivals:
        if label_of(rival) in labels:
            continue
        try:
            found.append(refitted_to(rival, diagnosis))
        except SimulationDiverged:  # nothing could speak against it more
            found.append(replace(rival, deviance=math.inf))
    return tuple(found)


def with_better(now: Rivals, gone: Sequence[Rival]) -> tuple[Rivals, tuple[Rival, ...]]:
    """The explanations that a diagnosis leaves and those that fit better than what it names, and the rest of the gone.

    Held-out trials may not confirm what fits better. That excludes nothing: another trial has to decide. Of many the
    best ``MOST_HIDDEN`` stay.

    Args:
        now: that it leaves.
        gone: that it does not, see ``no_longer_left``.
    """
    first = now.rivals[0].score(now.n)
    best = sorted((own for own in gone if own.score(now.n) < first), key=lambda own: own.score(now.n))[:MOST_HIDDEN]
    rest = tuple(own for own in gone if own not in best)
    stay = [replace(own, accepted=False) for own in best]
    return (replace(now, rivals=(*now.rivals, *stay)), rest) if stay else (now, rest)


def belief_of(now: Rivals, gone: Sequence[Rival] = ()) -> Belief:
    """The explanations after a diagnosis, the one that it names first.

    Args:
        now: that a diagnosis leaves.
        gone: that it no longer does, see ``no_longer_left``.
    """
    first = now.rivals[0].score(now.n)

    def told(rival: Rival, left: bool) -> Explanation:
        return Explanation(label_of(rival), rival.score(now.n) - first, left, rival.accepted)

    return Belief(now.verdict, (*(told(r, True) for r in now.rivals), *(told(r, False) for r in gone)))


@dataclass(frozen=True)
class Predicted:
    """What is predicted of a trial for a pair of explanations, see ``power.Power``.

    Attributes:
        true: the explanation that is taken for the truth.
        other: the one that it is to be distinguished from.
        gap: by how much −2Δln L moves in favour of the first, without noise.
        low: of the interval, noise and parameters in mind.
        high: of it.
        chance: that one trial settles the pair.
        repeats: of the trial that are likely to; inf where no number is.
    """

    true: str
    other: str
    gap: float
    low: float
    high: float
    chance: float
    repeats: float

    @classmethod
    def of(cls, rivals: Rivals, pairs: Sequence[Pair]) -> tuple[Predicted, ...]:
        """Of the pairs of a design that the recordings so far have not settled, both ways round."""
        labels = [label_of(rival) for rival in rivals.rivals]
        return tuple(
            cls(
                labels[own.first], labels[own.second], own.gap, *own.interval, own.chance, own.repeats
            )
            for pair in pairs
            if pair.ending != "settled"
            for own in pair.powers
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null where no number of repeats would do."""
        return {**asdict(self), "repeats": _finite(self.repeats)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Predicted:
        """What ``to_dict`` wrote down."""
        return cls(**{**data, "repeats": _or_infinite(data["repeats"])})


@dataclass(frozen=True)
class Realised:
    """What became of a prediction.

    Attributes:
        predicted: it; what it takes for the truth is what the diagnosis with the trial names first.
        gap: by how much −2Δln L has moved in favour of that.
        settled: whether the diagnosis no longer leaves the other, and that is behind by what is needed: an effect of a
            given size is excluded then, not merely asked for at another size.
    """

    predicted: Predicted
    gap: float
    settled: bool

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null for a gap without end, of an explanation that cannot follow the trial at all."""
        return {"predicted": self.predicted.to_dict(), "gap": _finite(self.gap), "settled": self.settled}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Realised:
        """What ``to_dict`` wrote down."""
        return cls(Predicted.from_dict(data["predicted"]), _or_infinite(data["gap"]), data["settled"])


def realised(
    before: Rivals, predicted: Sequence[Predicted], now: Rivals, gone: Sequence[Rival] = ()
) -> tuple[Realised, ...]:
    """What became of the predictions of those pairs whose first is what is named now.

    Args:
        before: rivals that the trial was designed for.
        predicted: of their pairs.
        now: that the diagnosis with the trial leaves.
        gone: that it no longer does.
    """
    was = {label_of(rival): rival.deviance for rival in before.rivals}
    after = {label_of(rival): rival for rival in (*gone, *now.rivals)}
    first, left = now.rivals[0], {label_of(rival) for rival in now.rivals}
    needed, found = margin(now), list[Realised]()
    for own in predicted:
        if own.true != label_of(first) or own.other not in after:
            continue
        other = after[own.other]
        gap = (other.deviance - first.deviance) - (was[own.other] - was[own.true])
        behind = other.score(now.n) - first.score(now.n)
        found.append(Realised(own, gap, own.other not in left and behind > needed))
    return tuple(found)


def unforeseen(became: Sequence[Realised]) -> tuple[Realised, ...]:
    """The predictions that did not come true though they would have, but for a chance of ``UNLIKELY``, were it true.

    What is named now is hardly what is there then, however well it fits: that may have no name.

    Args:
        became: of the predictions of a trial.
    """
    return tuple(own for own in became if not own.settled and own.predicted.chance >= 1.0 - UNLIKELY)


def held_out(given: Sequence[Recording], designed: int, patterns: Sequence[str] = ()) -> Holdout | None:
    """What is held out of recordings from before and designed trials, which come after them.

    Of each designed trial it is the end: recordings from before hardly show what it was designed to show, so they can
    neither confirm nor reject it. Of so few of these that one is too much of what there is to hold it out whole, it is
    the ends too, unless one is too short for that, and from the first diagnosis on: what is fitted once stays fitted,
    and cut as it was, so a trial alone moves the likelihoods.

    Args:
        given: the recordings from before, or the first trial where there were none.
        designed: how many designed trials there are.
        patterns: of names of trials that somebody wants held out; then it is for them alone to say.
    """
    if patterns:
        return None
    ends = frozenset(range(len(given), len(given) + designed))
    if len(given) < EVERY and all(end_of(own) is not None for own in given):
        return Holdout(ends=ends | frozenset(range(len(given))), apart=ends)
    found = choose_holdout([own.name for own in given])
    return replace(found, ends=found.ends | ends, apart=ends)


def fitted_share(patterns: Sequence[str] = ()) -> float:
    """How much of a designed trial is fitted, see ``held_out``.

    Args:
        patterns: as there.
    """
    return 1.0 if patterns else 1.0 - LAST


def worth_making(predicted: Sequence[Predicted], left: int) -> bool:
    """Whether trials like one, as many as there may yet be, are likely to settle a pair: more likely than not of one.

    Of a pair either explanation may be true, one as likely as the other; of several pairs their chances add up to how
    many are expected to be settled.

    Args:
        predicted: of the trial.
        left: how many trials there may yet be.
    """
    pairs: dict[frozenset[str], list[float]] = {}
    for own in predicted:
        chance = 1.0 if own.repeats <= left else 1.0 - (1.0 - own.chance) ** left
        pairs.setdefault(frozenset({own.true, own.other}), []).append(chance)
    return sum(sum(both) / len(both) for both in pairs.values()) >= WORTH


def hopeless(named: Collection[str], predicted: Sequence[Predicted]) -> tuple[Predicted, ...]:
    """The predictions for what is named, where not one of these explanations is to be told from the first; else none.

    Trials may yet be made, for what may hide beside them.

    Args:
        named: labels of the explanations that a diagnosis names, see ``Rivals.named``.
        predicted: of the best trial that was found.
    """
    own = tuple(pair for pair in predicted if pair.true in named and pair.other in named)
    known = {label for pair in own for label in (pair.true, pair.other)}
    return own if known == set(named) and not worth_making(own, 1) else ()


def why(predicted: Sequence[Predicted]) -> str:
    """Why a trial was chosen, as a clause: the pair that it is surest to settle, and how many others.

    Args:
        predicted: of the trial, one or more.
    """
    best = max(predicted, key=lambda own: (own.chance, own.gap))
    told = (
        f"it distinguishes {best.true} from {best.other} by an expected gap of {best.gap:.3g} ({best.low:.3g} to "
        f"{best.high:.3g}) in −2Δln L, with a chance of {100 * best.chance:.0f} %"
    )
    if math.isfinite(best.repeats) and best.repeats > 1:
        told += f"; {best.repeats:g} such trials would be likely to"
    if more := sum(own.chance >= 0.5 for own in predicted if own is not best):
        told += f"; of {counted(len(predicted) - 1, 'other pair')} {more} more likely than not"
    return told


def why_not(predicted: Sequence[Predicted]) -> str:
    """Why none was made, as a sentence.

    Args:
        predicted: of the best trial that was found.
    """
    told = "within the limits and the budget nothing more can be distinguished"
    if not predicted:
        return told

    def hardness(own: Predicted) -> tuple[float, float, float]:
        return own.repeats, -own.chance, -own.gap

    # Of each pair the way round that is harder: a trial that settles it were the other true does not settle it.
    harder: dict[frozenset[str], Predicted] = {}
    for own in sorted(predicted, key=hardness):
        harder[frozenset({own.true, own.other})] = own
    best = min(harder.values(), key=hardness)
    often = f"{best.repeats:g} of them would be needed" if math.isfinite(best.repeats) else "no number of them would do"
    return (
        f"{told}: the best trial that was found distinguishes {best.true} from {best.other} with a chance of "
        f"{100 * best.chance:.0f} %, and {often}"
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value
