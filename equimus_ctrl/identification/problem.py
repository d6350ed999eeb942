"""Residuals of simulated trials as a function of parameters and starts, with their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.identification.channels import require_alike
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import FARTHEST, difference, stacked_residuals
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.types import Array

Derivatives = tuple[list[Array], list[Array]]
"""For each segment (m, nj, p) ∂prediction/∂θ and (m, nj, s) ∂prediction/∂start."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """Starts of w segments of one shape, eliminated from their residuals and their derivatives [N | J, r].

    With N D⁻¹ = U diag(s) Vᵀ and D the norms of N's columns, a start that is damped by λ‖D δ‖² goes by
    δ = D⁻¹ V diag(s/(s² + λ)) Uᵀ(r − J δθ), and leaves of the residuals what no start can take and √(λ/(s² + λ)) of the
    rest.

    Attributes:
        segments: (w) which they are.
        turned: (w, s, p + 1) Uᵀ[J, r].
        sizes: (w, s) singular values.
        back: (w, s, s) D⁻¹ V.
    """

    segments: list[int]
    turned: Array
    sizes: Array
    back: Array

    def left(self, damping: float) -> Array:
        """(w·s, p + 1) rows that are left where the starts are damped."""
        rows = np.sqrt(damping / (self.sizes**2 + damping))[:, :, None] * self.turned
        return np.asarray(rows.reshape(-1, self.turned.shape[2]))

    def steps(self, change: Array, damping: float) -> Array:
        """(w, s) of the starts, with a change (p,) of θ in units of its scale."""
        target = self.turned[:, :, -1] - self.turned[:, :, :-1] @ change  # (w, s)
        return np.asarray((self.back @ (self.sizes / (self.sizes**2 + damping) * target)[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives at one point, the starts eliminated.

    Attributes:
        derivatives: by θ and by the starts.
        whole: (p + 1, p + 1) triangle of [R, c], the columns of R in units of the parameters' scale.
        starts: of the segments whose starts are free, see ``Elimination``.
    """

    derivatives: Derivatives
    whole: Array
    starts: list[Elimination]

    @property
    def factor(self) -> Array:
        """(p, p) R."""
        return self.whole[:-1, :-1]

    def damped(self, damping: float) -> tuple[Array, Array]:
        """(p, p) R and (p,) c where the starts are damped, see ``Elimination``."""
        rows = [own.left(damping) for own in self.starts]
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
        noise: of the joints, whose innovations are what is squared; without, all residuals of joints count
            alike, and others by how far they go beside them.
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
        # Noise is estimated over all of them.
        require_alike([s.channels for s in self.segments], [s.recording_name for s in self.segments])
        self._start_weights = [self._weights_of(segment) for segment in self.segments]
        shapes: dict[tuple[int, ...], list[int]] = {}
        for k, segment in enumerate(self.segments):
            shapes.setdefault(segment.outputs.shape, []).append(k)
        self._shapes = list(shapes.values())

    def whitened(self, segment: Segment, values: Array) -> Array:
        """Residuals or derivatives (m, nj + ne, ...) of a segment as they count."""
        if self.noise is None:
            return np.asarray(values / segment.scales.reshape(-1, *[1] * (values.ndim - 2)))
        return whiten(self.noise, segment.trial.sample_times, values)

    def points(self, thetas: Sequence[Array], starts: Sequence[Sequence[Sequence[Array]]]) -> list[Point]:
        """Simulate parameter sets (p,), each with one or more choices of starts, and take the best segment by segment.

        Args:
            thetas: (p,) each.
            starts: for each parameter set its choices, for each choice (2 nj + nz,) for every segment.
        """
        models = [self.parameters.model_at(theta) for theta in thetas]
        spread = [(i, choice) for i, choices in enumerate(starts) for choice in choices]
        self.evaluations += len(spread)
        rows = [np.array([choice[k] for _, choice in spread]) for k in range(len(self.segments))]
        found = self.simulator([models[i] for i, _ in spread], self.segments, rows)
        ends = np.cumsum([len(choices) for choices in starts])
        choices_of = [slice(end - len(choices), end) for end, choices in zip(ends, starts, strict=True)]
        taken: list[list[tuple[Array, Array, Array]]] = [[] for _ in thetas]
        costs = np.zeros(len(thetas))
        squares, residuals = self._squares(found)
        for k, (segment, weights, row) in enumerate(zip(self.segments, self._start_weights, rows, strict=True)):
            free = segment.free_at
            own = squares[k] + ((weights * (segment.start[free] - row[:, free])) ** 2).sum(axis=1)
            for i, choices_i in enumerate(choices_of):
                best = choices_i.start + int(np.argmin(own[choices_i]))
                costs[i] += own[best]
                # A view would keep all others alive.
                taken[i].append((row[best], residuals[k][best].copy(), found[k].position[best].copy()))
        return [
            Point(theta, [start for start, *_ in own], [r for _, r, _ in own], float(cost), [q for *_, q in own])
            for theta, own, cost in zip(thetas, taken, costs, strict=True)
        ]

    def _squares(self, found: Sequence[Predicted]) -> tuple[list[Array], list[Array]]:
        """For each segment (k,) sums of squares of its k predictions as they count, and (k, m, nj) their residuals.

        Segments of one shape are worked out together, for shooting intervals are many and short.
        """
        squares: list[Array] = [np.empty(0)] * len(found)
        residuals: list[Array] = [np.empty(0)] * len(found)
        for members in self._shapes:
            whole = stacked_residuals([self.segments[k] for k in members], [found[k] for k in members])
            if self.noise is None:
                counted = whole / np.stack([self.segments[k].scales for k in members])[:, None, None]
            elif all(joint.coloured == 0.0 for joint in self.noise):
                counted = whole / np.array([joint.white for joint in self.noise])
            else:
                times = [self.segments[k].trial.sample_times for k in members]
                counted = np.stack(
                    [
                        np.moveaxis(whiten(self.noise, time, np.moveaxis(own, 0, -1)), -1, 0)
                        for time, own in zip(times, whole, strict=True)
                    ]
                )
            for k, square, own in zip(members, (counted**2).sum(axis=(2, 3)), whole, strict=True):
                squares[k], residuals[k] = square, own
        return squares, residuals

    def slopes(self, point: Point, known: Derivatives | None = None) -> Slopes:
        """Forward differences about a point, or what is known of them."""
        by_theta, by_start = known or self.derivatives(point)
        scale = self.parameters.scale
        p = len(scale)
        shapes: dict[tuple[int, ...], list[int]] = {}
        columns: list[Array] = []
        for k, (segment, j, n, r) in enumerate(zip(self.segments, by_theta, by_start, point.residuals, strict=True)):
            whole = self.whitened(segment, np.concatenate([j * scale, r[:, :, None], n], axis=2))
            columns.append(whole.reshape(-1, whole.shape[2]))
            shapes.setdefault(columns[k].shape, []).append(k)
        rows: list[Array] = []
        starts: list[Elimination] = []
        for members in shapes.values():
            stacked = np.stack([columns[k] for k in members])  # (w, m·nj, p + 1 + s)
            system = stacked[:, :, : p + 1]
            if stacked.shape[2] > p + 1:
                own, system = self._eliminated(members, stacked[:, :, p + 1 :], system, point)
                starts.append(own)
            rows += list(_triangle(system))
        return Slopes((by_theta, by_start), _triangle(np.vstack(rows)), starts)

    def _eliminated(
        self, members: list[int], by_start: Array, system: Array, point: Point
    ) -> tuple[Elimination, Array]:
        """The starts of segments of one shape, and (w, m·nj + s, p + 1) what of [J, r] no start can do."""
        w, _, s = by_start.shape
        weights = np.array([self._start_weights[k] for k in members])  # (w, s)
        own = np.zeros((w, s, system.shape[2]))
        for row, weight, k in zip(own, weights, members, strict=True):
            free = self.segments[k].free_at
            row[:, -1] = weight * (self.segments[k].start[free] - point.starts[k][free])
        whole = np.concatenate([by_start, weights[:, :, None] * np.eye(s)], axis=1)
        system = np.concatenate([system, own], axis=1)
        norms = np.maximum(np.linalg.norm(whole, axis=1), 1e-300)  # (w, s)
        basis, sizes, turn = np.linalg.svd(whole / norms[:, None], full_matrices=False)
        turned = basis.swapaxes(1, 2) @ system
        back = turn.swapaxes(1, 2) / norms[:, :, None]
        return Elimination(members, turned, sizes, back), system - basis @ turned

    def moved_starts(self, point: Point, slopes: Slopes, change: Array, damping: float) -> list[list[Array]]:
        """Starts that go with a change (p,) of θ in units of its scale: the best to first order, a tenth of the way.

        The latter is for where the motion depends on its start with a kink, as on a joint's stop. Where it hardly
        depends on it, as where dry friction stops a joint at once, damping alone keeps the start near.
        """
        moved = [start.copy() for start in point.starts]
        for own in slopes.starts:
            for k, step in zip(own.segments, own.steps(change, damping), strict=True):
                moved[k][self.segments[k].free_at] += step
        if not any(segment.free_at for segment in self.segments):
            return [moved]
        return [moved, [old + 0.1 * (new - old) for old, new in zip(point.starts, moved, strict=True)]]

    def _weights_of(self, segment: Segment) -> Array:
        """(s,) what a start's distance from the measured one weighs, of its free components."""
        if self.noise is None or not segment.free_at:
            return segment.start_weights
        sigma = np.array([self.noise[j].sigma for j in segment.start_joints])
        return np.asarray(segment.start_weights / sigma)

    def derivatives(self, point: Point) -> Derivatives:
        """Forward differences about a point, by every parameter and free number of a start."""
        scale = self.parameters.scale
        # Steps lead away from the upper bound.
        by = difference(self.parameters.model, self.coarse or self.simulator)
        steps = by * scale * np.where(point.theta + by * scale <= self.parameters.high, 1.0, -1.0)
        p, most = len(scale), max(len(s.free_at) for s in self.segments)
        base = self.parameters.model_at(point.theta)
        moved = [self.parameters.model_at(point.theta + steps * unit) for unit in np.eye(p)]
        # In a batch the base costs nothing and has its neighbours' rounding; else it may be known already.
        first = int(self.simulator.engine.batched or self.coarse is not None)
        models = [*[base] * first, *moved, *([base] * most)]
        starts = []
        for segment, start in zip(self.segments, point.starts, strict=True):
            rows, free = np.tile(start, (len(models), 1)), segment.free_at
            rows[first + p + np.arange(len(free)), free] += by
            starts.append(rows)
        self.evaluations += len(models)
        nothing = np.empty(0)
        by_theta, by_start = [nothing] * len(starts), [nothing] * len(starts)
        simulated = (self.coarse or self.simulator)(models, self.segments, starts)
        for members in self._shapes:
            changes = self._changes(members, simulated, point, first)
            slopes = np.moveaxis(changes[:, :p] / steps[:, None, None], 1, -1)
            of_starts = np.moveaxis(changes[:, p:] / by, 1, -1)
            for k, slope, of_start in zip(members, slopes, of_starts, strict=True):
                by_theta[k], by_start[k] = slope, of_start[..., : len(self.segments[k].free_at)]
        return by_theta, by_start

    def _changes(self, members: list[int], simulated: Sequence[Predicted], point: Point, first: int) -> Array:
        """(w, k, m, nj) changes of the predictions of w segments of one shape by k neighbours of a point.

        Args:
            members: which segments.
            simulated: of all segments.
            point: whose predictions are known.
            first: whether it was simulated too, before its neighbours.
        """
        found = [simulated[k] for k in members]
        whole = np.stack([own.position for own in found])
        base = whole[:, :1] if first else np.stack([point.predicted[k] for k in members])[:, None]
        with np.errstate(invalid="ignore", over="ignore"):  # what diverges is dropped below
            changes: Array = whole[:, first:] - base
        for k, own, change in zip(members, found, changes, strict=True):
            if not own.sound.all():
                change[~own.sound[first:]] = 0.0  # a neighbour that diverges gives no slope
            if first and not own.sound[0]:
                change[:, own.reached[0] :] = 0.0
            elif not first:
                lost = np.abs(point.residuals[k]) >= FARTHEST * self.segments[k].scales
                change[:, np.any(lost, axis=1)] = 0.0
        return changes


def _triangle(matrix: Array) -> Array:
    """R of the QR factorisation, of each of a stack."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)
