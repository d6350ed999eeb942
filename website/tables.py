"""Tables on a phone: columns of prose are given room where a table is too wide for the screen anyway."""

from __future__ import annotations

import re
from html import unescape

TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
ROW = re.compile(r"<tr[^>]*>(.*?)</tr>", re.DOTALL)
CELL = re.compile(r"<(?P<tag>t[hd])(?P<rest>[^>]*)>(?P<inside>.*?)</(?P=tag)>", re.DOTALL)
CODE = re.compile(r"<code[^>]*>(.*?)</code>", re.DOTALL)
SCREEN, LEAST, EDGES = 368.0, 114.0, 21.0
"""Width that a phone of 400 px has for a table, a column's least one in the style sheet, a cell's padding [px]."""
LETTER = 7.0
"""Width of a letter of a table [px]."""
PROSE, FEW = 36, 8
"""A column is one of prose where a cell has more letters than this outside code, and one of few where none has more."""


def roomy(html: str) -> str:
    """The same page; in tables that scroll on a phone cells have the class ``prose`` or ``few`` where they are such."""
    return TABLE.sub(lambda found: _table(found[0]), html)


def _table(table: str) -> str:
    rows = [[cell["inside"] for cell in CELL.finditer(row)] for row in ROW.findall(table)]
    columns = list(zip(*[row for row in rows if len(row) == len(rows[0])], strict=True)) if rows else []
    widths = [max(LEAST, *(EDGES + LETTER * _unbroken(cell) for cell in column)) for column in columns]
    if len(columns) < 3 or sum(widths) <= SCREEN:
        return table
    kinds = [_kind(column) for column in columns]

    def row(found: re.Match[str]) -> str:
        number = iter(kinds)

        def cell(one: re.Match[str]) -> str:
            kind = next(number, "")
            return f'<{one["tag"]} class="{kind}"{one["rest"]}>{one["inside"]}</{one["tag"]}>' if kind else one[0]

        return found[0].replace(found[1], CELL.sub(cell, found[1]))

    return ROW.sub(row, table)


def _kind(column: tuple[str, ...]) -> str:
    if max(len(_text(CODE.sub("", cell))) for cell in column) > PROSE:
        return "prose"
    return "few" if max(len(_text(cell)) for cell in column) <= FEW else ""


def _unbroken(cell: str) -> int:
    """Letters of the longest piece that stays in one line."""
    short = [_text(code) for code in re.findall(r'<code class="short">(.*?)</code>', cell, re.DOTALL)]
    pieces = re.sub(r"<wbr>", " ", cell)
    return max([0, *map(len, short), *map(len, _text(pieces).split())])


def _text(html: str) -> str:
    return unescape(re.sub(r"<[^>]+>", "", html)).strip()
