"""Whether what a law is named for is dry friction of one angle more than of another.

Dry friction about one angle is imitated by others: by static friction where the joint rests there, by a memory of the
actuator across it. So at each joint at which one named law acts by itself, dry friction of any size over the angle
(``effects.smooth.SmoothFriction``) is fitted beside the hypothesis. The law is another one where that friction in its
place gains more by ``Thresholds.generalised_share`` of what the law gains, where the law beside it gains less than as
much, and where validation trials confirm the one in the place of the other. A friction law that it could be stays where
the size that is found is that law's own, give or take ``Thresholds.no_constant`` of its square.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from equimus_ctrl.diagnosis.confirmation import carried_over, confirms
from equimus_ctrl.diagnosis.coordinates import Coordinate
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.forces_beside import (
    CONFIDENT,
    alone_at,
    along,
    another_law,
    asked_in_torques,
    fitted_without,
    force_of,
    share_beyond,
)
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.residuals import ResidualForce
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects.smooth import SmoothFriction
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.types import Array

COVERED = (0.02, 0.98)
"""Quantiles of the measured angles between which the knots are: what is seldom passed says little."""
SIZES = (0.01, 0.03, 0.1, 0.3)
"""Of the force that moves the joint through its range, with which fits begin."""
REFINED = 4
"""Times that knots are moved to where the friction is."""
CLOSER = 3
"""Times that they are closer together there then."""
PEAKS = 2
"""Angles at which that is tried."""
EVEN = 0.1
"""Share of even knots in those that follow the samples: none coincide."""


@dataclass(frozen=True, eq=False)
class FrictionOverAngle:
    """Dry friction of any size over the angle, in the place of a named law.

    Attributes:
        joint: where.
        fitted: the hypothesis with it and without the law.
        gain: −2Δln L by it in the place of the law.
    """

    joint: str
    fitted: Fitted
    gain: float

    def told(self, search: Search) -> ResidualForce:
        """Of a report, as the force at a positive speed; without a curve where recordings do not determine it all."""
        model, part, axis = search.data.free.model, self.fitted.hypothesis[-1], Coordinate("pos", self.joint)
        given, uncertainty = part.candidate.given, self.fitted.fit.uncertainty
        x = knots_in(part.candidate)
        band = CONFIDENT * given["force_scale"] * uncertainty.standard_error[-len(x) :]
        known = bool(np.all(np.isfinite(band)))
        return ResidualForce(
            location=self.joint,
            share=1.0,
            coordinates=(axis, Coordinate("vel", self.joint, sign=True)),
            places=(self.joint,),
            gain=self.gain,
            threshold=search.threshold(part.candidate.n_parameters),
            unit=place_unit(model, "N·m", self.joint),
            axis=axis if known else None,
            axis_unit=place_unit(model, "rad", self.joint) if known else "",
            x=x if known else np.empty(0),
            force=0.0 - given["force_scale"] * self.fitted.fit.theta[-len(x) :] if known else np.empty(0),
            band=band if known else np.empty(0),
        )


def friction_in_place(search: Search, state: SearchState, split: Split) -> Mapping[int, FrictionOverAngle]:
    """Places of parts of the best hypothesis that are rather friction over the angle, with it; one at a joint at most.

    Args:
        search: that ended.
        state: the end.
        split: with the validation trials.

    Raises:
        BudgetSpent: where the budget ends.
    """
    best, found = state.best, dict[int, FrictionOverAngle]()
    holdout = HoldoutResiduals(search.data, split, state)
    parts = alone_at(search, best)

    def counts(gain: float, fall: float) -> bool:
        return search.data.thresholds.decides(partial(_counts, gain, fall))

    candidates = {_candidate(search, joint): joint for joint in parts}
    for candidate in asked_in_torques(search, best, list(candidates)):
        joint = candidates[candidate]
        beside = _fitted(search, best, candidate)
        if beside is None:
            continue
        falls = {k: state.without[k].deviance - best.deviance for k in parts[joint]}
        asked = [k for k, fall in falls.items() if counts(best.deviance - beside.deviance, fall)]
        if not asked:
            continue
        beside = _refined(search, best, beside)
        rather = dict[int, FrictionOverAngle]()
        for k in asked:
            own = fitted_without(search, beside, beside.hypothesis[:k] + beside.hypothesis[k + 1 :])
            if own is None:
                continue
            own = _refined(search, state.without[k], own)
            if not search.data.thresholds.decides(partial(_replaces, best, beside, own, falls[k])):
                continue
            if _is_the_same(search, own, best.hypothesis[k], joint):
                continue
            if not split.validation or confirms(search, carried_over(search, holdout, best, own)):
                rather[k] = FrictionOverAngle(joint, own, best.deviance - own.deviance)
        if rather:
            most = max(rather, key=lambda k: rather[k].gain)
            found[most] = rather[most]
    return found


def _counts(gain: float, fall: float, t: Thresholds) -> bool:
    return gain > t.generalised_share * fall


def _replaces(best: Fitted, beside: Fitted, own: Fitted, fall: float, t: Thresholds) -> bool:
    """Whether friction over the angle alone gains that more than a law, which gains less than that beside it."""
    return _counts(best.deviance - own.deviance, fall, t) and not _counts(own.deviance - beside.deviance, fall, t)


def _fitted(search: Search, best: Fitted, candidate: Candidate) -> Fitted | None:
    """Friction over the angle fitted beside a hypothesis; None where it gains too little, or diverges.

    It begins at nothing, at one size everywhere, and at that about one angle, whatever is best.
    """
    data, n = search.data, candidate.n_parameters
    about = [np.ones(n), *(np.eye(n)[k] + np.eye(n)[k + 1] for k in range(n - 1))]
    values = [np.zeros(n), *(share / max(SIZES) * own for share in SIZES for own in about)]
    hypothesis: Hypothesis = (*best.hypothesis, Part(candidate, dict(SmoothFriction.neutral)))
    begin = [(np.append(best.fit.theta, own), best.fit.starts) for own in values]
    try:
        fitted = data.coarse_fit(hypothesis, begin, best.noise, search.settings.long_steps)
        return data.converge(fitted) if search.accepts(best, fitted) else None
    except SimulationDiverged:
        return None


def _refined(search: Search, before: Fitted, fitted: Fitted) -> Fitted:
    """The same with knots closer together where the friction is largest, as long as it gains that much more.

    Args:
        search: that ended.
        before: the hypothesis without friction over the angle.
        fitted: the same with it.
    """
    for _ in range(REFINED):
        sizes = fitted.fit.theta[-fitted.hypothesis[-1].candidate.n_parameters :]
        others = [_closer(search, fitted, sizes, k) for k in largest(sizes)]
        best = min((other for other in others if other), key=lambda f: f.deviance, default=fitted)
        more, whole = fitted.deviance - best.deviance, before.deviance - best.deviance
        if more <= 0 or not search.data.thresholds.decides(partial(_counts, more, whole)):
            break
        fitted = best
    return fitted


def _closer(search: Search, fitted: Fitted, sizes: Array, k: int) -> Fitted | None:
    """The same with knots closer together about one of them; None where it diverges.

    It begins as it was, and with a spot there of several widths, once and twice as high.
    """
    data, candidate, n = search.data, fitted.hypothesis[-1].candidate, len(sizes)
    knots = knots_in(candidate)
    gap = float(np.gradient(knots)[k])
    closer = knots_about(knots[k], gap / CLOSER, knots[0], knots[-1], n)
    at = int(np.argmin(np.abs(closer - knots[k])))
    as_it_was = np.interp(closer, knots, sizes)
    far = np.where(np.abs(closer - knots[k]) < gap, 0.0, as_it_was)
    spots = [np.isin(np.arange(n), range(at - left, at + right + 1)) for left in (0, 1) for right in (0, 1)]
    own = [as_it_was, *(far + times * sizes[k] * spot for times in (1, 2) for spot in spots)]
    there = replace(candidate, given={**candidate.given, **_given(closer)})
    hypothesis: Hypothesis = (*fitted.hypothesis[:-1], Part(there, dict(SmoothFriction.neutral)))
    begin = [(np.append(fitted.fit.theta[:-n], one), fitted.fit.starts) for one in own]
    try:
        return data.converge(data.coarse_fit(hypothesis, begin, fitted.noise, search.settings.long_steps))
    except SimulationDiverged:
        return None


def largest(sizes: Array) -> list[int]:
    """The places of the largest local maxima of sizes (k,), of those that are more than nothing."""
    beside = np.maximum(np.append(sizes[1:], 0.0), np.append(0.0, sizes[:-1]))
    peaks = np.flatnonzero((sizes > 0) & (sizes >= beside))
    return [int(k) for k in peaks[np.argsort(-sizes[peaks], kind="stable")][:PEAKS]]


def knots_about(centre: float, width: float, low: float, high: float, count: int) -> Array:
    """(count,) increasing knots from ``low`` to ``high``, one of them at a centre, even in asinh((x − centre)/width).

    So their gaps are about a width near the centre and grow with the distance from there.
    """
    first, last = np.arcsinh((low - centre) / width), np.arcsinh((high - centre) / width)
    inner = np.linspace(first, last, count)[1:-1]
    if first < 0 < last:
        inner[np.argmin(np.abs(inner))] = 0.0
    return np.concatenate([[low], centre + width * np.sinh(inner), [high]])


def _candidate(search: Search, joint: str) -> Candidate:
    """Friction over the angles that were measured."""
    x, _ = along(search, joint)
    force = excitation_of(search.data.free.model, search.data.segments)[joint].force
    given = {**_given(knots_of(x, len(SmoothFriction.neutral))), "force_scale": max(max(SIZES) * force, 1e-9)}
    return Candidate(SmoothFriction, (joint,), (dict(SmoothFriction.neutral),), given=given)


def _given(knots: Array) -> dict[str, float]:
    return {f"x{k}": float(own) for k, own in enumerate(knots, 1)}


def knots_in(candidate: Candidate) -> Array:
    """(k,) the knots of friction over the angle."""
    return np.array([candidate.given[f"x{k}"] for k in range(1, candidate.n_parameters + 1)])


def knots_of(x: Array, count: int) -> Array:
    """(count,) increasing knots over positions x, closer where more of these are.

    Half of what is between two is a share of the samples, half one of the range: at most twice as far apart as even
    ones.
    """
    low, high = np.quantile(x, COVERED)
    high = max(float(high), float(low) + 1e-9)
    inside = np.sort(np.clip(x, low, high))
    level = (np.arange(1, len(inside) + 1) / len(inside) + (inside - low) / (high - low)) / 2
    found = np.interp(np.linspace(0.0, 1.0, count), level, inside)
    ends = np.linspace(low, high, count)
    return np.asarray((1 - EVEN) * found + EVEN * ends)


def _is_the_same(search: Search, fitted: Fitted, part: Part, joint: str) -> bool:
    """Whether friction over the angle is a friction law at its joint, whatever size that has."""
    if joint not in part.candidate.locations or not part.candidate.effect.dry:
        return False
    x, rate = along(search, joint)
    whole = force_of(fitted.hypothesis[-1], joint, x, rate)
    own = force_of(part, joint, x, rate)
    return not search.data.thresholds.decides(partial(another_law, share_beyond(whole, own[:, None])))
