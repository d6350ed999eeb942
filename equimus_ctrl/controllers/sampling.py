"""Sampling model-predictive control: at every instant many plans are tried, and the best ones followed.

Where a robot's joints can follow a path, a plan is a spline of commands beyond what the regulator of
``controllers.lqr`` would do along that path, in half their ranges; of any other robot it looks where it leads, see
``controllers.sampling_policies``. Its cost is that of the NMPC: errors and efforts in acceptable deviations, and the
regulator's cost behind the horizon. The nominal plan of the instant before, shifted, is always tried, and what the
regulator itself would do, which is followed where no plan costs less: at rest nothing wanders. The generator's numbers
follow from the seed and the instant, so that a run gives the same bits each time.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.controllers import sampling_policies
from equimus_ctrl.controllers.horizon import Horizon, HorizonState, Outlook
from equimus_ctrl.controllers.pace import Pace
from equimus_ctrl.controllers.planning import begun
from equimus_ctrl.controllers.sampling_policies import PolicyState, Waiting
from equimus_ctrl.controllers.sampling_settings import LOOKS, SamplingSettings, kind_of, there_of
from equimus_ctrl.controllers.valve_estimation import found_out
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.estimation.observer import Observer, require_model
from equimus_ctrl.models.model import Model
from equimus_ctrl.predictive.costs import Wanted, costs
from equimus_ctrl.predictive.rollouts import Rollouts, make_rollouts, members_of
from equimus_ctrl.predictive.sampling import METHODS, Memory, Method, Spread
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.settings import both
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

USUAL_EFFORTS = 25.0
"""How many acceptable deviations half the range of a command counts as where nothing limits it."""
Penalty = Callable[[Array, Array, Array, Wanted], Array]
"""(times (n + 1,) [s], states (m, n + 1, k) with positions and rates first, commands (m, n, na), what is wanted) → what
is added to costs (m,)."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """What the plans of one instant came to.

    Attributes:
        time: when they begin [s].
        nominal: (k, na) knots beyond what the regulator would do, to go on with, in half the range of commands.
        inputs: (steps, na) what reaches the valves of it [Pa].
        memory: of the method.
        cost: (samples,) of the last round's plans, the nominal one and the regulator's first; infinite where a rollout
            diverged.
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
        tools: made for the plant, and its valves, once.
        count: how many instants there have been, which the generator's numbers follow from.
    """

    plan: Sampled | None
    tools: SamplingTools
    count: int


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
    scale: Array
    """(na,) half the range of commands [Pa, or their unit]."""
    settings: SamplingSettings
    """With what is usual in the place of 0."""
    method: Method
    spread: Spread

    @property
    def observer(self) -> Observer:
        """That of the horizon."""
        return self.horizon.observer

    def taken_over(self, state: SamplingState) -> dict[str, Any]:
        """See ``controllers.valve_estimation``."""
        return self.horizon.taken_over(state)


class SamplingController:
    """The sampling controller; its state is a ``SamplingState``, or of ``controllers.sampling_policies``.

    Args:
        settings: of it.
        method: another way to find a plan than the settings name.
        penalty: what is added to the costs of plans, see ``Penalty``.
        now: a clock for the deadline [s].
        shared: the file that the settings are from where all robots share it, so that what is not for this one is
            left aside; empty where somebody chose them.
    """

    name = "sampling"

    def __init__(
        self,
        settings: SamplingSettings | None = None,
        method: Method | None = None,
        penalty: Penalty | None = None,
        now: Callable[[], float] = clock.perf_counter,
        shared: str = "",
    ) -> None:
        self.settings = settings or SamplingSettings()
        self._method, self._penalty, self._now, self._shared = method, penalty, now, shared

    def init(self, spec: PlantSpec, observation: Observation) -> SamplingState | Waiting:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model, or one that cannot be rolled out.
            ConfigError: where the margin leaves nothing of a joint's range, the engine lacks an effect, or a setting
                changes nothing of the robot.
            ModelError: where MuJoCo cannot simulate the robot.
        """
        require_model(spec)
        position = np.array(observation.position)
        kind = kind_of(Model(spec.model, spec.effects, spec.phase), position, self.settings.engine)
        there = there_of(self.settings, spec.model, kind)
        own, said = self.settings.suited(there, self.name, spec.model.name, self._shared)
        s = own.usual(kind)
        if kind == LOOKS:
            waiting = sampling_policies.begin(s, spec, observation)
            return replace(waiting, note=both(said, waiting.note))
        steps = round(s.horizon / (s.stride * spec.control_dt))
        if not max(s.knots, 2) <= steps:
            raise ConfigError(
                f"{self.name}: a horizon of {s.horizon:g} s has {steps} steps, expected at least {max(s.knots, 2)}"
            )

        def make(own: PlantSpec, settings: SamplingSettings, known: Horizon | None) -> SamplingTools:
            return self._tools(own, settings, position, steps, known)

        return SamplingState(**begun(make, spec, s, observation, said), count=0)

    def _tools(
        self, spec: PlantSpec, s: SamplingSettings, position: Array, steps: int, known: Horizon | None
    ) -> SamplingTools:
        banked = known is None and s.estimate_valves
        horizon = Horizon(spec, s, lambda later: np.full(steps, s.stride, dtype=np.int64), position, banked, known)
        models = members_of(horizon.observer.model, s.ensemble, s.spread, s.seed)
        rollouts = make_rollouts(models, s.samples, steps, s.stride * horizon.dt, s.engine, s.compiled)
        spline = Spline(s.spline, s.knots, float(horizon.times[-1]))
        basis = spline.matrix(horizon.times[:-1] + horizon.durations / 2)
        half = (horizon.reached[1] - horizon.reached[0]) / 2
        scale = np.where(np.isfinite(half) & (half > 0), half, USUAL_EFFORTS * horizon.weights.pressure)
        spread = Spread(s.least_deviation, s.deviation, s.temperature, s.elites)
        method = self._method or METHODS[s.method]
        return SamplingTools(horizon, rollouts, spline, basis, s.joint_range(spec), scale, s, method, spread)

    def step(
        self, observation: Observation, reference: Reference, state: SamplingState | PolicyState | Waiting
    ) -> tuple[Array, SamplingState | PolicyState]:
        """The next command, within the plant's limits.

        Raises:
            ControllerError: where a joint was not measured for longer than the observer has patience.
        """
        if not isinstance(state, SamplingState):
            method = self._method or METHODS[state.settings.method]
            return sampling_policies.step(method, self._penalty, observation, reference, state)
        pace = Pace(self._now, state.tools.settings.deadline, state.expected)
        state = found_out(observation, state)
        horizon = state.tools.horizon
        view = horizon.look(observation, reference, state)
        middle = view.wanted.feed + horizon.regulated(view)
        nominal, memory, shifted = self._shifted(view, state)
        found, reason = self._found(view, middle, nominal, memory, state, pace)
        fallback = self._inputs(state.tools, view, middle, nominal[None])[0] if shifted else None
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
        shape = (tools.settings.knots, tools.horizon.prediction.na)
        if plan is None or view.arrival >= plan.time + tools.horizon.times[-1]:
            return np.zeros(shape), tools.method.begin(shape, tools.spread), False
        return tools.spline.matrix(tools.spline.times + (view.arrival - plan.time)) @ plan.nominal, plan.memory, True

    def _found(
        self, view: Outlook, middle: Array, nominal: Array, memory: Memory, state: SamplingState, pace: Pace
    ) -> tuple[Sampled | None, str]:
        """The plans of this instant, or why there are none."""
        tools = state.tools
        s, method = tools.settings, tools.method
        rng = np.random.Generator(np.random.Philox(key=s.seed, counter=[0, 0, 0, state.count]))
        # Knots beyond the limits of what can reach the valves would cost the same as those at them.
        at = np.minimum(tools.spline.times / tools.horizon.durations[0], len(middle) - 1).astype(int)
        low, high = ((end - middle[at]) / tools.scale for end in tools.horizon.reached)
        cost, rounds, regulated = np.full(s.samples, np.inf), 0, np.zeros((1, *nominal.shape))
        while rounds < s.iterations and not pace.enough():
            drawn = method.draw(rng, nominal, memory, s.samples - 2, tools.spread)
            candidates = np.clip(np.concatenate([nominal[None], regulated, drawn]), low, high)
            cost = self._cost(tools, view, self._inputs(tools, view, middle, candidates))
            rounds += 1
            if not np.isfinite(cost).any():
                return None, "no sampled plan could be rolled out: all diverged"
            nominal, memory = method.update(candidates, cost, memory, tools.spread)
            if np.argmin(cost[1:]) == 0 and cost[1] <= cost[0]:
                nominal = candidates[1]
        if rounds == 0:
            return None, "no time was left for a solution"
        inputs = self._inputs(tools, view, middle, nominal[None])[0]
        plan = Sampled(view.arrival, frozen_array(nominal), frozen_array(inputs), memory, frozen_array(cost), rounds)
        return plan, ""

    def _inputs(self, tools: SamplingTools, view: Outlook, middle: Array, knots: Array) -> Array:
        """(n, steps, na) what reaches the drives of plans whose knots (n, k, na) are beyond (steps, na)."""
        low, high = tools.horizon.reached
        inputs = np.clip(middle + tools.basis @ (tools.scale * knots), low, high)
        if view.fixed is not None:
            inputs = np.where(np.isfinite(view.fixed), view.fixed, inputs)
        if tools.settings.pressure_rate:
            self._limited(tools, view, inputs)
        return inputs

    def _limited(self, tools: SamplingTools, view: Outlook, inputs: Array) -> None:
        """Hold inputs (n, steps, na) to the greatest rate of their change, in place; those settled stay."""
        low, high = tools.horizon.reached
        settled = np.zeros(inputs.shape[1:], dtype=bool) if view.fixed is None else np.isfinite(view.fixed)
        last = np.broadcast_to(view.before, inputs[:, 0].shape)
        reach = np.full(inputs.shape[2], tools.settings.pressure_rate * tools.horizon.dt)
        for k in range(inputs.shape[1]):
            near = np.clip(np.clip(inputs[:, k], last - reach, last + reach), low, high)
            inputs[:, k] = np.where(settled[k], inputs[:, k], near)
            last = np.where(settled[k], last, inputs[:, k])
            reach = np.where(settled[k], reach, tools.settings.pressure_rate * tools.horizon.durations[k])

    def _cost(self, tools: SamplingTools, view: Outlook, inputs: Array) -> Array:
        """(n,) of plans; infinite where a rollout diverged on any model."""
        s, horizon = tools.settings, tools.horizon
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
