"""The ``recordings`` verbs: JSON alone on standard output, people's text on the other, errors handed on."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import equimus_ctrl as eq
from equimus_ctrl import recordings
from equimus_ctrl.cli.recordings import app
from equimus_ctrl.errors import NotAvailable, RecordingError
from equimus_ctrl.recordings import RecordingWarning

TEXT = "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,1000,2000,1.5,0.1\n0.01,3000,2000,1.6,0.2\n"


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    path = tmp_path / "trial [0].csv"
    path.write_text(TEXT)
    return path


def test_check(trial: Path) -> None:
    result = CliRunner().invoke(app, ["check", str(trial), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert [summary["name"] for summary in found["trials"]] == ["trial [0]"] and found["warnings"] == []
    assert "1 trials" in result.stderr and "85.9..91.7" in result.stderr
    quiet = CliRunner().invoke(app, ["check", str(trial)])
    assert quiet.stdout == "" and "trial [0]" in quiet.stderr


def test_check_shows_doubts(trial: Path) -> None:
    trial.write_text(TEXT.replace("000,", ","))
    result = CliRunner().invoke(app, ["check", str(trial), "--json"])
    assert result.exit_code == 0 and len(json.loads(result.stdout)["warnings"]) == 1
    assert f"warning: {trial}: no command is above 3 Pa" in result.stderr


def test_check_passes_errors_on(trial: Path) -> None:
    trial.write_text(TEXT.replace("1.6", "nan"))
    result = CliRunner().invoke(app, ["check", str(trial), "--json"])
    assert isinstance(result.exception, RecordingError) and result.stdout == ""


def test_check_takes_limits(trial: Path) -> None:
    trial.write_text(TEXT.replace("3000", "90000").replace("0.2", "99"))
    options = ["--command-high", "1e5", "--rotating", "knee"]
    assert CliRunner().invoke(app, ["check", str(trial), *options]).exit_code == 0
    assert CliRunner().invoke(app, ["check", str(trial), *options[:2]]).exit_code != 0


def test_what_turns_without_end_is_no_hinge_in_degrees(trial: Path, tmp_path: Path) -> None:
    robot, path = tmp_path / "robot.xml", tmp_path / "run.csv"
    robot.write_text(
        '<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size="0.1" mass="1"/><body><joint name="wheel"/>'
        '<geom size="0.1" mass="1"/></body></body></worldbody><actuator><motor name="belt" joint="rail"/></actuator></mujoco>'
    )
    rows = "".join(f"{0.01 * k:g},0,{0.001 * k:g},{9 * k}\n" for k in range(9))
    path.write_text(f"time,cmd.belt,pos.rail,pos.wheel\n{rows}")
    check = ["check", str(path), "--model", str(robot), "--json"]
    told = json.loads(CliRunner().invoke(app, check).stdout)["warnings"]
    assert len(told) == 1 and "pos.wheel goes to 72 rad, 11 turns; are these degrees" in told[0]
    assert json.loads(CliRunner().invoke(app, [*check, "--rotating", "wheel"]).stdout)["warnings"] == []
    with pytest.warns(RecordingWarning, match="11 turns"):
        eq.check_recordings(path, eq.load_model(robot))
    assert eq.check_recordings(path, eq.load_model(robot), rotating=["wheel"])[0].rows == 9
    result = CliRunner().invoke(app, [*check, "--rotating", "whel"])
    assert str(result.exception) == "--rotating: there is no hinge 'whel'; did you mean 'wheel'? (known: wheel)"
    result = CliRunner().invoke(app, [*check, "--rotating", "rail"])
    assert str(result.exception) == "--rotating: there is no hinge 'rail' (known: wheel)"
    result = CliRunner().invoke(app, ["check", str(trial), "--rotating", "nee"])
    assert str(result.exception) == "--rotating: there is no joint 'nee'; did you mean 'knee'? (known: hip, knee)"


def test_check_of_an_mjcf_robot_reads_its_names_and_units(tmp_path: Path) -> None:
    robot, path = tmp_path / "robot.xml", tmp_path / "run.csv"
    robot.write_text(
        '<mujoco><worldbody><body name="cart"><joint name="rail" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>'
        '<actuator><motor name="belt" joint="rail"/></actuator></mujoco>'
    )
    path.write_text("time,cmd.belt,pos.rail\n" + "".join(f"{0.01 * k:g},{-3 + k},{0.001 * k:g}\n" for k in range(9)))
    result = CliRunner().invoke(app, ["check", str(path), "--model", str(robot), "--json"])
    assert json.loads(result.stdout)["trials"][0]["command_pa"] == {"belt": [-3.0, 5.0]}
    assert "-3.0..5.0" in result.stderr and "mm" in result.stderr and "0.0..8.0" in result.stderr
    robot.write_text(robot.read_text().replace('"belt"', '"rail"'))  # an actuator may be named as its joint
    path.write_text(path.read_text().replace("cmd.belt", "cmd.rail"))
    result = CliRunner().invoke(app, ["check", str(path), "--model", str(robot)])
    assert result.exit_code == 0 and result.stderr.count("rail") == 2 and "0.0..8.0" in result.stderr
    path.write_text(path.read_text().replace("pos.rail", "pos.slide"))
    result = CliRunner().invoke(app, ["check", str(path), "--model", str(robot)])
    assert isinstance(result.exception, RecordingError) and "rail" in str(result.exception)


def test_check_of_an_mjcf_robot_doubts_degrees(tmp_path: Path) -> None:
    robot, path = tmp_path / "robot.xml", tmp_path / "run.csv"
    robot.write_text(
        '<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1" pos="1 0 0" mass="1"/></body></worldbody>'
        '<actuator><motor name="drive" joint="hinge"/></actuator></mujoco>'
    )
    path.write_text("time,cmd.drive,pos.hinge\n" + "".join(f"{0.01 * k:g},0,{90 - k}\n" for k in range(9)))
    result = CliRunner().invoke(app, ["check", str(path), "--model", str(robot)])
    assert result.exit_code == 0
    assert "pos.hinge goes to 90 rad, 14 turns; are these degrees where radians belong?" in result.stderr
    path.write_text(path.read_text().replace(",9", ",1").replace(",8", ",1"))
    result = CliRunner().invoke(app, ["check", str(path), "--model", str(robot)])
    assert result.exit_code == 0 and "degrees" not in result.stderr


def test_import(trial: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    result = CliRunner().invoke(app, ["import", str(trial), "--output", str(output), "--json"])
    assert json.loads(result.stdout) == {"files": [str(output / trial.name)]}
    assert "1 trials written" in result.stderr
    again = CliRunner().invoke(app, ["import", str(trial), "--output", str(output)])
    assert isinstance(again.exception, RecordingError)
    assert CliRunner().invoke(app, ["import", str(trial), "-o", str(output), "--force"]).exit_code == 0


def test_fetch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def got(output: Path | None) -> tuple[recordings.Fetched, ...]:
        assert output == tmp_path
        return (recordings.Fetched(tmp_path / "a.csv", True), recordings.Fetched(tmp_path / "b.csv", False))

    monkeypatch.setattr(recordings, "fetch", got)
    result = CliRunner().invoke(app, ["fetch", "--output", str(tmp_path), "--json"])
    assert [file["downloaded"] for file in json.loads(result.stdout)["files"]] == [True, False]
    assert "a.csv (downloaded)" in result.stderr and "b.csv (already there)" in result.stderr

    def offline(output: Path | None) -> tuple[recordings.Fetched, ...]:
        raise NotAvailable("no")

    monkeypatch.setattr(recordings, "fetch", offline)
    assert isinstance(CliRunner().invoke(app, ["fetch"]).exception, NotAvailable)


@pytest.mark.parametrize("verb", ["import", "check", "fetch"])
def test_help_has_examples(verb: str) -> None:
    result = CliRunner().invoke(app, [verb, "--help"])
    assert result.exit_code == 0
    assert "Examples" in result.stdout and f"equimus-ctrl recordings {verb}" in result.stdout


def test_help_needs_no_numpy() -> None:
    code = "import sys; import equimus_ctrl.cli.recordings; print('equimus_ctrl.recordings' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
