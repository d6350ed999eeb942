"""Parameters of a model from what a robot did, by nonlinear least squares on simulated trials.

Levenberg and Marquardt's method over the parameters θ, the free numbers of the segments' starts eliminated by a QR
factorisation segment by segment, so that many short windows cost no more than their simulation. Each step solves

    min ‖R δ − c‖² + λ‖D δ‖²   subject to   low ≤ θ + δ ≤ high

for several λ at once, by which the starts are damped too, and simulates all of them side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.noise import Noise
from equimus_ctrl.identification.parameters import FreeParameters, place_unit
from equimus_ctrl.identification.problem import Derivatives, Point, Problem
from equimus_ctrl.identification.residuals import DIVERGED, joint_rmse
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator, simulator_for
from equimus_ctrl.identification.uncertainty import Uncertainty, uncertainty
from equimus_ctrl.models.augmented import unknown_starts
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

DAMPINGS = 10.0 ** np.array([-3.0, -1.5, 0.0, 1.5])
"""Around the last damping, these factors are tried side by side, with two choices of starts each: a block of lanes
costs as much as one."""
ONE_BY_ONE = 10.0 ** np.array([-1.0, 0.0, 1.0, 2.5])
"""The same where simulations take as long side by side as one after the other: the first that helps is taken."""
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e12
IDLE = 1e-9
"""A parameter with less than this share of the strongest one's effect is not moved."""
UNSEEN = 1e-3
"""Nor is one that over all it can be changes the predictions by less than this share of the residuals' RMS, by the root
of the sum of squares: such as where across a planar arm a mass sits. Rounding would take it to a bound."""

Begin = tuple[Array, Sequence[Array]]
"""Parameters (p,) and, for each segment, its start (2 nj + nz + 2 nl + nm,), see ``Segment.start``."""


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


@dataclass(frozen=True)
class SensorZero:
    """What a joint's sensor shows too much in one recording.

    Attributes:
        recording: its name.
        joint: whose.
        unit: of the value.
        value: the mean over the recording's shooting intervals, each of which has its own.
    """

    recording: str
    joint: str
    unit: str
    value: float


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Short):
    """Where a search ended.

    Attributes:
        parameters: what was free.
        theta: (p,) the values found.
        model: the model with them.
        starts: for each segment (2 nj + nz + 2 nl + nm,) its start as the sensors show it, see ``Segment.start``.
        residuals: for each segment (m, nj + ne) measured − predicted, of joints first [rad, or other units].
        before: the same of the initial model.
        cost: sum of squares that was minimised, in units of the noise's variance where a noise was given, else in those
            of the residuals, squared.
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

    @property
    def derivatives(self) -> Derivatives:
        """Where the search ended, worked out when they are first asked for: of most fits nobody does."""
        with threadpool_limits(limits=1, user_api="blas"):
            return self.derive()

    @property
    def jacobians(self) -> list[Array]:
        """For each segment (m, nj + ne, p) ∂prediction/∂θ."""
        return self.derivatives[0]

    @property
    def start_jacobians(self) -> list[Array]:
        """For each segment (m, nj + ne, s) ∂prediction/∂(free initial state)."""
        return self.derivatives[1]

    @property
    def uncertainty(self) -> Uncertainty:
        """Of ``theta``, worked out when it is first asked for: a search asks for few of its fits'."""
        # Not the last bit is to depend on who asks.
        with threadpool_limits(limits=1, user_api="blas"):
            return self.known()

    @property
    def rmse(self) -> Array:
        """(nj,) of the model found [rad or m]."""
        return joint_rmse(self.residuals)[: len(self.model.robot.joint_names)]

    @property
    def zeros(self) -> tuple[SensorZero, ...]:
        """Of all recordings and joints whose sensors' zeros were unknown."""
        values: dict[tuple[str, int], list[float]] = {}
        for segment, start in zip(self.problem.segments, self.starts, strict=True):
            first = 2 * segment.measured.shape[1]
            for j, value in zip(segment.zeros, start[first : first + len(segment.zeros)], strict=True):
                values.setdefault((segment.recording_name, j), []).append(float(value))
        joints = self.model.robot.joint_names
        return tuple(
            SensorZero(name, joints[j], place_unit(self.model, "rad", joints[j]), float(np.mean(own)))
            for (name, j), own in values.items()
        )

    @property
    def rmse_before(self) -> Array:
        """(nj,) of the initial model [rad or m]."""
        return joint_rmse(self.before)[: len(self.model.robot.joint_names)]


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
        begin: initial points of the search, the best of which is taken; the initial model by default.
        coarse: a faster engine for derivatives.
        earlier: a fit of the same whose end this one may go on from; its derivatives are taken over where simulations
            are dear.
        notify: called with (parameter sets simulated, best RMSE over all joints [rad]) after each step.

    Raises:
        ConfigError: where there are fewer residuals than unknowns or nothing is free.
        SimulationDiverged: where the initial model diverges on every segment.
    """
    # The matrices are small: threads of the linear algebra would only fight with those of the simulation.
    with threadpool_limits(limits=1, user_api="blas"):
        simulator = simulator or simulator_for(parameters.model, [s.poses for s in segments])
        unknown = unknown_starts(parameters.model.effects)
        problem = Problem(parameters, [s.with_unknown(unknown) for s in segments], simulator, noise, coarse)
        return _fit(problem, settings or FitSettings(), begin, earlier, notify)


def _fit(
    problem: Problem,
    settings: FitSettings,
    begin: Sequence[Begin],
    earlier: Fit | None,
    notify: Callable[[int, float], None],
) -> Fit:
    parameters, segments = problem.parameters, problem.segments
    samples = sum(s.outputs.size for s in segments)
    p, free_starts = len(parameters.free), sum(len(s.free_at) for s in segments)
    if not p:
        raise ConfigError(f"{parameters.model.name}: no parameter is free, so there is nothing to identify")
    if samples <= p + free_starts:
        raise ConfigError(
            f"{samples} measured angles are too few for {p + free_starts} unknowns ({p} parameters and {free_starts} "
            "of initial states)"
        )
    measured = [s.start for s in segments]
    given = [
        (theta, [s.from_start(start) for s, start in zip(segments, starts, strict=True)])
        for theta, starts in begin or [(parameters.start, measured)]
    ]
    together = problem.simulator.engine.batched
    # A free initial state from an earlier fit competes with the measured one.
    free_before = bool(free_starts and begin and together)
    choices = [[b[1], measured] if free_before else [b[1]] for b in given]
    point = min(problem.points([b[0] for b in given], choices), key=lambda tried: tried.cost)
    if all(np.all(r[-1] == DIVERGED * s.scales) for s, r in zip(segments, point.residuals, strict=True)):
        raise SimulationDiverged(
            f"{parameters.model.name}: the simulation diverges on every trial with the initial model"
        )
    before = point.residuals
    slopes = None
    if earlier is not None and _begins_where(problem, point, earlier):
        slopes = problem.slopes(point, earlier.derivatives)
    weights = np.zeros(p)
    damping, converged = 1e-2, False
    around = DAMPINGS if together else ONE_BY_ONE
    for _ in range(settings.steps):
        slopes = slopes or problem.slopes(point)
        weights = np.maximum(weights, np.linalg.norm(slopes.factor, axis=0))
        dampings = np.clip(damping * around, LEAST_DAMPING, MOST_DAMPING)
        unseen = UNSEEN * np.sqrt(point.cost / samples)
        changes = [_step(parameters, point.theta, slopes.damped(d), weights * np.sqrt(d), unseen) for d in dampings]
        thetas = [parameters.moved(point.theta, parameters.scale * c) for c in changes]
        starts = [problem.moved_starts(point, slopes, c, d) for c, d in zip(changes, dampings, strict=True)]
        tried: list[Point] = []
        for part in [slice(None)] if together else [slice(k, k + 1) for k in range(len(dampings))]:
            tried += problem.points(thetas[part], starts[part])
            if tried[-1].cost < point.cost:
                break
        best = min(range(len(tried)), key=lambda i: tried[i].cost)
        gain = (point.cost - tried[best].cost) / max(point.cost, 1e-300)
        if gain > 0:
            point, damping, slopes = tried[best], float(dampings[best]), None
        notify(problem.evaluations, float(np.sqrt(sum((r**2).sum() for r in point.residuals) / samples)))
        if not gain > 0 and dampings[-1] < MOST_DAMPING and np.abs(changes[-1]).max() > settings.tolerance:
            damping = float(dampings[-1]) * 10
            continue
        if gain < settings.tolerance:
            converged = True
            break
    spread = parameters.high - parameters.low
    if parameters.model.robot.traits.bounds_of_any_size:
        spread = np.minimum(spread, parameters.scale)
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
        cache(derive),
        cache(known),
    )
    return found


def _step(
    parameters: FreeParameters, theta: Array, slopes: tuple[Array, Array], damping: Array, unseen: float
) -> Array:
    """(p,) the damped step within bounds, in units of the parameters' scale.

    Args:
        parameters: what is free.
        theta: where it begins.
        slopes: (R, c).
        damping: (p,) λD.
        unseen: a parameter that changes the predictions by less over all it can be stays where it is.
    """
    factor, aim = slopes
    over_all = np.linalg.norm(factor, axis=0) * (parameters.high - parameters.low) / parameters.scale
    factor = np.where(over_all < unseen, 0.0, factor)
    # What has no effect beyond rounding stays where it is.
    least = IDLE * np.linalg.norm(factor, axis=0).max() + 1e-300
    system = np.vstack([factor, np.diag(np.maximum(damping, least))])
    target = np.concatenate([aim, np.zeros(len(theta))])
    low, high = (parameters.low - theta) / parameters.scale, (parameters.high - theta) / parameters.scale
    free = np.linalg.lstsq(system, target, rcond=None)[0]
    if np.all(free >= low) and np.all(free <= high):
        return np.asarray(free)
    tight = 1e-12 * np.maximum(high - low, 1e-300)
    found = lsq_linear(system, target, bounds=(np.minimum(low, -tight), np.maximum(high, tight)), method="bvls")
    return np.asarray(np.clip(found.x, low, high))


def _begins_where(problem: Problem, point: Point, other: Fit) -> bool:
    """Whether derivatives at the end of another fit are those at a point, and worth keeping."""
    own = other.problem
    return (
        not problem.simulator.engine.batched
        and (problem.coarse or problem.simulator) is (own.coarse or own.simulator)
        and problem.parameters.names == other.parameters.names
        and len(problem.segments) == len(own.segments)
        and all(a is b for a, b in zip(problem.segments, own.segments, strict=True))
        and np.array_equal(point.theta, other.theta)
        and all(np.array_equal(a, b) for a, b in zip(point.starts, other.starts, strict=True))
    )
