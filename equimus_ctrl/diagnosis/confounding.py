"""Confounded effects: beside one unstructured residual force they explain nothing more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from equimus_ctrl.diagnosis.explained_variance import explained
from equimus_ctrl.diagnosis.force_basis import ForceFamily
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.residual_force import LinearisedFit, judged
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array

COORDINATES = {
    "pos": "pos", "len": "pos", "vel": "vel", "rate": "vel", "cmd": "cmd", "past": "past", "path": "past",
    "time": "time",
}  # fmt: skip
"""What a place's coordinates are, in the words of the laws there."""


def same_place(family: ForceFamily, part: Part, drives_at_joints: bool) -> bool:
    """Whether a residual force acts where a part does.

    Args:
        family: the force.
        part: of a hypothesis.
        drives_at_joints: whether a force counts that acts at none but the part's joints, wherever it comes from.
    """
    places = set(part.candidate.locations)
    return family.location in places or (drives_at_joints and set(family.joints) <= places)


def coordinate_relation(part: Part, family: ForceFamily) -> Literal["none", "subset", "equal"]:
    """How the coordinates of a part's law, see ``Effect.depends``, relate to those of a residual force."""
    law, force = part.candidate.effect.depends(), _quantities(family)
    if law is None:
        return "none"
    return "equal" if law == force else "subset" if law < force else "none"


def restates(family: ForceFamily, hypothesis: Hypothesis, drives_at_joints: bool) -> Literal["", "same", "more"]:
    """Whether a residual force restates a part of a hypothesis: at its place, over the coordinates of its law.

    A curve over the speed is friction of the same joint. A share of the pressure that depends on the length is a
    length-dependent area. Such forces are no simpler explanations.

    Args:
        family: the force.
        hypothesis: with the parts.
        drives_at_joints: whether drives act at joints, with a fixed gear. A force there that depends on more than the
            law says "more"; one that depends on what the laws of several parts there depend on together says "same".
    """
    here = [part for part in hypothesis if same_place(family, part, drives_at_joints)]
    if any(coordinate_relation(part, family) == "equal" for part in here):
        return "same"
    contained = [part for part in here if coordinate_relation(part, family) == "subset"]
    if not drives_at_joints or not contained:
        return ""
    laws = [part.candidate.effect.depends() or set() for part in contained]
    return "same" if set().union(*laws) == _quantities(family) else "more"


def generalises(family: ForceFamily, part: Part) -> bool:
    """Whether a residual force at a part's joint is what its law depends on, times a function of something else."""
    if family.factor is None or not same_place(family, part, drives_at_joints=True):
        return False
    law = part.candidate.effect.depends() or set()
    return COORDINATES[family.factor.kind] in law and coordinate_relation(part, family) == "subset"


def contains_law(family: ForceFamily, hypothesis: Hypothesis) -> bool:
    """Whether a residual force at a part's joints depends on all that the part's law does: so it can do the same."""
    return any(
        same_place(family, part, drives_at_joints=True) and coordinate_relation(part, family) != "none"
        for part in hypothesis
    )


def confounded(
    at: LinearisedFit,
    falls: Sequence[float],
    together: float,
    least: Callable[[Thresholds], float],
    thresholds: Thresholds,
) -> tuple[int, ...]:
    """Parts of a fitted hypothesis that explain nothing beside a residual force that alone explains more than they.

    A part's size is reduced to nothing along the motion of the whole hypothesis, while all other parameters and one
    residual force are fitted. Where these compensate the part, the changes cancel along that motion, and the linear
    model holds however far the parameters have to go.

    Args:
        at: the hypothesis to first order, with the residual forces.
        falls: by how much χ² falls with each part, fitted.
        together: the same with all of them.
        least: gain with which a residual force is reported, see ``residual_force.judged``.
        thresholds: that decide.

    Returns:
        All parts, where they are confounded with one force together, or the one that is least needed beside a force.
    """
    removal = _Removal.of(at, least, thresholds)
    places = range(len(at.fitted.hypothesis))
    if len(places) > 1 and removal.needed(places, together) < np.inf:
        return tuple(places)
    each = [removal.needed([k], fall) for k, fall in enumerate(falls)]
    return (int(np.argmin(each)),) if each and min(each) < np.inf else ()


@dataclass(frozen=True, eq=False)
class _Removal:
    """Parts of a fitted hypothesis reduced to nothing, to first order.

    Attributes:
        at: the hypothesis.
        columns: for each part which columns of the Jacobian are its own.
        changes: for each part (N,) the change of the predictions without it; None where no value of it is nothing.
        least: see ``confounded``.
        thresholds: that decide.
        beside_all: the span of the whole Jacobian.
        chi2: of the residual without its projection onto that.
    """

    at: LinearisedFit
    columns: tuple[range, ...]
    changes: tuple[Array | None, ...]
    least: Callable[[Thresholds], float]
    thresholds: Thresholds
    beside_all: Nuisance
    chi2: float

    @classmethod
    def of(cls, at: LinearisedFit, least: Callable[[Thresholds], float], thresholds: Thresholds) -> _Removal:
        """Of every part of a hypothesis."""
        fitted, slopes = at.fitted, at.whitened_fit.slopes
        scale = fitted.fit.parameters.scale
        beside_all = Nuisance.of(slopes)
        first = len(scale) - fitted.n_parameters
        columns: list[range] = []
        changes: list[Array | None] = []
        for part in fitted.hypothesis:
            end = part.candidate.fades_to()
            steps = [end.get(key, value) - value for key, value in part.values.items()]
            columns.append(range(first, first + len(steps)))
            changes.append(slopes[:, columns[-1]] @ (steps / scale[columns[-1]]) if end else None)
            first += len(steps)
        chi2 = beside_all.squares_beyond(at.whitened_fit.residual)
        return cls(at, tuple(columns), tuple(changes), least, thresholds, beside_all, chi2)

    def needed(self, places: Sequence[int], fall: float) -> float:
        """Least that some parts explain beside a force that replaces them; infinite where none does.

        Args:
            places: of the parts.
            fall: of χ² with them, fitted.
        """
        changes = [change for k in places if (change := self.changes[k]) is not None]
        if len(changes) < len(places):
            return np.inf
        without = self.at.whitened_fit.residual - np.sum(changes, axis=0)
        removed = [i for k in places for i in self.columns[k]]
        kept = Nuisance.of(np.delete(self.at.whitened_fit.slopes, removed, axis=1))
        rise = kept.squares_beyond(without) - self.chi2
        if self.thresholds.decides(lambda t: rise < t.linear_share * fall):
            return np.inf
        hypothesis = tuple(self.at.fitted.hypothesis[k] for k in places)
        gains = [
            self._beside(columns, without, kept, rise)
            for family, columns in zip(self.at.families, self.at.columns, strict=True)
            # A force over more coordinates than the law contains the law: it would always explain as much.
            if not contains_law(family, hypothesis)
        ]
        return min(gains, default=np.inf)

    def _beside(self, columns: Array, without: Array, kept: Nuisance, rise: float) -> float:
        """What parts explain beside a force; infinite where it does not replace them.

        Args:
            columns: (N, k) of the force.
            without: (N,) residual without the parts.
            kept: the span of the other parameters.
            rise: of χ² without the parts.
        """
        force = explained(without, kept, columns, folds=self.at.folds)
        more = force.gain - rise
        if not self.thresholds.decides(partial(_replaces_effect, more, force.rank, judged(force, self.at), self.least)):
            return np.inf
        beside = explained(self.at.whitened_fit.residual, self.beside_all, columns).gain - more
        return float(beside) if self.thresholds.decides(lambda t: beside < t.residual_gain) else np.inf


def _replaces_effect(more: float, rank: int, fall: float, least: Callable[[Thresholds], float], t: Thresholds) -> bool:
    """Whether a residual force explains so much more than an effect that it may replace it."""
    return more > t.residual_gain + t.residual_price * rank and fall >= least(t)


def _quantities(family: ForceFamily) -> set[str]:
    """What a residual force depends on, in the words of laws."""
    return {COORDINATES[coordinate.kind] for coordinate in family.coordinates}
