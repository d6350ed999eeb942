"""A recording written row by row while it is made: what has been written is whole, whatever happens next."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings.csvfile import BEFORE
from equimus_ctrl.recordings.sheet import reason
from equimus_ctrl.types import Array


class RecordingStream:
    """A file in the recording format that grows; every row is handed to the system whole, at once.

    Args:
        path: a new file, in a folder that is there.
        joints: their names.
        actuators: theirs.
        before: (na,) command in force before the first row [Pa].
        notes: provenance.

    Raises:
        RecordingError: where the file is there already or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        joints: tuple[str, ...],
        actuators: tuple[str, ...],
        before: Array,
        notes: Mapping[str, str],
    ) -> None:
        self.path, self.rows = path, 0
        self._last = -np.inf
        header = [f"# {key} = {value}" for key, value in notes.items()]
        header += [f"# {BEFORE}{name} = {float(value)!r}" for name, value in zip(actuators, before, strict=True)]
        columns = ["time", *(f"cmd.{name}" for name in actuators), *(f"pos.{name}" for name in joints)]
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except OSError as error:
            raise RecordingError(f"{path}: the file cannot be made ({reason(error)})") from error
        self._write("\n".join([*header, ",".join(columns)]) + "\n")

    def add(self, time: float, command: Array, position: Array) -> None:
        """One more row: from this time on the command holds, and there the joints are.

        Raises:
            RecordingError: for a number that is not finite, a time not after the last one, or a full disk.
        """
        row = [float(time), *map(float, command), *map(float, position)]
        if not (np.isfinite(row).all() and time > self._last):
            raise RecordingError(
                f"{self.path}: row {self.rows} cannot be {row}, expected finite numbers and times that ascend"
            )
        self._write(",".join(map(repr, row)) + "\n")
        self._last, self.rows = time, self.rows + 1

    def close(self) -> None:
        """No more rows."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write(self, text: str) -> None:
        data = text.encode()
        size = os.fstat(self._file).st_size
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            with suppress(OSError):  # half a row would spoil all before it
                os.ftruncate(self._file, size)
            raise RecordingError(f"{self.path}: cannot be written ({reason(error)})") from error
