"""The linearisation: finite differences of the motion, textbook frequencies, and small motions themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from morphologies import STRUCTURES, integrate, pendulum, random_morphology, random_poses
from scipy.linalg import expm

from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.leg import nominal_leg
from equimus_ctrl.models.linear import state_matrices
from equimus_ctrl.models.morphology import Phase


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
