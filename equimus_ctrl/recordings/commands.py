"""Commands to be played: a CSV with ``time`` and ``cmd.<actuator>`` of each actuator, in SI units, as recordings have.

Other columns do not count, so that a recording's commands can be played as they are. Notes mean what they mean in a
recording: ``before.cmd.<actuator>``, ``interpolation = linear``, and what is known to be different (``set.…``,
``times.…``, ``payload.…``). ``start.pos.<joint> = 0.2`` (of all joints or none) says where the robot begins at rest
[rad or m]; without, it begins where it rests under the command before the first row.

Where joints are to track references, ``ref.<joint>`` of all joints says where they are to be, ``cmd.<actuator>`` is fed
forward, and notes have the law of the feedback (``types.FeedbackLaw``): ``track.smoothing`` [s],
``track.stiffness.<actuator>.<joint>`` and ``track.damping.<actuator>.<joint>``; what is not there is 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from equimus_ctrl.errors import ConfigError, RecordingError, unknown_name
from equimus_ctrl.recordings.checks import Limits
from equimus_ctrl.recordings.csvfile import BEFORE, replacing, stated_notes
from equimus_ctrl.recordings.sheet import PathLike, Sheet, open_sheet, shorten
from equimus_ctrl.types import Array, FeedbackLaw, frozen_array

COMMAND, REFERENCE, START = "cmd.", "ref.", "start.pos."
TRACK = "track."
STIFFNESS, DAMPING, SMOOTHING = f"{TRACK}stiffness.", f"{TRACK}damping.", f"{TRACK}smoothing"
DIFFERENT = ("set.", "times.", "payload.")
"""What notes begin with that say what is known to be different in the trial."""


@dataclass(frozen=True, eq=False)
class CommandFile:
    """What is to be played.

    Attributes:
        times: (n,) from 0 on, ascending [s].
        values: (n, na) from each time on [Pa, or the unit of each actuator's command].
        before: (na,) in force before, for long.
        position: (nj,) where the robot begins at rest [rad or m]; None where it rests under ``before``.
        linear: whether commands go along a line from each row to the next, in place of being held.
        different: notes that say what is known to be different in the trial.
        reference: (n, nj) where joints are to be [rad or m]; None where commands are played as they are. Between rows
            it goes along lines, and so does what is fed forward.
        law: by which they track it; commands are fed forward then.

    Raises:
        ConfigError: for a reference without a law, or a law without a reference.
    """

    times: Array
    values: Array
    before: Array
    position: Array | None = None
    linear: bool = False
    different: Mapping[str, str] = field(default_factory=dict)
    reference: Array | None = None
    law: FeedbackLaw | None = None

    def __post_init__(self) -> None:
        if (self.reference is None) != (self.law is None):
            raise ConfigError("a reference of joints is tracked by a feedback law, expected both or none")


def read_commands(
    path: PathLike, actuators: Sequence[str], joints: Sequence[str], low: Array, high: Array
) -> CommandFile:
    """The commands in a file.

    Args:
        path: of it.
        actuators: whose commands it has to have.
        joints: of the robot.
        low: (na,) lowest commands.
        high: (na,) highest.

    Raises:
        RecordingError: where the file cannot be read, lacks a column or has one of another actuator, times do not
            ascend, a command is out of its range, or a note says what cannot be.
    """
    sheet = open_sheet(path)
    columns = ["time", *(f"{COMMAND}{name}" for name in actuators)]
    for column in columns:
        if column not in sheet.header:
            raise sheet.header_error(f"there is no column {column!r}; expected {', '.join(columns)}")
    for column in sheet.header:
        if column.startswith(COMMAND) and column not in columns:
            raise sheet.header_error(unknown_name("actuator", column.removeprefix(COMMAND), actuators))
    law = _law(sheet, actuators, joints)
    wanted = [] if law is None else [f"{REFERENCE}{name}" for name in joints]
    for column in wanted:
        if column not in sheet.header:
            raise sheet.header_error(f"there is no column {column!r}, though notes {TRACK}… say how it is tracked")
    numbers = sheet.numbers([*columns, *wanted])
    times, values, reference = numbers[:, 0], numbers[:, 1 : len(columns)], numbers[:, len(columns) :]
    if len(times) < 2:
        raise sheet.error(0, "time", "this is the only row; expected two or more, the last where the commands end")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        row = int(late[0]) + 1
        raise sheet.error(row, "time", f"{times[row]:g} s does not come after {times[row - 1]:g} s")
    beyond = (values < low) | (values > high)
    if beyond.any():
        row, i = (int(k) for k in np.argwhere(beyond)[0])
        raise sheet.error(
            row, columns[1 + i], f"{values[row, i]:g} lies outside the range of commands, {low[i]:g} to {high[i]:g}"
        )
    notes, before = stated_notes(sheet, tuple(actuators), Limits.of_mjcf(joints, actuators))
    first = values[0] if before is None else before
    if np.any((first < low) | (first > high)):
        i = int(np.argmax((first < low) | (first > high)))
        raise RecordingError(
            f"{sheet.path}, note {BEFORE}{actuators[i]}: {first[i]:g} lies outside the range of commands, "
            f"{low[i]:g} to {high[i]:g}"
        )
    return CommandFile(
        frozen_array(times - times[0]),
        frozen_array(values),
        frozen_array(first),
        _start(sheet, notes, joints),
        notes.get("interpolation") == "linear",
        {key: text for key, text in notes.items() if key.startswith(DIFFERENT)},
        None if law is None else frozen_array(reference),
        law,
    )


def _law(sheet: Sheet, actuators: Sequence[str], joints: Sequence[str]) -> FeedbackLaw | None:
    """The law that notes say; None where they say none."""
    found = {STIFFNESS: np.zeros((len(actuators), len(joints))), DAMPING: np.zeros((len(actuators), len(joints)))}
    smoothing, said = 0.0, False
    places = {f"{a}.{j}": (i, k) for i, a in enumerate(actuators) for k, j in enumerate(joints)}
    for line, text in sheet.notes:
        key, _, number = (part.strip() for part in text.partition("="))
        if not key.startswith(TRACK):
            continue
        said, where = True, f"{sheet.path}, row {line}: note {key}"
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise RecordingError(f"{where} is {shorten(number)}, expected a finite number")
        if key == SMOOTHING:
            smoothing = value
            continue
        prefix = next((own for own in found if key.startswith(own)), None)
        if prefix is None:
            raise RecordingError(unknown_name("note", key, [SMOOTHING, STIFFNESS + "ACTUATOR.JOINT"], str(sheet.path)))
        if (place := key.removeprefix(prefix)) not in places:
            raise RecordingError(unknown_name("actuator and joint", place, places, where))
        found[prefix][places[place]] = value
    if not said:
        return None
    try:
        return FeedbackLaw(found[STIFFNESS], found[DAMPING], smoothing)
    except ConfigError as error:
        raise RecordingError(f"{sheet.path}: {error}") from None


def _start(sheet: Sheet, notes: Mapping[str, str], joints: Sequence[str]) -> Array | None:
    """(nj,) where notes say that the robot begins; None where they do not."""
    found: dict[str, float] = {}
    for key, text in notes.items():
        if not key.startswith(START):
            continue
        joint = key.removeprefix(START)
        if joint not in joints:
            raise RecordingError(unknown_name("joint", joint, joints, f"{sheet.path}: note {key}"))
        try:
            found[joint] = float(text)
        except ValueError:
            found[joint] = math.nan
        if not math.isfinite(found[joint]):
            raise RecordingError(f"{sheet.path}: note {key} is {shorten(text)}, expected a finite number in rad or m")
    missing = [joint for joint in joints if joint not in found]
    if found and missing:
        raise RecordingError(
            f"{sheet.path}: note '{START}{missing[0]}' is missing, though '{START}{next(iter(found))}' is there; state "
            "it for all joints or none"
        )
    return frozen_array([found[joint] for joint in joints]) if found else None


def write_commands(path: PathLike, actuators: Sequence[str], found: CommandFile, joints: Sequence[str] = ()) -> None:
    """Write commands with every bit of their numbers; the file appears whole or not at all.

    Args:
        path: of the file, which is replaced; see ``outputs`` for what must not be.
        actuators: names of the columns.
        found: what is written.
        joints: names of the positions in ``found``, where it says them.

    Raises:
        RecordingError: where it cannot be written.
    """
    notes = dict(found.different)
    notes |= {f"{BEFORE}{name}": repr(value) for name, value in zip(actuators, found.before.tolist(), strict=True)}
    if found.position is not None:
        notes |= {f"{START}{name}": repr(value) for name, value in zip(joints, found.position.tolist(), strict=True)}
    if found.linear:
        notes["interpolation"] = "linear"
    header, columns = ["time", *(f"{COMMAND}{name}" for name in actuators)], [found.times, found.values]
    if found.law is not None and found.reference is not None:
        notes |= _notes_of(found.law, actuators, joints)
        header += [f"{REFERENCE}{name}" for name in joints]
        columns.append(found.reference)
    with replacing(Path(path)) as file:
        file.writelines(f"# {key} = {text}\n" for key, text in notes.items())
        file.write(",".join(header) + "\n")
        rows = np.column_stack(columns)
        file.writelines(",".join(map(repr, row)) + "\n" for row in rows.tolist())


def _notes_of(law: FeedbackLaw, actuators: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Notes that say a law."""
    notes = {SMOOTHING: repr(law.smoothing)}
    for prefix, matrix in ((STIFFNESS, law.stiffness), (DAMPING, law.damping)):
        for actuator, row in zip(actuators, matrix.tolist(), strict=True):
            notes |= {f"{prefix}{actuator}.{j}": repr(v) for j, v in zip(joints, row, strict=True) if v != 0.0}
    return notes
