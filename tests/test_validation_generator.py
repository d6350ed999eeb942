"""Random robots: what was promised of them, and that they can be simulated."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import compile_model
from equimus_ctrl.robots.elastic.morphology import structure
from equimus_ctrl.validation import generator
from equimus_ctrl.validation.generator import FLOATING, SHAPES, hanging, is_sensible, pulsed_runs, random_robot


def crossed(robot: object) -> list[int]:
    """How many joints each actuator spans."""
    parents, spans, _ = structure(robot)  # type: ignore[arg-type]
    depth = {-1: 0} | {i: i + 1 for i in range(len(parents))}
    return [depth[b] - depth[a] for a, b in spans]


def test_shapes_have_two_to_four_joints_with_both_kinds_of_actuator() -> None:
    assert {joints for joints, _ in SHAPES.values()} == {2, 3, 4}
    assert 4 * len(SHAPES) >= 20
    for joints, spans in SHAPES.values():
        assert {b - a for a, b in spans} == {1, 2}
        assert all(-1 <= a < b < joints for a, b in spans)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_robot_is_of_its_shape_and_sensible(shape: str) -> None:
    robot = random_robot(shape, np.random.default_rng(5))
    assert len(robot.joints) == SHAPES[shape][0]
    assert set(crossed(robot)) == {1, 2}
    k = Kinematics(robot)
    for q in hanging(robot) + np.random.default_rng(0).uniform(-0.4, 0.4, (20, len(robot.joints))):
        assert k.lengths(q).min() > 0.03 and k.lengths(q).max() < 1.0
    rest = k.equilibrium(np.zeros(len(robot.actuators)), hanging(robot))
    assert np.abs(rest - hanging(robot)).max() < 1.3
    compile_model(robot)


def test_the_same_seed_gives_the_same_robot_and_another_another() -> None:
    first, again, other = (random_robot("three_joints", np.random.default_rng(s)) for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_senseless_robots_are_told() -> None:
    rng = np.random.default_rng(0)
    robot = random_robot("two_joints", rng)
    name = robot.actuators[0].name
    assert is_sensible(robot, rng)
    assert not is_sensible(robot.with_parameters({f"{name}.insertion.radius": 5.0}), rng)
    assert not is_sensible(robot.with_parameters({f"{name}.origin.radius": 1e-4}), rng)


def test_giving_up_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generator, "LONG", 0.0)
    monkeypatch.setattr(generator, "ATTEMPTS", 3)
    with pytest.raises(ModelError, match="no sensible robot of shape 'two_joints' was found in 3 attempts"):
        random_robot("two_joints", np.random.default_rng(0))


def test_nothing_ties_the_floating_robot_to_its_base() -> None:
    robot = random_robot(FLOATING, np.random.default_rng(0))
    assert all(point.body != "base" for a in robot.actuators for point in (a.origin, a.insertion))


def test_pulses_switch_on_and_off_within_the_range_and_on_the_grid() -> None:
    rng = np.random.default_rng(3)
    robots = tuple(random_robot("two_joints", rng, f"r{i}") for i in range(2))
    runs = pulsed_runs(robots, 10, 2.0, rng)
    assert runs.start.shape == (20, 2)
    assert runs.switch[0] == 0 and np.all(np.diff(runs.switch) > 0) and runs.switch[-1] < 2.0
    np.testing.assert_allclose(runs.switch * 120, np.round(runs.switch * 120), atol=1e-9)
    assert runs.pressure.min() == 0.0 and 5e3 < runs.pressure.max() <= 30e3
    assert 0.2 < (runs.pressure == 0).mean() < 0.6
    assert [m.name for m in runs.morphologies] == ["r0"] * 10 + ["r1"] * 10
