"""Where results go: nothing that is there already is written over, unless that is asked for.

Each run has a folder of its own. One that is named by the user has to be free; a default one gets the next free number,
``hold-pid``, ``hold-pid-2``, and so on. What ``--force`` takes away is what an earlier record says it wrote, no more.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError

RECORDS = ("record.json", "score.json", "validation.json", "design.json")
"""What the record of a folder of results is called, verb by verb."""


class Results:
    """The folder that one run's results go to, checked before any work.

    Args:
        given: by the user, if so.
        force: whether what an earlier run wrote there is replaced.
        default: where they go without, or a folder above it.

    Raises:
        ConfigError: where nothing can be put there, or an earlier run has.
    """

    def __init__(self, given: Path | None, force: bool, default: Path) -> None:
        self._given, self._force = given, force
        presets.check_folder(given or default)
        if given is None:
            return
        if not force and (held := _records(given)):
            raise ConfigError(
                f"{given}: holds the results of an earlier run ({held[0].name}); expected another folder, or --force"
                " to replace them"
            )

    def opened(self, default: Path) -> Path:
        """The folder, empty of earlier results.

        Args:
            default: where the user named none; numbered from 2 on where it is taken, as is the user's own where another
                run has ended there since it was found free.
        """
        folder = self._given or default
        if not self._force and (self._given is None or _records(folder)):
            return new_folder(folder)
        presets.make_folder(folder)
        if self._force:
            _clear(folder)
        return folder


def new_folder(wanted: Path) -> Path:
    """Make a folder that nobody has yet: as wanted, or with the next free number.

    Raises:
        ConfigError: where it cannot be made.
    """
    presets.make_folder(wanted.parent)
    for folder in numbered(wanted):
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be made ({error.strerror or error})") from None
        return folder
    raise AssertionError


@contextmanager
def new_folder_whole(path: Path) -> Iterator[Path]:
    """A folder to fill, that gets its name when all of it is there, and is gone where that fails.

    Raises:
        ConfigError: where it cannot be made, or something of its name is there by then.
    """
    presets.make_folder(path.parent)
    half = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(half, ignore_errors=True)
        half.mkdir()
        yield half
        check_new(path)
        os.replace(half, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made ({error.strerror or error})") from None
    finally:
        shutil.rmtree(half, ignore_errors=True)


def numbered(path: Path) -> Iterator[Path]:
    """A path, then ``name-2``, ``name-3`` and so on beside it."""
    yield path
    for k in itertools.count(2):
        yield path.with_name(f"{path.stem}-{k}{path.suffix}")


def free_name(path: Path) -> Path:
    """The first of the numbered names of a file that nothing has."""
    return next(own for own in numbered(path) if not os.path.lexists(own))


@contextmanager
def reserved(path: Path) -> Iterator[Path]:
    """An empty file by the first of the numbered names that nothing has, to be replaced; gone again where that fails.

    Raises:
        ConfigError: where it cannot be made.
    """
    presets.make_folder(path.parent)
    for own in numbered(path):
        try:
            os.close(os.open(own, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigError(f"{own}: cannot be made ({error.strerror or error})") from None
        break
    try:
        yield own
    except BaseException:
        own.unlink(missing_ok=True)
        raise


def check_new(path: Path, force: bool = False) -> None:
    """Raise ConfigError where a file cannot be written, or is there already and is not to be replaced.

    What is there and is no file, such as a folder or a device, is never replaced.
    """
    presets.check_place(path)
    if not force:
        check_free(path)


def check_free(path: Path) -> None:
    """Raise ConfigError where something is there already."""
    if os.path.lexists(path):
        raise ConfigError(f"{path}: is there already; expected another name, or --force to replace it")


def named_at_last(path: Path, name: Path) -> Path:
    """Give a file that has become whole the name by which others look for it.

    Raises:
        ConfigError: where something has that name, or it cannot be moved.
    """
    check_new(name)
    presets.make_folder(name.parent)
    try:
        os.replace(path, name)
    except OSError as error:
        raise ConfigError(f"{name}: cannot be written ({error.strerror or error})") from None
    return name


def write_record(folder: Path, name: str, record: Mapping[str, Any], files: Iterable[Path]) -> Path:
    """Write a folder's record, with the names of the files in it that belong to the same run; its file."""
    inside = [file.name for file in files if file.parent == folder]
    presets.write_text(folder / name, presets.json_text({**record, "files": inside}))
    return folder / name


def _records(folder: Path) -> list[Path]:
    return [path for name in RECORDS if (path := folder / name).exists()]


def _clear(folder: Path) -> None:
    """Take away what the records in a folder say that they belong to, and these."""
    for record in _records(folder):
        try:
            files = json.loads(record.read_text(encoding="utf-8")).get("files", [])
        except (OSError, ValueError, AttributeError):
            files = []
        for file in files if isinstance(files, list) else []:
            if (
                isinstance(file, str)
                and file == Path(file).name
                and ((own := folder / file).is_file() or own.is_symlink())
            ):
                own.unlink()
        record.unlink(missing_ok=True)
