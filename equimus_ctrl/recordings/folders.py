"""Folders of recordings and lines of text that are there as a whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings.csvfile import replacing, write
from equimus_ctrl.recordings.sheet import PathLike, reason
from equimus_ctrl.types import Recording


def write_folder(folder: PathLike, recordings: Sequence[Recording]) -> None:
    """Write recordings as ``<name>.csv`` into a new folder, which appears when all of them are in it.

    Args:
        folder: where; one that is there already is replaced.
        recordings: what.

    Raises:
        RecordingError: where something cannot be written.
    """
    folder = Path(folder)
    half = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(half, ignore_errors=True)
        half.mkdir(parents=True)
        for recording in recordings:
            write(half / f"{recording.name}.csv", recording)
        if folder.is_dir():
            shutil.rmtree(folder)
        os.replace(half, folder)
    except OSError as error:
        raise RecordingError(f"{folder}: the folder cannot be written ({reason(error)})") from error
    finally:
        shutil.rmtree(half, ignore_errors=True)


def write_text(path: PathLike, text: str) -> None:
    """Write a text as a whole; folders above it are made.

    Raises:
        RecordingError: where that cannot be done.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{path.parent}: the folder cannot be made ({reason(error)})") from error
    with replacing(path) as file:
        file.write(text)


def read_text(path: PathLike) -> str | None:
    """The text of a file; None where there is none.

    Raises:
        RecordingError: where it is there but cannot be read.
    """
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: the file cannot be read ({error})") from error


def holds(folder: PathLike, names: Sequence[str]) -> bool:
    """Whether a folder has a CSV file of each of these names and none besides."""
    folder = Path(folder)
    return folder.is_dir() and {path.stem for path in folder.glob("*.csv")} == set(names)
