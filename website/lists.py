"""Lists as MkDocs reads them: four columns of indent for what belongs to an item, an empty line before the first."""

from __future__ import annotations

import re

ITEM = re.compile(r"( *)((?:[-*+]|\d{1,9}[.)]) +)(?=\S)")
FENCE = re.compile(r" *(```+|~~~+)")
LEVEL = 4


def aligned(markdown: str) -> str:
    """The same page, in which forges and MkDocs see the same lists.

    Forges let what belongs to an item begin below its text, whatever the width of the bullet, and a list begin right
    after a paragraph.
    """
    out: list[str] = []
    columns: list[int] = []  # where the text of each list item around a line begins
    fence, before = "", ""
    for line in markdown.splitlines():
        indent = len(line) - len(line.lstrip(" "))
        if not line.strip():
            out.append("")
            before = ""
            continue
        if not fence:
            lazy = (
                before and not ITEM.match(line) and not FENCE.match(line) and not line.lstrip().startswith(("#", "|"))
            )
            while columns and indent < columns[-1] and not lazy:
                columns.pop()
        item, mark = (None, None) if fence else (ITEM.match(line), FENCE.match(line))
        inside = max(indent - (columns[-1] if columns else 0), 0)
        if item and not columns and before and not ITEM.match(before):
            out.append("")
        out.append(" " * (LEVEL * len(columns) + inside) + line.lstrip(" "))
        if item:
            columns.append(indent + len(item[2]))
        if fence and line.strip().startswith(fence):
            fence = ""
        elif mark:
            fence = mark[1]
        before = line
    return "\n".join(out) + "\n"
