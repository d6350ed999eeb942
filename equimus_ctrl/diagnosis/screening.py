"""Screening of candidates by the component of their response that is orthogonal to the parameters' Jacobian.

To first order the residual r of a fit falls to r − c·f − S·δ where a candidate is added: c is the simulated change of
predictions at an initial guess, f a factor on its size, S the Jacobian of the parameters and initial states, δ their
change. With P = I − QQᵀ, Q the span of S, the best f = rᵀPc / cᵀPc lets χ² fall by 2f·rᵀPc − f²·cᵀPc.

All of this is whitened twice. By white noise as large as the residuals, χ² falls by N times the share of residual
variance that is explained: what is large counts. By the noise estimated, which may be autocorrelated, χ² is on the
scale of the deviance that fits are scored by: neighbouring residuals that are alike count little, what is consistent
counts. While physics is missing that estimate takes some of it for noise, so neither ranking does alone; the best of
both are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, model_of, with_part
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit, whiten_fit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

WHITE, ESTIMATED = 0, 1
"""The two whitenings: by white noise as large as the residuals, and by the noise estimated."""
LOOKS = 3
"""How often a guess that the parameters nearly cancel is simulated at changed parameters: Newton's steps, of which each
squares what is left."""
STRONG = 0.03
"""Directions of the parameters weaker than this share of the strongest are not changed then: derivatives do not hold as
far as they would have to move. It says where fits begin, no more, as the next two do."""
LEAST, MOST = 0.3, 3.0
"""Between these factors a change is taken to grow with its first parameter."""
SHORTER = (0.5, 0.25)
"""Shares of a change to first order at which a fit may begin too, where the whole of it leads too far."""
WEAK = 1e-8
"""Directions of the parameters weaker than this share of the strongest are not changed at all."""


class ScreenedGains(NamedTuple):
    """By how much χ² of a candidate would fall, by each of the two whitenings."""

    white: float
    estimated: float


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate at its most promising initial guess.

    Attributes:
        candidate: what.
        hypothesis: the one screened against, with the candidate added.
        begin: (p,) θ that goes with it, to first order.
        gains: by how much χ² would fall.
        tried: the guesses that could be added.
        strength: for each of them χ² of its orthogonal component, by the noise estimated.
        whole: likewise χ² of all that it changes; None where nobody asked for strengths alone.
    """

    candidate: Candidate
    hypothesis: Hypothesis
    begin: Array
    gains: ScreenedGains
    tried: tuple[Mapping[str, float], ...]
    strength: Array
    whole: Array | None = None

    def begins(self, data: Data, fitted: Fitted, many_minima: bool) -> list[Array]:
        """(p,) each, θ to first order; beside other parts also part of the way there from no effect of the last one.

        The whole change may lead to a worse fit than none of it: other parts bend what is first order. In a direction
        that these hardly tell it leads far, into another minimum where there are many: then the last one leaves all but
        the last part where it is.

        Args:
            data: what was measured.
            fitted: the hypothesis screened against.
            many_minima: of fits, see ``SearchSettings``.
        """
        last = self.hypothesis[-1]
        nothing = Part(last.candidate, {**last.values, **last.candidate.fades_to()})
        start = data.theta_of(fitted.fit.theta, (*self.hypothesis[:-1], nothing))
        if not fitted.hypothesis or not last.candidate.fades_to():
            return [self.begin]
        change, own = self.begin - start, np.arange(len(start)) >= len(start) - last.candidate.n_parameters
        alone = [start + SHORTER[-1] * own * change] if many_minima else []
        return [self.begin, *(start + share * change for share in SHORTER), *alone]


@dataclass(frozen=True, eq=False)
class _Responses:
    """A fitted hypothesis and what each guess changes, whitened.

    Attributes:
        data: what was measured.
        fitted: the hypothesis.
        reference: for each segment what it predicts, by the engine that the guesses are simulated with.
        guesses: it with one more part each, at an initial guess.
        whitened_fits: its residual and Jacobian, for each whitening.
        columns: for each whitening (N, k) changes of predictions by the guesses.
    """

    data: Data
    fitted: Fitted
    reference: Sequence[Predicted]
    guesses: Sequence[Hypothesis]
    whitened_fits: Sequence[WhitenedFit]
    columns: Sequence[Array]


@dataclass(frozen=True, eq=False)
class _FirstOrderGains:
    """First-order gains of k guesses by one whitening, each at its best factor between LEAST and MOST.

    Attributes:
        gain: (k,) fall of χ².
        factor: (k,) f.
        strength: (k,) cᵀPc.
        change: (p, k) of θ in units of its scale.
    """

    gain: Array
    factor: Array
    strength: Array
    change: Array


@dataclass(frozen=True, eq=False)
class _Guess:
    """An initial guess, evaluated.

    Attributes:
        index: its place among the guesses.
        factor: by which its change is best taken.
        gains: fall of χ², for each whitening.
        strengths: χ² of the orthogonal component, for each whitening.
        theta: values of the kept parameters that go with it.
        kept: indices in the fitted θ of those that stay.
    """

    index: int
    factor: float
    gains: tuple[float, ...]
    strengths: tuple[float, ...]
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

    Raises:
        BudgetSpent: where the budget ends.
    """
    guesses = _initial_guesses(data, fitted, pool)
    if not guesses:
        return []
    responses = _responses(data, fitted, guesses)
    evaluated = _evaluated(responses)
    replacements = _rescreened_at_changed_parameters(responses, evaluated)
    screened = []
    for candidate in pool:
        if candidate in evaluated:
            of_it = sorted(evaluated[candidate], key=lambda guess: guess.index)
            screened.append(_selected(responses, candidate, [replacements.get(g.index, g) for g in of_it]))
    return screened


def screen_strengths(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> list[Screened]:
    """The same for what candidates change, whatever the residuals: their strengths alone are what they say.

    The strength of a guess that the parameters nearly cancel is that with these moved along, as a fit would move them.

    Raises:
        BudgetSpent: where the budget ends.
    """
    guesses = _initial_guesses(data, fitted, pool)
    if not guesses:
        return []
    responses = _responses(data, fitted, guesses)
    evaluated = _evaluated(responses)
    moved = _strengths_at_changed_parameters(responses, evaluated)
    whole, found = (responses.columns[ESTIMATED] ** 2).sum(axis=0), []
    for candidate in pool:
        if candidate in evaluated:
            of_it = sorted(evaluated[candidate], key=lambda guess: guess.index)
            own = [
                replace(g, strengths=(g.strengths[WHITE], moved.get(g.index, g.strengths[ESTIMATED]))) for g in of_it
            ]
            screened = _selected(responses, candidate, own)
            found.append(replace(screened, whole=whole[[guess.index for guess in own]]))
    return found


def _initial_guesses(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> list[Hypothesis]:
    """The hypothesis with one more part, for all initial guesses of all candidates that it can have."""
    guesses = []
    present = set(_adds(fitted.hypothesis))
    for candidate in pool:
        if present.issuperset(_adds([Part(candidate, {})])):
            continue
        for values in candidate.guesses:
            try:
                guesses.append(with_part(data.free.model, fitted.hypothesis, Part(candidate, values)))
            except ConfigError:  # the robot's own effects exclude it
                continue
    return guesses


def _responses(data: Data, fitted: Fitted, guesses: Sequence[Hypothesis]) -> _Responses:
    """What the guesses change, and those rescaled whose change is far too large, see ``_smaller``."""
    whitened_fits = [
        whiten_fit(data.times, fitted.fit, noise) for noise in (white_noise(fitted.fit.residuals), fitted.noise)
    ]
    plain = [start[None, :] for start in fitted.fit.starts]
    reference = data.screening_simulator([fitted.fit.model], data.segments, plain)
    changes = _changes(data, fitted, reference, guesses)
    if data.policy.rescaled_guesses and (smaller := _smaller(data, whitened_fits[WHITE], guesses, changes)):
        more = _changes(data, fitted, reference, smaller)
        guesses = [*guesses, *smaller]
        changes = [np.concatenate(pair, axis=2) for pair in zip(changes, more, strict=True)]
    columns = [w.columns(data.times, changes) for w in whitened_fits]
    return _Responses(data, fitted, reference, guesses, whitened_fits, columns)


def _evaluated(responses: _Responses) -> dict[Candidate, list[_Guess]]:
    """The guesses of each candidate with their first-order gains.

    They are evaluated in groups that keep the same parameters, for a guess may exclude parts of the hypothesis.
    """
    fitted, guesses = responses.fitted, responses.guesses
    base = len(responses.data.free.free)
    kept_by = [_kept(base, fitted.hypothesis, guess) for guess in guesses]
    scale = fitted.fit.parameters.scale
    evaluated: dict[Candidate, list[_Guess]] = {}
    for kept in dict.fromkeys(kept_by):
        rows = [k for k, own in enumerate(kept_by) if own == kept]

        own_columns = [c if len(rows) == c.shape[1] else c[:, rows] for c in responses.columns]
        by_whitening = computer.in_threads(
            responses.whitened_fits[WHITE].threads, partial(_gains, kept=np.array(kept)), responses.whitened_fits,
            own_columns,
        )  # fmt: skip
        for place, k in enumerate(rows):
            theta = np.array(fitted.fit.theta)[list(kept)]
            theta += by_whitening[WHITE].change[:, place] * scale[list(kept)]
            guess = _Guess(
                k,
                float(by_whitening[WHITE].factor[place]),
                tuple(float(gains.gain[place]) for gains in by_whitening),
                tuple(float(gains.strength[place]) for gains in by_whitening),
                theta,
                kept,
            )
            evaluated.setdefault(guesses[k][-1].candidate, []).append(guess)
    return evaluated


def _selected(responses: _Responses, candidate: Candidate, guesses: Sequence[_Guess]) -> Screened:
    """A candidate at the guess with the largest gain by either whitening, its size the best to first order."""
    best = max(guesses, key=lambda guess: max(guess.gains))
    hypothesis = responses.guesses[best.index]
    scaled = _rescaled(responses.data.free.model, hypothesis, best.factor) or hypothesis
    return Screened(
        candidate,
        scaled,
        np.concatenate([best.theta, list(scaled[-1].values.values())]),
        ScreenedGains(*(max(guess.gains[w] for guess in guesses) for w in (WHITE, ESTIMATED))),
        tuple(dict(responses.guesses[guess.index][-1].values) for guess in guesses),
        np.array([guess.strengths[ESTIMATED] for guess in guesses]),
    )


def _rescaled(model: Model, hypothesis: Hypothesis, factor: float) -> Hypothesis | None:
    """The hypothesis, the size of its last part so many times as far from the value of no effect.

    None where there is no such value, or where the size cannot be that large or small.
    """
    part = hypothesis[-1]
    if not (nothing := part.candidate.grows_from()):
        return None
    values = {**part.values, **{name: v + (part.values[name] - v) * factor for name, v in nothing.items()}}
    scaled = (*hypothesis[:-1], Part(part.candidate, values))
    try:
        model_of(model, scaled)
    except ConfigError:
        return None
    return scaled


def _smaller(
    data: Data, whitened_fit: WhitenedFit, guesses: Sequence[Hypothesis], changes: Sequence[Array]
) -> list[Hypothesis]:
    """Guesses that change far more than the residual, rescaled so that they would change about as much.

    Along a trial small causes add up: what one so large does says little of what one of the right size would.
    """
    nuisance = Nuisance.of(whitened_fit.slopes)
    squares = nuisance.squares_beyond(whitened_fit.residual)
    columns = whitened_fit.columns(data.times, changes)
    smaller = []
    for k, hypothesis in enumerate(guesses):
        factor = math.sqrt(squares / max(nuisance.squares_beyond(columns[:, k]), 1e-300))
        if factor > LEAST:
            continue
        if (scaled := _rescaled(data.free.model, hypothesis, factor)) is not None:
            smaller.append(scaled)
    return smaller


def _nearly_cancelled(data: Data, size: float, beyond: float) -> bool:
    """Whether parameters cancel so much of a change that the remainder is mostly curvature.

    Args:
        data: with the thresholds.
        size: ‖c‖² of the change.
        beyond: ‖Pc‖² of the remainder.
    """
    return data.thresholds.decides(lambda t: size > t.absorbed * beyond)


def _rescreened_at_changed_parameters(
    responses: _Responses, evaluated: Mapping[Candidate, Sequence[_Guess]]
) -> dict[int, _Guess]:
    """By their index, guesses that the parameters nearly cancel, where a second look gains more.

    Such a change is simulated together with the change of the model's parameters that cancels it: θ ← θ + S⁺(r − c),
    c of what both change, by the Jacobian S at the fit (chord method), LOOKS times. Where fits have few minima, only
    what a look improved is looked at again: what the chord method leads away from, it does not come back to.
    """
    data, fitted, columns = responses.data, responses.fitted, responses.columns
    base, scale = len(data.free.free), fitted.fit.parameters.scale[: len(data.free.free)]
    size = (columns[WHITE] ** 2).sum(axis=0)
    chosen = [
        guess
        for guesses in evaluated.values()
        for guess in guesses
        if len(guess.kept) >= base and _nearly_cancelled(data, float(size[guess.index]), guess.strengths[WHITE])
    ]
    if not chosen:
        return {}
    white = responses.whitened_fits[WHITE]
    # Weak directions would be changed far to fit the curvature.
    inverse = np.linalg.pinv(white.slopes[:, :base], rcond=STRONG)
    squares = [_Squares.of(w, {guess.kept for guess in chosen}) for w in responses.whitened_fits]
    steps = [inverse @ (white.residual - columns[WHITE][:, guess.index]) for guess in chosen]
    thetas = {
        g.index: data.free.moved(fitted.fit.theta[:base], step * scale) for g, step in zip(chosen, steps, strict=True)
    }
    replacements: dict[int, _Guess] = {}
    for _ in range(LOOKS):
        moved = [thetas[guess.index] for guess in chosen]
        hypotheses = [responses.guesses[guess.index] for guess in chosen]
        changes = _changes(data, fitted, responses.reference, hypotheses, moved)
        changed = [w.columns(data.times, changes) for w in responses.whitened_fits]
        again = []
        for k, guess in enumerate(chosen):
            gains = tuple(s.gain(guess.kept, c[:, k]) for s, c in zip(squares, changed, strict=True))
            theta = data.free.moved(moved[k], inverse @ (white.residual - changed[WHITE][:, k]) * scale)
            improved = gains[WHITE] > replacements.get(guess.index, guess).gains[WHITE]
            if improved:
                whole = np.concatenate([theta, guess.theta[base:]])
                replacements[guess.index] = replace(guess, factor=1.0, gains=gains, theta=whole)
            if improved or data.policy.many_minima:
                thetas[guess.index] = theta
                again.append(guess)
        if not (chosen := again):
            break
    return replacements


def _strengths_at_changed_parameters(
    responses: _Responses, evaluated: Mapping[Candidate, Sequence[_Guess]]
) -> dict[int, float]:
    """By their index, of guesses that the parameters nearly cancel, χ² of what is left once these are moved along.

    θ ← θ − S⁺c, c of what both change, by the Jacobian S at the fit (chord method), LOOKS times; the least counts.
    """
    data, fitted = responses.data, responses.fitted
    base, scale = len(data.free.free), fitted.fit.parameters.scale[: len(data.free.free)]
    whitened, columns = responses.whitened_fits[ESTIMATED], responses.columns[ESTIMATED]
    size = (columns**2).sum(axis=0)
    chosen = [
        guess
        for guesses in evaluated.values()
        for guess in guesses
        if len(guess.kept) >= base and _nearly_cancelled(data, float(size[guess.index]), guess.strengths[ESTIMATED])
    ]
    if not chosen:
        return {}
    inverse = np.linalg.pinv(whitened.slopes[:, :base], rcond=STRONG)
    spans = {kept: Nuisance.of(whitened.slopes[:, list(kept)]) for kept in {guess.kept for guess in chosen}}
    changed = columns[:, [guess.index for guess in chosen]]
    thetas = [fitted.fit.theta[:base]] * len(chosen)
    found = {guess.index: guess.strengths[ESTIMATED] for guess in chosen}
    for _ in range(LOOKS):
        thetas = [data.free.moved(t, -(inverse @ c) * scale) for t, c in zip(thetas, changed.T, strict=True)]
        hypotheses = [responses.guesses[guess.index] for guess in chosen]
        changed = whitened.columns(data.times, _changes(data, fitted, responses.reference, hypotheses, thetas))
        for k, guess in enumerate(chosen):
            left = spans[guess.kept].squares_beyond(changed[:, k])
            found[guess.index] = min(found[guess.index], left)
    return found


@dataclass(frozen=True, eq=False)
class _Squares:
    """Sums of squares orthogonal to the Jacobian of kept parameters, by one whitening.

    Attributes:
        residual: (N,) r.
        nuisance: for each set of kept parameters the span of their Jacobian.
        total: for each ‖Pr‖².
    """

    residual: Array
    nuisance: Mapping[tuple[int, ...], Nuisance]
    total: Mapping[tuple[int, ...], float]

    @classmethod
    def of(cls, whitened_fit: WhitenedFit, kinds: Collection[tuple[int, ...]]) -> _Squares:
        """Of some sets of kept parameters."""
        nuisance = {kept: Nuisance.of(whitened_fit.slopes[:, list(kept)]) for kept in kinds}
        total = {kept: span.squares_beyond(whitened_fit.residual) for kept, span in nuisance.items()}
        return cls(whitened_fit.residual, nuisance, total)

    def gain(self, kept: tuple[int, ...], change: Array) -> float:
        """‖Pr‖² − ‖P(r − c)‖² of a change c (N,)."""
        return self.total[kept] - self.nuisance[kept].squares_beyond(self.residual - change)


def _changes(
    data: Data,
    fitted: Fitted,
    reference: Sequence[Predicted],
    guesses: Sequence[Hypothesis],
    thetas: Sequence[Array] | None = None,
) -> list[Array]:
    """For each segment (m, nj, k) by how much each guess changes predictions [rad or m]; 0 where it diverges.

    Args:
        data: what was measured.
        fitted: what is changed.
        reference: for each segment what that predicts.
        guesses: what to.
        thetas: for each guess the model parameters, those of ``fitted`` by default.
    """
    present = fitted.fit.theta[: len(data.free.free)]
    models = _models(data, guesses, [present] * len(guesses) if thetas is None else thetas)
    kinds = [_kind(model) for model in models]
    changes = [np.zeros((*s.outputs.shape, len(guesses))) for s in data.segments]
    for kind in dict.fromkeys(kinds):
        data.budget.check()
        rows = [k for k, own in enumerate(kinds) if own == kind]
        starts = [np.tile(start, (len(rows), 1)) for start in fitted.fit.starts]
        after = data.screening_simulator([models[k] for k in rows], data.segments, starts)
        for change, predicted, before in zip(changes, after, reference, strict=True):
            moved = np.moveaxis(predicted.position - before.position, 0, -1)
            moved[:, :, ~predicted.sound] = 0.0
            moved[before.reached[0] :] = 0.0
            change[:, :, rows] = moved
    return changes


def _kind(model: Model) -> tuple[bool, tuple[str, ...]]:
    """Of what is simulated together: whether there is dry friction, and which effects have equations of their own.

    Dry friction anywhere makes the engine look for it everywhere. Equations that are not compiled yet take seconds, so
    a budget is asked before each.
    """
    own = {e.name for e in model.effects if e.own_equations and not model.robot.traits.keeps_states_of_laws}
    return any(e.rubs for e in model.effects), tuple(sorted(own))


def _models(data: Data, guesses: Sequence[Hypothesis], thetas: Sequence[Array]) -> list[Model]:
    """The model with each guess at its parameters; what has the same parameters shares the robot."""
    robots: dict[bytes, Model] = {}
    for theta in thetas:
        if (key := theta.tobytes()) not in robots:
            robots[key] = data.free.model_at(theta)
    return [model_of(robots[theta.tobytes()], guess) for theta, guess in zip(thetas, guesses, strict=True)]


def _kept(base: int, old: Hypothesis, new: Hypothesis) -> tuple[int, ...]:
    """Which parameters of a hypothesis stay beside one more part, as indices in its θ.

    Args:
        base: how many the model itself has.
        old: the hypothesis.
        new: with the part, which is the last.
    """
    stays = set(_adds(new[:-1]))
    return (*range(base), *(base + i for i, own in enumerate(_adds(old)) if own in stays))


def _adds(hypothesis: Sequence[Part]) -> list[tuple[str, tuple[str, ...], str, str]]:
    """The parameters that a hypothesis adds, each by its effect, where it acts, what it is, and in which trials."""
    parts = (part.candidate for part in hypothesis)
    return [(c.effect.name, own.places, own.key, own.group) for c in parts for own in c.parameters]


def _gains(whitened_fit: WhitenedFit, columns: Array, kept: Array) -> _FirstOrderGains:
    """First-order gains of changes (N, k) beside the kept parameters (indices in θ), see the module's law."""
    nuisance = Nuisance.of(whitened_fit.slopes[:, kept])
    along = nuisance.basis.T @ columns
    residual, beyond = nuisance.project_out(whitened_fit.residual), columns - nuisance.basis @ along
    strength = np.einsum("nk,nk->k", beyond, beyond)
    agreement = residual @ beyond
    factor = np.clip(agreement / np.maximum(strength, 1e-300), LEAST, MOST)
    gain = 2 * factor * agreement - factor**2 * strength
    change = nuisance.solution((nuisance.basis.T @ whitened_fit.residual)[:, None] - along * factor, WEAK)
    return _FirstOrderGains(gain, factor, strength, change)
