"""What a policy sees of a robot: measurements and commands so far, scaled by the robot's ranges."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.types import Array, PlantSpec

LIMIT = 10.0
"""Observations beyond this show as this."""
AHEAD = (0.0, 0.05, 0.1, 0.2)
"""How far ahead a policy sees the reference [s]."""


def bounded(parts: Iterable[Array]) -> NDArray[np.float32]:
    """(r, size) what policies see, of its parts (r, …) side by side."""
    return np.asarray(np.clip(np.concatenate(list(parts), axis=1), -LIMIT, LIMIT), dtype=np.float32)


class Sight(Protocol):
    """What of a task a policy sees that also who drives a robot has: of its reference and of the clock."""

    kind: ClassVar[str]

    def at(self, period: int, reference: Callable[[int], Array], scaling: Scaling) -> Array:
        """(size,) after so many control periods.

        Args:
            period: control periods since the start.
            reference: (nj,) after so many control periods [rad or m].
            scaling: of the robot.
        """
        ...


@dataclass(frozen=True)
class ReferenceAhead:
    """The reference now and later.

    Attributes:
        periods: how many control periods later, one after the other.
    """

    periods: tuple[int, ...]
    kind: ClassVar[str] = "reference"

    def __post_init__(self) -> None:
        object.__setattr__(self, "periods", tuple(int(k) for k in self.periods))

    @classmethod
    def of(cls, control_dt: float) -> ReferenceAhead:
        """``AHEAD``, with control periods of ``control_dt`` [s]."""
        return cls(tuple(round(ahead / control_dt) for ahead in AHEAD))

    def at(self, period: int, reference: Callable[[int], Array], scaling: Scaling) -> Array:
        """As of any sight."""
        return scaling.position(np.array([reference(period + k) for k in self.periods])).ravel()


@dataclass(frozen=True)
class TimeLeft:
    """The share of the time that is left.

    Attributes:
        periods: control periods in all.
    """

    periods: int
    kind: ClassVar[str] = "time_left"

    def left(self, period: Any) -> Any:
        """After so many control periods; none after the last."""
        return np.maximum(1 - period / self.periods, 0.0)

    def at(self, period: int, reference: Callable[[int], Array], scaling: Scaling) -> Array:
        """As of any sight."""
        return np.array([self.left(period)])


SIGHTS: dict[str, type[Any]] = {own.kind: own for own in (ReferenceAhead, TimeLeft)}


def sight_to_dict(sight: Sight) -> dict[str, Any]:
    """As JSON data."""
    return {"kind": sight.kind, **asdict(sight)}  # type: ignore[call-overload]


def sight_of(data: Mapping[str, Any], where: str) -> Sight:
    """Of JSON data.

    Raises:
        ConfigError: for an unknown kind.
    """
    own = dict(data)
    kind = str(own.pop("kind", ""))
    if kind not in SIGHTS:
        raise ConfigError(unknown_name("kind of observation", kind, SIGHTS, where))
    made: Sight = SIGHTS[kind](**own)
    return made


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

    def copy(self) -> Memory:
        """Another, that remembers the same."""
        other = Memory.__new__(Memory)
        other._scaling = self._scaling
        other._positions, other._actions = self._positions.copy(), self._actions.copy()
        return other

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
