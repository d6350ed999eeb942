"""CSV files of any columns, as logs: numbers of a column are read when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings.csvfile import BEFORE, COMMENT
from equimus_ctrl.recordings.logs import Log, Table
from equimus_ctrl.recordings.sheet import Sheet, open_sheet, shorten


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


def _notes(sheet: Sheet) -> dict[str, str]:
    """``key = value`` notes, which may say how commands are to be taken; of what else stands there one comment.

    Raises:
        RecordingError: where one is there twice.
    """
    notes: dict[str, str] = {}
    words = []
    for line, text in sheet.notes:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not key or key == COMMENT or (key.startswith("before") and not key.startswith(BEFORE)):
            words.append(value if key == COMMENT else text)
        elif key in notes:
            raise RecordingError(f"{sheet.path}, row {line}: note {shorten(key)} is there more than once")
        else:
            notes[key] = value
    return notes | ({COMMENT: " ".join(filter(None, words))} if any(words) else {})


def read_sheet(path: Path) -> Log:
    """The log of a CSV file.

    Raises:
        RecordingError: where it cannot be read.
    """
    sheet = open_sheet(path)
    notes = {"source": path.name} | _notes(sheet)
    clock = next((own for own in ("time", "timestamp", "t") if own in sheet.header), "")
    return Log(path, path.stem, (Table.of(_Columns(sheet)),), "a CSV file", None, notes, clock, "row")
