"""Commands that do not listen: a profile played back, or the reference's static pressures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ControllerError
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import elastic_of
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference


@dataclass(frozen=True, eq=False)
class OpenLoopController:
    """Plays commands regardless of what the robot does.

    Attributes:
        commands: time [s] → commands (na,); None means those that hold the reference pose at rest.
    """

    commands: Callable[[float], Array] | None = None

    def init(self, spec: PlantSpec, observation: Observation) -> Callable[[float, Reference], Array]:
        """The state is the function that gives the commands.

        Raises:
            ControllerError: where static pressures are needed and the plant carries no nominal model.
        """
        if self.commands is not None:
            commands = self.commands
            return lambda time, reference: commands(time)
        if not isinstance(spec.model, Robot):
            raise ControllerError("open loop needs commands to play, or a plant with a nominal model")
        statics = _statics(spec, spec.model)
        return lambda time, reference: np.clip(statics(reference.position(time)), spec.command_low, spec.command_high)

    def step(
        self, observation: Observation, reference: Reference, state: Callable[[float, Reference], Array]
    ) -> tuple[Array, Callable[[float, Reference], Array]]:
        """The command of this instant."""
        return state(observation.time, reference), state


def _statics(spec: PlantSpec, robot: Robot) -> Callable[[Array], Array]:
    """(pose) → commands that hold it at rest."""
    if "lengths" in robot.offers:
        return Kinematics(elastic_of(robot), spec.phase).static_pressure
    dynamics = Dynamics(Model(robot, spec.effects, spec.phase))
    return lambda pose: dynamics.holding(pose)[0]
