"""Guesses that the model's parameters nearly cancel, looked at again with these moved along, as a fit moves them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis import guessed_changes
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.guessed_changes import ESTIMATED, WHITE, Guess, Responses
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit
from equimus_ctrl.types import Array

LOOKS = 3
"""How often a guess that the parameters nearly cancel is simulated at changed parameters: Newton's steps, of which each
squares what is left."""
STRONG = 0.03
"""Directions of the parameters weaker than this share of the strongest are not changed then: derivatives do not hold as
far as they would have to move. It says where fits begin, no more, as the next two do."""


def rescreened(responses: Responses, evaluated: Mapping[Candidate, Sequence[Guess]]) -> dict[int, Guess]:
    """By their index, guesses that the parameters nearly cancel, where a second look gains more.

    Such a change is simulated together with the change of the model's parameters that cancels it: θ ← θ + S⁺(r − c),
    c of what both change, by the Jacobian S at the fit (chord method), LOOKS times. Where fits have few minima, only
    what a look improved is looked at again: what the chord method leads away from, it does not come back to.
    """
    data, fitted, columns = responses.data, responses.fitted, responses.columns
    base, scale = len(data.free.free), fitted.fit.parameters.scale[: len(data.free.free)]
    size = (columns[WHITE] ** 2).sum(axis=0)
    chosen = _nearly_cancelled(data, evaluated, size, base, WHITE)
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
    replacements: dict[int, Guess] = {}
    for _ in range(LOOKS):
        moved = [thetas[guess.index] for guess in chosen]
        hypotheses = [responses.guesses[guess.index] for guess in chosen]
        changes = guessed_changes.changes_of(data, fitted, responses.reference, hypotheses, moved)
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


def strengths_left(responses: Responses, evaluated: Mapping[Candidate, Sequence[Guess]]) -> dict[int, float]:
    """By their index, of guesses that the parameters nearly cancel, χ² of what is left once these are moved along.

    θ ← θ − S⁺c, c of what both change, by the Jacobian S at the fit (chord method), LOOKS times; the least counts.
    """
    data, fitted = responses.data, responses.fitted
    base, scale = len(data.free.free), fitted.fit.parameters.scale[: len(data.free.free)]
    whitened, columns = responses.whitened_fits[ESTIMATED], responses.columns[ESTIMATED]
    size = (columns**2).sum(axis=0)
    chosen = _nearly_cancelled(data, evaluated, size, base, ESTIMATED)
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
        changes = guessed_changes.changes_of(data, fitted, responses.reference, hypotheses, thetas)
        changed = whitened.columns(data.times, changes)
        for k, guess in enumerate(chosen):
            left = spans[guess.kept].squares_beyond(changed[:, k])
            found[guess.index] = min(found[guess.index], left)
    return found


def _nearly_cancelled(
    data: Data, evaluated: Mapping[Candidate, Sequence[Guess]], size: Array, base: int, whitening: int
) -> list[Guess]:
    """Guesses whose change parameters cancel so much of that the remainder is mostly curvature.

    Args:
        data: with the thresholds.
        evaluated: guesses of each candidate.
        size: ‖c‖² of each guess' change.
        base: how many parameters the model has, which all have to be kept.
        whitening: by which ‖Pc‖² of the remainder is meant.
    """

    def cancelled(guess: Guess) -> bool:
        beyond, whole = guess.strengths[whitening], float(size[guess.index])
        return data.thresholds.decides(lambda t: whole > t.absorbed * beyond)

    guesses = (guess for own in evaluated.values() for guess in own)
    return [guess for guess in guesses if len(guess.kept) >= base and cancelled(guess)]


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
