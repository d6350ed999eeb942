"""Logs of BAM's test benches (Duclusaud, Passault et al., Rhoban/bam): JSON with a list of ``entries``.

An entry has ``timestamp`` [s], ``position`` and ``goal_position`` [rad], ``speed`` [rad/s], ``torque_enable`` and more;
of two motors these stand under ``r1`` and ``r2``. What else stands in the file (mass, length, kp, …) becomes notes.
Where the torque is off no command is in force, so a log is cut into the trials during which it is on.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.presets import check_regular
from equimus_ctrl.recordings.logs import Log, Table, Wanted, reading
from equimus_ctrl.recordings.mapping import Mapping as ColumnMapping
from equimus_ctrl.recordings.mapping import Source
from equimus_ctrl.recordings.messages import columns_of

POSITION, GOAL, CLOCK, TORQUE = "position", "goal_position", "timestamp", "torque_enable"
NEEDED = f'"entries", a list of objects with "{CLOCK}"'


def is_bam(path: Path) -> bool:
    """Whether a JSON file has entries, by its text."""
    try:
        return b'"entries"' in path.read_bytes()
    except OSError:
        return False


def read_bam(path: Path) -> list[Log]:
    """The logs of a file: one for each time that the torque is on.

    Raises:
        RecordingError: where it cannot be read, lacks entries, or torque is never on.
    """
    with reading(path, "JSON file"):
        check_regular(path)
        data = json.loads(path.read_bytes())
    entries = data.get("entries") if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries or not all(isinstance(own, dict) for own in entries):
        raise RecordingError(f"{path}: has no entries, expected {NEEDED}, as BAM records them")
    for k, own in enumerate(entries):
        at = own.get(CLOCK)
        if isinstance(at, bool) or not isinstance(at, int | float):
            raise RecordingError(f"{path}: entry {k + 1} has {CLOCK} {at!r}, expected a number of seconds")
    with reading(path, "log"):  # an entry may be nested as deeply as somebody likes
        _, columns = columns_of((float(own[CLOCK]), None, own) for own in entries)
    notes = {"source": path.name}
    notes |= {f"bam.{key}": _text(value) for key, value in data.items() if isinstance(value, str | int | float)}
    parts = _powered(path, columns, len(entries))
    return [
        Log(
            path,
            path.stem if len(parts) == 1 else f"{path.stem}_{number}",
            (Table.of({key: values[first:last] for key, values in columns.items()}),),
            "a log of BAM", found, notes | {"source_rows": f"{first + 1}-{last}"}, CLOCK, "entry",
        )
        for number, (first, last) in enumerate(parts, 1)
    ]  # fmt: skip


def _text(value: Any) -> str:
    return " ".join(str(value).split())


def _powered(path: Path, columns: dict[str, NDArray[Any]], count: int) -> list[tuple[int, int]]:
    """(first, last + 1) entries of each time that the torque of all motors is on."""
    switches = [values for key, values in columns.items() if key == TORQUE or key.endswith(f".{TORQUE}")]
    if not switches:
        return [(0, count)]
    on = np.all([np.ma.filled(values, 0.0) > 0.5 for values in switches], axis=0)
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(np.int8)))
    parts = [(int(first), int(last)) for first, last in edges.reshape(-1, 2) if last - first > 1]
    if not parts:
        raise RecordingError(f"{path}: {TORQUE} is never on for two entries, so no command was in force")
    return parts


def found(log: Log, wanted: Wanted, mapping: ColumnMapping) -> dict[str, Source]:
    """Position and goal of the one motor; which is which of several a mapping says.

    Raises:
        RecordingError: where the robot has more joints, or something is missing.
    """
    table = log.tables[0]
    sources = {}
    for prefix, column, names in (("pos", POSITION, wanted.joints), ("cmd", GOAL, wanted.actuators)):
        if any(target.startswith(f"{prefix}.") for target in mapping.columns) or not names:
            continue
        if len(names) > 1 or column not in table.columns:
            raise RecordingError(
                f"{log.where}: which of {', '.join(table.columns)} is {prefix}. of {', '.join(names)} is not said; "
                f'expected a mapping with [columns], such as "{prefix}.{names[0]}" = "r1.{column}"'
            )
        sources[f"{prefix}.{names[0]}"] = Source(column)
    if prefix == "cmd" and sources and not wanted.goals[0] and f"cmd.{wanted.actuators[0]}" in sources:
        raise RecordingError(
            f"{log.where}: its commands are goals in rad, and those of {wanted.actuators[0]} are "
            f"{wanted.command_units[0]}; expected a model with a position servo"
        )
    return sources
