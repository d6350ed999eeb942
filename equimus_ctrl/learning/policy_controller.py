"""A policy as a controller: it sees what it saw in training, made by the same code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.learning.observing import Memory, Scaling, bounded
from equimus_ctrl.learning.policy import Acting
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference

ROW = np.array([0])


@dataclass(frozen=True, eq=False)
class PolicyState:
    """What a policy remembers.

    Attributes:
        scaling: of the robot.
        memory: of measurements and commands; not to be changed.
        every: control periods of the plant that make one of the policy's.
        start: time of the first observation [s].
        dt: of the plant [s].
        latest: control period of the policy in which it acted last; −1 before the first.
        command: (na,) that it holds.
    """

    scaling: Scaling
    memory: Memory
    every: int
    start: float
    dt: float
    latest: int
    command: Array


@dataclass(frozen=True, eq=False)
class PolicyController:
    """Commands of a policy, at its own control rate; in between they hold.

    Attributes:
        policy: which.
        name: shown in tables.

    Raises:
        ConfigError: where the policy sees what no controller does.
    """

    policy: Acting
    name: str = "policy"

    def __post_init__(self) -> None:
        suited = self.policy.suited
        if suited.privileged:
            raise ConfigError(f"{self.name}: the policy sees what no sensor shows; train it without privileged=True")
        if suited.sight is None:
            raise ConfigError(f"{self.name}: the policy sees {suited.blind}, which no plant shows to a controller")

    def init(self, spec: PlantSpec, observation: Observation) -> PolicyState:
        """The state to start from.

        Raises:
            ConfigError: where the plant is not the robot that the policy is for.
        """
        suited = self.policy.suited
        every = suited.check(spec, self.name)
        scaling = Scaling(spec)
        memory = Memory(1, scaling, suited.history)
        memory.begin(ROW, self._measured(observation)[None], observation.command[None])
        return PolicyState(scaling, memory, every, observation.time, spec.control_dt, -1, observation.command)

    def step(self, observation: Observation, reference: Reference, state: PolicyState) -> tuple[Array, PolicyState]:
        """The next command.

        Raises:
            ControllerError: where a measured position is not finite.
        """
        measured = self._measured(observation)
        # Also where a period of the plant was missed.
        period = round((observation.time - state.start) / state.dt) // state.every
        if period <= state.latest:
            return state.command, state
        memory = state.memory
        if state.latest >= 0:
            memory = memory.copy()
            memory.add(ROW, measured[None], observation.command[None])
        suited, dt = self.policy.suited, self.policy.suited.control_dt
        assert suited.sight is not None
        seen = suited.sight.at(period, lambda k: reference.position(state.start + k * dt), state.scaling)
        action = self.policy.act(bounded([memory.seen(ROW), seen[None]]))[0]
        command = state.scaling.command(action)
        return command, PolicyState(state.scaling, memory, state.every, state.start, state.dt, period, command)

    def _measured(self, observation: Observation) -> Array:
        measured = np.asarray(observation.position)
        if not np.isfinite(measured).all():
            raise ControllerError(
                f"{self.name}: the measured positions at {observation.time:.3f} s are {measured.tolist()}, and a "
                "policy takes finite ones alone"
            )
        return measured
