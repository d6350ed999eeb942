"""Paths of joints in CSV files: ``time`` and ``pos.<joint>`` of each joint in SI units; other columns do not count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from equimus_ctrl.recordings.sheet import PathLike, open_sheet
from equimus_ctrl.types import Array


def read_path(path: PathLike, names: Sequence[str]) -> tuple[Array, Array]:
    """Times (n,) [s] of the column ``time``, and (n, k) of the columns of some names.

    Raises:
        RecordingError: where the file cannot be read, lacks a column, or times do not ascend.
    """
    sheet = open_sheet(path)
    columns = ["time", *names]
    for column in columns:
        if column not in sheet.header:
            raise sheet.header_error(f"there is no column {column!r}; expected {', '.join(columns)}")
    values = sheet.numbers(columns)
    late = np.flatnonzero(np.diff(values[:, 0]) <= 0)
    if len(late):
        row = int(late[0]) + 1
        raise sheet.error(row, "time", f"{values[row, 0]:g} s does not come after {values[row - 1, 0]:g} s")
    return values[:, 0], values[:, 1:]
