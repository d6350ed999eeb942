"""Nonlinear model-predictive control on what an observer knows from angles and commands.

At every control instant the problem of ``predictive.problem`` is solved from where the robot will be when the command
arrives, about the plan of the instant before, shifted. What the reference takes comes from the inverse model, what
lies beyond the horizon costs what the regulator of ``controllers.lqr`` would let it cost. What cannot be solved, or not
in time, falls back: to the shifted plan, else to the regulator, else to the command in force.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.inverse import Inverse, InverseState, Target
from equimus_ctrl.controllers.lqr import CALM, LqrSettings, Schedule, waiting
from equimus_ctrl.controllers.preview import Ahead, Preview, Sight
from equimus_ctrl.controllers.settings import settings_from, table_of
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import Estimate, Observer, ObserverSettings, ObserverState
from equimus_ctrl.models.linear import fastest_rates, valve_lag
from equimus_ctrl.models.prediction import prediction
from equimus_ctrl.predictive.problem import Answer, Plan, Problem, Wanted, Weights
from equimus_ctrl.predictive.quadratic import SOLVERS
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

FORMAT = "equimus-ctrl/nmpc/1"

Status = Literal["converged", "iterated", "shifted", "lqr", "hold"]
FALLBACKS = ("shifted", "lqr", "hold")
"""Statuses of commands that no solution of this instant stands behind."""

SLOWER = 1.2
"""By so much may an iteration take longer from one instant to the next before that is doubted."""
FOLLOWED = 2.0
"""Fastest rate times step that a Runge–Kutta step is given; it would be stable to 2.78. Intervals are divided."""


@dataclass(frozen=True)
class NmpcSettings:
    """Settings of the predictive controller. An error as large as its allowance costs as much as an effort of its own.

    Attributes:
        nodes: intervals of the horizon.
        stride: how many control periods each interval lasts, those in which the next command takes hold apart: they
            last one.
        angle: allowance of angles [rad].
        rate: of velocities [rad/s].
        pressure: of pressures beyond what the reference asks for [Pa].
        limit: of angles beyond a joint's range [rad]; such ranges are soft.
        margin: by how much that range is narrower than from stop to stop [rad].
        pressure_rate: how fast what reaches the valves may change [Pa/s]; 0 for any.
        iterations: programs solved at one instant, at most; 1 is the real-time iteration.
        tolerance: it has converged where no pressure changes by more, in allowances.
        deadline: what is not solved by then after the step began falls back [s]; 0 for no deadline, as in simulation,
            where a run is to give the same bits each time.
        disturbance: whether torques that the observer cannot explain are taken to last.
        solver: of quadratic programs.
        compiled: whether a C compiler is used where there is one.
        spacing: of the grid of poses that the regulator behind the horizon is worked out at [rad].
        start_time: over which the first pose fades out of the reference [s].
        observer: how much is believed.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    nodes: int = 25
    stride: int = 2
    angle: float = 0.03
    rate: float = 1.0
    pressure: float = 1e3
    limit: float = 0.003
    margin: float = 0.0
    pressure_rate: float = 0.0
    iterations: int = 5
    tolerance: float = 0.01
    deadline: float = 0.0
    disturbance: bool = True
    solver: str = "daqp"
    compiled: bool = True
    spacing: float = 0.2
    start_time: float = 0.3
    observer: ObserverSettings = field(default_factory=lambda: ObserverSettings(disturbance=CALM))

    def __post_init__(self) -> None:
        for key, least, most in (("nodes", 2, 500), ("stride", 1, 100), ("iterations", 1, 1000)):
            value = getattr(self, key)
            if not least <= value <= most:
                raise ConfigError(f"{key} is {value}, expected {least} to {most}")
        for key in ("angle", "rate", "pressure", "limit", "tolerance", "spacing"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{key} is {value:g}, expected more than 0")
        for key in ("margin", "pressure_rate", "deadline", "start_time"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected at least 0")
        if self.solver not in SOLVERS:
            raise ConfigError(f"solver is {self.solver!r}, expected one of {', '.join(SOLVERS)}")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str = "NMPC settings") -> NmpcSettings:
        """From what a TOML file holds.

        Raises:
            ConfigError: for a key that there is not, or a value that does not fit.
        """
        return settings_from(cls, data, where, FORMAT)

    def to_dict(self) -> dict[str, Any]:
        """What a TOML file of these settings holds."""
        return table_of(self, FORMAT)

    def regulator(self) -> LqrSettings:
        """The regulator that goes on behind the horizon."""
        return LqrSettings(self.angle, self.rate, self.pressure, spacing=self.spacing)


@dataclass(frozen=True, eq=False)
class NmpcState:
    """What the controller carries from step to step.

    Attributes:
        observer: what is known of the robot.
        followed: where the reference was begun.
        sight: what is known of the reference ahead.
        plan: the latest plan that was solved for, or None.
        status: of the latest command, one of ``"converged"``, ``"iterated"`` (time or iterations ended it first, and
            always in real-time iteration), ``"shifted"`` (the plan of an instant before), ``"lqr"`` and ``"hold"``.
        reason: why it fell back; empty where it did not.
        answer: the latest solution, or None.
        under_way: for each actuator commands beyond what the reference asked for, the next to arrive first [Pa].
        expected: what an iteration is known to take, where there is a deadline [s].
        tools: made for the plant once.
    """

    observer: ObserverState
    followed: InverseState
    sight: Sight | None
    plan: Plan | None
    status: Status
    reason: str
    answer: Answer | None
    under_way: tuple[Array, ...]
    expected: float
    tools: NmpcTools

    @property
    def fell_back(self) -> bool:
        """Whether no solution of this instant stands behind the command."""
        return self.status in FALLBACKS


def intervals(nodes: int, stride: int, later: NDArray[np.int64]) -> NDArray[np.int64]:
    """(nodes,) how many control periods each interval of a horizon lasts.

    The first one in which an actuator obeys the next command lasts one period, all others up to a stride.

    Args:
        nodes: how many.
        stride: the longest.
        later: (na,) how many periods later than the first each actuator obeys.
    """
    edges = sorted({int(edge) for count in later for edge in (count, count + 1)})
    found: list[int] = []
    at = 0
    while len(found) < nodes:
        following = next((edge for edge in edges if edge > at), at + stride)
        found.append(min(stride, following - at))
        at += found[-1]
    return np.array(found, dtype=np.int64)


class _Pace:
    """Whether another iteration is likely to end before the deadline.

    Args:
        now: a clock [s].
        begun: when the step began [s].
        deadline: how long after that all is to be done [s].
        expected: what an iteration is known to take [s]; 0 where nothing is known.
    """

    def __init__(self, now: Callable[[], float], begun: float, deadline: float, expected: float) -> None:
        self._now, self._begun, self._deadline, self._expected = now, begun, deadline, expected
        self._iterating: float | None = None
        self._longest = 0.0

    def enough(self) -> bool:
        """Whether no further iteration is to begin."""
        now = self._ended()
        over = now + max(self._longest, self._expected) > self._begun + self._deadline
        self._iterating = None if over else now
        return over

    def end(self) -> float:
        """How long after the step began all iterations have ended [s]."""
        return self._ended() - self._begun

    @property
    def expected(self) -> float:
        """What an iteration is to be known to take from now on [s]: one that was held up is not taken as the rule."""
        if self._longest == 0:
            return self._expected
        return min(self._longest, SLOWER * self._expected) if self._expected else self._longest

    def _ended(self) -> float:
        now = self._now()
        if self._iterating is not None:
            self._longest, self._iterating = max(self._longest, now - self._iterating), None
        return now


@dataclass(frozen=True, eq=False)
class NmpcTools:
    """What is made once for a plant."""

    observer: Observer
    inverse: Inverse
    preview: Preview
    schedule: Schedule
    problem: Problem
    seen: NDArray[np.intp]
    """(k,) which states of the prediction the regulator has."""
    dt: float


class NmpcController:
    """The predictive controller; its state is an ``NmpcState``.

    Args:
        settings: of it.
        now: a clock for the deadline [s].
    """

    name = "nmpc"

    def __init__(self, settings: NmpcSettings | None = None, now: Callable[[], float] = clock.perf_counter) -> None:
        self.settings = settings or NmpcSettings()
        self._now = now

    def init(self, spec: PlantSpec, observation: Observation) -> NmpcState:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model.
            ConfigError: where the margin leaves nothing of a joint's range.
        """
        s = self.settings
        observer = Observer.of(spec, s.observer, s.compiled)
        model, dt = observer.model, spec.control_dt
        robot = changed_bodies(model.effects, model.morphology)
        periods = intervals(s.nodes, s.stride, waiting(model, dt))
        low, high = np.array(spec.joint_low) + s.margin, np.array(spec.joint_high) - s.margin
        for name, least, most in zip(spec.joints, low, high, strict=True):
            if least >= most:
                raise ConfigError(
                    f"margin is {s.margin:g} rad, but {name} turns from {least - s.margin:.4g} to "
                    f"{most + s.margin:.4g} rad only"
                )
        middle = (np.clip(low, -np.pi, np.pi) + np.clip(high, -np.pi, np.pi)) / 2
        rate, step = fastest_rates(robot, middle, model.phase)[0], float(s.stride * dt)
        inverse = Inverse(model, dt, s.start_time)
        limits = np.vstack([inverse.low, inverse.high])
        reached = shaped_commands(model.effects, inverse.actuators, limits)
        predicted = prediction(model, stops=False)
        problem = Problem(
            predicted,
            np.asarray(dt * periods, dtype=np.float64),
            Weights(s.angle, s.rate, s.pressure, s.limit),
            np.vstack([low, high]),
            np.vstack([np.minimum(*reached), np.maximum(*reached)]),
            s.pressure_rate or math.inf,
            s.solver,
            s.compiled,
            math.ceil(rate * step / FOLLOWED),
        )
        schedule = Schedule(model, s.regulator(), dt)
        schedule.prepare()
        lagging = np.flatnonzero(valve_lag(valve_settings(model.effects, inverse.actuators)) > 0)
        seen = np.concatenate([np.arange(2 * predicted.nj), 2 * predicted.nj + lagging])
        preview = Preview(inverse, periods, dt, float(observer.delays.min()))
        tools = NmpcTools(observer, inverse, preview, schedule, problem, seen, dt)
        under_way = tuple(np.zeros(count) for count in waiting(model, dt))
        followed = inverse.start(observation.time, np.array(observation.position))
        return NmpcState(observer.init(observation), followed, None, None, "hold", "", None, under_way, 0.0, tools)

    def step(self, observation: Observation, reference: Reference, state: NmpcState) -> tuple[Array, NmpcState]:
        """The next command, within the plant's limits.

        Raises:
            ObserverFault: where a joint was not measured for longer than the observer has patience.
        """
        s, t = self.settings, state.tools
        begun = self._now() if s.deadline else 0.0
        observer = t.observer.update(observation, state.observer)
        t.observer.require_sound(observer)
        arrival = observation.time + float(t.observer.delays.min())
        known = t.observer.foresee(observer, arrival)
        # The effects' own states are the observer's: what is asked of the valves ahead goes on from them.
        own = known.state[2 * t.problem.prediction.nj + t.problem.prediction.na :]
        followed = replace(state.followed, states=np.tile(own, (len(state.followed.states), 1)))
        path, sight = t.preview.look(reference, observation.time, followed, state.sight)
        push = known.disturbance if s.disturbance else np.zeros_like(known.disturbance)
        against = -t.inverse.counter(known.position, push)
        path = replace(path, feed=path.feed + against, pressure=path.pressure + against)
        fixed, first = self._fixed(t, observer, arrival)
        wanted = self._wanted(t, path)
        before = observer.sent.values[-1]
        fallback = None
        if state.plan is not None and arrival < state.plan.time + t.problem.times[-1]:
            guess = fallback = t.problem.shifted(state.plan, arrival, wanted)
        else:
            guess = t.problem.first_guess(arrival, known.state, push, wanted)
        pace = _Pace(self._now, begun, s.deadline, state.expected) if s.deadline else None
        answer = t.problem.solve(
            known.state, push, wanted, guess, fixed=fixed, before=before, period=t.dt, iterations=s.iterations,
            tolerance=s.tolerance, enough=pace.enough if pace else lambda: False,
        )  # fmt: skip
        late = pace.end() if pace else 0.0
        status, reason, asked = self._chosen(answer, late, fallback, first)
        if status == "lqr":
            status, asked = self._regulated(t, known, path, against, state)
        if asked is None:
            command = np.asarray(observation.command)
        else:
            if s.pressure_rate:
                asked = np.clip(asked, before - s.pressure_rate * t.dt, before + s.pressure_rate * t.dt)
            command = t.inverse.commands(asked[None])[0]
        arriving = shaped_commands(t.observer.model.effects, t.inverse.actuators, command[None])[0]
        beyond = arriving - path.feed[first, np.arange(len(first))]
        under_way = tuple(
            np.append(old[1:], new) if len(old) else old for old, new in zip(state.under_way, beyond, strict=True)
        )
        return frozen_array(command), replace(
            state,
            observer=observer,
            sight=sight,
            plan=state.plan if answer.outcome == "failed" else answer.plan,
            status=status,
            reason=reason,
            answer=answer,
            under_way=under_way,
            expected=pace.expected if pace else 0.0,
        )

    def _chosen(
        self, answer: Answer, late: float, fallback: Plan | None, first: NDArray[np.intp]
    ) -> tuple[Status, str, Array | None]:
        """Status, why it fell back, and (na,) what is to reach the valves, of a plan made now or an instant before."""
        own = np.arange(len(first))
        if answer.outcome != "failed" and late <= self.settings.deadline:
            return answer.outcome, "", answer.plan.inputs[first, own]
        reason = answer.reason or (
            f"the solution came {late * 1e3:.3g} ms after the step began, but the deadline is "
            f"{self.settings.deadline * 1e3:.3g} ms"
        )
        if fallback is not None and np.isfinite(fallback.inputs).all():
            return "shifted", reason, fallback.inputs[first, own]
        return "lqr", reason, None

    def _regulated(
        self, t: NmpcTools, known: Estimate, path: Ahead, against: Array, state: NmpcState
    ) -> tuple[Status, Array | None]:
        """What the regulator asks for, or nothing where it has no gains or no state."""
        target = Target(path.position[0], path.velocity[0], path.pressure[0] - against, path.feed[0])
        try:
            asked = path.feed[0] + t.schedule.correction(known, target, against, state.under_way)
        except ControllerError:
            return "hold", None
        return ("lqr", asked) if np.isfinite(asked).all() else ("hold", None)

    def _fixed(self, t: NmpcTools, observer: ObserverState, arrival: float) -> tuple[Array | None, NDArray[np.intp]]:
        """(n, na) inputs that commands under way have settled, NaN for those still free, and (na,) the first free."""
        delays, problem = t.observer.delays, t.problem
        first = np.zeros(len(delays), dtype=np.intp)
        later = delays - delays.min()
        if not later.any():
            return None, first
        fixed = np.full((len(problem.durations), len(delays)), np.nan)
        for i in np.flatnonzero(later > 0):
            # An interval most of which is over when the command arrives is no longer free.
            middle = problem.times[:-1] + problem.durations / 2
            taken = np.flatnonzero(middle < later[i])
            for k in taken:
                fixed[k, i] = observer.sent.at(arrival + float(middle[k]) - float(delays[i]), int(i))
            first[i] = min(len(taken), len(fixed) - 1)
        return fixed, first

    def _wanted(self, t: NmpcTools, path: Ahead) -> Wanted:
        nx = t.problem.prediction.nx
        last = np.zeros((nx, nx))
        k = len(t.seen)
        try:
            cost = t.schedule.cost(path.position[-1])[:k, :k]
            last[np.ix_(t.seen, t.seen)] = np.linalg.cholesky(cost).T
        except (ControllerError, np.linalg.LinAlgError):
            # Without a regulator there the last state counts as all others do.
            weights, span = t.problem.weights, math.sqrt(t.problem.durations[-1])
            nj = len(path.position[-1])
            last[np.diag_indices(2 * nj)] = span / np.repeat([weights.angle, weights.rate], nj)
        return Wanted(np.hstack([path.position, path.velocity, path.pressure]), path.feed, last)
