"""Optimal control of a robot over a horizon, by direct multiple shooting and sequential quadratic programming.

    min  Σ ½ hₖ (|qₖ − q*ₖ|²/α² + |vₖ − v*ₖ|²/β² + |uₖ − u*ₖ|²/ρ² + (‖qₖ beyond its range‖/λ)²)  +  ½ |L (x_N − x*_N)|²
    s.t. xₖ₊₁ = F(xₖ, uₖ, d, hₖ),   low ≤ uₖ ≤ high,   |uₖ − uₖ₋₁| ≤ r (tₖ − tₖ₋₁)

u are the pressures that reach the valves, or other commands as they arrive, F one step of ``models.prediction``. Joint
ranges are soft, and so are bounds of velocities; limits of u and of its rate are hard. Gauss and Newton's Hessian; the
steps' defects are folded into a program in the inputs alone (Bock and Plitt, 1984); soft ranges are the exact minimum
of their piecewise quadratic. Where a full step does worse by the sum of costs and defects, its inputs are followed
without a defect, and halved until they do better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.native import native
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.prediction import Prediction
from equimus_ctrl.predictive.condensing import fold, steepest, weigh
from equimus_ctrl.predictive.costs import Wanted, Weights
from equimus_ctrl.predictive.quadratic import QuadraticProgram
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array

Outcome = Literal["converged", "iterated", "failed"]

PASSES = 8
"""How often a program is solved again because other joints are beyond their range than was thought."""
SHORTEST = 1 / 16
"""Steps that were halved to this are not halved further."""
SAFE = 2.0
"""A defect costs so many times as much as its largest multiplier."""
KEPT = 1e-6
"""A limit may be missed by this share of an input's acceptable deviation."""
TINY = 1e-9
"""Share of the merit that rounding may take."""
UNBOUNDED = 1e12
"""By how much an input may change that is not free to [Pa]."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Inputs over a horizon and where they lead.

    Attributes:
        time: when it begins [s].
        inputs: (n, na) what reaches the valves [Pa].
        states: (n + 1, nx) of ``models.prediction``.
    """

    time: float
    inputs: Array
    states: Array


@dataclass(frozen=True, eq=False)
class Answer:
    """What a solution came to.

    Attributes:
        plan: the latest, whatever the outcome.
        outcome: ``"converged"``; ``"iterated"`` where iterations or time ended it first; ``"failed"`` where the program
            has no solution or none was found.
        iterations: how many linearised programs were solved.
        step: the last one's largest change of an input, in acceptable deviations.
        defect: the largest by which a step misses the next state, in acceptable deviations of angle, rate and pressure.
        cost: of the plan that the last program was made about.
        reason: why it failed.
    """

    plan: Plan
    outcome: Outcome
    iterations: int
    step: float
    defect: float
    cost: float
    reason: str = ""


class Problem:
    """The optimal control problem of one robot.

    Args:
        prediction: the robot's step, its joints without stops.
        durations: (n,) of the horizon's intervals [s].
        weights: see ``Weights``.
        angles: (2, nj) range of the joints [rad], or (2, 2 nj) with that of their velocities behind it [rad/s].
        inputs: (2, na) range of what reaches the valves [Pa].
        rate: of what reaches the valves, at most, of all or (na,) of each [Pa/s]; infinite for none.
        solver: of quadratic programs, see ``predictive.quadratic``.
        compiled: whether a C compiler may be used; without one CasADi's interpreter is.
        steps: of the prediction in each interval.

    Attributes:
        is_native: whether steps are machine code.
    """

    def __init__(
        self,
        prediction: Prediction,
        durations: Array,
        weights: Weights,
        angles: Array,
        inputs: Array,
        rate: float | Array = math.inf,
        solver: str = "daqp",
        compiled: bool = True,
        steps: int = 1,
    ) -> None:
        if not (len(durations) and np.all(durations > 0)):
            raise ConfigError(f"the horizon's intervals are {durations.tolist()} s, expected each more than 0")
        self.prediction, self.durations, self.weights = prediction, np.array(durations), weights
        self.times: Array = np.concatenate([[0.0], np.cumsum(durations)])
        n, nx, na, nj = len(durations), prediction.nx, prediction.na, prediction.nj
        self.angles, self.inputs, self.rate = np.array(angles), np.array(inputs), np.broadcast_to(rate, na)
        self._ranged = self.angles.shape[1]
        self._limited = bool(np.isfinite(self.rate).any())
        self._size = n * na
        fast = native(prediction.slopes, "slopes") if compiled else None
        self.is_native = fast is not None
        slopes = _in_steps(fast or prediction.slopes, steps)
        self._slopes = Buffered(slopes.map(n))
        # Machine code that also knows derivatives is quicker than an interpreted step.
        self._roll = Buffered(_rolling(fast or prediction.step, steps).mapaccum(n))
        self._scale = np.array(np.broadcast_to(weights.pressure, na), dtype=np.float64)
        self._effort = np.repeat(durations, na)
        self._weight = np.zeros((n - 1, nx))
        self._weight[:, :nj] = np.sqrt(durations[1:, None]) / weights.angle
        self._weight[:, nj : 2 * nj] = np.sqrt(durations[1:, None]) / weights.rate
        limit = np.broadcast_to(weights.limit, nj)
        if self._ranged > nj:  # beyond the bounds of velocities alike
            limit = np.append(limit, limit * weights.rate / weights.angle)
        self._soft: Array = np.append(durations[1:], durations[-1])[:, None] / limit**2
        sizes = ((weights.angle, nj), (weights.rate, nj), (weights.pressure, na))
        self._allowed = np.concatenate([np.broadcast_to(x, size) for x, size in sizes])
        self._big, self._small = np.zeros((n, nx, n * na)), np.zeros((n, nx))
        self._rows = np.zeros((2 * nj * (n - 1) + nx, n * na))
        self._hessian, self._gradient = np.zeros((n * na, n * na)), np.zeros(n * na)
        self._steepest, self._error = np.zeros(nx), np.zeros((n, nx))
        rows = None
        if self._limited:
            rows = np.eye(n * na) - np.eye(n * na, k=-na)
        self._program = QuadraticProgram(n * na, rows, solver)

    def allow(self, effort: Array) -> None:
        """From now on allow (na,) commands beyond what the reference asks for, in their unit."""
        self._scale[:] = effort

    def solve(
        self,
        start: Array,
        disturbance: Array,
        wanted: Wanted,
        guess: Plan,
        *,
        fixed: Array | None = None,
        before: Array | None = None,
        period: float = math.inf,
        iterations: int = 10,
        tolerance: float = 1e-3,
        enough: Callable[[], bool] = lambda: False,
    ) -> Answer:
        """A plan from a state on.

        Args:
            start: (nx,) the state at its beginning.
            disturbance: (nj,) torques that the model does not explain, taken as lasting [N·m].
            wanted: where the robot is to be.
            guess: where to begin.
            fixed: (n, na) inputs that are no longer free; NaN for those that are [Pa].
            before: (na,) inputs in force before [Pa]; needed where rates are limited.
            period: between two commands: by so much time may an input have moved since ``before`` [s].
            iterations: at most.
            tolerance: it has converged where no input changes by more, in acceptable deviations.
            enough: asked before each iteration whether it must not begin any more.
        """
        n, na = len(self.durations), self.prediction.na
        low, high = np.tile(self.inputs[0], (n, 1)), np.tile(self.inputs[1], (n, 1))
        bound = np.zeros((n, na), dtype=bool) if fixed is None else np.isfinite(fixed)
        if fixed is not None:
            low, high = np.where(bound, fixed, low), np.where(bound, fixed, high)
        plan = Plan(guess.time, np.clip(guess.inputs, low, high), np.vstack([start, guess.states[1:]]))
        limits = _Limits(low, high)
        if self._limited:
            assert before is not None, "limited rates need to know where the inputs were"
            span = self._spans(bound, period)
            blocked = self._blocked(low, high, bound, before, span)
            if blocked:
                return Answer(plan, "failed", 0, math.inf, math.inf, math.inf, blocked)
            limits = _Limits(low, high, np.where(bound, UNBOUNDED, np.minimum(span, UNBOUNDED)), np.asarray(before))
            # Steps go from one admissible plan to another, and so does any part of one.
            plan = Plan(plan.time, limits.nearest(plan.inputs), plan.states)
        self._slopes.arguments[2][:] = np.tile(disturbance, n)
        self._slopes.arguments[3][:] = self.durations
        origin, moved, share, closed = plan, None, 1.0, False
        penalty, merit = np.zeros(self.prediction.nx), math.inf
        step, done = math.inf, 0
        found = _Linearised(math.inf, math.inf, penalty, self._slopes.results[1])

        def answer(plan: Plan, outcome: Outcome, reason: str = "") -> Answer:
            # Solvers leave a bound by rounding.
            plan = Plan(plan.time, np.clip(plan.inputs, low, high), plan.states)
            return Answer(plan, outcome, done, step, found.defect, found.cost, reason)

        while done < iterations and not enough():
            found = self._linearised(plan, wanted)
            done += 1
            value = found.cost + float(penalty @ found.jumps)
            if moved is not None and not value <= merit + TINY * (1 + abs(merit)):
                if share <= SHORTEST:
                    return answer(origin, "iterated", "no step leads to a better plan")
                share = share / 2 if closed else 1.0
                closed = True
                plan = self._rolled(origin, moved[0], share, disturbance)
                continue
            if not math.isfinite(value + float(found.jumps.sum())):
                return answer(origin, "failed", "the predicted motion leaves every bound")
            moved = self._step(plan, limits)
            if moved is None:
                reason = "the QP solver found no solution of a program that has one"
                return answer(plan, "iterated" if done > 1 else "failed", reason)
            # With the multipliers of where it leads: those of a guess that errs nowhere say nothing.
            steepest(found.by_x, self._error + moved[1][1:], self._weight, wanted.last, self._steepest)
            penalty = np.maximum(penalty, SAFE * self._steepest)
            merit = found.cost + float(penalty @ found.jumps)
            step = float(np.abs(moved[0] / self._scale).max())
            origin, share, closed = plan, 1.0, False
            plan = Plan(plan.time, plan.inputs + moved[0], plan.states + moved[1])
            if step <= tolerance and found.defect <= tolerance:
                return answer(plan, "converged")
        if done == 0:
            return answer(plan, "failed", "no time was left for a solution")
        return answer(plan, "iterated")

    def shifted(self, plan: Plan, time: float, wanted: Wanted) -> Plan:
        """A plan as a guess for one that begins later; beyond its end, what is wanted there."""
        later = time - plan.time
        middle = self.times[:-1] + self.durations / 2 + later
        index = np.searchsorted(self.times, middle, side="right") - 1
        inside = index < len(self.durations)
        rows = np.minimum(index, len(self.durations) - 1)
        inputs = np.where(inside[:, None], plan.inputs[rows], wanted.feed)
        at = self.times + later
        place = np.clip(np.searchsorted(self.times, at, side="right") - 1, 0, len(self.durations) - 1)
        part = np.clip((at - self.times[place]) / self.durations[place], 0.0, 1.0)[:, None]
        states = (1 - part) * plan.states[place] + part * plan.states[place + 1]
        return Plan(time, inputs, states)

    def first_guess(self, time: float, start: Array, disturbance: Array, wanted: Wanted) -> Plan:
        """What the reference takes, as far as it is within limits, and where it leads from a state (nx,)."""
        inputs = np.clip(wanted.feed, *self.inputs)
        nothing = Plan(time, inputs, np.tile(start, (len(self.times), 1)))
        return self._rolled(nothing, np.zeros_like(inputs), 0.0, disturbance)

    def _rolled(self, plan: Plan, by: Array, share: float, disturbance: Array) -> Plan:
        """A plan with a share of a change of its inputs, and where these lead without a defect."""
        inputs = plan.inputs + share * by
        x, u, d, h = self._roll.arguments
        x[:], u[:], d[:], h[:] = plan.states[0], inputs.ravel(), np.tile(disturbance, len(inputs)), self.durations
        self._roll()
        return Plan(plan.time, inputs, np.vstack([plan.states[0], self._roll.results[0].T]))

    def _linearised(self, plan: Plan, wanted: Wanted) -> _Linearised:
        """What a plan comes to; the program about it is made ready."""
        x, u, _, _ = self._slopes.arguments
        x[:], u[:] = plan.states[:-1].ravel(), plan.inputs.ravel()
        self._slopes()
        after, by_x, by_u, _ = self._slopes.results
        gap = after.T - plan.states[1:]
        fold(by_x, by_u, gap, self._scale, self._big, self._small)
        error = self._error
        error[:, : len(self._allowed)] = plan.states[1:, : len(self._allowed)] - wanted.states[1:]
        effort = ((plan.inputs - wanted.feed) / self._scale).ravel()
        cost = weigh(
            self._big, self._small, error, self._weight, wanted.last, effort, self._effort, self._rows, self._hessian,
            self._gradient,
        )  # fmt: skip
        beyond = self._beyond(plan.states[1:, : self._ranged])
        if beyond.any():
            # A motion that overflows has left every bound; its cost says so.
            with np.errstate(over="ignore", invalid="ignore"):
                cost += 0.5 * float((self._soft * beyond**2).sum())
        size = np.abs(gap)
        seen = size[:, : len(self._allowed)].max(axis=0) / self._allowed
        return _Linearised(cost, float(seen.max()), size.sum(axis=0), by_x)

    def _beyond(self, q: Array) -> Array:
        """(n, k) by how much angles, and velocities, are above their range, or below it, negative then [rad, rad/s]."""
        return np.asarray(q - np.minimum(np.maximum(q, self.angles[0]), self.angles[1]))

    def _step(self, plan: Plan, limits: _Limits) -> tuple[Array, Array] | None:
        """Changes of inputs (n, na) and states (n + 1, nx), or None where none was found."""
        n, na, nj = len(self.durations), self.prediction.na, self._ranged
        lower, upper = (((side - plan.inputs) / self._scale).ravel() for side in (limits.low, limits.high))
        rates = self._changes(plan, limits)
        big = self._big.reshape(-1, self._size)
        base = plan.states[1:, :nj] + self._small[:, :nj]
        beyond = self._beyond(base)
        inputs, follows = np.zeros(self._size), np.zeros((n, self.prediction.nx))
        for _ in range(PASSES):
            h, g, active = self._hessian, self._gradient, beyond != 0
            if active.any():
                rows = self._big[:, :nj][active]
                weight = np.broadcast_to(self._soft, active.shape)[active]
                side = np.where(beyond > 0, self.angles[1], self.angles[0])
                h = h + (rows.T * weight) @ rows
                g = g + rows.T @ (weight * (base - side)[active])
            solved = self._program.solve(h, g, lower, upper, *rates)
            if solved is None:
                return None
            inputs = solved
            follows = (big @ inputs).reshape(n, -1)
            now = self._beyond(base + follows[:, :nj])
            settled, beyond = np.array_equal(np.sign(now), np.sign(beyond)), now
            if settled:
                break
        states = np.zeros_like(plan.states)
        states[1:] = self._small + follows
        return inputs.reshape(n, na) * self._scale, states

    def _spans(self, bound: NDArray[np.bool_], period: float) -> Array:
        """(n, na) by how much each input may differ from the one before [Pa]."""
        span: Array = np.append(period, self.durations[:-1])[:, None] * self.rate
        for i, first in enumerate(bound.sum(axis=0)):  # what is no longer free comes first
            if first < len(span):
                span[first, i] = self.rate[i] * period
        return span

    def _changes(self, plan: Plan, limits: _Limits) -> tuple[Array, ...]:
        """Least and most (n·na,) of how inputs change from one interval to the next, beyond what they do [scales]."""
        if limits.span is None or limits.before is None:
            return ()
        does = np.diff(np.vstack([limits.before, plan.inputs]), axis=0)
        return tuple(((side * limits.span - does) / self._scale).ravel() for side in (-1, 1))

    def _blocked(self, low: Array, high: Array, bound: NDArray[np.bool_], before: Array, span: Array) -> str:
        """Which limits leave no way, in words; empty where there is one."""
        robot = self.prediction.model.robot
        down, up = np.array(before), np.array(before)
        for k in range(len(low)):
            for i, name in enumerate(robot.actuator_names):
                if bound[k, i]:
                    down[i] = up[i] = low[k, i]
                    continue
                least, most = down[i] - span[k, i], up[i] + span[k, i]
                if least > high[k, i] + KEPT * self._scale[i] or most < low[k, i] - KEPT * self._scale[i]:
                    own = reading(robot.command_units[i])
                    from_least, from_low = (f"{own.factor * x:.4g}" for x in (least, low[k, i]))
                    return (
                        f"{name}: from {own.text(up[i])} the rate limit of {own.text(self.rate[i])}/s leads to "
                        f"{from_least} to {own.text(most)}, but the limits of what reaches the valve are "
                        f"{from_low} to {own.text(high[k, i])}"
                    )
                down[i], up[i] = max(least, low[k, i]), min(most, high[k, i])
        return ""


def _in_steps(slopes: ca.Function, steps: int) -> ca.Function:
    """(x, u, d, h) → x after h and its derivatives by x, u and d, in so many steps."""
    if steps == 1:
        return slopes
    x, u, d, h = (ca.MX.sym(name, slopes.size1_in(i)) for i, name in enumerate("xudh"))
    after, by_x, by_u, by_d = slopes(x, u, d, h / steps)
    for _ in range(steps - 1):
        after, next_x, next_u, next_d = slopes(after, u, d, h / steps)
        by_x, by_u, by_d = next_x @ by_x, next_x @ by_u + next_u, next_x @ by_d + next_d
    return ca.Function("slopes", [x, u, d, h], [after, by_x, by_u, by_d])


def _rolling(step: ca.Function, steps: int) -> ca.Function:
    """(x, u, d, h) → x after h, in so many steps of a function whose first result is that after one."""
    x, u, d, h = (ca.MX.sym(name, step.size1_in(i)) for i, name in enumerate("xudh"))
    after = x
    for _ in range(steps):
        found = step(after, u, d, h / steps)
        after = found[0] if step.n_out() > 1 else found
    return ca.Function("rolling", [x, u, d, h], [after])


@dataclass(frozen=True, eq=False)
class _Limits:
    """Of inputs (n, na): low, high, and by how much they may differ from the one before, of which the first [Pa]."""

    low: Array
    high: Array
    span: Array | None = None
    before: Array | None = None

    def nearest(self, inputs: Array) -> Array:
        """Admissible inputs, each as near to one of these (n, na) as those before it allow."""
        if self.span is None or self.before is None:
            return np.clip(inputs, self.low, self.high)
        found, last = np.empty_like(inputs), self.before
        for k, span in enumerate(self.span):
            found[k] = last = np.clip(np.clip(inputs[k], last - span, last + span), self.low[k], self.high[k])
        return found


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Of a plan: cost, largest defect (acceptable = 1), (nx,) sums of defects, (nx, n·nx) its steps' derivatives."""

    cost: float
    defect: float
    jumps: Array
    by_x: Array
