"""The linearisation: finite differences of the motion, textbook frequencies, and small motions themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest
from morphologies import STRUCTURES, integrate, pendulum, random_morphology, random_poses
from scipy.linalg import expm

from equimus_ctrl.effects import Effect, ForceEffect, NonlinearStiffness, ParallelSpring, make, parameter
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.linear import state_matrices
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_the_matrices_are_central_differences_of_the_acceleration(name: str, phase: Phase) -> None:
    m = random_morphology(name, 2, stops=True)
    k = Kinematics(m, phase)
    nj, na = len(m.joints), len(m.actuators)
    rng = np.random.default_rng(1)
    # One pose free, one with the joints pressed into their stops, where these stiffen them.
    for q in (random_poses(m, rng, 1, -0.6, 0.6)[0], random_poses(m, rng, 1, 1.05, 1.2)[0]):
        p = rng.uniform(0, 5e4, na)
        still = np.zeros(nj)
        a, b = state_matrices(m, q, p, phase)
        assert a.shape == (2 * nj, 2 * nj)
        assert b.shape == (2 * nj, na)
        np.testing.assert_array_equal(a[:nj], np.hstack([np.zeros((nj, nj)), np.eye(nj)]))
        np.testing.assert_array_equal(b[:nj], 0)
        h = 1e-5
        by_q = [(k.acceleration(q + e, still, p) - k.acceleration(q - e, still, p)) / (2 * h) for e in h * np.eye(nj)]
        by_v = [(k.acceleration(q, e, p) - k.acceleration(q, -e, p)) / (2 * h) for e in h * np.eye(nj)]
        by_p = [(k.acceleration(q, still, p + e) - k.acceleration(q, still, p - e)) / 2 for e in np.eye(na)]
        scale = 1e-5 * np.abs(a).max()
        np.testing.assert_allclose(a[nj:], np.hstack([np.array(by_q).T, np.array(by_v).T]), rtol=1e-5, atol=scale)
        np.testing.assert_allclose(b[nj:], np.array(by_p).T, rtol=1e-5, atol=1e-5 * np.abs(b).max())


def test_a_pendulum_swings_at_its_textbook_frequency() -> None:
    mass, com, inertia = 0.7, 0.25, 4e-3
    a, _ = state_matrices(pendulum(0.4, mass, com, inertia), [math.pi / 2], [0.0])
    omega = math.sqrt(mass * 9.8 * com / (inertia + mass * com**2))
    np.testing.assert_allclose(sorted(np.linalg.eigvals(a).imag), [-omega, omega], rtol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvals(a).real, 0, atol=1e-12)


def test_small_motions_of_the_leg_follow_the_linear_model() -> None:
    m = nominal_leg()
    k = Kinematics(m)
    p = np.array([12e3, 6e3])
    rest = k.equilibrium(p)
    a, b = state_matrices(m, rest, p)
    push = np.array([5.0, -3.0])  # [Pa]
    offset = np.array([1e-5, -2e-5, 1e-4, 3e-4])
    times = np.linspace(0, 0.5, 6)
    q, v = integrate(lambda t, q, v: k.acceleration(q, v, p + push), rest + offset[:2], offset[2:], times)
    moved = np.hstack([q - rest, v])
    system = np.block([[a, (b @ push)[:, None]], [np.zeros((1, 5))]])
    linear = [(expm(system * t) @ [*offset, 1.0])[:4] for t in times]
    np.testing.assert_allclose(moved, linear, atol=2e-3 * np.abs(moved).max())
    assert np.linalg.eigvals(a).real.max() < 0


# What pushes.

POSE, PRESSURE = np.array([1.4, 0.6]), np.array([14e3, 6e3])


def with_effects(*effects: Effect, quick: bool = True, more: float = 0.0) -> np.ndarray:
    """(2, 4) how much the effects change the leg's accelerations by angles and by velocities, times the masses.

    ``more`` is the pressure of the first actuator that makes up for what they push [Pa].
    """
    m = nominal_leg()
    changed, _ = state_matrices(m, POSE, PRESSURE + np.array([more, 0.0]), "swing", effects, quick)
    plain, _ = state_matrices(m, POSE, PRESSURE, "swing")
    return np.asarray(Kinematics(m).mass(POSE) @ (changed - plain)[2:])


def test_springs_stiffen_by_their_slopes() -> None:
    k, area = Kinematics(nominal_leg()), nominal_leg().actuators[0].area
    found = with_effects(ParallelSpring("knee", stiffness=0.3, rest=POSE[1]))
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [0, -0.3, 0, 0]], atol=1e-9)
    length, arm = k.lengths(POSE)[0], k.jacobian(POSE)[0]
    found = with_effects(NonlinearStiffness("maa", cubic=3e4, centre=length - 0.02), more=3e4 * 0.02**3 / area)
    np.testing.assert_allclose(found[:, :2], -3e4 * 3 * 0.02**2 * np.outer(arm, arm), atol=1e-9)
    np.testing.assert_allclose(found[:, 2:], 0, atol=1e-9)


def test_an_area_that_narrows_is_a_spring_and_a_weaker_drive() -> None:
    m, loss = nominal_leg(), 1.0
    k, maa = Kinematics(m), nominal_leg().actuators[0]
    length, arm = k.lengths(POSE)[0], k.jacobian(POSE)[0]
    left = 1 / (1 + loss * (length / maa.rest_length - 1))
    effect = make("narrowing_area", "maa", {"loss": loss})
    # The pressure that pushes as before, and how much less it does on the way out.
    a, b = state_matrices(m, POSE, PRESSURE / [left, 1.0], "swing", (effect,))
    plain_a, plain_b = state_matrices(m, POSE, PRESSURE, "swing")
    slope = -maa.area * PRESSURE[0] * loss * left / maa.rest_length
    np.testing.assert_allclose(k.mass(POSE) @ (a - plain_a)[2:, :2], slope * np.outer(arm, arm), atol=1e-9)
    np.testing.assert_allclose(b, plain_b * [left, 1.0], rtol=1e-9)


def test_effects_with_states_are_springs_to_quick_motion_and_what_they_are_at_rest_to_slow_motion() -> None:
    arm = Kinematics(nominal_leg()).jacobian(POSE)[1]
    for effect, stiffness in (
        (make("creep", "baa", {"stiffness": 70.0, "time_constant": 2.0}), 70.0),
        (make("hysteresis", "baa", {"size": 0.5, "width": 0.01}), 50.0),
    ):
        expected = -stiffness * np.outer(arm, arm)
        np.testing.assert_allclose(with_effects(effect)[:, :2], expected, atol=1e-9)
        np.testing.assert_allclose(with_effects(effect, quick=False), 0, atol=1e-9)


@dataclass(frozen=True)
class RootDrag(ForceEffect):
    name = "root_drag"
    sits_at = ("joint",)
    summary = "drag whose slope at rest is none"
    neutral = {"size": 0.0}  # noqa: RUF012
    size: float = parameter("N·m", 0.0, 10.0, "drag at 1 rad/s")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Any, p: Any) -> ca.SX:
        return -p["size"] * ca.sign(rate) * ca.sqrt(ca.fabs(rate))


def test_what_has_no_slope_and_what_only_rubs_change_nothing() -> None:
    for effect in (RootDrag("knee", size=0.1), make("coulomb_friction", "knee", {"friction": 0.1})):
        np.testing.assert_allclose(with_effects(effect), 0, atol=1e-9)
