"""``equimus-ctrl diagnose``: from a blinded ground truth to its name, and what it refuses."""

from __future__ import annotations

import json
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


@pytest.mark.slow
def test_a_concealed_ground_truth_is_recorded_and_found(ran: Any, tmp_path: Path) -> None:
    code, _, _ = ran(
        "run", "chirp", "--effect", "dead_zone:baa:threshold=4000", "--noise", 0.002, "--record", "concealed",
        "--set", "duration=10", "--no-figures",
    )  # fmt: skip
    assert code == 0
    code, out, err = ran("diagnose", "concealed", "--json", "--report", "report", "--write-model", "corrected.toml")
    assert code == 0
    record = json.loads(out)
    assert record["verdict"] == "explained"
    (finding,) = record["findings"]
    assert (finding["effect"], finding["locations"]) == ("dead_zone", ["baa"])
    threshold = finding["parameters"]["threshold"]
    assert threshold["low"] < threshold["value"] < threshold["high"]
    assert threshold["value"] == pytest.approx(4000, rel=0.03)
    assert "dead zone" in err and "kPa" in err
    assert json.loads((tmp_path / "report" / "record.json").read_text()) == record
    page = (tmp_path / "report" / "report.html").read_text()
    assert page.startswith("<!doctype html>") or page.startswith("<!DOCTYPE html>")
    assert "http://" not in page.replace("http://www.w3.org", "") and "dead zone" in page
    # The corrected model reproduces what was recorded, the one that came does not.
    scores = {}
    for name, model in (("nominal", []), ("corrected", ["--model", "corrected.toml"])):
        code, out, _ = ran("score", "concealed", "--json", *model)
        assert code == 0
        scores[name] = json.loads(out)["rmse_rad"]["knee"]
    assert scores["corrected"] < 0.0025 < 5 * scores["corrected"] < scores["nominal"]


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
