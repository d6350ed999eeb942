"""``equimus-ctrl validate``: what it prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from test_validation_cases import TINY

from equimus_ctrl.cli.main import main
from equimus_ctrl.validation import plan

FIGURES = {"static_map", "swing_errors", "responses", "morphologies", "conservation"}


MODEL = """
format = "equimus-ctrl/model/1"
[[effects]]
effect = "transport_delay"
location = "baa"
delay = 0.1
"""


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "QUICK", TINY)


@pytest.mark.slow
def test_json_alone_on_standard_output_tables_beside_it_files_in_the_folder(
    tiny: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    (tmp_path / "late.toml").write_text(MODEL)
    model = ["--model", str(tmp_path / "late.toml")]
    assert main(["validate", "--quick", *model, "--json", "--output", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["accurate"] is True
    assert {Path(file).stem for file in record["files"]} == FIGURES | {"validation"}
    for file in record["files"]:
        assert Path(file).stat().st_size > 1000
    written = json.loads((tmp_path / "out" / "validation.json").read_text())
    assert written["swing"] == record["swing"]
    rows = ("poses at rest", "0.00574", "foot pinned", "without stops", "random robots", "on stops: ", "× real time")
    for text in (*rows, "step responses: ", "without the model's transport_delay at baa"):
        assert text in err


@pytest.mark.slow
def test_a_missed_goal_is_exit_code_three_and_named(
    tiny: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(plan.ACCURACY_GOALS, "swing", 1e-15)
    monkeypatch.chdir(tmp_path)
    assert main(["validate", "--quick", "--no-figures"]) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert "missed: swing is " in err
    assert [path.name for path in (tmp_path / "validation/results/nominal_leg").iterdir()] == ["validation.json"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--threads", "0"], "threads is 0, expected at least 1"),
        (["--seed", "-3"], "seed is -3, expected at least 0"),
        (["--model", "none.toml"], "none.toml: there is no such file"),
        (["--output", "late.toml/results"], "is no folder and cannot become one"),
    ],
)
def test_what_is_wrong_is_a_sentence(
    arguments: list[str],
    message: str,
    tiny: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late.toml").write_text(MODEL)
    assert main(["validate", "--quick", *arguments]) == 2
    err = capsys.readouterr().err.strip()
    assert err.startswith("equimus-ctrl: ") and message in err
    assert len(err.splitlines()) == 1 and "Traceback" not in err
