"""Other laws in the place of a part that may stand for them: at the end of a search, from where each imitates it best.

A search asks what explains the residuals of a model that was refitted without a part. Where errors grow along a trial
that model has moved far, and first-order gains there say little: the true law may not be among the best few, or its fit
may begin on the wrong side and be dropped while it still gains. So at the end every candidate is asked, at the end's
own parameters, how much it would imitate of what the part changes,

    share = (‖P r‖² − ‖P (r − c')‖²) / ‖P c‖²

c what the part changes of the predictions, r that with the residuals that it leaves, c' what the candidate changes at
its best guess and size, all whitened by the end's noise, P the projection orthogonal to all other parameters. Of what
is far above the noise, noise has no say in it. What imitates a good share is fitted from there until it has converged.

Not asked is what else could be a part whose gain does not stand out from the scatter of the residuals, for none is
confirmed, or with which validation trials get worse, for nothing that is there would do that.

A law with many parameters may have fewer dimensions in what is seen, see ``Data.dimensions``. So Schwarz's cost of a
law that fits better is of dimensions here, as of what is listed as not distinguishable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.alternatives import pruned, simplified
from equimus_ctrl.diagnosis.fitting import CONVERGED_GAIN, Fitted
from equimus_ctrl.diagnosis.hypothesis import Part
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.screening import Screened, screen
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import whiten_fit

IMITATES = 0.5
"""A candidate is fitted in a part's place from this share of what that changes on: then they have more in common than
not. Guesses of its shape are few, so the true law may imitate no more by any of them."""
MOST_IMITATORS = 5
"""So many of them are, those that imitate most."""
ROUNDS = 4
"""How often a fit that still gains goes on until it counts as converged, at most."""


def with_imitators(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end, or a better one with other laws in the place of one of its parts. Not where minima are few.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis without one of its parts diverges.
    """
    if not search.settings.many_minima:
        return state
    for _ in range(search.settings.contests):
        better, tried = _better(search, state)
        state = replace(state, tried=tried)
        if better is None:
            break
        # Not exchanged: that counts parameters, and would take back what has fewer dimensions.
        state = simplified(search, pruned(search, search.needed(replace(state, best=better))))
    return state


def _better(search: HypothesisMoves, state: SearchState) -> tuple[Fitted | None, SearchHistory]:
    """The best hypothesis with other laws in a part's place, where it outdoes the present one."""
    best, tried = state.best, state.tried
    found: list[Fitted] = []
    for k in range(len(best.hypothesis)):
        if search.lost(state.without[k], best) or search.spoils(state.without[k], best):
            continue
        fits = imitations(search, state, k)
        two, tried = _two_in_place(search, replace(state, tried=tried.having(*fits)), k, fits)
        found += [*fits, *two]
    better = (fit for fit in found if outdoes(search, fit, best) and not search.aliased(fit))
    top = min(better, key=search.score, default=None)
    before = state.tried.fitted
    listed = (*tried.imitations, *(fit for fit in tried.fitted[len(before) :] if fit is not top))
    return top, replace(tried, fitted=before if top is None else (*before, top), imitations=listed)


def _two_in_place(
    search: HypothesisMoves, state: SearchState, k: int, fits: Sequence[Fitted]
) -> tuple[list[Fitted], SearchHistory]:
    """Hypotheses with two laws in the place of a part, which together have no more parameters than it.

    A law of many parameters may gain most alone, for it draws a little of each of two simple ones. The first of two is
    one that gains nearly as much, see ``Thresholds.runner_up``; of those that fit alike the one with the fewest
    parameters.

    Args:
        search: that ended.
        state: its end.
        k: the part's place.
        fits: others in its place, beside those of the state.
    """
    best, tried = state.best, state.tried
    rich, without = best.hypothesis[k].candidate.n_parameters, state.without[k]
    others = [*fits, *(state.alternatives[k] if state.alternatives else ())]
    own = without.n_parameters + rich

    def near(other: Fitted) -> bool:
        gain, most = without.deviance - other.deviance, without.deviance - best.deviance
        return search.data.thresholds.decides(lambda t: gain > t.runner_up * most)

    first: list[Fitted] = []
    for other in sorted(others, key=search.score):
        alike = any(abs(other.deviance - one.deviance) < CONVERGED_GAIN for one in first)
        if other.n_parameters < own and not alike and near(other) and not search.aliased(other):
            first.append(other)
    found: list[Fitted] = []
    for other in first[: search.settings.runners_up]:
        search.notify("a second effect beside another", other.label)
        more, tried = search.challenge(tried, other)
        found += [fit for fit in more if fit.n_parameters <= own and len(fit.hypothesis) <= search.settings.most_parts]
    return found, tried


def imitations(search: HypothesisMoves, state: SearchState, k: int) -> list[Fitted]:
    """Hypotheses with another law in a part's place, fitted from where each imitates most of it.

    Args:
        search: that ended.
        state: its end.
        k: the part's place.

    Raises:
        BudgetSpent: where the budget ends.
    """
    data, best, settings = search.data, state.best, search.settings
    label = best.hypothesis[k].candidate.label
    search.notify(f"what else could be {label}", best.label)
    rest = (*best.hypothesis[:k], *best.hypothesis[k + 1 :])
    begin = (data.theta_of(best.fit.theta, rest), best.fit.starts)
    try:
        without = data.coarse_fit(rest, [begin], best.noise, 0, settled=best.labels)
    except SimulationDiverged:  # so nothing is known of what it changes
        return []
    without = replace(without, noise=best.noise)
    known = {label} | _settled(state, k)
    pool = [c for c in search.allowed_candidates(state.tried) if c.label not in known]
    least = max(IMITATES * _changed(search, without, best), 1e-300)
    screened = [s for s in screen(data, without, pool) if s.gains.estimated >= least]
    chosen = sorted(screened, key=lambda s: -s.gains.estimated)[:MOST_IMITATORS]
    noise = white_noise(best.fit.residuals)
    reach = settings.kept_share * (state.without[k].deviance - best.deviance) + settings.kept_gain

    def fitted(imitator: Screened) -> Fitted | None:
        begins, steps = [(imitator.begin, best.fit.starts)], settings.coarse_steps
        with suppress(SimulationDiverged):  # so it cannot be what happened
            quick = data.coarse_fit(imitator.hypothesis, begins, noise, steps, settled=best.labels)
            return _converged(search, quick) if quick.deviance - best.deviance < reach else None
        return None

    fits = [fit for _, fit in computer.side_by_side(data.threads, fitted, chosen)]
    return [fit for fit in fits if fit is not None]


def _converged(search: HypothesisMoves, fitted: Fitted) -> Fitted:
    """A fit that goes on as long as it gains: fits of laws of many parameters are ill-conditioned."""
    for _ in range(ROUNDS):
        after = search.data.converge(fitted)
        if fitted.deviance - after.deviance < CONVERGED_GAIN:
            break
        fitted = after
    return after if after.deviance < fitted.deviance else fitted


def _settled(state: SearchState, k: int) -> set[str]:
    """Labels of what was fitted until converged in a part's place and has no parameter but its sizes: one minimum."""
    found = set()
    for alternative in state.alternatives[k] if state.alternatives else ():
        law = alternative.hypothesis[-1].candidate
        if alternative.fit.converged and law.n_parameters == len(law.sizes):
            found.add(law.label)
    return found


def _changed(search: HypothesisMoves, without: Fitted, best: Fitted) -> float:
    """‖P c‖²: χ² by which predictions differ with a part and without it, all other parameters projected out."""
    whitened = whiten_fit(search.data.times, without.fit, best.noise)
    changes = [(b - a)[:, :, None] for a, b in zip(best.fit.residuals, without.fit.residuals, strict=True)]
    return Nuisance.of(whitened.slopes).squares_beyond(whitened.columns(search.data.times, changes)[:, 0])


def outdoes(search: HypothesisMoves, other: Fitted, best: Fitted) -> bool:
    """Whether a hypothesis scores so much better that it is taken: clearly by dimensions, or else by parameters."""
    if search.outdoes(other, best):
        return not _clearly_by_dimensions(search, best, other)
    return _clearly_by_dimensions(search, other, best)


def _clearly_by_dimensions(search: HypothesisMoves, other: Fitted, best: Fitted) -> bool:
    """Whether a hypothesis fits better by more than its further dimensions cost.

    Directions that do not count as dimensions may still gain ``Thresholds.indistinguishable``, so it has to be better
    by as much.
    """
    price, gain = math.log(search.data.n), best.deviance - other.deviance
    kept = best.labels & other.labels
    new, old = ([p for p in fit.hypothesis if p.candidate.label not in kept] for fit in (other, best))

    def enough(more: int) -> bool:
        return search.data.thresholds.decides(lambda t: gain - price * more > t.indistinguishable)

    # Dimensions take time to count, so not where even the fewest there can be decide.
    if not enough(len(new) - sum(p.candidate.n_parameters for p in old)):
        return False
    return enough(sum(_dimensions(search, other, p) for p in new) - sum(_dimensions(search, best, p) for p in old))


def _dimensions(search: HypothesisMoves, fitted: Fitted, part: Part) -> int:
    count = part.candidate.n_parameters
    return count if count == 1 else search.data.dimensions(fitted, fitted.hypothesis.index(part), count)
