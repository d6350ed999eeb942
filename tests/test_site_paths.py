"""Named points of any robot, paths of a site by inverse kinematics, and how they are scored."""

from __future__ import annotations

import math
from dataclasses import replace
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, HINGES, RIG, pendulum, refusal
from rich.console import Console

from equimus_ctrl import workflow
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.points import points_of
from equimus_ctrl.report.site_figure import _plane, site_figure
from equimus_ctrl.report.tables import run_table, score_to_dict
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.context import ScenarioContext
from equimus_ctrl.scenarios.reaching import Reacher
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import score_run
from equimus_ctrl.scenarios.shapes import shape_path
from equimus_ctrl.types import Array


def arm(lengths: tuple[float, ...], ranges: str = "-3 3", drives: str = "") -> MjcfRobot:
    """Links in the x–z plane, each along x in the pose of the file, hinges about −y: angles count towards +z."""
    inner, at = "", 0.0
    for k, length in enumerate(lengths):
        inner += f"""<body name="link{k}" pos="{at} 0 0"><joint name="j{k}" axis="0 -1 0" range="{ranges}"
            limited="true" armature="0.05" damping="0.5"/>
            <inertial mass="0.2" pos="{length / 2} 0 0" diaginertia="0.002 0.002 0.002"/>"""
        at = length
    inner += f'<site name="tip" pos="{at} 0 0"/>' + "</body>" * len(lengths)
    motors = drives or "".join(f'<motor name="m{k}" joint="j{k}"/>' for k in range(len(lengths)))
    return MjcfRobot(
        "arm",
        f"""<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody>{inner}</worldbody>
        <actuator>{motors}</actuator></mujoco>""",
    )


TWO, THREE = arm((0.4, 0.3)), arm((0.4, 0.3, 0.2))


def reacher(robot: Robot, name: str = "tip") -> Reacher:
    return ScenarioContext(robot).reacher(name)


def built(robot: Robot, **options: str) -> Scenario:
    return workflow.load_scenario("track", robot, options=options, search=False)


def elbow_up(x: float, z: float) -> Array:
    """The textbook's inverse kinematics of two links, elbow bent to the negative side."""
    a, b = 0.4, 0.3
    second = -math.acos((x * x + z * z - a * a - b * b) / (2 * a * b))
    return np.array([math.atan2(z, x) - math.atan2(b * math.sin(second), a + b * math.cos(second)), second])


# --- points ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", [CRANE, RIG, nominal_leg()], ids=lambda robot: robot.name)
def test_jacobians_of_points_are_their_slopes(robot: Robot) -> None:
    points, q = points_of(Model(robot)), np.array([0.7, 0.2])
    for name in points.names:
        slopes = [(points.at(name, q + e)[0] - points.at(name, q - e)[0]) / 2e-6 for e in 1e-6 * np.eye(2)]
        np.testing.assert_allclose(points.at(name, q)[1], np.transpose(slopes), atol=1e-8)


def test_points_are_sites_centres_of_mass_and_tips() -> None:
    model = CRANE.mujoco_model()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, 0.1
    mujoco.mj_forward(model, data)
    points = points_of(Model(CRANE))
    assert points.names == ("tip", "arm", "rod") and points.ends == ("tip",)
    np.testing.assert_allclose(points.at("tip", [0.3, 0.1])[0], data.site("tip").xpos)
    np.testing.assert_allclose(points.at("rod", [0.3, 0.1])[0], data.body("rod").xipos)
    hip, knee = 0.9, 0.4
    legs = points_of(Model(nominal_leg()))
    thigh = 0.25 * np.array([math.cos(hip), math.sin(hip), 0.0])
    np.testing.assert_allclose(legs.at("thigh", [hip, knee])[0], thigh)
    np.testing.assert_allclose(
        legs.at("foot", [hip, knee])[0], thigh + 0.25 * np.array([math.cos(hip + knee), math.sin(hip + knee), 0.0])
    )


def test_the_end_is_the_one_that_most_joints_move() -> None:
    xml = HINGES.xml.replace('<body name="rod"', '<site name="inner"/><site name="outer" pos="1 0 0"/><body name="rod"')
    assert ScenarioContext(MjcfRobot("more", xml)).point("") == "tip"
    assert "did you mean 'tip'? (known: arm, rod, tip)" in refusal(lambda: ScenarioContext(HINGES).point("tpi"))


# --- inverse kinematics ------------------------------------------------------------------------------------------


def test_two_links_follow_as_the_textbook_says_and_keep_their_elbow() -> None:
    turn = np.linspace(0, 2 * np.pi, 200)
    places = np.column_stack([0.45 + 0.1 * np.cos(turn), 0 * turn, 0.1 + 0.1 * np.sin(turn)])
    found = reacher(TWO).follow(turn, places, elbow_up(0.5, 0.1))
    np.testing.assert_allclose(found, [elbow_up(x, z) for x, _, z in places], atol=1e-5)


def test_joints_to_spare_move_as_little_as_they_can() -> None:
    """Along a path, rates are those of least size, J⁺ ẋ: no part of them lies in the null space of J."""
    share = np.linspace(0, 1, 400)
    start = np.array([0.3, 0.6, -0.4])
    own = reacher(THREE)
    places = own.place(start) + share[:, None] * np.array([-0.15, 0.0, 0.1])
    poses = own.follow(share, places, start)
    for k in (100, 250, 399):
        slope = own.points.at("tip", (poses[k] + poses[k - 1]) / 2)[1]
        rate = poses[k] - poses[k - 1]
        np.testing.assert_allclose(rate, np.linalg.pinv(slope) @ slope @ rate, atol=2e-3 * np.abs(rate).max())


def test_what_is_out_of_reach_is_told_with_the_nearest_place() -> None:
    """Two links reach 0.7 m; the nearest place lies on that circle, towards the one that is asked for."""
    pose, miss = reacher(TWO).reach(np.array([0.9, 0.0, 1.2]), elbow_up(0.5, 0.2))
    assert miss == pytest.approx(1.5 - 0.7, abs=1e-6)
    np.testing.assert_allclose(reacher(TWO).place(pose), [0.42, 0.0, 0.56], atol=1e-3)
    said = refusal(lambda: built(TWO, site="tip", size="0.1", centre="0.9 0 1.2"))
    assert "with centre = 0.9 0 1.2: arm: tip cannot reach (0.9, 0, 1.2) m" in said
    assert "it comes as near as (0.42, 0, 0.56) m, 800 mm away" in said
    held = arm((0.4, 0.3), "-0.5 0.5")
    said = refusal(lambda: built(held, size="0.01", site="tip", centre="0.1 0 0.1"))
    assert "at the end of" in said and "range" in said


def test_a_joint_at_its_end_leaves_the_way_to_others() -> None:
    """The third joint is at its end and stays; the others put the tip in its place."""
    own, start = reacher(arm((0.4, 0.3, 0.2), "-1 1")), np.array([-0.3, 0.9, 1.0])
    target = own.place(np.array([0.2, 0.95, 1.0]))
    pose, miss = own.reach(target, start)
    low, high = own.robot.joint_range
    assert miss < 1e-8 and np.all((pose >= low) & (pose <= high))


def test_turns_add_up() -> None:
    """A joint that turns on and on is not wrapped."""
    free = MjcfRobot("free", TWO.xml.replace('range="-3 3"', "").replace('limited="true"', ""))
    turn = np.linspace(0, 4 * np.pi, 500)
    places = 0.5 * np.column_stack([np.cos(turn), 0 * turn, np.sin(turn)])
    found = reacher(free).follow(turn, places, elbow_up(0.5, 0.0))
    assert found[-1, 0] - found[0, 0] == pytest.approx(4 * np.pi, abs=1e-5)


# --- paths -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["line", "triangle", "square", "circle"])
def test_shapes_lie_in_their_circle_and_go_from_rest_to_rest(shape: str) -> None:
    times, places = shape_path(shape, 0.2, 1.5, 2)
    assert np.linalg.norm(places, axis=1).max() == pytest.approx(0.1)
    np.testing.assert_allclose(places[0], places[-1], atol=1e-12)
    rates = np.diff(places, axis=0) / np.diff(times)[:, None]
    fastest = np.abs(rates).max()
    assert np.abs(rates[[0, -1]]).max() < 1e-2 * fastest
    assert np.abs(np.diff(rates, axis=0)).max() < 0.1 * fastest
    length = {"line": 4, "triangle": 3 * math.sqrt(3), "square": 4 * math.sqrt(2), "circle": 2 * math.pi}[shape]
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert way == pytest.approx(0.1 * 2 * length, rel=1e-3)


@pytest.mark.parametrize("robot", [HINGES, RIG, nominal_leg(), THREE], ids=lambda robot: robot.name)
def test_by_default_a_robot_can_do_its_path_and_the_plane_is_that_in_which_it_moves(robot: Robot) -> None:
    for shape in ("triangle", "line"):
        scenario = built(robot, shape=shape)
        assert scenario.site is not None
        times = np.arange(2.0, scenario.duration, 1 / 120)
        wanted = scenario.site.wanted_at(times)
        poses = np.array([scenario.reference.position(float(t)) for t in times])
        np.testing.assert_allclose(scenario.site.places(poses), wanted, atol=1e-6)
        assert np.ptp(wanted, axis=0).max() > 5e-3
        across = 2 if robot.traits.catalogue == "elastic" else 1
        assert np.ptp(wanted[:, across]) < 1e-6


def test_a_stretched_arm_bends_before_it_draws() -> None:
    """In the file's pose its tip moves one way alone; as much as is asked for it bends."""
    small, large = built(TWO, site="tip", shape="circle"), built(TWO, site="tip", shape="circle", size="0.2")
    assert small.site is not None and large.site is not None
    places = large.site.wanted.values
    np.testing.assert_allclose(np.ptp(places, axis=0), [0.2, 0.0, 0.2], atol=1e-3)
    assert np.linalg.norm(places, axis=1).max() <= 0.7
    assert np.linalg.norm(small.site.wanted.values.mean(axis=0)) > np.linalg.norm(places.mean(axis=0))


def test_centre_plane_and_size_are_what_they_are_given_as() -> None:
    scenario = built(TWO, site="tip", shape="square", size="0.1", centre="0.3,0,0.3", plane="zx")
    assert scenario.site is not None
    corners = scenario.site.wanted.values[[0, 240, 480, 720]]
    np.testing.assert_allclose(corners.mean(axis=0), [0.3, 0.0, 0.3], atol=1e-9)
    half = 0.05 / math.sqrt(2)
    np.testing.assert_allclose(np.abs(corners - [0.3, 0.0, 0.3]), [[half, 0, half]] * 4, atol=1e-9)


def test_a_file_says_a_path(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("time,x,y,z\n1,0.4,0,0.2\n2,0.5,0,0.2\n3,0.5,0,0.3\n")
    scenario = built(TWO, site="tip", file=str(file))
    tip = reacher(TWO).place
    for time, place in ((2.0, [0.4, 0, 0.2]), (2.5, [0.45, 0, 0.2]), (4.0, [0.5, 0, 0.3])):
        np.testing.assert_allclose(tip(scenario.reference.position(time)), place, atol=1e-6)
    assert scenario.score_window == (2.0, 4.0)
    file.write_text("time,x,y\n1,0.4,0\n2,0.5,0\n")
    assert "there is no column 'z'" in refusal(lambda: built(TWO, site="tip", file=str(file)))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"shape": "cirle"}, "there is no shape 'cirle'; did you mean 'circle'?"),
        ({"site": "tip", "plane": "xx"}, "plane is 'xx', expected two of x, y and z"),
        ({"site": "tip", "centre": "1 2"}, "centre is '1 2', expected three numbers"),
        ({"site": "tip", "size": "-1"}, "size is -1 m, expected more than 0"),
        ({"size": "1"}, "size is that of a shape"),
        ({"site": "tip", "waypoints": "shoulder=3"}, "expected no site, shape or file beside them"),
        ({"shape": "line", "file": "a.csv"}, "expected one of both"),
    ],
)
def test_what_cannot_be_meant_is_told(options: dict[str, str], sentence: str) -> None:
    assert sentence in refusal(lambda: built(HINGES, **options))


def test_a_point_that_moves_along_one_line_has_no_plane() -> None:
    one = MjcfRobot("one", pendulum())
    assert "tip moves along one line alone" in refusal(lambda: built(one, shape="circle"))


def test_a_pose_that_actuators_cannot_hold_is_told_before_the_run() -> None:
    weak = arm((0.4, 0.3), drives='<motor joint="j0" name="a" ctrlrange="-.3 .3"/><motor joint="j1" name="b"/>')
    said = refusal(lambda: built(weak, site="tip", size="0.02", centre="0.6 0 0"))
    assert "j0 cannot be held" in said


def test_a_path_that_actuators_cannot_move_so_fast_along_is_told_before_the_run() -> None:
    weak = arm(
        (0.4, 0.3), drives='<motor joint="j0" name="a" ctrlrange="-6 6"/><motor joint="j1" name="b" ctrlrange="-6 6"/>'
    )
    asked = {"site": "tip", "shape": "circle", "size": "0.1", "centre": "0.3 0 -0.3"}
    assert built(weak, **asked, leg_time="2").duration > 2
    said = refusal(lambda: built(weak, **asked, leg_time="0.05"))
    assert "its actuators cannot move tip along a circle of 100 mm, 0.05 s from corner to corner" in said


# --- scores ------------------------------------------------------------------------------------------------------


def test_the_plane_of_a_long_path_is_found() -> None:
    turn = np.linspace(0, 2 * np.pi, 50_000)
    places = np.outer(np.cos(turn), [0.1, 0, 0]) + np.outer(np.sin(turn), [0, 0.1, 0.1])
    _, axes, names = _plane(places)
    assert np.abs(axes.T @ [0, 1, -1]).max() < 1e-9 and all("along" in name for name in names)
    assert _plane(np.zeros((1, 3)))[1].shape == (3, 2)


def test_the_sites_error_is_what_wrong_angles_make_of_it() -> None:
    """A sensor's zero that is off by ε shifts what is measured: the tip is off by ε times its distance from the axis."""
    options = {"site": "tip", "shape": "circle", "size": "0.1", "centre": "0.5 0 0", "leg_time": "0.3"}
    done = workflow.run_scenario("track", "pid", model=Model(TWO), options=options)
    assert done.score.site is not None and done.scenario.site is not None
    assert done.score.site.rmse[0] < 2e-3
    turned = replace(done.run, position=done.run.reference + np.array([0.01, 0.0]))
    score = score_run(turned, done.scenario)
    assert score.site is not None
    away = np.linalg.norm(done.scenario.site.wanted.values, axis=1)
    assert 0.99 * 0.01 * away.min() < score.site.mae[0] < score.site.largest[0] < 1.01 * 0.01 * away.max()
    record = score_to_dict(score, turned, done.scenario, "pid")["site"]
    assert record == {
        "name": "tip", "rmse_m": score.site.rmse[0], "mae_m": score.site.mae[0], "max_m": score.site.largest[0]
    }  # fmt: skip
    out = StringIO()
    Console(file=out, width=100).print(run_table(score, turned, done.scenario, "pid"))
    row = next(line for line in out.getvalue().splitlines() if "its path" in line).split()
    assert row[0] == "tip" and row[3:5] == [f"{score.site.rmse[0]:.4f}", f"{1e3 * score.site.rmse[0]:.2f}"]
    figure = site_figure(turned, done.scenario.site, score, "track")
    plane, over_time = figure.axes
    assert (plane.get_xlabel(), plane.get_ylabel()) == ("x [mm]", "z [mm]")
    assert over_time.lines[0].get_ydata().max() == pytest.approx(1e3 * score.site.largest[0], rel=1e-2)
