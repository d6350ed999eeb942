"""Overshoot after a step: of runs, and of servos by themselves, about which no controller can do much."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.tuning.evaluation import BAND
from equimus_ctrl.types import Array, Controller, Observation, PlantSpec, Reference, Run


@dataclass(frozen=True, eq=False)
class ServosAlone:
    """A controller whose servos get the reference as their goal.

    Attributes:
        others: what drives the other actuators.
        robot: whose servos they are.
    """

    others: Controller
    robot: Robot

    def init(self, spec: PlantSpec, observation: Observation) -> Any:
        """See ``Controller``."""
        return self.others.init(spec, observation)

    def step(self, observation: Observation, reference: Reference, state: Any) -> tuple[ArrayLike, Any]:
        """See ``Controller``."""
        command, state = self.others.step(observation, reference, state)
        goals = self.robot.goals_at(np.asarray(reference.position(observation.time)))
        return np.where(self.robot.goals, goals, command), state


def servos_of(robot: Robot) -> list[str]:
    """The actuators whose commands are goals."""
    return [name for name, goal in zip(robot.actuator_names, robot.goals, strict=True) if goal]


def as_hinges(spec: PlantSpec) -> Array:
    """(nj,) factors by which a mm of a slide counts as a degree of a hinge."""
    return np.array([math.radians(reading(unit).factor) for unit in spec.joint_units])


def overshoots(done: Run, step_at: float) -> Array:
    """(nj,) how far each joint goes beyond the end of a step, as a share of it; of one that has none, of ``BAND``."""
    assert done.truth is not None
    begins, scale = round(step_at / done.spec.control_dt), as_hinges(done.spec)
    after = scale * (done.truth - done.reference)[begins:]
    way = scale * (done.reference[-1] - (done.reference[begins - 1] if begins else done.truth[0]))
    beyond = np.where(np.abs(way) > BAND, after * np.sign(way), np.abs(after))
    return np.asarray(beyond.max(axis=0) / np.maximum(np.abs(way), BAND))
