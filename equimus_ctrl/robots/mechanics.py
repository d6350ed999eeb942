"""What compiled equations need of a robot: their form, its parameters, and the dynamics of its commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.following import DIRECT
from equimus_ctrl.robots.elastic.form import ElasticForm
from equimus_ctrl.robots.mjcf.form import FAR, TreeForm
from equimus_ctrl.types import Array

Structure = ElasticForm | TreeForm
"""What the form of equations depends on; robots of one structure differ in parameters alone."""


@dataclass(frozen=True)
class Channel:
    """What lies between a command, as it arrives at an actuator, and what the actuator's force is made of.

    Attributes:
        low: lowest command that counts.
        high: highest.
        delay: of the command [s].
        kind: DIRECT, FILTERED, INTEGRATED or SLEWED, see ``effects.command.DIRECT``.
        number: time constant [s] or fastest rate.
        least: lowest a.
        most: highest a.
        actuator: whose it is.
    """

    low: float = -FAR
    high: float = FAR
    delay: float = 0.0
    kind: int = DIRECT
    number: float = 0.0
    least: float = -FAR
    most: float = FAR
    actuator: int = 0


@dataclass(frozen=True, eq=False)
class Mechanics:
    """A robot as compiled equations take it.

    Attributes:
        form: of the equations.
        parameters: (np,) of the form.
        joints: (nj,) which of the form's coordinates is each joint's.
        starts: (n,) which joint each of the form's coordinates moves with at a start; those whose motion is prescribed
            or not measured are counted on behind the joints.
        law_places: kind of place → the form's places at which force laws act, by name.
        channels: of the actuators.
    """

    form: Structure
    parameters: Array
    joints: NDArray[np.int64]
    starts: NDArray[np.int64]
    law_places: Mapping[str, Sequence[str]]
    channels: tuple[Channel, ...]

    def friction(self) -> dict[tuple[str, int], float]:
        """(kind, index) → dry friction that the robot itself has there [N·m or N]."""
        return {place: float(self.parameters[at]) for place, at in self.form.friction_at.items()}
