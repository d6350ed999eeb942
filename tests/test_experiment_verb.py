"""``experiment design``: from a diagnosis' record to commands that are played, and what is said of them."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import refusal
from rich.console import Console
from rival_legs import delays, frictions

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.recordings.commands import read_commands
from equimus_ctrl.report.experiment_figures import design_drawings
from equimus_ctrl.report.experiment_text import pair_sentence, print_design
from equimus_ctrl.workflow.experiments import command_file, rivals_in, run_command, write_design

SMALL = {"family": ["steps"], "evaluations": 20, "draws": 9, "threads": 1, "duration": 2.5}


@cache
def of_frictions() -> Designed:
    return eq.design_experiment(frictions(), limit={"drive.low": "-1", "drive.high": "1"}, **SMALL)


@cache
def of_delays() -> Designed:
    return eq.design_experiment(delays(), **SMALL)


def test_what_is_written_is_what_was_designed(tmp_path: Path) -> None:
    found = of_frictions()
    files = write_design(found, tmp_path / "next", figures=False, model_options=["--model", "robot.xml"])
    assert [file.name for file in files.all] == ["design.csv", "design.json"]
    robot, limits = found.rivals.model.robot, found.limits
    own = read_commands(
        files.commands, robot.actuator_names, robot.joint_names, limits.command_low, limits.command_high
    )
    assert np.array_equal(own.values, found.commands.commands) and np.array_equal(own.times, found.commands.times)
    assert own.position is not None and np.array_equal(own.position, found.commands.start)  # type: ignore[arg-type]
    record = json.loads(files.record.read_text())
    assert record["schema"] == "equimus-ctrl/design/1" and record["commands"] == "design.csv"
    assert record["run"] == run_command(files.commands, ["--model", "robot.xml"])
    assert record["files"] == ["design.csv"] and record["pairs"][0]["rivals"] == [0, 1]
    assert "holds the results of an earlier run (design.json)" in refusal(
        lambda: write_design(found, tmp_path / "next", figures=False)
    )


@pytest.mark.slow
def test_the_keys_of_the_record_stand_in_the_documentation() -> None:
    page = (Path(__file__).parents[1] / "docs" / "formats.md").read_text(encoding="utf-8")
    table = page.partition("## The record of a designed trial\n")[2].partition("\n## ")[0]
    found = of_delays().to_dict()
    keys = {*found, *found["pairs"][0], *found["pairs"][0]["powers"][0], *found["remedies"][0], *found["tried"][0]}
    assert {key for key in keys if f"`{key}`" not in table} == set()


def test_the_answer_in_words() -> None:
    found = of_delays()
    console = Console(width=100, record=True, file=io.StringIO())
    print_design(console, found, "equimus-ctrl run commands", "equimus-ctrl diagnose")
    text = " ".join(console.export_text().split())
    assert (
        "sensor delay at hip and knee or transport delay at maa and baa: not distinguishable within the limits" in text
    )
    assert "would distinguish them: a sensor" in text and "in place of" in text
    assert "at most 10 %" in text and "none is worth making" in text and "equimus-ctrl run commands" not in text
    print_design(console, of_frictions(), "equimus-ctrl run commands", "equimus-ctrl diagnose")
    assert "  equimus-ctrl run commands\n  equimus-ctrl diagnose\n" in console.export_text()
    (pair,) = of_frictions().pairs
    assert "trial" in pair_sentence(of_frictions(), pair) or "repeats" in pair_sentence(of_frictions(), pair)
    assert "settle this already" in pair_sentence(found, replace(pair, ending="settled"))
    assert "design again" in pair_sentence(found, replace(pair, ending="another trial"))


@pytest.mark.parametrize("name", ["commands", "predictions", "power"])
def test_every_figure_is_drawn(name: str) -> None:
    figure = design_drawings(of_frictions())[name]()
    assert figure is not None and figure.axes and figure.get_suptitle()


def test_rivals_are_read_from_whatever_holds_them(tmp_path: Path) -> None:
    rivals = frictions()
    data = {"schema": "equimus-ctrl/diagnosis/2", "rivals": json.loads(json.dumps(rivals.to_dict()))}
    path = tmp_path / "record.json"
    path.write_text(json.dumps(data))
    for given in (data, path, tmp_path, str(path)):
        assert rivals_in(given, rivals.model).to_dict() == rivals.to_dict()
    assert rivals_in(rivals) is rivals
    assert "is not the model that was diagnosed" in refusal(lambda: rivals_in(data, eq.nominal_model()))
    path.write_text("{")
    assert f"{path}: is no JSON" in refusal(lambda: rivals_in(path, rivals.model))
    path.write_text("[]")
    assert "is no record of a diagnosis" in refusal(lambda: rivals_in(path, rivals.model))
    path.write_text(json.dumps({"schema": "equimus-ctrl/diagnosis/2"}))
    assert "expected equimus-ctrl/diagnosis/2 with rivals" in refusal(lambda: rivals_in(tmp_path, rivals.model))
    path.write_text(json.dumps({**data, "rivals": {"robot": data["rivals"]["robot"]}}))  # type: ignore[index]
    assert "its rivals cannot be read (KeyError" in refusal(lambda: rivals_in(tmp_path, rivals.model))


@pytest.mark.slow
def test_the_command_writes_what_run_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                           capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    data = {"schema": "equimus-ctrl/diagnosis/2", "rivals": delays().to_dict()}
    (tmp_path / "record.json").write_text(json.dumps(data))
    words = ["experiment", "design", "record.json", "--family", "steps", "--evaluations", "15", "--draws", "5"]
    words += ["--duration", "2", "--threads", "1", "--no-figures", "-o", "next", "--json"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["run"] == "equimus-ctrl run commands --set file=next/design.csv --record designed"
    assert "none is worth making" in err and record["pairs"][0]["ending"] == "inseparable"
    assert main([*record["run"].split()[1:], "--no-figures"]) == 0
    assert list((tmp_path / "designed").glob("*.csv"))
    assert main(words) == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"family": ["step"]}, "there is no family of commands 'step'; did you mean 'steps'?"),
        ({"can": ["payload:nowhere=1"]}, "nowhere"),
        ({"limit": {"mma.high": "1"}}, "there is no limit 'mma.high'"),
        ({"sensor_noise": {"vel.hop": 1.0}}, "there is no sensor 'vel.hop'; did you mean 'vel.hip'?"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(changes: dict[str, object], said: str) -> None:
    assert said in refusal(lambda: eq.design_experiment(delays(), **{**SMALL, "evaluations": 11, **changes}))


def test_a_file_of_commands_says_what_is_different(tmp_path: Path) -> None:
    found = of_delays()
    other = replace(found, condition=replace(found.condition, payloads={"foot": 0.2}))
    assert command_file(other).different == {"payload.foot": "0.2"} and command_file(found).position is None
