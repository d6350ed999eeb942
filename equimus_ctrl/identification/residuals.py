"""What was measured less what is predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.identification.segments import LEAST_SAMPLES, Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.augmented import unknown_starts
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

DIVERGED = 3.0
"""Residual of a sample that a diverging simulation could not give [rad or m; of a channel in units of its scale]: worse
than any real one, yet finite."""
FARTHEST = float(np.nextafter(DIVERGED, 0.0))
"""Largest residual of a sample that a simulation did give, in the same units: what turns over may be turns away."""
DIFFERENCE, SMALL_DIFFERENCE = 1e-5, 1e-7
"""Step of the finite differences: of parameters in units of their scales, of angles [rad] and velocities [rad/s] at a
start. The small one is for what grows along a segment, see ``difference``."""
STARTS = 3
"""So often the start of a trial that begins in motion is improved where a model is judged."""
PARTS = (0.125, 0.25, 0.5)
"""Of a segment, over which its start is improved before all of it counts."""


def joint_rmse(residuals: Sequence[Array]) -> Array:
    """(nj + ne,) root mean square of all segments' residuals, of joints [rad or m] and then of channels."""
    return np.asarray(np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0)))


def difference(model: Model, simulator: Simulator) -> float:
    """Step of the finite differences.

    Where nothing holds a robot in place, a change grows a thousandfold and more along a segment: one of 1e-5 gives no
    slope at its end. A smaller one asks for an engine without a solver's tolerance.
    """
    grows = not model.robot.traits.held_in_place
    return SMALL_DIFFERENCE if grows and simulator.engine.batched else DIFFERENCE


def residual_of(segment: Segment, found: Predicted, index: int) -> Array:
    """(m, nj + ne) of one of a segment's predictions; DIVERGED from where it diverged on."""
    one = Predicted(found.position[index : index + 1], found.reached[index : index + 1])
    return np.asarray(stacked_residuals([segment], [one])[0, 0])


def stacked_residuals(segments: Sequence[Segment], found: Sequence[Predicted]) -> Array:
    """(w, k, m, nj + ne) of all predictions of w segments of one shape, see ``residual_of``."""
    position = np.stack([own.position for own in found])
    measured = np.stack([segment.outputs for segment in segments])
    scales = np.stack([segment.scales for segment in segments])[:, None, None]
    reached = np.stack([own.reached for own in found])
    with np.errstate(invalid="ignore", over="ignore"):  # numbers after a divergence mean nothing
        residual = np.clip(measured[:, None] - position, -FARTHEST * scales, FARTHEST * scales)
    lost = np.arange(position.shape[2]) >= reached[:, :, None]
    return np.asarray(np.where(lost[..., None], DIVERGED * scales, residual))


def residuals_of(
    model: Model, segments: Sequence[Segment], simulator: Simulator, improved: int = STARTS
) -> list[Array]:
    """For each segment (m, nj + ne) measured − predicted; DIVERGED where nothing is predicted, see ``followed``."""
    return followed(model, segments, simulator, improved)[1]


def followed(
    model: Model, segments: Sequence[Segment], simulator: Simulator, improved: int = STARTS
) -> tuple[list[Array], list[Array]]:
    """For each segment its start (2 nj + nz + 2 nl,) and (m, nj + ne) measured − predicted from there.

    These are DIVERGED where nothing is predicted. Starts, see ``Segment.start``, are measured ones. Those of robots
    that need not start at rest are improved by Gauss and Newton's method over a growing part of the segment: where
    errors grow along it, a start as it was measured may lie in another local minimum than the true one, and a short
    part has but one.

    Args:
        model: that predicts.
        segments: what was measured.
        simulator: the engine.
        improved: so often starts are improved over whole segments; from twice on over parts of them before.
    """
    if not segments:
        return [], []
    starts = [s.start for s in segments]
    residuals = _from(model, segments, simulator, starts)
    if model.robot.traits.starts_at_rest:
        return _remembered(model, segments, simulator, starts, residuals)
    if improved > 1:
        grown = starts
        for share in PARTS:
            parts = [_part(s, share) for s in segments]
            grown = _better_starts(model, parts, simulator, grown, _from(model, parts, simulator, grown))[0]
        tried = zip(segments, starts, residuals, grown, _from(model, segments, simulator, grown), strict=True)
        best = [(x, r) if _squares(s, r) <= _squares(s, q) else (y, q) for s, x, r, y, q in tried]
        starts, residuals = [x for x, _ in best], [r for _, r in best]
    for _ in range(improved):
        starts, residuals = _better_starts(model, segments, simulator, starts, residuals)
    return starts, residuals


def _remembered(
    model: Model, segments: Sequence[Segment], simulator: Simulator, starts: list[Array], residuals: list[Array]
) -> tuple[list[Array], list[Array]]:
    """``followed`` of robots that start at rest: what effects begin with that begin anywhere is found, nothing else."""
    count = unknown_starts(model.effects)
    wide = [segment.with_unknown(count) for segment in segments]
    if not any(segment.unknown for segment in wide):
        return starts, residuals
    starts = [segment.start for segment in wide]
    for _ in range(STARTS):
        starts, residuals = _better_starts(model, wide, simulator, starts, residuals, wide[0].unknown)
    return starts, residuals


def _from(model: Model, segments: Sequence[Segment], simulator: Simulator, starts: Sequence[Array]) -> list[Array]:
    found = simulator([model], segments, [start[None, :] for start in starts])
    return [residual_of(s, f, 0) for s, f in zip(segments, found, strict=True)]


def _part(segment: Segment, share: float) -> Segment:
    """The first share of a segment."""
    return segment.first(min(max(round(share * len(segment.measured)), LEAST_SAMPLES), len(segment.measured)))


def _squares(segment: Segment, residual: Array) -> float:
    """Sum of squares, each in units of how far what is measured goes beside the joints."""
    return float(((residual / segment.scales) ** 2).sum())


def _better_starts(
    model: Model,
    segments: Sequence[Segment],
    simulator: Simulator,
    starts: list[Array],
    residuals: list[Array],
    components: Sequence[int] | None = None,
) -> tuple[list[Array], list[Array]]:
    """One step of Gauss and Newton for each segment's start, or some components of it, where it helps."""
    by, whole = difference(model, simulator), np.eye(len(starts[0]))
    along = whole if components is None else whole[list(components)]
    n = len(along)
    rows = [np.vstack([start, start + by * along]) for start in starts]
    found = simulator([model] * (n + 1), segments, rows)
    tried = []
    for segment, start, residual, f in zip(segments, starts, residuals, found, strict=True):
        weights = 1.0 / segment.scales
        slopes: Array = np.zeros((*residual.shape, n))
        reached = int(f.reached.min())  # numbers after a divergence mean nothing
        with np.errstate(invalid="ignore", over="ignore"):
            slopes[:reached] = np.moveaxis(f.position[1:, :reached] - f.position[0, :reached], 0, -1) / by
            step: Array = np.zeros(n)
            if np.all(np.isfinite(slopes)):
                weighted = (slopes * weights[:, None]).reshape(residual.size, n)
                step[:] = np.linalg.lstsq(weighted, (residual * weights).ravel(), rcond=1e-9)[0]
        if not np.all(np.isfinite(step)):
            step = np.zeros(n)
        tried.append(np.array([start + share * (step @ along) for share in (1.0, 0.3)]))
    found = simulator([model] * 2, segments, tried)
    moved, left = [], []
    for segment, start, residual, rows_tried, f in zip(segments, starts, residuals, tried, found, strict=True):
        choices = [(residual, start), *((residual_of(segment, f, k), rows_tried[k]) for k in range(2))]
        best = min(choices, key=lambda choice, own=segment: _squares(own, choice[0]))  # type: ignore[misc]
        left.append(best[0])
        moved.append(best[1])
    return moved, left
