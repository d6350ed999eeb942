"""Figures of a run: what is drawn is what happened, for robots of other shapes too."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.report import run_figures, style
from equimus_ctrl.report.drawing import first_pass, skeleton, well_spaced
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import ElasticActuator, Joint, JointStop, Link, Morphology, Point
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.scenarios.scenario import CommandProfile, Scenario
from equimus_ctrl.scenarios.scoring import Score, score_run
from equimus_ctrl.types import Array, Recording, Run


def actuator(name: str, origin: Point, insertion: Point) -> ElasticActuator:
    return ElasticActuator(name, origin, insertion, 0.1, 200.0, 10.0, 0.2, 4e-4)


def chain(nj: int, na: int) -> Morphology:
    """A chain of links, its actuators from the base to each link in turn."""
    links = tuple(Link.rod(f"link{i}", 0.2 + 0.05 * i, 0.1) for i in range(nj))
    bodies = ["base", *(link.name for link in links)]
    joints = tuple(
        Joint(f"joint{i}", bodies[i], bodies[i + 1], 0.1, JointStop(-1.0), JointStop(2.5)) for i in range(nj)
    )
    actuators = tuple(
        actuator(
            f"act{i}", Point.cartesian("base", 0.1 - 0.05 * i, 0.02), Point(bodies[1 + i % nj], 0.15, 0.3 - 0.2 * i)
        )
        for i in range(na)
    )
    return Morphology(f"chain{nj}", links, joints, actuators, foot=links[-1].name)


def make_run(m: Morphology, *, n: int = 240, asked: Array | None = None) -> Run:
    time = np.arange(n) / 120
    nj, na = len(m.joints), len(m.actuators)
    wanted = np.stack([1.2 / (1 + i) + 0.2 * np.sin(3 * time + i) for i in range(nj)], axis=1)
    position = wanted + 0.05 * np.cos(2 * time)[:, None]
    if asked is None:
        asked = 1e3 * (20 + 10 * np.sin(time[:, None] + np.arange(na)))
    command = np.clip(asked, m.command_low, m.command_high)
    spec = make_spec(m, 1 / 120, m)
    return Run(
        spec, time, position, wanted, command, asked, command != asked, np.full(n, 1e-5), np.zeros(asked.shape[1])
    )


def make_scenario(run: Run, **changes: Any) -> Scenario:
    def wanted(time: float) -> Array:
        return np.array([np.interp(time, run.time, column) for column in run.reference.T])

    return Scenario("case", "a case", float(run.time[-1]), FunctionReference(wanted), **changes)


def recording_of(run: Run, shift: float) -> Recording:
    time = run.time[::2] + 0.001
    position = np.stack([np.interp(time, run.time, column) for column in run.position.T], axis=1) + shift
    return Recording("real", time, run.command[::2], position, run.spec.actuators, run.spec.joints)


def joints_figure(run: Run, scenario: Scenario, m: Morphology) -> tuple[Figure, Score]:
    score = score_run(run, scenario)
    wanted = run_figures.wanted_of(run, scenario, Kinematics(m))
    return run_figures.joints_figure(run, score, wanted, run_figures.beside_of(run, scenario), "a heading"), score


def labels(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def line(axes: Axes, colour: str) -> Any:
    return next(item for item in axes.lines if item.get_color() == colour)


@pytest.mark.parametrize("nj", [1, 2, 3])
def test_skeleton_agrees_with_the_symbolic_model(nj: int) -> None:
    m = nominal_leg() if nj == 2 else chain(nj, 2)
    kinematics = Kinematics(m)
    poses = np.random.default_rng(nj).uniform(-0.5, 1.5, (4, nj))
    for phase in ("swing", "stance"):
        bones = skeleton(m, poses, phase)  # type: ignore[arg-type]
        lengths = np.linalg.norm(bones.actuators[:, :, 1] - bones.actuators[:, :, 0], axis=-1)
        for k, pose in enumerate(poses):
            np.testing.assert_allclose(bones.foot[k] - bones.base[k], kinematics.foot(pose), atol=1e-12)
            np.testing.assert_allclose(bones.links[k, :, 1] - bones.base[k], kinematics.knots(pose)[1:], atol=1e-12)
            np.testing.assert_allclose(lengths[k], kinematics.lengths(pose), atol=1e-12)
        np.testing.assert_allclose(bones.base if phase == "swing" else bones.foot, 0.0, atol=1e-12)


def test_brackets_join_the_links_to_attachments_off_their_axis() -> None:
    m = nominal_leg()
    bones = skeleton(m, [math.pi / 2, 0.0])
    assert bones.brackets.shape == (1, 2, 2, 2)
    np.testing.assert_allclose(bones.brackets[0, :, 0, 0], 0.0, atol=1e-12)  # on the hanging leg's vertical axis
    np.testing.assert_allclose(bones.brackets[0, :, 1], bones.actuators[0, :, 1], atol=1e-12)


def test_poses_far_apart_and_the_path_without_what_it_retraces() -> None:
    square = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.01, 0.0]])
    assert well_spaced(square, 4) == [0, 2, 1, 3]
    assert well_spaced(np.zeros((5, 2)), 4) == [0]
    twice = first_pass(np.concatenate([square, square]))
    kept = twice[np.isfinite(twice[:, 0])]
    step = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    assert 3.8 < step[step < 0.05].sum() < 4.2
    assert np.isnan(twice[len(twice) * 3 // 4 :, 0]).mean() > 0.8
    assert len(first_pass(np.ones((9, 2)))) == 1


@pytest.mark.parametrize("nj", [1, 2, 3, 4])
def test_joint_panels_show_the_run_the_reference_and_the_error(nj: int) -> None:
    m = nominal_leg() if nj == 2 else chain(nj, 1)
    run = make_run(m)
    figure, score = joints_figure(run, make_scenario(run, score_window=(0.5, 1.5)), m)
    assert len(figure.axes) == 2 * nj
    for j, joint in enumerate(m.joint_names):
        panel, strip = figure.axes[2 * j : 2 * j + 2]
        shown = line(panel, style.joint_colour(j))
        np.testing.assert_allclose(shown.get_xdata(), run.time)
        np.testing.assert_allclose(shown.get_ydata(), np.degrees(run.position[:, j]))
        wanted = line(panel, style.REFERENCE)
        np.testing.assert_allclose(wanted.get_ydata(), np.degrees(run.reference[:, j]))
        assert wanted.is_dashed()
        error = np.degrees(run.position[:, j] - run.reference[:, j])
        np.testing.assert_allclose(line(strip, style.joint_colour(j)).get_ydata(), error, atol=1e-12)
        assert panel.get_title("left").startswith(joint)
        assert f"{np.degrees(score.tracking.rmse[j]):.2f}°" in panel.get_title("left")
        assert "°" in panel.get_ylabel()
        assert sorted(patch.get_x() + patch.get_width() for patch in panel.patches) == pytest.approx(
            [0.5, run.time[-1]]
        )
    assert figure.axes[-1].get_xlabel() == "time [s]"
    assert "not scored (scored: 0.5 to 1.5 s)" in labels(figure)
    assert "error: run − reference" in labels(figure)


def test_a_recording_is_shown_beside_a_controlled_run_whose_error_is_that_of_tracking() -> None:
    m = nominal_leg()
    run = make_run(m)
    scenario = make_scenario(run, recorded=recording_of(run, 0.02))
    figure, score = joints_figure(run, scenario, m)
    assert scenario.recorded is not None
    assert score.recorded is not None
    beside = line(figure.axes[0], style.RECORDED)
    inside = scenario.recorded.time <= run.time[-1]
    np.testing.assert_allclose(beside.get_ydata(), np.degrees(scenario.recorded.position[inside, 0]))
    error = line(figure.axes[1], style.joint_colour(0)).get_ydata()
    np.testing.assert_allclose(error, np.degrees(run.position - run.reference)[:, 0], atol=1e-12)
    title = figure.axes[0].get_title("left")
    assert f"{np.degrees(score.recorded.rmse[0]):.2f}° (0.0200 rad) from the recording" in title
    assert "from the reference" in title
    assert {"recorded (real)", "error: run − reference"} <= set(labels(figure))
    assert not figure.axes[0].patches  # all of it is scored


def test_played_commands_are_judged_by_what_the_real_robot_did() -> None:
    m = nominal_leg()
    levels = np.array([[1e4, 2e4], [3e4, 1e4]])
    run = make_run(m, asked=np.repeat(levels, 120, axis=0))
    profile = CommandProfile([0.0, 1.0], levels)
    figure, score = joints_figure(run, make_scenario(run, commands=profile, recorded=recording_of(run, 0.02)), m)
    assert score.recorded is not None
    error = line(figure.axes[1], style.joint_colour(0)).get_ydata()
    np.testing.assert_allclose(error, -np.degrees(0.02), atol=1e-2)
    assert "error: run − recorded" in labels(figure)
    assert "0.0200 rad) from the recording" in figure.axes[0].get_title("left")


def test_a_recording_outside_the_run_is_left_out() -> None:
    run = make_run(nominal_leg())
    recorded = recording_of(run, 0.0)
    late = Recording(
        "late", recorded.time + 60, recorded.command, recorded.position, recorded.actuators, recorded.joints
    )
    assert run_figures.beside_of(run, make_scenario(run, recorded=late)) is None


def test_played_commands_are_drawn_beside_the_poses_slow_ones_would_give() -> None:
    m = nominal_leg()
    kinematics = Kinematics(m)
    levels = np.array([[1e4, 2e4], [3e4, 1e4]])
    run = make_run(m, asked=np.repeat(levels, 120, axis=0))
    scenario = make_scenario(run, commands=CommandProfile([0.0, 1.0], levels))
    wanted = run_figures.wanted_of(run, scenario, kinematics)
    assert not wanted.followed
    for row, level in ((0, 0), (119, 0), (120, 1), (239, 1)):
        np.testing.assert_allclose(wanted.position[row], kinematics.equilibrium(levels[level]), atol=1e-6)
    figure, score = joints_figure(run, scenario, m)
    off = (run.position - wanted.position)[run.time <= score.window[1], 0]
    rmse = np.degrees(np.sqrt((off**2).mean()))
    assert f"RMSE {rmse:.2f}°" in figure.axes[0].get_title("left")
    thin = line(figure.axes[0], style.REFERENCE)
    assert thin.is_dashed()
    assert thin.get_linewidth() < style.REFERENCE_WIDTH
    assert any("slow commands" in label for label in labels(figure))

    closed = make_run(m)
    assert run_figures.wanted_of(closed, make_scenario(closed, commands=scenario.commands), kinematics).followed


def test_a_reference_that_already_is_where_slow_commands_lead_is_kept() -> None:
    m = nominal_leg()
    kinematics = Kinematics(m)
    level = np.array([1e4, 2e4])
    run = make_run(m, asked=np.tile(level, (240, 1)))
    pose = kinematics.equilibrium(level)
    run = replace(run, reference=np.tile(pose, (240, 1)))
    scenario = Scenario("hold", "", 2.0, HoldReference(pose), commands=CommandProfile([0.0], [level]))
    wanted = run_figures.wanted_of(run, scenario, kinematics)
    assert not wanted.followed
    assert wanted.position is run.reference
    figure, score = joints_figure(run, scenario, m)
    assert f"{np.degrees(score.tracking.rmse[1]):.2f}°" in figure.axes[2].get_title("left")


@pytest.mark.parametrize("nj", [1, 2, 3])
def test_foot_path_is_in_millimetres_with_y_down_and_equal_axes(nj: int) -> None:
    m = nominal_leg() if nj == 2 else chain(nj, 2)
    run, kinematics = make_run(m), Kinematics(m)
    scenario = make_scenario(run, recorded=recording_of(run, 0.1))
    wanted = run_figures.wanted_of(run, scenario, kinematics)
    figure = run_figures.foot_path_figure(run, kinematics, wanted, run_figures.beside_of(run, scenario), "a heading")
    machine, path, strip = figure.axes
    off = np.array([kinematics.foot(a) - kinematics.foot(b) for a, b in zip(run.position, run.reference, strict=True)])
    drawn_off = line(strip, style.FOOT).get_ydata()
    np.testing.assert_allclose(drawn_off, np.maximum(1e3 * np.linalg.norm(off, axis=1), 1e-3), rtol=1e-6)
    assert strip.get_yscale() == "log" and "distance from the reference" in strip.get_title("left")
    feet = np.array([kinematics.foot(pose) for pose in run.position[::60]]) * 1e3
    for axes in (machine, path):
        np.testing.assert_allclose(np.array(line(axes, style.FOOT).get_data()).T[::60], feet, atol=1e-9)
        low, high = sorted(axes.get_ylim())
        assert axes.get_ylim()[0] > axes.get_ylim()[1]
        assert axes.get_aspect() == 1.0
        assert "mm" in axes.get_xlabel()
        assert "mm" in axes.get_ylabel()
        assert low < feet[:, 1].min()
        assert high > feet[:, 1].max()
    assert {text.get_text() for text in machine.texts} == {*m.joint_names, *m.actuator_names}
    drawn = sum(item.get_color() == style.actuator_colour(0) for item in machine.lines)
    assert 2 <= drawn <= 4  # the pose at the start and faded ones
    assert {"this run", "reference", "recorded (real)", "start", "end"} == set(labels(figure))


def test_in_stance_the_path_is_the_bases() -> None:
    m = nominal_leg()
    run, kinematics = make_run(m), Kinematics(m, "stance")
    wanted = run_figures.Wanted(np.tile(run.reference[:1], (240, 1)), True)
    figure = run_figures.foot_path_figure(run, kinematics, wanted, None, "a heading")
    base = np.array(line(figure.axes[1], style.FOOT).get_data()).T
    np.testing.assert_allclose(base[0], -1e3 * kinematics.foot(run.position[0]), atol=1e-9)
    assert figure.axes[1].get_title("left") == "the base alone"
    target = next(item for item in figure.axes[1].lines if item.get_marker() == "+")
    np.testing.assert_allclose(
        np.ravel(target.get_data()), -1e3 * kinematics.foot(run.reference[0]), atol=1e-9
    )  # one pose is a cross, not a path


@pytest.mark.parametrize("na", [1, 2, 6])
def test_pressure_panels_show_commands_limits_and_clipping(na: int) -> None:
    m = nominal_leg() if na == 2 else chain(1, na)
    time = np.arange(240) / 120
    asked = np.full((240, na), 10e3)
    asked[:, 0] = np.where((time >= 0.5) & (time < 1.0), 80e3, 40e3)
    run = make_run(m, asked=asked)
    scenario = make_scenario(run)
    score = score_run(run, scenario)
    figure = run_figures.commands_figure(run, score, "a heading")
    assert len(figure.axes) == na
    for i, (axes, name) in enumerate(zip(figure.axes, m.actuator_names, strict=True)):
        shown = line(axes, style.actuator_colour(i))
        np.testing.assert_allclose(shown.get_ydata(), run.command[:, i] / 1e3)
        assert shown.get_drawstyle() == "steps-post"
        assert axes.get_ylabel() == f"{name} [kPa]"
        assert axes.get_title("left").startswith(f"{name}   {score.effort[i] / 1e3:.1f} kPa RMS")
    first = figure.axes[0]
    assert "25.0 % of commands clipped" in first.get_title("left")
    bars = [path.get_extents() for item in first.collections for path in item.get_paths()]
    assert [(bar.x0, bar.x1, bar.y0) for bar in bars] == [pytest.approx((0.5, 1.0, 50.0))]
    assert first.get_ylim()[1] > 50
    if na > 1:
        assert figure.axes[1].get_ylim()[1] < 20  # a little pressure is not squeezed under a far limit
        assert [text.get_text() for text in figure.axes[1].texts] == ["limit 50 kPa ↑"]
    assert any(label.startswith("clipped") for label in labels(figure))


@pytest.mark.slow
def test_figures_are_saved_alike_each_time_and_leave_the_global_settings_alone(tmp_path: Path) -> None:
    m = nominal_leg()
    run = make_run(m)
    scenario = make_scenario(run, recorded=recording_of(run, 0.02))
    score, kinematics = score_run(run, scenario), Kinematics(m)
    before = dict(matplotlib.rcParams)
    paths = run_figures.save_run_figures(run, scenario, score, kinematics, tmp_path / "a" / "b", "case · pid")
    again = run_figures.save_run_figures(run, scenario, score, kinematics, tmp_path / "again", "case · pid")
    assert dict(matplotlib.rcParams) == before
    assert [path.name for path in paths] == ["joints.png", "foot_path.png", "pressures.png"]
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == sorted(path.name for path in paths)
    for path, other in zip(paths, again, strict=True):
        assert path.read_bytes() == other.read_bytes()
        with Image.open(path) as image:
            assert not image.text  # type: ignore[attr-defined]
            pixels = np.asarray(image.convert("RGB")).astype(int)
        assert pixels.shape[1] == 1200
        white = (pixels == 255).all(axis=2).mean()
        assert 0.5 < white < 0.98
        coloured = (np.ptp(pixels, axis=2) > 60).mean()
        assert coloured > 0.002


def test_a_run_of_another_robot_is_refused(tmp_path: Path) -> None:
    run = make_run(nominal_leg())
    scenario = make_scenario(run)
    with pytest.raises(ConfigError, match="chain1 has joint0 and act0"):
        run_figures.save_run_figures(run, scenario, score_run(run, scenario), Kinematics(chain(1, 1)), tmp_path, "x")
    assert not list(tmp_path.iterdir())


def test_colours_differ_within_each_family() -> None:
    for family in (style.JOINT_COLOURS, style.ACTUATOR_COLOURS):
        assert len(set(family)) == len(family)
    assert style.joint_colour(len(style.JOINT_COLOURS)) == style.JOINT_COLOURS[0]
