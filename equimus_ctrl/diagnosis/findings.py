"""What a diagnosis found, from where its search ended."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from equimus_ctrl.diagnosis.alternatives import in_place, replacement
from equimus_ctrl.diagnosis.candidates import Part
from equimus_ctrl.diagnosis.confirmation import HoldoutResiduals
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis_moves import SearchHistory, SearchState
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.diagnosis.results import Detectable, Estimate, Evidence, Finding, Named, Ranked, Verdict
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.models.model import Model

IN_WORDS = {
    "search": "more effects",
    "confirmation": "whether held-out trials confirm the effects",
    "unexplained": "what remains unexplained",
    "discretization": "the error of the physics step",
    "validation": "whether the error on held-out trials is above the noise",
    "alternatives": "what fits as well in an effect's place",
}
"""What each stage of a diagnosis looks at."""
Finely = Callable[[Fitted], Fitted]


def verdict(findings: Sequence[Finding], rest: ResidualAnalysis, decided: bool) -> Verdict:
    """In one word.

    Args:
        findings: effects named.
        rest: what they leave.
        decided: whether everything that decides findings and unexplained residuals was carried out.
    """
    if not decided:
        return "unfinished"
    if rest.unexplained:
        return "partly_explained" if findings else "unexplained"
    return "explained" if findings else "consistent"


def named_part(part: Part) -> Named:
    """What a part is and where."""
    return Named(part.candidate.effect.name, part.candidate.locations)


def equivalents(search: Search, found: SearchState, left: bool, finely: Finely) -> tuple[tuple[Named, ...], ...]:
    """For each part of the hypothesis what fits as well in its place.

    Args:
        search: that ended there.
        found: its end.
        left: whether something stays unexplained beside them.
        finely: fits with a smaller discretisation error.
    """
    equivalent = []
    for k in range(len(found.without)):
        own, tried = _equivalent(search, found, k, left, finely)
        found = replace(found, tried=tried)
        equivalent.append(own)
    return tuple(equivalent)


def findings(
    search: Search, found: SearchState, holdout: HoldoutResiduals, equivalent: Sequence[tuple[Named, ...]]
) -> tuple[Finding, ...]:
    """The parts of the hypothesis with their intervals and their evidence, the one that gains most first.

    Args:
        search: that ended there.
        found: its end.
        holdout: residuals on held-out trials.
        equivalent: see ``equivalents``; empty where nobody looked.
    """
    parts = enumerate(found.best.hypothesis)
    named = [
        Finding(
            part,
            _estimates(search.data, found.best, k),
            _evidence(search, found, holdout, k),
            equivalent[k] if equivalent else (),
        )
        for k, part in parts
    ]
    return tuple(sorted(named, key=lambda f: -f.evidence.gain))


def _evidence(search: Search, found: SearchState, holdout: HoldoutResiduals, k: int) -> Evidence:
    best, without = found.best, found.without[k]
    gain, count = without.deviance - best.deviance, best.hypothesis[k].candidate.n_parameters
    log10_p_value = (_log_p_value(gain, count) + math.log(max(len(search.pool), 1))) / math.log(10)
    return Evidence(
        gain,
        search.threshold(count),
        min(log10_p_value, 0.0),
        holdout.gain(without, best),
        holdout.share(without.fit.residuals, best.fit.residuals, found.base.fit.residuals),
        holdout.share(*(holdout.residuals(f.fit.model) for f in (without, best, found.base))),
    )


def _log_p_value(gain: float, count: int) -> float:
    """Ln P(χ²(count) > gain), by its asymptote where it is too small to be computed."""
    exact = float(chi2.logsf(gain, count))
    if math.isfinite(exact):
        return exact
    return (count / 2 - 1) * math.log(gain / 2) - gain / 2 - math.lgamma(count / 2)


def _estimates(data: Data, best: Fitted, k: int) -> dict[str, Estimate]:
    first = len(data.free.free) + sum(p.candidate.n_parameters for p in best.hypothesis[:k])
    found = {}
    for i, key in enumerate(best.hypothesis[k].values):
        free = best.fit.parameters.free[first + i]
        value, width = float(best.fit.theta[first + i]), float(best.fit.uncertainty.half_width[first + i])
        low, high = value - width, value + width
        if first + i in data.discontinuous(best.hypothesis):
            low, high = data.span(best, first + i)
        low = max(low, free.low) if math.isfinite(low) else -math.inf
        high = min(high, free.high) if math.isfinite(high) else math.inf
        found[key] = Estimate(value, low, high, free.unit)
    return found


def _equivalent(
    search: Search, found: SearchState, k: int, left: bool, finely: Finely
) -> tuple[tuple[Named, ...], SearchHistory]:
    """Alternatives that fit as well; none with more parameters, which reproduces anything simpler.

    Close ones are compared with short steps: where commands jump, discretisation errors can separate equivalent
    effects.
    """
    thresholds, gain = search.data.thresholds, found.without[k].deviance - found.best.deviance

    def margin(t: Thresholds) -> float:
        equivalent = max(t.indistinguishable, t.indistinguishable_share * gain) if left else t.indistinguishable
        return max(equivalent + search.scatter(t), t.simulation_error * search.data.n)

    def within_scatter(t: Thresholds) -> float:
        return margin(t) + t.step_scatter

    def within(alternative: Fitted, best: Fitted, most: Callable[[Thresholds], float]) -> bool:
        more = search.score(alternative) - search.score(best)
        return thresholds.decides(lambda t: more < most(t))

    own = found.best.hypothesis[k].candidate.label
    others: dict[str, Named] = {}
    alternatives, tried = in_place(search, found, k, within_scatter)
    for alternative in sorted(alternatives, key=search.score):
        other = replacement(alternative, found.without[k])
        if (
            alternative.n_parameters > found.best.n_parameters
            or other is None
            or not within(alternative, found.best, within_scatter)
        ):
            continue
        label = other.candidate.label
        if label != own and label not in others and within(finely(alternative), finely(found.best), margin):
            others[label] = named_part(other)
    return tuple(others.values()), tried


def ranking(search: Search, found: SearchState) -> tuple[Ranked, ...]:
    """All candidates alone, best first."""
    alone: dict[str, float] = {}
    for fitted in found.tried.fitted:
        if len(fitted.hypothesis) == 1:
            label = fitted.label
            alone[label] = max(alone.get(label, -math.inf), found.base.deviance - fitted.deviance)
    ranked = [
        Ranked(
            Named(s.candidate.effect.name, s.candidate.locations),
            max(s.gains[1], 0.0),
            alone.get(s.candidate.label),
            search.threshold(s.candidate.n_parameters),
        )
        for s in found.tried.first
    ]
    return tuple(sorted(ranked, key=lambda r: -max(r.fitted or 0.0, r.screened if r.fitted is None else 0.0)))


def detectable(search: Search, found: SearchState) -> tuple[Detectable, ...]:
    """The smallest size of each effect that would have been accepted."""
    smallest = []
    for s in found.tried.first:
        size = _smallest(s, search.threshold(s.candidate.n_parameters))
        key = next(iter(s.candidate.effect.parameter_info()))
        unit = s.candidate.effect.parameter_info()[key]["unit"]
        unit_there = place_unit(search.data.free.model, unit, s.candidate.locations[0])
        named = Named(s.candidate.effect.name, s.candidate.locations)
        smallest.append(Detectable(named, key, size, unit_there))
    return tuple(smallest)


def _smallest(screened: Screened, threshold: float) -> float:
    """The value of the first parameter at which the change alone would be accepted, from the closest guess."""
    key, nothing = next(iter(screened.candidate.effect.parameter_info())), screened.candidate.effect.grows_from()
    values = np.array([guess[key] for guess in screened.tried])
    strength = np.maximum(screened.strength, 1e-300)
    if nothing is not None:
        nearest = int(np.argmin(np.abs(np.log(strength / threshold))))
        return float(abs(values[nearest] - nothing) * math.sqrt(threshold / strength[nearest]))
    seen = strength >= threshold
    if not seen.any():
        return math.nan
    return float(values[seen][np.argmin(strength[seen])])


def notes(found: SearchState, split: Split, excluded: Sequence[str], not_done: Sequence[str]) -> list[str]:
    """What else a person ought to know of how the search went."""
    said = []
    if not_done:
        said.append(f"Ended before its end; not looked at: {', '.join(IN_WORDS[stage] for stage in not_done)}.")
    if excluded:
        said.append(f"Not looked for, as was asked: {', '.join(excluded)}.")
    if not split.validation:
        said.append("Nothing was held out, so nothing judged what was found but the trials that it was fitted to.")
    elif not split.test:
        said.append(
            "There is no test set (from eight trials on, or by --test), so errors are those of validation trials, "
            "which chose too."
        )
    fit = found.best.fit
    held = [f.name for f, side in zip(fit.parameters.free, fit.at_bound, strict=True) if side]
    if held:
        said.append(
            f"{', '.join(held)} ended at a bound: they may compensate missing physics, or the bounds are too narrow."
        )
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
