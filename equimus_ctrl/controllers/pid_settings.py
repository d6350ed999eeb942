"""Settings of a PID, and the file that holds them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array, PlantSpec

FORMAT = "equimus-ctrl/pid/1"
Space = Literal["length", "joint"]


@dataclass(frozen=True)
class PidGains:
    """One channel's gains. Efforts are forces [N] on a length [m], or torques [N·m] on an angle [rad].

    Of a slide m takes the place of rad and N of N·m; decoupled efforts are accelerations [rad/s² or m/s²].

    Attributes:
        kp: effort per error.
        ki: effort per error and second.
        kd: effort per rate of error.
        tracking_time: in place of what the settings have for all channels [s].
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    tracking_time: float | None = None

    def __post_init__(self) -> None:
        for key, value in self.to_dict().items():
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected a finite number of at least 0")

    def to_dict(self) -> dict[str, float]:
        """What a TOML table of these gains holds."""
        return {key: value for key, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class PidSettings:
    """Settings of a PID; the law is in ``controllers.pid_kernel``.

    Attributes:
        gains: channel name (actuator or joint) → gains.
        space: ``"length"`` closes a loop round each actuator's length, ``"joint"`` round each joint's angle.
        derivative_time: time constant of the derivative filter [s].
        tracking_time: how fast the integrator follows a saturated command (anti-windup) [s].
        proportional_weight: share of the reference in the proportional term.
        derivative_weight: share of the reference in the derivative term.
        start_time: over which the first measured pose fades out of the reference (bumpless start) [s].
        feedforward: whether pressures are added that follow from the reference alone.
        inverse: whether these pressures are the inverse of all that is known of the plant: motion, forces, valves
            and sensors (``controllers.inverse``); else they hold the reference pose at rest.
        decoupled: whether efforts of joints are accelerations, which the mass matrix turns into torques, so that no
            joint disturbs another; for the PID by exact equations (``controllers.exact_pid``).
        lateness: by how much later than is known commands may act [s]: feedback takes for an error what is beyond both
            the reference and one out of which the first pose fades so much later. Of a PID on elastic actuators.
    """

    gains: Mapping[str, PidGains]
    space: Space = "length"
    derivative_time: float = 0.02
    tracking_time: float = 0.2
    proportional_weight: float = 1.0
    derivative_weight: float = 1.0
    start_time: float = 0.3
    feedforward: bool = True
    inverse: bool = False
    decoupled: bool = False
    lateness: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "gains", dict(self.gains))
        if self.space not in get_args(Space):
            raise ConfigError(unknown_name("PID space", str(self.space), get_args(Space)))
        for key in (
            "derivative_time",
            "tracking_time",
            "proportional_weight",
            "derivative_weight",
            "start_time",
            "lateness",
        ):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected a finite number of at least 0")
        if self.decoupled and self.space != "joint":
            raise ConfigError('decoupled is true, which is of joints, but space is not "joint"')
        if self.inverse and not self.feedforward:
            raise ConfigError("inverse is true, which is a way to feed forward, but feedforward is false")

    @property
    def late_start(self) -> float:
        """Over which the first pose fades out of the later reference [s]: on average ``lateness`` later."""
        return self.start_time + 2 * self.lateness

    def channels(self, spec_or_robot: PlantSpec | Robot) -> tuple[str, ...]:
        """Names of the channels on a robot: its actuators or its joints."""
        if isinstance(spec_or_robot, Robot):
            return spec_or_robot.actuator_names if self.space == "length" else spec_or_robot.joint_names
        return spec_or_robot.actuators if self.space == "length" else spec_or_robot.joints

    def fits(self, robot: Robot) -> bool:
        """Whether a robot has just these channels."""
        return set(self.gains) == set(self.channels(robot)) and (self.space == "joint" or "lengths" in robot.offers)

    def gain_matrix(self, channels: tuple[str, ...]) -> Array:
        """(7, n_channels) rows k_p, k_i, k_d, T_f, T_t, b, c, as the kernel takes them.

        Raises:
            ConfigError: where a channel has no gains or gains have no channel.
        """
        for name in self.gains:
            if name not in channels:
                raise ConfigError(unknown_name(f"{self.space} channel", name, channels, "PID gains"))
        for name in channels:
            if name not in self.gains:
                raise ConfigError(f"PID gains: channel {name!r} has none (given: {', '.join(self.gains) or 'none'})")
        rows = []
        for g in (self.gains[name] for name in channels):
            tracking = self.tracking_time if g.tracking_time is None else g.tracking_time
            times = self.derivative_time, tracking
            rows.append([g.kp, g.ki, g.kd, *times, self.proportional_weight, self.derivative_weight])
        return np.array(rows).T.copy()

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str = "PID settings") -> PidSettings:
        """Settings from what a TOML file holds.

        Raises:
            ConfigError: for an unknown or missing key or a value of the wrong kind, in a sentence with ``where``.
        """
        names = [f.name for f in fields(cls)]
        values: dict[str, Any] = {}
        for key, value in data.items():
            if key == "format":
                if value != FORMAT:
                    raise ConfigError(f"{where}: format is {value!r}, expected {FORMAT!r}")
                continue
            if key not in names:
                raise ConfigError(unknown_name("key", key, names, where))
            values[key] = value
            if key in ("space", "gains"):
                continue
            switch = key in ("feedforward", "inverse", "decoupled")
            if isinstance(value, bool) != switch or not isinstance(value, int | float):
                kind = "true or false" if switch else "a number"
                raise ConfigError(f"{where}: {key} is {value!r}, expected {kind}")
        gains = values.get("gains")
        if not isinstance(gains, Mapping) or not gains:
            raise ConfigError(f"{where}: there is no [gains.<channel>] table")
        values["gains"] = {name: _gains(table, f"{where}: gains.{name}") for name, table in gains.items()}
        try:
            return cls(**values)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """What a TOML file of these settings holds."""
        data = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("gains", "decoupled")}
        data |= {"decoupled": True} if self.decoupled else {}
        return {"format": FORMAT, **data, "gains": {name: gains.to_dict() for name, gains in self.gains.items()}}


def _gains(table: Any, where: str) -> PidGains:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is {table!r}, expected a table with kp, ki and kd")
    known = [f.name for f in fields(PidGains)]
    for key, value in table.items():
        if key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{where}: {key} is {value!r}, expected a number")
    if "kp" not in table:
        raise ConfigError(f"{where}: 'kp' is missing")
    try:
        return PidGains(**{key: float(value) for key, value in table.items()})
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
