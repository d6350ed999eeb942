"""Sets of trials: reading them, naming them, describing them, and converting them to the project's format."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from collections.abc import Mapping as Table
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.errors import RecordingError, nearest
from equimus_ctrl.recordings import checks, csvfile, formats, logs, upstream
from equimus_ctrl.recordings.checks import LEG, Limits
from equimus_ctrl.recordings.logs import Wanted
from equimus_ctrl.recordings.mapping import Mapping
from equimus_ctrl.recordings.sheet import PathLike, header_of, open_sheet, reason
from equimus_ctrl.types import Array, Recording


def read_set(
    paths: PathLike | Iterable[PathLike],
    *,
    joints: Sequence[str] | None = None,
    actuators: Sequence[str] | None = None,
    limits: Limits = LEG,
    wanted: Wanted | None = logs.LEG,
    mapping: Mapping | None = None,
) -> tuple[Recording, ...]:
    """Read the trials of files and folders; see ``read_with_files``."""
    found = read_with_files(paths, joints=joints, actuators=actuators, limits=limits, wanted=wanted, mapping=mapping)
    return tuple(trial for _, trial in found)


def read_with_files(
    paths: PathLike | Iterable[PathLike],
    *,
    joints: Sequence[str] | None = None,
    actuators: Sequence[str] | None = None,
    limits: Limits = LEG,
    wanted: Wanted | None = logs.LEG,
    mapping: Mapping | None = None,
) -> tuple[tuple[Path, Recording], ...]:
    """Read the trials of files and folders, in any format that is known, each with its file.

    Files come in the order given, those of a folder sorted by name; a bag's or a dataset's folder counts as a file, and
    static poses in a folder are passed over. A name that two trials share gets the folder's name in front:
    ``open_1_trial_00``. All trials have the same joints and actuators, in the same order.

    Args:
        paths: a file, a folder, or several of them.
        joints: the joints wanted, in the order wanted; the first trial's where None.
        actuators: the actuators wanted, in the order wanted; the first trial's where None.
        limits: what may stand in a recording.
        wanted: names and units of the robot, by which columns of other formats are found; None where nobody knows.
        mapping: what the columns of other formats are; with one, CSV files are of any columns too.

    Raises:
        NotAvailable: a library that reads a format is not installed.
        ConfigError: the mapping does not fit the robot.
        RecordingError: a file cannot be read or is given twice; a folder has no recordings; a trial lacks a joint or
            actuator, or has others than the rest.
    """
    files = list_files(paths)
    found: list[tuple[Path, Recording]] = []
    for path in files:
        trials: Sequence[Recording] | None = formats.recordings_of(path, limits, wanted, mapping)
        if trials is None:
            sheet = open_sheet(path)
            if upstream.kind(sheet.header):
                trials = upstream.recordings(sheet, limits)
            else:
                trials = (csvfile.from_sheet(sheet, limits),)
        found += [(path, trial) for trial in trials]
    for path, trial in found:
        checks.warn(checks.plausibility_warnings(str(path), trial, limits))
    first_path, first = found[0]
    for path, trial in found[1:]:
        for kind, names, expected in (
            ("joints", trial.joints, first.joints),
            ("actuators", trial.actuators, first.actuators),
        ):
            if set(names) != set(expected):
                raise RecordingError(
                    f"{path}: its {kind} are {', '.join(names)}, those of {first_path} are {', '.join(expected)}; "
                    "all trials of a set have the same"
                )
    chosen = (
        tuple(first.joints if joints is None else joints),
        tuple(first.actuators if actuators is None else actuators),
    )
    arranged = tuple(
        (path, _arranged(path, trial, name, *chosen, limits.missing))
        for (path, trial), name in zip(found, _unique_names(found), strict=True)
    )
    if not limits.pressures:  # a model asks for its own; of a leg somebody picks
        checks.warn(_unused(first_path, first, *chosen))
    return arranged


def _unused(path: Path, trial: Recording, joints: Sequence[str], actuators: Sequence[str]) -> list[str]:
    """A sentence on columns that nothing asks for; none where there are none."""
    more = [f"pos.{name}" for name in trial.joints if name not in joints]
    more += [f"cmd.{name}" for name in trial.actuators if name not in actuators]
    return [f"{path}: {', '.join(more)} not used: the model has no such joint or actuator"] if more else []


def list_files(paths: PathLike | Iterable[PathLike]) -> tuple[Path, ...]:
    """The recording files that ``paths`` stand for: files as given, folders by what is in them, sorted by name.

    A bag's folder and a LeRobot dataset's stand for themselves. Of others the CSV files count, and where there are none
    the files of other formats.

    Raises:
        RecordingError: nothing is given, something is given twice or does not exist, or a folder has no recordings.
    """
    given = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    files: list[Path] = []
    for path in given:
        files += _folder_files(path) if path.is_dir() and formats.format_of(path) is None else [path]
    if not files:
        raise RecordingError("no recordings are given; at least one file or folder belongs here")
    seen: set[Path] = set()
    for path in files:
        if (resolved := path.resolve()) in seen:
            raise RecordingError(f"{path}: this file is given twice")
        seen.add(resolved)
    return tuple(files)


def _folder_files(folder: Path) -> list[Path]:
    try:
        entries = sorted(folder.iterdir(), key=lambda path: path.name)
    except OSError as error:
        raise RecordingError(f"{folder}: the folder cannot be read ({reason(error)})") from error
    tables = [path for path in entries if path.suffix.lower() == ".csv" and not path.name.startswith(".")]
    files = [path for path in tables if path.is_file()]
    trials = [path for path in files if upstream.kind(header_of(path)) != upstream.STATIC_POSES]
    if not files:
        trials = [path for path in entries if not path.name.startswith(".") and formats.format_of(path) is not None]
    if not trials:
        what = "only static poses" if files else "no recordings"
        raise RecordingError(
            f"{folder}: there are {what} in this folder; expected CSV files, one a trial, or files of other formats "
            f"({', '.join(formats.READ_SUFFIXES[1:])})"
        )
    return trials


def _unique_names(found: Sequence[tuple[Path, Recording]]) -> list[str]:
    names = [trial.name for _, trial in found]
    if len(set(names)) < len(names):
        names = [
            f"{path.resolve().parent.name}_{name}" if names.count(name) > 1 else name
            for (path, _), name in zip(found, names, strict=True)
        ]
    taken: set[str] = set()
    for index, name in enumerate(names):
        count = 2
        while names[index] in taken:
            names[index] = f"{name}_{count}"
            count += 1
        taken.add(names[index])
    return names


def _arranged(
    path: Path, trial: Recording, name: str, joints: tuple[str, ...], actuators: tuple[str, ...], hint: str = ""
) -> Recording:
    kinds = (("joint", "pos", joints, trial.joints), ("actuator", "cmd", actuators, trial.actuators))
    for kind, prefix, wanted, there in kinds:
        for item in wanted:
            if item not in there:
                column, known = f"{prefix}.{item}", [f"{prefix}.{name}" for name in there]
                raise RecordingError(
                    f"{path}: there is no column {column!r} for {kind} {item}{nearest(item, there)} (there: "
                    f"{', '.join(known) or 'none'})" + (f"; {hint}" if hint else "")
                )
    if (name, joints, actuators) == (trial.name, trial.joints, trial.actuators):
        return trial
    j = [trial.joints.index(joint) for joint in joints]
    a = [trial.actuators.index(actuator) for actuator in actuators]
    return Recording(
        name=name,
        time=trial.time,
        command=trial.command[:, a],
        position=trial.position[:, j],
        actuators=actuators,
        joints=joints,
        velocity=None if trial.velocity is None else trial.velocity[:, j],
        measured=None if trial.measured is None else trial.measured[:, a],
        before=None if trial.before is None else trial.before[a],
        notes=trial.notes,
        sites=trial.sites,
    )


@dataclass(frozen=True)
class Summary:
    """What one trial holds, in SI units.

    Attributes:
        name: the trial's name.
        rows: number of samples.
        duration_s: from the first to the last sample [s].
        rate_hz: one over the median time between samples [Hz].
        jitter_s: standard deviation of the time between samples [s].
        interval_s: shortest and longest time between samples [s].
        command_pa: lowest and highest command of each actuator [Pa].
        position_rad: lowest and highest angle of each joint [rad].
        before_pa: command in force before the first row [Pa], None where the recording does not say.
        notes: what the file says of itself.
    """

    name: str
    rows: int
    duration_s: float
    rate_hz: float
    jitter_s: float
    interval_s: tuple[float, float]
    command_pa: Table[str, tuple[float, float]]
    position_rad: Table[str, tuple[float, float]]
    before_pa: Table[str, float] | None
    notes: Table[str, str]

    def as_json(self) -> dict[str, Any]:
        """The same as a dictionary that ``json`` takes."""
        return asdict(self)


def summarise(recording: Recording) -> Summary:
    """Duration, rate, jitter and ranges of one trial."""
    steps = np.diff(recording.time)

    def ranges(names: Sequence[str], values: Array) -> dict[str, tuple[float, float]]:
        low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        return dict(zip(names, zip(low, high, strict=True), strict=True))

    return Summary(
        name=recording.name,
        rows=len(recording.time),
        duration_s=float(recording.time[-1] - recording.time[0]),
        rate_hz=1.0 / float(np.median(steps)),
        jitter_s=float(steps.std()),
        interval_s=(float(steps.min()), float(steps.max())),
        command_pa=ranges(recording.actuators, recording.command),
        position_rad=ranges(recording.joints, recording.position),
        before_pa=None
        if recording.before is None
        else dict(zip(recording.actuators, recording.before.tolist(), strict=True)),
        notes=dict(recording.notes),
    )


def convert(
    sources: PathLike | Iterable[PathLike], output: PathLike, *, force: bool = False, limits: Limits = LEG
) -> tuple[Path, ...]:
    """Write each trial of ``sources`` to ``output/<trial>.csv`` in the project's format: all of them or none.

    Args:
        sources: files or folders, in any format ``read_set`` takes.
        output: folder to write into; made where it does not exist.
        force: replace files that are there already.
        limits: what may stand in a recording.

    Returns:
        The files written.

    Raises:
        RecordingError: a source is wrong, a file is there already, or the folder cannot be written.
    """
    return write_set(read_set(sources, limits=limits), output, force=force)


def write_set(recordings: Sequence[Recording], output: PathLike, *, force: bool = False) -> tuple[Path, ...]:
    """Write each trial to ``output/<trial>.csv`` in the project's format: all of them or none.

    Args:
        recordings: the trials, each with a name of its own.
        output: folder to write into; made where it does not exist.
        force: replace files that are there already.

    Returns:
        The files written.

    Raises:
        RecordingError: a file is there already, or the folder cannot be written.
    """
    output = Path(output)
    targets = [output / f"{recording.name}.csv" for recording in recordings]
    taken = [target for target in targets if target.exists()]
    if taken and not force:
        raise RecordingError(f"{taken[0]}: this file is there already; name another folder, or --force to replace it")
    made = not output.exists()
    try:
        output.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=".import-", dir=output))
    except OSError as error:
        raise RecordingError(f"{output}: recordings cannot be written there ({reason(error)})") from error
    try:
        for recording, target in zip(recordings, targets, strict=True):
            csvfile.write(scratch / target.name, recording)
        _move_all(scratch, targets)
    except OSError as error:
        raise RecordingError(f"{output}: recordings cannot be written there ({reason(error)})") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if made and not any(output.iterdir()):
            output.rmdir()
    return tuple(targets)


def _move_all(scratch: Path, targets: Sequence[Path]) -> None:
    """Move the files of ``scratch`` to ``targets``; where one fails, put back what was there."""
    kept = scratch / "replaced"
    kept.mkdir()
    moved: list[Path] = []
    try:
        for target in targets:
            if target.exists():
                os.replace(target, kept / target.name)
            moved.append(target)
            os.replace(scratch / target.name, target)
    except BaseException:
        for target in moved:
            target.unlink(missing_ok=True)
            if (kept / target.name).exists():
                os.replace(kept / target.name, target)
        raise
