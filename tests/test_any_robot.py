"""Scenarios, the PID and their figures of robots of any kind: hinges and slides, motors and servos, too few actuators."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import HINGES, RIG, pendulum, refusal
from rich.console import Console

from equimus_ctrl import workflow
from equimus_ctrl.controllers.exact_pid import ExactPidState
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings
from equimus_ctrl.controllers.placement import placed_gains
from equimus_ctrl.controllers.registry import compared_controllers
from equimus_ctrl.effects import CoulombFriction, PayloadMass, SensorDelay, TransportDelay
from equimus_ctrl.errors import ControllerError
from equimus_ctrl.loop import run
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, make_spec
from equimus_ctrl.report.comparison import comparison_figures, comparison_table
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.scenarios.scoring import StepFigures
from equimus_ctrl.types import Start

FINGER = Path(__file__).parents[1] / "docs" / "examples" / "finger.toml"
SERVO = MjcfRobot(
    "servo",
    pendulum('damping="0.6" frictionloss="0.05"', drive='<position name="goal" joint="pivot" kp="60" kv="1"/>'),
)
CARTPOLE = MjcfRobot(
    "cartpole",
    """<mujoco model="cartpole"><compiler angle="radian"/><option timestep="0.005"/><worldbody><body name="cart">
    <joint name="slider" type="slide" axis="1 0 0" range="-1 1" limited="true" damping="0.5"/>
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
    <body name="pole"><joint name="hinge" axis="0 1 0" damping="0.01"/>
    <inertial mass="0.2" pos="0 0 -0.3" diaginertia="0.006 0.006 0.0001"/></body></body></worldbody>
    <actuator><motor name="push" joint="slider" ctrlrange="-20 20"/></actuator></mujoco>""",
)
EVERY: tuple[Robot, ...] = (HINGES, RIG, SERVO, CARTPOLE, workflow.load_model(FINGER).robot)
every_robot = pytest.mark.parametrize("robot", EVERY, ids=lambda robot: robot.name)


# --- scenarios ---------------------------------------------------------------------------------------------------


@every_robot
@pytest.mark.parametrize("name", ["hold", "step", "track", "chirp", "multisine", "push", "payload"])
def test_every_robot_has_these_within_its_ranges_and_can_begin_them(name: str, robot: Robot) -> None:
    scenario = workflow.load_scenario(name, robot, search=False)
    low, high = robot.joint_range
    for time in np.linspace(0, scenario.duration, 50):
        pose = scenario.reference.position(float(time))
        assert np.all((pose >= low - 1e-3) & (pose <= high + 1e-3))
    first = MujocoPlant(Model(robot)).reset(scenario.start, 0)
    assert np.isfinite(first.position).all() and np.isfinite(first.command).all()


def test_a_pose_is_given_by_joints_as_people_read_them_and_by_keyframe() -> None:
    xml = RIG.xml.replace(
        "</mujoco>", '<keyframe><key name="low" qpos="0.1 0.02"/><key qpos="0 0.1"/></keyframe></mujoco>'
    )
    robot = MjcfRobot("keyed", xml)

    def pose(**options: str) -> list[float]:
        return workflow.load_scenario("hold", robot, options=options, search=False).reference.position(0.0).tolist()

    assert pose() == [0.1, 0.02] and pose(keyframe="key1") == [0.0, 0.1]
    assert pose(shoulder="30", reach="50") == pytest.approx([np.pi / 6, 0.05])
    assert "there is no keyframe 'high'" in refusal(lambda: pose(keyframe="high"))
    assert "there is no option 'elbow'" in refusal(lambda: pose(elbow="3"))
    assert "option shoulder is 'up'" in refusal(lambda: pose(shoulder="up"))


def test_a_keyframe_out_of_a_joints_range_is_told_with_what_is_nearest() -> None:
    keys = '<keyframe><key name="far" qpos="2.5 0.02"/><key name="near" qpos="0.3 0.02"/></keyframe></mujoco>'
    robot = MjcfRobot(
        "keyed",
        RIG.xml.replace("</mujoco>", keys).replace('damping="0.3"', 'damping="0.3" range="-1 1" limited="true"'),
    )
    low, high = np.degrees([side[0] for side in robot.joint_range])
    said = (
        f"keyed: keyframe 'far' has shoulder at 143.2°, outside the joint's range of {low:.1f}° to {high:.1f}°; "
        f"the nearest that can be reached is {high:.1f}°"
    )
    for name in ("hold", "step", "track", "multisine"):
        assert said in refusal(lambda name=name: workflow.load_scenario(name, robot, search=False))
    for options in ({"keyframe": "near"}, {"shoulder": "20"}):
        found = workflow.load_scenario("hold", robot, options=options, search=False)
        assert np.degrees(found.reference.position(0.0)[0]) < high


def test_the_legs_pose_is_its_own_keyframe() -> None:
    found = workflow.load_scenario("hold", nominal_leg(), search=False)
    assert found.reference.position(0.0).tolist() == [np.pi / 2, 0.0]
    assert found.summary == "reach (90°, 0°) from rest and hold it"


def test_a_step_turns_back_at_the_end_of_a_range_and_leaves_joints_without_actuator() -> None:
    near = MjcfRobot("near", pendulum(joint='range="-1 0.1" limited="true"'))
    scenario = workflow.load_scenario("step", near, search=False)
    assert np.degrees(scenario.reference.position(3.0)) == pytest.approx(-10)
    moved = workflow.load_scenario("step", CARTPOLE, options={"size": "200"}, search=False)
    np.testing.assert_allclose(moved.reference.position(2.0) - moved.reference.position(0.0), [0.2, 0.0])
    assert moved.step_at == 1.0 and moved.score_window == (1.0, 4.0)


def test_a_path_goes_through_its_way_points_from_rest_to_rest(tmp_path: Path) -> None:
    options = {"waypoints": "shoulder=20 reach=30; shoulder=-10", "leg_time": "1"}
    path = workflow.load_scenario("track", RIG, options=options, search=False)
    at = path.reference.position
    np.testing.assert_allclose(at(0.0), RIG.home)
    np.testing.assert_allclose(at(2.0), [np.radians(20), 0.03])
    np.testing.assert_allclose(at(3.0), [np.radians(-10), 0.0], atol=1e-12)
    np.testing.assert_allclose(at(4.0), at(2.0))
    np.testing.assert_allclose(at(3.0 + 1 / 120), at(3.0), atol=1e-4)
    assert path.score_window == (2.0, 4.0)
    assert "'shoulder' is no way point" in refusal(
        lambda: workflow.load_scenario("track", RIG, options={"waypoints": "shoulder"}, search=False)
    )
    file = tmp_path / "path.csv"
    file.write_text("time,pos.reach,pos.shoulder,more\n5,0.01,0.1,0\n6,0.02,0.2,0\n")
    read = workflow.load_scenario("track", RIG, options={"file": str(file)}, search=False)
    np.testing.assert_allclose(read.reference.position(2.5), [0.15, 0.015])
    file.write_text("time,pos.reach\n5,0.01\n")
    said = refusal(lambda: workflow.load_scenario("track", RIG, options={"file": str(file)}, search=False))
    assert "there is no column 'pos.shoulder'" in said


def test_a_motion_beyond_the_actuators_is_made_smaller() -> None:
    weak = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1 1"/>'))
    scenario = workflow.load_scenario("multisine", weak, options={"swing": "60", "high": "2"}, search=False)
    dynamics, times = Dynamics(Model(weak)), np.arange(0, 20, 1 / 120)
    q = np.array([scenario.reference.position(float(t)) for t in times])
    a = np.gradient(np.gradient(q, times, axis=0), times, axis=0)
    most = max(abs(dynamics.needed(x, 0 * x, y)[0]) for x, y in zip(q[5:-5], a[5:-5], strict=True))
    assert 0.7 < most < 1.1


def test_a_pose_that_cannot_be_held_is_told_by_joint_and_lack() -> None:
    weak = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1 1"/>'))
    said = refusal(lambda: workflow.load_scenario("hold", weak, options={"pivot": "90"}, search=False))
    assert "weak: pivot cannot be held at 90°, which takes 2.94 N·m: its actuators exert 1 N·m at most" in said
    said = refusal(lambda: workflow.load_scenario("hold", CARTPOLE, options={"hinge": "40"}, search=False))
    assert "hinge cannot be held at 40°, which takes 0.378 N·m: no actuator acts on it" in said
    resting = MjcfRobot(
        "resting",
        pendulum(joint='range="-1 1" limited="true"', drive='<motor name="m" joint="pivot" ctrlrange="-1 1"/>'),
    )
    said = refusal(lambda: workflow.load_scenario("hold", resting, options={"pivot": "57"}, search=False))
    assert "its actuators exert 1 N·m at most" in said


# --- scoring ------------------------------------------------------------------------------------------------------


def test_figures_of_a_step_are_those_of_a_lag_of_first_order() -> None:
    time = np.arange(0, 5, 1e-3)
    position = np.column_stack([1 + 0.5 * (1 - np.exp(-time / 0.3)), np.full(len(time), 2.0)])
    found = StepFigures.of(time, position, np.array([1.0, 2.0]), np.array([1.5, 2.001]))
    assert found.rise[0] == pytest.approx(0.3 * np.log(9), abs=2e-3)
    assert found.settling[0] == pytest.approx(0.3 * np.log(50), abs=2e-3)
    assert found.overshoot[0] == 0.0 and np.isnan([found.rise[1], found.overshoot[1], found.settling[1]]).all()
    np.testing.assert_allclose(found.offset, [0.0, -0.001], atol=1e-6)


def test_overshoot_is_that_of_an_oscillator() -> None:
    time, zeta, omega = np.arange(0, 10, 1e-3), 0.4, 5.0
    damped = omega * np.sqrt(1 - zeta**2)
    wave = np.cos(damped * time) + zeta * omega / damped * np.sin(damped * time)
    found = StepFigures.of(time, (1 - np.exp(-zeta * omega * time) * wave)[:, None], np.zeros(1), np.ones(1))
    assert found.overshoot[0] == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=1e-3)


# --- the PID ------------------------------------------------------------------------------------------------------


@every_robot
def test_it_holds_any_robot_as_it_comes(robot: Robot) -> None:
    done = workflow.run_scenario("hold", "pid", model=Model(robot), options={"duration": "2"}, noise=1e-4)
    assert "placed by the mass matrix" in done.run.note
    assert done.score.step is not None
    np.testing.assert_allclose(done.score.step.offset, 0.0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [RIG, SERVO], ids=lambda robot: robot.name)
def test_it_follows_a_path_and_takes_up_what_its_model_lacks(robot: Robot) -> None:
    link = robot.places()["link"][-1]
    heavy = (PayloadMass(link, 0.2), CoulombFriction(robot.joint_names[0], 0.2))
    quick = {"leg_time": "0.6"}
    known = workflow.run_scenario("track", "pid", model=Model(robot), options=quick)
    unknown = workflow.run_scenario("track", "pid", model=Model(robot), options=quick, effects=heavy)
    assert np.all(known.score.tracking.rmse < 2e-3)
    assert np.all(unknown.score.tracking.rmse < 0.05)
    held = workflow.run_scenario("hold", "pid", model=Model(robot), effects=heavy, options={"duration": "5"})
    assert held.score.step is not None
    np.testing.assert_allclose(held.score.step.offset, 0.0, atol=2e-3)


def test_its_first_command_is_the_one_in_force() -> None:
    plant = MujocoPlant(Model(HINGES))
    start = Start(command=np.array([0.4, -0.3]), position=np.array([0.3, 0.2]))
    done = run(plant, PidController(None), HoldReference([0.3, 0.2]), 0.1, start=start)
    np.testing.assert_allclose(done.command[0], [0.4, -0.3], atol=1e-9)


@pytest.mark.slow
def test_a_limit_of_force_winds_nothing_up() -> None:
    weak = MjcfRobot("weak", pendulum('damping="0.4"', drive='<motor name="motor" joint="pivot" ctrlrange="-2 2"/>'))
    plant = MujocoPlant(Model(weak))

    def wanted(time: float) -> np.ndarray:
        return np.array([1.4 if time < 4 else 0.2])

    done = run(plant, PidController(None), FunctionReference(wanted), 7.0)
    after = done.time > 4.0
    assert np.abs(done.position[after][200:] - 0.2).max() < 0.02  # there after 1.6 s
    assert done.position[after].min() > 0.0


def test_a_step_beyond_the_actuators_is_taken_without_overshoot() -> None:
    done = workflow.run_scenario("step", "pid", model=Model(CARTPOLE), options={"size": "100"})
    step = done.score.step
    assert step is not None and step.size[0] == pytest.approx(0.1)
    assert step.overshoot[0] < 0.05 and step.rise[0] < 1.0
    assert done.score.saturated < 0.05


def test_gains_of_ones_own_are_of_joints_and_need_not_be_decoupled() -> None:
    settings = PidSettings({"shoulder": PidGains(60, 60, 8), "reach": PidGains(400, 400, 40)}, "joint", inverse=True)
    done = workflow.run_scenario("track", PidController(settings), model=Model(RIG), options={"leg_time": "0.6"})
    assert np.all(done.score.tracking.rmse < 2e-3) and done.run.note == ""
    gravity = replace(settings, inverse=False)
    options = {"shoulder": "30", "duration": "4"}
    slow = workflow.run_scenario("hold", PidController(gravity), model=Model(RIG), options=options)
    assert slow.score.step is not None and np.abs(slow.score.step.offset).max() < 1e-3
    lengths = PidSettings({"lift": PidGains(1), "push": PidGains(1)})
    spec = make_spec(RIG, 0.01, RIG)
    first = MujocoPlant(Model(RIG)).reset()
    assert "has no elastic actuators" in refusal(lambda: PidController(lengths).init(spec, first))


@pytest.mark.slow
def test_placed_gains_are_slower_where_drives_are_late() -> None:
    found = []
    for delay in (0.0, 0.05, 0.15):
        model = Model(HINGES, (TransportDelay("lift", delay), TransportDelay("push", delay)) if delay else ())
        plant = MujocoPlant(model)
        placed = placed_gains(Dynamics(model), plant.spec, HINGES.home)
        found.append(placed.bandwidth)
        assert placed.everywhere == (delay == 0)  # none of them balances it upright when it is late
        done = run(plant, PidController(None), HoldReference(HINGES.home + 0.1), 6.0)
        assert np.abs(done.position[-50:] - HINGES.home - 0.1).max() < 0.01
    assert found[0] > 2 * found[1] > 2 * found[2]


@pytest.mark.slow
def test_late_sensors_are_reckoned_with() -> None:
    late = Model(HINGES, tuple(SensorDelay(joint, 0.05) for joint in HINGES.joint_names))
    plant, dynamics = MujocoPlant(late), Dynamics(late)
    at_once = placed_gains(Dynamics(Model(HINGES)), plant.spec, HINGES.home)
    assert placed_gains(dynamics, plant.spec, HINGES.home).bandwidth < at_once.bandwidth / 2
    done = run(plant, PidController(None), HoldReference(HINGES.home + 0.1), 8.0)
    assert np.abs(done.position[-100:] - HINGES.home - 0.1).max() < 0.01


@pytest.mark.parametrize(
    ("joint", "drive"),
    [
        ('damping="0.1"', '<motor name="motor" joint="pivot" ctrlrange="-200 200"/>'),
        ('damping="40"', '<motor name="motor" joint="pivot" ctrlrange="-200 200"/>'),
        ('damping="0.5"', '<velocity name="speed" joint="pivot" kv="30" ctrlrange="-5 5"/>'),
    ],
    ids=["light", "damped", "velocity"],
)
def test_a_step_hardly_overshoots_however_much_a_joint_is_damped(joint: str, drive: str) -> None:
    robot = MjcfRobot("one", pendulum(joint, drive=drive))
    done = workflow.run_scenario("step", "pid", model=Model(robot), options={"duration": "4"})
    assert done.score.step is not None
    assert done.score.step.overshoot[0] < 0.1 and done.score.step.settling[0] < 1.0
    np.testing.assert_allclose(done.score.step.offset, 0.0, atol=1e-4)


@pytest.mark.slow
def test_a_delay_that_nobody_told_of_is_borne() -> None:
    robot = MjcfRobot("limited", HINGES.xml.replace("<motor", '<motor ctrlrange="-60 60"'))
    found = workflow.compare(["step"], ["pid"], under=["nominal", "unmodelled_delay"], model=Model(robot))
    known, unknown = (entry.score for entry in found.entries)
    assert known is not None and unknown is not None and unknown.step is not None
    assert np.all(unknown.tracking.rmse < 1.2 * known.tracking.rmse)
    moved = ~np.isnan(unknown.step.overshoot)
    assert np.all(unknown.step.overshoot[moved] < 0.2)


def test_commands_change_no_faster_than_an_actuator_can() -> None:
    drive = '<pid name="goal" joint="pivot" kp="40" slewmax="0.5" input="pos"/>'
    plant = MujocoPlant(Model(MjcfRobot("slow", pendulum('damping="2"', drive=drive))))
    done = run(plant, PidController(None), FunctionReference(lambda t: np.array([0.0 if t < 0.5 else 0.6])), 8.0)
    assert np.isfinite(plant.spec.command_rate).all()
    fastest = np.abs(np.diff(done.command, axis=0)).max()
    assert fastest == pytest.approx(0.5 * plant.spec.control_dt)
    assert np.abs(done.position[-50:] - 0.6).max() < 0.01


def test_it_says_what_keeps_it_from_placing_gains() -> None:
    idle = MjcfRobot("idle", pendulum(drive='<damper name="brake" joint="pivot" kv="5" ctrlrange="0 2"/>'))
    said = refusal(lambda: workflow.run_scenario("hold", "pid", model=Model(idle)))
    assert "idle: no command exerts anything on a joint at rest" in said
    up = MjcfRobot("up", pendulum(inertial='mass="1" pos="0 0 0.3" diaginertia="0.01 0.01 0.01"'))
    late = Model(up, (TransportDelay("motor", 0.2),))
    said = refusal(lambda: workflow.run_scenario("hold", "pid", model=late))
    assert "up: pivot moves away from 0° under any PID placed for 0.008 to 0.094 Hz" in said
    assert "up to 0.2 s late" in said


def test_a_joint_without_actuator_that_falls_is_told() -> None:
    upright = MjcfRobot("upright", CARTPOLE.xml.replace('pos="0 0 -0.3"', 'pos="0 0 0.3"'))
    with pytest.raises(ControllerError, match="upright: hinge moves away from 0°, and it has no actuator"):
        workflow.run_scenario("hold", "pid", model=Model(upright))


def test_a_state_of_the_exact_pid_changes_nothing_of_an_earlier_one() -> None:
    plant = MujocoPlant(Model(RIG))
    controller, reference = PidController(None), HoldReference([0.2, 0.02])
    observation = plant.reset()
    state = controller.init(plant.spec, observation)
    assert isinstance(state, ExactPidState)
    first, _ = controller.step(observation, reference, state)
    again, _ = controller.step(observation, reference, state)
    np.testing.assert_array_equal(first, again)


# --- comparisons --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_comparison_takes_the_controllers_that_can_and_delays_that_such_robots_have() -> None:
    assert compared_controllers(CARTPOLE) == ("pid", "lqr", "nmpc", "sampling")
    quick = {"duration": "1"}
    found = workflow.compare(["hold"], ["pid", "lqr"], model=Model(CARTPOLE), draws=1, scenario_options=quick)
    assert [entry.controller for entry in found.entries] == ["pid", "lqr"] * 4 and not found.failures
    conditions = {c.name: c for c in found.conditions}
    assert conditions["delayed"].model.effects == (TransportDelay("push", 0.02),)
    assert "a dead time of 0.02 s" in conditions["delayed"].summary
    changed, known = conditions["perturbed"].model.parameters(), CARTPOLE.parameters()
    assert {name for name in known if changed[name] != known[name]} == {
        "cart.mass", "cart.inertia", "pole.mass", "pole.inertia", "slider.damping", "hinge.damping",
    }  # fmt: skip
    assert "masses and inertias ±15 %, damping and friction ±40 %" in conditions["perturbed"].summary
    row = found.entries[2].to_dict()
    assert set(row["rmse_m"]) == {"slider"} and set(row["rmse_rad"]) == {"hinge"} and set(row["effort_n"]) == {"push"}


def test_the_table_of_many_joints_names_the_worst() -> None:
    chain = HINGES.xml.replace(
        '<site name="tip"',
        "".join(
            f'<body name="b{k}" pos="0 0 -0.1"><joint name="j{k}" axis="0 1 0" damping="0.1" armature="0.01"/>'
            f'<inertial mass="0.1" pos="0 0 -0.05" diaginertia="0.001 0.001 0.001"/></body>'
            for k in range(2)
        )
        + '<site name="tip"',
    ).replace("</actuator>", '<motor name="j0" joint="j0"/><motor name="j1" joint="j1"/></actuator>')
    robot = MjcfRobot("four", chain)
    found = workflow.compare(
        ["step"], ["pid"], under=["nominal"], model=Model(robot), scenario_options={"duration": "1.2", "joint": "j1"}
    )
    out = StringIO()
    Console(file=out, width=80).print(comparison_table(found))
    assert "worst joint, mrad" in out.getvalue() and "j1 " in out.getvalue()
    figures = comparison_figures(found)
    assert len(figures["motion_step"].axes) == 2 * 4, "each with its error"


@pytest.mark.slow
def test_a_robot_of_one_joint_and_one_actuator_is_driven_by_every_controller() -> None:
    found = workflow.compare(["hold"], under=["nominal"], model=workflow.load_model(FINGER))
    assert len(found.entries) == 4 and not found.failures
    for entry in found.entries:
        assert entry.score is not None and entry.score.step is not None
        assert abs(entry.score.step.offset[0]) < 2e-3
