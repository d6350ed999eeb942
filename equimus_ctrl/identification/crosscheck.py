"""k-fold cross-validation of fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.identification.fit import Fit, FitSettings, fit
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import joint_rmse, residuals_of
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False, repr=False)
class CrossCheck(Short):
    """Errors on held-out trials, all folds of a cross-validation together.

    Attributes:
        folds: how many fits were made, each without its share of the trials.
        rmse: (nj,) of the fits on the trials they were made without [rad].
        rmse_before: (nj,) of the initial model, on the same trials [rad].
        spread: (p,) largest difference of a parameter between the fits.
    """

    folds: int
    rmse: Array
    rmse_before: Array
    spread: Array


def cross_check(
    found: Fit,
    segments: Sequence[Segment],
    simulator: Simulator,
    folds: int,
    settings: FitSettings | None = None,
    notify: Callable[[int], None] = lambda done: None,
) -> CrossCheck | None:
    """Fit without each fold of the recordings in turn, and predict it; None where there are fewer than two recordings.

    Recordings are dealt out to the folds in turn. Every fit starts from ``found``, which saves time and leads to the
    same minimum.

    Args:
        found: the fit to all segments.
        segments: what it was made from.
        simulator: the engine.
        folds: how many at most.
        settings: how the fits search.
        notify: called with the number of folds done.
    """
    recordings = sorted({s.recording for s in segments})
    folds = min(folds, len(recordings))
    if folds < 2:
        return None
    free = tuple(
        replace(f, start=float(np.clip(v, f.low, f.high)))
        for f, v in zip(found.parameters.free, found.theta, strict=True)
    )
    begin = FreeParameters(found.model, free)
    unseen: list[Array] = []
    before: list[Array] = []
    thetas = []
    for k in range(folds):
        heldout = set(recordings[k::folds])
        own = [s for s in segments if s.recording in heldout]
        kept = [s for s in segments if s.recording not in heldout]
        rest = fit(begin, kept, simulator=simulator, settings=settings, noise=found.problem.noise)
        thetas.append(rest.theta)
        unseen += residuals_of(rest.model, own, simulator)
        before += residuals_of(found.parameters.model, own, simulator)
        notify(k + 1)
    nj = len(found.rmse)
    return CrossCheck(folds, joint_rmse(unseen)[:nj], joint_rmse(before)[:nj], np.ptp(thetas, axis=0))
