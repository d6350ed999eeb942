"""Nonlinear model-predictive control on what an observer knows from angles and commands.

At every control instant the problem of ``predictive.problem`` is solved from where the robot will be when the command
arrives, about the plan of the instant before, shifted. What the reference takes comes from the inverse model, what
lies beyond the horizon costs what the regulator of ``controllers.lqr`` would let it cost. What cannot be solved, or not
in time, falls back: to the shifted plan, else to the regulator, else to the command in force.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.allowances import settable
from equimus_ctrl.controllers.horizon import Horizon, HorizonSettings, HorizonState
from equimus_ctrl.controllers.pace import Pace
from equimus_ctrl.controllers.planning import begun
from equimus_ctrl.controllers.valve_estimation import found_out
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.estimation.observer import Observer, require_model
from equimus_ctrl.predictive.problem import Answer, Plan, Problem
from equimus_ctrl.predictive.quadratic import SOLVERS
from equimus_ctrl.settings import FileSettings
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference

FORMAT = "equimus-ctrl/nmpc/1"


@dataclass(frozen=True)
class NmpcSettings(HorizonSettings, FileSettings):
    """Settings of the predictive controller, beside what a ``HorizonSettings`` allows.

    Attributes:
        nodes: intervals of the horizon.
        stride: how many control periods each interval lasts, except those in which the next command takes hold: they
            last one.
        iterations: programs solved at one instant, at most; 1 is the real-time iteration.
        tolerance: it has converged where no command changes by more, in acceptable deviations.
        velocity: soft bound of the joints' velocities, either way [rad/s or m/s]; 0 for none.
        solver: of quadratic programs.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    form: ClassVar[str] = FORMAT

    nodes: int = 25
    stride: int = 2
    iterations: int = 5
    tolerance: float = 0.01
    velocity: float = 0.0
    solver: str = "daqp"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._count("nodes", 2, 500)
        self._count("stride", 1, 100)
        self._count("iterations", 1, 1000)
        self._require(("tolerance",), above=0.0)
        self._require(("velocity",), least=0.0)
        if self.solver not in SOLVERS:
            raise ConfigError(f"solver is {self.solver!r}, expected one of {', '.join(SOLVERS)}")


@dataclass(frozen=True, eq=False)
class NmpcState(HorizonState):
    """What the controller carries from step to step.

    Attributes:
        plan: the latest one that was solved for, or None.
        answer: the latest solution, or None.
        tools: made for the plant, and its valves, once.
    """

    plan: Plan | None
    tools: NmpcTools
    answer: Answer | None


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


@dataclass(frozen=True, eq=False)
class NmpcTools:
    """What is made once for a plant."""

    horizon: Horizon
    problem: Problem

    @property
    def observer(self) -> Observer:
        """That of the horizon."""
        return self.horizon.observer

    def taken_over(self, state: NmpcState) -> dict[str, Any]:
        """See ``controllers.valve_estimation``."""
        return self.horizon.taken_over(state)


class NmpcController:
    """The predictive controller; its state is an ``NmpcState``.

    Args:
        settings: of it.
        now: a clock for the deadline [s].
        said: of its settings, for a person to read; stands before what it says itself.
    """

    name = "nmpc"

    def __init__(
        self, settings: NmpcSettings | None = None, now: Callable[[], float] = clock.perf_counter, said: str = ""
    ) -> None:
        self.settings = settings or NmpcSettings()
        self._now, self._said = now, said

    def init(self, spec: PlantSpec, observation: Observation) -> NmpcState:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model, or one without equations, or no regulator keeps the robot
                where it is.
            ConfigError: where the margin leaves nothing of a joint's range, or a setting changes nothing of the robot.
        """
        s, position = self.settings, np.array(observation.position)
        require_model(spec)
        s.check_idle(settable(spec.model), self.name, spec.model.name)

        def make(own: PlantSpec, settings: NmpcSettings, known: Horizon | None) -> NmpcTools:
            return self._tools(own, settings, position, known)

        return NmpcState(**begun(make, spec, s, observation, self._said), answer=None)

    @staticmethod
    def _tools(spec: PlantSpec, s: NmpcSettings, position: Array, known: Horizon | None = None) -> NmpcTools:
        banked = known is None and s.estimate_valves
        horizon = Horizon(spec, s, lambda later: intervals(s.nodes, s.stride, later), position, banked, known)
        angles = s.joint_range(spec)
        if s.velocity:
            angles = np.hstack([angles, s.velocity * np.array([[-1.0], [1.0]]) * np.ones(len(position))])
        problem = Problem(
            horizon.prediction,
            horizon.durations,
            horizon.weights,
            angles,
            horizon.reached,
            horizon.rate,
            s.solver,
            s.compiled,
            horizon.parts,
        )
        return NmpcTools(horizon, problem)

    def step(self, observation: Observation, reference: Reference, state: NmpcState) -> tuple[Array, NmpcState]:
        """The next command, within the plant's limits.

        Raises:
            ObserverFault: where a joint was not measured for longer than the observer has patience.
        """
        pace = Pace(self._now, self.settings.deadline, state.expected)
        state = found_out(observation, state)
        s, horizon, problem = self.settings, state.tools.horizon, state.tools.problem
        view = horizon.look(observation, reference, state)
        shifted = None
        if state.plan is not None and view.arrival < state.plan.time + problem.times[-1]:
            guess = shifted = problem.shifted(state.plan, view.arrival, view.wanted)
        else:
            guess = problem.first_guess(view.arrival, view.known.state, view.disturbance, view.wanted)
        problem.allow(view.effort)
        answer = problem.solve(
            view.known.state, view.disturbance, view.wanted, guess, fixed=view.fixed, before=view.before,
            period=horizon.dt, iterations=s.iterations, tolerance=s.tolerance, enough=pace.enough,
        )  # fmt: skip
        overrun = horizon.overrun(pace.end())
        failed = answer.outcome == "failed"
        status, reason, asked = horizon.choose(
            view,
            None if failed else answer.plan.inputs,
            "converged" if answer.outcome == "converged" else "iterated",
            (answer.reason if failed else "") or overrun,
            None if shifted is None else shifted.inputs,
            state,
        )
        command, state = horizon.send(view, asked, observation, state)
        plan = state.plan if failed else answer.plan
        return command, replace(state, plan=plan, status=status, reason=reason, answer=answer, expected=pace.expected)
