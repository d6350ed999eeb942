"""What initial guesses of candidates change, simulated from a fitted hypothesis and whitened: columns of screening."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
LEAST, MOST = 0.3, 3.0
"""Between these factors a change is taken to grow with its first parameter."""


@dataclass(frozen=True, eq=False)
class Responses:
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
class Guess:
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


def initial_guesses(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> list[Hypothesis]:
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


def responses_to(data: Data, fitted: Fitted, guesses: Sequence[Hypothesis]) -> Responses:
    """What the guesses change, and those rescaled whose change is far too large, see ``_smaller``."""
    whitened_fits = [
        whiten_fit(data.times, fitted.fit, noise) for noise in (white_noise(fitted.fit.residuals), fitted.noise)
    ]
    plain = [start[None, :] for start in fitted.fit.starts]
    reference = data.screening_simulator([fitted.fit.model], data.segments, plain)
    changes = changes_of(data, fitted, reference, guesses)
    if data.policy.rescaled_guesses and (smaller := _smaller(data, whitened_fits[WHITE], guesses, changes)):
        more = changes_of(data, fitted, reference, smaller)
        guesses = [*guesses, *smaller]
        changes = [np.concatenate(pair, axis=2) for pair in zip(changes, more, strict=True)]
    columns = [w.columns(data.times, changes) for w in whitened_fits]
    return Responses(data, fitted, reference, guesses, whitened_fits, columns)


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
        if (scaled := rescaled(data.free.model, hypothesis, factor)) is not None:
            smaller.append(scaled)
    return smaller


def rescaled(model: Model, hypothesis: Hypothesis, factor: float) -> Hypothesis | None:
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


def changes_of(
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


def kept_beside(base: int, old: Hypothesis, new: Hypothesis) -> tuple[int, ...]:
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
