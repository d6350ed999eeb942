"""Screening of candidates by the component of their response that is orthogonal to the parameters' Jacobian."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from equimus_ctrl.diagnosis.candidates import Candidate, Hypothesis, Part, model_of, with_part
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit, whiten_fit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

LOOKS, STRONG = 3, 0.03
"""How often, and the least share of the strongest direction's effect in directions that are changed."""
LEAST, MOST = 0.3, 3.0
"""Between these factors a change is taken to grow with its first parameter."""
WEAK = 1e-8
"""Directions of the free parameters weaker than this share of the strongest are not changed."""


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate at its most promising initial guess.

    Attributes:
        candidate: what.
        hypothesis: the one screened against, with the candidate added.
        begin: parameters of the model (p,) that go with it, to first order.
        gains: by how much χ² would fall, for each whitening of the residuals.
        tried: the guesses that could be added.
        strength: for each of them χ² of its change's component orthogonal to the parameters' Jacobian.
    """

    candidate: Candidate
    hypothesis: Hypothesis
    begin: Array
    gains: tuple[float, ...]
    tried: tuple[Mapping[str, float], ...]
    strength: Array


@dataclass(frozen=True, eq=False)
class _FirstOrder:
    """An initial guess.

    Attributes:
        index: its place among the entries.
        factor: by which the change is best taken.
        gains: of χ², for each weighing.
        strength: χ² of the component orthogonal to the parameters' Jacobian.
        left: the same by the first weighing.
        theta: values of the kept parameters that go with it.
        kept: which parameters stay.
    """

    index: int
    factor: float
    gains: tuple[float, ...]
    strength: float
    left: float
    theta: Array
    kept: tuple[int, ...]


def screen(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> list[Screened]:
    """Every candidate of a pool added to a fitted hypothesis, where that is possible, to first order.

    Args:
        data: what was measured.
        fitted: the hypothesis that they are added to.
        pool: the candidates.

    Returns:
        One for each that can be added, in the pool's order.
    """
    entries: list[tuple[Candidate, Hypothesis]] = []
    for candidate in pool:
        for guess in candidate.guesses:
            try:
                entries.append((candidate, with_part(data.free.model, fitted.hypothesis, Part(candidate, guess))))
            except ConfigError:  # the robot's own effects exclude it
                continue
    if not entries:
        return []
    whitened_fits = [
        whiten_fit(data.times, fitted.fit, noise) for noise in (white_noise(fitted.fit.residuals), fitted.noise)
    ]
    changes = _changes(data, fitted, entries)
    if data.policy.rescaled_guesses and (smaller := _smaller(data, whitened_fits[0], entries, changes)):
        more = _changes(data, fitted, smaller)
        entries = [*entries, *smaller]
        changes = [np.concatenate(pair, axis=2) for pair in zip(changes, more, strict=True)]
    columns = [w.columns(data.times, changes) for w in whitened_fits]
    owners = _owners(len(data.free.free), fitted.hypothesis)
    found: dict[Candidate, list[_FirstOrder]] = {}
    for kept in {_kept(owners, fitted.hypothesis, hypothesis) for _, hypothesis in entries}:
        rows = [k for k, (_, h) in enumerate(entries) if _kept(owners, fitted.hypothesis, h) == kept]
        results = [_gains(w, c[:, rows], np.array(kept)) for w, c in zip(whitened_fits, columns, strict=True)]
        for place, k in enumerate(rows):
            theta = np.array(fitted.fit.theta)[list(kept)]
            theta += results[0][3][:, place] * fitted.fit.parameters.scale[list(kept)]
            tried_now = _FirstOrder(
                k,
                float(results[0][1][place]),
                tuple(float(gain[place]) for gain, *_ in results),
                float(results[1][2][place]),
                float(results[0][2][place]),
                theta,
                kept,
            )
            found.setdefault(entries[k][0], []).append(tried_now)
    _again(data, fitted, entries, whitened_fits, columns, found)
    screened = []
    for candidate in pool:
        tried = sorted(found.get(candidate, []), key=lambda t: t.index)
        if not tried:
            continue
        best = max(tried, key=lambda t: max(t.gains))
        hypothesis = entries[best.index][1]
        part = hypothesis[-1]
        first, nothing = next(iter(part.values)), candidate.effect.grows_from()
        values = dict(part.values)
        if nothing is not None:
            values[first] = nothing + (values[first] - nothing) * best.factor
        try:
            scaled = (*hypothesis[:-1], Part(candidate, values))
            model_of(data.free.model, scaled)
        except ConfigError:
            scaled, values = hypothesis, dict(part.values)
        screened.append(
            Screened(
                candidate,
                scaled,
                np.concatenate([best.theta, list(values.values())]),
                tuple(max(t.gains[w] for t in tried) for w in range(len(whitened_fits))),
                tuple(dict(entries[t.index][1][-1].values) for t in tried),
                np.array([t.strength for t in tried]),
            )
        )
    return screened


def _smaller(
    data: Data, whitened_fit: WhitenedFit, entries: Sequence[tuple[Candidate, Hypothesis]], changes: Sequence[Array]
) -> list[tuple[Candidate, Hypothesis]]:
    """Guesses that change far more than is left, with first parameters that change about as much as that.

    Along a trial small causes add up: what one so large does says little of what one of the right size would.
    """
    beside = Nuisance.of(whitened_fit.slopes)
    left = beside.squares_beyond(whitened_fit.residual)
    columns = whitened_fit.columns(data.times, changes)
    found = []
    for k, (candidate, hypothesis) in enumerate(entries):
        nothing = candidate.effect.grows_from()
        factor = math.sqrt(left / max(beside.squares_beyond(columns[:, k]), 1e-300))
        if nothing is None or factor > LEAST:
            continue
        values = dict(hypothesis[-1].values)
        first = next(iter(values))
        values[first] = nothing + (values[first] - nothing) * factor
        try:
            scaled = (*hypothesis[:-1], Part(candidate, values))
            model_of(data.free.model, scaled)
        except ConfigError:  # below what it can be
            continue
        found.append((candidate, scaled))
    return found


def _absorbed(size: float, left: float, t: Thresholds) -> bool:
    """Whether free parameters cancel so much of a change that the remainder is mostly curvature."""
    return size > t.absorbed * left


def _again(
    data: Data,
    fitted: Fitted,
    entries: Sequence[tuple[Candidate, Hypothesis]],
    whitened_fits: Sequence[WhitenedFit],
    columns: Sequence[Array],
    found: dict[Candidate, list[_FirstOrder]],
) -> None:
    """Screen again guesses that free parameters nearly cancel, at changed parameters; better ones replace ``found``."""
    base = len(data.free.free)
    size = (columns[0] ** 2).sum(axis=0)
    scale = fitted.fit.parameters.scale[:base]
    chosen = [
        (tried, place)
        for tried in found.values()
        for place, t in enumerate(tried)
        if len(t.kept) >= base and data.thresholds.decides(partial(_absorbed, float(size[t.index]), t.left))
    ]
    if not chosen:
        return
    w = whitened_fits[0]
    # Weak directions would be bent far to fit the curvature.
    strong = np.linalg.pinv(w.slopes[:, :base], rcond=STRONG)
    kinds = {tried[place].kept for tried, place in chosen}
    beside = [{kept: Nuisance.of(v.slopes[:, list(kept)]) for kept in kinds} for v in whitened_fits]
    totals = [
        {kept: own.squares_beyond(v.residual) for kept, own in q.items()}
        for v, q in zip(whitened_fits, beside, strict=True)
    ]
    thetas = []
    for tried, place in chosen:
        change = strong @ (w.residual - columns[0][:, tried[place].index])
        thetas.append(data.free.moved(fitted.fit.theta[:base], change * scale))
    for _ in range(LOOKS):
        changes = _changes(data, fitted, [entries[tried[place].index] for tried, place in chosen], thetas)
        moved = [v.columns(data.times, changes) for v in whitened_fits]
        for k, (tried, place) in enumerate(chosen):
            t = tried[place]
            gains = tuple(
                totals[way][t.kept] - beside[way][t.kept].squares_beyond(v.residual - moved[way][:, k])
                for way, v in enumerate(whitened_fits)
            )
            theta = data.free.moved(thetas[k], strong @ (w.residual - moved[0][:, k]) * scale)
            if gains[0] > t.gains[0]:
                tried[place] = replace(t, factor=1.0, gains=gains, theta=np.concatenate([theta, t.theta[base:]]))
            thetas[k] = theta


def _changes(
    data: Data,
    fitted: Fitted,
    entries: Sequence[tuple[Candidate, Hypothesis]],
    thetas: Sequence[Array] | None = None,
) -> list[Array]:
    """For each segment (m, nj, k) by how much each entry changes what is predicted [rad]; 0 where it diverges.

    Args:
        data: what was measured.
        fitted: what is changed.
        entries: what to.
        thetas: for each entry the model's own free parameters, those of ``fitted`` by default.
    """
    data.budget.check()
    names = data.free.names
    own = fitted.fit.theta[: len(names)]
    robots: dict[bytes, Model] = {}
    models = []
    for k, (_, hypothesis) in enumerate(entries):
        theta = own if thetas is None else thetas[k]
        key = theta.tobytes()
        if key not in robots:
            robots[key] = data.free.model_at(theta)
        models.append(model_of(robots[key], hypothesis))
    # Dry friction anywhere makes the engine look for it everywhere.
    rubs = [any(isinstance(e, ForceEffect) and e.rubs for e in model.effects) for model in models]
    changes = [np.zeros((*s.measured.shape, len(entries))) for s in data.segments]
    simulator = data.coarse or data.simulator
    plain = [start[None, :] for start in fitted.fit.starts]
    reference = simulator([fitted.fit.model], data.segments, plain)
    for group in (True, False):
        rows = [k for k, rub in enumerate(rubs) if rub == group]
        if not rows:
            continue
        starts = [np.tile(start, (len(rows), 1)) for start in fitted.fit.starts]
        found = simulator([models[k] for k in rows], data.segments, starts)
        for change, predicted, before in zip(changes, found, reference, strict=True):
            moved = np.moveaxis(predicted.position - before.position, 0, -1)
            moved[:, :, ~predicted.sound] = 0.0
            moved[before.reached[0] :] = 0.0
            change[:, :, rows] = moved
    return changes


def _owners(base: int, hypothesis: Hypothesis) -> list[int]:
    """For each free parameter the part it belongs to; −1 for the model's own."""
    owners = [-1] * base
    for k, part in enumerate(hypothesis):
        owners += [k] * part.candidate.n_parameters
    return owners


def _kept(owners: Sequence[int], old: Hypothesis, new: Hypothesis) -> tuple[int, ...]:
    """Which parameters of the old hypothesis are there in the new one."""
    left = {k for k, part in enumerate(old) if any(part is other for other in new)} | {-1}
    return tuple(i for i, owner in enumerate(owners) if owner in left)


def _gains(whitened_fit: WhitenedFit, columns: Array, kept: Array) -> tuple[Array, Array, Array, Array]:
    """Gain of χ², best factor, χ² of the change itself, (p, k) change of the scaled parameters.

    The column is taken at a factor between LEAST and MOST, with the best change of the parameters.
    """
    beside = Nuisance.of(whitened_fit.slopes[:, kept])
    residual, left = beside.project_out(whitened_fit.residual), beside.project_out(columns)
    strength = (left**2).sum(axis=0)
    agreement = residual @ left
    factor = np.clip(agreement / np.maximum(strength, 1e-300), LEAST, MOST)
    gain = 2 * factor * agreement - factor**2 * strength
    moved = beside.lstsq(whitened_fit.residual[:, None] - columns * factor, WEAK)
    return gain, factor, strength, moved
