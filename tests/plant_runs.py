"""Runs of a simulated leg."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Observation

LEG = nominal_leg()
STEP = np.array([20e3, 12e3])


def drive(plant: MujocoPlant, command: Callable[[float], Array], n: int) -> list[Observation]:
    """n control periods after a reset that has been done."""
    seen = []
    for k in range(n):
        seen.append(plant.step(command(k * plant.spec.control_dt)))
    return seen


def positions(seen: list[Observation]) -> Array:
    return np.array([observation.position for observation in seen])
