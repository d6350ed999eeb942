"""Where many plans lead: the plant's own motion, in both engines, pressures and unknown torques included."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.effects import Effect, make
from equimus_ctrl.effects.command import pressure_history, pressure_rollouts
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.mujoco_batch import MujocoBatch
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings
from equimus_ctrl.models.model import Model
from equimus_ctrl.predictive.costs import Wanted, Weights, costs
from equimus_ctrl.predictive.rollouts import ExactRollouts, MujocoRollouts, make_rollouts, members_of
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array

LEG, DT, STEPS = nominal_leg(), 1 / 120, 40
LAG: tuple[Effect, ...] = (
    make("first_order_lag", "maa", {"time_constant": 0.1}), make("rate_limit", "baa", {"rate": 2e5}),
)  # fmt: skip
FLOW: tuple[Effect, ...] = (make("asymmetric_lag", "maa", {"fill": 0.05, "vent": 0.2}),)
CREEP: tuple[Effect, ...] = (
    *LAG, make("creep", "maa", {"stiffness": 500.0, "time_constant": 0.5}),
)  # fmt: skip
START = np.array([1.45, 0.6, 0.1, -0.2, 1e4, 8e3])
DISTURBANCE = np.array([0.2, -0.1])


def plans(count: int = 6, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(5e3, 2e4, (count, STEPS // 8, 2)), 8, axis=1)


@pytest.mark.parametrize("effects", [(), LAG, FLOW], ids=["none", "lag and rate", "filling and venting"])
def test_pressures_are_those_of_the_plants_valves(effects: tuple[Effect, ...]) -> None:
    valve, inputs, parts = valve_settings(effects, LEG.actuator_names), plans(), 3
    means, ends = np.empty((6, STEPS * parts, 2)), np.empty((6, STEPS + 1, 2))
    first = np.array([1.2e4, 3e3])
    pressure_rollouts(first, inputs, valve, DT / parts, means, ends)
    for run in range(len(inputs)):
        wanted = np.empty((STEPS * parts, 2, 2))
        pressure_history(np.arange(STEPS) * DT + 1e-12, inputs[run], first, valve, 0.0, DT / parts, wanted)
        np.testing.assert_allclose(means[run], wanted[:, 0], rtol=1e-6)
    if not effects:
        np.testing.assert_array_equal(ends[:, 1:], inputs)


def test_both_engines_follow_the_exact_motion() -> None:
    """The exact reduced model at a twelfth of the step, an unknown torque on its joints."""
    model, inputs = Model(LEG, LAG), plans()
    truth = ExactRollouts([model], 6, 12 * STEPS, DT / 12, False)(START, DISTURBANCE, np.repeat(inputs, 12, axis=1))[0]
    truth = truth[:, ::12]
    reduced = ExactRollouts([model], 6, STEPS, DT, False)(START, DISTURBANCE, inputs)[0]
    found = MujocoRollouts([model], 6, STEPS, DT)(START, DISTURBANCE, inputs)[0]
    moved = np.abs(truth[:, -1, :2] - START[:2]).mean(axis=0)
    assert np.all(moved > 0.05)
    np.testing.assert_allclose(reduced[..., :2], truth[..., :2], atol=2e-4)
    assert np.all(np.sqrt(((found - truth)[..., :2] ** 2).mean(axis=(0, 1))) < [1.5e-3, 1e-2])
    np.testing.assert_allclose(found[..., 4:], truth[..., 4:], rtol=1e-6)
    np.testing.assert_allclose(reduced[..., 4:], truth[..., 4:], rtol=1e-6)
    undisturbed = MujocoRollouts([model], 6, STEPS, DT)(START, 0 * DISTURBANCE, inputs)[0]
    assert np.abs(undisturbed - found)[:, -1, :2].min() > 1e-3


def test_a_batch_under_constant_torques_moves_as_its_equations_of_motion_say() -> None:
    leg, dt, n = LEG.without_stops(), 1e-5, 4
    rng = np.random.default_rng(0)
    q, torque = np.tile([1.45, 0.6], (n, 1)), rng.normal(0, 0.2, (n, 2))
    held = np.tile([1e4, 8e3], (n, 1, 1))
    batch = MujocoBatch(leg, "swing", SolverSettings(timestep=dt, integrator="RK4", softness=0.01))
    v = batch.run(q, np.zeros((n, 2)), held, torque)[1][:, 1] - batch.run(q, np.zeros((n, 2)), held)[1][:, 1]
    mass = Kinematics(leg).mass(q[0])
    np.testing.assert_allclose(v / dt, np.linalg.solve(mass, torque.T).T, rtol=2e-3)
    with pytest.raises(ConfigError, match=r"torque has shape \(4, 3\), expected \(4, 2\)"):
        batch.run(q, np.zeros((n, 2)), held, np.zeros((n, 3)))


def test_models_of_an_ensemble_are_each_its_own() -> None:
    models = members_of(Model(LEG, LAG), 3, 0.2, seed=4)
    assert models[0] == Model(LEG, LAG) and all(one.effects == LAG for one in models)
    assert models == members_of(Model(LEG, LAG), 3, 0.2, seed=4)
    nominal = LEG.parameters()
    for one in models[1:]:
        strays = {key: value / nominal[key] for key, value in one.morphology.parameters().items() if nominal[key]}
        assert all(abs(value - 1) <= 0.2 + 1e-12 for value in strays.values())
        assert sum(abs(value - 1) > 1e-3 for value in strays.values()) >= 8
    inputs = plans()
    for engine in ("mujoco", "exact"):
        together = make_rollouts(models, 6, STEPS, DT, engine, False)(START, DISTURBANCE, inputs)
        assert together.shape[:3] == (3, 6, STEPS + 1)
        for one, states in zip(models, together, strict=True):
            alone = make_rollouts([one], 6, STEPS, DT, engine, False)(START, DISTURBANCE, inputs)[0]
            np.testing.assert_allclose(states, alone, rtol=1e-6, atol=1e-7)


def test_force_effects_are_the_reduced_models() -> None:
    model = Model(LEG, CREEP)
    assert isinstance(make_rollouts([Model(LEG, LAG)], 4, 5, DT), MujocoRollouts)
    assert isinstance(make_rollouts([model], 4, 5, DT, compiled=False), ExactRollouts)
    with pytest.raises(ConfigError, match="engine is 'mujoco', which does not simulate"):
        make_rollouts([model], 4, 5, DT, "mujoco")


@pytest.mark.parametrize("engine", ["mujoco", "exact"])
def test_long_steps_are_divided(engine: str) -> None:
    models, inputs = [Model(LEG, LAG)], plans()[:, ::8]
    fine = make_rollouts(models, 6, STEPS, DT, engine, False)(START, DISTURBANCE, np.repeat(inputs, 8, axis=1))[0]
    coarse = make_rollouts(models, 6, STEPS // 8, 8 * DT, engine, False)(START, DISTURBANCE, inputs)[0]
    np.testing.assert_allclose(coarse[..., :2], fine[:, ::8, :2], atol=2e-3)


@pytest.mark.parametrize(("kind", "knots"), [("zero", 4), ("linear", 4), ("cubic", 5), ("zero", 1), ("linear", 2)])
def test_splines_go_through_their_knots_and_hold_at_the_end(kind: str, knots: int) -> None:
    spline, values = Spline(kind, knots, 0.6), np.random.default_rng(0).normal(size=(knots, 2))
    np.testing.assert_allclose(spline.matrix(spline.times) @ values, values, atol=1e-12)
    np.testing.assert_array_equal(spline.matrix(np.array([0.6, 0.9, 5.0])) @ values, np.tile(values[-1], (3, 1)))
    times = np.linspace(0, 0.6, 50)
    np.testing.assert_allclose(spline.matrix(times).sum(axis=1), 1, atol=1e-12)
    # Shifted by a time and read is read that much later.
    if kind == "linear" and knots > 2:
        shifted = spline.matrix(spline.times + spline.times[1]) @ values
        np.testing.assert_allclose(shifted[:-1], values[1:], atol=1e-12)


def test_splines_that_make_no_sense() -> None:
    with pytest.raises(ConfigError, match="knots is 3, expected at least 4 for a cubic spline"):
        Spline("cubic", 3, 1.0)
    with pytest.raises(ConfigError, match="no spline 'cubik'; did you mean 'cubic'"):
        Spline("cubik", 4, 1.0)


def test_costs_are_their_sum_written_out() -> None:
    rng, n, nj = np.random.default_rng(1), 5, 2
    weights, durations = Weights(0.03, 1.0, 1e3, 0.003), rng.uniform(0.01, 0.02, n)
    angles, low = np.array([[1.0, 0.1], [2.0, 1.0]]), 1.0
    wanted = Wanted(rng.normal(1.5, 0.1, (n + 1, 6)), rng.normal(0, 1e3, (n, 2)), rng.normal(0, 1, (6, 6)))
    states, inputs = rng.normal(1.4, 0.5, (3, n + 1, 6)), rng.normal(0, 1e3, (3, n, 2))
    assert (states[..., 0] < low).any() and (states[..., 1] > 1.0).any()
    found = costs(weights, durations, angles, wanted, states, inputs)
    for m in range(3):
        total = 0.0
        for k in range(n):
            total += 0.5 * durations[k] * sum(((inputs[m, k, i] - wanted.feed[k, i]) / 1e3) ** 2 for i in range(2))
        for k in range(1, n + 1):
            span = durations[min(k, n - 1)]
            for j in range(nj):
                q = states[m, k, j]
                over = max(q - angles[1, j], 0) + max(angles[0, j] - q, 0)
                total += 0.5 * span * (over / 0.003) ** 2
                if k < n:
                    total += 0.5 * span * ((q - wanted.states[k, j]) / 0.03) ** 2
                    total += 0.5 * span * (states[m, k, nj + j] - wanted.states[k, nj + j]) ** 2
        total += 0.5 * ((wanted.last @ (states[m, n] - wanted.states[n])) ** 2).sum()
        assert found[m] == pytest.approx(total, rel=1e-12)
