"""Confirmation: whether recordings bear a part out that a search has accepted.

Fitted trials say whether its gain stands out from the scatter of the residuals, inverse dynamics along their motion
whether they show it, held-out trials whether they improve as is expected. Each has a threshold of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from equimus_ctrl.diagnosis.alternatives import indistinguishable, listed, simpler_laws, simplified
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.scoring import extra_parameters
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState, Undecided
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.torque_agreement import share_in_torques

Reason = Literal["gain", "distance", "evident", "uninformative", "worse", "scatter", "torques"]
"""By what a part is confirmed, or is not; what is found is a number, and what it has to be:

- gain: what validation trials gain by it, over what as many samples of the fitted ones gain; at least
  ``Thresholds.validation_share``.
- distance: the same over χ² by which the two models differ on validation trials, all that they can show; as much.
- evident: they cannot show it, for the part alone changes next to nothing there, and the gain on the fitted trials is
  ``Thresholds.evident`` times the least one; it is confirmed, and the number is inf.
- uninformative: they cannot show it, and that gain is not as large; the number is that of "gain".
- worse: with it half of a kind of validation trials gets worse than without any effect, see ``Thresholds.worse``; the
  number is χ² there over that of the refitted model.
- scatter: residuals are more than noise, and its gain on the fitted trials does not stand out from how they scatter
  from block to block, see ``block_scatter.stands_out``; the number is how much more they scatter than their noise.
- torques: inverse dynamics along the measured motion do not show it; the number is the share that they do show, see
  ``torque_agreement.share_in_torques``, to be at least ``Thresholds.torque_share``.
"""


@dataclass(frozen=True)
class Confirmation:
    """What recordings say of a part.

    Attributes:
        reason: what says it, see ``Reason``.
        found: the number that says it, see ``Reason``.
        where: of "worse" the trials that get worse.
        stands_out: of "scatter" t² over the least that it has to be by some thresholds, see ``block_scatter``.
    """

    reason: Reason
    found: float
    where: str = ""
    stands_out: Callable[[Thresholds], float] = field(default=lambda t: 0.0, compare=False, repr=False)

    def margin(self, t: Thresholds) -> float:
        """What was found over the least that confirms the part by some thresholds: it is confirmed from 1 on."""
        match self.reason:
            case "evident":
                return math.inf
            case "worse":
                return 0.0
            case "scatter":
                return self.stands_out(t)
            case "torques":
                return self.found / t.torque_share
            case "gain" | "distance" | "uninformative":
                return self.found / t.validation_share

    def __str__(self) -> str:
        """A clause for the report."""
        said = {
            "gain": f"validation trials gain {self.found:.3g} of what the fitted ones let expect",
            "distance": f"validation trials gain {self.found:.3g} of what they can show of it",
            "evident": "validation trials cannot show it, and its gain on the fitted ones is far above the threshold",
            "uninformative": "validation trials cannot show it, and its gain on the fitted ones is not far above the "
            "threshold",
            "worse": f"with it {self.where} has {self.found:.3g} times the squared error of the refitted model",
            "scatter": f"residuals are more than noise: from block to block they scatter {self.found:.3g} times "
            "as much, and its gain does not stand out from that",
            "torques": f"inverse dynamics along the measured motion show {self.found:.3g} of what they would of it",
        }
        return said[self.reason]


Tell = Callable[[str, Confirmation], None]
"""Called with the label of a part and what recordings say of it."""


def confirmed(
    search: Search, state: SearchState, split: Split, tell: Tell = lambda label, confirmation: None
) -> SearchState:
    """The hypothesis without the parts that held-out trials do not confirm, and those not needed without these.

    Where an alternative fits as well in such a part's place and is confirmed, it is accepted. Where minima are many and
    no part is left, the best effects alone are judged likewise, see ``_alone``.

    Args:
        search: that ended there.
        state: its end.
        split: with the validation trials.
        tell: told of each part that is confirmed or rejected.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis without one of its parts diverges.
    """
    if not split.validation or not state.best.hypothesis:
        return state
    been: dict[frozenset[str], Fitted] = {}
    state = _confirmed(search, state, split, tell, been)
    if search.settings.many_minima and not state.best.hypothesis:
        state = _confirmed(search, _alone(search, state, been), split, tell, been)
    return state


def _alone(search: HypothesisMoves, state: SearchState, been: Mapping[frozenset[str], Fitted]) -> SearchState:
    """A search moved to the best effect alone, of those that were not judged; as it is where none is accepted.

    One that began with several laws together may have fitted none by itself, and what several imitate is simple.

    Args:
        search: whose it is.
        state: without any part.
        been: what was judged, by its labels.
    """
    options, tried = search.challenge(state.tried, state.best)
    state, found = replace(state, tried=tried), list[Fitted]()
    new = [f for f in sorted(options, key=search.score) if not any(_same_effects(f, own) for own in been.values())]
    for option in new[: search.settings.kept]:
        best, state = _converged(search, state, option)
        if search.accepts(state.best, best) and not search.aliased(best):
            found.append(best)
    if not found:
        return state
    return replace(state, best=min(found, key=search.score), without=(state.best,), alternatives=((),))


def _converged(search: HypothesisMoves, state: SearchState, fitted: Fitted) -> tuple[Fitted, SearchState]:
    """A fit converged, and a search that knows it."""
    known = state.tried.converged
    best = known.get(fitted) or search.data.converge(fitted)
    return best, replace(state, tried=replace(state.tried, converged={**known, fitted: best}))


def _confirmed(
    search: Search, state: SearchState, split: Split, tell: Tell, been: dict[frozenset[str], Fitted]
) -> SearchState:
    """The same of what a search ended with.

    Args:
        search: that ended there.
        state: its end.
        split: with the validation trials.
        tell: see ``confirmed``.
        been: gets what is judged, by its labels.
    """
    while state.best.hypothesis:
        been[state.best.labels] = state.best
        if (needless := _needless(search, state)) is not None:
            state = search.moved(state, state.without[needless])
            continue
        holdout, confirmations = _confirmations(search, state, split)
        parts = [part.candidate.label for part in state.best.hypothesis]
        place = least_confirmed(search, confirmations)
        if place is None:
            if (spoils := _makes_worse(search, holdout, state)) is not None:
                tell(parts[spoils[0]], spoils[1])
                state = search.moved(state, state.without[spoils[0]])
                continue
            if (simpler := _simpler(search, holdout, state, tell)) is not None:
                state = simpler
                continue
            for label, confirmation in zip(parts, confirmations, strict=True):
                tell(label, confirmation)
            return state
        tell(parts[place], confirmations[place])
        if search.settings.many_minima:
            state, found = _another(search, state, place, split, been.keys())
            if found:
                continue
        if len(state.best.hypothesis) == 1:
            state = listed(search, state)
            if (other := _confirmed_alternative(search, holdout, state)) is not None:
                tell(other[0].best.hypothesis[-1].candidate.label, other[1])
                return other[0]
        state = search.moved(state, state.without[place])
    return state


def confirmed_as_fitted(
    search: Search, state: SearchState, split: Split, tell: Tell = lambda label, confirmation: None
) -> SearchState:
    """The same where there is no time for further fits: what is left is a hypothesis that was fitted on the way.

    It is the best of which every part is needed and confirmed, and none was rejected as part of a better one.

    Args:
        search: that was ended there.
        state: what it had come to.
        split: with the validation trials.
        tell: told of each part that is confirmed or rejected.
    """
    rejected, needless = set[str](), set[frozenset[str]]()
    while split.validation and state.best.hypothesis:
        if _needless(search, state) is not None:
            needless.add(state.best.labels)
            state = _best_known(search, state, rejected, needless)
            continue
        holdout, confirmations = _confirmations(search, state, split)
        parts = [part.candidate.label for part in state.best.hypothesis]
        place = least_confirmed(search, confirmations)
        against = _makes_worse(search, holdout, state) if place is None else (place, confirmations[place])
        if against is None:
            for label, confirmation in zip(parts, confirmations, strict=True):
                tell(label, confirmation)
            break
        tell(parts[against[0]], against[1])
        rejected.add(parts[against[0]])
        state = _best_known(search, state, rejected, needless)
    return state


def best_as_fitted(search: HypothesisMoves, state: SearchState) -> SearchState:
    """A search at the best hypothesis that was fitted without each of its parts, too: where it is, or one before."""
    if len(state.without) == len(state.best.hypothesis):
        return state
    return _best_known(search, state, frozenset(), frozenset())


def _needless(search: HypothesisMoves, state: SearchState) -> int | None:
    """The place of the part that gains least on the fitted trials, where that is not enough to accept it."""
    least = min(range(len(state.without)), key=lambda k: state.without[k].deviance, default=None)
    return None if least is None or search.accepts(state.without[least], state.best) else least


def _best_known(
    search: HypothesisMoves, state: SearchState, rejected: Set[str], needless: Set[frozenset[str]]
) -> SearchState:
    """A search at the best hypothesis that was fitted, and so was it without each of its parts.

    Args:
        search: whose it is.
        state: with what was fitted.
        rejected: labels of parts that it must not have.
        needless: labels of hypotheses that it is not, together.
    """
    known = {state.base.labels: state.base}
    for fitted in sorted((*state.tried.fitted, *state.without, state.best), key=lambda f: -f.deviance):
        known[fitted.labels] = fitted
    rests = {fitted: [fitted.labels - {p.candidate.label} for p in fitted.hypothesis] for fitted in known.values()}
    left = [
        fitted
        for fitted, rest in rests.items()
        if known.keys() >= set(rest) and not fitted.labels & rejected and fitted.labels not in needless
        and len(fitted.hypothesis) <= search.settings.most_parts and state.tried.allows(fitted.candidates)
    ]  # fmt: skip
    best = min(left, key=search.score)  # the model without any part at least
    return replace(
        state,
        best=best,
        without=tuple(known[own] for own in rests[best]),
        alternatives=tuple(() for _ in rests[best]),
        tried=state.tried.having(state.best, *state.without),
    )


def _confirmations(search: Search, state: SearchState, split: Split) -> tuple[HoldoutResiduals, list[Confirmation]]:
    """What validation trials show, and what recordings say of each part."""
    holdout = HoldoutResiduals(search.data, split, state)
    return holdout, [confirmation_of(search, holdout, without, state.best) for without in state.without]


def least_confirmed(search: Search, confirmations: Sequence[Confirmation]) -> int | None:
    """The place of the part that is confirmed least, by ``Confirmation.margin``; None where all are confirmed."""

    def place(t: Thresholds) -> int | None:
        margins = [one.margin(t) for one in confirmations]
        least = int(np.argmin(margins))
        return None if margins[least] >= 1 else least

    thresholds = search.data.thresholds
    found = place(thresholds)
    # Other thresholds may reject another part, so this is a decision of its own.
    thresholds.decides(lambda t: place(t) == found)
    return found


def _simpler(search: Search, holdout: HoldoutResiduals, state: SearchState, tell: Tell) -> SearchState | None:
    """The end with a simpler law in the place of one whose further parameters held-out trials do not confirm.

    Friction of two sizes in the two directions may fit better than of one and say less of other trials. Where they
    cannot show the difference, the richer law stays undecided beside the simpler one.
    """
    if not search.settings.many_minima:
        return None
    for k, part in enumerate(state.best.hypothesis):
        for simpler in simpler_laws(search, state, part):
            rest = state.best.hypothesis
            fits, tried = search.refitted(state.tried, state.best, (*rest[:k], simpler, *rest[k + 1 :]))
            state = replace(state, tried=tried)
            for simple in fits:
                confirmation = confirmation_of(search, holdout, simple, state.best)
                if not confirms(search, confirmation):
                    tell(part.candidate.label, confirmation)
                    if confirmation.reason == "uninformative" and search.accepts(simple, state.best):
                        open_ = Undecided(simpler.candidate.label, part)
                        state = replace(state, undecided=(*state.undecided, open_))
                    return search.moved(state, simple)
    return None


def _makes_worse(search: Search, holdout: HoldoutResiduals, state: SearchState) -> tuple[int, Confirmation] | None:
    """The part by which half of a kind of validation trials gets worse than the refitted model, if one does.

    On the whole a part may gain and still extrapolate wrongly: states that drift, say, of which the fitted trials saw
    the beginning alone.
    """
    names, halves = holdout.halves
    base, best = holdout.squares(state.base.fit.model), holdout.squares(state.best.fit.model)
    distance = holdout.squares_between(state.base.fit.model, state.best.fit.model)
    for piece in sorted(range(len(halves)), key=lambda k: -best[k] / max(base[k], 1e-300)):
        # By chance alone χ² differs by twice the root of the distance of the two models there.
        if not search.data.thresholds.decides(partial(_worse, base[piece], best[piece], distance[piece])):
            continue
        without = [holdout.squares(fitted.fit.model)[piece] for fitted in state.without]
        k = int(np.argmin(without))
        if without[k] < best[piece]:
            return k, Confirmation("worse", best[piece] / base[piece], names[piece])
    return None


def _worse(base: float, best: float, distance: float, t: Thresholds) -> bool:
    return best > (1 + t.worse) * base + max(t.uninformative, 2 * t.worse_by_chance * math.sqrt(distance))


def _confirmed_alternative(
    search: Search, holdout: HoldoutResiduals, state: SearchState
) -> tuple[SearchState, Confirmation] | None:
    """The end with another part in the only one's place, that fits as well and that held-out trials confirm."""
    score = search.score(state.best)
    other_laws = (a for a in state.alternatives[0] if not _same_effects(a, state.best))
    as_good = (a for a in other_laws if indistinguishable(search, a, score))
    for alternative in sorted(as_good, key=search.score):
        confirmation = confirmation_of(search, holdout, state.without[0], alternative)
        if confirms(search, confirmation):
            others = (state.best, *(a for a in state.alternatives[0] if a is not alternative))
            return replace(state, best=alternative, alternatives=(others,)), confirmation
    return None


def _another(
    search: Search, state: SearchState, place: int, split: Split, been: Set[frozenset[str]]
) -> tuple[SearchState, bool]:
    """The best hypothesis that fits better than the one less a part, all of whose parts are confirmed; whether one is.

    Validation trials may reject one part too many of a kind alone: an asymmetric friction that took an
    offset's place, say. A law that a simpler one fits as well as becomes that.

    Args:
        search: that ended.
        state: its end.
        place: of the part.
        split: with the validation trials.
        been: labels of what was looked at before, one of whose parts was not needed or not confirmed.
    """
    rejected, looked_at = state.best, set[frozenset[str]]()
    limit = search.score(state.without[place])
    for fitted in sorted(state.tried.fitted, key=search.score):
        if len(looked_at) >= search.settings.unconfirmed or search.score(fitted) >= limit:
            break
        size, known = len(fitted.hypothesis), looked_at | been
        if not 0 < size <= search.settings.most_parts or fitted.labels in known:
            continue
        if not state.tried.allows(fitted.candidates) or _same_effects(fitted, rejected):
            continue
        looked_at.add(fitted.labels)
        best, state = _converged(search, state, fitted)
        holdout = HoldoutResiduals(search.data, split, replace(state, best=best))
        for k in range(len(best.hypothesis)):
            without, tried = search.refit(state.tried, best, (*best.hypothesis[:k], *best.hypothesis[k + 1 :]))
            state = replace(state, tried=tried)
            if not search.accepts(without, best):
                break
            if not confirms(search, confirmation_of(search, holdout, without, best)):
                break
        else:
            return simplified(search, search.moved(state, best)), True
    return state, False


def _same_effects(first: Fitted, second: Fitted) -> bool:
    """Whether two hypotheses differ at most in which groups of trials have values of their own."""
    one, two = (
        {(p.candidate.effect, p.candidate.locations, p.candidate.each) for p in fitted.hypothesis}
        for fitted in (first, second)
    )
    return one == two


def confirmation_of(search: Search, holdout: HoldoutResiduals, simple: Fitted, rich: Fitted) -> Confirmation:
    """What recordings say of the part by which a hypothesis is richer, before it is named.

    The fitted trials say whether its gain stands out from the scatter of what is left, and whether inverse dynamics
    show it, the held-out ones whether it carries over. A residual force has no name that could be wrong, so it is asked
    for the latter alone.

    Raises:
        BudgetSpent: where the budget ends.
    """
    return (
        _lost_in_scatter(search, simple, rich)
        or _not_in_torques(search, simple, rich)
        or carried_over(search, holdout, simple, rich)
    )


def _lost_in_scatter(search: Search, simple: Fitted, rich: Fitted) -> Confirmation | None:
    """Why a gain is within the scatter of the residuals; None where it stands out from it, or they are noise alone."""
    over_needed, thresholds = partial(search.over_scatter, simple, rich), search.data.thresholds
    if thresholds.decides(lambda t: over_needed(t) >= 1):
        return None
    dispersion = search.scatter_beside(simple, rich, thresholds).dispersion
    return Confirmation("scatter", dispersion, stands_out=over_needed)


def _not_in_torques(search: Search, simple: Fitted, rich: Fitted) -> Confirmation | None:
    """The part by which a hypothesis is richer that inverse dynamics do not show; None where they show all."""
    if (domain := search.torque_domain) is None:
        return None
    more = [k for k, part in enumerate(rich.hypothesis) if part.candidate.label not in simple.labels]
    least = min((share_in_torques(search.data, domain, rich, k) for k in more), default=math.inf)
    thresholds = search.data.thresholds
    if thresholds.decides(lambda t: least >= t.torque_share):
        return None
    return Confirmation("torques", least)


def carried_over(search: Search, holdout: HoldoutResiduals, simple: Fitted, rich: Fitted) -> Confirmation:
    """What validation trials say of the part by which a hypothesis is richer.

    Its gain there, over that on as many samples of the fitted trials. Where trials differ in kind, validation trials
    may show less of it: in some recordings a drive's limit is never reached, say. So the gain may also be as large as
    they can show, and a part that they cannot show at all is confirmed where its gain on the fitted trials is large: a
    table that is touched in one recording alone, say. The two fits then differ there by their other parameters.
    """
    ratio = holdout.carried_over(simple, rich)
    thresholds = search.data.thresholds
    if (
        thresholds.decides(lambda t: ratio >= t.validation_share)
        or search.data.free.model.robot.traits.same_kind_of_trials
    ):
        return Confirmation("gain", ratio)
    distance = holdout.distance(simple, rich)
    shown = min(distance, holdout.own_distance(simple, rich))
    if thresholds.decides(lambda t: shown >= t.uninformative):
        return Confirmation("distance", max(ratio, holdout.gain(simple, rich) / distance))
    gain, more = simple.deviance - rich.deviance, extra_parameters(simple, rich)
    if thresholds.decides(lambda t: gain > t.evident * search.threshold(more, t)):
        return Confirmation("evident", math.inf)
    return Confirmation("uninformative", ratio)


def confirms(search: Search, confirmation: Confirmation) -> bool:
    """Whether what recordings say of a part confirms it, see ``Confirmation.margin``."""
    return search.data.thresholds.decides(lambda t: confirmation.margin(t) >= 1)
