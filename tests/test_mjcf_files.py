"""Files of MJCF robots: what is saved comes back, and what is written moves alike."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mjcf_models import ARM, CRANE, PENDULUM, corrected_xml, pendulum, refusal

from equimus_ctrl.effects import (
    ActuatorGain,
    AsymmetricDamping,
    AsymmetricFriction,
    Backlash,
    ConstantForce,
    CoulombFriction,
    DriveCompliance,
    DrivePlay,
    Effect,
    FirstOrderLag,
    GravityTilt,
    LoadFriction,
    ParallelSpring,
    PayloadMass,
    PayloadOffCentre,
    QuadraticDamping,
    SensorDelay,
    SensorOffset,
    StribeckFriction,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
)
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import FORMAT, Model, model_from_dict, model_to_dict
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import load_mjcf, load_model, save_model
from equimus_ctrl.workflow.exports import write_corrected


def driven(robot: MjcfRobot, until: float = 1.0) -> Trial:
    """Commands that jump on the physics' grid, and a start away from rest."""
    times = np.arange(0.0, until - 0.05, 0.125)
    k, i = np.meshgrid(np.arange(len(times)), np.arange(len(robot.actuators)), indexing="ij")
    commands = np.round(1.5 * np.sin(1.7 * k + i), 3) / (1 + 2 * i)
    start = np.linspace(0.4, 0.1, len(robot.joints))
    return Trial("t", times, commands, commands[0], 0.0, start, np.arange(0.0, until + 1e-9, 0.025))


def moved(model: Model, trial: Trial | None = None) -> Array:
    robot = model.robot
    assert robot is not None
    found = simulate_mjcf([model], [trial or driven(robot)], threads=1)[0]
    assert found.sound.all()
    return found.position[0]


def stepped(model: Any, robot: MjcfRobot, trial: Trial) -> Array:
    """The same trial, by MuJoCo alone."""
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in robot.joint_names]
    for joint, q in zip(joints, trial.position, strict=True):
        data.qpos[joint.qposadr[0]] = q
        if any(model.joint(k).name == f"{joint.name} drive" for k in range(model.njnt)):
            data.qpos[model.joint(f"{joint.name} drive").qposadr[0]] = q
    order = [model.actuator(name).id for name in robot.actuator_names]
    for i, before in zip(order, trial.before, strict=True):
        if model.actuator_actadr[i] >= 0:
            data.act[model.actuator_actadr[i]] = before
        if n := model.actuator_history[i, 0]:
            past = np.arange(-n, 0) * model.opt.timestep
            mujoco.mj_initCtrlHistory(model, data, i, past, np.full((n, 1), before))
    out = [[data.qpos[joint.qposadr[0]] for joint in joints]]
    every = round((trial.sample_times[1] - trial.sample_times[0]) / model.opt.timestep)
    for k in range((len(trial.sample_times) - 1) * every):
        row = np.searchsorted(trial.times, (k + 0.5) * model.opt.timestep, side="right") - 1
        data.ctrl[order] = trial.commands[row]
        mujoco.mj_step(model, data)
        if (k + 1) % every == 0:
            out.append([data.qpos[joint.qposadr[0]] for joint in joints])
    return np.array(out)


@pytest.fixture
def crane_file(tmp_path: Path) -> Path:
    path = tmp_path / "robots" / "robot.xml"
    path.parent.mkdir()
    path.write_text(ARM)
    return path


HELD: dict[str, tuple[Effect, ...]] = {
    "nothing": (),
    "viscous_friction": (ViscousFriction("shoulder", 0.8),),
    "quadratic_damping": (QuadraticDamping("reach", 20.0),),
    "coulomb_friction": (CoulombFriction("reach", 0.6),),
    "asymmetric_friction": (AsymmetricFriction("shoulder", 1.2, 0.3),),
    "parallel_spring": (ParallelSpring("shoulder", 3.0, -0.4), ParallelSpring("reach", 30.0, 0.3)),
    "constant_force": (ConstantForce("reach", 2.5),),
    "constant_force of servos": (ConstantForce("shoulder", 1.0),),
    "payload_mass": (PayloadMass("tip", 0.7), PayloadMass("arm", 0.4)),
    "payload_off_centre": (PayloadOffCentre("rod", 0.5, 0.1, 0.05, -0.1),),
    "actuator_gain": (ActuatorGain("servo", 0.6), ActuatorGain("drive", 1.5)),
    "torque_saturation": (TorqueSaturation("servo", 1.5),),
    "joint_compliance": (DriveCompliance("shoulder", 60.0, 0.3),),
    "drive_play": (DrivePlay("reach", 0.02),),
    "gravity_tilt": (GravityTilt("base", 0.3),),
    "transport_delay": (TransportDelay("servo", 0.05), TransportDelay("drive", 0.0333)),
}
HELD["all of them"] = tuple(
    effect
    for name, effects in HELD.items()
    if name not in ("asymmetric_friction", "constant_force of servos", "payload_off_centre", "drive_play")
    for effect in effects
)
"""Without those that can stand beside no other there, or need a drive at a joint whose drive gives way."""


@pytest.mark.parametrize("name", HELD)
def test_a_saved_model_comes_back_and_its_xml_moves_like_it(name: str, crane_file: Path, tmp_path: Path) -> None:
    robot = load_mjcf(crane_file).with_parameters({"arm.mass": 2.25, "reach.damping": 2.0, "tilt": 0.05})
    model = Model(robot, HELD[name])
    path = tmp_path / "found" / "deep" / "model.toml"
    assert save_model(path, model, crane_file) == [path, path.with_suffix(".xml")]
    back = load_model(path)
    assert back.parameters() == model.parameters() and back.effects == model.effects and back.name == "crane"
    np.testing.assert_array_equal(moved(back), moved(model))
    text = path.read_text()
    assert 'mjcf = "../../robots/robot.xml"' in text and "model.xml has all of this in one MuJoCo model." in text
    written = mujoco.MjModel.from_xml_path(str(path.with_suffix(".xml")))
    trial = driven(robot)
    own = stepped(written, robot, trial)
    plain = moved(Model(robot))
    # Six digits are written of each number.
    np.testing.assert_allclose(own, moved(model), rtol=0, atol=2e-5)
    assert name == "nothing" or np.abs(own - plain).max() > 2e-3


def test_all_numbers_that_were_found_are_in_the_xml(crane_file: Path, tmp_path: Path) -> None:
    """To the six digits that are written; what gravity leans by is in its direction, how mass is spread in the inertia."""
    robot = load_mjcf(crane_file)
    kept = "tilt", *SHAPE
    changed = {name: 1.2345 * value + 0.0123 for name, value in robot.parameters().items() if not name.endswith(kept)}
    model = Model(robot.with_parameters(changed))
    save_model(tmp_path / "found.toml", model, crane_file)
    again = load_mjcf(tmp_path / "found.xml").parameters()
    there = dict.fromkeys(robot.parameters(), 0.0) | changed
    assert again == {name: pytest.approx(value, rel=1e-5) for name, value in there.items()}
    np.testing.assert_array_equal(moved(load_model(tmp_path / "found.toml")), moved(model))


@pytest.mark.parametrize("tau", [0.08, 0.0])
@pytest.mark.parametrize("late", [(), (TransportDelay("servo", 0.02),)], ids=["prompt", "late"])
def test_a_lag_is_a_filter_of_the_actuator(late: tuple[Effect, ...], tau: float, crane_file: Path) -> None:
    """MuJoCo's is half a step from the mean over a step, and as prompt as the command where it takes no time."""
    robot = load_mjcf(crane_file)
    lag = FirstOrderLag("servo", tau)
    xml, left = corrected_xml(Model(robot, (lag, *late)))
    assert left == ()
    trial = replace(driven(robot), before=np.zeros(len(robot.actuators)))
    own = stepped(mujoco.MjModel.from_xml_string(xml), robot, trial)
    off = np.abs(own - moved(Model(robot, (lag, *late)), trial)).max()
    changed = np.abs(own - moved(Model(robot, late), trial)).max()
    assert off < (0.02 * changed if tau else 2e-5)
    again = MjcfRobot("again", xml)
    assert again.parameters()["servo.time_constant"] == pytest.approx(tau)
    np.testing.assert_allclose(moved(Model(again), trial), own, rtol=0, atol=2e-5)


def test_what_xml_has_no_field_for_is_told(crane_file: Path, tmp_path: Path) -> None:
    effects = (
        ViscousFriction("reach", 1.0), FirstOrderLag("servo", 0.1), StribeckFriction("reach", 0.1, 0.2, 0.1),
        AsymmetricDamping("shoulder", 0.1), LoadFriction("shoulder", 0.1), SensorOffset("shoulder", 0.1),
        Backlash("reach", 0.01), TransportDelay("drive", 1e-5), SensorDelay("reach", 1e-5),
    )  # fmt: skip
    model = Model(load_mjcf(crane_file), effects)
    told = [f"{e.name} at {e.location}" for e in effects[2:]]
    xml, left = corrected_xml(model)
    assert list(left) == told and f"<!-- Not in here: {', '.join(told)}. -->" in xml
    assert not mujoco.MjModel.from_xml_string(xml).actuator_delay.any()
    save_model(tmp_path / "m.toml", model, crane_file)
    assert f"m.xml has all of this in one MuJoCo model, but for {', '.join(told)}." in (tmp_path / "m.toml").read_text()
    assert write_corrected(tmp_path / "again.xml", model) == left
    assert load_model(tmp_path / "m.toml").effects == effects


@pytest.mark.parametrize("late", [0.0333, 0.05])
@pytest.mark.parametrize("own", [True, False], ids=["sensor of the XML", "new sensor"])
def test_a_late_measurement_is_a_sensor_with_a_delay(own: bool, late: float) -> None:
    """MuJoCo's sensor shows what the package's simulation says that the recording would show."""
    sensor = '<sensor><jointpos name="encoder" joint="shoulder"/></sensor></mujoco>'
    robot = replace(CRANE, xml=ARM.replace("</mujoco>", sensor)) if own else CRANE
    model = Model(robot, (SensorDelay("shoulder", late),))
    xml, left = corrected_xml(model)
    assert left == ()
    written, trial = mujoco.MjModel.from_xml_string(xml), driven(robot)
    assert [written.sensor(k).name for k in range(written.nsensor)] == ["encoder" if own else "pos.shoulder"]
    data, step = mujoco.MjData(written), written.opt.timestep
    data.qpos[:] = trial.position
    past = np.arange(-written.sensor_history[0, 0], 0) * step
    mujoco.mj_initSensorHistory(written, data, 0, past, np.full((len(past), 1), trial.position[0]), 0.0)
    order, shown = [written.actuator(name).id for name in robot.actuator_names], []
    for k in range(round(trial.sample_times[-1] / step)):
        data.ctrl[order] = trial.commands[np.searchsorted(trial.times, (k + 0.5) * step, side="right") - 1]
        mujoco.mj_step(written, data)
        shown.append(data.sensordata[0])  # of the beginning of the step
    every = round((trial.sample_times[1] - trial.sample_times[0]) / step)
    found = np.array(shown)[::every]
    np.testing.assert_allclose(found, moved(model, trial)[: len(found), 0], rtol=0, atol=2e-5)
    assert np.abs(found - moved(Model(robot), trial)[: len(found), 0]).max() > 0.02


LIMITED = (
    '<general name="m" joint="pivot" gainprm="2" biastype="affine" biasprm="0.1 -1 0" gear="-3" forcerange="-0.3 0.2"/>'
)
NOT_HELD = {
    "springs are off": (pendulum(option='<flag spring="disable"/>'), ParallelSpring("pivot", 1.0, 0.3)),
    "a curved spring": (pendulum('stiffness="1 0.3"'), ParallelSpring("pivot", 1.0, 0.3)),
    "a limited joint": (pendulum('actuatorfrclimited="true" actuatorfrcrange="-1 1"'), ConstantForce("pivot", 0.5)),
    "actuators are off": (pendulum(option='<flag actuation="disable"/>'), ConstantForce("pivot", 0.5)),
    "asymmetric at a limited joint": (
        pendulum('actuatorfrclimited="true" actuatorfrcrange="-1 1"'), AsymmetricFriction("pivot", 0.5, 0.1),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_HELD)
def test_what_a_joint_cannot_take_stays_out_of_its_fields(name: str) -> None:
    text, effect = NOT_HELD[name]
    robot = MjcfRobot("p", text)
    assert corrected_xml(Model(robot, (effect,)))[1] == (f"{effect.name} at pivot",)
    plain, written = (
        mujoco.MjModel.from_xml_string(corrected_xml(model)[0]) for model in (Model(robot), Model(robot, (effect,)))
    )
    for field in ("jnt_stiffness", "qpos_spring", "actuator_biasprm", "dof_frictionloss"):
        np.testing.assert_array_equal(getattr(written, field), getattr(plain, field))


def test_a_constant_force_is_none_of_a_limited_drive() -> None:
    """The drive may exert as much as before beside it."""
    robot = MjcfRobot("p", pendulum(drive=LIMITED))
    model = Model(robot, (ConstantForce("pivot", 0.8),))
    xml, left = corrected_xml(model)
    written, trial = mujoco.MjModel.from_xml_string(xml), driven(robot)
    assert left == ()
    np.testing.assert_allclose(written.actuator_forcerange[0], [-0.3 - 0.8 / 3, 0.2 - 0.8 / 3], rtol=1e-5)
    np.testing.assert_allclose(stepped(written, robot, trial), moved(model, trial), rtol=0, atol=2e-5)
    np.testing.assert_allclose(moved(Model(MjcfRobot("again", xml)), trial), moved(model, trial), rtol=0, atol=2e-5)


def test_the_xml_is_found_beside_the_model_file_from_anywhere(
    crane_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = crane_file.parent / "model.toml"
    beside.write_text('mjcf = "robot.xml"\nname = "left crane"\n[parameters]\n"arm.mass" = 3\n')
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    model = load_model(os.path.relpath(beside))
    assert model.name == "left crane" and model.parameters()["arm.mass"] == 3
    assert model.parameters()["rod.mass"] == 0.5
    beside.write_text(f'mjcf = "{crane_file}"\n')
    assert load_model(beside).name == "crane"


def test_a_model_that_is_saved_again_still_finds_its_xml(crane_file: Path, tmp_path: Path) -> None:
    model = Model(load_mjcf(crane_file), (ViscousFriction("reach", 1.0),))
    first, second = tmp_path / "a" / "one.toml", tmp_path / "b" / "c" / "two.toml"
    save_model(first, model, crane_file)
    save_model(second, load_model(first), first)
    assert load_model(second).parameters() == model.parameters()


def test_saving_beside_the_xml_leaves_it_as_it_is(crane_file: Path) -> None:
    """The corrected XML must not take the place of the one that the model file changes."""
    model = Model(load_mjcf(crane_file), (PayloadMass("tip", 0.7),))
    save_model(crane_file.with_suffix(".toml"), model, crane_file)
    assert crane_file.read_text() == ARM
    np.testing.assert_array_equal(moved(load_model(crane_file.with_suffix(".toml"))), moved(model))


def test_an_xml_of_somebody_else_stays(crane_file: Path, tmp_path: Path) -> None:
    model = Model(load_mjcf(crane_file), (PayloadMass("tip", 0.7),))
    (tmp_path / "keep.xml").write_text("<mujoco/>")
    assert save_model(tmp_path / "keep.toml", model, crane_file)[1].name == "keep_whole.xml"
    assert (tmp_path / "keep.xml").read_text() == "<mujoco/>"
    for _ in range(2):  # what was written together is written again
        assert save_model(tmp_path / "own.toml", model, crane_file)[1].name == "own.xml"


def test_a_model_is_its_dictionary() -> None:
    model = Model(CRANE.with_parameters({"arm.mass": 3.0}), (TransportDelay("push", 0.05),))
    data = model_to_dict(model)
    assert data == {
        "format": FORMAT,
        "name": "crane",
        "mjcf": "crane.xml",
        "parameters": {"arm.mass": 3.0},
        "effects": [{"effect": "transport_delay", "location": "push", "delay": 0.05}],
    }
    asked: list[str] = []

    def read(name: str, edits: Edits) -> MjcfRobot:
        assert not edits
        asked.append(name)
        return CRANE

    back = model_from_dict(data, "m.toml", read)
    assert asked == ["crane.xml"]
    assert back.parameters() == model.parameters() and back.effects == model.effects


WRONG_FILES: dict[str, tuple[str, str]] = {
    'mjcf = "robto.xml"': ("there is no such file", "robto.xml"),
    "mjcf = 3": ("mjcf is 3, expected the name of an MJCF file", ""),
    'mjcf = "robot.xml"\nmorphology = "nominal_leg"': ("there is no key 'morphology'", "known: effects, format, ignore, lock, mjcf"),
    'mjcf = "robot.xml"\nphase = "stance"': ("there is no key 'phase'", ""),
    'mjcf = "robot.xml"\nformat = "x"': (f"format is 'x', expected {FORMAT!r}", ""),
    'mjcf = "robot.xml"\nname = 3': ("name is 3, expected a text", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mas" = 1': ("no parameter 'arm.mas'; did you mean 'arm.mass'?", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mass" = "x"': ("parameters: arm.mass is 'x', expected a number", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mass" = -1': ("arm.mass is -1, expected a finite number of at least 0", ""),
    'mjcf = "robot.xml"\n[parameters]\narm.mass = 1': ("'arm' is a table; put a dotted name in quotes", ""),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "creep"\nlocation = "push"\nstiffness = 1\ntime_constant = 1': (
        "an MJCF robot cannot have effect creep", "",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "elbow"\ndamping = 1': (
        "effect viscous_friction: there is no joint 'elbow'", "known: reach, shoulder",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "reach"\ndampng = 1': (
        "there is no parameter 'dampng'; did you mean 'damping'?", "",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "reach"\ndamping = -1': (
        "damping is -1 N·m·s/rad, expected 0 to", "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG_FILES, ids=lambda text: re.sub(r"\W+", " ", text)[:60])
def test_what_is_wrong_in_a_model_file_is_said_with_its_name(text: str, crane_file: Path) -> None:
    path = crane_file.parent / "model.toml"
    path.write_text(text)
    told = refusal(lambda: load_model(path))
    assert told.startswith(f"{path}: ")
    assert all(part in told for part in WRONG_FILES[text])


def test_without_a_file_to_read_from_an_xml_cannot_be_named() -> None:
    assert "mjcf is 'robot.xml', expected" in refusal(lambda: model_from_dict({"mjcf": "robot.xml"}, "m"))


def test_an_xml_is_a_model_by_itself(crane_file: Path) -> None:
    model = load_model(crane_file)
    robot = model.robot
    assert robot is not None and robot.source == "robot.xml"
    assert model.effects == () and model.parameters() == CRANE.parameters()
    assert load_model(str(crane_file)).name == "crane"


def test_a_robot_without_a_name_is_called_after_its_file(tmp_path: Path) -> None:
    (tmp_path / "gripper.xml").write_text(pendulum().replace(' model="pendulum"', ""))
    assert load_model(tmp_path / "gripper.xml").name == "gripper"


def test_numbers_come_out_of_a_file_with_all_their_digits(tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(pendulum(inertial='mass="0.123456789" pos="0 0 -0.3" diaginertia="1 1 1"'))
    assert load_mjcf(tmp_path / "p.xml").parameters()["arm.mass"] == pytest.approx(0.123456789, rel=1e-12)


def test_included_files_are_read_into_one(tmp_path: Path) -> None:
    drive = '<actuator><motor name="motor" joint="pivot"/></actuator>'
    (tmp_path / "drive.xml").write_text(f"<mujocoinclude>{drive}</mujocoinclude>")
    (tmp_path / "p.xml").write_text(pendulum().replace(drive, '<include file="drive.xml"/>'))
    robot = load_mjcf(tmp_path / "p.xml")
    (tmp_path / "drive.xml").unlink()
    assert robot.actuator_names == ("motor",)
    assert replace(robot, name="copy").parameters() == PENDULUM.parameters()


SOLID = "v 0 0 0\nv .2 0 0\nv 0 .2 0\nv 0 0 .2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESHED = """<mujoco model="meshed"><compiler meshdir="parts"/><asset><mesh name="shape" file="shape.obj"/></asset>
  <worldbody><body name="arm"><joint name="pivot" axis="0 1 0" armature="0.01"/><geom type="mesh" mesh="shape"/></body>
  </worldbody><actuator><motor name="motor" joint="pivot"/></actuator></mujoco>"""


def test_meshes_are_kept_with_the_robot_and_found_from_what_is_saved(tmp_path: Path) -> None:
    (tmp_path / "robot" / "parts").mkdir(parents=True)
    (tmp_path / "robot" / "parts" / "shape.obj").write_text(SOLID)
    (tmp_path / "robot" / "meshed.xml").write_text(MESHED)
    model = load_model(tmp_path / "robot" / "meshed.xml")
    assert model.parameters()["arm.mass"] == pytest.approx(1000 * 0.2**3 / 6, rel=1e-5)
    softer = Model(model.robot, (DriveCompliance("pivot", 5.0, 0.1),))
    assert np.abs(moved(softer) - moved(model)).max() > 1e-3
    save_model(tmp_path / "found" / "new.toml", softer, tmp_path / "robot" / "meshed.xml")
    np.testing.assert_array_equal(moved(load_model(tmp_path / "found" / "new.toml")), moved(softer))
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "found" / "new.xml"))
    assert written.body("arm").mass[0] == pytest.approx(model.parameters()["arm.mass"], rel=1e-5)


def test_a_mesh_is_taken_from_where_mujoco_takes_it(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "shape.obj").write_text(SOLID)
    (tmp_path / "shape.obj").write_text(SOLID.replace(".2", ".4"))
    (tmp_path / "meshed.xml").write_text(MESHED)
    own = mujoco.MjModel.from_xml_path(str(tmp_path / "meshed.xml")).body("arm").mass[0]
    assert load_model(tmp_path / "meshed.xml").parameters()["arm.mass"] == pytest.approx(own, rel=1e-9)


def test_robots_that_differ_in_a_mesh_alone_are_two() -> None:
    small, large = (
        MjcfRobot("meshed", MESHED, {"shape.obj": SOLID.replace(".2", size).encode()}) for size in (".2", ".4")
    )
    assert large.parameters()["arm.mass"] == pytest.approx(8 * small.parameters()["arm.mass"], rel=1e-5)
    assert small.digest == replace(small, name="again").digest != large.digest


NAMELESS = '<body pos="0 0 -0.6"><inertial mass="0.3" pos="0 0 0" diaginertia="0.01 0.01 0.01"/></body>'


@pytest.mark.parametrize(
    "text",
    [
        pendulum(body=NAMELESS),
        pendulum(tail='<tendon><fixed stiffness="3"><joint joint="pivot" coef="1"/></fixed></tendon>'),
        pendulum()
        .replace('angle="radian"', 'angle="degree"')
        .replace("armature", 'springref="20" stiffness="3" armature'),
        pendulum(head='<default><joint damping="0.4" stiffness="2"/></default>'),
        pendulum(head='<default><geom mass="2"/></default>', body='<geom size="0.1"/>'),
        pendulum(head='<compiler inertiafromgeom="true"/>', body='<geom size="0.1" pos="0 0 -0.4"/>'),
        pendulum(tail='<keyframe><key name="home" qpos="0.1"/></keyframe>'),
    ],
    ids=[
        "nameless body",
        "nameless tendon",
        "degrees",
        "defaults",
        "geoms",
        "geoms' inertia",
        "keyframe",
    ],
)
@pytest.mark.parametrize("effect", [PayloadMass("tip", 0.5), DriveCompliance("pivot", 20.0, 0.1)], ids=lambda e: e.name)
def test_any_mjcf_robot_can_be_written(text: str, effect: Effect) -> None:
    model = Model(MjcfRobot("p", text), (effect,))
    robot = model.robot
    assert robot is not None
    xml, left = corrected_xml(model)
    assert left == ()
    trial = driven(robot)
    own = stepped(mujoco.MjModel.from_xml_string(xml), robot, trial)
    np.testing.assert_allclose(own, moved(model, trial), rtol=0, atol=2e-5)
    assert np.abs(own - moved(Model(robot), trial)).max() > 1e-3
