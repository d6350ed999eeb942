"""Tables with a column for each of many joints: as many columns at a time as a terminal has room for."""

from __future__ import annotations

from collections.abc import Sequence
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
    """A table that is continued below where it is too wide, its first column repeated; no number is ever cut.

    Attributes:
        title: over it.
        heads: of the columns, the first that of what rows are called.
        rows: cells as text.
        sections: rows after which a line is drawn.
        caption: below all of it; empty for none.
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    sections: Sequence[int] = ()
    caption: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        first, count = 1, len(self.heads)
        yield Text(self.title, style="bold")
        while first < count or first == 1:
            last = count
            while last > first + 1 and self._width(console, options, first, last) > options.max_width:
                last -= 1
            if first > 1:
                yield Text(" continued", style="dim")
            yield self._table(first, last)
            first = max(last, 2)
        if self.caption:
            yield Text(f" {self.caption}", style="dim")

    def _width(self, console: Console, options: ConsoleOptions, first: int, last: int) -> int:
        whole = options.update(max_width=WHOLE)
        return Measurement.get(console, whole, self._table(first, last)).maximum

    def _table(self, first: int, last: int) -> Table:
        """With the first column and those from ``first`` to before ``last``."""
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column(self.heads[0], overflow="fold")
        for head in self.heads[first:last]:
            table.add_column(head, justify="right", no_wrap=True)
        for k, (name, *cells) in enumerate(self.rows):
            shown = map(Text, (name, *cells[first - 1 : last - 1]))
            table.add_row(*shown, end_section=k in self.sections)
        return table
