"""The command ``run`` with robots of MuJoCo's XML: what it writes, what it refuses, and what is left of a run that ends early."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mjcf_models import RIG, pendulum, refusal

from equimus_ctrl import recordings, workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.effects import PayloadMass
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

Ran = Callable[..., tuple[int, str, str]]
UNLIMITED = '<mujoco model="wild"><worldbody><body name="block"><joint name="z" type="slide" axis="0 0 1"/>\
<inertial mass="2" pos="0 0 0" diaginertia="0.01 0.01 0.01"/></body></worldbody>\
<actuator><motor name="lift" joint="z"/></actuator></mujoco>'
CONTROLLER = """\
class Runaway:
    until = 0.1
    def init(self, spec, observation):
        return None
    def step(self, observation, reference, state):
        return [0.0 if observation.time < self.until else 1e9], state

class AtOnce(Runaway):
    until = 0.0
"""


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ran:
    """Run the command in a folder of its own: (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(tmp_path))
    for name, text in (
        ("rig.xml", RIG.xml), ("pendulum.xml", pendulum()), ("wild.xml", UNLIMITED), ("own.py", CONTROLLER),
    ):  # fmt: skip
        (tmp_path / name).write_text(text)

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(["run", *arguments])
        out, err = capsys.readouterr()
        return code, out, " ".join(err.split())

    return call


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_robot_of_xml_is_run_recorded_and_scored(ran: Ran, tmp_path: Path) -> None:
    code, out, err = ran(
        "hold", "--model", "rig.xml", "--set", "shoulder=10", "--set", "duration=0.4", "--json",
        "--output", "out", "--record", "kept",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads(out)
    assert (found["model"], found["controller"], found["failure"]) == (RIG.name, "pid", None)
    assert found["rmse_rad"].keys() == {"shoulder"} and found["rmse_m"].keys() == {"reach"}
    assert files(tmp_path / "out") == {"joints.png", "commands.png", "series.csv", "score.json"}
    assert json.loads((tmp_path / "out" / "score.json").read_text()) == found
    again = recordings.read(
        tmp_path / "kept" / "hold.csv", limits=recordings.Limits.of_mjcf(RIG.joint_names, RIG.actuator_names)
    )
    assert again.position.shape == (len(again.time), 2) and again.notes["controller"] == "pid"


def test_a_run_that_diverges_keeps_what_there_is_and_says_why(ran: Ran, tmp_path: Path) -> None:
    wild = ("hold", "--model", "wild.xml", "-c", "own.py:Runaway", "--set", "duration=1", "--record", "kept")
    (tmp_path / "out").mkdir()
    for name in ("score.json", "joints.png", "commands.png", "mine.txt"):
        (tmp_path / "out" / name).write_text("of another run")
    code, out, err = ran(*wild, "--json", "--output", "out")
    assert code == 3 and "the simulation diverged" in err
    found = json.loads(out)
    assert "diverged" in found["failure"] and found["failure"] in err
    assert (found["scenario"], found["controller"]) == ("hold", "own.py:Runaway")
    assert files(tmp_path / "out") == {"score.json", "series.csv", "mine.txt"}
    assert json.loads((tmp_path / "out" / "score.json").read_text()) == found
    kept = recordings.read(tmp_path / "kept" / "hold.csv", limits=recordings.Limits.of_mjcf(["z"], ["lift"]))
    assert kept.time[-1] == pytest.approx(found["ended_s"]) and kept.notes["failure"] == found["failure"]


def test_its_folder_is_that_of_any_run_and_it_draws_nothing_unasked(ran: Ran, tmp_path: Path) -> None:
    code, _, err = ran("hold", "--model", "wild.xml", "-c", "own.py:AtOnce", "--no-figures", "--record", "kept")
    assert code == 3, err
    assert files(tmp_path / "results" / "run" / "hold-AtOnce") == {"score.json"}
    assert not (tmp_path / "kept").exists()  # one row is no recording


def test_results_of_another_run_do_not_stay_beside_new_ones(ran: Ran, tmp_path: Path) -> None:
    short = ("hold", "--model", "pendulum.xml", "--set", "duration=0.1", "--output", "out")
    assert ran(*short)[0] == 0
    assert "series.csv" in files(tmp_path / "out")
    assert ran(*short, "--no-figures")[0] == 0
    assert files(tmp_path / "out") == {"score.json"}


def test_a_video_of_a_robot_that_none_shows_is_refused_before_the_run(ran: Ran, tmp_path: Path) -> None:
    code, _, err = ran("hold", "--model", "rig.xml", "--video", "film.gif", "--set", "duration=60")
    assert code == 2 and "rig: a video shows robots with elastic actuators alone" in err
    assert not (tmp_path / "results").exists()


# --- what a run builds on -----------------------------------------------------------------------------------------


def test_a_scenario_builds_on_what_is_known_not_on_what_is_simulated() -> None:
    weak = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1 1"/>'))
    light = weak.with_parameters({"arm.mass": 0.2})
    options = {"pivot": "60", "duration": "0.1"}
    assert "cannot be held" in refusal(lambda: workflow.run_scenario("hold", model=Model(weak), options=options))
    done = workflow.run_scenario("hold", model=Model(weak), nominal=Model(light), options=options)
    assert done.model.robot is weak
    heavy = Model(light, (PayloadMass("arm", 1.0),))
    assert "cannot be held" in refusal(
        lambda: workflow.run_scenario("hold", model=Model(light), nominal=heavy, options=options)
    )
    assert "but rig has shoulder, reach" in refusal(
        lambda: workflow.run_scenario("hold", model=Model(RIG), nominal=Model(weak), options={"pivot": "3"})
    )


def test_a_wrong_name_among_ones_own_gains_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "controllers").mkdir()
    file, leg = tmp_path / "controllers" / "pid.toml", nominal_leg()
    scenario = workflow.load_scenario("hold", leg, search=False)
    file.write_text("[gains.maaa]\nkp = 1.0\n[gains.baa]\nkp = 1.0\n")
    said = refusal(lambda: workflow.load_controller("pid", scenario, robot=leg))
    assert "pid.toml: PID gains: there is no length channel 'maaa'; did you mean 'maa'?" in said
    file.write_text("[gains.baa]\nkp = 1.0\n")
    assert "channel 'maa' has none" in refusal(lambda: workflow.load_controller("pid", scenario, robot=leg))
    file.write_text("[gains.hip]\nkp = 1.0\n[gains.knee]\nkp = 1.0\n")
    assert "no length channel 'hip'" in refusal(lambda: workflow.load_controller("pid", scenario, robot=leg))
    placed = workflow.load_controller("pid", scenario, robot=RIG)
    assert isinstance(placed, PidController) and placed.settings is None
    (tmp_path / "controllers" / "pid_rig.toml").write_text('space = "joint"\n[gains.sholder]\nkp = 1.0\n')
    assert "no joint channel 'sholder'" in refusal(lambda: workflow.load_controller("pid", scenario, robot=RIG))
