"""Confounded effects: beside one unstructured residual force they explain nothing more."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np

from equimus_ctrl.diagnosis.candidates import Hypothesis
from equimus_ctrl.diagnosis.explained_variance import explained
from equimus_ctrl.diagnosis.force_basis import Group
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.diagnosis.residual_force import LinearisedFit, judged
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array

COORDINATES = {
    "pos": "pos", "len": "pos", "vel": "vel", "rate": "vel", "cmd": "cmd", "past": "past", "path": "past",
    "time": "time",
}  # fmt: skip
"""What a place's coordinates are, in the words of the laws there."""


def restates(group: Group, hypothesis: Hypothesis, drives_at_joints: bool) -> Literal["", "same", "more"]:
    """Whether a residual force restates a part of a hypothesis: at its place, over the coordinates of its law.

    A curve over the speed is friction of the same joint. A share of the pressure that depends on the length is a
    length-dependent area. Such forces are no simpler explanations. Drives with a fixed gear are at their joints; a
    force there that depends on more than the law says "more", one that depends on what the laws of several parts
    there depend on together says "same".
    """
    keys = re.findall(r"\b(pos|vel|len|rate|cmd|past|path|time)\b", group.depends_on)
    depends_on = {COORDINATES[key] for key in keys}
    found: Literal["", "same", "more"] = ""
    together: set[str] = set()
    for part in hypothesis:
        own, places = part.candidate.effect.depends(), set(part.candidate.locations)
        here = group.location in places or (drives_at_joints and set(group.joints) <= places)
        if own == depends_on and here:
            return "same"
        if drives_at_joints and here and own is not None and own < depends_on:
            found, together = "more", together | own
    return "same" if found and together == depends_on else found


def _stands_in(more: float, rank: int, fall: float, least: Callable[[Thresholds], float], t: Thresholds) -> bool:
    """Whether a residual force explains so much more than an effect that it may replace it."""
    return more > t.residual_gain + t.residual_price * rank and fall >= least(t)


def _adds_little(beside: float, rise: float, t: Thresholds) -> bool:
    """Whether an effect is hardly needed beside a residual force."""
    return beside < min(t.residual_gain, t.confounded_keeps * rise)


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
    fitted = at.fitted
    slopes, residual, scale = at.whitened_fit.slopes, at.whitened_fit.residual, fitted.fit.parameters.scale
    beside_all = Nuisance.of(slopes)
    own = beside_all.squares_beyond(residual)
    first = len(scale) - fitted.n_parameters
    columns_of: list[range] = []
    to_nothing: list[Array | None] = []
    for part in fitted.hypothesis:
        end = part.candidate.effect.fades_to()
        steps = [end.get(key, value) - value for key, value in part.values.items()]
        columns_of.append(range(first, first + len(steps)))
        to_nothing.append(slopes[:, columns_of[-1]] @ (steps / scale[columns_of[-1]]) if end else None)
        first += len(steps)

    def needed(chosen: Sequence[int], fall: float) -> float:
        """Least that some parts explain beside a force that replaces them; infinite where none does."""
        changes = [change for k in chosen if (change := to_nothing[k]) is not None]
        if len(changes) < len(chosen):
            return np.inf
        left = residual - np.sum(changes, axis=0)
        kept = Nuisance.of(np.delete(slopes, [i for k in chosen for i in columns_of[k]], axis=1))
        rise = kept.squares_beyond(left) - own
        if thresholds.decides(lambda t: rise < t.linear_share * fall):
            return np.inf
        hypothesis, smallest = tuple(fitted.hypothesis[k] for k in chosen), np.inf
        for group, columns in zip(at.groups, at.columns, strict=True):
            # A force over more coordinates than the law contains the law: it would always explain as much.
            if restates(group, hypothesis, drives_at_joints=True):
                continue
            force = explained(left, kept, columns, folds=at.folds)
            if not thresholds.decides(partial(_stands_in, force.gain - rise, force.rank, judged(force, at), least)):
                continue
            beside = explained(residual, beside_all, columns).gain - (force.gain - rise)
            if thresholds.decides(partial(_adds_little, beside, rise)):
                smallest = min(smallest, beside)
        return float(smallest)

    places = range(len(fitted.hypothesis))
    if len(places) > 1 and needed(places, together) < np.inf:
        return tuple(places)
    each = [needed([k], fall) for k, fall in enumerate(falls)]
    return (int(np.argmin(each)),) if each and min(each) < np.inf else ()
