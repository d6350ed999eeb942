"""A free base whose measured pose is an input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import corrected_xml, refusal
from scipy.spatial.transform import Rotation

from equimus_ctrl import workflow
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.recordings.smoothing import smoothed
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.free_base import POSE, joints_of, part, positions, sequence_for
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

FLYER = """<mujoco model="flyer"><compiler angle="radian"/><option timestep="0.0005"/><worldbody>
  <body name="hull" pos="0 0 1" euler="0 0 1"><freejoint name="base"/>
    <inertial mass="2" pos="0.02 0 0" diaginertia="0.03 0.02 0.04"/><site name="nose" pos="0.2 0.1 0"/>
    <body name="arm" pos="0.1 0 -0.1"><joint name="swing" axis="0 1 0" armature="0.002" damping="0.02"/>
      <inertial mass="0.5" pos="0.01 0.005 -0.15" diaginertia="0.004 0.004 0.0005"/><site name="tip" pos="0 0 -0.25"/>
    </body></body></worldbody>
  <actuator><motor name="motor" joint="swing"/></actuator>
  <keyframe><key qpos="0 0 1 1 0 0 0 0.2"/></keyframe></mujoco>"""
TIMES = np.arange(201) / 200


def pose_at(times: Array) -> Array:
    """(n, 7) a base that swings in the room, beside yaw past a half turn."""
    place = np.column_stack([0.1 * np.sin(6 * times), 0.05 * np.cos(5 * times), 1 + 0.05 * np.sin(8 * times)])
    angles = np.column_stack([4 * times, 0.3 * np.sin(7 * times), 0.2 * np.cos(6 * times)])
    return np.column_stack([place, Rotation.from_euler("ZYX", angles).as_quat()[:, [3, 0, 1, 2]]])


def flight(dt: float) -> Array:
    """(n,) the arm by MuJoCo with its free joint and a physics step.

    In each step the wrench on the base is the one that gives it the acceleration it has.
    """
    model = mujoco.MjModel.from_xml_string(FLYER.replace('damping="0.02"', ""))
    model.opt.timestep = dt
    data, small = mujoco.MjData(model), 1e-5
    data.qpos[7], rows, whole = 0.2, [], np.zeros((7, 7))
    for time in dt * np.arange(round(TIMES[-1] / dt) + 1):
        rows.append(data.qpos[7])
        before, now, after = pose_at(time + np.array([-small, 0.0, small]))
        turn = [Rotation.from_quat(q[[4, 5, 6, 3]]) for q in (before, now, after)]
        ahead, back = (turn[1].inv() * turn[2]).as_rotvec(), (turn[1].inv() * turn[0]).as_rotvec()
        data.qpos[:7] = now
        data.qvel[:6] = np.concatenate([(after - before)[:3], ahead - back]) / (2 * small)
        wanted = np.concatenate([(after - 2 * now + before)[:3], ahead + back]) / small**2
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, whole)
        free = data.qacc.copy()
        # M q̈ = f: what the base lacks, given that nothing more acts on the arm
        inverse = np.linalg.inv(whole)[:6, :6]
        data.qfrc_applied[:6] = data.qfrc_applied[:6] + np.linalg.solve(inverse, wanted - free[:6])
        mujoco.mj_step(model, data)
    return np.array(rows)[np.round(TIMES / dt).astype(int)]


POSES = pose_at(TIMES)
POSES[::2, 3:] *= -1  # the same orientations
COLUMNS = tuple(f"base.{own}" for own in POSE)


def recording(pose: Array = POSES) -> Recording:
    rows = np.column_stack([pose, 0.1 * TIMES])
    return Recording("flight", TIMES, np.zeros((len(TIMES), 1)), rows, ("motor",), (*COLUMNS, "swing"))


def files(folder: Path, pose: Array = POSES) -> tuple[Path, Path]:
    (folder / "flyer.xml").write_text(FLYER)
    write(folder / "flight.csv", recording(pose))
    return folder / "flyer.xml", folder / "flight.csv"


def test_a_free_joint_is_measured_or_left_out_and_a_sentence_names_both(tmp_path: Path) -> None:
    cup = """<body name="cup"><freejoint name="slack"/><inertial mass="0.2" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
      </body></worldbody>"""
    xml, csv = files(tmp_path)
    xml.write_text(FLYER.replace("</worldbody>", cup).replace('0.2"/></keyframe>', '0.2 2 0 0 1 0 0 0"/></keyframe>'))
    told = refusal(lambda: workflow.load_model(xml, prescribe=["base"]))
    assert "joint 'slack' is a free joint" in told and told.count(";") == 1
    measured, left_out = told.rsplit("; ", 1)
    assert measured.endswith("pos.slack.qz) and taken as it is from recordings by --prescribe slack")
    assert left_out.startswith("a loose object in the scene is left out by ")
    assert told.endswith("--ignore cup")
    found = workflow.load_model(xml, prescribe=["base"], ignore=["cup"], recordings=[csv])
    assert found.robot.joint_names == ("swing",) and found.robot.prescribed_columns == COLUMNS
    both = workflow.load_model(xml, prescribe=["base", "slack"])
    assert both.robot.joint_names == ("swing",) and len(both.robot.prescribed_columns) == 14


def test_a_body_in_a_frame_of_the_file_is_where_its_pose_says() -> None:
    framed = FLYER.replace("<worldbody>", '<worldbody><frame pos="0.1 0.2 0.3" euler="0 0 1">').replace(
        "</worldbody>", "</frame></worldbody>"
    )
    robot = MjcfRobot("flyer", framed, edits=Edits(prescribe=("base",), turns={"base": "zyx"}))
    data = mujoco.MjData(robot.plan.base)
    data.qpos[:6] = robot.prescribed_positions("it", POSES[:1])[0]
    mujoco.mj_kinematics(robot.plan.base, data)
    np.testing.assert_allclose(data.body("hull").xpos, POSES[0, :3], atol=1e-12)
    np.testing.assert_allclose(np.abs(data.body("hull").xquat @ POSES[0, 3:]), 1.0, atol=1e-12)


WALKER = """<mujoco model="walker"><compiler angle="radian"/><option timestep="0.0005"/><worldbody>
  <geom name="floor" type="plane" size="2 2 0.1"/><body name="trunk" pos="0 0 0.45"><freejoint name="base"/>
    <geom type="box" size="0.1 0.1 0.05" mass="5" contype="0" conaffinity="0"/>
    <body name="thigh"><joint name="hip" axis="0 1 0" damping="0.1" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      <body name="shank" pos="0 0 -0.25"><joint name="knee" axis="0 1 0" damping="0.1" frictionloss="0.3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
        <geom name="foot" type="sphere" size="0.03" pos="0 0 -0.25" mass="0.05"/></body></body></body></worldbody>
  <actuator><position name="hip" joint="hip" kp="60"/><position name="knee" joint="knee" kp="60"/></actuator></mujoco>"""


@pytest.mark.slow
def test_feet_stand_on_the_floor_as_under_a_heavy_base() -> None:
    """By hand: two heavy slides, put where they belong in each step, and a solver that goes on to the end."""
    times, heavy = np.arange(81) / 200, 1e6
    still = np.zeros_like(times)
    pose = np.column_stack([0.05 * np.sin(4 * times), still, 0.45 + 0.03 * np.sin(6 * times), still + 1, *[still] * 3])
    robot = MjcfRobot("walker", WALKER, edits=Edits(prescribe=("base",), turns={"base": "zyx"}))
    moved = smoothed("it", robot.prescribed_names, times, robot.prescribed_positions("it", pose))
    start, command = np.array([-0.5, 1.0]), np.tile([-0.5, 1.0], (len(times), 1))
    own = Trial("it", times, command, command[0], 0.0, start, times, prescribed=moved)
    engine = engine_for(Model(robot), positions=[np.column_stack([command, moved.position])])
    assert "'floor' touches 'foot'" in engine.reason
    found = engine.simulate([Model(robot)], [own], [np.array([[*start, 0.0, 0.0]])], 1)[0].position[0]
    slides = "".join(f'<joint type="slide" axis="{axis}" armature="{heavy}"/>' for axis in ("1 0 0", "0 0 1"))
    xml = WALKER.replace('<freejoint name="base"/>', slides).replace("/><worldbody>", ' tolerance="0"/><worldbody>')
    model = mujoco.MjModel.from_xml_string(xml)
    data, dt, rows, touched = mujoco.MjData(model), model.opt.timestep, [], []
    data.qpos[2:], data.ctrl[:] = start, start
    for time in dt * np.arange(round(times[-1] / dt) + 1):
        rows.append(data.qpos[2:].copy())
        touched.append(data.ncon)
        place, rate, _ = moved.at(time)
        data.qpos[:2], data.qvel[:2] = place[[0, 2]] - [0.0, 0.45], rate[[0, 2]]
        data.qfrc_applied[:2] = heavy * (moved.at(time + dt)[1] - rate)[[0, 2]] / dt
        mujoco.mj_step(model, data)
    by_hand = np.array(rows)[:: round(times[1] / dt)]
    assert 0.2 < np.mean(touched) < 0.9
    assert np.abs(found - by_hand).max() < 1e-4 * np.ptp(by_hand)


@pytest.mark.parametrize("sequence", ["zyx", "xzy"])
def test_slides_and_hinges_are_where_the_free_joint_is(sequence: str) -> None:
    spec = mujoco.MjSpec.from_string(FLYER)
    for key in list(spec.keys):
        spec.delete(key)
    assert part(spec, "base", sequence) == joints_of("base", sequence)
    parted, free = spec.compile(), mujoco.MjModel.from_xml_string(FLYER)
    pose = POSES[:20]  # the sequence xzy meets gimbal lock later
    found = positions("it", "base", sequence, pose)
    for own, wanted in zip(found, pose, strict=True):
        places = []
        for model, q in ((parted, own), (free, wanted)):
            data = mujoco.MjData(model)
            data.qpos[: len(q)], data.qpos[len(q)] = q, 0.3
            mujoco.mj_kinematics(model, data)
            places.append(data.site_xpos.copy())
        np.testing.assert_allclose(*places, atol=1e-12)


def test_the_limbs_move_as_with_mujocos_free_joint(tmp_path: Path) -> None:
    xml, csv = files(tmp_path)
    model = workflow.load_model(xml, prescribe=["base"], recordings=[csv]).with_parameters({"swing.damping": 0.0})
    assert model.robot.joint_names == ("swing",) and model.robot.prescribed_columns == COLUMNS
    assert model.robot.places()["foot"] == ("tip",) and "hull.mass" not in model.robot.parameters()
    (own,) = workflow.gather([csv], model)
    assert own.joints == ("swing",) and own.prescribed is not None
    assert own.prescribed.position[:, 3].max() > np.pi  # yaw goes on past a half turn
    trial = Trial.of(own, own.position[0])
    steps, start = (1e-3, 5e-4), np.array([[0.2, 0.0]])
    found = [engine_for(model, "mujoco", dt).simulate([model], [trial], [start])[0].position[0, :, 0] for dt in steps]
    by_hand = [flight(dt) for dt in steps]
    # Each without its step's error of first order
    ours, wanted = (2 * fine - coarse for coarse, fine in (found, by_hand))
    assert np.abs(ours - wanted).max() < 1e-5 * np.ptp(wanted)


def test_axes_are_chosen_by_the_recordings(tmp_path: Path) -> None:
    upright = POSES.copy()
    turned = Rotation.from_quat(POSES[:, [4, 5, 6, 3]]) * Rotation.from_euler("Y", np.pi / 2)
    upright[:, 3:] = turned.as_quat()[:, [3, 0, 1, 2]]
    assert sequence_for("base", [("flight", POSES)]) == "zyx"
    other = sequence_for("base", [("flight", upright)])
    assert other != "zyx"
    assert np.abs(np.diff(positions("it", "base", other, upright), axis=0)).max() < 0.1
    xml, csv = files(tmp_path, upright)
    assert "pos.base.qw" in refusal(lambda: workflow.load_model(xml))
    without = workflow.load_model(xml, prescribe=["base"])
    told = refusal(lambda: workflow.gather([csv], without))
    assert "no sequence of axes stays clear of gimbal lock in these recordings, or the model was read without" in told
    model = workflow.load_model(xml, prescribe=["base"], recordings=[csv])
    assert workflow.gather([csv], model)[0].prescribed is not None


def test_what_is_no_pose_is_told(tmp_path: Path) -> None:
    wrong = POSES.copy()
    wrong[7, 3:] *= 1.5
    xml, csv = files(tmp_path, wrong)
    told = refusal(lambda: workflow.load_model(xml, prescribe=["base"], recordings=[csv]))
    assert "flight: sample 7 of pos.base.qw" in told and "norm 1.5, expected 1" in told
    tumbling = POSES.copy()
    turns = Rotation.random(len(POSES), rng=np.random.default_rng(0))
    tumbling[:, 3:] = turns.as_quat()
    xml, csv = files(tmp_path, tumbling)
    model = workflow.load_model(xml, prescribe=["base"], recordings=[csv])
    assert "gimbal lock" in refusal(lambda: workflow.gather([csv], model))


def test_the_xml_that_is_written_has_its_free_joint_again(tmp_path: Path) -> None:
    xml, _ = files(tmp_path)
    model = workflow.load_model(xml, prescribe=["base"]).with_parameters({"arm.mass": 0.7})
    whole = mujoco.MjModel.from_xml_string(corrected_xml(model)[0])
    assert (whole.nq, whole.nv, whole.nu) == (8, 7, 1) and whole.body("arm").mass == 0.7
    assert whole.body("hull").mass == 2 and whole.nkey == 1


def test_what_acts_on_the_base_alone_is_not_needed(tmp_path: Path) -> None:
    thrust = '<motor name="rotor" site="nose" gear="0 0 1 0 0 0"/><motor name="reel" site="tip" gear="0 0 1 0 0 0"/>'
    (tmp_path / "it.xml").write_text(
        FLYER.replace("<actuator>", f"<actuator>{thrust}").split("<keyframe>")[0] + "</mujoco>"
    )
    robot = workflow.load_model(tmp_path / "it.xml", prescribe=["base"]).robot
    assert robot.actuator_names == ("reel", "motor")
    whole = mujoco.MjModel.from_xml_string(corrected_xml(Model(robot))[0])
    assert [whole.actuator(i).name for i in range(3)] == ["rotor", "reel", "motor"]


@pytest.mark.parametrize("rated", [False, True], ids=["positions", "one velocity"])
@pytest.mark.parametrize("suffix", [".mcap", ".csv", ".npz", ".rrd", "bags"])
def test_the_pose_of_a_base_is_written_and_read_back(suffix: str, rated: bool, tmp_path: Path) -> None:
    """By the exports of a model that takes it as its input, with every bit where a format keeps them."""
    library = {".mcap": "mcap", ".rrd": "rerun", "bags": "rosbags"}.get(suffix)
    if library is not None:
        pytest.importorskip(library)
    xml, csv = files(tmp_path)
    if rated:
        rate = np.full((len(TIMES), len(COLUMNS) + 1), np.nan)
        rate[:, -1] = 0.1
        csv.unlink()
        write(csv, replace(recording(), velocity=rate))
    model = workflow.load_model(xml, prescribe=["base"], recordings=[csv])
    (trial,) = workflow.read_recordings([csv], model)
    assert trial.joints == ("swing",) and (trial.velocity is not None) is rated
    assert tuple(trial.inputs) == tuple(f"pos.{name}" for name in COLUMNS)
    path = tmp_path / f"written{suffix}"
    if suffix in (".csv", ".npz"):
        workflow.write_recording(path, trial)
    else:
        (path, *_) = workflow.export_recordings([csv], path, model, ros2=suffix == "bags")
    if suffix == ".rrd":
        assert all(f"base.{own}".encode() in path.read_bytes() for own in POSE)
        return
    (back,) = workflow.read_recordings([path], model)
    for kind in ("time", "position", "command", *(["velocity"] if rated and suffix != "bags" else [])):
        np.testing.assert_array_equal(getattr(back, kind), getattr(trial, kind))
    for k, name in enumerate(COLUMNS):
        np.testing.assert_array_equal(back.inputs[f"pos.{name}"], POSES[:, k])
    assert back.prescribed is not None and trial.prescribed is not None
    np.testing.assert_array_equal(back.prescribed.position, trial.prescribed.position)


def test_velocities_of_some_joints_are_written_alone(tmp_path: Path) -> None:
    """Of a base that is prescribed, or of no more joints than have a sensor."""
    xml, _ = files(tmp_path)
    own = recording()
    rate = np.full(own.position.shape, np.nan)
    rate[:, 0] = np.gradient(own.position[:, 0], TIMES)
    csv = tmp_path / "rated.csv"
    write(csv, replace(own, velocity=rate))
    (trial,) = workflow.read_recordings([csv], workflow.load_model(xml, prescribe=["base"], recordings=[csv]))
    assert trial.velocity is None
    np.testing.assert_array_equal(trial.inputs["vel.base.x"], rate[:, 0])
    assert set(trial.inputs) == {"vel.base.x", *(f"pos.{name}" for name in COLUMNS)}
    assert {"vel.base.x", "pos.base.qz"} < set(trial.to_dataframe().columns)
