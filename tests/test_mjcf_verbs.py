"""The verbs on MJCF robots: what they write, and what they refuse."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from pendulum_runs import MOTOR, PENDULUM, SERVO, recorded

from equimus_ctrl import presets, workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import write
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording


def files(folder: Path, xml: str, trials: Sequence[Recording]) -> tuple[Path, Path]:
    presets.write_text(folder / "robot.xml", xml)
    (folder / "runs").mkdir()
    for trial in trials:
        write(folder / "runs" / f"{trial.name}.csv", trial)
    return folder / "robot.xml", folder / "runs"


@pytest.mark.slow
def test_what_makes_an_answer_doubtful_is_told() -> None:
    """Nothing that judges, and commands that MuJoCo clips."""
    drive = MOTOR.replace("/>", ' ctrllimited="true" ctrlrange="-0.3 0.3"/>')
    real, model = (Model(MjcfRobot("robot", PENDULUM.format(drive=d))) for d in (MOTOR, drive))
    trials = recorded(real, count=1, seconds=2.0)
    found = workflow.diagnose(trials, model, shoot=2.0, most=1)
    assert not found.validation and not found.test
    assert any(note.startswith("Nothing was held out") for note in found.notes)
    assert any("beyond the XML's ctrlrange of -0.3 to 0.3" in note for note in found.notes)


def test_a_recording_of_three_rows_is_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    xml, runs = files(tmp_path, robot.xml, recorded(Model(robot), count=1, seconds=0.03))
    assert main(["score", str(runs), "--model", str(xml), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_rad"]["hinge"] < 0.05


@pytest.mark.slow
def test_the_verbs_write_a_model_that_predicts_better(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    xml, runs = files(tmp_path, robot.xml, recorded(Model(robot, [CoulombFriction("hinge", 0.08)])))
    out = tmp_path / "corrected.toml"
    assert main(["diagnose", str(runs), "--model", str(xml), "--write-model", str(out), "--most", "1", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["findings"][0]["effect"] == "coulomb_friction" and out.with_suffix(".xml").is_file()
    errors = []
    for model in (xml, out):
        assert main(["score", str(runs), "--model", str(model), "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["rmse_rad"]["hinge"])
    assert errors[1] < errors[0] / 5
    free = tmp_path / "free.toml"
    assert main(["list", "parameters", "--model", str(xml), "--write", str(free)]) == 0
    capsys.readouterr()
    own = ["identify", str(runs), "--model", str(xml), "--parameters", str(free), "--no-figures", "--json"]
    assert main([*own, "--output", str(tmp_path / "id")]) == 0
    rows = json.loads(capsys.readouterr().out)["trials"]["parameters"]
    assert {row["name"] for row in rows} == {"arm.mass", "arm.inertia"}
    assert main(["sensitivity", str(runs), "--model", str(xml), "--no-figures", "--json"]) == 0


WRONG = {
    "no joint": ("<mujoco><worldbody/></mujoco>", "has no joint"),
    "no XML": ("<mujoco><worldbody>", "MuJoCo cannot load it"),
    "free": (
        '<mujoco><worldbody><body><freejoint name="f"/><geom size=".1"/></body></worldbody></mujoco>',
        "joint 'f' is a free joint, expected hinges and slides alone: the base has to be fixed",
    ),
    "names": (
        PENDULUM.format(drive=MOTOR).replace('name="hinge"', 'name="elbow"').replace('joint="hinge"', 'joint="elbow"'),
        "elbow",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_models_that_cannot_be_are_told_in_a_sentence(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    xml, message = WRONG[case]
    path, runs = files(tmp_path, xml, recorded(Model(MjcfRobot("robot", PENDULUM.format(drive=MOTOR))), count=2))
    assert main(["diagnose", str(runs), "--model", str(path)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert message in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--engine", "foo"], "there is no engine 'foo' (known: mujoco, reduced)"),
        (["--folds", "-1"], "the cross-validation has -1 folds, expected 0 or more"),
    ],
)
def test_identify_refuses_what_it_cannot_do(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    xml = PENDULUM.format(drive=MOTOR)
    path, runs = files(tmp_path, xml, recorded(Model(MjcfRobot("robot", xml)), count=2))
    assert main(["identify", str(runs), "--model", str(path), "-o", str(tmp_path / "out"), *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split()) and not (tmp_path / "out").exists()


def test_a_model_that_diverges_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unstable = PENDULUM.format(drive='<general name="drive" joint="hinge" biastype="affine" biasprm="0 1e6 0"/>')
    real = Model(MjcfRobot("robot", PENDULUM.format(drive=SERVO)))
    path, runs = files(tmp_path, unstable, recorded(real, count=2))
    assert main(["diagnose", str(runs), "--model", str(path)]) != 0
    assert "diverges on the recorded commands" in " ".join(capsys.readouterr().err.split())


def test_the_leg_s_validation_refuses_other_robots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(PENDULUM.format(drive=MOTOR))
    assert main(["validate", "--model", str(path)]) == 2
    assert "has no elastic actuators, which this is for" in " ".join(capsys.readouterr().err.split())
