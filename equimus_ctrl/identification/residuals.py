"""What was measured less what is predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from equimus_ctrl.engines.batch import Predicted
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

DIVERGED = 3.0
"""Residual of a sample that a diverging simulation could not give [rad]: worse than any real one, yet finite."""
FARTHEST = float(np.nextafter(DIVERGED, 0.0))
"""Of samples that a simulation did give, for one that is farther off: what turns over may be turns away [rad]."""
START_DIFFERENCE = 1e-5
"""Step of the finite differences for angles [rad] and velocities [rad/s] at a start."""
STARTS = 3
"""So often the start of a trial that begins in motion is improved where a model is judged."""


def joint_rmse(residuals: Sequence[Array]) -> Array:
    """(nj,) root mean square of all segments' residuals [rad]."""
    return np.asarray(np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0)))


def residual_of(segment: Segment, found: Predicted, index: int) -> Array:
    """(m, nj) of one of a segment's predictions; DIVERGED from where it diverged on."""
    reached = found.reached[index]
    residual = np.full(segment.measured.shape, DIVERGED)
    residual[:reached] = np.clip(segment.measured[:reached] - found.position[index, :reached], -FARTHEST, FARTHEST)
    return residual


def residuals_of(
    model: Model, segments: Sequence[Segment], simulator: Simulator, improved: int = STARTS
) -> list[Array]:
    """For each segment (m, nj) measured − predicted from its measured start [rad]; DIVERGED where there is none.

    Of robots that need not start at rest, from the start that fits best.

    Args:
        model: that predicts.
        segments: what was measured.
        simulator: the engine.
        improved: so often such a start is improved.
    """
    if not segments:
        return []
    starts = [s.start for s in segments]
    found = simulator([model], segments, [start[None, :] for start in starts])
    residuals = [residual_of(s, f, 0) for s, f in zip(segments, found, strict=True)]
    if model.robot.traits.starts_at_rest:
        return residuals
    for _ in range(improved):
        starts, residuals = _better_starts(model, segments, simulator, starts, residuals)
    return residuals


def _better_starts(
    model: Model, segments: Sequence[Segment], simulator: Simulator, starts: list[Array], residuals: list[Array]
) -> tuple[list[Array], list[Array]]:
    """One step of Gauss and Newton for each segment's start, where it helps."""
    n = len(starts[0])
    rows = [np.vstack([start, start + START_DIFFERENCE * np.eye(n)]) for start in starts]
    found = simulator([model] * (n + 1), segments, rows)
    tried = []
    for start, residual, f in zip(starts, residuals, found, strict=True):
        slopes: Array = np.zeros((*residual.shape, n))
        reached = int(f.reached.min())  # numbers after a divergence mean nothing
        with np.errstate(invalid="ignore", over="ignore"):
            slopes[:reached] = np.moveaxis(f.position[1:, :reached] - f.position[0, :reached], 0, -1) / START_DIFFERENCE
            step: Array = np.zeros(n)
            if np.all(np.isfinite(slopes)):
                step[:] = np.linalg.lstsq(slopes.reshape(residual.size, n), residual.ravel(), rcond=1e-9)[0]
        if not np.all(np.isfinite(step)):
            step = np.zeros(n)
        tried.append(np.array([start + share * step for share in (1.0, 0.3)]))
    found = simulator([model] * 2, segments, tried)
    moved, left = [], []
    for segment, start, residual, rows_tried, f in zip(segments, starts, residuals, tried, found, strict=True):
        choices = [(residual, start), *((residual_of(segment, f, k), rows_tried[k]) for k in range(2))]
        best = min(choices, key=lambda choice: float((choice[0] ** 2).sum()))
        left.append(best[0])
        moved.append(best[1])
    return moved, left
