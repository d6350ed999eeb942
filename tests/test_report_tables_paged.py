"""Tables of many joints in 80 columns: continued below, and no number cut."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from equimus_ctrl.report.paged import PagedTable


def shown(table: PagedTable, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(table)
    return console.export_text()


@pytest.mark.parametrize("width", [80, 50, 30])
@pytest.mark.parametrize("joints", [1, 3, 7, 24])
def test_every_number_is_there_and_every_line_fits(width: int, joints: int) -> None:
    names = [f"joint_{k}\nrad" for k in range(joints)]
    rows = [(f"trial_{r}", *(f"{-69.123456 + k + 100 * r:.6f}" for k in range(joints))) for r in range(3)]
    table = PagedTable("Errors [of all]", ("trial", *names), rows, sections=(1,), caption="no more")
    text, whole = shown(table, width), shown(table, 1000)
    assert "…" not in text and all(len(line) <= width for line in text.splitlines())
    for name, *cells in rows:
        assert all(text.split().count(cell) == 1 for cell in cells)
        assert text.count(name) == 1 + text.count("continued")
    assert all(f"joint_{k}" in text for k in range(joints))
    assert text.count("Errors [of all]") == 1 and text.count("no more") == 1
    assert ("continued" in text) is (max(map(len, whole.splitlines())) > width) and "continued" not in whole


def test_columns_are_read_beside_their_heads() -> None:
    heads = ("trial", *(f"a_long_name_of_joint_{k}" for k in range(6)))
    text = shown(PagedTable("T", heads, [("one", *(f"{k}.5" for k in range(6)))]))
    blocks = text.split("continued")
    assert len(blocks) == 2
    for k in range(6):
        block = next(own for own in blocks if f"a_long_name_of_joint_{k}" in own)
        assert f"{k}.5" in block


def test_a_table_without_numbers_or_rows() -> None:
    assert "trial" in shown(PagedTable("T", ("trial",), [("one",)]))
    assert "trial" in shown(PagedTable("T", ("trial", "x"), []))


def test_leading_columns_are_repeated() -> None:
    heads = ("parameter", "unit", *(f"a_long_name_of_joint_{k}" for k in range(6)))
    text = shown(PagedTable("T", heads, [("knee.damping", "N·m·s/rad", *(f"{k}.5" for k in range(6)))], leading=2))
    assert text.count("knee.damping") == text.count("N·m·s/rad") == 1 + text.count("continued") > 1


def test_where_no_column_fits_beside_a_name_rows_are_lists() -> None:
    names = ["a_very_long_name_of_a_joint.damping", "b"]
    rows = [(name, f"{k}.123456", "") for k, name in enumerate(names)]
    text = shown(PagedTable("T", ("parameter", "before\nin N", "at bound"), rows, caption="no more"), 36)
    lines = [line.rstrip() for line in text.splitlines()]
    assert lines == ["T", names[0], "  before in N: 0.123456", "b", "  before in N: 1.123456", " no more"]
