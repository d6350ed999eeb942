"""The equations of motion against textbooks, conservation laws and an independent derivation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from morphologies import (
    STRUCTURES,
    Skeleton,
    double_pendulum,
    integrate,
    newton_acceleration,
    pendulum,
    random_morphology,
    random_poses,
    stop_torque,
)

from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.symbolic import symbolic_model
from equimus_ctrl.models.symbolic_model import SymbolicModel, ldl_solve, pseudo_solve
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, Point, pack
from equimus_ctrl.types import Array

PHASES: tuple[Phase, ...] = ("swing", "stance")
ROBOTS = [(name, seed) for name in STRUCTURES for seed in (0, 1)]

every_robot = pytest.mark.parametrize(("name", "seed"), ROBOTS)
every_phase = pytest.mark.parametrize("phase", PHASES)


@lru_cache(maxsize=64)
def function(model: SymbolicModel, *outputs: str) -> ca.Function:
    return ca.Function("f", [model.q, model.v, model.f, model.tau, model.p], [getattr(model, key) for key in outputs])


def evaluate(
    morphology: Morphology, phase: Phase, output: str, q: Array, v: Array | None = None, f: Array | None = None
) -> Array:
    nj, na = len(morphology.joints), len(morphology.actuators)
    v = np.zeros(nj) if v is None else v
    f = np.zeros(na) if f is None else f
    return np.array(function(symbolic_model(morphology, phase), output)(q, v, f, np.zeros(nj), pack(morphology)))


def states(morphology: Morphology, seed: int, n: int = 5) -> list[tuple[Array, Array, Array, Array]]:
    """(q, v, pressure, torque) at random."""
    rng = np.random.default_rng(seed)
    nj, na = len(morphology.joints), len(morphology.actuators)
    return [
        (q, rng.normal(0, 3, nj), rng.uniform(0, 5e4, na), rng.normal(0, 1, nj))
        for q in random_poses(morphology, rng, n)
    ]


@every_phase
@every_robot
def test_acceleration_is_that_of_an_independent_derivation(name: str, seed: int, phase: Phase) -> None:
    """D'Alembert's principle over particles; in stance a floating base with the foot held by multipliers."""
    m = random_morphology(name, seed, stops=True)
    for q, v, p, tau in states(m, seed):
        expected = newton_acceleration(m, q, v, p, tau, phase)
        np.testing.assert_allclose(Kinematics(m, phase).acceleration(q, v, p, tau), expected, rtol=1e-9)


@every_phase
@pytest.mark.parametrize("make", [nominal_leg, ideal_leg])
def test_the_legs_move_as_the_independent_derivation_says(make: Callable[[], Morphology], phase: Phase) -> None:
    m = make()
    rng = np.random.default_rng(5)
    for _ in range(20):
        q, v = rng.uniform([0.3, -0.1], [2.8, 2.1]), rng.normal(0, 4, 2)
        p = rng.uniform(0, 5e4, 2)
        expected = newton_acceleration(m, q, v, p, phase=phase)
        np.testing.assert_allclose(Kinematics(m, phase).acceleration(q, v, p), expected, rtol=1e-9)


@every_phase
@every_robot
def test_the_mass_matrix_is_symmetric_positive_definite_and_that_of_the_energy(
    name: str, seed: int, phase: Phase
) -> None:
    m = random_morphology(name, seed)
    k = Kinematics(m, phase)
    for q, v, _, _ in states(m, seed):
        mass = k.mass(q)
        np.testing.assert_allclose(mass, mass.T, rtol=1e-12, atol=1e-15)
        assert np.linalg.eigvalsh(mass).min() > 0
        assert k.energy(q, v)[0] == pytest.approx(v @ mass @ v / 2, rel=1e-12)


@every_robot
def test_the_energies_are_sums_over_the_parts(name: str, seed: int) -> None:
    """An actuator's kinetic energy is ½∫|v|²dm along it, by quadrature; its gravity acts along it too."""
    m = random_morphology(name, seed)
    k = Kinematics(m)
    nodes, weights = np.polynomial.legendre.leggauss(9)
    down = np.array([-np.sin(m.tilt), np.cos(m.tilt)])
    for q, v, _, _ in states(m, seed):
        s = Skeleton(m, q, v)
        kinetic = potential = 0.0
        for link in m.links:
            centre = s.point(link.name, link.com)
            spin = s.heading(link.name)[1]
            kinetic += link.mass * abs(s.velocity(centre)) ** 2 / 2 + link.inertia * spin**2 / 2
            potential -= link.mass * m.gravity * down @ (centre.at.real, centre.at.imag)
        for a in m.actuators:
            one, two = s.end(a.origin), s.end(a.insertion)
            for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
                speed = (1 - node) * s.velocity(one) + node * s.velocity(two)
                place = (1 - node) * one.at + node * two.at
                kinetic += weight * a.mass * abs(speed) ** 2 / 2
                potential -= weight * a.mass * m.gravity * down @ (place.real, place.imag)
            potential += a.stiffness * (abs(two.at - one.at) - a.rest_length) ** 2 / 2
        np.testing.assert_allclose(k.energy(q, v), (kinetic, potential), rtol=1e-10, atol=1e-13)


@every_phase
@every_robot
def test_the_bias_is_the_differentiated_lagrangian(name: str, seed: int, phase: Phase) -> None:
    """d/dt ∂T/∂v − ∂T/∂q + ∂V/∂q with v held, by central differences of the energies alone; no damping, no stops."""
    m = random_morphology(name, seed, damped=False)
    k = Kinematics(m, phase)
    h = 1e-4

    def kinetic(q: Array, v: Array) -> float:
        return k.energy(q, v)[0]

    def momentum(q: Array, v: Array) -> Array:  # exact: T is quadratic in v
        eye = np.eye(len(q))
        return np.array([kinetic(q, v + e) - kinetic(q, v - e) for e in eye]) / 2

    for q, v, _, _ in states(m, seed, 3):
        eye = h * np.eye(len(q))
        carried = (momentum(q + h * v, v) - momentum(q - h * v, v)) / (2 * h)
        by_q = np.array([sum((1, -1) * np.array(k.energy(q + e, v))) for e in eye])
        by_q -= np.array([sum((1, -1) * np.array(k.energy(q - e, v))) for e in eye])
        expected = carried - by_q / (2 * h)
        bias = evaluate(m, phase, "bias", q, v).ravel()
        np.testing.assert_allclose(bias, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
        static = evaluate(m, phase, "static_bias", q).ravel()
        np.testing.assert_allclose(static, evaluate(m, phase, "bias", q).ravel(), rtol=1e-12, atol=1e-12)


@every_phase
@every_robot
def test_power_balance(name: str, seed: int, phase: Phase) -> None:
    """dE/dt = fᵀ dl/dt + τᵀv − damping in joints and actuators, the energy differentiated along the motion."""
    m = random_morphology(name, seed)
    k = Kinematics(m, phase)
    h = 1e-5
    for q, v, p, tau in states(m, seed):
        a = k.acceleration(q, v, p, tau)
        change = (sum(k.energy(q + h * v, v + h * a)) - sum(k.energy(q - h * v, v - h * a))) / (2 * h)
        rate = k.jacobian(q) @ v
        drive = np.array([d.area for d in m.actuators]) * p
        lost = sum(d.damping * r**2 for d, r in zip(m.actuators, rate, strict=True))
        lost += sum(j.damping * w**2 for j, w in zip(m.joints, v, strict=True))
        power = drive @ rate + tau @ v - lost
        assert lost > 0
        assert change == pytest.approx(power, rel=1e-5, abs=1e-5 * (abs(drive @ rate) + abs(tau @ v) + lost))


def check_conserved(energy: Array) -> None:
    """(n, 2) kinetic and potential: much is exchanged, nothing is lost."""
    kinetic, total = energy[:, 0], energy.sum(axis=1)
    assert np.ptp(kinetic) > 0.5 * kinetic.max()
    assert np.ptp(total) < 1e-9 * kinetic.max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "phase"),
    [("one_joint", "swing"), ("mono_and_bi", "swing"), ("branched", "swing"), ("one_joint", "stance")],
)
def test_energy_is_conserved_without_damping(name: str, phase: Phase) -> None:
    m = random_morphology(name, 1, damped=False)
    # Actuators far from having no length, where the equations are singular.
    far = tuple(replace(a, origin=replace(a.origin, radius=0.9)) for a in m.actuators)
    k = Kinematics(replace(m, actuators=far), phase)
    rng = np.random.default_rng(2)
    q0, v0 = random_poses(m, rng, 1)[0], rng.normal(0, 2, len(m.joints))
    none = np.zeros(len(m.actuators))
    q, v = integrate(lambda t, q, v: k.acceleration(q, v, none), q0, v0, np.linspace(0, 1, 9), rtol=3e-13, atol=1e-14)
    energy = np.array([k.energy(*x) for x in zip(q, v, strict=True)])
    check_conserved(energy)


def test_the_undamped_leg_conserves_energy_for_two_seconds() -> None:
    damped = nominal_leg()
    m = replace(
        damped,
        joints=tuple(replace(j, damping=0.0, lower=None, upper=None) for j in damped.joints),
        actuators=tuple(replace(a, damping=0.0) for a in damped.actuators),
    )
    k = Kinematics(m)
    q, v = integrate(
        lambda t, q, v: k.acceleration(q, v, [0, 0]),
        np.array([1.4, 0.9]),
        np.array([4.0, -9.0]),
        np.linspace(0, 2, 11),
        rtol=3e-13,
        atol=1e-14,
    )
    energy = np.array([k.energy(*x) for x in zip(q, v, strict=True)])
    check_conserved(energy)


def test_a_single_pendulum_is_the_textbook_one() -> None:
    mass, com, inertia = 0.7, 0.25, 4e-3
    k = Kinematics(pendulum(0.4, mass, com, inertia))
    for q in np.linspace(-3, 3, 13):
        expected = mass * 9.8 * com * np.cos(q) / (inertia + mass * com**2)
        assert k.acceleration([q], [2.0], [0.0])[0] == pytest.approx(expected, rel=1e-12)
        # Under pressure its moment arm is that of the cosine rule: dl/dq = a·b·sin(q)/l.
        length = np.sqrt(0.3**2 + 0.1**2 - 2 * 0.3 * 0.1 * np.cos(q))
        assert k.lengths([q])[0] == pytest.approx(length, rel=1e-12)
        pushed = expected + 4e-4 * 3e4 * 0.3 * 0.1 * np.sin(q) / length / (inertia + mass * com**2)
        assert k.acceleration([q], [2.0], [3e4])[0] == pytest.approx(pushed, rel=1e-12)


def test_a_double_pendulum_is_the_textbook_one() -> None:
    m = double_pendulum()
    (one, two), g = m.links, m.gravity
    rng = np.random.default_rng(3)
    for _ in range(20):
        q, v = rng.uniform(-3, 3, 2), rng.normal(0, 4, 2)
        c2, s2 = np.cos(q[1]), np.sin(q[1])
        m22 = two.inertia + two.mass * two.com**2
        m12 = m22 + two.mass * one.length * two.com * c2
        m11 = one.inertia + one.mass * one.com**2 + m22 + two.mass * (one.length**2 + 2 * one.length * two.com * c2)
        pull = two.mass * one.length * two.com * s2
        fall2 = two.mass * g * two.com * np.cos(q.sum())
        fall1 = (one.mass * one.com + two.mass * one.length) * g * np.cos(q[0]) + fall2
        rhs = [pull * (2 * v[0] * v[1] + v[1] ** 2) + fall1, -pull * v[0] ** 2 + fall2]
        expected = np.linalg.solve([[m11, m12], [m12, m22]], rhs)
        np.testing.assert_allclose(Kinematics(m).acceleration(q, v, [0.0]), expected, rtol=1e-10)
        np.testing.assert_allclose(Kinematics(m).mass(q), [[m11, m12], [m12, m22]], rtol=1e-12)


def test_a_lone_spring_oscillates_at_the_root_of_k_over_a_third_of_its_mass() -> None:
    """Without gravity, small angles about the pose where the rod stands square to the link: ω² = k r²/(I + m r²/3)."""
    m = pendulum(inertia=4e-3, mass=0.7, com=0.25)
    rod = replace(m.actuators[0], origin=Point.cartesian("base", 0.1, 0.3), mass=0.9, stiffness=80.0, rest_length=0.3)
    k = Kinematics(replace(m, gravity=0.0, actuators=(rod,)))
    h = 1e-5
    slope = (k.acceleration([h], [0], [0]) - k.acceleration([-h], [0], [0]))[0] / (2 * h)
    moment = 4e-3 + 0.7 * 0.25**2 + 0.9 * 0.1**2 / 3
    assert slope == pytest.approx(-80.0 * 0.1**2 / moment, rel=1e-8)


@every_robot
def test_static_pressure_holds_the_pose_or_comes_as_close_as_can_be(name: str, seed: int) -> None:
    m = random_morphology(name, seed)
    k = Kinematics(m)
    area = np.array([a.area for a in m.actuators])
    for q, _, _, _ in states(m, seed):
        pressure = k.static_pressure(q)
        drive = k.jacobian(q).T * area
        needed = evaluate(m, "swing", "static_bias", q).ravel()
        expected = np.linalg.pinv(drive) @ needed  # least squares, least norm
        np.testing.assert_allclose(pressure, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
        if len(m.actuators) >= len(m.joints):
            still = np.zeros(len(m.joints))
            left = k.mass(q) @ k.acceleration(q, still, pressure)
            np.testing.assert_allclose(left, 0, atol=1e-9 * np.abs(needed).max() + 1e-12)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    q=st.one_of(st.floats(-3, 4), st.floats(-0.1, 0.0), st.floats(1.9, 2.1)),
    v=st.one_of(st.floats(-20, 20), st.floats(-1000, 1000)),
)
@example(q=-0.1, v=50.0)
@example(q=2.1, v=-50.0)
def test_a_stop_pushes_back_and_never_pulls(q: float, v: float) -> None:
    m = nominal_leg()
    pose, rate = np.array([1.2, q]), np.array([0.0, v])
    torque = evaluate(m, "swing", "stop_torque", pose, rate).ravel()
    assert torque[0] == 0.0
    assert torque[1] == pytest.approx(stop_torque(m.joints[1], q, v), rel=1e-12, abs=1e-12)
    if -0.035 <= q <= 2.0:
        assert torque[1] == 0.0
    elif q < -0.035:
        assert torque[1] >= 0.0
    else:
        assert torque[1] <= 0.0


@pytest.mark.parametrize("phase", PHASES)
def test_a_leaning_base_is_a_turned_world(phase: Phase) -> None:
    """Gravity leaned by the tilt, or the whole robot turned the other way under upright gravity: the same motion."""
    m = replace(nominal_leg(), joints=tuple(replace(j, lower=None, upper=None) for j in nominal_leg().joints))
    tilt = 0.31
    turned = replace(
        m,
        actuators=tuple(replace(a, origin=replace(a.origin, angle=a.origin.angle - tilt)) for a in m.actuators),
    )
    q, v, p = np.array([1.3, 0.4]), np.array([1.0, -2.0]), [1e4, 2e4]
    leaning = Kinematics(replace(m, tilt=tilt), phase).acceleration(q, v, p)
    upright = Kinematics(turned, phase).acceleration(q - (tilt, 0), v, p)
    np.testing.assert_allclose(leaning, upright, rtol=1e-10)
    assert not np.allclose(leaning, Kinematics(m, phase).acceleration(q, v, p), rtol=1e-3)


def test_in_stance_the_base_falls_freely_when_the_leg_weighs_next_to_nothing() -> None:
    """A heavy base on a light one-link leg is an inverted pendulum about the foot."""
    m = pendulum(length=0.4, mass=1e-9, com=0.0, inertia=0.0)
    k = Kinematics(replace(m, base_mass=2.0, gravity=9.8), "stance")
    for q in (1.2, 1.57, 2.0):
        # The base sits at foot − 0.4 (cos q, sin q), so gravity along +y drives q away from upright.
        assert k.acceleration([q], [0.7], [0.0])[0] == pytest.approx(-9.8 / 0.4 * np.cos(q), rel=1e-6)


def test_one_structure_is_derived_once() -> None:
    assert symbolic_model(nominal_leg()) is symbolic_model(ideal_leg())
    assert symbolic_model(nominal_leg(), "stance") is not symbolic_model(nominal_leg())


@settings(deadline=None, max_examples=40, derandomize=True)
@given(data=st.data(), n=st.integers(1, 5))
def test_ldl_solves_positive_definite_systems(data: st.DataObject, n: int) -> None:
    values = hnp.arrays(np.float64, (n, n), elements=st.floats(-2, 2))
    root, rhs = data.draw(values), data.draw(values)[:, 0]
    matrix = root @ root.T + np.eye(n)
    found = np.array(ca.DM(ldl_solve(ca.SX(matrix), ca.SX(rhs)))).ravel()
    np.testing.assert_allclose(found, np.linalg.solve(matrix, rhs), rtol=1e-9, atol=1e-12)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(rows=st.integers(1, 4), columns=st.integers(1, 4), seed=st.integers(0, 1000))
def test_pseudo_solve_is_the_pseudoinverse(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    left, _, right = np.linalg.svd(rng.normal(size=(rows, columns)), full_matrices=False)
    matrix = left @ np.diag(rng.uniform(0.5, 2, min(rows, columns))) @ right
    rhs = rng.normal(size=rows)
    found = np.array(ca.DM(pseudo_solve(ca.SX(matrix), ca.SX(rhs)))).ravel()
    np.testing.assert_allclose(found, np.linalg.pinv(matrix) @ rhs, rtol=1e-9, atol=1e-10)
