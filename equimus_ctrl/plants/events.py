"""What befalls a robot while it runs, unknown to every controller: a push (torques or a force), a load taken up."""

from __future__ import annotations

import math
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array, frozen_array


@dataclass(frozen=True, eq=False)
class Push:
    """Torques on the joints for a while.

    Attributes:
        time: when it begins [s].
        duration: [s].
        torque: (nj,) [N·m].

    Raises:
        ConfigError: for numbers that are none of these.
    """

    time: float
    duration: float
    torque: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "torque", frozen_array(self.torque, 1, "push torque"))
        if not (math.isfinite(self.time) and math.isfinite(self.duration) and self.duration > 0):
            raise ConfigError(f"a push at {self.time:g} s lasts {self.duration:g} s, expected more than 0")
        if not all(math.isfinite(value) for value in self.torque):
            raise ConfigError(f"the torques of a push are {self.torque.tolist()} N·m, expected finite numbers")


@dataclass(frozen=True)
class Load:
    """A point mass at a link's tip from some time on, see ``effects.bodies.PayloadMass``.

    Attributes:
        time: when it is taken up [s].
        mass: [kg].
        location: ``"foot"`` or a link's name.

    Raises:
        ConfigError: for numbers that are none of these.
    """

    time: float
    mass: float
    location: str = "foot"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.time) and math.isfinite(self.mass) and self.mass >= 0):
            raise ConfigError(f"a load at {self.time:g} s has a mass of {self.mass:g} kg, expected at least 0")


@dataclass(frozen=True, eq=False)
class PointForce:
    """A force at a named point of the robot for a while, fixed in the room, see ``models.points``.

    Attributes:
        time: when it begins [s].
        duration: [s].
        force: (3,) [N].
        location: the point.

    Raises:
        ConfigError: for numbers that are none of these.
    """

    time: float
    duration: float
    force: Array
    location: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "force", frozen_array(self.force, 1, "force"))
        if not (math.isfinite(self.time) and math.isfinite(self.duration) and self.duration > 0):
            raise ConfigError(f"a force at {self.time:g} s lasts {self.duration:g} s, expected more than 0")
        if self.force.shape != (3,) or not all(math.isfinite(value) for value in self.force):
            raise ConfigError(f"the force at {self.location} is {self.force.tolist()} N, expected three finite numbers")


Event = Push | PointForce | Load
