"""What the equations of a robot with elastic actuators look like."""

from __future__ import annotations

from typing import NamedTuple

from equimus_ctrl.types import Array

N_GLOBAL, N_JOINT, N_ACTUATOR = 3, 13, 9
"""How many entries of the parameter vector belong to the whole, to each joint and to each actuator."""


class ElasticForm(NamedTuple):
    """What the equations' form depends on; bodies are numbered by the joint that carries them, −1 is the base.

    Attributes:
        parents: of the joints.
        spans: bodies of each actuator.
        foot: the foot's body.
    """

    parents: tuple[int, ...]
    spans: tuple[tuple[int, int], ...]
    foot: int

    @property
    def n_links(self) -> int:
        """How many links move."""
        return len(self.parents)

    @property
    def law_places(self) -> dict[str, int]:
        """Kind of place → how many there are at which force laws act."""
        return {"joint": len(self.parents), "actuator": len(self.spans)}

    @property
    def n_parameters(self) -> int:
        """How many entries the parameter vector has."""
        return N_GLOBAL + len(self.parents) * N_JOINT + len(self.spans) * N_ACTUATOR

    @property
    def friction_at(self) -> dict[tuple[str, int], int]:
        """(kind, index) of places at which the robot itself can have dry friction → where its size stands."""
        return {}

    @property
    def stiff(self) -> bool:
        """Whether it may move faster than explicit steps of a control period follow."""
        return False

    @property
    def n_inside(self) -> int:
        """How many states the robot has beside its motion."""
        return 0

    def unlimited(self, parameters: Array, commands: bool = False) -> Array:
        """(n_parameters,) the same parameters with no bounds of forces or commands, of which they have none."""
        return parameters
