"""What befalls a robot while it runs, unknown to every controller: a push (disturbance torques), a load taken up."""

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


Event = Push | Load
