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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.guessed_changes import (
    ESTIMATED,
    LEAST,
    MOST,
    WHITE,
    Guess,
    Responses,
    initial_guesses,
    kept_beside,
    rescaled,
    responses_to,
)
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.moved_parameters import rescreened, strengths_left
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit
from equimus_ctrl.types import Array

PROMISING = 2
"""Guesses of a candidate at which its fit may begin, the best ones."""
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
        others: (p,) each, θ at which a fit may begin as well: to first order the change of a law that begins somewhere,
            such as a dead zone's, grows evenly from nothing on, and the best size by that may be where it does nothing.
    """

    candidate: Candidate
    hypothesis: Hypothesis
    begin: Array
    gains: ScreenedGains
    tried: tuple[Mapping[str, float], ...]
    strength: Array
    whole: Array | None = None
    others: tuple[Array, ...] = ()

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
            return [self.begin, *self.others]
        change, own = self.begin - start, np.arange(len(start)) >= len(start) - last.candidate.n_parameters
        alone = [start + SHORTER[-1] * own * change] if many_minima else []
        return [self.begin, *(start + share * change for share in SHORTER), *alone, *self.others]


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
class _Begun:
    """The guesses of a pool's candidates, simulated and evaluated.

    Attributes:
        responses: what they change.
        evaluated: those of each candidate that can be added, with their first-order gains.
    """

    responses: Responses
    evaluated: Mapping[Candidate, Sequence[Guess]]

    @classmethod
    def of(cls, data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> _Begun | None:
        """Of candidates added to a fitted hypothesis; None where none can be."""
        guesses = initial_guesses(data, fitted, pool)
        if not guesses:
            return None
        responses = responses_to(data, fitted, guesses)
        return cls(responses, _evaluated(responses))

    def in_order(self, pool: Sequence[Candidate]) -> Iterator[tuple[Candidate, list[Guess]]]:
        """Those of the pool that can be added, each with its guesses, all in their order."""
        for candidate in pool:
            if candidate in self.evaluated:
                yield candidate, sorted(self.evaluated[candidate], key=lambda guess: guess.index)


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
    if (begun := _Begun.of(data, fitted, pool)) is None:
        return []
    replacements = rescreened(begun.responses, begun.evaluated)
    return [
        _selected(begun.responses, candidate, [replacements.get(g.index, g) for g in of_it])
        for candidate, of_it in begun.in_order(pool)
    ]


def screen_strengths(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> list[Screened]:
    """The same for what candidates change, whatever the residuals: their strengths alone are what they say.

    The strength of a guess that the parameters nearly cancel is that with these moved along, as a fit would move them.

    Raises:
        BudgetSpent: where the budget ends.
    """
    if (begun := _Begun.of(data, fitted, pool)) is None:
        return []
    moved = strengths_left(begun.responses, begun.evaluated)
    whole, found = (begun.responses.columns[ESTIMATED] ** 2).sum(axis=0), []
    for candidate, of_it in begun.in_order(pool):
        own = [replace(g, strengths=(g.strengths[WHITE], moved.get(g.index, g.strengths[ESTIMATED]))) for g in of_it]
        screened = _selected(begun.responses, candidate, own)
        found.append(replace(screened, whole=whole[[guess.index for guess in own]]))
    return found


def _evaluated(responses: Responses) -> dict[Candidate, list[Guess]]:
    """The guesses of each candidate with their first-order gains.

    They are evaluated in groups that keep the same parameters, for a guess may exclude parts of the hypothesis.
    """
    fitted, guesses = responses.fitted, responses.guesses
    base = len(responses.data.free.free)
    kept_by = [kept_beside(base, fitted.hypothesis, guess) for guess in guesses]
    scale = fitted.fit.parameters.scale
    evaluated: dict[Candidate, list[Guess]] = {}
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
            guess = Guess(
                k,
                float(by_whitening[WHITE].factor[place]),
                tuple(float(gains.gain[place]) for gains in by_whitening),
                tuple(float(gains.strength[place]) for gains in by_whitening),
                theta,
                kept,
            )
            evaluated.setdefault(guesses[k][-1].candidate, []).append(guess)
    return evaluated


def _selected(responses: Responses, candidate: Candidate, guesses: Sequence[Guess]) -> Screened:
    """A candidate at the guess with the largest gain by either whitening, its size the best to first order."""
    best, *less = sorted(guesses, key=lambda guess: -max(guess.gains))
    hypothesis = responses.guesses[best.index]
    scaled = rescaled(responses.data.free.model, hypothesis, best.factor) or hypothesis
    others = [_as_guessed(responses, best)] if best.factor != 1.0 else []
    for guess in less[: PROMISING - 1]:
        own = responses.guesses[guess.index]
        if max(guess.gains) > 0 and guess.kept == best.kept and own[:-1] == hypothesis[:-1]:
            smaller = rescaled(responses.data.free.model, own, guess.factor) or own
            others.append(np.concatenate([guess.theta, list(smaller[-1].values.values())]))
            others += [_as_guessed(responses, guess)] if guess.factor != 1.0 else []
    return Screened(
        candidate,
        scaled,
        np.concatenate([best.theta, list(scaled[-1].values.values())]),
        ScreenedGains(*(max(guess.gains[w] for guess in guesses) for w in (WHITE, ESTIMATED))),
        tuple(dict(responses.guesses[guess.index][-1].values) for guess in guesses),
        np.array([guess.strengths[ESTIMATED] for guess in guesses]),
        others=tuple(others),
    )


def _as_guessed(responses: Responses, guess: Guess) -> Array:
    """(p,) θ at the size that was guessed, the parameters kept moved with it to first order."""
    start = np.array(responses.fitted.fit.theta)[list(guess.kept)]
    values = list(responses.guesses[guess.index][-1].values.values())
    return np.concatenate([start + (guess.theta - start) / guess.factor, values])


def _gains(whitened_fit: WhitenedFit, columns: Array, kept: Array) -> _FirstOrderGains:
    """First-order gains of changes (N, k) beside the kept parameters (indices in θ), see the module's law.

    A parameter at an active bound stays there, or goes back inside where a change has it do so.
    """
    white = whitened_fit.narrowed(kept)
    within = Nuisance.of(white.movable)
    found = _gains_beside(within, white.residual, columns)
    if white.movable is white.slopes:
        return found
    anywhere = Nuisance.of(white.slopes)
    free = _gains_beside(anywhere, white.residual, columns)
    crossed = within.squares_beyond(white.residual) - anywhere.squares_beyond(white.residual)
    inside = white.inside(free.change)
    return _FirstOrderGains(
        np.where(inside, free.gain + crossed, found.gain),
        np.where(inside, free.factor, found.factor),
        free.strength,
        np.where(inside, free.change, found.change),
    )


def _gains_beside(nuisance: Nuisance, residual: Array, columns: Array) -> _FirstOrderGains:
    """The same beside the span of some derivatives."""
    along = nuisance.basis.T @ columns
    left, beyond = nuisance.project_out(residual), columns - nuisance.basis @ along
    strength = np.einsum("nk,nk->k", beyond, beyond)
    agreement = left @ beyond
    factor = np.clip(agreement / np.maximum(strength, 1e-300), LEAST, MOST)
    gain = 2 * factor * agreement - factor**2 * strength
    change = nuisance.solution((nuisance.basis.T @ residual)[:, None] - along * factor, WEAK)
    return _FirstOrderGains(gain, factor, strength, change)
