"""What moves in the simulated plant: a robot in MuJoCo, whatever it was described by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Robots
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.elastic_body import ElasticBody
from equimus_ctrl.plants.mjcf_body import MjcfBody
from equimus_ctrl.types import Array


class Body(Protocol):
    """A robot in MuJoCo.

    Attributes:
        mujoco_model: its ``mujoco.MjModel``.
        data: its ``mujoco.MjData``.
        qpos: (nj,) of the joints.
        dof: (nj,) of the joints.
        control: (na,) of the commands.
        valve: (na, 6) between commands and ``data.ctrl``, see ``effects.command.DELAY``.
        sensor: (nj, 4), see ``effects.sensors``.
    """

    mujoco_model: Any
    data: Any
    qpos: NDArray[np.int64]
    dof: NDArray[np.int64]
    control: NDArray[np.int64]
    valve: Array
    sensor: Array

    def command_before(self, position: Array | None) -> Array:
        """(na,) what is in force before it begins at a pose (nj,), or anywhere, where nobody says so."""
        ...

    def rest(self, command: Array | None) -> Array:
        """(nj,) where it rests under a command (na,); where it begins if nobody says a command.

        Raises:
            ModelError: where it rests nowhere under it.
        """
        ...

    def place(self, position: Array, velocity: Array | None, arrived: Array) -> None:
        """Put it into a pose (nj,) with rates (nj,), what (na,) arrived of the commands long being in force."""
        ...

    def exert(self) -> None:
        """Set what effects exert over the step that comes."""
        ...

    def advance(self, pushes: Sequence[Array]) -> bool:
        """Take one physics step, further forces (nj,) on the joints; False where its numbers are lost."""
        ...

    def exerted(self) -> Array | None:
        """(nj,) what actuators exerted on the joints over the last step [N·m or N]; None where that is not known."""
        ...

    def numbers(self) -> Mapping[str, Array]:
        """MuJoCo's numbers of its bodies as they are."""
        ...

    def loaded(self, loads: Sequence[tuple[str, float]]) -> Mapping[str, Array]:
        """The same with point masses [kg] at places."""
        ...


Make = Callable[[Model, float, Scene | None, str | None], Body]
BODIES_OF: dict[Robots, Make] = {"elastic": ElasticBody, "mjcf": MjcfBody}
"""Kind of robots (``RobotTraits.catalogue``) → its body, see ``body_of``."""


def body_of(model: Model, dt: float, scene: Scene | None = None, integrator: str | None = None) -> Body:
    """A model in MuJoCo.

    Args:
        model: with its effects.
        dt: physics step [s].
        scene: adds what stands around it.
        integrator: of MuJoCo's, where its description names none; the one that follows its motion by default.
    """
    return BODIES_OF[model.robot.traits.catalogue](model, dt, scene, integrator)
