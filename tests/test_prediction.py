"""One step of a model with its valves: against the reduced engine, its own differences, and what can be told by hand."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.effects import Effect, make
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import Prediction, prediction
from equimus_ctrl.robots.elastic.leg import nominal_leg

LEG = nominal_leg()
BEFORE, GIVEN = np.array([9e3, 4e3]), np.array([16e3, 7e3])
LAG = (make("first_order_lag", "maa", {"time_constant": 0.08}), make("first_order_lag", "baa", {"time_constant": 0.15}))

SMOOTH: dict[str, tuple[Effect, ...]] = {
    "nothing": (),
    "lags": LAG,
    "asymmetric": (make("asymmetric_lag", "maa", {"fill": 0.06, "vent": 0.2}),),
    "limited": (make("rate_limit", "maa", {"rate": 2e4}), make("filling_flow", "baa", {"rate": 1.5e4, "power": 1.3})),
    "springs": (
        make("parallel_spring", "hip", {"stiffness": 0.5, "rest": 1.2}),
        make("nonlinear_stiffness", "baa", {"cubic": 2e4, "centre": 0.28}),
    ),
    "areas": (make("narrowing_area", "maa", {"loss": 0.8}),),
    "memories": (
        make("creep", "maa", {"stiffness": 60.0, "time_constant": 0.4}),
        make("hysteresis", "baa", {"size": 0.4, "width": 0.02}),
    ),
    "bodies": (make("payload_mass", "foot", {"mass": 0.05}), make("gravity_tilt", "base", {"angle": 0.05})),
}


def carried(p: Prediction, x: np.ndarray, u: np.ndarray, until: float, h: float) -> np.ndarray:
    rows = [x]
    for _ in range(round(until / h)):
        rows.append(np.array(p.step(rows[-1], u, np.zeros(p.nj), h)).ravel())
    return np.array(rows)


@pytest.mark.parametrize("name", SMOOTH)
def test_many_short_steps_are_the_motion_of_the_reduced_engine(name: str) -> None:
    model = Model(LEG, SMOOTH[name])
    p, h = prediction(model), 1e-3
    start = rest_pose(model, BEFORE)
    time = np.arange(501) * h
    trial = Trial("", time, np.tile(GIVEN, (501, 1)), BEFORE, 0.0, start, time)
    expected = simulate([model], [trial], dt=2.5e-4)[0].position[0]
    found = carried(p, p.at_rest(start, BEFORE), GIVEN, 0.5, h)[:, :2]
    assert np.ptp(expected, axis=0).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("name", [*SMOOTH, "dry friction"])
def test_derivatives_are_central_differences(name: str) -> None:
    effects = SMOOTH.get(name, (make("coulomb_friction", "knee", {"friction": 0.03}),))
    p = prediction(Model(LEG, (*LAG, *effects) if name in ("springs", "dry friction") else effects))
    rng = np.random.default_rng(1)
    x = p.at_rest(np.array([1.4, 0.6]), BEFORE) + rng.normal(size=p.nx) * [0.05] * p.nx
    u, d, h = GIVEN, np.array([0.1, -0.02]), 4e-3
    after, *slopes = (np.array(part) for part in p.slopes(x, u, d, h))
    np.testing.assert_array_equal(after, np.array(p.step(x, u, d, h)))
    for which, (value, slope) in enumerate(zip((x, u, d), slopes, strict=True)):
        for k in range(len(value)):
            step = 1e-6 * max(abs(value[k]), 1.0)
            sides = []
            for side in (-1, 1):
                moved = [x.copy(), u.copy(), d.copy()]
                moved[which][k] += side * step
                sides.append(np.array(p.step(*moved, h)).ravel())
            difference = (sides[1] - sides[0]) / (2 * step)
            np.testing.assert_allclose(
                slope[:, k], difference, rtol=2e-5, atol=2e-6 * max(np.abs(difference).max(), 1e-9)
            )


def test_an_unknown_torque_speeds_up_what_was_at_rest_by_itself_over_the_masses() -> None:
    p, q, h = prediction(Model(LEG)), np.array([1.4, 0.6]), 1e-5
    k = Kinematics(LEG)
    d = np.array([0.2, -0.05])
    x = p.at_rest(q, k.static_pressure(q))
    after = np.array(p.step(x, k.static_pressure(q), d, h)).ravel()
    np.testing.assert_allclose(after[2:4] / h, np.linalg.solve(k.mass(q), d), rtol=2e-3)


def test_a_robot_at_rest_stays_there() -> None:
    for name, effects in SMOOTH.items():
        model = Model(LEG, effects)
        p = prediction(model)
        x = p.at_rest(rest_pose(model, BEFORE), BEFORE)
        np.testing.assert_allclose(carried(p, x, BEFORE, 0.05, 5e-3)[-1], x, atol=1e-8, err_msg=name)


def test_without_a_lag_pressures_are_there_at_once_and_with_a_limited_rate_they_climb_at_it() -> None:
    at_once = prediction(Model(LEG))
    x = at_once.at_rest(np.array([1.4, 0.6]), BEFORE)
    np.testing.assert_array_equal(np.array(at_once.step(x, GIVEN, [0, 0], 1e-4)).ravel()[4:6], GIVEN)
    slow = prediction(Model(LEG, (make("rate_limit", "maa", {"rate": 2e4}),)))
    after = np.array(slow.step(slow.at_rest(np.array([1.4, 0.6]), BEFORE), GIVEN, [0, 0], 0.01)).ravel()
    np.testing.assert_allclose(after[4:6], [BEFORE[0] + 200.0, GIVEN[1]])


def test_without_stops_a_joint_turns_on() -> None:
    stop = next(joint.lower for joint in LEG.joints if joint.name == "knee")
    assert stop is not None
    deep, q = 0.05, np.array([1.4, stop.angle - 0.05])
    free, held = (prediction(Model(LEG), stops) for stops in (False, True))
    h = 1e-6
    pushed, loose = (np.array(p.step(p.at_rest(q, np.zeros(2)), [0, 0], [0, 0], h)).ravel()[2:4] for p in (held, free))
    push = Kinematics(LEG).mass(q) @ (pushed - loose) / h
    np.testing.assert_allclose(push, [0.0, stop.stiffness * deep], atol=1e-2 * stop.stiffness * deep)
