"""Residuals of simulated trials as a function of parameters and starts, with their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import FARTHEST, difference, residual_of
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.types import Array

Derivatives = tuple[list[Array], list[Array]]
"""For each segment (m, nj, p) ∂prediction/∂θ and (m, nj, s) ∂prediction/∂start."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """A segment's start, eliminated from its residuals and their derivatives [N | J, r].

    With N D⁻¹ = U diag(s) Vᵀ and D the norms of N's columns, a start that is damped by λ‖D δ‖² goes by
    δ = D⁻¹ V diag(s/(s² + λ)) Uᵀ(r − J δθ), and leaves of the residuals what no start can take and √(λ/(s² + λ)) of the
    rest.

    Attributes:
        turned: (s, p + 1) Uᵀ[J, r].
        sizes: (s,) singular values.
        back: (s, s) D⁻¹ V.
    """

    turned: Array
    sizes: Array
    back: Array

    def left(self, damping: float) -> Array:
        """(s, p + 1) rows that are left where the start is damped."""
        return np.sqrt(damping / (self.sizes**2 + damping))[:, None] * self.turned

    def step(self, change: Array, damping: float) -> Array:
        """(s,) of the start, with a change (p,) of θ in units of its scale."""
        target = self.turned[:, -1] - self.turned[:, :-1] @ change
        return np.asarray(self.back @ (self.sizes / (self.sizes**2 + damping) * target))


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives at one point, the starts eliminated.

    Attributes:
        derivatives: by θ and by the starts.
        whole: (p + 1, p + 1) triangle of [R, c], the columns of R in units of the parameters' scale.
        starts: for each segment, see ``Elimination``; None where its start is not free.
    """

    derivatives: Derivatives
    whole: Array
    starts: list[Elimination | None]

    @property
    def factor(self) -> Array:
        """(p, p) R."""
        return self.whole[:-1, :-1]

    def damped(self, damping: float) -> tuple[Array, Array]:
        """(p, p) R and (p,) c where the starts are damped, see ``Elimination``."""
        rows = [own.left(damping) for own in self.starts if own is not None]
        found = _triangle(np.vstack([self.whole, *rows])) if rows else self.whole
        return found[:-1, :-1], found[:-1, -1]


@dataclass(frozen=True, eq=False)
class Point:
    """A parameter set with its starts, residuals, cost and, for each segment, (m, nj) what is predicted."""

    theta: Array
    starts: list[Array]
    residuals: list[Array]
    cost: float
    predicted: list[Array]


class Problem:
    """Residuals and their derivatives as functions of the free parameters and starts.

    Args:
        parameters: what is free.
        segments: what was measured.
        simulator: the engine.
        noise: of the joints, whose innovations are what is squared; all residuals count alike without.
        coarse: a faster engine, whose predictions are compared with its own alone: for derivatives.
    """

    def __init__(
        self,
        parameters: FreeParameters,
        segments: Sequence[Segment],
        simulator: Simulator,
        noise: Noise | None = None,
        coarse: Simulator | None = None,
    ) -> None:
        self.coarse = coarse
        self.parameters = parameters
        self.segments = list(segments)
        self.simulator = simulator
        self.noise = noise
        self.evaluations = 0

    def whitened(self, segment: Segment, values: Array) -> Array:
        """Residuals or derivatives (m, nj, ...) of a segment as they count."""
        return values if self.noise is None else whiten(self.noise, segment.trial.sample_times, values)

    def points(self, thetas: Sequence[Array], starts: Sequence[Sequence[Sequence[Array]]]) -> list[Point]:
        """Simulate parameter sets (p,), each with one or more choices of starts, and take the best segment by segment.

        Args:
            thetas: (p,) each.
            starts: for each parameter set its choices, for each choice (2 nj,) for every segment.
        """
        models = [self.parameters.model_at(theta) for theta in thetas]
        spread = [(i, choice) for i, choices in enumerate(starts) for choice in choices]
        self.evaluations += len(spread)
        rows = [np.array([choice[k] for _, choice in spread]) for k in range(len(self.segments))]
        found = self.simulator([models[i] for i, _ in spread], self.segments, rows)
        points = [Point(theta, [], [], 0.0, []) for theta in thetas]
        for segment, row, predicted in zip(self.segments, rows, found, strict=True):
            best: dict[int, tuple[float, Array, Array, Array]] = {}
            residuals = np.stack([residual_of(segment, predicted, place) for place in range(len(spread))], axis=-1)
            squares = (self.whitened(segment, residuals) ** 2).sum(axis=(0, 1))
            for place, (i, _) in enumerate(spread):
                cost = float(squares[place] + (self._start_residual(segment, row[place]) ** 2).sum())
                if i not in best or cost < best[i][0]:
                    best[i] = cost, row[place], residuals[:, :, place], predicted.position[place]
            for i, (cost, start, residual, position) in best.items():
                points[i].predicted.append(position)
                points[i].starts.append(start)
                points[i].residuals.append(residual)
                points[i] = replace(points[i], cost=points[i].cost + cost)
        return points

    def slopes(self, point: Point, known: Derivatives | None = None) -> Slopes:
        """Forward differences about a point, or what is known of them."""
        by_theta, by_start = known or self.derivatives(point)
        scale = self.parameters.scale
        p = len(scale)
        rows: list[Array] = []
        starts: list[Elimination | None] = []
        for segment, j, n, r, x in zip(self.segments, by_theta, by_start, point.residuals, point.starts, strict=True):
            count, s = j.shape[0] * j.shape[1], segment.free_start
            columns = self.whitened(segment, np.concatenate([j * scale, r[:, :, None], n], axis=2)).reshape(count, -1)
            system = columns[:, : p + 1]
            if s:
                whole = np.vstack([columns[:, p + 1 :], np.diag(self._start_weights(segment))])
                own = np.zeros((s, p + 1))
                own[:, p] = self._start_residual(segment, x)
                system = np.vstack([system, own])
                norms = np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
                basis, sizes, turn = np.linalg.svd(whole / norms, full_matrices=False)
                turned = basis.T @ system
                starts.append(Elimination(turned, sizes, turn.T / norms[:, None]))
                system = system - basis @ turned
            else:
                starts.append(None)
            rows.append(_triangle(system))
        return Slopes((by_theta, by_start), _triangle(np.vstack(rows)), starts)

    def moved_starts(self, point: Point, slopes: Slopes, change: Array, damping: float) -> list[list[Array]]:
        """Starts that go with a change (p,) of θ in units of its scale: the best to first order, a tenth of the way.

        The latter is for where the motion depends on its start with a kink, as on a joint's stop. Where it hardly
        depends on it, as where dry friction stops a joint at once, damping alone keeps the start near.
        """
        moved = []
        for start, own in zip(point.starts, slopes.starts, strict=True):
            moved.append(start.copy())
            if own is not None:
                moved[-1][: len(own.sizes)] += own.step(change, damping)
        if not any(segment.free_start for segment in self.segments):
            return [moved]
        return [moved, [old + 0.1 * (new - old) for old, new in zip(point.starts, moved, strict=True)]]

    def _start_weights(self, segment: Segment) -> Array:
        if self.noise is None or not segment.free_start:
            return segment.start_weights
        nj = segment.measured.shape[1]
        sigma = np.array([self.noise[k % nj].sigma for k in range(segment.free_start)])
        return np.asarray(segment.start_weights / sigma)

    def _start_residual(self, segment: Segment, start: Array) -> Array:
        s = segment.free_start
        return np.asarray(self._start_weights(segment) * (segment.start[:s] - start[:s]))

    def derivatives(self, point: Point) -> Derivatives:
        """Forward differences about a point, by every parameter and free number of a start."""
        scale = self.parameters.scale
        # Steps lead away from the upper bound.
        by = difference(self.parameters.model, self.coarse or self.simulator)
        steps = by * scale * np.where(point.theta + by * scale <= self.parameters.high, 1.0, -1.0)
        p, most = len(scale), max(s.free_start for s in self.segments)
        base = self.parameters.model_at(point.theta)
        moved = [self.parameters.model_at(point.theta + steps * unit) for unit in np.eye(p)]
        # In a batch the base costs nothing and has its neighbours' rounding; else it may be known already.
        first = int(self.simulator.engine.batched or self.coarse is not None)
        models = [*[base] * first, *moved, *([base] * most)]
        starts = []
        for segment, start in zip(self.segments, point.starts, strict=True):
            rows = np.tile(start, (len(models), 1))
            for k in range(segment.free_start):
                rows[first + p + k, k] += by
            starts.append(rows)
        self.evaluations += len(models)
        by_theta, by_start = [], []
        simulated = (self.coarse or self.simulator)(models, self.segments, starts)
        for segment, found, known, residual in zip(
            self.segments, simulated, point.predicted, point.residuals, strict=True
        ):
            with np.errstate(invalid="ignore", over="ignore"):  # what diverges is dropped below
                change = found.position[first:] - (found.position[0] if first else known)
            change[~found.sound[first:]] = 0.0  # a neighbour that diverges tells no slope
            if first and not found.sound[0]:
                change[:, found.reached[0] :] = 0.0
            elif not first:
                change[:, np.any(np.abs(residual) >= FARTHEST, axis=1)] = 0.0
            by_theta.append(np.moveaxis(change[:p] / steps[:, None, None], 0, -1))
            by_start.append(np.moveaxis(change[p : p + segment.free_start] / by, 0, -1))
        return by_theta, by_start


def _triangle(matrix: Array) -> Array:
    """R of the QR factorisation."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)
