"""Equations of motion solved for the commands, and what stands between a command and what arrives of it."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import DELAY, FILL, RATE, VENT
from equimus_ctrl.effects.following import FILTERED, SLEWED
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.effects.sensors import SENSOR_DELAY, sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.models.augmented import augmented_model, law_parameters
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.dynamics import Dynamics, share_left
from equimus_ctrl.models.inverse import inverse_dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, frozen_array


class Solved(Protocol):
    """The commands, as they arrive at the actuators, under which a robot moves."""

    def rest(self, q: Array) -> Array:
        """(nz,) the effects' states after a long rest at q (nj,) [rad or m]."""
        ...

    def commands(self, q: Array, v: Array, a: Array, z: Array) -> Array:
        """(n, na) under which it moves so (nj, n), the effects' states being (nz, n)."""
        ...

    def counter(self, q: Array, torque: Array) -> Array:
        """(na,) what exerts torques (nj,) [N·m or N] by itself at q (nj,) [rad or m]."""
        ...

    def advanced(self, q: Array, v: Array, z: Array, dt: float) -> Array:
        """(nz,) the effects' states after dt [s] of such motion."""
        ...

    def possible(self, q: Array, v: Array, a: Array) -> float:
        """The share of a motion (nj,) each, beside what holds its pose, that is to be fed forward."""
        ...


class _Pressures:
    """Of actuators whose pressures act along lengths, see ``models.inverse``."""

    def __init__(self, model: Model) -> None:
        robot = changed_bodies(model.effects, model.robot)
        mechanics, laws = robot.mechanics(), laws_of(model.effects)
        slots = augmented_model(mechanics.form, model.phase, laws).slots
        self._law = inverse_dynamics(mechanics.form, model.phase, laws)
        own = law_parameters(slots, model.effects, robot.joint_names, robot.actuator_names)
        self._low, self._high = robot.command_limits
        self._span = np.max(self._high - self._low)
        self._parameters = np.array([*mechanics.parameters, *own])
        self._pressure, self._counter = Buffered(self._law.pressure), Buffered(self._law.counter)
        for call in (self._pressure, self._counter):
            call.arguments[-1][:] = self._parameters
        self._remembers = self._law.rest.numel_out(0) > 0

    def rest(self, q: Array) -> Array:
        if not self._remembers:
            return np.empty(0)
        return np.array(self._law.rest(q, self._parameters)).ravel()

    def commands(self, q: Array, v: Array, a: Array, z: Array) -> Array:
        call, given = self._pressure, (q.T, v.T, a.T, z.T)
        found = np.empty((q.shape[1], len(call.results[0])))
        for k, row in enumerate(found):
            for argument, values in zip(call.arguments, given, strict=False):
                argument[:] = values[k]
            call()
            row[:] = call.results[0]
        return found

    def counter(self, q: Array, torque: Array) -> Array:
        call = self._counter
        call.arguments[0][:], call.arguments[1][:] = q, torque
        call()
        return np.array(call.results[0])

    def advanced(self, q: Array, v: Array, z: Array, dt: float) -> Array:
        return np.array(self._law.advanced(q, v, z, self._parameters, dt)).ravel()

    def possible(self, q: Array, v: Array, a: Array) -> float:
        still = np.zeros_like(q)
        z = self.rest(q)[:, None]
        moving = self.commands(q[:, None], v[:, None], a[:, None], z)[0]
        resting = self.commands(q[:, None], still[:, None], still[:, None], z)[0]
        most = float(np.linalg.norm(moving - resting))
        # What the ends of pressures cut off of the motion; of the pose springs take it where they can.
        beyond = moving - np.clip(moving, self._low, self._high), resting - np.clip(resting, self._low, self._high)
        return share_left(float(np.linalg.norm(beyond[0] - beyond[1])), most, float(self._span))


class _Exact:
    """Of any actuators, see ``models.dynamics``; the effects' states count as after a long rest."""

    def __init__(self, model: Model) -> None:
        self._dynamics = Dynamics(model)

    def rest(self, q: Array) -> Array:
        return np.empty(0)

    def commands(self, q: Array, v: Array, a: Array, z: Array) -> Array:
        own = self._dynamics
        return np.array([own.commands(x, y, own.needed(x, y, w)) for x, y, w in zip(q.T, v.T, a.T, strict=True)])

    def counter(self, q: Array, torque: Array) -> Array:
        return self._dynamics.answer(self._dynamics.authority(q, np.zeros_like(q))[0], torque)

    def advanced(self, q: Array, v: Array, z: Array, dt: float) -> Array:
        return z

    def possible(self, q: Array, v: Array, a: Array) -> float:
        return self._dynamics.possible(q, v, a)


def solved_for_commands(model: Model) -> Solved:
    """The inverse of a model.

    Raises:
        NotAvailable: where no equations hold the robot.
    """
    return _Pressures(model) if "lengths" in model.robot.offers else _Exact(model)


def known_lateness(model: Model, lags: bool = True) -> float:
    """By how much what a command does is seen late at most, as is known [s].

    Args:
        model: of the robot.
        lags: whether time constants count beside dead times and late sensors.
    """
    valve = valves_of(model)
    sensor = sensor_settings(model.effects, model.robot.joint_names)[:, SENSOR_DELAY]
    lag = float(((valve[:, FILL] + valve[:, VENT]) / 2).max()) if lags else 0.0
    return float(valve[:, DELAY].max()) + lag + float(sensor.max())


@lru_cache(maxsize=32)
def valves_of(model: Model) -> Array:
    """(na, 6) what stands between commands and actuators, see ``effects.command.DELAY``.

    That of the effects, and delays, filters and limited rates of the robot's own; time constants in a row count as
    their sum.
    """
    robot = changed_bodies(model.effects, model.robot)
    valve = valve_settings(model.effects, robot.actuator_names)
    for i, channel in enumerate(robot.mechanics().channels):
        valve[i, DELAY] += channel.delay
        if channel.kind == FILTERED:
            valve[i, [FILL, VENT]] += channel.number
        elif channel.kind == SLEWED and channel.number > 0:
            valve[i, RATE] = min(valve[i, RATE], channel.number)
    return frozen_array(valve)
