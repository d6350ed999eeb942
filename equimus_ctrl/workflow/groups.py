"""Groups of trials: those of each folder, such as one unit of a robot, or one day."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import DiagnoseOptions
from equimus_ctrl.recordings import Mapping
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.mjcf import read_trials_with_files

LEAST_TRIALS = 2
"""Of a group, where nobody says what is held out: one is fitted, one judges."""


def by_folder(
    recordings: Path | str | Iterable[Path | str | Recording],
    model: Model,
    mapping: Mapping | Path | str | None = None,
) -> tuple[list[Recording], dict[str, str]]:
    """The trials of files and folders, and by the name of each the folder that it is in.

    Folders go by their names, with as many of those above them as tell them apart.

    Args:
        recordings: files or folders.
        model: whose joints and actuators are wanted.
        mapping: see ``scores.gather``.

    Raises:
        RecordingError: where one cannot be read.
        ConfigError: where trials are given that are in no folder, or all are in one.
    """
    given = [recordings] if isinstance(recordings, Path | str) else list(recordings)
    files = [Path(item) for item in given if isinstance(item, Path | str)]
    if len(files) < len(given):
        raise ConfigError("trials are grouped by folder, but some were not given as files; expected files or folders")
    found = read_trials_with_files(files, model.robot, mapping)
    label = _labels([path.resolve().parent for path, _ in found])
    if len(label) < 2:
        raise ConfigError(
            f"trials are grouped by folder, but all of them are in {next(iter(label.values()))}; expected those of two "
            "folders or more"
        )
    return [trial for _, trial in found], {trial.name: label[path.resolve().parent] for path, trial in found}


def _labels(folders: Iterable[Path]) -> dict[Path, str]:
    """Short names of some folders, none twice."""
    distinct = list(dict.fromkeys(folders))
    for parts in range(1, max(len(folder.parts) for folder in distinct)):
        names = {folder: "/".join(folder.parts[-parts:]) for folder in distinct}
        if max(Counter(names.values()).values()) == 1:
            return names
    return {folder: str(folder) for folder in distinct}


def check_enough(groups: Sequence[str], options: DiagnoseOptions) -> None:
    """Raise ConfigError where a group has too few trials to fit and to judge by, or is the only one left."""
    counts = Counter(groups)
    if len(counts) == 1:
        raise ConfigError(f"all trials selected are in {next(iter(counts))}; expected some of two folders or more")
    few = [group for group, count in counts.items() if count < LEAST_TRIALS]
    if few and not (options.validation or options.until is not None):
        raise ConfigError(
            f"{few[0]} has one trial, expected at least {LEAST_TRIALS} in each folder: one is fitted, one judges; "
            "or say how much of each is fitted (until)"
        )


def check_fitted(groups: Sequence[str], train: Sequence[Segment]) -> None:
    """Raise ConfigError where all trials of a group are held out."""
    for group in dict.fromkeys(groups):
        if all(segment.group != group for segment in train):
            raise ConfigError(f"all trials of {group} are held out; expected one at least that is fitted")
