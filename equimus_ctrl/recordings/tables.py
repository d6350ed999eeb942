"""CSV files of any columns, as logs: numbers of a column are read when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from equimus_ctrl.recordings.csvfile import COMMENT
from equimus_ctrl.recordings.logs import Log, Table
from equimus_ctrl.recordings.sheet import Sheet, open_sheet


class _Columns(Mapping[str, NDArray[Any]]):
    """Columns of a sheet: those that nobody asks for may hold texts."""

    def __init__(self, sheet: Sheet) -> None:
        self._sheet = sheet

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._sheet.header:
            raise KeyError(name)
        return self._sheet.numbers([name])[:, 0]

    def __contains__(self, name: object) -> bool:
        return name in self._sheet.header

    def __iter__(self) -> Iterator[str]:
        return iter(self._sheet.header)

    def __len__(self) -> int:
        return len(self._sheet.header)


def read_sheet(path: Path) -> Log:
    """The log of a CSV file.

    Raises:
        RecordingError: where it cannot be read.
    """
    sheet = open_sheet(path)
    notes = {"source": path.name}
    if said := " ".join(text for _, text in sheet.notes if text):
        notes[COMMENT] = said
    clock = next((own for own in ("time", "timestamp", "t") if own in sheet.header), "")
    return Log(path, path.stem, (Table.of(_Columns(sheet)),), "a CSV file", None, notes, clock, "row")
