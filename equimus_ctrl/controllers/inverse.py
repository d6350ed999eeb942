"""Feed-forward by the inverse of a model: what makes it follow a reference, and what its sensors show meanwhile.

The reference is differentiated, the equations of motion with all effects give the pressures P (``models.inverse``), and
valves are undone in turn: a command leads P by the transport delay and, where the valve lags, by τ dP/dt, and is what
dead zone, supply coupling, saturation and threshold leave P of. Held commands have a mean delay of half a period and
lead by that, too. Rate limits and filling flows cannot be undone. What is measured is compared with what offset, scale,
delay and play of the sensors make of the reference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.controllers.pid_kernel import blend
from equimus_ctrl.effects.command import DELAY, FILL, VENT
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, behind, follow, sensor_settings, shown
from equimus_ctrl.effects.valves import command_for, shaped_commands, useful_commands
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import solved_for_commands, valves_of
from equimus_ctrl.types import Array, Reference

SMOOTHING = 1 / 60
"""A reference is differentiated over as much to either side [s]."""


def window(control_dt: float, spread: float = 0.0) -> int:
    """How many control instants a step of a reference is differentiated over, from the first to a last arrival [s]."""
    return round(2 * SMOOTHING / control_dt) + 2 + math.ceil(spread / control_dt - 1e-9)


@dataclass(frozen=True, eq=False)
class InverseState:
    """How far a reference has been followed.

    Attributes:
        begun: when [s].
        pose: (nj,) where the robot was then [rad].
        states: (k, nz) of the effects, for each of the valves' delays.
        held: (nj,) what sensors with play show [rad].
        held_late: (nj,) what they show of a robot that is late, see ``later`` [rad].
    """

    begun: float
    pose: Array
    states: Array
    held: Array
    held_late: Array


@dataclass(frozen=True, eq=False)
class Target:
    """Where a robot that follows a reference is when the next command arrives, all delays included.

    Attributes:
        position: (nj,) [rad].
        velocity: (nj,) [rad/s].
        pressure: (na,) behind the valves [Pa].
        feed: (na,) what is to reach the valves, each at its own arrival [Pa].
    """

    position: Array
    velocity: Array
    pressure: Array
    feed: Array


class Inverse:
    """The inverse of a model at a control rate.

    Args:
        model: what is known of the robot.
        control_dt: time between two commands [s].
        start_time: over which the first pose fades out of the reference [s].

    Attributes:
        low: (na,) lowest command of any use [Pa].
        high: (na,) highest.
        actuators: their names.
    """

    def __init__(self, model: Model, control_dt: float, start_time: float) -> None:
        self._law = solved_for_commands(model)
        robot, effects = model.robot, model.effects
        self._effects, self.actuators = effects, robot.actuator_names
        self._sensor = sensor_settings(effects, robot.joint_names)
        self._valve = valves_of(model)
        self._delays = np.unique(self._valve[:, DELAY])
        lags = np.any(self._valve[:, [FILL, VENT]] > 0, axis=1)
        # Of each dead time whose actuators they are, and whether any of their valves lags.
        self._groups = [
            (float(delay), own, bool(lags[own].any()))
            for delay in self._delays
            for own in [np.flatnonzero(self._valve[:, DELAY] == delay)]
        ]
        self._dt, self._start_time = control_dt, start_time
        self._ranges = robot.command_ranges
        self.low, self.high = useful_commands(effects, robot.actuator_names, *robot.command_limits)

    def start(self, time: float, measured: Array) -> InverseState:
        """A robot that has long been at rest.

        Args:
            time: now [s].
            measured: (nj,) angles [rad].
        """
        pose = behind(self._sensor, measured)
        rest = self._law.rest(pose)
        return InverseState(time, pose, np.tile(rest, (len(self._delays), 1)), pose, pose)

    def taken_over(self, state: InverseState) -> InverseState:
        """What another inverse has followed, for valves that differ from its own."""
        return replace(state, states=np.tile(state.states[:1], (len(self._delays), 1)))

    def hold(self, state: InverseState) -> Array:
        """(na,) the command that holds the robot where it starts [Pa]."""
        return np.asarray(self.commands(self._holding(state)[None])[0])

    def arriving(self, command: Array) -> Array:
        """(n, na) what reaches the valves of commands (n, na) [Pa]."""
        return np.asarray(shaped_commands(self._effects, self.actuators, command, self._ranges))

    def surplus(self, state: InverseState, command: Array) -> Array:
        """(na,) by how much more pressure arrives of a command than holds the robot where it starts [Pa]."""
        return np.asarray(self.arriving(command[None])[0] - self._holding(state))

    def follow(
        self, reference: Reference, times: Array, stamps: Array, state: InverseState
    ) -> tuple[Array, Array, InverseState]:
        """What to command, and what the sensors show of a robot that follows.

        Args:
            reference: of the true angles; evaluated ahead of time by the valves' delay.
            times: (n,) successive control instants [s].
            stamps: (n,) when what is known at each of them was measured [s].
            state: how far it has been followed.

        Returns:
            Angles (n, nj) that the sensors show [rad], commands (n, na) within the useful range [Pa], and the state
            after the last of them.
        """
        feed, states = self._feed(reference, times, state)
        measured, held = self._shown(reference, stamps, state, state.held, self._start_time)
        return measured, self.commands(feed), replace(state, states=states, held=held)

    def later(
        self, reference: Reference, stamps: Array, state: InverseState, start_time: float
    ) -> tuple[Array, InverseState]:
        """What the sensors show of a robot that is later at the start, and the state after that.

        Args:
            reference: of the true angles.
            stamps: (n,) when what is known at successive control instants was measured [s].
            state: how far it has been followed.
            start_time: over which the first pose fades out of its reference [s].

        Returns:
            Angles (n, nj) [rad], and the state.
        """
        measured, held = self._shown(reference, stamps, state, state.held_late, start_time)
        return measured, replace(state, held_late=held)

    def target(self, reference: Reference, time: float, state: InverseState) -> tuple[Target, InverseState]:
        """Where a robot that follows is when a command that is given now first arrives.

        Args:
            reference: of the true angles; evaluated ahead of time by the valves' delay.
            time: of the control instant [s].
            state: how far it has been followed.

        Returns:
            That, and the state after it.
        """
        instant = np.array([time])
        feed, states = self._feed(reference, instant, state)
        q, v, a = self.motion(reference, instant + self._delays[0], state)
        pressure = self.pressures(q, v, a, state.states[0][:, None])
        return Target(q[:, 0], v[:, 0], pressure[0], feed[0]), replace(state, states=states)

    def possible(
        self, reference: Reference, time: float, state: InverseState, before: tuple[float, ...], now: bool = False
    ) -> tuple[float, ...]:
        """Shares of the reference's motion, beside what holds its pose, that can be done at instants a period apart.

        They reach from ``SMOOTHING`` before a command that is given now first arrives to as much after it last does:
        actuators that are late by unlike times move one robot, and a motion is toned down for all alike.

        Args:
            reference: of the true angles.
            time: of the control instant [s].
            state: how far it has been followed.
            before: what was found an instant before; empty at the first.
            now: whether they reach from ``SMOOTHING`` before now on.
        """
        spread = float(self._delays[-1]) - (0.0 if now else float(self._delays[0]))
        latest = time + float(self._delays[-1]) + SMOOTHING + self._dt / 2
        new = range(0 if before else math.ceil(spread / self._dt - 1e-9), -1, -1)
        instants = np.array([latest - k * self._dt for k in new])
        motion = (x.T for x in self.motion(reference, instants, state))
        found = [self.share(q, v, a) for q, v, a in zip(*motion, strict=True)]
        return (*before, *found)[-window(self._dt, spread) :]

    def share(self, q: Array, v: Array, a: Array) -> float:
        """Of a motion (nj,) each, beside what holds its pose, that can be done."""
        return self._law.possible(q, v, a)

    def toned(self, target: Target, share: float, reference: Reference, time: float, state: InverseState) -> Target:
        """A target with a share of the motion that it has beside its pose; as it is where that is all of it.

        Args:
            target: of a control instant.
            share: of its motion.
            reference: that it is of.
            time: of the instant [s].
            state: how far the reference has been followed.
        """
        if share >= 1:
            return target
        rest, held = self.resting(target.position, state.states[0]), np.empty_like(target.feed)
        for k, (delay, own, _) in enumerate(self._groups):
            pose = self._poses(reference, np.array([time + delay + self._dt / 2]), state, self._start_time)[0]
            held[own] = self.resting(pose, state.states[k])[own]
        pressure, feed = rest + share * (target.pressure - rest), held + share * (target.feed - held)
        return Target(target.position, share * target.velocity, pressure, feed)

    def resting(self, q: Array, z: Array) -> Array:
        """(na,) what holds a pose (nj,) [rad], the effects' states being (nz,) [Pa]."""
        still = np.zeros((len(q), 1))
        return np.asarray(self._law.commands(q[:, None], still, still, z[:, None])[0])

    def _feed(self, reference: Reference, times: Array, state: InverseState) -> tuple[Array, Array]:
        """(n, na) what is to reach the valves [Pa], and the effects' states afterwards."""
        pressure, states = np.empty((len(times), len(self.actuators))), np.empty_like(state.states)
        n, to_sides = len(times), np.array([[0.0], [-self._dt], [self._dt]])
        for k, (delay, own, lags) in enumerate(self._groups):
            arrival = times + delay + self._dt / 2
            q, v, a = self.motion(reference, (arrival + (to_sides if lags else to_sides[:1])).ravel(), state)
            z, states[k] = self.states(q[:, :n], v[:, :n], state.states[k])
            found = self.pressures(q, v, a, np.tile(z, q.shape[1] // n))[:, own]
            pressure[:, own] = found[:n]
            if lags:
                rate = np.zeros_like(pressure)
                rate[:, own] = (found[2 * n :] - found[n : 2 * n]) / (2 * self._dt)
                pressure += self.lead(rate)
        return pressure, states

    def _holding(self, state: InverseState) -> Array:
        return self.resting(state.pose, state.states[0])

    def commands(self, pressure: Array) -> Array:
        """(n, na) the commands within the useful range that come nearest to pressures [Pa]."""
        command = command_for(self._effects, self.actuators, pressure, self.low, self.high)
        return np.clip(command, self.low, self.high)

    def _poses(self, reference: Reference, times: Array, state: InverseState, lasts: float) -> Array:
        """(n, nj) where the robot is to be: the first pose fades into the reference, both at rest before [rad]."""
        found = np.empty((len(times), len(state.pose)))
        for k, time in enumerate(np.maximum(times, state.begun).tolist()):
            found[k] = reference.position(time)
            if time - state.begun < lasts:
                weight = blend(time - state.begun, lasts)
                found[k] = (1 - weight) * found[k] + weight * state.pose
        return found

    def motion(self, reference: Reference, times: Array, state: InverseState) -> tuple[Array, Array, Array]:
        """(nj, n) angles, velocities and accelerations of a robot that follows the reference from its first pose on."""
        around = np.concatenate([times - SMOOTHING, times, times + SMOOTHING])
        found, n = self._poses(reference, around, state, self._start_time).T, len(times)
        before, now, after = found[:, :n], found[:, n : 2 * n], found[:, 2 * n :]
        return now, (after - before) / (2 * SMOOTHING), (after - 2 * now + before) / SMOOTHING**2

    def states(self, q: Array, v: Array, first: Array) -> tuple[Array, Array]:
        """(nz, n) the effects' states along a motion, and after it."""
        z = np.empty((len(first), q.shape[1]))
        for k in range(q.shape[1] if len(first) else 0):
            z[:, k] = first
            first = self._law.advanced(q[:, k], v[:, k], first, self._dt)
        return z, first

    def counter(self, q: Array, torque: Array) -> Array:
        """(na,) what pressures exert torques (nj,) [N·m] on the joints at a pose (nj,) [rad] by themselves [Pa]."""
        return self._law.counter(q, torque)

    def lead(self, rate: Array) -> Array:
        """(n, na) by how much commands to valves that lag lead pressures of these rates (n, na) [Pa/s] [Pa]."""
        return np.asarray(np.where(rate > 0, self._valve[:, FILL], self._valve[:, VENT]) * rate)

    def pressures(self, q: Array, v: Array, a: Array, z: Array) -> Array:
        """(n, na) under which the robot moves so (nj, n), the effects' states being (nz, n) [Pa]."""
        return self._law.commands(q, v, a, z)

    def _shown(
        self, reference: Reference, times: Array, state: InverseState, held: Array, start_time: float
    ) -> tuple[Array, Array]:
        """(n, nj) what the sensors show, and (nj,) where those with play are held in the end, ``held`` before."""
        angles, held = np.empty((len(times), len(state.pose))), held.copy()
        for sensor_delay in np.unique(self._sensor[:, SENSOR_DELAY]):
            own = np.flatnonzero(self._sensor[:, SENSOR_DELAY] == sensor_delay)
            angles[:, own] = self._poses(reference, times - sensor_delay, state, start_time)[:, own]
        for j in np.flatnonzero(self._sensor[:, PLAY] > 0):
            for k in range(len(times)):
                angles[k, j] = held[j] = follow(held[j], angles[k, j], self._sensor[j, PLAY])
        return shown(self._sensor, angles), held
