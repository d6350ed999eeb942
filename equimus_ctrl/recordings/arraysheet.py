"""Columns that are arrays already, as what the checks of a recording take."""

from __future__ import annotations

from collections.abc import Mapping as Table
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings.logs import stem
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class ArraySheet:
    """Columns of a recording that are arrays already; ``sheet.Sheet`` without a text.

    Attributes:
        path: of the file.
        name: of the trial.
        form: what a row is called.
        notes: (number, text) of each.
        columns: name → (n,) values in SI units.
    """

    path: Path
    name: str
    form: str
    notes: tuple[tuple[int, str], ...]
    columns: Table[str, Array]

    @property
    def header(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.columns)

    @property
    def line_numbers(self) -> Sequence[int]:
        """Of each row."""
        return range(1, len(self.columns["time"]) + 1)

    @property
    def where(self) -> str:
        """For messages."""
        return str(self.path) if self.name == stem(self.path) else f"{self.path} ({self.name})"

    def error(self, row: int, column: str, problem: str) -> RecordingError:
        """Of row ``row`` (from 0 on) of a column."""
        return RecordingError(f"{self.where}, row {row + 1}, column {column}: {problem}")

    def header_error(self, problem: str) -> RecordingError:
        """Of the columns as a whole."""
        return RecordingError(f"{self.where}: {problem}")

    def numbers(self, columns: Sequence[str]) -> Array:
        """(n, len(columns)) finite numbers.

        Raises:
            RecordingError: where there are none, or one is not finite.
        """
        values = np.column_stack([self.columns[column] for column in columns])
        if not len(values):
            raise self.header_error("holds no rows")
        if not np.isfinite(values).all():
            row, k = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
            raise self.error(row, columns[k], f"{values[row, k]} is not finite; a finite number belongs there")
        return values
