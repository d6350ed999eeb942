"""``equimus-ctrl diagnose``: what it refuses. That it finds what is missing the commands of the README show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.cli.main import main
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.types import Recording


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command in a folder of its own: (exit code, stdout, stderr)."""
    (tmp_path / "none").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(tmp_path / "none"))
    monkeypatch.setenv("COLUMNS", "160")

    def call(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def still(path: Path, *, degrees: bool = False, moving: bool = True, rows: int = 600) -> Path:
    """A made-up trial."""
    time = np.arange(rows) / 100
    command = np.full((rows, 2), 1e4)
    if moving:
        command[rows // 2 :] = 2e4
    position = 0.1 * np.sin(time)[:, None] + [1.5, 0.5]
    write(path, Recording(path.stem, time, command, np.rad2deg(position) if degrees else position, ("maa", "baa"),
                          ("hip", "knee")))  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("make", "arguments", "sentence"),
    [
        (lambda p: still(p / "a.csv", moving=False), (), "the commands never move"),
        (lambda p: still(p / "a.csv", degrees=True), (), "degrees"),
        (lambda p: still(p / "a.csv", rows=30), (), "too short"),
        (lambda p: still(p / "a.csv"), ("--validation", "b"), "there is no trial 'b'"),
        (lambda p: still(p / "a.csv"), ("--most", 0), "the largest number of effects is 0"),
        (lambda p: still(p / "a.csv"), ("--exclude", "stiction"), "there is no effect 'stiction'"),
        (lambda p: still(p / "a.csv"), ("--threads", 0), "threads is 0"),
        (lambda p: still(p / "a.csv"), ("--free", "maa.colour"), "maa.colour"),
        (lambda p: p / "nowhere", (), "nowhere"),
    ],
)
def test_what_cannot_be_used_is_one_sentence_and_no_report(
    ran: Any, tmp_path: Path, make: Any, arguments: tuple[object, ...], sentence: str
) -> None:
    code, out, err = ran("diagnose", make(tmp_path), *arguments, "--report", "report", "--json")
    assert code == 2
    assert out == "" and sentence in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "report").exists()
