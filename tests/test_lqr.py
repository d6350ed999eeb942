"""The regulator: optimal where the robot is linear, and on the leg along references, late valves and wrong numbers."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.linalg import expm

from equimus_ctrl.controllers.lqr import FORMAT, LqrController, LqrSettings, Schedule, regulator, waiting
from equimus_ctrl.controllers.registry import make_controller
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import ObserverFault, ObserverSettings
from equimus_ctrl.loop import run
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.linear import linearise
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.types import Array, Run

LEG, DT, POSE = nominal_leg(), 1 / 120, np.array([1.45, 0.6])
LAG = (make("first_order_lag", "maa", {"time_constant": 0.1}), make("first_order_lag", "baa", {"time_constant": 0.06}))
DELAYS = (make("transport_delay", "maa", {"delay": 0.05}), make("transport_delay", "baa", {"delay": 0.1}))
KNOWN: dict[str, tuple[Effect, ...]] = {"nothing": (), "lags": LAG, "late": (*LAG, *DELAYS)}


def smooth(time: float) -> Array:
    return POSE + np.array([0.07, 0.12]) * np.sin([2.0 * time, 3.0 * time])


def tracked(effects: tuple[Effect, ...], known: tuple[Effect, ...], leg: object = LEG, **options: float) -> Run:
    plant = MujocoPlant(Model(leg, effects), nominal=Model(LEG, known), noise=options.pop("noise", 0.0))  # type: ignore[arg-type]
    return run(plant, LqrController(LqrSettings(**options)), FunctionReference(smooth), 5.0, seed=1)  # type: ignore[arg-type]


def rmse(done: Run, after: float = 1.0) -> Array:
    error = (done.position - done.reference)[done.time > after]
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


def test_a_regulator_is_worked_out_once_for_one_model_pose_and_weights() -> None:
    model, settings = Model(LEG, LAG), LqrSettings(integral=0.05)
    found = regulator(model, POSE, settings, DT)
    assert regulator(Model(nominal_leg(), LAG), POSE.copy(), replace(settings), DT) is found
    assert not any(own.flags.writeable for own in (found.a, found.b, found.q, found.r, found.gain, found.cost))
    others = [
        regulator(Model(LEG, KNOWN["late"]), POSE, settings, DT),
        regulator(model, POSE + 0.01, settings, DT),
        regulator(model, POSE, settings, DT / 2),
        *(regulator(model, POSE, replace(settings, **{key: 0.07}), DT) for key in ("angle", "rate", "integral")),
        regulator(model, POSE, replace(settings, pressure=500.0), DT),
    ]
    assert all(own.gain.shape != found.gain.shape or not np.array_equal(own.gain, found.gain) for own in others)


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize("integral", [0.0, 0.05])
def test_what_is_simulated_costs_half_of_x_p_x(name: str, integral: float) -> None:
    found = regulator(Model(LEG, KNOWN[name]), POSE, LqrSettings(integral=integral), DT)
    x = np.random.default_rng(2).normal(size=len(found.a))
    expected, cost = 0.5 * x @ found.cost @ x, 0.0
    for _ in range(20_000):
        u = -found.gain @ x
        cost += 0.5 * (x @ found.q @ x + u @ found.r @ u)
        x = found.a @ x + found.b @ u
    assert cost == pytest.approx(expected, rel=1e-6)
    assert np.abs(np.linalg.eigvals(found.a - found.b @ found.gain)).max() < 1


def test_no_other_gains_cost_less() -> None:
    found = regulator(Model(LEG, LAG), POSE, LqrSettings(), DT)
    rng = np.random.default_rng(0)
    for _ in range(20):
        gain = found.gain * (1 + 0.05 * rng.normal(size=found.gain.shape))
        closed = found.a - found.b @ gain
        if np.abs(np.linalg.eigvals(closed)).max() < 1:
            cost = found.q + gain.T @ found.r @ gain
            for _ in range(24):  # twice as many samples each time
                cost, closed = cost + closed.T @ cost @ closed, closed @ closed
            assert np.linalg.eigvalsh(cost - found.cost).min() > -1e-9 * np.abs(cost).max()


def test_the_robot_it_is_made_for_is_the_sampled_linear_model_with_commands_under_way() -> None:
    model = Model(LEG, KNOWN["late"])
    found, system = regulator(model, POSE, LqrSettings(integral=0.0), DT), linearise(Model(LEG, LAG), POSE)
    sampled = control.c2d(system, DT)
    assert waiting(model, DT).tolist() == [0, 6]
    n = system.nstates
    np.testing.assert_allclose(found.a[:n, :n], sampled.A, atol=1e-10)
    np.testing.assert_allclose(found.b[:n, 0], sampled.B[:, 0], rtol=1e-8, atol=1e-14)
    # A command to the slower valve takes six samples more.
    x = np.zeros(len(found.a))
    for k in range(8):
        x = found.a @ x + found.b @ [0.0, 1.0 if k == 0 else 0.0]
        assert bool(np.any(x[:n])) == (k >= 6)
    np.testing.assert_allclose(found.a[:n] @ np.eye(len(found.a))[n], sampled.B[:, 1], rtol=1e-8, atol=1e-14)


def test_linearised_it_speaks_python_control() -> None:
    model = Model(LEG, (*LAG, make("sensor_scale", "knee", {"scale": 1.1})))
    system = linearise(model, POSE)
    assert isinstance(system, control.StateSpace)
    assert system.state_labels == ["pos_hip", "pos_knee", "vel_hip", "vel_knee", "pressure_maa", "pressure_baa"]
    assert system.input_labels == ["cmd_maa", "cmd_baa"] and system.output_labels == ["pos_hip", "pos_knee"]
    # At rest the angles follow the pressures as the nonlinear leg's do.
    k, held, step = Kinematics(LEG), holding_pressure(model, POSE), 1.0
    for i in range(2):
        moved = [k.equilibrium(held + side * step * np.eye(2)[i]) for side in (-1, 1)]
        slope = (moved[1] - moved[0]) / (2 * step) * [1.0, 1.1]
        np.testing.assert_allclose(system.dcgain()[:, i], slope, rtol=1e-4)
    response = control.forced_response(system, np.arange(0, 1, 0.01), np.full((2, 100), 100.0))
    assert response.outputs.shape == (2, 100)
    np.testing.assert_allclose(expm(system.A * 0.01)[4, 4], np.exp(-0.1), rtol=1e-9)


@pytest.mark.slow
def test_it_follows_a_smooth_reference_through_lags_and_delays_that_it_knows() -> None:
    late = KNOWN["late"]
    known = rmse(tracked(late, late), 3.0)
    assert np.all(known < 2e-4)
    assert np.all(known < 0.1 * rmse(tracked(late, LAG, estimate_valves=False), 3.0))  # knowing a delay is worth it
    assert np.all(rmse(tracked(late, late, integral=0.05), 3.0) < 5e-3)
    assert np.all(rmse(tracked(late, late, noise=2e-3)) < 3e-3)  # the measurement's own included


@pytest.mark.slow
def test_valves_that_are_later_than_it_knows_do_not_make_it_swing() -> None:
    assert np.all(rmse(tracked(KNOWN["lags"], ())) < 0.02)
    late = (make("transport_delay", "baa", {"delay": 0.1}),)
    assert np.all(rmse(tracked(late, ())) < 0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("how", "seed"), [("integral", 0), ("disturbance", 1)])
def test_wrong_legs_end_where_they_should(how: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrong = {
        name: value * (1 + (0.02 if name.endswith("rest_length") else 0.15) * rng.uniform(-1, 1))
        for name, value in LEG.parameters().items()
        if name.endswith((".stiffness", ".area", ".rest_length"))
    }
    settings = LqrSettings(integral=0.05 if how == "integral" else 0.0, disturbance=how == "disturbance")
    plant = MujocoPlant(Model(LEG.with_parameters(wrong), KNOWN["late"]), nominal=Model(LEG, KNOWN["late"]))
    done = run(plant, LqrController(settings), HoldReference(POSE), 8.0)
    np.testing.assert_allclose(done.position[-60:].mean(axis=0), POSE, atol=5e-3)


@pytest.mark.slow
def test_against_a_limit_the_integral_does_not_wind_up() -> None:
    plant, out = MujocoPlant(Model(LEG, LAG)), np.array([0.6, 0.1])
    reach = Kinematics(LEG).static_pressure(out)
    assert not np.all((reach >= 0) & (reach <= 5e4))
    reference = FunctionReference(lambda t: out if 1 < t < 4 else POSE)
    done = run(plant, LqrController(), reference, 8.0)
    assert np.all((done.command >= 0) & (done.command <= 5e4))
    np.testing.assert_allclose(done.position[-60:].mean(axis=0), POSE, atol=0.01)


def test_gains_between_poses_are_in_between() -> None:
    schedule = Schedule(Model(LEG, LAG), LqrSettings(), DT)
    low, high = LEG.joint_range
    cells = np.ceil((high - low) / 0.2)
    node = low + (high - low) * np.array([4, 3]) / cells
    other = node + (high - low) * np.array([1, 0]) / cells
    np.testing.assert_allclose(schedule.gain(node), regulator(Model(LEG, LAG), node, LqrSettings(), DT).gain)
    np.testing.assert_allclose(
        schedule.gain((node + other) / 2), (schedule.gain(node) + schedule.gain(other)) / 2, rtol=1e-9
    )
    np.testing.assert_array_equal(schedule.gain(high + 1.0), schedule.gain(high))


def test_without_measurements_it_says_so() -> None:
    plant, controller = MujocoPlant(Model(LEG)), LqrController(LqrSettings(observer=ObserverSettings(patience=0.05)))
    observation = plant.reset()
    state = controller.init(plant.spec, observation)
    blind = np.full(2, np.nan)
    for _ in range(6):
        command, state = controller.step(observation, HoldReference(POSE), state)
        observation = replace(plant.step(command), position=blind)
    with pytest.raises(ObserverFault, match=r"^hip was last measured at 0\.000 s"):
        controller.step(replace(observation, time=0.06), HoldReference(POSE), state)
    with pytest.raises(ControllerError, match="needs a model"):
        controller.init(replace(plant.spec, model=None), plant.reset())


def test_settings_come_from_tables_and_go_back() -> None:
    settings = LqrSettings(angle=0.02, disturbance=False, observer=ObserverSettings(noise=1e-3))
    assert LqrSettings.from_dict(settings.to_dict()) == settings
    controller = make_controller("lqr", {"angle": 1, "observer": {"noise": 0.01}})
    assert isinstance(controller, LqrController)
    assert controller.settings.observer == replace(LqrSettings().observer, noise=0.01)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (
            {"angel": 1.0},
            "lqr.toml: there is no key 'angel'; did you mean 'angle'? (known: angle, bandwidth, disturbance, "
            "estimate_valves, integral, observer, pressure, rate, spacing, start_time)",
        ),
        ({"angle": "wide"}, "lqr.toml: angle is 'wide', expected a number"),
        ({"angle": True}, "lqr.toml: angle is True, expected a number"),
        ({"angle": 0.0}, "lqr.toml: angle is 0, expected more than 0"),
        ({"integral": -1.0}, "lqr.toml: integral is -1, expected at least 0"),
        ({"disturbance": 1}, "lqr.toml: disturbance is 1, expected true or false"),
        ({"observer": 3}, "lqr.toml: observer is 3, expected a table"),
        (
            {"observer": {"noise": -1.0}},
            "lqr.toml: observer: noise is -1.0, expected a number of at least 1e-09",
        ),
        ({"format": "equimus-ctrl/pid/1"}, f"lqr.toml: format is 'equimus-ctrl/pid/1', expected '{FORMAT}'"),
    ],
)
def test_settings_that_make_no_sense(table: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        LqrSettings.from_dict(table, "lqr.toml")
    assert str(caught.value) == sentence
