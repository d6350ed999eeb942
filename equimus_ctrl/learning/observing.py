"""What a policy sees of a robot: measurements and commands so far, scaled by the robot's ranges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array, PlantSpec

LIMIT = 10.0
"""Observations beyond this show as this."""


class Scaling:
    """Positions and commands of a robot as numbers that are mostly within ±1.

    Positions are (q − middle)/(half range); of joints without range, hinges mostly, within ±π, over π. Commands are 2(u
    − low)/(high − low) − 1.

    Args:
        spec: of the robot.

    Raises:
        ConfigError: where a command has no limits.
    """

    def __init__(self, spec: PlantSpec) -> None:
        low, high = np.array(spec.command_low), np.array(spec.command_high)
        for name, least, most in zip(spec.actuators, low, high, strict=True):
            if not (np.isfinite([least, most]).all() and least < most):
                raise ConfigError(
                    f"the command of {name} goes from {least:g} to {most:g}, expected finite limits that actions from "
                    "-1 to 1 can be mapped to"
                )
        self.command_low, self.command_high = low, high
        ranged = np.isfinite(spec.joint_low) & np.isfinite(spec.joint_high)
        self.free = ~ranged & np.array([unit == "rad" for unit in spec.joint_units])
        least, most = np.where(ranged, spec.joint_low, -1.0), np.where(ranged, spec.joint_high, 1.0)
        self.middle = (least + most) / 2
        self.half = np.where(self.free, np.pi, (most - least) / 2)

    def command(self, action: Array) -> Array:
        """(…, na) commands of actions within ±1."""
        share = (np.clip(action, -1.0, 1.0) + 1) / 2
        return np.asarray(self.command_low + share * (self.command_high - self.command_low))

    def action(self, command: Array) -> Array:
        """(…, na) the actions of commands."""
        return np.asarray(2 * (command - self.command_low) / (self.command_high - self.command_low) - 1)

    def position(self, q: Array) -> Array:
        """(…, nj) of positions [rad or m]."""
        return np.asarray(self.difference(q - self.middle))

    def difference(self, q: Array) -> Array:
        """(…, nj) of differences of positions [rad or m]; whole turns of joints without range are none."""
        turned = (q + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(np.where(self.free, turned, q) / self.half)


class Memory:
    """The last measurements and commands of n robots, as they are observed.

    Args:
        n: how many robots.
        scaling: of the robot.
        history: how many of each; before the first, it is taken to have been the same.
    """

    def __init__(self, n: int, scaling: Scaling, history: int) -> None:
        self._scaling = scaling
        self._positions = np.zeros((n, history, len(scaling.half)))
        self._actions = np.zeros((n, history, len(scaling.command_low)))

    @property
    def size(self) -> int:
        """Of what is observed."""
        return int(self._positions[0].size + self._actions[0].size)

    def begin(self, rows: NDArray[np.int64], measured: Array, command: Array) -> None:
        """Robots begin where (r, nj) is measured of them under commands (r, na)."""
        self._positions[rows] = self._scaling.position(measured)[:, None]
        self._actions[rows] = self._scaling.action(command)[:, None]

    def add(self, rows: NDArray[np.int64], measured: Array, command: Array) -> None:
        """After commands (r, na), (r, nj) is measured."""
        for kept, new in (
            (self._positions, self._scaling.position(measured)),
            (self._actions, self._scaling.action(command)),
        ):
            kept[rows] = np.concatenate([kept[rows][:, 1:], new[:, None]], axis=1)

    def seen(self, rows: NDArray[np.int64]) -> Array:
        """(r, size): positions, the oldest first, then commands likewise."""
        return np.concatenate([kept[rows].reshape(len(rows), -1) for kept in (self._positions, self._actions)], axis=1)
