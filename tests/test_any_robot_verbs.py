"""The command ``run`` with MJCF robots: what it writes, what it refuses, and what is left of a run that ends early."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import RIG, pendulum, refusal
from PIL import Image
from rich.console import Console

from equimus_ctrl import recordings, workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.registry import compared_controllers
from equimus_ctrl.effects import PayloadMass
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.comparison import comparison_table
from equimus_ctrl.report.run_figures import commands_figure
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.scenario import CommandProfile, Scenario

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
    inside = [Path(file).name for file in found["files"] if file.startswith("out")]
    assert json.loads((tmp_path / "out" / "score.json").read_text()) == {**found, "files": inside}
    again = recordings.read(
        tmp_path / "kept" / "hold.csv", limits=recordings.Limits.of_mjcf(RIG.joint_names, RIG.actuator_names)
    )
    assert again.position.shape == (len(again.time), 2) and again.notes["controller"] == "pid"


def test_a_run_that_diverges_keeps_what_there_is_and_says_why(ran: Ran, tmp_path: Path) -> None:
    wild = ("hold", "--model", "wild.xml", "-c", "own.py:Runaway", "--set", "duration=1", "--record", "kept")
    (tmp_path / "out").mkdir()
    for name in ("joints.png", "commands.png", "mine.txt"):
        (tmp_path / "out" / name).write_text("of another run")
    (tmp_path / "out" / "score.json").write_text('{"files": ["joints.png", "commands.png"]}')
    code, out, err = ran(*wild, "--json", "--output", "out", "--force")
    assert code == 3 and "the simulation diverged" in err
    found = json.loads(out)
    assert "diverged" in found["failure"] and found["failure"] in err
    assert (found["scenario"], found["controller"]) == ("hold", "own.py:Runaway")
    assert files(tmp_path / "out") == {"score.json", "series.csv", "mine.txt"}
    assert json.loads((tmp_path / "out" / "score.json").read_text()) == {**found, "files": ["series.csv"]}
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
    code, _, err = ran(*short, "--no-figures")
    assert code == 2 and "out: holds the results of an earlier run (score.json); expected another folder" in err
    assert "series.csv" in files(tmp_path / "out")
    assert ran(*short, "--no-figures", "--force")[0] == 0
    assert files(tmp_path / "out") == {"score.json"}


def test_every_run_has_its_own_folder_and_its_own_recording(ran: Ran, tmp_path: Path) -> None:
    short = ("hold", "--model", "pendulum.xml", "--set", "duration=0.1", "--no-figures", "--record", "kept")
    for seed in range(3):
        assert ran(*short, "--seed", str(seed))[0] == 0
    folders = sorted((tmp_path / "results" / "run").iterdir())
    assert [own.name for own in folders] == ["hold-pid", "hold-pid-2", "hold-pid-3"]
    assert [json.loads((own / "score.json").read_text())["seed"] for own in folders] == [0, 1, 2]
    assert files(tmp_path / "kept") == {"hold.csv", "hold-2.csv", "hold-3.csv"}
    assert ran(*short, "--seed", "7", "--force")[0] == 0
    assert len(list((tmp_path / "results" / "run").iterdir())) == 3
    assert json.loads((folders[0] / "score.json").read_text())["seed"] == 7
    assert len(files(tmp_path / "kept")) == 4, "a trial is one more, whatever else is replaced"
    (tmp_path / "film.gif").write_text("mine")
    code, _, err = ran(*short, "--video", "film.gif")
    assert code == 2 and "film.gif: is there already; expected another name, or --force to replace it" in err
    assert (tmp_path / "film.gif").read_text() == "mine"


def test_a_video_of_an_xml_robot_is_written(ran: Ran, tmp_path: Path) -> None:
    code, out, _ = ran("hold", "--model", "rig.xml", "--video", "film.gif", "--set", "duration=0.3", "--json")
    assert code == 0 and "film.gif" in json.loads(out)["files"]
    with Image.open(tmp_path / "film.gif") as image:
        assert image.n_frames == 6  # type: ignore[attr-defined]


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


MUSCLE = (
    pendulum(body='<site name="end" pos="0.05 0 -0.1"/>', head="", drive="")
    .replace("<worldbody>", '<worldbody><site name="root" pos="0.05 0 0.1"/>')
    .replace(
        "<actuator></actuator>",
        '<tendon><spatial name="t"><site site="root"/><site site="end"/></spatial></tendon>'
        '<actuator><muscle name="flexor" tendon="t" force="300" lengthrange="0.1 0.4"/></actuator>',
    )
)


def test_who_cannot_drive_a_robot_is_told_with_what_stands_in_the_way() -> None:
    model = Model(MjcfRobot("limb", MUSCLE))
    for name in ("pid", "open_loop"):
        said = refusal(lambda name=name: workflow.run_scenario("hold", name, model=model))
        assert f"{name} computes with exact equations of motion, which cannot hold the muscle 'flexor' of limb" in said
        assert said.endswith("those that can drive it: sampling")
    assert compared_controllers(model.robot) == ("sampling",)
    scenario = workflow.load_scenario("hold", model.robot, search=False)
    played = replace(scenario, commands=CommandProfile([0.0], [[0.2]]), duration=0.1)
    assert workflow.run_scenario(played, "open_loop", model=model).run.command[-1] == 0.2


# --- options of scenarios -----------------------------------------------------------------------------------------


def built(name: str, robot: Robot, **options: str) -> Scenario:
    return workflow.load_scenario(name, robot, options=options, search=False)


SERVO = MjcfRobot(
    "servo",
    pendulum(
        'range="-1.5 1.5" limited="true"',
        drive='<position name="goal" joint="pivot" kp="40" ctrlrange="-1.57 1.57" forcerange="-6 6"/>',
    ),
)
WEAK = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1 1"/>'))


@pytest.mark.parametrize(
    ("name", "robot", "options", "said"),
    [
        ("multisine", RIG, {"period": "0"}, "period 0 s; expected 0 < duration and 0 < 1/period <= high"),
        ("track", RIG, {"waypoints": ";"}, "waypoints are ';', expected poses such as 'elbow=30; elbow=0'"),
        ("track", RIG, {"duration": "1"}, "the scored window 2 to 8 s holds no samples of the first 1 s"),
        ("track", WEAK, {"waypoints": "pivot=0; pivot=80; pivot=5"}, "pivot cannot be held at 80°"),
        ("chirp", RIG, {"mean": "20"}, "mean is of robots whose pressures sweep; rig sweeps its joints, see swing"),
        (
            "chirp",
            nominal_leg(),
            {"swing": "5"},
            "swing is of robots whose joints sweep; nominal_leg sweeps its pressu",
        ),
        ("hold", SERVO, {"pivot": "120"}, "servo: a pose to be held has pivot at 120.0°, outside the joint's range of"),
    ],
    ids=lambda value: value if isinstance(value, str) else getattr(value, "name", ""),
)
def test_options_that_cannot_be_are_told_before_a_run(
    name: str, robot: Robot, options: dict[str, str], said: str
) -> None:
    assert said in refusal(lambda: built(name, robot, **options))


def test_a_path_of_one_row_is_told(tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("time,pos.shoulder,pos.reach\n0,0,0\n")
    said = refusal(lambda: built("track", RIG, file=str(tmp_path / "one.csv")))
    assert "one.csv: there is one row, expected a path of at least two" in said


def test_a_force_the_wrong_way_is_told_with_its_sign() -> None:
    narrow = MjcfRobot(
        "narrow", pendulum(drive='<position name="goal" joint="pivot" kp="40" ctrlrange="-0.2 0.2" forcerange="-6 6"/>')
    )
    said = refusal(lambda: built("hold", narrow, pivot="60"))
    assert "takes 2.55 N·m: its actuators exert -6 N·m at most" in said


def test_a_swing_along_a_path_is_made_smaller_where_actuators_cannot_do_as_much() -> None:
    path = built("track", WEAK, swing="60")
    most = max(abs(float(path.reference.position(time)[0])) for time in np.arange(0, 8, 0.05))
    assert 0.1 < most < np.arcsin(1 / 2.943)


def test_sines_of_many_joints_are_no_faster_than_was_asked_for() -> None:
    joints = 5
    links = "".join(
        f'<body name="b{k}"><joint name="j{k}" type="slide" axis="1 0 0"/>'
        '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
        for k in range(joints)
    )
    drives = "".join(f'<motor joint="j{k}"/>' for k in range(joints))
    robot = MjcfRobot(
        "many",
        f"<mujoco><worldbody>{links}{'</body>' * joints}</worldbody><actuator>{drives}</actuator></mujoco>",
    )
    scenario = built("multisine", robot, high="0.3", duration="60")  # three multiples of a tenth of a hertz
    times = 1.0 + np.arange(0, 50, 0.05)  # three of the periods of 16.7 s
    values = np.array([scenario.reference.position(float(time)) for time in times])
    power = np.abs(np.fft.rfft(values - values.mean(axis=0), axis=0)) ** 2
    frequencies = np.fft.rfftfreq(len(times), 0.05)
    assert np.all(power[frequencies > 0.31].sum(axis=0) < 1e-3 * power.sum(axis=0))
    assert len(set(power.argmax(axis=0))) == joints


def test_a_joint_that_is_called_like_an_option_has_a_name_of_its_own() -> None:
    robot = MjcfRobot("odd", pendulum().replace("pivot", "duration"))
    scenario = built("hold", robot, **{"pos.duration": "30", "option.duration": "3"})
    assert scenario.duration == 3.0 and scenario.reference.position(0.0) == pytest.approx([np.pi / 6])
    said = refusal(lambda: built("hold", robot, duration="3"))
    assert "expected option.duration or pos.duration" in said
    assert "there is no option 'option.keyframe'" in refusal(lambda: built("hold", robot, **{"option.keyframe": "a"}))


# --- what people look at ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_table_that_would_be_too_wide_has_the_worst_joint_and_whole_names() -> None:
    found = workflow.compare(
        ["hold"], under=["nominal", "unmodelled_delay"], model=Model(RIG), scenario_options={"duration": "0.3"}
    )
    shown = {}
    for width in (60, 80, 120):
        out = StringIO()
        Console(file=out, width=width).print(comparison_table(found))
        shown[width] = out.getvalue()
        assert "…" not in shown[width] and " pid " in shown[width]
    assert "shoulder, mrad" in shown[120] and "reach, mm" in shown[120] and "unmodelled_delay" in shown[120]
    assert "step, ms" in shown[120] and "step, ms" not in shown[60]
    assert "worst joint" in shown[60] and "shoulder, mrad" not in shown[60]
    assert all("unmodelled_delay" in shown[k] and " sampling " in shown[k] for k in shown)


def test_the_legend_of_commands_has_limits_where_they_are_in_view() -> None:
    wide = MjcfRobot("wide", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1000 1000"/>'))
    labels = []
    for robot in (wide, WEAK):
        done = workflow.run_scenario("hold", model=Model(robot), options={"pivot": "15", "duration": "0.3"})
        (legend,) = commands_figure(done.run, done.score, "").legends or [None]
        labels.append([] if legend is None else [text.get_text() for text in legend.get_texts()])
    assert labels[0] == [] and "beyond the limits" in labels[1]


def test_a_base_whose_motion_recordings_tell_is_refused_by_a_run_as_such(ran: Ran, tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(
        '<mujoco model="floater"><worldbody><body name="trunk"><freejoint name="root"/><geom size="0.1"/>'
        '<body name="leg" pos="0 0 -0.2"><joint name="hip" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>'
        '<actuator><motor name="m" joint="hip"/></actuator></mujoco>'
    )
    code, _, err = ran("hold", "--model", "free.xml")
    assert code == 2 and "from recordings by --prescribe root" in err
    code, _, err = ran("hold", "--model", "free.xml", "--prescribe", "root")
    assert code == 2 and "root.turn_x is an input from recordings, which a run does not have" in err


# --- what a robot's description asks of scenarios ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"push": {"torqe": 0.4}}, "scenarios.push: there is no option 'torqe'; did you mean 'torque'?"),
        ({"push": {"torque": "much"}}, "scenarios.push: option torque is 'much', expected float"),
        ({"puhs": {"torque": 0.4}}, "scenarios: there is no scenario 'puhs'; did you mean 'push'?"),
    ],
)
def test_what_a_description_misspells_of_scenarios_is_told(table: dict[str, dict[str, float | str]], said: str) -> None:
    assert said in refusal(lambda: built("push", replace(nominal_leg(), scenarios=table)))
