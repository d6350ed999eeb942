"""Geometry and statics: the published formulas of the leg, finite differences, and rest as a settled motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from morphologies import STRUCTURES, Skeleton, newton_acceleration, pendulum, random_morphology, random_poses
from scipy.optimize import minimize

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.linear import state_matrices
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Joint, Morphology, Point
from equimus_ctrl.types import Array

LEG = nominal_leg()
ROBOTS = [(name, seed) for name in STRUCTURES for seed in (0, 1, 2)]

every_robot = pytest.mark.parametrize(("name", "seed"), ROBOTS)


@pytest.mark.parametrize("pose", [(math.pi / 2, 0.0), (0.6, 1.5), (2.0, 0.3)])
def test_the_leg_has_the_published_geometry(pose: tuple[float, float]) -> None:
    """The points A to F of the paper, written out from its table."""
    t1, t2 = pose
    knee = 0.25 * np.array([math.cos(t1), math.sin(t1)])
    foot = knee + 0.25 * np.array([math.cos(t1 + t2), math.sin(t1 + t2)])
    c = 0.21213 * np.array([math.cos(t1 - math.radians(8.13)), math.sin(t1 - math.radians(8.13))])
    d = knee + 0.10 * np.array([math.cos(t1 + t2 + math.radians(30)), math.sin(t1 + t2 + math.radians(30))])
    k = Kinematics(LEG)
    np.testing.assert_allclose(k.knots(pose), [(0, 0), knee, foot], atol=1e-15)
    np.testing.assert_allclose(k.foot(pose), foot, rtol=1e-14)
    lengths = [np.linalg.norm(c - (0.06, 0)), np.linalg.norm(d - (-0.10, 0))]
    np.testing.assert_allclose(k.lengths(pose), lengths, rtol=1e-14)


@every_robot
def test_points_are_where_complex_numbers_put_them(name: str, seed: int) -> None:
    m = random_morphology(name, seed)
    k = Kinematics(m)
    for q in random_poses(m, np.random.default_rng(seed), 3):
        s = Skeleton(m, q, np.zeros(len(q)))
        tips = [0j, *(s.point(j.child, m.link(j.child).length).at for j in m.joints)]
        np.testing.assert_allclose(k.knots(q), [(z.real, z.imag) for z in tips], rtol=1e-12, atol=1e-15)
        foot = s.point(m.foot, m.link(m.foot).length).at
        np.testing.assert_allclose(k.foot(q), (foot.real, foot.imag), rtol=1e-12)
        lengths = [abs(s.end(a.insertion).at - s.end(a.origin).at) for a in m.actuators]
        np.testing.assert_allclose(k.lengths(q), lengths, rtol=1e-12)


@every_robot
def test_jacobians_are_central_differences(name: str, seed: int) -> None:
    m = random_morphology(name, seed)
    k = Kinematics(m)
    h = 1e-6
    for q in random_poses(m, np.random.default_rng(seed), 3):
        steps = h * np.eye(len(q))
        lengths = np.array([k.lengths(q + e) - k.lengths(q - e) for e in steps]).T / (2 * h)
        foot = np.array([k.foot(q + e) - k.foot(q - e) for e in steps]).T / (2 * h)
        np.testing.assert_allclose(k.jacobian(q), lengths, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(k.foot_jacobian(q), foot, rtol=1e-6, atol=1e-8)


def test_a_pendulum_rests_hanging_down_and_not_upright() -> None:
    """Both are poses without torque, and the one that is looked from lies between them."""
    assert Kinematics(pendulum()).equilibrium([0.0])[0] == pytest.approx(math.pi / 2, abs=1e-9)
    with pytest.raises(ModelError, match=r"pendulum: no pose at rest was found under pressures of 0 kPa"):
        Kinematics(replace(pendulum(), base_mass=1.0, gravity=0.0)).equilibrium([0.0])


def total_potential(m: Morphology, q: Array, pressure: Array) -> float:
    """Gravity, springs, pressures and stops, in complex numbers [J]."""
    s = Skeleton(m, q, np.zeros(len(q)))
    energy = -sum(link.mass * m.gravity * s.point(link.name, link.com).at.imag for link in m.links)
    for a, p in zip(m.actuators, pressure, strict=True):
        one, two = s.end(a.origin).at, s.end(a.insertion).at
        energy -= a.mass * m.gravity * (one + two).imag / 2 + a.area * p * abs(two - one)
        energy += a.stiffness * (abs(two - one) - a.rest_length) ** 2 / 2
    for joint, angle in zip(m.joints, q, strict=True):
        if joint.lower is not None and joint.upper is not None:
            energy += joint.lower.stiffness * max(joint.lower.angle - angle, 0.0) ** 2 / 2
            energy += joint.upper.stiffness * max(angle - joint.upper.angle, 0.0) ** 2 / 2
    return float(energy)


@pytest.mark.parametrize("pressure", [(0.0, 0.0), (12e3, 3e3), (50e3, 0.0), (0.0, 50e3), (50e3, 50e3), (20e3, 9e3)])
def test_the_equilibrium_is_where_the_potential_is_least(pressure: tuple[float, float]) -> None:
    p = np.array(pressure)
    rest = Kinematics(LEG).equilibrium(p)
    low, high = LEG.joint_range
    found = minimize(
        lambda q: total_potential(LEG, q, p),
        low + 0.4 * (high - low),
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-15, "maxiter": 2000},
    )
    np.testing.assert_allclose(rest, found.x, atol=1e-5)
    np.testing.assert_allclose(newton_acceleration(LEG, rest, np.zeros(2), p), 0, atol=1e-4)


def test_at_the_stop_the_leg_rests_a_little_inside_it() -> None:
    rest = Kinematics(LEG).equilibrium([50e3, 50e3])
    low, high = LEG.joint_range
    outside = np.minimum(rest - low, high - rest)
    assert outside.min() < 0
    assert outside.min() > -0.1


def test_an_equilibrium_is_looked_for_near_the_start_given() -> None:
    """Without a joint's stops a pose and its full turns are all at rest."""
    k = Kinematics(pendulum())
    for turn in (-1, 0, 1):
        start = math.pi / 2 + 2 * math.pi * turn + 0.3
        assert k.equilibrium([0.0], start=[start])[0] == pytest.approx(math.pi / 2 + 2 * math.pi * turn, abs=1e-9)


@pytest.mark.parametrize("rate", [0.02, 1.0])  # [Hz]: at the latter poses are too far apart to be followed
def test_poses_along_pressures_are_those_found_one_by_one(rate: float) -> None:
    k = Kinematics(LEG)
    t = np.arange(0.0, 6.0, 1 / 10)
    pressures = 25e3 * (1 + np.stack([np.sin(2 * np.pi * rate * t), np.cos(2 * np.pi * 1.3 * rate * t)], axis=1))
    one_by_one = [k.equilibrium(pressures[0])]
    for pressure in pressures[1:]:
        one_by_one.append(k.equilibrium(pressure, one_by_one[-1]))
    np.testing.assert_allclose(k.equilibria(pressures), one_by_one, atol=1e-10)


def test_poses_along_pressures_stay_on_their_turn_or_are_refused() -> None:
    k = Kinematics(pendulum())
    for turn in (-1, 0, 1):
        whole = math.pi / 2 + 2 * math.pi * turn
        np.testing.assert_allclose(k.equilibria(np.zeros((5, 1)), [whole + 0.3]), np.full((5, 1), whole), atol=1e-9)
    with pytest.raises(ModelError, match="no pose at rest was found under pressures of 10, 12.5 kPa"):
        Kinematics(LEG, "stance").equilibria([[10e3, 12.5e3], [10e3, 12.5e3]])
    with pytest.raises(ModelError, match="expected one finite number of Pa"):
        Kinematics(LEG).equilibria([[10e3, 12e3], [10e3, math.nan]])
    with pytest.raises(ModelError, match=r"pressures have shape \(0,\), expected \(n, na\), n at least 1"):
        Kinematics(LEG).equilibria([])


@pytest.mark.parametrize("name", ["one_joint", "mono_and_bi", "more_drives_than_joints"])
def test_static_pressure_and_equilibrium_undo_each_other(name: str) -> None:
    m = random_morphology(name, 4)
    k = Kinematics(m)
    rng = np.random.default_rng(0)
    found = 0
    for q in random_poses(m, rng, 40):
        pressure = k.static_pressure(q)
        slope = state_matrices(m, q, pressure)[0][len(q) :, : len(q)]
        if np.linalg.eigvals(slope).real.max() < -1.0:  # a pose may be held without being stable
            found += 1
            np.testing.assert_allclose(k.equilibrium(pressure, start=q), q, atol=1e-7)
    assert found >= 5


def test_holds_says_whether_the_pressures_are_within_range() -> None:
    k = Kinematics(LEG)
    reachable = k.equilibrium([10e3, 8e3])
    np.testing.assert_allclose(k.static_pressure(reachable), [10e3, 8e3], rtol=1e-6)
    assert k.holds(reachable)
    assert not Kinematics(replace(LEG, command_high=9e3)).holds(reachable)
    assert not Kinematics(replace(LEG, command_low=9e3)).holds(reachable)
    lifted = replace(LEG, joints=(replace(LEG.joints[0], lower=replace(LEG.joints[0].lower, angle=2.0)), LEG.joints[1]))  # type: ignore[type-var]
    assert not Kinematics(lifted).holds(reachable)


def test_fewer_drives_than_joints_cannot_hold_every_pose() -> None:
    m = replace(random_morphology("fewer_drives_than_joints", 0), command_low=-1e9, command_high=1e9)
    assert not any(Kinematics(m).holds(q) for q in random_poses(m, np.random.default_rng(0), 5))


def test_no_rest_is_a_sentence_with_the_pressures() -> None:
    with pytest.raises(ModelError) as caught:
        Kinematics(LEG, "stance").equilibrium([10e3, 12.5e3])
    assert str(caught.value) == "nominal_leg: no pose at rest was found under pressures of 10, 12.5 kPa"


@pytest.mark.parametrize("pressure", [[math.nan, 0.0], [math.inf, 0.0], [1e4, 1e4, 1e4], [1e4], 1e4])
def test_pressures_that_cannot_be_are_refused_in_a_sentence(pressure: list[float]) -> None:
    with pytest.raises(ModelError) as caught:
        Kinematics(LEG).equilibrium(pressure)
    expected = f"nominal_leg: pressures are {pressure}, expected one finite number of Pa for each of maa, baa"
    assert str(caught.value) == expected


def test_joint_order_is_that_of_the_description_and_not_of_the_links() -> None:
    backwards = replace(LEG, links=LEG.links[::-1])
    q: Array = np.array([1.1, 0.5])
    np.testing.assert_array_equal(Kinematics(backwards).lengths(q), Kinematics(LEG).lengths(q))
    np.testing.assert_array_equal(Kinematics(backwards).mass(q), Kinematics(LEG).mass(q))


def test_a_joint_may_sit_off_the_tip_of_its_parent() -> None:
    off = replace(LEG, joints=(LEG.joints[0], Joint("knee", "thigh", "calf", at=Point.cartesian("thigh", 0.2, 0.03))))
    q = np.array([math.pi / 2, 0.0])
    # Hanging straight down, the thigh's own x points down and its y to the left.
    np.testing.assert_allclose(Kinematics(off).foot(q), (-0.03, 0.45), atol=1e-15)
