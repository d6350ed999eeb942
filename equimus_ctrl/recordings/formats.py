"""The formats of recordings: one registry, by what a file is called and what is in it.

A reader is one function from a path to logs; what their columns are, ``mapping`` says for all formats alike. The
project's own CSV format and those of the leg are read by ``sets``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from equimus_ctrl.errors import RecordingError, unknown_name
from equimus_ctrl.recordings import arrays, bags, bam, csvfile, mcapfile, parquet, rerunfile
from equimus_ctrl.recordings.assemble import recording_of
from equimus_ctrl.recordings.checks import Limits
from equimus_ctrl.recordings.exported import Exported
from equimus_ctrl.recordings.logs import Log, Wanted
from equimus_ctrl.recordings.mapping import Mapping as ColumnMapping
from equimus_ctrl.recordings.sheet import PathLike
from equimus_ctrl.recordings.tables import read_sheet
from equimus_ctrl.types import Recording


@dataclass(frozen=True)
class Format:
    """A format that is read.

    Attributes:
        name: for people.
        fits: whether a path is one, by its name and content.
        read: gives its logs, one a trial.
    """

    name: str
    fits: Callable[[Path], bool]
    read: Callable[[Path], list[Log]]


def _suffix(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: not path.is_dir() and path.suffix.lower() in suffixes


FORMATS = (
    Format("LeRobot dataset", lambda path: path.is_dir() and parquet.is_lerobot(path), parquet.read_lerobot),
    Format("rosbag2 bag", bags.is_bag, bags.read_bag),
    Format("MCAP", _suffix(".mcap"), mcapfile.read_mcap),
    Format("npz", _suffix(".npz"), arrays.read_npz),
    Format("PACE", _suffix(".pt", ".pth"), arrays.read_torch),
    Format("parquet", _suffix(".parquet"), parquet.read_parquet),
    Format("BAM", lambda path: _suffix(".json")(path) and bam.is_bam(path), bam.read_bam),
)
"""The first that fits a path reads it."""
READ_SUFFIXES = (".csv", ".mcap", ".db3", ".npz", ".pt", ".pth", ".parquet", ".json")


def format_of(path: Path) -> Format | None:
    """The format of a file or folder; None of a CSV file, a folder of files, or what nobody knows."""
    return next((own for own in FORMATS if own.fits(path)), None)


def read_logs(path: Path, mapped: bool = False) -> list[Log] | None:
    """The logs of a file; None of one in the project's own format or the leg's, unless it is mapped.

    Raises:
        NotAvailable: where the library that reads it is not installed.
        RecordingError: where it cannot be read.
    """
    own = format_of(path)
    if own is not None:
        return own.read(path)
    if path.suffix.lower() == ".json":
        raise RecordingError(f"{path}: is no recording that is known; expected {bam.NEEDED} in it, as BAM records")
    return [read_sheet(path)] if mapped else None


def recordings_of(
    path: Path, limits: Limits, wanted: Wanted | None = None, mapping: ColumnMapping | None = None
) -> list[Recording] | None:
    """The trials of a file of any format but the project's own and the leg's, see ``read_logs``.

    Raises:
        NotAvailable, RecordingError, ConfigError: see ``assemble.recording_of``.
    """
    logs = read_logs(path, mapping is not None)
    return None if logs is None else [recording_of(log, limits, wanted, mapping) for log in logs]


def _write_csv(path: Path, trial: Exported) -> None:
    csvfile.write(path, trial.recording)


def _write_npz(path: Path, trial: Exported) -> None:
    arrays.write_npz(path, dict(csvfile.columns(trial.recording)), csvfile.notes_of(trial.recording))


def _write_parquet(path: Path, trial: Exported) -> None:
    parquet.write_parquet(path, dict(csvfile.columns(trial.recording)), csvfile.notes_of(trial.recording))


def _write_mcap(path: Path, trial: Exported) -> None:
    mcapfile.write_mcap(path, [trial], [csvfile.notes_of(trial.recording)])


def _write_rerun(path: Path, trial: Exported) -> None:
    rerunfile.write_rerun(path, [trial])


WRITERS: Mapping[str, Callable[[Path, Exported], None]] = {
    ".csv": _write_csv,
    ".mcap": _write_mcap,
    ".npz": _write_npz,
    ".parquet": _write_parquet,
    ".rrd": _write_rerun,
}
"""Suffix → what writes a trial into such a file."""


def write_recording(path: PathLike, recording: Recording, units: Mapping[str, str] | None = None) -> None:
    """Write a trial in the format that the name ends in: ``.csv``, ``.npz``, ``.parquet``, ``.mcap`` or ``.rrd``.

    All but the last are read back with every bit. A file that is there is replaced.

    Args:
        path: of the file.
        recording: the trial.
        units: column → SI unit, for those who look at it.

    Raises:
        NotAvailable: where the library of the format is not installed.
        RecordingError: where the recording is none that could be read back, or the format is not known.
        ConfigError: where the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise RecordingError(f"{path}: " + unknown_name("format", suffix, WRITERS))
    csvfile.check_writable(path, recording)
    WRITERS[suffix](path, Exported(recording, units=units or {}))
