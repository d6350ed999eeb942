"""The reference of the validation against a second derivation of the motion, and what is read off it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from morphologies import integrate as integrate_alone
from morphologies import newton_acceleration, random_morphology

from equimus_ctrl.computer import workers
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.validation.experiment import Experiment, any_force, undamped
from equimus_ctrl.validation.poses import OMEGA, holding_pressure, slowest_rate, workspace
from equimus_ctrl.validation.reference import evaluate, integrate, own_error, reference_runs, shortest


def switched(phase: Phase = "swing", n: int = 3) -> Experiment:
    m = nominal_leg().without_stops()
    rng = np.random.default_rng(4)
    start = rng.uniform([1.2, 0.4], [1.8, 1.0], (n, 2))
    return Experiment((m,), phase, start, np.array([0.0, 0.15]), rng.uniform(0, 3e4, (n, 2, 2)), 0.3)


@pytest.mark.parametrize("phase", ["swing", "stance"])
def test_it_is_the_motion_that_newton_gives(phase: Phase) -> None:
    runs = switched(phase)
    q, v = integrate(runs)
    m = runs.morphologies[0]
    for i in range(2):
        x, rate = runs.start[i], np.zeros(2)
        for k, (begin, end) in enumerate(((0, 18), (18, 36))):

            def acceleration(t: float, q: np.ndarray, v: np.ndarray, i: int = i, k: int = k) -> np.ndarray:
                return newton_acceleration(m, q, v, runs.pressure[i, k], phase=phase)

            alone, rates = integrate_alone(acceleration, x, rate, runs.times[begin : end + 1], rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(q[i, begin : end + 1], alone, atol=1e-8)
            np.testing.assert_allclose(v[i, begin : end + 1], rates, atol=1e-6)
            x, rate = alone[-1], rates[-1]
    assert np.ptp(q, axis=1).max() > 0.1


def test_robots_of_one_structure_run_together_as_they_run_alone() -> None:
    robots = tuple(random_morphology("mono_and_bi", seed) for seed in range(3))
    robots = tuple(
        replace(r, actuators=tuple(replace(a, name=f"d{i}") for i, a in enumerate(r.actuators))) for r in robots
    )
    runs = replace(switched(), morphologies=robots)
    together, _ = integrate(runs)
    for i in range(3):
        alone, _ = integrate(runs.part(slice(i, i + 1)))
        np.testing.assert_allclose(together[i], alone[0], atol=1e-9)
    assert np.abs(together[0] - together[1]).max() > 0.01


def test_its_own_error_is_what_a_tighter_run_says() -> None:
    runs = switched()
    q = reference_runs(runs)
    assert own_error(runs, q, np.arange(3)) < 1e-8
    assert own_error(runs, q + 1e-5, np.arange(3)) == pytest.approx(1e-5, rel=1e-3)
    assert np.isnan(own_error(runs, q, np.arange(0)))


def test_grouping_runs_near_a_stop_changes_nothing_but_the_tolerance() -> None:
    runs = switched()
    np.testing.assert_allclose(reference_runs(runs, np.array([False, True, False])), reference_runs(runs), atol=1e-6)


def test_pressures_are_held_from_their_switch_on() -> None:
    runs = switched()
    held = runs.held(1 / 240)
    assert held.shape == (3, 72, 2)
    assert np.all(held[:, 35] == runs.pressure[:, 0])
    assert np.all(held[:, 36] == runs.pressure[:, 1])


def test_touching_a_stop_and_short_actuators_are_seen() -> None:
    runs = replace(switched(), morphologies=(nominal_leg(),))
    q = np.tile([1.5, 0.5], (3, 37, 1))
    q[1, 20, 1] = -0.035
    assert runs.touches(q).tolist() == [False, True, False]
    q[2, 5] = np.nan
    lengths = Kinematics(nominal_leg()).lengths([1.5, 0.5])
    found = shortest(runs, q)
    assert found[0] == pytest.approx(lengths.min())
    assert found[2] == 0.0


def test_pressures_from_the_statics_hold_the_pose() -> None:
    m = nominal_leg().without_stops()
    poses = np.random.default_rng(0).uniform(*OMEGA, (20, 2))
    pressure, left = holding_pressure(m, poses)
    assert left.max() < 1e-12
    for q, p in zip(poses, pressure, strict=True):
        assert np.abs(newton_acceleration(m, q, np.zeros(2), p)).max() < 1e-9


def test_too_few_actuators_hold_no_pose() -> None:
    m = nominal_leg()
    _, left = holding_pressure(replace(m, actuators=m.actuators[:1]), np.array([[1.2, 0.7]]))
    assert left[0] > 1e-2


def test_slowest_rate_is_that_of_newtons_motion() -> None:
    m = nominal_leg().without_stops()
    pose = np.array([1.3, 0.6])
    pressure, _ = holding_pressure(m, pose[None])
    h, zero = 1e-6, np.zeros(2)
    a = np.zeros((4, 4))
    a[:2, 2:] = np.eye(2)
    for j, e in enumerate(np.eye(2) * h):
        up, down = (newton_acceleration(m, pose + s * e, zero, pressure[0]) for s in (1, -1))
        a[2:, j] = (up - down) / (2 * h)
        up, down = (newton_acceleration(m, pose, s * e, pressure[0]) for s in (1, -1))
        a[2:, 2 + j] = (up - down) / (2 * h)
    area = np.array([x.area for x in m.actuators])
    found = slowest_rate(m, pose[None], area * pressure)
    assert found[0] == pytest.approx(np.linalg.eigvals(a).real.max(), rel=1e-6)


def test_a_stiffer_robot_gets_a_shorter_step() -> None:
    m = nominal_leg()
    poses = np.array([[1.4, 0.7]])
    assert step_divisor(m, "swing", list(poses), 1 / 120, stops=False) == 1
    assert step_divisor(m.with_parameters({"baa.damping": 500.0}), "swing", list(poses), 1 / 120, stops=False) > 4


def test_what_damping_takes_is_the_rates_squared_times_their_dampers() -> None:
    m = nominal_leg()
    q, v, f = np.array([[1.4, 0.6]]), np.array([[0.7, -1.1]]), np.array([[3.0, -4.0]])
    power, slope = evaluate("loss", m, q, v, f)
    rates = Kinematics(m).jacobian(q[0]) @ v[0]
    dampers = [a.damping for a in m.actuators]
    expected = sum(j.damping * x**2 for j, x in zip(m.joints, v[0], strict=True)) + rates @ (dampers * rates)
    assert power[0, 0] == pytest.approx(expected, rel=1e-12)
    a = newton_acceleration(m, q[0], v[0], f[0] / [x.area for x in m.actuators])
    h = 1e-6
    ahead, behind = (evaluate("loss", m, q + s * h * v, v + s * h * a, f)[0][0, 0] for s in (1, -1))
    assert slope[0, 0] == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)


def test_robots_are_changed_only_where_that_is_said() -> None:
    m = nominal_leg()
    free = undamped(m)
    assert all(j.damping == 0 and j.lower is None and j.upper is None for j in free.joints)
    assert all(a.damping == 0 for a in free.actuators)
    assert any_force(m).command_low < -1e6
    assert [a.mass for a in free.actuators] == [a.mass for a in m.actuators]


def test_poses_come_from_the_published_workspace_or_from_between_the_stops() -> None:
    m = nominal_leg()
    np.testing.assert_array_equal(workspace(m), OMEGA)
    narrow = m.with_parameters({"hip.lower.angle": 1.0})
    assert workspace(narrow)[0][0] == 1.0
    other = random_morphology("one_joint", 0, stops=True)
    low, high = workspace(other)
    assert other.joint_range[0] < low < high < other.joint_range[1]
    assert np.isfinite(workspace(random_morphology("branched", 0))).all()


@pytest.mark.slow
def test_processes_change_nothing() -> None:
    runs = switched(n=6)
    near = np.array([True, False, True, False, False, True])
    alone = reference_runs(runs, near)
    told: list[float] = []
    with workers(2) as pool:
        np.testing.assert_array_equal(reference_runs(runs, near, told.append, pool=pool), alone)
    assert told == sorted(told)
    assert told[-1] == 1.0
