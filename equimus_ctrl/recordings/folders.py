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


def copy(source: PathLike, target: PathLike) -> None:
    """Copy a text file as a whole; folders above the new one are made.

    Raises:
        RecordingError: where there is none, or it cannot be done.
    """
    text = read_text(source)
    if text is None:
        raise RecordingError(f"{source}: the file is missing")
    write_text(target, text)


def copy_folder(source: PathLike, target: PathLike) -> None:
    """Copy a folder of text files, which appears when all of them are in it, in the place of one that is there.

    Raises:
        RecordingError: where there is none, or it cannot be done.
    """
    source, target = Path(source), Path(target)
    half = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(half, ignore_errors=True)
        half.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(source, half)
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(half, target)
    except OSError as error:
        raise RecordingError(f"{source}: the folder cannot be copied to {target} ({reason(error)})") from error
    finally:
        shutil.rmtree(half, ignore_errors=True)


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


def texts(folder: PathLike, pattern: str) -> dict[Path, str]:
    """Files in a folder whose names match a pattern, by name, with what they hold.

    Raises:
        RecordingError: where one cannot be read.
    """
    return {path: read_text(path) or "" for path in sorted(Path(folder).glob(pattern))}


def holds(folder: PathLike, names: Sequence[str]) -> bool:
    """Whether a folder has a CSV file of each of these names and none besides."""
    folder = Path(folder)
    return folder.is_dir() and {path.stem for path in folder.glob("*.csv")} == set(names)
