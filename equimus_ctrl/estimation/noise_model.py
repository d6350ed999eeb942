"""What an observer assumes of what pushes a robot about: white torques, unknown torques that walk, straying drives.

Where commands are pressures, shares of what the actuators can exert. Any other robot may have drives without a limit;
what is assumed of it follows from how fast the observer is to be. Of a joint with inertia I that white torques of
density σ_τ push, positions being measured every Δt with noise σ, the Kalman filter's poles lie at

    ω_o = √(σ_τ / (I σ √Δt)),    and an unknown torque that walks with σ_d is found with the rate σ_d / σ_τ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import elastic_of
from equimus_ctrl.types import Array

FIRST = 0.3
"""Standard deviation of the unknown torques at the start, in shares of the largest that the actuators can exert."""
QUICKER = 6.0
"""ω_o by the bandwidth of the loop."""
TAKEN_UP = 1.0
"""Rate at which unknown torques are found by the same."""
STRAYS = 0.005
"""By so much what has arrived varies within 1/ω, in shares of allowed efforts: little, and not the 0 of blind trust."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Densities and deviations, see ``estimation.observer``.

    Attributes:
        torque: (nj,) density of the white torques on the joints [N·m·√s or N·√s].
        walk: (nj,) standard deviation of the unknown torques' walk after a second [N·m or N].
        first: (nj,) theirs at the start.
        pressure: (na,) of the walk of what has arrived after a second [Pa, or the commands' unit].
        noise: of a measured position [rad or m].
    """

    torque: Array
    walk: Array
    first: Array
    pressure: Array
    noise: float


def pressed(model: Model, torque: float, disturbance: float, pressure: float, noise: float) -> NoiseModel:
    """Of a robot whose commands are pressures; arguments as of ``estimation.observer.ObserverSettings``."""
    robot = elastic_of(changed_bodies(model.effects, model.robot))
    low, high = (np.clip(side, -np.pi, np.pi) for side in robot.joint_range)
    middle = (low + high) / 2
    area = np.array([a.area for a in robot.actuators])
    span = robot.command_high - robot.command_low
    most: Array = np.abs(Kinematics(robot, model.phase).jacobian(middle).T * area) @ np.full(len(area), span)
    return NoiseModel(
        torque * most,
        disturbance * most,
        FIRST * most,
        np.full(len(area), pressure * span),
        noise,
    )


def followed(inertia: Array, effort: Array, bandwidth: float, noise: float, dt: float) -> NoiseModel:
    """Of a robot in a loop.

    Args:
        inertia: (nj,) of each joint [kg·m² or kg].
        effort: (na,) what commands are allowed beyond what a reference asks for, in their unit.
        bandwidth: of the loop [rad/s].
        noise: standard deviation of a measured position [rad or m].
        dt: time between two measurements [s].
    """
    torque = inertia * (QUICKER * bandwidth) ** 2 * noise * math.sqrt(dt)
    walk = TAKEN_UP * bandwidth * torque
    # After as long as the loop takes, the unknown torques may be what white ones would have come to.
    strays = STRAYS * math.sqrt(bandwidth) * effort
    return NoiseModel(torque, walk, torque * math.sqrt(bandwidth) * QUICKER, strays, noise)
