"""The smallest sizes at which effects would be accepted beside a hypothesis."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.findings import named_candidate
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.results import Detectable
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

ROUNDS = 4
"""So often sizes are looked at again at the smallest detectable ones that were found."""
NEAR, FAR = 1.5, 10.0
"""Factors of χ² from the threshold within which a size is not looked at again, and beyond which nothing is said of it:
what a large change of parameters cancels does not show by the curvature that a small one leaves."""
MOST_CHANGED = 30.0
"""Factor by which a size changes from one round to the next at most."""


def smallest_sizes(
    model: Model, screened: Sequence[Screened], threshold: Callable[[int], float]
) -> tuple[Detectable, ...]:
    """The smallest size of each effect that would be accepted, to first order.

    χ² of its change beyond the free parameters, ``Screened.strength``, grows with the square of the size. So from the
    guess of size a whose strength s is nearest to the acceptance threshold the smallest size is a·√(threshold/s); inf
    where no guess is within a factor ``FAR`` of it, or where the effect cannot be that large. Of an effect without a
    size it is the weakest guess that would be accepted; nan where none would.

    Args:
        model: at whose places the effects are.
        screened: each candidate alone.
        threshold: acceptance threshold of an effect with so many parameters.
    """
    smallest = []
    for s in screened:
        if s.candidate.each or s.candidate.absent:  # of which each place, and all groups, are candidates by themselves
            continue
        least, nothing = threshold(s.candidate.n_parameters), s.candidate.effect.grows_from()
        size, info = smallest_size(s, least), s.candidate.effect.parameter_info()
        key = next(iter(info))
        if nothing is not None:
            room = max(info[key]["high"] - nothing, nothing - info[key]["low"])
            size = size if is_near(s, least, FAR) and size <= room else math.inf
        unit_there = place_unit(model, info[key]["unit"], s.candidate.locations[0])
        named = named_candidate(s.candidate)
        smallest.append(Detectable(named, key, size, unit_there))
    return tuple(smallest)


def smallest_size(screened: Screened, threshold: float) -> float:
    """The value of the first parameter at which the change alone would be accepted, from the closest guess."""
    key, nothing = next(iter(screened.candidate.effect.parameter_info())), screened.candidate.effect.grows_from()
    values = np.array([guess[key] for guess in screened.tried])
    strength = np.maximum(screened.strength, 1e-300)
    if nothing is not None:
        nearest = int(np.argmin(_apart(strength, threshold)))
        return float(abs(values[nearest] - nothing) * math.sqrt(threshold / strength[nearest]))
    seen = strength >= threshold
    if not seen.any():
        return math.nan
    return float(values[seen][np.argmin(strength[seen])])


def near_threshold(
    screened: Sequence[Screened],
    threshold: Callable[[int], float],
    strengths: Callable[[Sequence[Candidate]], Sequence[Screened]],
) -> list[Screened]:
    """Candidates at guesses whose strengths are near the acceptance threshold, for a law need not be linear.

    The guess that is nearest to it is made smaller or larger, all that its influence is in proportion to, as if χ² grew
    with the square of the size; and between sizes on both sides of the threshold by halves of their ratio.

    Args:
        screened: each candidate alone.
        threshold: acceptance threshold of an effect with so many parameters.
        strengths: screens candidates.
    """
    found = {s.candidate.label: s for s in screened}
    looked_at = {s.candidate.label: _LookedAt.of(s, threshold(s.candidate.n_parameters)) for s in screened
                 if s.candidate.grows_from() and s.candidate.fades_to() and not s.candidate.each
                 and not s.candidate.absent}  # fmt: skip
    for _ in range(ROUNDS):
        again = {label: own for label, own in looked_at.items() if not own.near}
        if not again:
            break
        pool = [replace(found[label].candidate, guesses=(own.next,)) for label, own in again.items()]
        for s in strengths(pool):
            looked_at[s.candidate.label] = again[s.candidate.label].with_another(s)
    return [looked_at[label].put_into(s) if label in looked_at else s for label, s in found.items()]


def is_near(screened: Screened, threshold: float, factor: float = NEAR) -> bool:
    """Whether a guess is so strong that its size says how large the smallest detectable one is."""
    return bool(np.any(_apart(screened.strength, threshold) < math.log(factor)))


def resized(screened: Screened, threshold: float) -> dict[str, float]:
    """The guess whose strength is nearest to the threshold, all that its influence is in proportion to made smaller."""
    return _LookedAt.of(screened, threshold).next


def _scaled(screened: Screened, values: Mapping[str, float], factor: float) -> dict[str, float]:
    ends = screened.candidate.fades_to()
    return {**values, **{name: end + factor * (values[name] - end) for name, end in ends.items()}}


def _apart(strength: Array, threshold: float) -> Array:
    apart: Array = np.abs(np.log(np.maximum(strength, 1e-300) / threshold))
    return apart


@dataclass(frozen=True)
class _LookedAt:
    """One guess at several sizes.

    Attributes:
        guess: the candidate, with the guess at its own size alone.
        threshold: of χ².
        factors: of its size that were looked at, 1 first.
        strengths: for each χ².
    """

    guess: Screened
    threshold: float
    factors: tuple[float, ...]
    strengths: tuple[float, ...]

    @classmethod
    def of(cls, screened: Screened, threshold: float) -> _LookedAt:
        """The guess whose strength is nearest to the threshold."""
        nearest = int(np.argmin(_apart(screened.strength, threshold)))
        alone = replace(screened, tried=(screened.tried[nearest],), strength=screened.strength[[nearest]], whole=None)
        return cls(alone, threshold, (1.0,), (float(screened.strength[nearest]),))

    @property
    def near(self) -> bool:
        """Whether one of them is."""
        return bool(np.any(_apart(np.array(self.strengths), self.threshold) < math.log(NEAR)))

    @property
    def _next(self) -> float:
        """The factor that is looked at next."""
        tried = sorted(zip(self.factors, self.strengths, strict=True))
        above = [factor for factor, strength in tried if strength >= self.threshold]
        below = [factor for factor, strength in tried if strength < self.threshold]
        if above and below:
            (low, high) = max((f for f in below if f < above[0]), default=above[0] / MOST_CHANGED), above[0]
            return math.sqrt(low * high)
        nearest = int(np.argmin(_apart(np.array(self.strengths), self.threshold)))
        by = math.sqrt(self.threshold / max(self.strengths[nearest], 1e-300))
        return self.factors[nearest] * float(np.clip(by, 1 / MOST_CHANGED, MOST_CHANGED))

    @property
    def next(self) -> dict[str, float]:
        """The guess at the size that is looked at next."""
        return _scaled(self.guess, self.guess.tried[0], self._next)

    def with_another(self, screened: Screened) -> _LookedAt:
        """The same with what that came to."""
        strength = float(screened.strength[0])
        return replace(self, factors=(*self.factors, self._next), strengths=(*self.strengths, strength))

    def put_into(self, screened: Screened) -> Screened:
        """A candidate with these sizes of the guess as what was tried."""
        tried = tuple(_scaled(self.guess, self.guess.tried[0], factor) for factor in self.factors)
        return replace(screened, tried=tried, strength=np.array(self.strengths), whole=None)
