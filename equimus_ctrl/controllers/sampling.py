"""Sampling model-predictive control: at every instant many plans are tried in MuJoCo, and the best ones followed.

What follows is for robots with elastic actuators; what has none is driven as ``controllers.sampling_any`` says.

A plan is a spline of pressures beyond what the reference asks of the valves. Its cost is that of the NMPC: errors and
efforts in allowances, and the regulator's cost behind the horizon. The nominal plan of the instant before, shifted, is
always tried; the generator's numbers follow from the seed and the instant, so that a run gives the same bits each time.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from equimus_ctrl.controllers import sampling_any
from equimus_ctrl.controllers.horizon import Horizon, HorizonSettings, HorizonState, Outlook, Pace
from equimus_ctrl.controllers.sampling_any import AnySamplingSettings, AnySamplingState, Waiting
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.predictive.costs import Wanted, costs
from equimus_ctrl.predictive.rollouts import ENGINES, Rollouts, make_rollouts, members_of
from equimus_ctrl.predictive.sampling import METHODS, Memory, Method, Spread
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.settings import FileSettings
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

FORMAT = "equimus-ctrl/sampling/1"

Penalty = Callable[[Array, Array, Array, Wanted], Array]
"""(times (n + 1,) [s], states (m, n + 1, k), inputs (m, n, na) [Pa], what is wanted) → (m,) what is added to costs."""


@dataclass(frozen=True)
class SamplingSettings(HorizonSettings, FileSettings):
    """Settings of the sampling controller, beside what a ``HorizonSettings`` allows.

    Attributes:
        method: of ``predictive.sampling.METHODS``.
        samples: plans tried at once, the nominal one included.
        steps: of the horizon.
        stride: how many control periods each lasts.
        knots: of a plan's spline.
        spline: ``"zero"`` (each knot holds until the next), ``"linear"`` or ``"cubic"``.
        least_deviation: standard deviation of the knots of the finest plans [Pa].
        deviation: of the boldest [Pa].
        temperature: of MPPI, relative to the difference between the median and the least cost of the plans.
        elites: share of the plans that the cross-entropy method goes on with.
        iterations: rounds of samples at one instant, at most.
        engine: ``"mujoco"``, ``"reduced"`` (the exact reduced model in machine code) or ``"auto"``: MuJoCo where it
            simulates all of the model's effects in many rollouts at once, else the reduced model.
        ensemble: how many models each plan is tried on: the model, and others with perturbed parameters.
        spread: by which share their stiffness, area, damping and mass are perturbed at most.
        risk: share of the models that counts, those on which a plan costs most; 1 for the mean over all.
        seed: of all that is drawn.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    form: ClassVar[str] = FORMAT

    method: str = "cem"
    samples: int = 32
    steps: int = 40
    stride: int = 1
    knots: int = 4
    spline: str = "linear"
    least_deviation: float = 30.0
    deviation: float = 6000.0
    temperature: float = 0.1
    elites: float = 0.1
    iterations: int = 1
    engine: str = "auto"
    ensemble: int = 1
    spread: float = 0.15
    risk: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in METHODS:
            raise ConfigError(unknown_name("method", self.method, METHODS))
        if self.engine not in ENGINES:
            raise ConfigError(f"engine is {self.engine!r}, expected one of {', '.join(ENGINES)}")
        for key, least, most in (
            ("samples", 2, 100_000), ("steps", 2, 1000), ("stride", 1, 100), ("knots", 1, self.steps),
            ("iterations", 1, 1000), ("ensemble", 1, 1000), ("seed", 0, 2**63),
        ):  # fmt: skip
            self._count(key, least, most)
        self._require(("least_deviation", "temperature", "elites", "risk"), above=0.0)
        self._require(("deviation",), least=self.least_deviation)
        self._require(("spread",), least=0.0)
        for key, top in (("elites", 1.0), ("risk", 1.0), ("spread", 0.95)):
            if getattr(self, key) > top:
                raise ConfigError(f"{key} is {getattr(self, key):g}, expected at most {top:g}")
        Spline(self.spline, self.knots, 1.0)


@dataclass(frozen=True, eq=False)
class Sampled:
    """What the plans of one instant came to.

    Attributes:
        time: when they begin [s].
        nominal: (k, na) knots beyond what the reference asks for, to go on with [Pa].
        inputs: (steps, na) what reaches the valves of it [Pa].
        memory: of the method.
        cost: (samples,) of the last round's plans, the nominal one first; infinite where a rollout diverged.
        rounds: how many there were.
    """

    time: float
    nominal: Array
    inputs: Array
    memory: Memory
    cost: Array
    rounds: int


@dataclass(frozen=True, eq=False)
class SamplingState(HorizonState):
    """What the controller carries from step to step.

    Attributes:
        plan: the latest plans, or None.
        count: how many instants there have been, which the generator's numbers follow from.
        tools: made for the plant once.
    """

    plan: Sampled | None
    count: int
    tools: SamplingTools


@dataclass(frozen=True, eq=False)
class SamplingTools:
    """What is made once for a plant."""

    horizon: Horizon
    rollouts: Rollouts
    spline: Spline
    basis: Array
    """(steps, k) the spline in the middle of each step."""
    range: Array
    """(2, nj) soft range of the joints [rad]."""


class SamplingController:
    """The sampling controller; its state is a ``SamplingState``, or of ``controllers.sampling_any``.

    Args:
        settings: of it, of one kind or the other; those of the other kind are the defaults.
        method: another way to find a plan than the settings name.
        penalty: what is added to the costs of plans, see ``Penalty``.
        now: a clock for the deadline [s].
    """

    name = "sampling"

    def __init__(
        self,
        settings: SamplingSettings | AnySamplingSettings | None = None,
        method: Method | None = None,
        penalty: Penalty | None = None,
        now: Callable[[], float] = clock.perf_counter,
    ) -> None:
        self.any_settings = settings if isinstance(settings, AnySamplingSettings) else AnySamplingSettings()
        self.settings = s = settings if isinstance(settings, SamplingSettings) else SamplingSettings()
        self._any_method = method or METHODS[self.any_settings.method]
        self._method, self._penalty, self._now = method or METHODS[s.method], penalty, now
        self._spread = Spread(s.least_deviation, s.deviation, s.temperature, s.elites)

    def init(self, spec: PlantSpec, observation: Observation) -> SamplingState | Waiting:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model, or one that cannot be rolled out.
            ConfigError: where the margin leaves nothing of a joint's range, or the engine lacks an effect.
            ModelError: where MuJoCo cannot simulate the robot.
        """
        if isinstance(spec.model, Robot) and "lengths" not in spec.model.offers:
            return sampling_any.begin(self.any_settings, spec, observation)
        s = self.settings
        horizon = Horizon(spec, s, lambda later: np.full(s.steps, s.stride, dtype=np.int64))
        models = members_of(horizon.observer.model, s.ensemble, s.spread, s.seed)
        rollouts = make_rollouts(models, s.samples, s.steps, s.stride * horizon.dt, s.engine, s.compiled)
        spline = Spline(s.spline, s.knots, float(horizon.times[-1]))
        basis = spline.matrix(horizon.times[:-1] + horizon.durations / 2)
        tools = SamplingTools(horizon, rollouts, spline, basis, s.joint_range(spec))
        return SamplingState(**horizon.begin(observation), plan=None, count=0, tools=tools)

    def step(
        self, observation: Observation, reference: Reference, state: SamplingState | AnySamplingState | Waiting
    ) -> tuple[Array, SamplingState | AnySamplingState]:
        """The next command, within the plant's limits.

        Raises:
            ControllerError: where a joint was not measured for longer than the observer has patience.
        """
        if not isinstance(state, SamplingState):
            own = self.any_settings, self._any_method, self._penalty
            return sampling_any.step(*own, observation, reference, state)
        horizon = state.tools.horizon
        pace = Pace(self._now, self.settings.deadline, state.expected)
        view = horizon.look(observation, reference, state)
        nominal, memory, shifted = self._shifted(view, state)
        found, reason = self._found(view, nominal, memory, state, pace)
        fallback = self._inputs(state.tools, view, nominal[None])[0] if shifted else None
        status, reason, asked = horizon.choose(
            view,
            None if found is None else found.inputs,
            "sampled",
            reason or horizon.overrun(pace.end()),
            fallback,
            state,
        )
        command, state = horizon.send(view, asked, observation, state)
        return command, replace(
            state, plan=found or state.plan, count=state.count + 1, status=status, reason=reason,
            expected=pace.expected,
        )  # fmt: skip

    def _shifted(self, view: Outlook, state: SamplingState) -> tuple[Array, Memory, bool]:
        """The nominal knots and the method's memory as they are now, and whether they come from a plan."""
        tools, plan = state.tools, state.plan
        shape = (self.settings.knots, tools.horizon.prediction.na)
        if plan is None or view.arrival >= plan.time + tools.horizon.times[-1]:
            return np.zeros(shape), self._method.begin(shape, self._spread), False
        return tools.spline.matrix(tools.spline.times + (view.arrival - plan.time)) @ plan.nominal, plan.memory, True

    def _found(
        self, view: Outlook, nominal: Array, memory: Memory, state: SamplingState, pace: Pace
    ) -> tuple[Sampled | None, str]:
        """The plans of this instant, or why there are none."""
        s, tools, method = self.settings, state.tools, self._method
        rng = np.random.Generator(np.random.Philox(key=s.seed, counter=[0, 0, 0, state.count]))
        # Knots beyond the limits of what can reach the valves would cost the same as those at them.
        feed = view.wanted.feed[np.minimum(tools.spline.times / tools.horizon.durations[0], s.steps - 1).astype(int)]
        low, high = tools.horizon.reached[0] - feed, tools.horizon.reached[1] - feed
        cost, rounds = np.full(s.samples, np.inf), 0
        while rounds < s.iterations and not pace.enough():
            drawn = method.draw(rng, nominal, memory, s.samples - 1, self._spread)
            candidates = np.clip(np.concatenate([nominal[None], drawn]), low, high)
            cost = self._cost(tools, view, self._inputs(tools, view, candidates))
            rounds += 1
            if not np.isfinite(cost).any():
                return None, "no sampled plan could be rolled out: all diverged"
            nominal, memory = method.update(candidates, cost, memory, self._spread)
        if rounds == 0:
            return None, "no time was left for a solution"
        inputs = self._inputs(tools, view, nominal[None])[0]
        plan = Sampled(view.arrival, frozen_array(nominal), frozen_array(inputs), memory, frozen_array(cost), rounds)
        return plan, ""

    def _inputs(self, tools: SamplingTools, view: Outlook, knots: Array) -> Array:
        """(n, steps, na) what reaches the valves of plans with knots (n, k, na), within all limits [Pa]."""
        low, high = tools.horizon.reached
        inputs = np.clip(view.wanted.feed + tools.basis @ knots, low, high)
        if view.fixed is not None:
            inputs = np.where(np.isfinite(view.fixed), view.fixed, inputs)
        if self.settings.pressure_rate:
            self._limited(tools, view, inputs)
        return inputs

    def _limited(self, tools: SamplingTools, view: Outlook, inputs: Array) -> None:
        """Hold inputs (n, steps, na) to the greatest rate of their change, in place; those settled stay."""
        low, high = tools.horizon.reached
        settled = np.zeros(inputs.shape[1:], dtype=bool) if view.fixed is None else np.isfinite(view.fixed)
        last = np.broadcast_to(view.before, inputs[:, 0].shape)
        reach = np.full(inputs.shape[2], self.settings.pressure_rate * tools.horizon.dt)
        for k in range(inputs.shape[1]):
            near = np.clip(np.clip(inputs[:, k], last - reach, last + reach), low, high)
            inputs[:, k] = np.where(settled[k], inputs[:, k], near)
            last = np.where(settled[k], last, inputs[:, k])
            reach = np.where(settled[k], reach, self.settings.pressure_rate * tools.horizon.durations[k])

    def _cost(self, tools: SamplingTools, view: Outlook, inputs: Array) -> Array:
        """(n,) of plans; infinite where a rollout diverged on any model."""
        s, horizon = self.settings, tools.horizon
        states = tools.rollouts(view.known.state, view.disturbance, inputs)
        members = []
        with np.errstate(all="ignore"):  # what diverges may overflow
            for some in states:
                cost = costs(s.weights(), horizon.durations, tools.range, view.wanted, some, inputs)
                if self._penalty is not None:
                    cost = cost + self._penalty(horizon.times, some, inputs, view.wanted)
                members.append(cost)
            worst = np.sort(members, axis=0)[-max(round(s.risk * len(members)), 1) :]
            mean = worst.mean(axis=0)
        return np.where(np.isfinite(mean), mean, np.inf)
