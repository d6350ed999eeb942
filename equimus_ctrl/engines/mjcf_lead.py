"""What the motion before a trial's start left of an MJCF robot's hidden states, stepped by MuJoCo.

Drives that turn by themselves, states of laws and of actuators follow the commands while all joints are put, step by
step, where they were recorded to be. ``engines.lane_hidden`` does the same free of discretisation error. Integrators of
commands alone are not stepped to where a pass begins: they add up all of the commands before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from equimus_ctrl.effects.following import STRIDE
from equimus_ctrl.effects.sensors import SCALE, SENSOR_DELAY, behind, hermite_rate
from equimus_ctrl.engines.limits import MAX_SPEED, REMEMBERED
from equimus_ctrl.engines.mjcf_commands import Arriving
from equimus_ctrl.engines.mjcf_realised import LOST, Realised, function_address, scratch
from equimus_ctrl.engines.motion import hermite_arrays
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.types import Array

hermite_rates = cast("Callable[..., Array]", hermite_rate.py_func)
"""``effects.sensors.hermite_rate`` over whole arrays."""


@dataclass(frozen=True, eq=False)
class Hidden:
    """What no sensor shows of an MJCF robot.

    Attributes:
        rotors: (n, 2) coordinates and rates of drives that turn by themselves [rad or m, rad/s or m/s].
        act: (na,) MuJoCo's activations.
        states: (nj, nz) of the laws.
        sound: whether they mean anything.
    """

    rotors: Array
    act: Array
    states: Array
    sound: bool = True


Rows = Callable[[Realised, Trial], Array]
"""(1 + n, na) all commands of a history, see ``mjcf.rows_of``."""


def remembers(own: Realised) -> bool:
    """Whether a robot has states that hang on the motion before, and not on commands alone."""
    by_commands = sum(drive.state is not None for drive in own.robot.actuators)
    return bool(len(own.rotors) or any(law.n_states for law in own.stepped) or own.mujoco.na > by_commands)


class Leader:
    """Leads the hidden states of one robot along recordings to where trials start.

    Of trials of one recording that come in the order of their starts, one pass leads to all: up to the last start, and
    over what is farther from the recording's start than ``REMEMBERED`` twice.

    Args:
        own: the robot.
        kernel: that steps it, see ``engines.mjcf_kernel``.
        rows: commands of a history.
        begin: the hidden states at a trial's start, where a pass begins, with (2 n,) coordinates and rates of all
            joints there, and where the recording begins.
    """

    def __init__(self, own: Realised, kernel: Any, rows: Rows, begin: Callable[[Trial, Array, Array], Hidden]) -> None:
        self.own, self.kernel, self.rows, self.begin = own, kernel, rows, begin
        self.places = np.vstack([own.places[:, :2], own.others])
        self._arriving: dict[Hashable, Arriving] = {}
        self._reached: dict[Hashable, tuple[int, int, Hidden, Array]] = {}

    def at(self, trial: Trial, start: Array) -> Hidden:
        """The hidden states where a trial starts inside its recording.

        Args:
            trial: of a recorded motion, see ``Trial.led``.
            start: (2 n,) coordinates and rates of all joints at its start.
        """
        recorded, first = trial.led, float(trial.times[0])
        assert recorded is not None
        bends = min(recorded.reading, trial.start - first, REMEMBERED / 2)
        stride = STRIDE * float(self.own.mujoco.opt.timestep)
        period = max(int((trial.start - first) / REMEMBERED) - 1, 0)
        last = int((trial.start - bends - first) / stride)
        key = trial.history
        if key not in self._arriving:
            self._arriving[key] = Arriving.of(self.own, trial, self.rows(self.own, trial))
        arriving, reached = self._arriving[key], self._reached.get(key)
        if reached is None or reached[0] != period or reached[1] > last:
            place = int(period * REMEMBERED / stride)
            early = replace(trial, start=first + place * stride)
            here, there = np.concatenate(self._motion(trial, np.array([early.start, first])), axis=1)
            reached = period, place, self.begin(early, here, there), arriving.at(early.start)
        _, place, hidden, carried = reached
        while place < last:
            here = first + place * stride
            hidden = self._led(trial, hidden, arriving, carried, here, first + (place + 1) * stride)
            place += 1
        self._reached[key] = period, place, hidden, carried
        return self._led(trial, hidden, arriving, carried.copy(), first + place * stride, trial.start, start, bends)

    def _motion(self, trial: Trial, times: Array) -> tuple[Array, Array]:
        """(n, nj + np + nu) coordinates and rates of the recorded motion."""
        assert trial.led is not None
        motion, own = trial.led.motion, self.own
        q, v, _ = motion.at(times)
        nj = len(own.places)
        for j in np.flatnonzero(own.sensor[:, SENSOR_DELAY] > 0):
            late = motion.at(times + own.sensor[j, SENSOR_DELAY])
            q[:, j], v[:, j] = late[0][:, j], late[1][:, j]
        q[:, :nj] = behind(own.sensor, q[:, :nj])
        v[:, :nj] /= own.sensor[:, SCALE]
        return q, v

    def _led(
        self,
        trial: Trial,
        hidden: Hidden,
        arriving: Arriving,
        carried: Array,
        begun: float,
        until: float,
        start: Array | None = None,
        bends: float = 0.0,
    ) -> Hidden:
        """The hidden states after a part of the recording, whose end bends to a start where one is given.

        Once they have diverged they stay so.
        """
        if not hidden.sound:
            return hidden
        own, model = self.own, self.own.mujoco
        usual = float(model.opt.timestep)
        steps = max(math.ceil((until - begun) / usual - 1e-9), 1)
        dt = (until - begun) / steps
        q, v = self._motion(trial, np.linspace(begun, until, steps + 1))
        if start is not None:
            off, faster = np.split(start, 2)
            off, faster = off - q[-1], faster - v[-1]
            share = np.maximum(1.0 - (until - np.linspace(begun, until, steps + 1)[:, None]) / bends, 0.0)
            q = q + hermite_arrays(0.0, 0.0, off, faster, bends, share)
            v = v + hermite_rates(0.0, 0.0, off, faster, bends, share)
        data, states, nj = scratch.data(model), hidden.states.copy(), len(own.places)
        model.dof_frictionloss[own.places[:, 1]] = own.loss
        data.qpos[own.rotors[:, 0]], data.qvel[own.rotors[:, 1]] = hidden.rotors.T
        data.act[:] = hidden.act
        path = np.empty((2, steps + 1, nj))
        try:
            model.opt.timestep = dt
            sound = self.kernel.run_mjcf(
                function_address("mj_step"), model._address, data._address, own.places, own.laws, own.loss,
                np.full(nj, MAX_SPEED), arriving.piece(carried, begun, dt, steps), np.empty((0, nj)), states,
                data.qpos, data.qvel, data.ctrl, data.qfrc_applied, model.dof_frictionloss, data.qfrc_actuator, dt,
                self.places, np.ascontiguousarray(q), np.ascontiguousarray(v), *path, data.act, np.empty((0, 0)),
            )  # fmt: skip
        finally:
            model.opt.timestep = usual
        rotors = np.column_stack([data.qpos[own.rotors[:, 0]], data.qvel[own.rotors[:, 1]]])
        numbers = all(np.isfinite(values).all() for values in (rotors, data.act, states))
        kept = sound == steps + 1 and not any(data.warning[kind].number for kind in LOST)
        return Hidden(
            rotors, np.array(data.act), states, bool(numbers and kept and (np.abs(rotors[:, 1]) < MAX_SPEED).all())
        )
