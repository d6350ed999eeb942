"""A recording behind the plant protocol: it shows what was measured and cannot be moved by commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Observation, PlantSpec, Recording, Start, frozen_array


class ReplayPlant:
    """Plays a recording back at a control rate; commands are clipped and reported but change nothing.

    It serves to see what a controller or an observer would have done with the real robot's measurements.

    Args:
        recording: what is played, from its first row on.
        model: the robot it is of, for names and limits.
        control_rate: [Hz].

    Raises:
        ConfigError: where the recording's joints or actuators are not the model's.
    """

    def __init__(self, recording: Recording, model: Robot, control_rate: float = 120.0) -> None:
        if (recording.joints, recording.actuators) != (model.joint_names, model.actuator_names):
            raise ConfigError(
                f"{recording.name}: has joints {', '.join(recording.joints)} and actuators "
                f"{', '.join(recording.actuators)}, but {model.name} has {', '.join(model.joint_names)} and "
                f"{', '.join(model.actuator_names)}"
            )
        if not 0 < control_rate < float("inf"):
            raise ConfigError(f"control rate is {control_rate:g} Hz, expected more than 0")
        self.recording = recording
        spec = make_spec(model, 1 / control_rate, model)
        self._spec = spec if recording.velocity is None else replace(spec, senses=frozenset({"velocities"}))
        self.reset()

    @property
    def spec(self) -> PlantSpec:
        """What a controller may know."""
        return self._spec

    @property
    def duration(self) -> float:
        """How long the recording lasts [s]."""
        return float(self.recording.time[-1] - self.recording.time[0])

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        """Rewind; a recording starts where it starts, so ``start`` and ``seed`` have no say."""
        self._count = 0
        self._clipped = np.zeros(len(self.spec.actuators), dtype=bool)
        return self._observe()

    def step(self, command: ArrayLike) -> Observation:
        """Play one control period on.

        Raises:
            ConfigError: for a command of the wrong size, or past the recording's end.
        """
        asked = np.asarray(command, dtype=np.float64)
        if asked.shape != (len(self.spec.actuators),):
            raise ConfigError(f"command has shape {asked.shape}, expected ({len(self.spec.actuators)},)")
        if not np.all(np.isfinite(asked)):
            raise ConfigError(f"command at {self._count * self.spec.control_dt:.3f} s is {asked}, not finite")
        if (self._count + 1) * self.spec.control_dt > self.duration + self.spec.control_dt:
            raise ConfigError(f"{self.recording.name}: the recording ends after {self.duration:.3f} s")
        self._clipped = (asked < self.spec.command_low) | (asked > self.spec.command_high)
        self._count += 1
        return self._observe()

    def close(self) -> None:
        """Nothing to let go of."""

    def _observe(self) -> Observation:
        now = self._count * self.spec.control_dt
        first = self.recording.time[0]
        row = max(int(np.searchsorted(self.recording.time - first, now + 1e-9, side="right")) - 1, 0)
        clipped = self._clipped.copy()
        clipped.flags.writeable = False
        return Observation(
            time=now,
            position=frozen_array(self.recording.position[row]),
            stamp=min(float(self.recording.time[row] - first), now),
            command=frozen_array(self.recording.command[row]),
            clipped=clipped,
            velocity=None if self.recording.velocity is None else frozen_array(self.recording.velocity[row]),
        )
