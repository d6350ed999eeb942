"""A search's memory on top of an append-only store of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from equimus_ctrl.tuning.evaluation import Evaluation


class Rows(Protocol):
    """An append-only store."""

    rows: list[dict[str, Any]]

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row."""
        ...

    def truncate(self, count: int) -> None:
        """Drop all rows from number ``count`` on."""
        ...


class RowJournal:
    """Evaluations kept as rows; the first row that does not fit the search ends what is reused.

    Args:
        store: where the rows are.
    """

    def __init__(self, store: Rows) -> None:
        self._store = store
        self._usable = len(store.rows)

    def known(self, index: int, values: Sequence[float]) -> Evaluation | None:
        """The evaluation number ``index``, if it is there and was of the very same values."""
        if index >= self._usable:
            return None
        row = self._store.rows[index]
        try:
            if row["index"] == index and row["values"] == list(values):
                return Evaluation.from_dict(row["evaluation"])
        except (KeyError, TypeError):
            pass
        self._usable = index
        self._store.truncate(index)
        return None

    def add(self, index: int, stage: str, values: Sequence[float], evaluation: Evaluation) -> None:
        """Keep one more."""
        self._store.append({"index": index, "stage": stage, "values": list(values), "evaluation": evaluation.to_dict()})


class Memory:
    """Rows that are kept nowhere else, as long as a tuning lasts."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row."""
        self.rows.append(dict(row))

    def truncate(self, count: int) -> None:
        """Drop all rows from number ``count`` on."""
        del self.rows[count:]
