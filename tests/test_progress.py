"""What verbs say of how far they are."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from equimus_ctrl.cli import progress


def test_without_a_terminal_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    text = io.StringIO()
    with progress.stage_bar(Console(file=text, force_terminal=False, width=40), "getting ready") as show:
        for seconds, stage, share in ((4.0, "refit", 0.1), (11.0, "search", 0.25), (15.0, "search", 0.3)):
            clock[0] = 100.0 + seconds
            show(stage, share, "coulomb_friction:elbow")
        clock[0] = 121.5
        show("report")
    assert text.getvalue().splitlines() == [
        "search, 25 % after 11 s; best so far: coulomb_friction:elbow",
        "report, 30 % after 22 s; best so far: coulomb_friction:elbow",
    ]


def test_at_a_terminal_a_bar_and_no_lines() -> None:
    text = io.StringIO()
    with progress.stage_bar(Console(file=text, force_terminal=True, width=80), "getting ready") as show:
        show("refit", 0.5)
    assert " after " not in text.getvalue()
