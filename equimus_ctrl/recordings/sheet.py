"""From the bytes of a comma-separated file to its header and numbers, with the place of whatever is wrong.

The fast path reads all numbers at once; only when that fails is the file gone through cell by cell to name the
culprit.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.presets import check_regular
from equimus_ctrl.types import Array

PathLike = str | os.PathLike[str]
LONGEST = 40
"""Characters of a cell that a message shows."""


class Tabular(Protocol):
    """Columns of numbers with the place of whatever is wrong in them: a CSV file's, or those of any other log."""

    @property
    def path(self) -> Path: ...

    @property
    def name(self) -> str: ...

    @property
    def notes(self) -> tuple[tuple[int, str], ...]: ...

    @property
    def header(self) -> tuple[str, ...]: ...

    @property
    def line_numbers(self) -> Sequence[int]: ...

    def error(self, row: int, column: str, problem: str) -> RecordingError:
        """For row ``row`` (from 0 on) of a column."""

    def header_error(self, problem: str) -> RecordingError:
        """For something wrong in the header."""

    def numbers(self, columns: Sequence[str]) -> Array:
        """(n, len(columns)) finite numbers."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """The text of one file, split but not yet turned into numbers.

    Attributes:
        path: the file.
        notes: (line number, text without the ``#``) of the lines before the header that start with ``#``.
        header: column names, in the file's order.
        header_line: 1-based line number of the header.
        lines: the data lines that are not blank.
        line_numbers: 1-based line number of each of ``lines``.
    """

    path: Path
    notes: tuple[tuple[int, str], ...]
    header: tuple[str, ...]
    header_line: int
    lines: Sequence[str]
    line_numbers: Sequence[int]

    @property
    def name(self) -> str:
        """Of the trial."""
        return self.path.stem

    def error(self, row: int, column: str, problem: str) -> RecordingError:
        """The error for data row ``row`` (0-based) of ``column``; its message has the line number in the file."""
        return RecordingError(f"{self.path}, row {self.line_numbers[row]}, column {column}: {problem}")

    def header_error(self, problem: str) -> RecordingError:
        """The error for something wrong in the header."""
        return RecordingError(f"{self.path}, row {self.header_line}: {problem}")

    def numbers(self, columns: Sequence[str]) -> Array:
        """The (n, len(columns)) finite numbers of ``columns``.

        Raises:
            RecordingError: there are no rows, a row has too many or too few cells, a cell is not a number or is
                not finite.
        """
        if not self.lines:
            raise RecordingError(f"{self.path}: there is a header but not one row of data below it")
        width = len(self.header)
        for row, line in enumerate(self.lines):
            if line.count(",") != width - 1:
                raise self._width_error(row)
        positions = [self.header.index(column) for column in columns]
        try:
            values = np.loadtxt(self.lines, delimiter=",", comments=None, usecols=positions, ndmin=2)
        except (ValueError, OverflowError):
            raise self._cell_error(columns, positions) from None
        finite = np.isfinite(values)
        if not finite.all():
            row, k = (int(i) for i in np.argwhere(~finite)[0])
            cell = self.lines[row].split(",")[positions[k]]
            raise self.error(row, columns[k], f"{shorten(cell)} is not finite; a finite number belongs there")
        return values

    def _width_error(self, row: int) -> RecordingError:
        line = self.lines[row]
        if line.lstrip().startswith("#"):
            problem = f"{shorten(line)} stands below the header; notes that start with '#' belong above it"
        else:
            cells = line.count(",") + 1
            problem = f"{cells} cell{'s' if cells > 1 else ''}, but the header names {len(self.header)} columns"
        return RecordingError(f"{self.path}, row {self.line_numbers[row]}: {problem}")

    def _cell_error(self, columns: Sequence[str], positions: Sequence[int]) -> RecordingError:
        for row, line in enumerate(self.lines):
            cells = line.split(",")
            for column, position in zip(columns, positions, strict=True):
                if not _is_number(cells[position]):
                    return self.error(
                        row, column, f"{shorten(cells[position])} is not a number; a number belongs there"
                    )
        return RecordingError(f"{self.path}: the rows below the header cannot be read as numbers")


def _is_number(cell: str) -> bool:
    # float() also takes '1_000' and digits of other scripts, which no file format here knows.
    if "_" in cell or not cell.isascii():
        return False
    try:
        float(cell)
    except ValueError:
        return False
    return True


def shorten(text: str) -> str:
    """``text`` quoted for a message, cut to ``LONGEST`` characters; 'an empty cell' where there is none."""
    text = text.strip()
    if not text:
        return "an empty cell"
    return repr(text if len(text) <= LONGEST else text[: LONGEST - 1] + "…")


def open_sheet(path: PathLike) -> Sheet:
    """Read a file's notes, header and data lines.

    Raises:
        RecordingError: it is not a file, cannot be opened, is not UTF-8 text, is empty, or its header has a nameless,
            unprintable or repeated column or no commas.
    """
    path = Path(path)
    lines = _decode(path, _read_bytes(path)).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    notes: list[tuple[int, str]] = []
    for index, line in enumerate(lines):
        stripped = line.strip()
        if stripped.startswith("#"):
            notes.append((index + 1, stripped[1:].strip()))
        elif stripped:
            break
    else:
        raise RecordingError(f"{path}: the file is empty; a header and rows of numbers belong in it")
    header = tuple(name.strip() for name in stripped.split(","))
    body = [(number, line) for number, line in enumerate(lines[index + 1 :], index + 2) if line.strip()]
    sheet = Sheet(path, tuple(notes), header, index + 1, [line for _, line in body], [number for number, _ in body])
    _check_header(sheet, stripped)
    return sheet


def _check_header(sheet: Sheet, line: str) -> None:
    if len(sheet.header) == 1:
        for separator, name in ((";", "semicolons"), ("\t", "tabs")):
            if separator in line:
                raise sheet.header_error(f"the columns are separated by {name}; commas belong between them")
    for position, name in enumerate(sheet.header, 1):
        if not name:
            raise sheet.header_error(f"column {position} of {len(sheet.header)} has no name")
        if not name.isprintable():
            raise sheet.header_error(f"the name of column {position}, {name!r}, has a character that cannot be printed")
    repeated = [name for name, count in Counter(sheet.header).items() if count > 1]
    if repeated:
        places = ", ".join(str(i) for i, name in enumerate(sheet.header, 1) if name == repeated[0])
        raise sheet.header_error(f"column {shorten(repeated[0])} is there more than once (as columns {places})")


def header_of(path: PathLike) -> tuple[str, ...]:
    """The column names of a file, without reading its rows; empty where it has none or is not text."""
    try:
        check_regular(Path(path))
        with open(path, encoding="utf-8-sig") as file:
            for line in file:
                if line.strip() and not line.lstrip().startswith("#"):
                    return tuple(name.strip() for name in line.split(","))
    except (OSError, UnicodeDecodeError):
        pass
    return ()


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise RecordingError(f"{path}: this is a folder where a file belongs")
    try:
        check_regular(path)
        return path.read_bytes()
    except FileNotFoundError:
        raise RecordingError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: the file cannot be read ({reason(error)})") from error


def _decode(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(
            f"{path}, row {row}: byte 0x{data[error.start]:02x} is not UTF-8 text; a recording is a CSV file in UTF-8"
        ) from None


def reason(error: Exception) -> str:
    """What the operating system says of ``error``, without its number and file name."""
    return getattr(error, "strerror", None) or str(error)


def number(value: float) -> str:
    """``value`` for a message: six figures, or ``nan``."""
    return f"{value:.6g}" if math.isfinite(value) else str(value)
