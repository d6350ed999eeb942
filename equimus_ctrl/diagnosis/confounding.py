"""Names that are but shadows: where one push without a name is put in, what was found explains nothing more."""

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
from equimus_ctrl.diagnosis.residual_force import Linear, judged
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array

COORDINATES = {
    "pos": "pos", "len": "pos", "vel": "vel", "rate": "vel", "cmd": "cmd", "past": "past", "path": "past",
    "time": "time",
}  # fmt: skip
"""What a place's coordinates are, in the words of the laws there."""


def restates(group: Group, hypothesis: Hypothesis, drives_at_joints: bool) -> Literal["", "same", "more"]:
    """Whether a push is what a part of a hypothesis says, without its name: at its place, over what its law depends on.

    A curve over the speed is friction of the same joint, a share of the pressure that depends on the length is an area
    that does: those are no simpler stories. Drives with a fixed gear are where their joints are, and a push there that
    depends on more than the law does says more; on what the laws of several parts there depend on, the same.
    """
    told = {COORDINATES[key] for key in re.findall(r"\b(pos|vel|len|rate|cmd|past|path|time)\b", group.depends_on)}
    found: Literal["", "same", "more"] = ""
    together: set[str] = set()
    for part in hypothesis:
        own, places = part.candidate.effect.depends(), set(part.candidate.locations)
        here = group.location in places or (drives_at_joints and set(group.joints) <= places)
        if own == told and here:
            return "same"
        if drives_at_joints and here and own is not None and own < told:
            found, together = "more", together | own
    return "same" if found and together == told else found


def _stands_in(more: float, rank: int, fall: float, least: Callable[[Thresholds], float], t: Thresholds) -> bool:
    """Whether a push explains so much more than an effect that it may stand in for it."""
    return more > t.residual_gain + t.residual_price * rank and fall >= least(t)


def _adds_little(beside: float, rise: float, t: Thresholds) -> bool:
    """Whether an effect is hardly needed beside a push."""
    return beside < min(t.residual_gain, t.confounded_keeps * rise)


def shadowed(
    at: Linear, falls: Sequence[float], together: float, least: Callable[[Thresholds], float], limits: Thresholds
) -> tuple[int, ...]:
    """Parts of a fitted hypothesis that explain nothing beside a push, which without them explains more than they do.

    A part's size is taken back to nothing along the motion of the whole hypothesis, all other numbers and one push
    fitted in its place. Where these do what the part did, changes cancel along that motion, and the linear model
    holds however far the numbers have to go.

    Args:
        at: the hypothesis to first order, with the pushes.
        falls: by how much χ² falls with each part, fitted.
        together: the same with all of them.
        least: what a push has to explain to be told, see ``residual_force.judged``.
        limits: the numbers that decide.

    Returns:
        All parts, where they are the shadow of one push together, or the one that is least needed beside a push.
    """
    fitted = at.fitted
    slopes, residual, scale = at.weighing.slopes, at.weighing.residual, fitted.fit.parameters.scale
    beside_all = Nuisance.of(slopes)
    own = beside_all.left(residual)
    first = len(scale) - fitted.n_parameters
    numbers: list[range] = []
    to_nothing: list[Array | None] = []
    for part in fitted.hypothesis:
        end = part.candidate.effect.fades_to()
        steps = [end.get(key, value) - value for key, value in part.values.items()]
        numbers.append(range(first, first + len(steps)))
        to_nothing.append(slopes[:, numbers[-1]] @ (steps / scale[numbers[-1]]) if end else None)
        first += len(steps)

    def needed(chosen: Sequence[int], fall: float) -> float:
        """Least that some parts explain beside a push that stands in for them; infinite where none does."""
        changes = [change for k in chosen if (change := to_nothing[k]) is not None]
        if len(changes) < len(chosen):
            return np.inf
        left = residual - np.sum(changes, axis=0)
        kept = Nuisance.of(np.delete(slopes, [i for k in chosen for i in numbers[k]], axis=1))
        rise = kept.left(left) - own
        if limits.decides(lambda t: rise < t.linear_share * fall):
            return np.inf
        hypothesis, smallest = tuple(fitted.hypothesis[k] for k in chosen), np.inf
        for group, columns in zip(at.groups, at.columns, strict=True):
            # A push over more than the law depends on has the law within it: on any robot it would always do as much.
            if restates(group, hypothesis, drives_at_joints=True):
                continue
            push = explained(left, kept, columns, folds=at.folds)
            if not limits.decides(partial(_stands_in, push.gain - rise, push.rank, judged(push, at), least)):
                continue
            beside = explained(residual, beside_all, columns).gain - (push.gain - rise)
            if limits.decides(partial(_adds_little, beside, rise)):
                smallest = min(smallest, beside)
        return float(smallest)

    places = range(len(fitted.hypothesis))
    if len(places) > 1 and needed(places, together) < np.inf:
        return tuple(places)
    each = [needed([k], fall) for k, fall in enumerate(falls)]
    return (int(np.argmin(each)),) if each and min(each) < np.inf else ()
