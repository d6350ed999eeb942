"""References of joints tracked by a given feedback law, see ``types.FeedbackLaw``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from equimus_ctrl.engines.tracking_law import nothing_remembered, tracking_command
from equimus_ctrl.errors import ControllerError
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array, FeedbackLaw, Observation, PlantSpec, Reference, frozen_array


@dataclass(frozen=True, eq=False)
class TrackingState:
    """What it carries from step to step.

    Attributes:
        memory: (2, nj) see ``engines.tracking_law.ERROR``.
        spec: of the plant.
    """

    memory: Array
    spec: PlantSpec


@dataclass(frozen=True, eq=False)
class TrackingController:
    """PD with a feed-forward that is given.

    Attributes:
        law: of the feedback.
        reference: of the joints, as (nj,) at a time.
        feed: what is fed forward, as (na,) at a time.
    """

    name: ClassVar[str] = "tracking"

    law: FeedbackLaw
    reference: Reference
    feed: Reference

    def init(self, spec: PlantSpec, observation: Observation) -> TrackingState:
        """Nothing is remembered at first.

        Raises:
            ControllerError: where the law is of another number of joints or actuators than the plant, or the robot is
                so far from where the reference begins that the first command would leave its range.
        """
        wanted = len(spec.actuators), len(spec.joints)
        if self.law.stiffness.shape != wanted:
            raise ControllerError(
                f"the feedback law has gains {self.law.stiffness.shape} from joints to actuators, expected {wanted}"
            )
        state = TrackingState(nothing_remembered(len(spec.joints)), spec)
        first = np.asarray(self.step(observation, self.reference, state)[0])
        if np.any((first < spec.command_low) | (first > spec.command_high)):
            wanted_pose = self.reference.position(observation.stamp)
            off = np.abs(observation.position - wanted_pose)
            j = int(np.argmax(off))
            unit = reading(spec.joint_units[j])
            raise ControllerError(
                f"{spec.joints[j]} is at {unit.text(observation.position[j])} and its reference begins at "
                f"{unit.text(wanted_pose[j])}; expected a robot that begins near its reference, for it would jump there"
            )
        return state

    def step(
        self, observation: Observation, reference: Reference, state: TrackingState
    ) -> tuple[Array, TrackingState]:  # fmt: skip
        """The next command, which the plant clips; what was measured is compared with the reference of then."""
        law, spec, memory = self.law, state.spec, state.memory.copy()
        command = np.empty(len(spec.actuators))
        tracking_command(
            np.array(self.reference.position(observation.stamp)), np.array(observation.position),
            np.array(self.feed.position(observation.time)), np.array(law.stiffness), np.array(law.damping),
            law.smoothing, spec.control_dt, memory, command,
        )  # fmt: skip
        return frozen_array(command), TrackingState(memory, spec)
