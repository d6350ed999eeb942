"""What hardware settings come to for one robot: arrays in the order of its joints and actuators."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.plants.hardware.settings import Calibration, Channel, HardwareSettings, Wire
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array, frozen_array

SWEEP = 0.05
"""A command that nothing else limits takes so long at least through its range [s]."""
RATE = "/s"
"""Units of goals that end so say how fast something is to move, not where it is to be."""


@dataclass(frozen=True, eq=False)
class Interface:
    """How one robot is reached.

    Attributes:
        wire: with all topics.
        calibrations: of the joints.
        channels: of the actuators.
        joint_units: SI units of the joints' positions.
        command_units: SI units of the commands.
        margin: (nj,) a joint so far beyond its range is a fault [rad or m].
        speed: (nj,) positions that change faster have jumped [rad/s or m/s].
        noise: (nj,) by so much they may differ however short the time [rad or m].
        command_low: (na,) lowest command.
        command_high: (na,) highest.
        slew: (na,) by how much commands change at most [their unit/s].
        stop: (na,) what stops the robot; NaN where the last command does, a goal for where something is.
    """

    wire: Wire
    calibrations: tuple[Calibration, ...]
    channels: tuple[Channel, ...]
    joint_units: tuple[str, ...]
    command_units: tuple[str, ...]
    margin: Array
    speed: Array
    noise: Array
    command_low: Array
    command_high: Array
    slew: Array
    stop: Array

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(na,) whose last command stops the robot."""
        return np.isnan(self.stop)

    @property
    def stopped(self) -> str:
        """What the robot is once it was stopped, in a word."""
        return stopped_word(self.command_units)

    def stopping(self, command: Array) -> Array:
        """(na,) what stops the robot after a command (na,)."""
        return np.where(self.holds, command, self.stop)

    def numbers(self, command: Array) -> list[float]:
        """What is sent for a command (na,)."""
        values = [0.0] * len(command)
        for value, channel in zip(command.tolist(), self.channels, strict=True):
            values[channel.index] = value / channel.unit
        return values

    def command(self, numbers: Sequence[float]) -> Array:
        """(na,) the command of which numbers were sent, as many as there are actuators."""
        return np.array([numbers[channel.index] * channel.unit for channel in self.channels])


def stopped_word(units: Iterable[str]) -> str:
    """What a robot with commands of some SI units is once it was stopped, in a word."""
    return "vented" if set(units) == {"Pa"} else "stopped"


def settings_for(robot: Robot, rate: float) -> HardwareSettings:
    """Settings of a robot of which no file tells: names, limits and units are its own.

    Args:
        robot: with names, ranges and units.
        rate: of commands [Hz].
    """
    return HardwareSettings(rate=rate, wire=Wire(commands=topic_of_commands(robot)))


def topic_of_commands(robot: Robot) -> str:
    """What ros2_control's examples call the topic of a ``forward_command_controller`` with a robot's commands."""
    units, goals = robot.command_units, robot.goals
    words = {
        "pressure": all(unit == "Pa" for unit in units),
        "velocity": all(unit.endswith(RATE) for unit in units),
        "position": all(goals) and not any(unit.endswith(RATE) for unit in units),
        "effort": all(unit in ("N", "N·m") for unit in units),
    }
    return f"/forward_{next((word for word, fits in words.items() if fits), 'command')}_controller/commands"


def interface_of(
    settings: HardwareSettings, robot: Robot, where: str = "hardware settings", limited: bool = True
) -> Interface:
    """How a robot is reached.

    Args:
        settings: with what differs from the robot's own names, units and limits.
        robot: whose joints and actuators are on the wire.
        where: for messages.
        limited: whether it is to be driven, and its commands have to be limited.

    Raises:
        ConfigError: for a joint or actuator that it does not have, two that share a name or a place, or commands that
            nothing limits.
    """
    joints, actuators, safety = robot.joint_names, robot.actuator_names, settings.safety
    _known("joint", settings.joints, joints, where)
    _known("actuator", settings.actuators, actuators, where)
    own = [(name, settings.joints.get(name, Calibration())) for name in joints]
    calibrations = tuple(replace(given, name=given.name or name) for name, given in own)
    channels = tuple(
        replace(given, index=i if given.index < 0 else given.index)
        for i, given in enumerate(settings.actuators.get(name, Channel()) for name in actuators)
    )
    names, places = [c.name for c in calibrations], [c.index for c in channels]
    if len(set(names)) < len(names):
        raise ConfigError(f"{where}: joints are called {', '.join(names)} on the wire, expected each another name")
    if sorted(places) != list(range(len(places))):
        raise ConfigError(
            f"{where}: actuators have the indices {', '.join(map(str, places))}, expected 0 to {len(places) - 1}, "
            "each once"
        )
    if "Pa" not in robot.command_units and (safety.pressure is not None or safety.slew is not None):
        key = "slew" if safety.pressure is None else "pressure"
        raise ConfigError(
            f"{where}: safety: {key} is for robots driven by pressures, and {robot.name} has none; expected low, high "
            f"and slew under [actuators.{actuators[0]}]"
        )
    slides = np.array([unit == "m" for unit in robot.joint_units])
    low, high, slew, stop = (np.empty(len(actuators)) for _ in range(4))
    limits = zip(*robot.command_limits, robot.command_rates, strict=True)
    for i, (least, most, fastest) in enumerate(limits):
        channel, unit = channels[i], robot.command_units[i]
        pressure = safety.pressure if unit == "Pa" else None
        low[i] = max(least, -np.inf if channel.low is None else channel.low)
        high[i] = min(most, *(v for v in (channel.high, pressure) if v is not None), np.inf)
        label = f"{where}: {robot.name}: commands of {actuators[i]}" + (f" [{unit}]" if unit != "1" else "")
        if limited and not (np.isfinite(low[i]) and np.isfinite(high[i])):
            raise ConfigError(
                f"{label} have no limits of their own, expected low and high under [actuators.{actuators[i]}]"
            )
        if not low[i] < high[i]:
            raise ConfigError(f"{label} lie between {low[i]:g} and {high[i]:g}, expected low below high")
        goal = robot.goals[i] and not unit.endswith(RATE)
        usual = {"rad": safety.speed, "m": safety.slide_speed}.get(unit) if goal else None
        span = most - least if np.isfinite(most - least) else high[i] - low[i]
        given = (channel.slew, safety.slew if unit == "Pa" else None, usual, span / SWEEP)
        slew[i] = min(fastest, next(v for v in given if v is not None))
        stop[i] = channel.stop if channel.stop is not None else np.nan if goal else 0.0
        if channel.stop is not None and not low[i] <= channel.stop <= high[i]:
            raise ConfigError(f"{label}: stop is {channel.stop:g}, expected {low[i]:g} to {high[i]:g}")
    by_kind = {
        "margin": (safety.slide_margin, safety.joint_margin),
        "speed": (safety.slide_speed, safety.speed),
        "noise": (safety.slide_noise, safety.noise),
    }
    return Interface(
        replace(settings.wire, commands=settings.wire.commands or topic_of_commands(robot)),
        calibrations, channels, robot.joint_units, robot.command_units,
        **{key: frozen_array(np.where(slides, *pair)) for key, pair in by_kind.items()},
        command_low=frozen_array(low), command_high=frozen_array(high), slew=frozen_array(slew),
        stop=frozen_array(stop),
    )  # fmt: skip


def _known(kind: str, given: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for name in given:
        if name not in known:
            raise ConfigError(unknown_name(kind, name, known, where))
