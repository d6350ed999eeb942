"""What a diagnosis found, from where its search ended."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtrc, chdtri

from equimus_ctrl.diagnosis.alternatives import in_place, replacement
from equimus_ctrl.diagnosis.curved_intervals import curved_ends
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.guessed_changes import ESTIMATED
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.results import (
    Equivalent,
    Estimate,
    Evidence,
    Finding,
    Named,
    Ranked,
    Verdict,
)
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.fit import FitSettings
from equimus_ctrl.identification.parameters import in_group
from equimus_ctrl.identification.results import zeros_sentence
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.models.model import Model

Finely = Callable[[Fitted], Fitted]
"""Fits with a smaller discretisation error, from where a fit ended."""


def verdict(findings: Sequence[Finding], unexplained: bool, settled: bool) -> Verdict:
    """In one word.

    Args:
        findings: effects named.
        unexplained: whether something is missing beside them that has no name.
        settled: whether all stages that findings and unexplained residuals depend on were carried out.
    """
    if not settled:
        return "unfinished"
    if unexplained:
        return "partly_explained" if findings else "unexplained"
    return "explained" if findings else "consistent"


def named_part(part: Part) -> Named:
    """The effect of a part and its places."""
    return named_candidate(part.candidate)


def named_candidate(candidate: Candidate) -> Named:
    """The effect of a candidate and its places."""
    return Named(candidate.effect.name, candidate.locations, candidate.each)


def equivalents(
    search: Search, end: SearchState, unexplained: bool, finely: Finely
) -> tuple[tuple[Equivalent, ...], ...]:
    """For each part of the hypothesis what fits as well in its place, or better.

    Args:
        search: that ended there.
        end: of the search.
        unexplained: whether something stays unexplained beside the parts.
        finely: fits with a smaller discretisation error.

    Raises:
        BudgetSpent: where the budget ends.
    """
    equivalent = []
    for k in range(len(end.without)):
        others, tried = _equivalent(search, end, k, unexplained, finely)
        end = replace(end, tried=tried)
        equivalent.append(others)
    return tuple(equivalent)


def findings(
    search: Search, end: SearchState, holdout: HoldoutResiduals, equivalent: Sequence[Sequence[Equivalent]]
) -> tuple[Finding, ...]:
    """The parts of the hypothesis with their intervals and their evidence, the one that gains most first.

    Args:
        search: that ended there.
        end: of the search.
        holdout: residuals on held-out trials.
        equivalent: see ``equivalents``; empty where nobody looked.

    Raises:
        BudgetSpent: where the budget ends while an interval is profiled.
    """
    found = []
    for k, part in enumerate(end.best.hypothesis):
        estimates, evidence = estimates_of(search.data, end.best, k), _evidence(search, end, holdout, k)
        others = tuple(other.named for other in equivalent[k]) if equivalent else ()
        candidate = part.candidate
        for places in [(place,) for place in candidate.locations] if candidate.each else [candidate.locations]:
            own = {p.key: estimates[p.name] for p in candidate.common if set(p.places) & set(places)}
            why = _undetermined(search.data, end.best, k, estimates, places)
            alone, law = (part.narrowed(places), part) if candidate.each else (part, None)
            by_group = _by_group(candidate, places, estimates, groups_of(search.data.segments))
            found.append(Finding(alone, own, evidence, others, law, why, by_group))
    return tuple(sorted(found, key=lambda f: -f.evidence.gain))


def _by_group(
    candidate: Candidate, places: Sequence[str], estimates: Mapping[str, Estimate], groups: Sequence[str]
) -> dict[str, dict[str, Estimate]]:
    """A part's parameters at some places in each group of trials, see ``Finding.by_group``."""
    here = [p for p in candidate.common if set(p.places) & set(places)]
    if not candidate.absent and not any(in_group(p.name, group) in estimates for p in here for group in groups):
        return {}
    return {
        group: {p.key: estimates.get(in_group(p.name, group), estimates[p.name]) for p in here}
        if group not in candidate.absent
        else {}
        for group in groups
    }


def _undetermined(data: Data, best: Fitted, k: int, estimates: Mapping[str, Estimate], places: Sequence[str]) -> str:
    """Why the parameters of a part at some of its places are not identifiable; "" where they are.

    A parameter at a bound where the effect does not vanish says that the law is strained, or another one. An interval
    that covers all that the parameter can be says nothing of it. Where no direction of its parameters is seen beside
    the others, it stands for these: a gain for masses. Where some are, what it is is known, though not each number.
    """
    candidate = best.hypothesis[k].candidate
    first = len(data.free.free) + sum(p.candidate.n_parameters for p in best.hypothesis[:k])
    info = candidate.effect.parameter_info()
    here = [(i, own) for i, own in enumerate(candidate.parameters) if set(own.places) & set(places)]
    names = {best.fit.parameters.free[first + i].label for i, _ in here}
    if data.aliased(best, k, names):
        return "other parameters can do the same, beyond their bounds"
    for i, own in here:
        free, side, estimate = (
            best.fit.parameters.free[first + i],
            int(best.fit.at_bound[first + i]),
            estimates[own.name],
        )
        unit = "" if free.unit == "1" else f" {free.unit}"
        seen = math.isfinite(float(best.fit.uncertainty.standard_error[first + i]))
        if side and seen and not (side < 0 and info[own.key]["low"] == 0.0):
            return f"{own.key} is at its bound of {estimate.value:.4g}{unit}"
        covered = estimate.high - estimate.low
        if math.isfinite(covered) and data.thresholds.decides(partial(_covers, covered / (free.high - free.low))):
            between = f"{free.low:.4g} to {free.high:.4g}{unit}"
            return f"the interval of {own.key} covers what it can be, {between}"
    return ""


def _covers(share: float, t: Thresholds) -> bool:
    return share > t.covered


def _evidence(search: Search, end: SearchState, holdout: HoldoutResiduals, k: int) -> Evidence:
    best, without = end.best, end.without[k]
    gain, count = without.deviance - best.deviance, best.hypothesis[k].candidate.n_parameters
    log10_p_value = (log_p_value(gain, count) + math.log(max(len(search.pool), 1))) / math.log(10)
    alone = _alone(end, best.hypothesis[k].candidate.label)
    share_alone, validation_alone = math.nan, math.nan
    if alone is not None:
        share_alone = holdout.share(end.base.fit.residuals, alone.fit.residuals, end.base.fit.residuals)
        base, only = (holdout.residuals(f.fit.model) for f in (end.base, alone))
        validation_alone = holdout.share(base, only, base)
    return Evidence(
        gain=gain,
        threshold=search.threshold(count),
        log10_p_value=min(log10_p_value, 0.0),
        validation_gain=holdout.gain(without, best),
        share=holdout.share(without.fit.residuals, best.fit.residuals, end.base.fit.residuals),
        validation_share=holdout.share(*(holdout.residuals(f.fit.model) for f in (without, best, end.base))),
        share_alone=share_alone,
        validation_share_alone=validation_alone,
    )


def _alone(end: SearchState, label: str) -> Fitted | None:
    """The best fit with a part as the only one; None where the search has made none."""
    fits = [f for f in (end.best, *end.without, *end.tried.fitted) if f.labels == frozenset({label})]
    return min(fits, key=lambda f: f.deviance, default=None)


def log_p_value(gain: float, count: int) -> float:
    """Ln P(χ²(k) > g), by its asymptote (k/2 − 1)·ln(g/2) − g/2 − ln Γ(k/2) where it is too small to be computed.

    Args:
        gain: g.
        count: k.
    """
    if gain <= 0:
        return 0.0
    exact = float(chdtrc(count, gain))
    if exact > 0.0:
        return math.log(exact)
    return (count / 2 - 1) * math.log(gain / 2) - gain / 2 - math.lgamma(count / 2)


def estimates_of(data: Data, best: Fitted, k: int) -> dict[str, Estimate]:
    """The parameters of a part of the hypothesis with 95 % intervals [unit of each].

    θ ± t·s by Student's t, see ``identification.uncertainty``, or by profile likelihood where the predictions jump, see
    ``Data.span``, or bend, see ``curved_ends``. They are clipped at the parameters' bounds, and ±inf where there is no
    end.

    Raises:
        BudgetSpent: where the budget ends while an interval is profiled.
    """
    first = len(data.free.free) + sum(p.candidate.n_parameters for p in best.hypothesis[:k])
    parameters, jumps = best.hypothesis[k].candidate.parameters, data.discontinuous(best.hypothesis)
    known = np.isfinite(best.fit.uncertainty.half_width)
    smooth = [i for i in range(first, first + len(parameters)) if known[i] and i not in jumps]
    ends, estimates = curved_ends(data, best, smooth), {}
    for i, own in enumerate(parameters):
        free = best.fit.parameters.free[first + i]
        value, width = float(best.fit.theta[first + i]), float(best.fit.uncertainty.half_width[first + i])
        low, high = ends.get((first + i, -1), value - width), ends.get((first + i, 1), value + width)
        if first + i in jumps:
            low, high = data.span(best, first + i)
        low = max(low, free.low) if math.isfinite(low) else -math.inf
        high = min(high, free.high) if math.isfinite(high) else math.inf
        estimates[own.name] = Estimate(value, low, high, free.unit)
    return estimates


def _equivalent(
    search: Search, end: SearchState, k: int, unexplained: bool, finely: Finely
) -> tuple[tuple[Equivalent, ...], SearchHistory]:
    """Alternatives that fit as well or better.

    What a parameter does that others do as well makes a law no richer, see ``Data.dimensions``: a spring to a point of
    the room has four, of which one hinge shows one. A law with more dimensions reproduces anything simpler. It is
    listed where it fits better than chance would let it, with the confidence of all intervals, and Schwarz's cost of
    its dimensions does not decide; or where held-out trials say nothing of it, see ``SearchState.undecided``. Close
    ones are compared with short steps: where commands jump, discretisation errors can separate equivalent effects.
    """
    thresholds, gain = search.data.thresholds, end.without[k].deviance - end.best.deviance

    def margin(t: Thresholds) -> float:
        return search.equally_good(t, t.indistinguishable_share * gain if unexplained else 0.0)

    def within_scatter(t: Thresholds) -> float:
        return margin(t) + t.step_scatter

    def worse(alternative: Fitted, best: Fitted) -> float:
        fewer = max(best.n_parameters - alternative.n_parameters, 0)
        return alternative.deviance - best.deviance - fewer * math.log(search.data.n)

    def within(more: float, most: Callable[[Thresholds], float]) -> bool:
        return thresholds.decides(lambda t: more < most(t))

    def more_dimensions(alternative: Fitted, part: Part) -> int:
        own = part.candidate.n_parameters
        room = end.best.n_parameters - (alternative.n_parameters - own)
        seen = partial(search.data.dimensions, alternative, alternative.hypothesis.index(part))
        if own <= room:
            return 0
        return max(seen(own if beyond_chance(alternative, 1) else room) - room, 0)

    def beyond_chance(alternative: Fitted, dimensions: int) -> bool:
        return end.best.deviance - alternative.deviance > float(chdtri(dimensions, 1 - FitSettings().confidence))

    label = end.best.hypothesis[k].candidate.label
    others, tried = _undecided(search, end, k)
    alternatives, tried = in_place(search, replace(end, tried=tried), k, within_scatter)
    for alternative in sorted(alternatives, key=search.score):
        part = replacement(alternative, end.without[k])
        if part is None or not within(worse(alternative, end.best), within_scatter):
            continue
        other = part.candidate.label
        if named_part(part) == named_part(end.best.hypothesis[k]):  # in other groups of trials
            continue
        if other == label or other in others:
            continue
        richer = more_dimensions(alternative, part)
        if richer and not beyond_chance(alternative, richer):
            continue
        more = worse(finely(alternative), finely(end.best)) + richer * math.log(search.data.n)
        if within(more, margin):
            # Whether it is better is decided; by how much is told by the thresholds as they are.
            better = 0.0 if within(-more, margin) else -more - margin(thresholds)
            others[other] = Equivalent(named_part(part), alternative, better)
    return tuple(others.values()), tried


def _undecided(search: Search, end: SearchState, k: int) -> tuple[dict[str, Equivalent], SearchHistory]:
    """By their labels richer laws in the k-th part's place of which held-out trials say nothing."""
    parts, tried = end.best.hypothesis, end.tried
    others: dict[str, Equivalent] = {}
    for own in end.undecided:
        if own.simple == parts[k].candidate.label and tried.allows([own.rich.candidate]):
            fits, tried = search.refitted(tried, end.best, (*parts[:k], *parts[k + 1 :], own.rich))
            for fitted in fits:
                others[own.rich.candidate.label] = Equivalent(named_part(own.rich), fitted)
    return others, tried


def ranking(search: Search, end: SearchState) -> tuple[Ranked, ...]:
    """All candidates alone, by what they gain in −2 ln L, fitted or else to first order, the best first."""
    alone: dict[str, float] = {}
    for fitted in end.tried.fitted:
        if len(fitted.hypothesis) == 1:
            label = fitted.label
            alone[label] = max(alone.get(label, -math.inf), end.base.deviance - fitted.deviance)
    ranked = [
        Ranked(
            named_candidate(s.candidate),
            max(s.gains[ESTIMATED], 0.0),
            alone.get(s.candidate.label),
            search.threshold(s.candidate.n_parameters),
        )
        for s in end.tried.first
        if not s.candidate.absent
    ]
    return tuple(sorted(ranked, key=lambda r: -max(r.fitted or 0.0, r.screened if r.fitted is None else 0.0)))


def notes(end: SearchState, split: Split, excluded: Sequence[str], not_done: Sequence[str]) -> list[str]:
    """What else a person ought to know of how the search went.

    Args:
        end: of the search.
        split: of the trials.
        excluded: names of effects that were not looked for.
        not_done: what was not looked at, in words.
    """
    said = []
    if not_done:
        said.append(f"Ended before its end; not looked at: {', '.join(not_done)}.")
    if excluded:
        said.append(f"Not looked for, as was asked: {', '.join(excluded)}.")
    if split.of > len(split.train):
        said.append(
            f"Fitted were {len(split.train)} of {split.of} shooting intervals, fast and slow ones of all recordings: "
            "all would take longer in proportion."
        )
    if not split.validation:
        said.append("Nothing was held out, so nothing judged what was found but the trials that it was fitted to.")
    elif not split.test:
        said.append(
            "There is no test set (from eight trials on, or by --test), so errors are those of validation trials, "
            "which chose too."
        )
    fit = end.best.fit
    held = [f.label for f, side in zip(fit.parameters.free, fit.at_bound, strict=True) if side]
    if held:
        said.append(
            f"{', '.join(held)} ended at a bound: this may compensate missing physics, or the bounds are too narrow."
        )
    if zeros := zeros_sentence(fit):
        said.append(zeros)
    if not fit.converged:
        said.append("The last fit was stopped before it had converged.")
    return said


def beyond_range(model: Model, split: Split) -> list[str]:
    """Where commands leave the range beyond which a simulation clips them: the robot need not."""
    said = []
    for name, (low, high) in model.robot.clipped_commands().items():
        column = model.robot.actuator_names.index(name)
        commands = np.concatenate([s.trial.commands[:, column] for s in (*split.train, *split.validation, *split.test)])
        if commands.min() < low or commands.max() > high:
            said.append(
                f"Commands of {name} go from {commands.min():.4g} to {commands.max():.4g}, beyond the XML's "
                f"ctrlrange of {low:.4g} to {high:.4g}: MuJoCo clips them there, which the robot need not do."
            )
    return said
