"""Joints that are held, actuators that are left out, robots of URDF files and motors for them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import ARM, refusal

from equimus_ctrl import recordings, workflow
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.editing import lock_of
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import load_model

HAND = """<mujoco model="hand"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="arm" pos="0 0 1" euler="0 0.3 0"><joint name="shoulder" axis="0 1 0" pos="0 0 0.05"/>
    <inertial mass="1" pos="0.1 0 -0.2" diaginertia="0.02 0.02 0.01"/>
    <body name="wrist" pos="0 0 -0.4" quat="0.9 0.1 0.2 0.3"><joint name="turn" axis="1 2 0" pos="0.02 0 0.01" ref="0.1"/>
      <inertial mass="0.5" pos="0 0.05 -0.1" diaginertia="0.003 0.002 0.001"/>
      <body name="finger" pos="0 0.1 -0.2"><joint name="grip" type="slide" axis="0 1 1"/>
        <inertial mass="0.2" pos="0.01 0 0" diaginertia="1e-4 2e-4 1e-4"/><site name="tip" pos="0 0 -0.05"/></body>
    </body></body></worldbody>
  <actuator><motor name="lift" joint="shoulder"/><motor joint="turn"/><position name="hold" joint="grip" kp="50"/></actuator>
  <keyframe><key name="home" qpos="0 0.1 0"/></keyframe></mujoco>"""
URDF = """<robot name="two">
  <link name="base"/>
  <link name="upper"><visual><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></visual>
    <collision><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></collision>
    <inertial><origin xyz="0 0 -0.2"/><mass value="1.5"/><inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
    <inertia ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="5"/><dynamics damping="0.1"/></joint>
  <joint name="knee" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.4"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""

SCENE = """<mujoco model="scene"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/><site name="home"/>{cup}
  <body name="arm" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom name="link" type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/><site name="tip" pos="0 0 -.4"/></body>{ball}
  </worldbody>{beside}
  <actuator><motor name="lift" joint="shoulder"/><motor name="spare" joint="shoulder"/></actuator>
  <sensor><jointpos name="angle" joint="shoulder"/></sensor>{key}</mujoco>"""
CUP = """<body name="cup" pos="-0.4 0 1"><freejoint name="carried"/><geom name="rim" size="0.05"/><site name="mark"/>
    <body name="lid" pos="0 0 .1"><joint name="opens" axis="1 0 0"/><geom name="top" size="0.02"/></body></body>"""
BALL = '<body name="ball" pos="1 0.5 1"><freejoint/><geom size="0.05"/></body>'
BESIDE = """<contact><pair geom1="rim" geom2="link"/><exclude body1="lid" body2="arm"/></contact>
  <equality><weld body1="cup" body2="arm" active="false"/><joint joint1="opens" joint2="shoulder" active="false"/></equality>
  <tendon><spatial name="string"><site site="home"/><site site="mark"/></spatial></tendon>
  <sensor><framepos objtype="body" objname="cup"/><framepos objtype="site" objname="tip" reftype="body" refname="cup"/>
  <touch site="mark"/><tendonpos tendon="string"/></sensor>"""
KEY = """<keyframe><key name="up" qpos="-.4 0 1 1 0 0 0 .1 .7 1 .5 1 1 0 0 0" qvel="0 0 0 0 0 0 .1 .2 0 0 0 0 0 0" ctrl="1 2"/>
  </keyframe>"""
CROWDED = SCENE.format(cup=CUP, ball=BALL, beside=BESIDE, key=KEY)


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    path = tmp_path / "hand.xml"
    path.write_text(HAND)
    return path


def places(model: mujoco.MjModel, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """(tip of the finger, mass matrix) with joints at some values."""
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    return data.site("tip").xpos.copy(), whole


@pytest.mark.parametrize("value", [0.1, 0.8, -1.1])
def test_a_joint_that_is_held_is_where_it_is_held(hand: Path, value: float) -> None:
    """Hinges and slides, with an anchor and a reference of their own: the same kinematics and the same inertia."""
    whole, held = load_model(hand), load_model(hand, lock={"turn": value, "grip": 0.03})
    assert held.robot.joint_names == ("shoulder",) and held.robot.actuator_names == ("lift",)
    tip, inertia = places(whole.robot.mujoco_model(), {"shoulder": 0.4, "turn": value, "grip": 0.03})  # type: ignore[attr-defined]
    tip_held, inertia_held = places(held.robot.mujoco_model(), {"shoulder": 0.4})  # type: ignore[attr-defined]
    assert tip_held == pytest.approx(tip, abs=1e-6)
    # The armature of what is held is that of no joint any more; there is none here.
    assert inertia_held[0, 0] == pytest.approx(inertia[0, 0], rel=1e-5)


def test_an_actuator_without_a_name_takes_its_joint_s(hand: Path) -> None:
    assert load_model(hand).robot.actuator_names == ("lift", "turn", "hold")


def test_an_actuator_that_is_left_out_exerts_nothing(hand: Path) -> None:
    model = load_model(hand, ignore=["hold"])
    assert model.robot.actuator_names == ("lift", "turn") and model.robot.joint_names == ("shoulder", "turn", "grip")


def test_what_is_not_there_is_told(hand: Path) -> None:
    assert "there is no joint 'turm'" in refusal(lambda: load_model(hand, lock={"turm": 0.0}))
    assert "did you mean 'turn'" in refusal(lambda: load_model(hand, lock={"turm": 0.0}))
    assert "there is no actuator or loose object 'up'" in refusal(lambda: load_model(hand, ignore=["up"]))
    assert "expected a finite position" in refusal(lambda: load_model(hand, lock={"turn": float("nan")}))
    assert "MJCF robots alone" in refusal(lambda: load_model(None, lock={"hip": 0.0}))
    assert "expected JOINT or JOINT=POSITION" in refusal(lambda: lock_of("turn=wide"))
    assert lock_of("turn") == ("turn", 0.0) and lock_of("turn=-0.2") == ("turn", -0.2)


def test_a_model_file_remembers(hand: Path, tmp_path: Path) -> None:
    model = load_model(hand, lock={"turn": 0.5}, ignore=["hold"])
    written = workflow.save_model(tmp_path / "mine.toml", model, hand)
    again = load_model(written[0])
    assert again.robot.joint_names == ("shoulder", "grip") and again.robot.actuator_names == ("lift",)
    assert again.robot.xml == model.robot.xml  # type: ignore[attr-defined]
    text = written[0].read_text()
    written[0].write_text(text.replace('ignore = ["hold"]', 'ignore = "hold"'))
    assert "expected a list of names of actuators and loose objects" in refusal(lambda: load_model(written[0]))


def test_recordings_need_not_have_what_is_held(hand: Path, tmp_path: Path) -> None:
    time = np.arange(0, 2, 0.01)
    one = Recording("r", time, np.zeros((200, 2)), np.zeros((200, 2)), ("lift", "spare"), ("shoulder", "other"))
    recordings.write(tmp_path / "r.csv", one)
    said = refusal(lambda: workflow.gather([tmp_path / "r.csv"], load_model(hand)))
    assert "column 'cmd.turn' is missing" in said and "--lock" in said and "--ignore" in said
    held = load_model(hand, lock={"turn": 0.5, "grip": 0.0})
    with pytest.warns(recordings.RecordingWarning, match=r"pos.other, cmd.spare not used"):
        (trial,) = workflow.gather([tmp_path / "r.csv"], held)
    assert trial.joints == ("shoulder",) and trial.actuators == ("lift",)


def test_a_urdf_is_loaded_without_its_meshes_and_with_motors(tmp_path: Path) -> None:
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    assert "--motors" in refusal(lambda: load_model(path))
    model = load_model(path, motors=True)
    assert model.robot.joint_names == model.robot.actuator_names == ("hip", "knee")
    assert [model.robot.command_unit(name) for name in model.robot.actuator_names] == ["N·m", "N·m"]
    values = model.parameters()
    assert values["upper.mass"] == 1.5 and values["hip.damping"] == 0.1
    start, times = np.array([0.3, -0.2]), np.arange(0, 0.5, 0.01)
    trial = Trial("t", times, np.zeros((50, 2)), np.zeros(2), 0.0, start, times)
    fallen = simulate_mjcf([model], [trial], threads=1)[0].position[0]
    assert np.abs(fallen[-1] - start).max() > 0.1  # it swings


def test_a_broken_urdf_is_told(tmp_path: Path) -> None:
    path = tmp_path / "two.urdf"
    path.write_text(URDF[:-20])
    assert "MuJoCo cannot load it" in refusal(lambda: load_model(path, motors=True))


def test_what_others_need_is_not_held(tmp_path: Path) -> None:
    path = tmp_path / "crane.xml"
    tendon = '<tendon><fixed name="t"><joint joint="reach" coef="1"/></fixed></tendon></mujoco>'
    path.write_text(ARM.replace("</mujoco>", tendon))
    assert "reach changed" in refusal(lambda: load_model(path, lock={"reach": 0.0}))


def test_robots_made_of_one_file_otherwise_are_others(hand: Path) -> None:
    robots = [load_model(hand, lock={"turn": v}).robot for v in (0.0, 0.5)]
    assert all(isinstance(robot, MjcfRobot) for robot in robots)
    assert robots[0].digest != robots[1].digest  # type: ignore[attr-defined]
    assert Model(robots[0]).robot.joint_names == ("shoulder", "grip")


def test_a_loose_object_goes_with_all_that_names_it(tmp_path: Path) -> None:
    """Nothing is left of it, and the robot moves as the one of a file without it."""
    crowded, alone = tmp_path / "crowded.xml", tmp_path / "alone.xml"
    crowded.write_text(CROWDED)
    alone.write_text(SCENE.format(cup="", ball="", beside="", key=""))
    models = [load_model(crowded, ignore=["cup", "ball"]), load_model(alone)]
    robot = models[0].robot
    assert robot.joint_names == ("shoulder",) and robot.actuator_names == ("lift", "spare")
    own = robot.mujoco_model()  # type: ignore[attr-defined]
    assert (own.nq, own.nbody, own.npair, own.nexclude, own.neq, own.ntendon, own.nsensor) == (1, 2, 0, 0, 0, 0, 1)
    assert own.key_qpos.tolist() == [[0.7]] and own.key_qvel.tolist() == [[0.2]] and own.key_ctrl.tolist() == [[1, 2]]
    times = np.arange(0, 1, 0.01)
    trial = Trial("t", times, np.tile([0.5, 0.1], (100, 1)), np.zeros(2), 0.0, np.array([0.3]), times)
    paths = [simulate_mjcf([model], [trial], threads=1)[0].position[0] for model in models]
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-9)
    assert np.ptp(paths[0]) > 0.05


def test_an_actuator_goes_with_its_entries_of_keyframes(tmp_path: Path) -> None:
    path = tmp_path / "crowded.xml"
    path.write_text(CROWDED)
    own = load_model(path, ignore=["cup", "lift", "ball"]).robot.mujoco_model()  # type: ignore[attr-defined]
    assert own.key_ctrl.tolist() == [[2.0]] and own.key_qpos.tolist() == [[0.7]]
    drives = '<position name="a" joint="j" timeconst=".1"/><motor name="b" joint="j"/><intvelocity name="c" joint="j" actrange="-1 1"/>'
    path.write_text(
        f"""<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody><actuator>{drives}</actuator>
        <keyframe><key ctrl="1 2 3" act=".4 .5"/></keyframe></mujoco>"""
    )
    own = load_model(path, ignore=["a"]).robot.mujoco_model()  # type: ignore[attr-defined]
    assert own.key_ctrl.tolist() == [[2, 3]] and own.key_act.tolist() == [[0.5]]


def test_a_free_joint_is_refused_with_the_way_out_where_there_is_one(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(CROWDED)
    assert "left out by --ignore cup" in refusal(lambda: load_model(path))
    assert "left out by --ignore ball" in refusal(lambda: load_model(path, ignore=["cup"]))
    path.write_text(CROWDED.replace('<body name="ball"', "<body"))
    assert "for which its body needs a name" in refusal(lambda: load_model(path, ignore=["cup"]))
    assert "did you mean 'cup'" in refusal(lambda: load_model(path, ignore=["cap"]))
    told = refusal(lambda: load_model(path, ignore=["arm"]))
    assert "body 'arm' has no free joint" in told and "--lock" in told
    walker = SCENE.format(cup="", ball="", beside="", key="").replace(
        '<joint name="shoulder" axis="0 1 0" damping="0.1"/>',
        '<freejoint name="root"/><body name="leg"><joint name="shoulder" axis="0 1 0"/><geom size=".1"/></body>',
    )
    path.write_text(walker)
    told = refusal(lambda: load_model(path))
    assert told.endswith("taken as it is from recordings by --prescribe root") and "--ignore" not in told


def test_a_model_file_remembers_objects_and_says_that_the_xml_lacks_them(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(CROWDED)
    model = load_model(path, ignore=["cup", "ball"])
    file, whole = workflow.save_model(tmp_path / "mine.toml", model, path)
    assert 'ignore = ["cup", "ball"]' in file.read_text()
    assert load_model(file).robot.xml == model.robot.xml  # type: ignore[attr-defined]
    assert "Not in here: cup, which is ignored, ball, which is ignored." in whole.read_text()
    assert load_model(whole).robot.joint_names == ("shoulder",)
