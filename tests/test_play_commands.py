"""Commands from files, played by the scenario ``commands``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hardware_rig import DT, MODEL, MemoryWire, patient
from mjcf_models import CRANE, RIG, pendulum, refusal

import equimus_ctrl as eq
from equimus_ctrl import recordings, workflow
from equimus_ctrl.effects import PayloadMass
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.recordings import CommandFile, read_commands, write_commands
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

LEG = eq.nominal_leg()
FINGER = workflow.load_model(Path(__file__).parents[1] / "docs" / "examples" / "finger.toml").robot
FREE = MjcfRobot("free", pendulum())
SERVO = MjcfRobot(
    "servo", pendulum('damping="0.6"', drive='<position name="goal" joint="pivot" kp="60" kv="1" ctrlrange="-1 1"/>')
)
EVERY: tuple[tuple[Robot, float, float], ...] = (
    (LEG, 9e3, 12e3), (FINGER, 0.0, 2e4), (FREE, 0.4, 0.8), (SERVO, 0.0, 0.3), (CRANE, 0.0, 0.2), (RIG, 0.0, 0.3),
)  # fmt: skip


def file_of(tmp_path: Path, robot: Robot, rows: str, notes: str = "") -> str:
    header = ",".join(["time", *(f"cmd.{name}" for name in robot.actuator_names)])
    path = tmp_path / "design.csv"
    path.write_text(f"{notes}{header}\n{rows}")
    return str(path)


def steps(robot: Robot, first: float, then: float) -> str:
    return "".join(
        ",".join([str(time), *[str(value)] * len(robot.actuator_names)]) + "\n"
        for time, value in ((3.0, first), (3.25, then), (3.5, first), (3.75, first))
    )


def built(robot: Robot, file: str, **more: str) -> eq.Scenario:
    return workflow.load_scenario("commands", robot, options={"file": file, **more}, search=False)


@pytest.mark.parametrize(("robot", "first", "then"), EVERY, ids=[own.name for own, *_ in EVERY])
def test_every_robot_begins_at_rest_and_is_commanded_what_the_file_says(
    robot: Robot, first: float, then: float, tmp_path: Path
) -> None:
    scenario = built(robot, file_of(tmp_path, robot, steps(robot, first, then)))
    assert scenario.duration == 0.75 and scenario.controller == "open_loop"
    done = eq.run_scenario(scenario, model=Model(robot), record=tmp_path / "done.csv")
    time, command = done.run.time, done.run.command
    assert np.all(command[time < 0.2499] == first) and np.all(command[(time > 0.2501) & (time < 0.4999)] == then)
    before = time < 0.25
    np.testing.assert_allclose(done.run.position[before], np.tile(scenario.reference.position(0.0), (before.sum(), 1)),
                               atol=2e-3)  # fmt: skip
    assert np.abs(done.run.position[~before] - done.run.position[0]).max() > 3e-3
    again = built(robot, str(tmp_path / "done.csv"))  # a recording's commands can be played too
    assert again.commands is not None and np.all(again.commands.at(0.3) == then)


def test_the_reference_is_where_the_robot_would_rest(tmp_path: Path) -> None:
    scenario = built(LEG, file_of(tmp_path, LEG, steps(LEG, 9e3, 12e3)))
    kinematics = eq.Kinematics(LEG)
    for time, value in ((0.0, 9e3), (0.25, 12e3), (0.5, 9e3)):
        np.testing.assert_allclose(scenario.reference.position(time), kinematics.equilibrium([value] * 2), atol=1e-8)
    wild = built(FREE, file_of(tmp_path, FREE, steps(FREE, 0.5, 9.0)))
    assert wild.reference.position(0.3) == pytest.approx(rest_pose(Model(FREE), [0.5]))


def test_a_robot_without_rest_says_so_and_begins_where_notes_say(tmp_path: Path) -> None:
    file = file_of(tmp_path, FREE, steps(FREE, 5.0, 4.0))
    assert (
        "free: rests in no pose under commands of (5) N·m; expected a first command under which it rests, or notes "
        "start.pos.JOINT that say where it begins"
    ) in refusal(lambda: built(FREE, file))
    noted = built(FREE, file_of(tmp_path, FREE, steps(FREE, 5.0, 4.0), "# start.pos.pivot = 0.3\n"))
    assert noted.start.position is not None and noted.start.position.tolist() == [0.3]
    assert eq.run_scenario(noted, model=Model(FREE)).run.position[0].tolist() == [0.3]


def test_what_was_commanded_before_counts(tmp_path: Path) -> None:
    scenario = built(FREE, file_of(tmp_path, FREE, steps(FREE, 1.0, 1.0), "# before.cmd.motor = -0.5\n"))
    done = eq.run_scenario(scenario, model=Model(FREE))
    assert done.run.position[0] == pytest.approx(rest_pose(Model(FREE), [-0.5]))
    assert done.run.before.tolist() == [-0.5] and done.run.command[0].tolist() == [1.0]


def test_lines_are_followed(tmp_path: Path) -> None:
    scenario = built(FREE, file_of(tmp_path, FREE, "0,0\n1,1\n2,0\n", "# interpolation = linear\n"))
    assert scenario.commands is not None
    assert [float(scenario.commands.at(t)[0]) for t in (0.0, 0.25, 1.0, 1.5, 5.0)] == [0.0, 0.25, 1.0, 0.5, 0.0]


def test_what_is_known_to_be_different_is_simulated_and_recorded(tmp_path: Path) -> None:
    notes = "# payload.tip = 0.4\n# times.pivot.armature = 2\n# source = made up\n"
    scenario = built(FREE, file_of(tmp_path, FREE, steps(FREE, 0.5, 0.9), notes))
    done = eq.run_scenario(scenario, model=Model(FREE), record=tmp_path / "done.csv")
    other = FREE.with_parameters({"pivot.armature": 2 * FREE.parameters()["pivot.armature"]})
    loaded = Model(other, (PayloadMass("tip", 0.4),))
    plain = built(other, file_of(tmp_path, other, steps(other, 0.5, 0.9)))
    same = eq.run_scenario(plain, model=loaded)
    np.testing.assert_allclose(done.run.position, same.run.position, atol=1e-12)
    kept = recordings.read(tmp_path / "done.csv", limits=recordings.Limits.of_mjcf(("pivot",), ("motor",))).notes
    assert kept["payload.tip"] == "0.4" and kept["times.pivot.armature"] == "2" and "source" not in kept


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,cmd.maa\n0,1\n1,1\n", "row 1: there is no column 'cmd.baa'; expected time, cmd.maa, cmd.baa"),
        ("time,cmd.maa,cmd.baa,cmd.bba\n0,1,1,1\n", "row 1: there is no actuator 'bba'; did you mean 'baa'?"),
        ("time,cmd.maa,cmd.baa\n0,1,1\n", "row 2, column time: this is the only row"),
        ("time,cmd.maa,cmd.baa\n0,1,1\n0,2,2\n", "row 3, column time: 0 s does not come after 0 s"),
        ("time,cmd.maa,cmd.baa\n0,1,1\n1,60000,2\n", "row 3, column cmd.maa: 60000 lies outside the range of commands"),
        ("time,cmd.maa,cmd.baa\n0,1,one\n1,1,1\n", "row 2, column cmd.baa: 'one' is not a number"),
        ("# before.cmd.maa = 1\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "note 'before.cmd.baa' is missing"),
        ("# before.cmd.maa = -1\n# before.cmd.baa = 0\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n",
         "note before.cmd.maa: -1 lies outside the range of commands, 0 to 50000"),
        ("# start.pos.hip = 1\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "note 'start.pos.knee' is missing"),
        ("# start.pos.hpi = 1\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "there is no joint 'hpi'; did you mean 'hip'?"),
        ("# start.pos.hip = up\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "note start.pos.hip is 'up', expected a finite"),
        ("# start.pos.hip = 9\n# start.pos.knee = 0\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "begins with hip at 515.7°"),
        ("# set.mass = 9\ntime,cmd.maa,cmd.baa\n0,1,1\n1,1,1\n", "note set.mass: there is no parameter 'mass'"),
        ("", "the file is empty"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_by_file_and_place(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "design.csv"
    path.write_text(text)
    told = refusal(lambda: built(LEG, str(path)))
    assert said in told and "design.csv" in told


def test_without_a_file_there_is_nothing_to_play() -> None:
    assert "expected file=FILE.csv" in refusal(lambda: workflow.load_scenario("commands", LEG, search=False))
    assert "there is no such file" in refusal(lambda: built(LEG, "nowhere.csv"))


def test_what_is_written_is_read_back_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    given = CommandFile(
        np.r_[0.0, np.sort(rng.random(20))], rng.random((21, 2)), rng.random(2), rng.random(2), True, {"set.m": "1e-3"}
    )
    path = tmp_path / "out.csv"
    write_commands(path, ("a", "b"), given, ("p", "q"))
    found = read_commands(path, ("a", "b"), ("p", "q"), np.zeros(2), np.ones(2))
    for key in ("times", "values", "before", "position"):
        assert np.array_equal(getattr(found, key), getattr(given, key))
    assert found.linear and found.different == given.different


@pytest.mark.real_time
def test_a_real_robots_recording_says_what_is_known_to_be_different(
    wires: Callable[..., MemoryWire], tmp_path: Path
) -> None:
    file = file_of(tmp_path, LEG, "0,3000,3000\n0.1,5000,3000\n0.3,3000,3000\n", "# payload.foot = 0.1\n")
    plant = HardwarePlant(
        MODEL, patient(), armed=True, transport=wires(), record=tmp_path / "real.csv", notes={"payload.foot": "0.1"}
    )
    done = eq.run_scenario(built(LEG, file), plant=plant, model=MODEL)
    assert len(done.run.time) == round(0.3 / DT)
    kept: Recording = recordings.read(tmp_path / "real.csv")
    assert kept.notes["payload.foot"] == "0.1" and kept.notes["plant"] == "hardware"
