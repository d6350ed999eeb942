"""Wrap the prose of Markdown files at 120 columns: ``python website/reflow.py FILE…``.

Of a notebook in percent format the Markdown cells. Code, tables, headings and HTML stay as they are, and a file is left
alone where it would be rendered otherwise.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path

from markdown_it import MarkdownIt

COLUMNS = 120
ITEM = re.compile(r"(?P<indent>\s*)(?P<bullet>(?:[-*+]|\d+[.)]) +)?(?P<text>.*)")
KEPT = re.compile(r"\s*(\||#{1,6} |<|:::|!\[|---$|===)|\s*$")
"""Lines that are no prose: tables, headings, HTML, directives, figures, rules, empty ones."""
STARTS = re.compile(r"([-*+]|\d+[.)]|#+|>|\|.*)$")
"""Words with which a line cannot begin: it would become an item, a heading, a quotation or a table."""


def prose(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Runs of lines with the number of the first: paragraphs and items as one run, and each other line by itself."""
    run: list[str] = []
    first, fence, front = 0, "", False
    for number, line in enumerate(lines):
        mark = re.match(r"\s*(```+|~~~+)", line)
        front = line == "---" if number == 0 else front and line != "---"
        fenced = bool(fence or mark) or front
        if mark:
            fence = "" if fence and line.strip().startswith(fence) else fence or mark[1]
        begins = fenced or KEPT.match(line) or ((found := ITEM.match(line)) and found["bullet"])
        if run and not begins:
            run.append(line)
            continue
        if run:
            yield first, run
        first, run = number, [line]
        if fenced or KEPT.match(line):
            yield first, run
            run = []
    if run:
        yield first, run


def is_prose(run: list[str], lines: list[str], first: int) -> bool:
    """Whether a run may be wrapped: no code, table or heading, and no code by its indent alone."""
    fenced = sum(bool(re.match(r"\s*(```+|~~~+)", line)) for line in lines[:first]) % 2
    deep = run[0].startswith("    ") and (first == 0 or not lines[first - 1].strip()) and not _in_list(lines[:first])
    return not (fenced or deep or KEPT.match(run[0]) or run[0].lstrip().startswith(("```", "~~~")))


def _in_list(before: list[str]) -> bool:
    """Whether the nearest line that is not indented, above, begins an item."""
    for line in reversed(before):
        if line.strip() and not line.startswith(" "):
            return bool((found := ITEM.match(line)) and found["bullet"])
    return False


def wrapped(text: str, columns: int = COLUMNS) -> str:
    """The same text with its prose in lines of so many columns at most."""
    lines = text.splitlines()
    out: list[str] = []
    for first, run in prose(lines):
        if not is_prose(run, lines, first) or max(len(line) for line in run) <= columns:
            out += run
            continue
        found = ITEM.match(run[0])
        assert found is not None
        head = found["indent"] + (found["bullet"] or "")
        words: list[str] = []
        for word in " ".join([found["text"], *(line.strip() for line in run[1:])]).split(" "):
            if words and STARTS.match(word):
                words[-1] += "\0" + word
            else:
                words.append(word)
        body = textwrap.wrap(
            " ".join(words),
            columns,
            initial_indent=head,
            subsequent_indent=" " * len(head),
            break_long_words=False,
            break_on_hyphens=False,
        )
        out += [line.replace("\0", " ") for line in body]
    return "\n".join(out) + "\n"


def notebook(text: str) -> str:
    """The same of the Markdown cells of a notebook in percent format."""
    cells = re.split(r"(?m)^(?=# %%)", text)
    return "".join(_cell(cell) if cell.startswith("# %% [markdown]") else cell for cell in cells)


def _cell(cell: str) -> str:
    head, _, body = cell.partition("\n")
    blank = body[len(body.rstrip("\n")) :]
    plain = "\n".join(line.removeprefix("#").removeprefix(" ") for line in body.rstrip("\n").splitlines())
    return head + "\n" + "\n".join(f"# {line}".rstrip() for line in wrapped(plain, COLUMNS - 2).splitlines()) + blank


def rendered(text: str) -> str:
    """As HTML, blanks and line ends alike."""
    return " ".join(MarkdownIt("commonmark").enable("table").render(text).split())


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        before = path.read_text(encoding="utf-8")
        after = notebook(before) if path.suffix == ".py" else wrapped(before)
        if path.suffix != ".py" and rendered(before) != rendered(after):
            print(f"{path}: left as it is, for it would be rendered otherwise")
        elif after != before:
            path.write_text(after, encoding="utf-8")
