"""What numbers in a recording can be right: time, range of the commands, and units."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.recordings.sheet import Tabular, number
from equimus_ctrl.types import Array, Recording

GAP, GAP_TIME = 100, 2.0
"""So many usual times between rows without one are a gap, if that is so long at least [s]: some write in bursts."""
LARGEST = 1e10
"""No quantity of a robot is so large in SI units; MuJoCo takes a state beyond it for one that has diverged."""
MANY_TURNS = 4.0
"""Of a hinge about zero; it may turn without end, but most that is said to go farther is in degrees."""


class RecordingWarning(UserWarning):
    """A recording can be read, but something in it looks like a slip."""


@dataclass(frozen=True)
class Limits:
    """What may stand in a recording; the defaults are those of the EquiMus leg.

    Attributes:
        command_low: lowest command [Pa].
        command_high: highest command [Pa]. Both ends are held to one millionth of the range, for rounding.
        max_angle: largest |angle| that can be radians [rad]. One joint beyond it and the whole file is taken to be in
            degrees; the hip of a leg hanging down is at some 90 of them. A file whose joints all stay within ±6.9°
            cannot be distinguished from radians by its size and passes.
        rotating: joints that may turn without end; their angles are not judged.
        checked_for_degrees: those of them that are checked for degrees in the place of radians, see ``MANY_TURNS``.
        max_interval: largest median time between rows [s]; milliseconds in the place of seconds exceed it.
        joints: names that belong together: a file with one of them must have all of them.
        actuators: the same for actuators.
        missing: what to do where some of them are missing, for the message.
        given: positions that are an input: of these no velocities are asked for.
    """

    command_low: float = 0.0
    command_high: float = 50_000.0
    max_angle: float = 1.1 * 2.0 * math.pi
    rotating: tuple[str, ...] = ()
    checked_for_degrees: tuple[str, ...] = ()
    max_interval: float = 0.5
    joints: tuple[str, ...] = ("hip", "knee")
    actuators: tuple[str, ...] = ("maa", "baa")
    missing: str = ""
    given: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.command_low < self.command_high:
            raise ConfigError(
                f"the lowest command ({number(self.command_low)} Pa) must be below the highest "
                f"({number(self.command_high)} Pa)"
            )
        for key in ("max_angle", "max_interval"):
            if not getattr(self, key) > 0.0:
                raise ConfigError(f"{key} is {number(getattr(self, key))}; it must be above 0")

    @property
    def pressures(self) -> bool:
        """Whether commands are pressures; those of MJCF robots are whatever their actuators take."""
        return math.isfinite(self.command_high)

    @classmethod
    def of_mjcf(
        cls,
        joints: Sequence[str],
        actuators: Sequence[str],
        hinges: Sequence[str] = (),
        missing: str = "",
        given: Sequence[str] = (),
    ) -> Limits:
        """Of a robot whose commands may be anything, and whose joints, of which some are hinges, may go without end."""
        every, wide = (*joints, *given), (-math.inf, math.inf, math.inf)
        return cls(
            *wide, every, tuple(hinges), joints=every, actuators=tuple(actuators), missing=missing, given=tuple(given)
        )


LEG = Limits()


def check_time(sheet: Tabular, column: str, time: Array, limits: Limits) -> None:
    """Raise RecordingError unless ``time`` (n,) [s] has two rows or more, ascends strictly, and is in seconds."""
    if len(time) < 2:
        raise sheet.error(0, column, "this is the only row; a recording has at least two")
    steps = np.diff(time)
    if not (steps > 0.0).all():
        row = int(np.argmin(steps > 0.0)) + 1
        verb = "repeats" if time[row] == time[row - 1] else "goes back from"
        raise sheet.error(
            row,
            column,
            f"{float(time[row])!r} s {verb} the {float(time[row - 1])!r} s of row {sheet.line_numbers[row - 1]}; "
            "times must ascend",
        )
    check_interval(sheet, column, steps, limits)
    check_gaps(sheet, column, time)


def check_gaps(sheet: Tabular, column: str, time: Array) -> None:
    """Raise RecordingError where there are no rows for more than half of the time; the longest gap is told."""
    if (row := after_gap(time)) is not None:
        raise sheet.error(row, column, gap_problem(time, row))


def after_gap(time: Array) -> int | None:
    """The row after the longest gap of a recording that has no rows for more than half of the time; else None."""
    steps = np.diff(time)
    gaps = steps > max(GAP * _usual(steps), GAP_TIME)
    return int(np.argmax(steps)) + 1 if steps[gaps].sum() > (time[-1] - time[0]) / 2 else None


def gap_problem(time: Array, row: int) -> str:
    """What is wrong with times that have a gap before a row."""
    steps = np.diff(time)
    return (
        f"nothing was recorded for {number(steps[row - 1])} s before {number(time[row])} s, where rows are "
        f"{number(_usual(steps))} s apart; these are several recordings, or one with a wrong time"
    )


def _usual(steps: Array) -> float:
    return float(np.sort(steps)[(len(steps) - 1) // 2])


def check_sizes(sheet: Tabular, columns: Sequence[str], values: Array) -> None:
    """Raise RecordingError for a number (n, k) that nothing of a robot is as large as."""
    beyond = np.abs(values) > LARGEST
    if beyond.any():
        row, k = (int(i) for i in np.argwhere(beyond)[0])
        raise sheet.error(
            row,
            columns[k],
            f"{number(float(values[row, k]))} is beyond ±{LARGEST:g}; a number in SI units belongs there",
        )


def check_interval(sheet: Tabular, column: str, steps: Array, limits: Limits) -> None:
    """Raise RecordingError where the median of ``steps``, the times between rows, cannot be seconds."""
    interval = float(np.median(steps))
    if interval > limits.max_interval:
        raise sheet.error(
            1,
            column,
            f"rows are {number(interval)} apart, above the {number(limits.max_interval)} s allowed; this looks like "
            "milliseconds where seconds belong",
        )


def check_commands(sheet: Tabular, columns: Sequence[str], command: Array, limits: Limits, unit: float = 1.0) -> None:
    """Raise RecordingError where ``command`` (n, k) is outside the range; ``unit`` is what one of it is in Pa."""
    outside = _outside(command * unit, limits)
    if outside.any():
        row, k = (int(i) for i in np.argwhere(outside)[0])
        raise sheet.error(row, columns[k], command_problem(float(command[row, k]) * unit, limits))


def command_problem(value: float, limits: Limits) -> str:
    """An empty string for a command [Pa] inside the range, else what is wrong with it."""
    if not _outside(np.array(value), limits):
        return ""
    side = "above" if value > limits.command_high else "below"
    return (
        f"command {number(value)} Pa is {side} the range {number(limits.command_low)}..{number(limits.command_high)} Pa"
    )


def _outside(command: Array, limits: Limits) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    span = limits.command_high - limits.command_low
    slack = 1e-6 * span if math.isfinite(span) else 0.0
    return np.asarray((command > limits.command_high + slack) | (command < limits.command_low - slack))


def check_angles(
    sheet: Tabular, joints: Sequence[str], columns: Sequence[str], position: Array, limits: Limits
) -> None:
    """Raise RecordingError where ``position`` (n, n_joints) cannot be radians; see ``Limits.max_angle``."""
    judged = [k for k, joint in enumerate(joints) if joint not in limits.rotating]
    beyond = np.abs(position[:, judged]) > limits.max_angle
    if beyond.any():
        row, k = (int(i) for i in np.argwhere(beyond)[0])
        k = judged[k]
        raise sheet.error(
            row,
            columns[k],
            f"{number(float(position[row, k]))} is beyond ±{number(limits.max_angle)} rad; this looks like degrees "
            "where radians belong",
        )


def check_degrees(sheet: Tabular, columns: Sequence[str], position: Array) -> None:
    """Raise RecordingError where ``position`` (n, k), said to be degrees, stays within a full turn in radians."""
    if np.abs(position).max() <= 2.0 * math.pi:
        raise sheet.error(
            0,
            columns[0],
            f"no angle is beyond {number(float(np.abs(position).max()))}; this looks like radians where degrees belong",
        )


def plausibility_warnings(name: str, recording: Recording, limits: Limits) -> list[str]:
    """One sentence for each thing that looks like a slip but can be meant.

    Commands in kPa where Pa belong cannot be distinguished from tiny ones with certainty. So that is a warning and no
    error. It is given where the largest command, the one before the first row included, is above zero and yet not above
    0.12 % of the range (60 Pa of 50 kPa, which is also 20 % above the range read as kPa). All-zero commands give none.
    A hinge that goes farther than ``MANY_TURNS`` may be in degrees, or turn without end.
    """
    found = []
    command, before = recording.command, recording.before
    largest = max(float(command.max(initial=0.0)), float(before.max(initial=0.0)) if before is not None else 0.0)
    if 0.0 < largest <= 1.2 * limits.command_high / 1e3 and math.isfinite(limits.command_high):
        found.append(
            f"{name}: no command is above {number(largest)} Pa, in a range up to {number(limits.command_high)} Pa; are "
            "these kPa where Pa belong?"
        )
    for joint, angle in zip(recording.joints, np.abs(recording.position).max(axis=0).tolist(), strict=True):
        turns = angle / (2.0 * math.pi)
        if joint in limits.checked_for_degrees and turns > MANY_TURNS:
            found.append(
                f"{name}: pos.{joint} goes to {number(angle)} rad, {turns:.0f} turns; are these degrees where radians "
                "belong?"
            )
    return found


def warn(sentences: Sequence[str]) -> None:
    """Give each sentence as a RecordingWarning."""
    for sentence in sentences:
        warnings.warn(sentence, RecordingWarning, stacklevel=3)
