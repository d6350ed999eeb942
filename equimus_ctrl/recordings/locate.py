"""Where the recordings are."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from equimus_ctrl.errors import RecordingError, unknown_name
from equimus_ctrl.recordings import upstream
from equimus_ctrl.recordings.sheet import header_of

VARIABLE = "EQUIMUS_RECORDINGS"
LegFile = Literal["step_release", "triangle", "static_poses_36", "static_poses_13"]
_LEG_FILES = ("step_release", "triangle", "static_poses_36", "static_poses_13")


def fetch_folder() -> Path:
    """Where ``equimus-ctrl recordings fetch`` puts the files unless another folder is given."""
    import platformdirs

    return Path(platformdirs.user_data_path("equimus_ctrl", appauthor=False)) / "recordings"


def find_recordings(explicit: Path | None = None) -> Path | None:
    """The folder of recordings, or None where there is none.

    In this order: ``explicit``; the environment variable EQUIMUS_RECORDINGS; ``../shared/recordings`` beside the
    working directory or the checkout this package runs from; the folder ``fetch`` writes to.

    Raises:
        RecordingError: ``explicit`` or EQUIMUS_RECORDINGS names something that is not a folder.
    """
    return next(iter(_folders(explicit)), None)


def _folders(explicit: Path | None) -> list[Path]:
    named = ((explicit, "--recordings"), (os.environ.get(VARIABLE), VARIABLE))
    for value, origin in named:
        if value:
            folder = Path(value).expanduser()
            if not folder.is_dir():
                problem = "is not a folder" if folder.exists() else "does not exist"
                raise RecordingError(f"{origin}: {folder} {problem}; a folder of recordings belongs there")
            return [folder]
    beside: list[Callable[[], Path]] = [Path.cwd, lambda: Path(__file__).resolve().parents[2]]
    places = [place().parent / "shared" / "recordings" for place in beside] + [fetch_folder()]
    return [folder for folder in dict.fromkeys(places) if folder.is_dir() and any(folder.iterdir())]


def leg_file(kind: LegFile, explicit: Path | None = None) -> Path | None:
    """The file of the leg's recordings of one kind, in the folder of recordings or its ``equimus_leg``, or None.

    A file named after its kind is taken first (``triangle.csv``), then an upstream one (``…_A2B_data.csv``) with the
    columns of that kind. Where neither ``explicit`` nor EQUIMUS_RECORDINGS is given, all places ``find_recordings``
    knows are searched.

    Raises:
        RecordingError: there is no such kind, or ``explicit`` or EQUIMUS_RECORDINGS is not a folder.
    """
    if kind not in _LEG_FILES:
        raise RecordingError(unknown_name("kind of leg recording", kind, _LEG_FILES))
    for folder in _folders(explicit):
        for place in (folder, folder / "equimus_leg"):
            if (path := place / f"{kind}.csv").is_file():
                return path
            for path in sorted(place.glob("*_A2B_data.csv")):
                if upstream.kind(header_of(path)) == kind:
                    return path
    return None


def missing_hint() -> str:
    """How to get the recordings of the real leg, as a sentence."""
    return (
        "the recordings of the real leg are not here: get them with `equimus-ctrl recordings fetch`, or name "
        f"the folder that has them with --recordings DIR or {VARIABLE}"
    )
