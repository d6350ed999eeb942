"""PID on actuator lengths or joint angles, fed forward by the static pressures or the inverse of the model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.controllers import exact_pid, pid_kernel
from equimus_ctrl.controllers.exact_pid import ExactPidState
from equimus_ctrl.controllers.inverse import Inverse, InverseState
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.controllers.placement import placed_gains
from equimus_ctrl.engines import compiled
from equimus_ctrl.errors import ConfigError, ControllerError, NotAvailable
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import elastic_of
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array


@dataclass(frozen=True, eq=False)
class PidState:
    """What a PID carries from step to step.

    Attributes:
        memory: (3, n_channels) integral, filtered derivative, previous weighted error.
        offset: (n_joints,) first measured pose minus first reference [rad].
        begun: time of the first observation [s].
        spec: of the plant.
        constants: the nominal model's prepared numbers.
        gains: (7, n_channels).
        law: the compiled kernel module.
        low: (n_actuators,) lowest command of any use [Pa].
        high: (n_actuators,) highest [Pa].
        inverse: of the model, where it is what feeds forward.
        inverse_state: how far that has followed the reference.
    """

    memory: Array
    offset: Array
    begun: float
    spec: PlantSpec
    constants: Array
    gains: Array
    law: Any
    low: Array
    high: Array
    inverse: Inverse | None = None
    inverse_state: InverseState | None = None


@dataclass(frozen=True)
class PidController:
    """PID with filtered derivative, anti-windup, bumpless start and feed-forward.

    Attributes:
        settings: gains and the rest; None for gains that are placed when it begins, see ``controllers.placement``.
    """

    settings: PidSettings | None

    def init(self, spec: PlantSpec, observation: Observation) -> PidState | ExactPidState:
        """Start so that the first command is the one in force.

        Raises:
            ControllerError: where the plant carries no nominal model, or one without equations, a joint-space PID has
                not as many actuators as joints, or no gains that are placed keep the robot where it is.
            ConfigError: where the gains do not match the plant's channels.
        """
        if not isinstance(spec.model, Robot):
            raise ControllerError("the PID computes with a nominal model, and this plant carries none")
        if self.settings is None or self.settings.decoupled or "lengths" not in spec.model.offers:
            return self._begin_exactly(spec, observation)
        if self.settings.space == "joint" and len(spec.joints) > len(spec.actuators):
            raise ControllerError(
                f"a joint-space PID needs at least as many actuators as joints, this plant has {len(spec.actuators)} "
                f'for {len(spec.joints)}; use space = "length"'
            )
        s = self.settings
        robot = elastic_of(spec.model)
        law = compiled.load(robot, spec.phase, pid_kernel)
        gains = s.gain_matrix(s.channels(spec))
        constants = compiled.prepared(robot, spec.phase)
        memory = np.zeros((3, gains.shape[1]))
        # Writable copies: numba compiles anew for read-only arrays.
        y, low, high = np.array(observation.position), np.array(spec.command_low), np.array(spec.command_high)
        inverse, following = None, None
        if s.inverse:
            inverse = Inverse(Model(spec.model, spec.effects, spec.phase), spec.control_dt, s.start_time)
            following = inverse.start(observation.time, y)
            low, high = np.maximum(low, inverse.low), np.minimum(high, inverse.high)
            surplus = inverse.surplus(following, observation.command)
        else:
            fed = np.empty(len(low))
            law.static_feed(y, s.feedforward, constants, fed)
            surplus = observation.command - fed
        law.pid_start(y, surplus, gains, s.space == "length", constants, memory)
        offset = np.full(len(spec.joints), np.nan)
        return PidState(memory, offset, observation.time, spec, constants, gains, law, low, high, inverse, following)

    def _begin_exactly(self, spec: PlantSpec, observation: Observation) -> ExactPidState:
        if self.settings is not None and self.settings.lateness:
            raise ConfigError(
                f"lateness is {self.settings.lateness:g} s, which is of a PID that is not decoupled on a robot with "
                f"elastic actuators, not of one on {spec.model.name}; expected 0"
            )
        try:
            dynamics = Dynamics(Model(spec.model, spec.effects, spec.phase))
        except NotAvailable as error:
            raise ControllerError(str(error)) from None
        if self.settings is None:
            placed = placed_gains(dynamics, spec, np.array(observation.position))
            return replace(exact_pid.begin(placed.settings, spec, observation, dynamics), note=placed.sentence)
        if self.settings.space == "length":
            raise ConfigError(
                f'PID gains: {spec.model.name} has no elastic actuators, whose lengths they are of; use space = "joint"'
            )
        return exact_pid.begin(self.settings, spec, observation, dynamics)

    def step(
        self, observation: Observation, reference: Reference, state: PidState | ExactPidState
    ) -> tuple[Array, PidState | ExactPidState]:
        """The next command, within the plant's limits.

        What was measured is compared with where the robot was to be then, on time and by ``lateness`` behind;
        pressures are fed forward for now.
        """
        if isinstance(state, ExactPidState):
            return exact_pid.step(observation, reference, state)
        assert self.settings is not None  # else it began exactly
        s, spec = self.settings, state.spec
        offset, following, fed = state.offset, state.inverse_state, np.empty(len(spec.actuators))
        now, measured = observation.time, max(observation.stamp, state.begun)
        if state.inverse is not None and following is not None:
            instants = np.array([now]), np.array([measured])
            shown, planned, following = state.inverse.follow(reference, *instants, following)
            later, following = state.inverse.later(reference, instants[1], following, s.late_start)
            r, late, fed = shown[0], later[0], planned[0]
        else:
            if np.isnan(offset).any():
                offset = observation.position - reference.position(measured)

            def pose(time: float, start_time: float) -> Array:
                weight = state.law.blend(time - state.begun, start_time)
                return np.asarray(reference.position(time) + weight * offset)

            r, late = pose(measured, s.start_time), pose(measured, s.late_start)
            state.law.static_feed(pose(now, s.start_time), s.feedforward, state.constants, fed)
        memory = state.memory.copy()
        command = np.empty(len(spec.actuators))
        state.law.pid_command(
            r,
            late,
            np.array(observation.position),
            fed,
            state.gains,
            s.space == "length",
            state.low,
            state.high,
            spec.control_dt,
            state.constants,
            memory,
            command,
        )
        return frozen_array(command), replace(state, memory=memory, offset=offset, inverse_state=following)
