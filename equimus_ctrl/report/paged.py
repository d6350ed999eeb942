"""Tables with a column for each of many joints: as many columns at a time as a terminal has room for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

WHOLE = 100_000
"""A width in which no table is cut."""


@dataclass(frozen=True)
class PagedTable:
    """A table that is continued below where it is too wide, its first columns repeated; nothing is ever cut.

    Where not even one more column has room beside the first ones, each row is a list of its own under its name.

    Attributes:
        title: over it.
        heads: of the columns, the first that of what rows are called.
        rows: cells as text.
        sections: rows after which a line is drawn.
        caption: below all of it; empty for none.
        leading: how many columns are repeated; all of them words, the others numbers.
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    sections: Sequence[int] = ()
    caption: str = ""
    leading: int = 1

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.title, style="bold")
        pages = list(self._pages(console, options))
        if all(self._width(console, options, page) <= options.max_width for page in pages):
            for k, page in enumerate(pages):
                if k:
                    yield Text(" continued", style="dim")
                yield page
        else:
            yield from self._lists()
        if self.caption:
            yield Text(f" {self.caption}", style="dim")

    def _pages(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        first, count = self.leading, len(self.heads)
        while first < count or first == self.leading:
            last = count
            while last > first + 1 and self._width(console, options, self._table(first, last)) > options.max_width:
                last -= 1
            yield self._table(first, last)
            first = max(last, self.leading + 1)

    @staticmethod
    def _width(console: Console, options: ConsoleOptions, table: Table) -> int:
        return Measurement.get(console, options.update(max_width=WHOLE), table).maximum

    def _table(self, first: int, last: int) -> Table:
        """With the leading columns and those from ``first`` to before ``last``."""
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for head in self.heads[: self.leading]:
            table.add_column(head, overflow="fold")
        for head in self.heads[first:last]:
            table.add_column(head, justify="right", no_wrap=True)
        for k, cells in enumerate(self.rows):
            shown = map(Text, (*cells[: self.leading], *cells[first:last]))
            table.add_row(*shown, end_section=k in self.sections)
        return table

    def _lists(self) -> Iterator[Text]:
        """Each row's name on a line of its own, which only a narrower terminal breaks, and its cells below it."""
        for name, *cells in self.rows:
            yield Text(name, overflow="fold")
            for head, cell in zip(self.heads[1:], cells, strict=True):
                if cell:
                    yield Text(f"  {' '.join(head.split())}: {cell}", overflow="fold")
