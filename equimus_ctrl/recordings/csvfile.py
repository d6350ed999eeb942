"""The project's recording format: one CSV a trial.

Header ``time,cmd.<actuator>…,pos.<joint>…`` with optional ``vel.<joint>`` (all joints or none; ``Limits.given`` apart),
``meas.<actuator>`` (of a leg all actuators or none) and ``site.<site>.x``, ``.y``, ``.z`` (any), the columns in any
order, SI units, times strictly ascending. A command holds from its row until the next, or goes along a line to it (note
``interpolation = linear``). Lines starting with ``#`` before the header carry ``key = value`` notes;
``before.cmd.<actuator> = value`` (all actuators or none) states the command in force before the first row. Blank lines
are passed over. Text is UTF-8.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from equimus_ctrl.errors import RecordingError, nearest, unknown_name
from equimus_ctrl.recordings import checks, upstream
from equimus_ctrl.recordings.checks import LEG, Limits, after_gap, gap_problem
from equimus_ctrl.recordings.sheet import PathLike, Tabular, open_sheet, reason, shorten
from equimus_ctrl.types import Array, Recording

PREFIXES = {"cmd": "actuator", "pos": "joint", "vel": "joint", "meas": "actuator"}
SITE = "site."
AXES = ("x", "y", "z")
BEFORE = "before.cmd."
COMMENT = "comment"
CHOICES = {"settled": ("yes", "no"), "interpolation": ("hold", "linear")}
"""Notes that take one of a few words."""


def read(path: PathLike, *, limits: Limits = LEG) -> Recording:
    """Read one trial; its name is the file's stem.

    Warns with a RecordingWarning where commands look like kPa, or a hinge's angles like degrees.

    Args:
        path: a CSV file in the project's format.
        limits: what may stand in it: range of the commands [Pa], largest angle [rad], largest interval [s].

    Raises:
        RecordingError: one sentence with the file, the row (1-based line number), the column, the value found and what
            would have been right.
    """
    sheet = open_sheet(path)
    if kind := upstream.kind(sheet.header):
        raise sheet.header_error(
            f"these are the columns of the leg's {kind} format; `equimus-ctrl recordings import` converts it"
        )
    recording = from_sheet(sheet, limits)
    checks.warn(checks.plausibility_warnings(recording.name, recording, limits))
    return recording


def from_sheet(sheet: Tabular, limits: Limits) -> Recording:
    """The trial in ``sheet``, checked."""
    groups = _columns(sheet, limits)
    joints, actuators = groups["pos"], groups["cmd"]
    names = {prefix: [f"{prefix}.{name}" for name in _order(prefix, groups)] for prefix in PREFIXES if groups[prefix]}
    unmeasured = {name for prefix in ("vel", "meas") for name in names.get(prefix, ()) if name not in sheet.header}
    notes, before = stated_notes(sheet, actuators, limits)
    seen = [column for column in sheet.header if column.startswith(SITE)]
    whole = ["time", *(column for group in names.values() for column in group), *seen]
    columns = [column for column in whole if column not in unmeasured]
    values = sheet.numbers(columns)

    def block(prefix: str) -> Array | None:
        """With nan where nothing is measured."""
        if prefix not in names:
            return None
        found = np.full((len(values), len(names[prefix])), np.nan)
        there = [k for k, name in enumerate(names[prefix]) if name not in unmeasured]
        found[:, there] = values[:, [columns.index(names[prefix][k]) for k in there]]
        return found

    time, command, position = values[:, 0], block("cmd"), block("pos")
    assert position is not None  # _columns refuses a header without them
    command = np.empty((len(time), 0)) if command is None else command
    checks.check_time(sheet, "time", time, limits)
    checks.check_commands(sheet, names.get("cmd", ()), command, limits)
    checks.check_angles(sheet, joints, names["pos"], position, limits)
    checks.check_sizes(sheet, columns[1:], values[:, 1:])
    return Recording(
        name=sheet.name,
        time=time,
        command=command,
        position=position,
        actuators=actuators,
        joints=joints,
        velocity=block("vel"),
        measured=block("meas"),
        before=before,
        notes=notes,
        sites={column.removeprefix(SITE): values[:, columns.index(column)] for column in seen},
    )


def _sensed(recording: Recording) -> Array | None:
    """Columns of what was measured at actuators that have a sensor."""
    return None if recording.measured is None else recording.measured[:, list(recording.force_columns)]


def _order(prefix: str, groups: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Names in the order of the commands or positions, whatever the order in the file."""
    return groups["cmd" if PREFIXES[prefix] == "actuator" else "pos"]


def _columns(sheet: Tabular, limits: Limits) -> dict[str, tuple[str, ...]]:
    """Actuator and joint names by prefix, from a header that has all it needs."""
    found: dict[str, list[str]] = {prefix: [] for prefix in PREFIXES}
    for column in sheet.header:
        prefix, dot, name = column.partition(".")
        if prefix in PREFIXES and dot and name:
            found[prefix].append(name)
        elif column != "time" and not is_site(column):
            raise sheet.header_error(_unknown_column(column))
    if "time" not in sheet.header:
        raise sheet.header_error("column 'time' is missing; sample times in seconds belong in it")
    quantities = (
        ("commanded pressures in Pa", "joint angles in rad") if limits.pressures else ("commands", "joints' positions")
    )
    for prefix, what in zip(("cmd", "pos"), quantities, strict=True):
        passive = prefix == "cmd" and not limits.actuators and not limits.pressures
        if not found[prefix] and not passive:
            raise sheet.header_error(
                f"there is no column '{prefix}.<{PREFIXES[prefix]}>'; {what} belong in such columns"
            )
    for prefix, together in (("cmd", limits.actuators), ("pos", limits.joints)):
        _demand_all(sheet, prefix, found[prefix], together, limits.missing)
    for prefix, base in (("vel", "pos"), ("meas", "cmd")):
        for name in found[prefix]:
            if name not in found[base]:
                raise sheet.header_error(
                    f"column '{prefix}.{name}': " + unknown_name(PREFIXES[prefix], name, found[base])
                )
        # A single drive may have a sensor of its force; what presses in actuators is measured in all of them.
        if found[prefix] and (prefix != "meas" or limits.pressures):
            _demand_all(sheet, prefix, found[prefix], [name for name in found[base] if name not in limits.given], "")
    return {prefix: tuple(names) for prefix, names in found.items()}


def is_site(column: str) -> bool:
    """Whether a column is a coordinate of a site."""
    name, _, axis = column.removeprefix(SITE).rpartition(".")
    return column.startswith(SITE) and bool(name) and axis in AXES


def _demand_all(sheet: Tabular, prefix: str, found: Sequence[str], together: Sequence[str], hint: str) -> None:
    missing = [name for name in together if name not in found]
    if missing and len(missing) < len(together):
        present = next(name for name in together if name in found)
        raise sheet.header_error(
            f"column '{prefix}.{missing[0]}' is missing, though '{prefix}.{present}' is there; "
            f"{' and '.join(together)} belong together" + (f"; {hint}" if hint else "")
        )


def _unknown_column(column: str) -> str:
    last = column.replace("_", ".").replace(" ", ".").split(".")[-1]
    candidates = ["time", *(f"{prefix}.{last}" for prefix in PREFIXES)]
    known = "time, cmd.<actuator>, pos.<joint>, vel.<joint>, meas.<actuator>, site.<site>.x"
    return f"there is no column {shorten(column)}{nearest(column.lower(), candidates)} (known: {known})"


def stated_notes(sheet: Tabular, actuators: tuple[str, ...], limits: Limits) -> tuple[dict[str, str], Array | None]:
    """The notes without those that state ``before``, and ``before`` (n_actuators,) [Pa] where it is stated."""
    notes: dict[str, str] = {}
    before: dict[str, float] = {}
    for line, text in sheet.notes:
        place = f"{sheet.path}, row {line}"
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not key or key == COMMENT:
            words = value if key == COMMENT else text
            notes[COMMENT] = f"{notes[COMMENT]} {words}" if COMMENT in notes else words
            continue
        if key in notes or (key.startswith(BEFORE) and key.removeprefix(BEFORE) in before):
            raise RecordingError(f"{place}: note {shorten(key)} is there more than once")
        if key.startswith("before"):
            actuator = key.removeprefix(BEFORE)
            if not key.startswith(BEFORE) or actuator not in actuators:
                raise RecordingError(unknown_name("note", key, [BEFORE + name for name in actuators], where=place))
            before[actuator] = _before_value(place, key, value, limits)
        elif key in CHOICES and value not in CHOICES[key]:
            raise RecordingError(f"{place}: note '{key}' is {shorten(value)}, expected {' or '.join(CHOICES[key])}")
        else:
            notes[key] = value
    if not before:
        return notes, None
    for actuator in actuators:
        if actuator not in before:
            raise RecordingError(
                f"{sheet.path}: note '{BEFORE}{actuator}' is missing, though '{BEFORE}{next(iter(before))}' is there; "
                "state it for all actuators or none"
            )
    return notes, np.array([before[actuator] for actuator in actuators])


def _before_value(place: str, key: str, value: str, limits: Limits) -> float:
    try:
        pressure = float(value)
    except ValueError:
        pressure = math.nan
    if not math.isfinite(pressure):
        raise RecordingError(
            f"{place}, note {key}: {shorten(value)} is not a finite number; a "
            f"{'pressure in Pa' if limits.pressures else 'command'} belongs there"
        )
    if problem := checks.command_problem(pressure, limits):
        raise RecordingError(f"{place}, note {key}: {problem}")
    return pressure


def write(path: PathLike, recording: Recording) -> None:
    """Write one trial with every bit of its numbers; the file appears whole or not at all.

    The folder must exist. The trial's name is not written: it is the file's stem.

    Raises:
        RecordingError: the recording is not one ``read`` could take (a number that is not finite, times that do not
            ascend, fewer than two rows, no joint or actuator, a name or note the format cannot hold), or the file
            cannot be written.
    """
    path = Path(path)
    check_writable(path, recording)
    header, blocks = zip(*columns(recording), strict=True)
    values = np.column_stack(blocks)
    with replacing(path) as file:
        for key, value in notes_of(recording).items():
            file.write(f"# {key} = {value}\n")
        file.write(",".join(header) + "\n")
        file.writelines(",".join(map(repr, row)) + "\n" for row in values.tolist())


def columns(recording: Recording) -> Iterator[tuple[str, Array]]:
    """(name, (n,) values) of the columns of a recording's file; none of what no sensor gives."""
    yield "time", recording.time
    for prefix, names, block in (
        ("cmd", recording.actuators, recording.command),
        ("pos", recording.joints, recording.position),
        ("vel", recording.joints, recording.velocity),
        ("meas", [recording.actuators[i] for i in recording.force_columns], _sensed(recording)),
    ):
        if block is not None:
            for k, name in enumerate(names):
                if prefix != "vel" or not np.isnan(block[:, k]).all():
                    yield f"{prefix}.{name}", block[:, k]
    yield from recording.inputs.items()
    yield from ((f"{SITE}{name}", values) for name, values in recording.sites.items())


def notes_of(recording: Recording) -> dict[str, str]:
    """The notes of a recording's file, with those that state the command before the first row."""
    before = () if recording.before is None else recording.before.tolist()
    stated = zip(recording.actuators, before, strict=True) if before else ()
    return {**recording.notes, **{f"{BEFORE}{name}": repr(value) for name, value in stated}}


def check_writable(path: Path, recording: Recording) -> None:
    """Nothing where a recording is one that could be read back.

    Raises:
        RecordingError: where it is not, see ``write``.
    """
    if len(recording.time) < 2:
        raise RecordingError(f"{path}: the recording has {len(recording.time)} row(s); at least two are needed")
    steps = np.diff(recording.time)
    if not (steps > 0.0).all() and np.isfinite(recording.time).all():
        row = int(np.argmin(steps > 0.0)) + 1
        raise RecordingError(
            f"{path}: time {float(recording.time[row])!r} s of sample {row} does not come after "
            f"{float(recording.time[row - 1])!r} s; times must ascend"
        )
    if np.isfinite(recording.time).all() and (gap := after_gap(recording.time)) is not None:
        raise RecordingError(f"{path}: {gap_problem(recording.time, gap)}")
    for kind, names in (("actuator", recording.actuators), ("joint", recording.joints)):
        if not names:
            raise RecordingError(f"{path}: the recording has no {kind}; at least one is needed")
        if len(set(names)) < len(names):
            raise RecordingError(f"{path}: the {kind} names {', '.join(names)} are not all different")
        for name in names:
            _check_text(path, f"{kind} name", name, forbidden=",=")
    for column, values in columns(recording):
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise RecordingError(f"{path}: sample {row} of {column} is {values[row]}; only finite numbers are written")
    if recording.before is not None and not np.isfinite(recording.before).all():
        raise RecordingError(f"{path}: the command before the first row is {recording.before}; it must be finite")
    for name in recording.sites:
        if not is_site(f"{SITE}{name}"):
            raise RecordingError(f"{path}: site {name!r} cannot be written; expected a site and an axis, such as tip.x")
        _check_text(path, "site", name, forbidden=",=")
    for key, value in recording.notes.items():
        _check_text(path, "note", key, forbidden="=")
        if key.startswith("before"):
            raise RecordingError(f"{path}: note {key!r} cannot be written; names that start with 'before' are reserved")
        if key in CHOICES and value not in CHOICES[key]:
            raise RecordingError(f"{path}: note '{key}' is {shorten(value)}, expected {' or '.join(CHOICES[key])}")
        if value:
            _check_text(path, f"text of note {key!r}", value)


def _check_text(path: Path, what: str, text: str, forbidden: Iterable[str] = ()) -> None:
    unusable = [c for c in text if c in forbidden or not (c.isprintable() or c == "\t")]
    if not text or text != text.strip() or unusable:
        why = f"it holds {unusable[0]!r}" if unusable else "it is empty or has blanks at an end"
        raise RecordingError(f"{path}: {what} {text!r} cannot be written; {why}")


@contextmanager
def replacing(path: Path) -> Iterator[TextIO]:
    """A text file that becomes ``path`` when the block ends well, and leaves no trace when it does not."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "w", encoding="utf-8", newline="\n") as file:
            yield file
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise RecordingError(f"{path}: the file cannot be written ({reason(error)})") from error
        raise
