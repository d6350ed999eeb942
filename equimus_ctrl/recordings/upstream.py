"""The formats in which the EquiMus leg was recorded: step release, triangle, and static poses.

All three have degrees for angles; the first two have Pa, the static poses kPa, for pressures. θ1 (hip) is
``thigh_theta21``, θ2 (knee) is ``calf_theta32``. Further columns are ignored, and a file is recognised by its columns,
whatever its name.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings import checks
from equimus_ctrl.recordings.checks import LEG, Limits
from equimus_ctrl.recordings.sheet import PathLike, Sheet, number, open_sheet
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Recording, frozen_array

JOINTS = ("hip", "knee")
ACTUATORS = ("maa", "baa")
STEP_RELEASE, TRIANGLE, STATIC_POSES = "step_release", "triangle", "static_poses"
SEGMENT = 2.0
"""How long one segment of the triangle lasts [s]."""

_TIME = "relative_time"
_ANGLES = ("thigh_theta21", "calf_theta32")
_STARTS = ("pressure1_start", "pressure2_start")
_ENDS = ("pressure1_end", "pressure2_end")
_CURRENT = ("current_pressure1", "current_pressure2")
_STATIC = ("P1 (kPa)", "P2 (kPa)", "theta1 (deg)", "theta2 (deg)")
_SETTLED = 5.0  # deg; see step_release
_RESTART = 0.1  # s


@dataclass(frozen=True, eq=False, repr=False)
class StaticPoses(Short):
    """Joint angles at which the leg came to rest under constant pressures.

    Attributes:
        name: the file's stem.
        pressure: (n, 2) commanded pressures [Pa].
        position: (n, 2) resting joint angles [rad].
        actuators: names of the columns of ``pressure``.
        joints: names of the columns of ``position``.
    """

    name: str
    pressure: Array
    position: Array
    actuators: tuple[str, ...] = ACTUATORS
    joints: tuple[str, ...] = JOINTS

    def __post_init__(self) -> None:
        object.__setattr__(self, "pressure", frozen_array(self.pressure, 2, f"{self.name}: pressure"))
        object.__setattr__(self, "position", frozen_array(self.position, 2, f"{self.name}: position"))


def kind(header: Sequence[str]) -> str | None:
    """Which upstream format a header belongs to: ``step_release``, ``triangle``, ``static_poses`` or None.

    A file with ``relative_time`` is a step release where it also logs ``current_pressure1`` or ``current_pressure2``,
    and a triangle otherwise.
    """
    if _TIME in header:
        return STEP_RELEASE if any(column in header for column in _CURRENT) else TRIANGLE
    return STATIC_POSES if any(column in header for column in _STATIC) else None


def step_release(sheet: Sheet, limits: Limits = LEG) -> tuple[Recording, ...]:
    """One trial a group: start pressures from ``relative_time`` 0, zero pressure from about 5 s, the end at 10 s.

    The command is ``current_pressure1/2``, row by row. A trial is named after the start pressures in kPa, such as
    ``step_release_p30_20``; a repetition gets ``_2``. ``before`` is zero pressure.

    The public file has 27 of the 36 groups on the 10 kPa grid, each once and in one piece, 587 to 595 rows at 16.4 to
    20.1 ms. The command drops to zero in the first row after 5 s (5.0003 to 5.0166 s); the leg follows about 0.07 to
    0.17 s later. Every record starts near the pose at which the one before it ended (median 0.1°, at worst 1.4°), and
    within 3.0° of where it ends itself; how long the pause was is not recorded. The first group, (0, 0), is the
    exception: it starts 10° away from rest, and moving. ``before`` is missing there, and a note ``settled = no`` put
    in. The rule is a start more than 5° from the end.

    Raises:
        RecordingError: a column is missing; a number is wrong; times go back within a group.
    """
    _demand(sheet, (_TIME, *_STARTS, *_CURRENT, *_ANGLES), STEP_RELEASE)
    values = sheet.numbers((_TIME, *_STARTS, *_CURRENT, *_ANGLES))
    time, start, command, degrees = values[:, 0], values[:, 1:3], values[:, 3:5], values[:, 5:7]
    checks.check_commands(sheet, _STARTS, start, limits)
    checks.check_commands(sheet, _CURRENT, command, limits)
    checks.check_degrees(sheet, _ANGLES, degrees)
    pieces = _pieces(sheet, time, start, _STARTS)
    checks.check_interval(sheet, _TIME, np.diff(time), limits)
    trials: list[Recording] = []
    seen: dict[str, int] = {}
    for first, last in pieces:
        name = "step_release_p" + "_".join(f"{p / 1e3:.6g}".replace(".", "d") for p in start[first].tolist())
        seen[name] = seen.get(name, 0) + 1
        settled = bool((np.abs(degrees[first] - degrees[last - 1]) <= _SETTLED).all())
        trials.append(
            Recording(
                name=name if seen[name] == 1 else f"{name}_{seen[name]}",
                time=time[first:last],
                command=command[first:last],
                position=np.radians(degrees[first:last]),
                actuators=ACTUATORS,
                joints=JOINTS,
                before=np.zeros(2) if settled else None,
                notes=_provenance(sheet, first, last) | ({} if settled else {"settled": "no"}),
            )
        )
    return tuple(trials)


def triangle(sheet: Sheet, limits: Limits = LEG) -> tuple[Recording, ...]:
    """One trial named ``triangle``: segments of 2 s, in each of which ``pressure*_end`` is commanded.

    ``relative_time`` restarts in each segment; the clock is rebuilt as 2 s times the segments gone by plus
    ``relative_time``. A command is in force from the first row of its segment, as recordings can change commands at
    rows only; the leg was given it at ``relative_time`` 0, up to 17 ms earlier.

    The public file has 20 segments (40 s) of 189 to 191 rows. Pressures change exactly where ``relative_time``
    restarts, at 16.4 to 17.1 ms; segments end at 1.989 to 1.9995 s, so that the clock has a gap of 16 to 28 ms at each
    restart where rows are else 10.0 to 11.5 ms apart. No time repeats. 537 of 3804 rows repeat all columns of the row
    before: the log ran ahead of the motion capture there.

    ``before`` is zero pressure: ``pressure*_start`` of the first segment, (6154, 2728) Pa, cannot have been in force,
    as the leg starts at (73.9°, 62.5°), beside its rest at zero pressure (73.1°, 61.4°), and ends the segments that
    command those pressures at about (80°, 56°). ``pressure*_start`` is used where the first pose is within 2° of
    the mean end of such segments.

    Raises:
        RecordingError: a column is missing; a number is wrong; times go back within a segment, or a segment is longer
            than 2 s.
    """
    _demand(sheet, (_TIME, *_ENDS, *_ANGLES), TRIANGLE)
    starts = _STARTS if all(column in sheet.header for column in _STARTS) else ()
    values = sheet.numbers((_TIME, *_ENDS, *_ANGLES, *starts))
    time, command, degrees, start = values[:, 0], values[:, 1:3], values[:, 3:5], values[:, 5:]
    checks.check_commands(sheet, _ENDS, command, limits)
    checks.check_commands(sheet, starts, start, limits)
    checks.check_degrees(sheet, _ANGLES, degrees)
    pieces = _pieces(sheet, time, np.hstack([command, start]), (*_ENDS, *starts))
    clock = time.copy()
    for segment, (first, last) in enumerate(pieces):
        if time[last - 1] >= SEGMENT:
            raise sheet.error(
                last - 1, _TIME, f"{number(time[last - 1])} s is not below the {number(SEGMENT)} s a segment lasts"
            )
        clock[first:last] += segment * SEGMENT
    checks.check_interval(sheet, _TIME, np.diff(clock), limits)
    before = np.zeros(2)
    if starts:
        ends = [degrees[last - 1] for first, last in pieces if np.allclose(command[first], start[0], atol=1.0)]
        if ends and (np.abs(np.mean(ends, axis=0) - degrees[0]) <= 2.0).all():
            before = start[0]
    recording = Recording(
        name=TRIANGLE,
        time=clock,
        command=command,
        position=np.radians(degrees),
        actuators=ACTUATORS,
        joints=JOINTS,
        before=before,
        notes=_provenance(sheet, 0, len(time)),
    )
    return (recording,)


def read_static_poses(path: PathLike, *, limits: Limits = LEG) -> StaticPoses:
    """Read ``P1 (kPa),P2 (kPa),theta1 (deg),theta2 (deg)``: pressures against the pose at rest.

    Args:
        path: of the file.
        limits: what may stand in it.

    Raises:
        RecordingError: a column is missing; a number is wrong; a pressure is outside the range; angles look like
            radians.
    """
    sheet = open_sheet(path)
    _demand(sheet, _STATIC, STATIC_POSES)
    values = sheet.numbers(_STATIC)
    checks.check_commands(sheet, _STATIC[:2], values[:, :2], limits, unit=1e3)
    checks.check_degrees(sheet, _STATIC[2:], values[:, 2:])
    return StaticPoses(sheet.path.stem, values[:, :2] * 1e3, np.radians(values[:, 2:]))


def _demand(sheet: Sheet, columns: Sequence[str], what: str) -> None:
    for column in columns:
        if column not in sheet.header:
            raise sheet.header_error(f"column {column!r} is missing; the leg's {what} format has {', '.join(columns)}")


def _pieces(sheet: Sheet, time: Array, key: Array, columns: Sequence[str]) -> list[tuple[int, int]]:
    """(first, last + 1) rows of each piece: ``time`` (n,) ascends within it, ``key`` (n, k) changes only between."""
    steps = np.diff(time)
    back: NDArray[np.bool_] = np.r_[False, steps <= 0.0]
    # A single time that is too small is a wrong number, not a restart: the row after it goes on from the row before.
    stays = np.r_[False, np.r_[time[2:], 0.0] < time[:-1]]
    restart = np.r_[False, steps < -1.0] & (time >= 0.0) & (time < _RESTART) & stays
    changed: NDArray[np.bool_] = np.r_[False, (np.diff(key, axis=0) != 0.0).any(axis=1)]
    wrong = np.flatnonzero((back & ~restart) | (changed & ~restart))
    if wrong.size:
        row = int(wrong[0])
        line = sheet.line_numbers[row - 1]
        if back[row]:
            raise sheet.error(
                row,
                _TIME,
                f"{float(time[row])!r} s does not come after the {float(time[row - 1])!r} s of row {line}; times must "
                f"ascend, or restart below {number(_RESTART)} s",
            )
        k = int(np.argmax(key[row] != key[row - 1]))
        raise sheet.error(
            row,
            columns[k],
            f"{number(key[row, k])} Pa differs from the {number(key[row - 1, k])} Pa of row {line}, though "
            f"{_TIME} does not restart",
        )
    bounds = [0, *(int(row) for row in np.flatnonzero(restart)), len(time)]
    for first, last in itertools.pairwise(bounds):
        if last - first < 2:
            raise sheet.error(first, _TIME, "this row stands alone between two restarts; at least two belong together")
    return list(itertools.pairwise(bounds))


def _provenance(sheet: Sheet, first: int, last: int) -> dict[str, str]:
    rows = f"{sheet.line_numbers[first]}-{sheet.line_numbers[last - 1]}"
    return {"source": sheet.path.name, "source_rows": rows}


def recordings(sheet: Sheet, limits: Limits = LEG) -> tuple[Recording, ...]:
    """The trials in a sheet of the step-release or triangle format.

    Raises:
        RecordingError: the sheet has neither format, or something in it is wrong.
    """
    match kind(sheet.header):
        case "step_release":
            return step_release(sheet, limits)
        case "triangle":
            return triangle(sheet, limits)
        case "static_poses":
            raise RecordingError(f"{sheet.path}: these are static poses, not a recording over time")
        case _:
            raise sheet.header_error("this is none of the leg's upstream formats")
