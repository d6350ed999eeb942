"""Steps that are too long for a robot are told, and MuJoCo chooses its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_trials import simulate_mujoco
from equimus_ctrl.engines.steps import FOLLOWED, STABLE, rates_at, step_divisor
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.linear import fastest_rates
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array

LEG = nominal_leg()
AWAY, FALLING = np.array([1.5, 0.6]), np.array([1.6, 0.02])


def trial(start: Array, pressure: tuple[float, float] = (5e3, 2e3)) -> Trial:
    held = np.tile(pressure, (2, 1))
    return Trial("hold", np.array([0.0, 0.5]), held, held[0], 0.0, start, np.linspace(0, 0.5, 60))


def test_rates_are_those_of_small_motions_by_finite_differences() -> None:
    kinematics = Kinematics(LEG)
    h = 1e-6

    def motion(x: Array, stops: bool) -> Array:
        torque = np.zeros(2)
        if stops:  # pressed ones add their stiffness and damping, wherever they stand
            torque = -200.0 * (x[:2] - AWAY) - 1.0 * x[2:]
        return np.concatenate([x[2:], kinematics.acceleration(x[:2], x[2:], np.zeros(2), torque)])

    rest = np.concatenate([AWAY, np.zeros(2)])
    for stops, found in zip((False, True), fastest_rates(LEG, AWAY), strict=True):
        columns = [(motion(rest + h * e, stops) - motion(rest - h * e, stops)) / (2 * h) for e in np.eye(4)]
        assert found == pytest.approx(np.abs(np.linalg.eigvals(np.array(columns).T)).max(), rel=1e-5)


def test_a_step_too_long_for_the_motion_is_told_with_one_that_is_not() -> None:
    stiff = LEG.with_parameters({"baa.damping": 400.0})
    free, _ = rates_at(stiff, "swing", [AWAY])
    dt = 1.02 * STABLE / free
    with pytest.warns(UserWarning, match="too long for its fastest motion; expected at most") as caught:
        simulate([Model(stiff)], [trial(Kinematics(stiff).equilibrium((5e3, 2e3)), (5e3, 2e3))], dt=dt)
    told = float(str(caught[0].message).split("at most ")[1].removesuffix(" ms")) / 1e3
    assert told == pytest.approx(FOLLOWED / free, rel=0.05)
    simulate([Model(stiff)], [trial(AWAY)], dt=told)


def test_the_reduced_engine_is_of_fourth_order() -> None:
    """Halving the step divides the error by sixteen."""
    thrown = replace(trial(AWAY), velocity=np.array([1.0, -2.0]), sample_times=np.array([0.08]))
    exact, *ends = (simulate([Model(LEG)], [thrown], dt=0.08 / n)[0].position[0] for n in (1024, 40, 80, 160))
    errors = [np.abs(end - exact).max() for end in ends]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.2)


def test_the_reduced_engine_divides_its_step_where_a_stop_is_pressed() -> None:
    coarse, fine = (simulate([Model(LEG)], [trial(FALLING, (5e3, 4e4))], dt=dt)[0].position[0] for dt in (4e-3, 1e-4))
    assert fine[:, 1].min() < -0.03
    np.testing.assert_allclose(coarse, fine, atol=4e-4)


def test_mujoco_divides_its_step_until_it_follows_the_robot() -> None:
    assert step_divisor(LEG, "swing", [AWAY], 1e-4) == 1
    divisor = step_divisor(LEG, "swing", [FALLING], FAST_SETTINGS.timestep)
    assert divisor > 1
    found = simulate_mujoco([Model(LEG)], [trial(FALLING, (5e3, 4e4))])[0].position[0]
    exact = simulate([Model(LEG)], [trial(FALLING, (5e3, 4e4))], dt=2e-4)[0].position[0]
    assert exact[:, 1].min() < -0.035
    np.testing.assert_allclose(found, exact, atol=2e-4)
    coarse = simulate_mujoco([Model(LEG)], [trial(FALLING, (5e3, 4e4))], settings=FAST_SETTINGS)
    np.testing.assert_allclose(coarse[0].position[0], exact, atol=2e-4)
