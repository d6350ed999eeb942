"""What is left when the best hypothesis has been found: what it depends on, and whether named effects only mimic it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.diagnosis.explained import Explained, explained
from equimus_ctrl.diagnosis.fitting import Data, Fitted, whitened
from equimus_ctrl.diagnosis.flexible import Axis, Group
from equimus_ctrl.diagnosis.leftover import Flexible, Linear, change_of, flexible, linear, nuisances, owned
from equimus_ctrl.diagnosis.results import Leftover
from equimus_ctrl.types import Array

LEAST_GAIN = 40.0
"""Least fall of χ² on trials left out in turn that counts; noise alone stays below for the best of all pushes."""
LEAST_SHARE = 2.5e-3
"""The same as a share of the number of samples: two simulations of one leg differ by some of that."""
TRACE = 0.01
"""Share of all that the refitted model had in excess below which what is left is but a trace."""
INSTEAD = 0.9
"""Share of what a named effect and what is left explain, from which on a single push is believed in place of both."""
ALONE = 0.97
"""Share of what several named effects explain from which on a single push in their place is believed instead."""
MOST = 3
"""How many pushes are told at most."""
UNTOLD = 1e-4
"""Part of a push of which the free parameters leave less than this share is not told."""
POINTS = 61
CONFIDENT = 1.96


@dataclass(frozen=True, eq=False)
class Remainder:
    """What is left.

    Attributes:
        leftovers: pushes that nothing named explains, strongest first.
        superfluous: places of parts of the hypothesis that such a push explains as well or better.
    """

    leftovers: tuple[Leftover, ...]
    superfluous: tuple[int, ...]


def remainder(data: Data, base: Fitted, best: Fitted) -> Remainder:
    """Look for what a fitted hypothesis leaves.

    Args:
        data: what was measured.
        base: the model without any hypothesis.
        best: the hypothesis.
    """
    at = linear(data, best, best.noise)
    if at is None:
        return Remainder((), ())
    if _imitated(data, at):
        # Anything can be imitated by enough effects; one push that does it alone is the simpler story.
        return Remainder((), tuple(range(len(best.hypothesis))))
    taken = sum(float((w**2).sum()) for w in whitened(data, best.noise, base.fit.residuals))
    taken -= sum(float((w**2).sum()) for w in whitened(data, best.noise, best.fit.residuals))
    threshold = max(LEAST_GAIN, LEAST_SHARE * data.n)
    found: list[tuple[Flexible, Array]] = []
    extra: Array | None = None
    for _ in range(MOST):
        ranked = flexible(at, extra)
        top = ranked[0]
        whole = max(taken, 0.0) + sum(f.found.gain for f, _ in found) + top.found.gain
        if _gain(top, at) < threshold or top.found.gain < TRACE * whole:
            break
        columns = at.columns[next(k for k, g in enumerate(at.groups) if g is top.group)]
        found.append((top, columns))
        extra = columns if extra is None else np.column_stack([extra, columns])
    if not found:
        return Remainder((), ())
    superfluous = _superfluous(data, at, found[0][1]) if best.hypothesis else ()
    total = sum(f.found.gain for f, _ in found)
    told = tuple(_told(data, at, f, columns, f.found.gain / total, threshold) for f, columns in found)
    return Remainder(told, superfluous)


def _gain(top: Flexible, at: Linear) -> float:
    """On trials left out in turn; of a single trial, less what its numbers gain by chance."""
    return top.found.held_out if at.folds else top.found.gain - 3.0 * top.found.rank


def _imitated(data: Data, at: Linear) -> bool:
    """Whether one flexible push explains what several named effects do together, or one that strains its bounds."""
    parts = at.fitted.hypothesis
    if not parts or (len(parts) == 1 and not strained(data, at.fitted)):
        return False
    without = at.weighing.residual + change_of(data, at, ())
    kept = owned(data, parts, ())
    own = [i for i in range(at.weighing.slopes.shape[1]) if i not in kept]
    basis = nuisances(at.weighing.slopes[:, kept])
    changes = [change_of(data, at, parts[:k] + parts[k + 1 :]) for k in range(len(parts))]
    named = explained(without, basis, np.column_stack([*changes, at.weighing.slopes[:, own]])).gain
    best = max(explained(without, basis, columns, folds=at.folds).held_out for columns in at.columns)
    return best > ALONE * named


def strained(data: Data, fitted: Fitted) -> bool:
    """Whether a parameter of some effect ended at a bound where the effect does not vanish."""
    first = len(data.free.free)
    for part in fitted.hypothesis:
        for i, key in enumerate(part.values):
            side = int(fitted.fit.at_bound[first + i])
            harmless = side < 0 and part.candidate.effect.parameter_info()[key]["low"] == 0.0
            if side and not harmless:
                return True
        first += part.candidate.n_parameters
    return False


def _superfluous(data: Data, at: Linear, left: Array) -> tuple[int, ...]:
    """Parts in whose place one flexible push explains as much as they do together with the push that is left (N, k)."""
    found = []
    hypothesis = at.fitted.hypothesis
    slopes = at.weighing.slopes
    for k in range(len(hypothesis)):
        kept = owned(data, hypothesis, [i for i in range(len(hypothesis)) if i != k])
        own = [i for i in range(slopes.shape[1]) if i not in kept]
        change = change_of(data, at, hypothesis[:k] + hypothesis[k + 1 :])
        without = at.weighing.residual + change
        basis = nuisances(slopes[:, kept])
        named_columns = np.column_stack([change, slopes[:, own]])
        pushes = [explained(without, basis, columns, folds=at.folds) for columns in at.columns]
        best = max(pushes, key=lambda p: p.held_out if at.folds else p.gain)
        both = explained(without, basis, np.column_stack([named_columns, left])).gain
        if best.gain > INSTEAD * both:
            found.append(k)
    return tuple(found)


def _told(data: Data, at: Linear, top: Flexible, columns: Array, share: float, threshold: float) -> Leftover:
    group = top.group
    joint = _joint(at, group, top.found)
    axis = group.axes[0] if len(group.axes) == 1 else None
    x = push = band = np.empty(0)
    if axis is not None:
        x = np.linspace(*axis.range, POINTS)
        push, band = _curve(at, columns, axis, x)
    kinds = {kind for kind, _ in group.pushes}
    names = {"joint": data.free.model.morphology.joint_names, "actuator": data.free.model.morphology.actuator_names}
    places = tuple(names[kind][i] for kind, i in group.pushes)
    unit = _unit("N·m" if kinds == {"joint"} else "N", group)
    return Leftover(
        joint,
        share,
        group.depends_on,
        places,
        _gain(top, at),
        threshold,
        unit,
        axis.name if axis else "",
        axis.unit if axis else "",
        x,
        push,
        band,
    )


def _unit(push: str, group: Group) -> str:
    kind = group.factor.partition(".")[0]
    return {"": push, "vel": f"{push}·s/rad", "rate": f"{push}·s/m", "cmd": f"{push}/Pa", "len": f"{push}/m"}.get(
        kind, push
    )


def _joint(at: Linear, group: Group, found: Explained) -> str:
    """The joint on which the push works hardest, of those it acts on."""
    joints = at.fitted.fit.model.morphology.joint_names
    work = np.zeros(len(joints))
    for torque, motion in zip(group.torques(at.motions), at.motions, strict=True):
        fitted = torque @ found.coefficients
        stiff = np.maximum(np.ptp(motion.position, axis=0), 1e-6)
        work += (fitted - fitted.mean(axis=0)).std(axis=0) * stiff
    allowed = [joints.index(name) for name in group.joints]
    return joints[max(allowed, key=lambda j: work[j])]


def _curve(at: Linear, columns: Array, axis: Axis, x: Array) -> tuple[Array, Array]:
    """(n,) the push over its coordinate and half the width of its 95 % interval, both without their means.

    What the free parameters could do as well is not told by the data, and left out of both.
    """
    basis = nuisances(at.weighing.slopes)
    free = columns - basis @ (basis.T @ columns)
    strength, turn = np.linalg.eigh(free.T @ free)
    whole = float(np.linalg.eigvalsh(columns.T @ columns)[-1])
    seen = strength > UNTOLD * max(whole, 1e-300)
    residual = at.weighing.residual - basis @ (basis.T @ at.weighing.residual)
    found = (turn[:, seen].T @ (free.T @ residual)) / strength[seen]
    rows = axis.basis(x)
    rows = (rows - rows.mean(axis=0)) @ turn[:, seen]
    return rows @ found, np.asarray(CONFIDENT * np.linalg.norm(rows / np.sqrt(strength[seen]), axis=1))
