"""Parameters of a model from what a robot did, by nonlinear least squares on simulated trials.

Levenberg and Marquardt's method over the parameters θ, the free numbers of the segments' starts eliminated by a QR
factorisation segment by segment, so that many short windows cost no more than their simulation. Each step solves

    min ‖R δ − c‖² + λ‖D δ‖²   subject to   low ≤ θ + δ ≤ high

for several λ at once and simulates all of them side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.engines.batch import Predicted, simulate
from equimus_ctrl.engines.machine import simulate_machines
from equimus_ctrl.engines.predict import behind_sensors
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.uncertainty import Uncertainty, uncertainty
from equimus_ctrl.models.model import Model, machine_of
from equimus_ctrl.types import Array

STEP = 3e-3
"""Physics step of the reduced engine in fits [s], where the robot allows it: an error of 1e-5 rad, or 3e-5 rad with
static friction, a hundredth of what sensors' noise is."""
DIVERGED = 3.0
"""Residual of a sample that a diverging simulation could not give [rad]: worse than any real one, yet finite."""
FARTHEST = float(np.nextafter(DIVERGED, 0.0))
"""Of samples that a simulation did give, for one that is farther off: what turns over may be turns away [rad]."""
DIFFERENCE = 1e-5
"""Step of the finite differences, in units of each parameter's scale."""
START_DIFFERENCE = 1e-5
"""The same for angles [rad] and velocities [rad/s] at a start."""
STARTS = 3
"""So often the start of a machine's trial is improved where its model is judged."""
DAMPINGS = 10.0 ** np.array([-3.0, -1.5, 0.0, 1.5])
"""Around the last damping, these factors are tried side by side, with two choices of starts each: a block of lanes
costs as much as one."""
ONE_BY_ONE = 10.0 ** np.array([-1.0, 0.0, 1.0, 2.5])
"""The same where simulations take as long side by side as one after the other: the first that helps is taken."""
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e12
IDLE = 1e-9
"""A parameter with less than this share of the strongest one's effect is not moved."""

Begin = tuple[Array, Sequence[Array]]
"""Parameters (p,) and, for each segment, its start (2 nj,)."""
Derivatives = tuple[list[Array], list[Array]]
"""For each segment (m, nj, p) ∂prediction/∂θ and (m, nj, s) ∂prediction/∂start."""
Simulator = Callable[[Sequence[Model], Sequence[Segment], Sequence[Array]], list[Predicted]]
"""(models, segments, starts (k, 2 nj) for each segment as the sensors show them) → predictions."""


def reduced_simulator(dt: float | None = None, threads: int | None = None, longest: float = STEP) -> Simulator:
    """The reduced engine.

    Args:
        dt: physics step [s]; by default ``longest``, divided until it follows the first model that is simulated. It
            then stays, so that a search always sees the same discretisation.
        threads: as many as there are cores by default.
        longest: [s].
    """
    chosen: list[float] = []

    def run(models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        if not chosen:
            m = changed_bodies(models[0].effects, models[0].morphology)
            poses = [s.trial.position for s in segments]
            chosen.append(dt or longest / step_divisor(m, models[0].phase, poses, longest, stops=False))
        trials = [s.trial for s in segments]
        true = [behind_sensors(models, rows) for rows in starts]
        return simulate(models, trials, starts=true, dt=chosen[0], threads=threads, check=dt is not None)

    return run


def machine_simulator(dt: float | None = None, threads: int | None = None) -> Simulator:
    """MuJoCo, for machines.

    Args:
        dt: physics step [s]; the MuJoCo model's by default.
        threads: as many as there are cores by default.
    """

    def run(models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        true = [behind_sensors(models, rows) for rows in starts]
        return simulate_machines(models, [s.trial for s in segments], starts=true, dt=dt, threads=threads)

    return run


def simulator_for(model: Model, threads: int | None = None) -> Simulator:
    """The engine that a model is fitted with: MuJoCo for machines, else the reduced one."""
    return reduced_simulator(threads=threads) if machine_of(model) is None else machine_simulator(threads=threads)


@dataclass(frozen=True)
class FitSettings:
    """How a fit searches.

    Attributes:
        tolerance: relative change of cost or parameters at which it stops.
        steps: at most.
        confidence: of the intervals.
    """

    tolerance: float = 1e-6
    steps: int = 100
    confidence: float = 0.95


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a search ended.

    Attributes:
        parameters: what was free.
        theta: (p,) the values found.
        model: the model with them.
        starts: for each segment (2 nj,) its start as the sensors show it [rad, rad/s].
        residuals: for each segment (m, nj) measured − predicted [rad].
        before: the same of the model as it came.
        cost: sum of squares that was minimised, in units of the noise's variance where a noise was given, else [rad²].
        at_bound: (p,) −1, 0, 1: where a bound holds a parameter back.
        evaluations: how many parameter sets were simulated.
        converged: whether the search ended by itself.
        problem: what was solved.
        derive: works out ``derivatives``.
        known: works out ``uncertainty``.
    """

    parameters: FreeParameters
    theta: Array
    model: Model
    starts: tuple[Array, ...]
    residuals: tuple[Array, ...]
    before: tuple[Array, ...]
    cost: float
    at_bound: Array
    evaluations: int
    converged: bool
    problem: Problem
    derive: Callable[[], Derivatives]
    known: Callable[[], Uncertainty]

    @cached_property
    def derivatives(self) -> Derivatives:
        """Where the search ended, worked out when they are first asked for: of most fits nobody does."""
        with threadpool_limits(limits=1, user_api="blas"):
            return self.derive()

    @property
    def jacobians(self) -> list[Array]:
        """For each segment (m, nj, p) ∂prediction/∂θ."""
        return self.derivatives[0]

    @property
    def start_jacobians(self) -> list[Array]:
        """For each segment (m, nj, s) ∂prediction/∂start, its free numbers."""
        return self.derivatives[1]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of ``theta``, worked out when it is first asked for: a search asks for few of its fits'."""
        # Not the last bit is to depend on who asks.
        with threadpool_limits(limits=1, user_api="blas"):
            return self.known()

    @property
    def rmse(self) -> Array:
        """(nj,) [rad]."""
        return joint_rmse(self.residuals)

    @property
    def rmse_before(self) -> Array:
        """(nj,) of the model as it came [rad]."""
        return joint_rmse(self.before)


def joint_rmse(residuals: Sequence[Array]) -> Array:
    """(nj,) root mean square of all segments' residuals [rad]."""
    return np.asarray(np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0)))


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Derivatives at one point, the starts eliminated.

    Attributes:
        derivatives: by θ and by the starts.
        factor: (p, p) R with the columns in units of the parameters' scale.
        target: (p,) c.
        starts: for each segment its (Q, R) of ∂/∂start, the weighted start below the samples.
    """

    derivatives: Derivatives
    factor: Array
    target: Array
    starts: list[tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class _Point:
    """A parameter set with its starts, residuals, cost and, for each segment, (m, nj) what is predicted."""

    theta: Array
    starts: list[Array]
    residuals: list[Array]
    cost: float
    predicted: list[Array]


def residuals_of(model: Model, segments: Sequence[Segment], simulator: Simulator) -> list[Array]:
    """For each segment (m, nj) measured − predicted from its measured start [rad]; DIVERGED where there is none.

    Of machines, which do not start at rest, from the start that fits best.
    """
    if not segments:
        return []
    starts = [s.start for s in segments]
    found = simulator([model], segments, [start[None, :] for start in starts])
    residuals = [_residual(s, f, 0) for s, f in zip(segments, found, strict=True)]
    if machine_of(model) is None:
        return residuals
    for _ in range(STARTS):
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
        with np.errstate(invalid="ignore", over="ignore"):
            slopes = np.moveaxis(f.position[1:] - f.position[0], 0, -1).reshape(residual.size, n) / START_DIFFERENCE
        step = np.linalg.lstsq(slopes, residual.ravel(), rcond=1e-9)[0] if np.all(np.isfinite(slopes)) else np.zeros(n)
        tried.append(np.array([start + share * step for share in (1.0, 0.3)]))
    found = simulator([model] * 2, segments, tried)
    moved, left = [], []
    for segment, start, residual, rows_tried, f in zip(segments, starts, residuals, tried, found, strict=True):
        choices = [(residual, start), *((_residual(segment, f, k), rows_tried[k]) for k in range(2))]
        best = min(choices, key=lambda choice: float((choice[0] ** 2).sum()))
        left.append(best[0])
        moved.append(best[1])
    return moved, left


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
        self.side_by_side = machine_of(parameters.model) is None

    def whitened(self, segment: Segment, values: Array) -> Array:
        """Residuals or derivatives (m, nj, ...) of a segment as they count."""
        return values if self.noise is None else whiten(self.noise, segment.trial.sample_times, values)

    def points(self, thetas: Sequence[Array], starts: Sequence[Sequence[Sequence[Array]]]) -> list[_Point]:
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
        points = [_Point(theta, [], [], 0.0, []) for theta in thetas]
        for segment, row, predicted in zip(self.segments, rows, found, strict=True):
            best: dict[int, tuple[float, Array, Array, Array]] = {}
            residuals = np.stack([_residual(segment, predicted, place) for place in range(len(spread))], axis=-1)
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

    def slopes(self, point: _Point, known: Derivatives | None = None) -> _Slopes:
        """Forward differences about a point, or what is known of them."""
        by_theta, by_start = known or self.derivatives(point)
        scale = self.parameters.scale
        p = len(scale)
        rows, starts = [], []
        for segment, j, n, r, x in zip(self.segments, by_theta, by_start, point.residuals, point.starts, strict=True):
            count, s = j.shape[0] * j.shape[1], segment.free_start
            columns = self.whitened(segment, np.concatenate([j * scale, r[:, :, None], n], axis=2)).reshape(count, -1)
            system = columns[:, : p + 1]
            if s:
                whole = np.vstack([columns[:, p + 1 :], np.diag(self._start_weights(segment))])
                own = np.zeros((s, p + 1))
                own[:, p] = self._start_residual(segment, x)
                system = np.vstack([system, own])
                basis, upper = np.linalg.qr(whole, mode="reduced")
                starts.append((basis, upper))
                system = system - basis @ (basis.T @ system)
            else:
                starts.append((np.empty((count, 0)), np.empty((0, 0))))
            rows.append(_triangle(system))
        factor = _triangle(np.vstack(rows))
        return _Slopes((by_theta, by_start), factor[:p, :p], factor[:p, p], starts)

    def begins_where(self, other: Fit, point: _Point) -> bool:
        """Whether derivatives at the end of another fit are those at a point, and worth keeping."""
        own = other.problem
        return (
            not self.side_by_side
            and (self.coarse or self.simulator) is (own.coarse or own.simulator)
            and self.parameters.names == other.parameters.names
            and len(self.segments) == len(own.segments)
            and all(a is b for a, b in zip(self.segments, own.segments, strict=True))
            and np.array_equal(point.theta, other.theta)
            and all(np.array_equal(a, b) for a, b in zip(point.starts, other.starts, strict=True))
        )

    def moved_starts(self, point: _Point, slopes: _Slopes, change: Array) -> list[list[Array]]:
        """Starts that go with a change (p,) of θ in units of its scale: the best to first order, a tenth of the way.

        The latter is for where the motion depends on its start with a kink, as on a joint's stop.
        """
        moved = []
        scale = self.parameters.scale
        for k, segment in enumerate(self.segments):
            start = point.starts[k].copy()
            s = segment.free_start
            if s:
                basis, upper = slopes.starts[k]
                left = self.whitened(segment, point.residuals[k] - slopes.derivatives[0][k] @ (scale * change)).ravel()
                target = np.concatenate([left, self._start_residual(segment, start)])
                start[:s] += solve_triangular(upper, basis.T @ target)
            moved.append(start)
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

    def derivatives(self, point: _Point) -> Derivatives:
        """Forward differences about a point, by every parameter and free number of a start."""
        scale = self.parameters.scale
        # Steps lead away from the upper bound.
        steps = DIFFERENCE * scale * np.where(point.theta + DIFFERENCE * scale <= self.parameters.high, 1.0, -1.0)
        p, most = len(scale), max(s.free_start for s in self.segments)
        base = self.parameters.model_at(point.theta)
        moved = [self.parameters.model_at(point.theta + steps * unit) for unit in np.eye(p)]
        # Side by side the base costs nothing and has its neighbours' rounding; else it may be known already.
        first = int(self.side_by_side or self.coarse is not None)
        models = [*[base] * first, *moved, *([base] * most)]
        starts = []
        for segment, start in zip(self.segments, point.starts, strict=True):
            rows = np.tile(start, (len(models), 1))
            for k in range(segment.free_start):
                rows[first + p + k, k] += START_DIFFERENCE
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
            by_start.append(np.moveaxis(change[p : p + segment.free_start] / START_DIFFERENCE, 0, -1))
        return by_theta, by_start


def _triangle(matrix: Array) -> Array:
    """R of the QR factorisation."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)


def _residual(segment: Segment, found: Predicted, index: int) -> Array:
    reached = found.reached[index]
    residual = np.full(segment.measured.shape, DIVERGED)
    residual[:reached] = np.clip(segment.measured[:reached] - found.position[index, :reached], -FARTHEST, FARTHEST)
    return residual


def fit(
    parameters: FreeParameters,
    segments: Sequence[Segment],
    *,
    simulator: Simulator | None = None,
    settings: FitSettings | None = None,
    noise: Noise | None = None,
    begin: Sequence[Begin] = (),
    coarse: Simulator | None = None,
    earlier: Fit | None = None,
    notify: Callable[[int, float], None] = lambda evaluations, rmse: None,
) -> Fit:
    """Least squares over all segments, bounds kept.

    Args:
        parameters: what is free.
        segments: what was measured.
        simulator: the engine; see ``simulator_for`` for the default.
        settings: how it searches.
        noise: of the joints, by which residuals count; all alike without.
        begin: where the search may begin, the best of them is taken; the model as it came by default.
        coarse: a faster engine for derivatives.
        earlier: a fit of the same whose end this one may go on from; its derivatives are taken over where simulations
            are dear.
        notify: called with (parameter sets simulated, best RMSE over all joints [rad]) after each step.

    Raises:
        ConfigError: where there are fewer residuals than unknowns or nothing is free.
        SimulationDiverged: where the model as it came diverges on every segment.
    """
    # The matrices are small: threads of the linear algebra would only fight with those of the simulation.
    with threadpool_limits(limits=1, user_api="blas"):
        problem = Problem(parameters, segments, simulator or simulator_for(parameters.model), noise, coarse)
        return _fit(problem, settings or FitSettings(), begin, earlier, notify)


def _fit(
    problem: Problem,
    settings: FitSettings,
    begin: Sequence[Begin],
    earlier: Fit | None,
    notify: Callable[[int, float], None],
) -> Fit:
    parameters, segments = problem.parameters, problem.segments
    samples = sum(s.measured.size for s in segments)
    p, free_starts = len(parameters.free), sum(s.free_start for s in segments)
    if not p:
        raise ConfigError(f"{parameters.model.name}: no parameter is free, so there is nothing to identify")
    if samples <= p + free_starts:
        raise ConfigError(
            f"{samples} measured angles are too few for {p + free_starts} unknowns ({p} parameters and {free_starts} "
            "numbers of starts)"
        )
    given = begin or [(parameters.start, [s.start for s in segments])]
    point = min(problem.points([b[0] for b in given], [[b[1]] for b in given]), key=lambda tried: tried.cost)
    if all(np.all(r[-1] == DIVERGED) for r in point.residuals):
        raise SimulationDiverged(f"{parameters.model.name}: the simulation diverges on every trial as the model came")
    before = point.residuals
    slopes = None
    if earlier is not None and problem.begins_where(earlier, point):
        slopes = problem.slopes(point, earlier.derivatives)
    weights = np.zeros(p)
    damping, converged = 1e-2, False
    around = DAMPINGS if problem.side_by_side else ONE_BY_ONE
    for _ in range(settings.steps):
        slopes = slopes or problem.slopes(point)
        weights = np.maximum(weights, np.linalg.norm(slopes.factor, axis=0))
        dampings = np.clip(damping * around, LEAST_DAMPING, MOST_DAMPING)
        changes = [_step(parameters, point.theta, slopes, weights * np.sqrt(d)) for d in dampings]
        thetas = [parameters.moved(point.theta, parameters.scale * c) for c in changes]
        starts = [problem.moved_starts(point, slopes, c) for c in changes]
        tried: list[_Point] = []
        for part in [slice(None)] if problem.side_by_side else [slice(k, k + 1) for k in range(len(dampings))]:
            tried += problem.points(thetas[part], starts[part])
            if tried[-1].cost < point.cost:
                break
        best = min(range(len(tried)), key=lambda i: tried[i].cost)
        gain = (point.cost - tried[best].cost) / max(point.cost, 1e-300)
        if gain > 0:
            point, damping, slopes = tried[best], float(dampings[best]), None
        elif dampings[-1] < MOST_DAMPING and np.abs(changes[-1]).max() > settings.tolerance:
            damping = float(dampings[-1]) * 10
            continue
        notify(problem.evaluations, float(np.sqrt(sum((r**2).sum() for r in point.residuals) / samples)))
        if gain < settings.tolerance:
            converged = True
            break
    spread = parameters.high - parameters.low
    if not problem.side_by_side:
        spread = np.minimum(spread, parameters.scale)  # what bounds hold of machines of any size lies far apart
    low, high = point.theta - parameters.low < 1e-6 * spread, parameters.high - point.theta < 1e-6 * spread

    def derive() -> Derivatives:
        return slopes.derivatives if slopes else problem.derivatives(point)

    def known() -> Uncertainty:
        by_theta, by_start = found.derivatives
        return uncertainty(
            [problem.whitened(s, j) for s, j in zip(segments, by_theta, strict=True)],
            [problem.whitened(s, r) for s, r in zip(segments, point.residuals, strict=True)],
            [problem.whitened(s, n) for s, n in zip(segments, by_start, strict=True)],
            parameters.names,
            parameters.scale,
            point.theta,
            settings.confidence,
        )

    found = Fit(
        parameters,
        point.theta,
        parameters.model_at(point.theta),
        tuple(point.starts),
        tuple(point.residuals),
        tuple(before),
        point.cost,
        high.astype(int) - low.astype(int),
        problem.evaluations,
        converged,
        problem,
        derive,
        known,
    )
    return found


def _step(parameters: FreeParameters, theta: Array, slopes: _Slopes, damping: Array) -> Array:
    """(p,) the damped step within bounds, in units of the parameters' scale."""
    # What has no effect beyond rounding stays where it is.
    least = IDLE * np.linalg.norm(slopes.factor, axis=0).max() + 1e-300
    system = np.vstack([slopes.factor, np.diag(np.maximum(damping, least))])
    target = np.concatenate([slopes.target, np.zeros(len(theta))])
    low, high = (parameters.low - theta) / parameters.scale, (parameters.high - theta) / parameters.scale
    free = np.linalg.lstsq(system, target, rcond=None)[0]
    if np.all(free >= low) and np.all(free <= high):
        return np.asarray(free)
    tight = 1e-12 * np.maximum(high - low, 1e-300)
    found = lsq_linear(system, target, bounds=(np.minimum(low, -tight), np.maximum(high, tight)), method="bvls")
    return np.asarray(np.clip(found.x, low, high))
