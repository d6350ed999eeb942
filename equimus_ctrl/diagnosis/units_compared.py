"""What differs between groups of trials, and between the robot and its nominal model, once a diagnosis has ended.

A difference between groups is a parameter with values of their own (``diagnosis.groups``): its evidence is the fall of
−2 ln L against one value for all, everything else refitted. A departure from the nominal model is a parameter whose
refitted value differs from the one given, by Wald's statistic (θ − θ₀)²/s², beside all effects found. All departures
together are told only where the nominal values, with the effects refitted to first order, fit worse by more than an
effect of as many parameters would have to gain, on held-out trials too: then it is another unit than the one that the
numbers are of.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np

from equimus_ctrl.diagnosis.differences import AnotherUnit, Departure, Difference
from equimus_ctrl.diagnosis.estimates import Estimate, Named
from equimus_ctrl.diagnosis.findings import estimates_of, log_p_value
from equimus_ctrl.diagnosis.fitting import Fitted, chi_squared
from equimus_ctrl.diagnosis.groups import Apart
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Part
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.identification.parameters import FreeParameters, in_group
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.models.model import Model


def differences(search: Search, end: SearchState, split: Split) -> tuple[Difference, ...]:
    """What differs between groups, the strongest evidence first; none where trials are in no groups."""
    if not (groups := groups_of(search.data.segments)):
        return ()
    apart = Apart(search, end.best)
    known = cache(partial(estimates_of, apart.data, apart.best))
    of_model = dict.fromkeys(own.name for own in apart.own if own.part is None)
    found = [_of_model(apart, name, groups, split) for name in of_model]
    for k, part in enumerate(end.best.hypothesis):
        candidate = part.candidate
        of_part = [*(name for name, _ in candidate.own), *(candidate.sizes if candidate.absent else ())]
        found += [_of_part(apart, k, name, known(k), groups, split) for name in dict.fromkeys(of_part)]
    return tuple(sorted((own for own in found if own is not None), key=lambda own: -own.gain))


def _of_model(apart: Apart, name: str, groups: Sequence[str], split: Split) -> Difference | None:
    free = apart.data.free.free
    own = {f.group: k for k, f in enumerate(free) if f.name == name}
    kept = [k for k, f in enumerate(free) if f.name != name or not f.group]
    fewer = replace(apart.data, free=FreeParameters(apart.data.free.model, tuple(free[k] for k in kept)))
    common = apart.fitted_with(fewer, apart.theta[kept], apart.best.hypothesis)
    known = model_estimates(apart.best, len(free))
    values = {group: known[own.get(group, own[""])] for group in groups}
    return _judged(apart, common, name, None, values, len(own) - 1, split)


def _of_part(
    apart: Apart, k: int, name: str, known: Mapping[str, Estimate], groups: Sequence[str], split: Split
) -> Difference | None:
    part = apart.best.hypothesis[k]
    candidate = part.candidate
    own = [pair for pair in candidate.own if pair[0] == name]
    left = tuple(pair for pair in candidate.own if pair not in own)
    gone = {in_group(*pair) for pair in own}
    alike = replace(candidate, own=left, absent=())
    common = apart.with_part(k, Part(alike, {key: v for key, v in part.values.items() if key not in gone}))
    values = {g: None if g in candidate.absent else known.get(in_group(name, g), known[name]) for g in groups}
    parameter = next(p for p in candidate.common if p.name == name)
    places = candidate.locations if not candidate.each else parameter.places
    named = Named(candidate.effect.name, places)
    return _judged(apart, common, parameter.key, named, values, max(len(own), 1), split)


def _judged(
    apart: Apart, common: Apart | None, name: str, named: Named | None, values: Mapping[str, Estimate | None],
    count: int, split: Split,
) -> Difference | None:  # fmt: skip
    """A difference with its evidence against one value for all; None where it is not accepted, or that has no fit."""
    if common is None:
        return None
    gain, search = common.best.deviance - apart.best.deviance, apart.search
    if not search.data.thresholds.decides(lambda t: gain > search.threshold(count, t)):
        return None
    holdout = HoldoutResiduals(apart.data, split, SearchState(apart.best, apart.best))
    p_value = (log_p_value(max(gain, 1e-300), count) + math.log(max(len(search.pool), 1))) / math.log(10)
    threshold, there = search.threshold(count), holdout.gain(common.best, apart.best)
    return Difference(name, named, values, gain, threshold, min(p_value, 0.0), there)


def model_estimates(best: Fitted, count: int) -> list[Estimate]:
    """The first so many parameters of a fit, with 95 % intervals within their bounds."""
    found = []
    for k, free in enumerate(best.fit.parameters.free[:count]):
        value, width = best.fit.theta[k], best.fit.uncertainty.half_width[k]
        low, high = float(value - width), float(value + width)
        if math.isfinite(width):
            low, high = max(low, free.low), min(high, free.high)
        found.append(Estimate(float(value), low, high, free.unit))
    return found


def another_unit(search: Search, end: SearchState, split: Split) -> AnotherUnit | None:
    """What of the model's parameters is not nominal; None where the nominal values fit as well.

    They do where χ² is higher with them by no more than an effect of as many parameters has to gain, or where on
    validation trials the fitted values gain less than ``Thresholds.validation_share`` of what they gain on as many of
    the samples fitted.

    Args:
        search: that ended.
        end: of it.
        split: with the validation trials.
    """
    data, best = search.data, end.best
    n = len(data.free.free)
    model = _with_nominal_values(search, best)
    if model is None:
        return None
    try:
        residuals = residuals_of(model, data.segments, data.simulator)
    except SimulationDiverged:
        return None
    before, after = (chi_squared(best.noise, data.times, r) for r in (residuals, best.fit.residuals))
    gain, thresholds = before - after, data.thresholds
    if not thresholds.decides(lambda t: gain > search.threshold(n, t)):
        return None
    there = math.nan
    if split.validation:
        holdout = HoldoutResiduals(data, split, end)
        times = [s.trial.sample_times for s in split.validation]
        pair = (holdout.residuals(own) for own in (model, best.fit.model))
        first, second = (chi_squared(best.noise, times, r) for r in pair)
        there = first - second
        share = sum(s.outputs.size for s in split.validation) / data.n
        if not thresholds.decides(lambda t: there >= t.validation_share * gain * share):
            return None
    return AnotherUnit(gain, search.threshold(n), there, _departures(search, best))


def _with_nominal_values(search: Search, best: Fitted) -> Model | None:
    """A fitted model with the nominal values of its parameters, effects refitted to first order; None where none is."""
    data, fit = search.data, best.fit
    n = len(data.free.free)
    nominal = data.free.model.parameters()  # fits may begin elsewhere
    values = np.array([nominal[f.name] for f in data.free.free])
    away = values - fit.theta[:n]
    theta = np.concatenate([values, fit.theta[n:]])
    if len(theta) > n:
        slopes, scale = whiten_fit(data.times, fit, best.noise).slopes, fit.parameters.scale
        change = np.linalg.lstsq(slopes[:, n:], -slopes[:, :n] @ (away / scale[:n]), rcond=1e-9)[0]
        theta[n:] = np.clip(theta[n:] + change * scale[n:], fit.parameters.low[n:], fit.parameters.high[n:])
    try:
        return fit.parameters.model_at(theta)
    except (ConfigError, ModelError):  # no such robot can be
        return None


def _departures(search: Search, best: Fitted) -> tuple[Departure, ...]:
    free, errors = search.data.free.free, best.fit.uncertainty.standard_error
    groups, found = groups_of(search.data.segments), list[Departure]()
    nominal = search.data.free.model.parameters()
    for f, estimate, error in zip(free, model_estimates(best, len(free)), errors, strict=False):
        if not (math.isfinite(error) and error > 0):
            continue
        statistic = ((estimate.value - nominal[f.name]) / float(error)) ** 2
        if not search.data.thresholds.decides(lambda t, s=statistic: s > search.threshold(1, t)):  # type: ignore[misc]
            continue
        elsewhere = {other.group for other in free if other.name == f.name}
        where = [f.group] if f.group else [g for g in groups if g not in elsewhere] if len(elsewhere) > 1 else [""]
        found += [Departure(f.name, group, nominal[f.name], estimate) for group in where]
    return tuple(found)
