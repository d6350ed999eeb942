"""How a robot is reached, what its numbers mean, and what is never done to it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.settings import settings_from, table_of

FORMAT = "equimus-ctrl/hardware/1"
LEAST_STALE = 3.0
"""At least so many periods may pass without a measurement: with fewer, a delayed one looks like a lost one."""
MOST_DOMAIN = 232
"""DDS works out its ports from the domain; beyond this there are none."""


@dataclass(frozen=True)
class Calibration:
    """What a joint's number on the wire means: position = scale · (number − zero).

    Attributes:
        name: of the joint on the wire; its own by default.
        zero: the number at position 0.
        scale: rad (slides m) per unit, negative where it goes the other way.
    """

    name: str = ""
    zero: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.zero):
            raise ConfigError(f"zero is {self.zero:g}, expected a finite number")
        if not math.isfinite(self.scale) or self.scale == 0:
            raise ConfigError(f"scale is {self.scale:g}, expected a finite number other than 0")


@dataclass(frozen=True)
class Channel:
    """What is sent for an actuator: number = command / unit, at a place of the array; and its limits.

    Commands are in the SI unit that the robot has them in: Pa, N·m, N, rad or m of a goal, 1 of a control signal.

    Attributes:
        index: of the array that is sent; by default that of the actuator.
        unit: of the command per unit on the wire, such as 1000 for kPa; negative where it acts the other way.
        low: lowest command; the robot's own limit by default, and where that is higher.
        high: highest, alike.
        slew: by how much it changes at most in a second; stopping is exempt.
        stop: what is sent to stop the robot; by default 0, and the last one of a goal for where something is.
    """

    index: int = -1
    unit: float = 1.0
    low: float | None = None
    high: float | None = None
    slew: float | None = None
    stop: float | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.unit) or self.unit == 0:
            raise ConfigError(f"unit is {self.unit:g}, expected a finite number other than 0")
        if self.index < -1:
            raise ConfigError(f"index is {self.index}, expected at least 0")
        for key in ("low", "high", "stop"):
            if (value := getattr(self, key)) is not None and not math.isfinite(value):
                raise ConfigError(f"{key} is {value:g}, expected a finite number")
        if self.slew is not None and not (math.isfinite(self.slew) and self.slew > 0):
            raise ConfigError(f"slew is {self.slew:g}, expected more than 0")


@dataclass(frozen=True)
class Wire:
    """How a robot is reached.

    Attributes:
        transport: by name, see ``plants.hardware.transport``.
        domain: of DDS, ROS_DOMAIN_ID.
        states: topic of ``sensor_msgs/msg/JointState``.
        commands: topic of ``std_msgs/msg/Float64MultiArray``; by default what ros2_control calls that of a
            ``forward_command_controller`` with such commands, see ``interface.topic_of_commands``.
    """

    transport: str = "dds"
    domain: int = 0
    states: str = "/joint_states"
    commands: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= MOST_DOMAIN:
            raise ConfigError(f"domain is {self.domain}, expected 0 to {MOST_DOMAIN}")
        for key in ("states", "commands"):
            topic = getattr(self, key)
            if key == "commands" and not topic:
                continue
            if not topic.startswith("/") or topic.endswith("/") or any(c.isspace() for c in topic):
                raise ConfigError(f"{key} is {topic!r}, expected a topic such as /joint_states")


@dataclass(frozen=True)
class Safety:
    """What is enforced last, whatever a controller says. A fault stops the robot within one period.

    Attributes:
        pressure: highest that is ever sent [Pa]; the robot's own limit by default, and where that is lower. Of robots
            that are driven by pressures alone; limits of others stand with the actuators.
        slew: by how much pressures change at most [Pa/s]; venting is exempt.
        joint_margin: a hinge so far beyond its range is a fault [rad].
        speed: angles that change faster between two samples have jumped [rad/s].
        noise: by so much they may differ however short the time [rad].
        slide_margin: the first of slides [m].
        slide_speed: the second [m/s].
        slide_noise: the third [m].
        stale: without a sample for longer is a fault [s].
        clock: stamps that deviate by more from when samples arrive mean that the device's clock has jumped [s].
        misses: so many deadlines in a row may be missed; one more is a fault.
    """

    pressure: float | None = None
    slew: float | None = None
    joint_margin: float = 0.15
    speed: float = 30.0
    noise: float = 0.05
    slide_margin: float = 0.05
    slide_speed: float = 5.0
    slide_noise: float = 0.01
    stale: float = 0.1
    clock: float = 0.5
    misses: int = 5

    def __post_init__(self) -> None:
        for key in ("pressure", "slew", "speed", "noise", "slide_speed", "slide_noise", "stale", "clock"):
            value = getattr(self, key)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ConfigError(f"safety: {key} is {value:g}, expected more than 0")
        for key in ("joint_margin", "slide_margin"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"safety: {key} is {value:g}, expected at least 0")
        if self.misses < 0:
            raise ConfigError(f"safety: misses is {self.misses}, expected at least 0")


@dataclass(frozen=True)
class HardwareSettings:
    """All that is known of a real robot beside its model.

    Attributes:
        rate: of commands [Hz].
        patience: how long the first sample is waited for [s].
        settle: how long the start's command is held before a run begins, ramped to at first [s].
        wire: how it is reached.
        safety: what is enforced.
        joints: joint → calibration; all by default as they come.
        actuators: actuator → what is sent for it.
    """

    rate: float = 120.0
    patience: float = 10.0
    settle: float = 3.0
    wire: Wire = field(default_factory=Wire)
    safety: Safety = field(default_factory=Safety)
    joints: Mapping[str, Calibration] = field(default_factory=dict)
    actuators: Mapping[str, Channel] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key in ("rate", "patience"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{key} is {value:g}, expected more than 0")
        if not (math.isfinite(self.settle) and self.settle >= 0):
            raise ConfigError(f"settle is {self.settle:g}, expected at least 0")
        if self.safety.stale < LEAST_STALE / self.rate:
            raise ConfigError(
                f"safety: stale is {self.safety.stale:g} s, expected at least {LEAST_STALE:g} periods of "
                f"{1 / self.rate:.4g} s"
            )

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str = "hardware settings") -> HardwareSettings:
        """From what a TOML file holds: the settings' own keys, and a table for each joint and actuator.

        Raises:
            ConfigError: for a key that there is not, or a value that does not fit.
        """
        rest = dict(data)
        joints = {
            name: settings_from(Calibration, table, f"{where}: joints.{name}")
            for name, table in _tables(rest.pop("joints", {}), f"{where}: joints").items()
        }
        actuators = {
            name: settings_from(Channel, table, f"{where}: actuators.{name}")
            for name, table in _tables(rest.pop("actuators", {}), f"{where}: actuators").items()
        }
        flat = settings_from(_Flat, rest, where, FORMAT)
        try:
            return cls(flat.rate, flat.patience, flat.settle, flat.wire, flat.safety, joints, actuators)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """What a TOML file of these settings holds."""
        flat = table_of(_Flat(self.rate, self.patience, self.settle, self.wire, self.safety), FORMAT)
        joints = {name: table_of(own) for name, own in self.joints.items()}
        return {**flat, "joints": joints, "actuators": {name: table_of(own) for name, own in self.actuators.items()}}


@dataclass(frozen=True)
class _Flat:
    """The settings without their tables by name."""

    rate: float = 120.0
    patience: float = 10.0
    settle: float = 3.0
    wire: Wire = field(default_factory=Wire)
    safety: Safety = field(default_factory=Safety)


def _tables(value: Any, where: str) -> Mapping[str, Mapping[str, Any]]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where} is {value!r}, expected a table")
    for name, table in value.items():
        if not isinstance(table, Mapping):
            raise ConfigError(f"{where}.{name} is {table!r}, expected a table")
    return value
