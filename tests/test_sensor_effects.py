"""What a sensor makes of a motion: sampling, delay, play, factor and offset, in the engine and in the plant."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equimus_ctrl.effects import Backlash, Effect, FirstOrderLag, SensorDelay, SensorOffset, SensorScale
from equimus_ctrl.effects.sensors import follow, hermite, sample, sensor_settings
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.predict import measured_start, predict
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Recording, Start

LEG = nominal_leg()
IDEAL = np.array([0.0, 1.0, 0.0, 0.0])


def sampled(q: Array, v: Array, start: float, dt: float, sensor: Array, times: Array) -> Array:
    out = np.full(len(times), np.nan)
    sample(q, v, start, dt, sensor, times, out)
    return out


# --- sampling ---------------------------------------------------------------------------------------------------


@given(
    c=st.lists(st.floats(-3, 3), min_size=4, max_size=4),
    start=st.floats(-5, 5),
    dt=st.floats(1e-3, 0.3),
    n=st.integers(2, 30),
    seed=st.integers(0, 999),
)
@settings(deadline=None, max_examples=100, derandomize=True)
def test_a_cubic_motion_is_sampled_exactly(c: list[float], start: float, dt: float, n: int, seed: int) -> None:
    p = np.polynomial.Polynomial(c)
    grid = dt * np.arange(n)
    times = np.sort(np.random.default_rng(seed).uniform(0, grid[-1], 17))
    found = sampled(p(grid), p.deriv()(grid), start, dt, IDEAL, start + times)
    np.testing.assert_allclose(found, p(times), rtol=0, atol=1e-9 * (1 + np.abs(p(grid)).max()))


def test_on_the_grid_the_samples_are_the_grids_own() -> None:
    rng = np.random.default_rng(0)
    q, v = rng.normal(0, 1, 20), rng.normal(0, 1, 20)
    np.testing.assert_allclose(sampled(q, v, 0.0, 0.125, IDEAL, np.arange(20) * 0.125), q, rtol=1e-15)


def test_before_the_grid_the_joint_stood_still() -> None:
    q, v = np.array([1.0, 2.0, 3.0]), np.array([7.0, 1.0, 1.0])
    late = np.array([0.0, 1.0, 0.5, 0.0])
    found = sampled(q, v, 4.0, 0.1, late, np.array([4.0, 4.2, 4.5]))
    np.testing.assert_array_equal(found, [1.0, 1.0, 1.0])


def test_factor_and_offset_act_on_the_angle_in_this_order() -> None:
    q, v = np.array([1.0, 1.0]), np.zeros(2)
    np.testing.assert_allclose(sampled(q, v, 0.0, 0.1, np.array([0.2, 1.5, 0.0, 0.0]), np.array([0.0, 0.1])), 1.7)


def test_each_effect_writes_its_own_joints_row() -> None:
    effects = [SensorOffset("knee", 0.1), SensorScale("hip", 1.2), SensorDelay("knee", 0.03), Backlash("hip", 0.05)]
    found = sensor_settings([*effects, FirstOrderLag("maa", 0.1)], ("hip", "knee"))
    np.testing.assert_array_equal(found, [[0.0, 1.2, 0.0, 0.05], [0.1, 1.0, 0.03, 0.0]])


def test_hermite_meets_both_ends_with_their_slopes() -> None:
    values = (0.3, -2.0, 0.7, 5.0, 0.2)
    assert hermite(*values, 0.0) == 0.3 and hermite(*values, 1.0) == pytest.approx(0.7, rel=1e-15)
    for share, slope in ((1e-7, -2.0), (1 - 1e-7, 5.0)):
        rate = (hermite(*values, share + 1e-7) - hermite(*values, share - 1e-7)) / (2e-7 * 0.2)
        assert rate == pytest.approx(slope, abs=1e-4)


# --- play -------------------------------------------------------------------------------------------------------


def dragged(angles: Array, play: float) -> Array:
    """A pin in a slot of width ``play``: the slot moves only where the pin pushes one of its ends."""
    slot = float(angles[0])
    out = []
    for angle in angles:
        if angle > slot + play / 2:
            slot = angle - play / 2
        elif angle < slot - play / 2:
            slot = angle + play / 2
        out.append(slot)
    return np.array(out)


@given(
    angles=st.lists(st.floats(-2, 2), min_size=2, max_size=40),
    play=st.floats(1e-3, 1),
)
@settings(deadline=None, max_examples=200, derandomize=True)
def test_play_is_a_pin_in_a_slot(angles: list[float], play: float) -> None:
    q = np.array(angles)
    found = sampled(q, np.zeros(len(q)), 0.0, 1.0, np.array([0.0, 1.0, 0.0, play]), np.arange(len(q)) * 1.0)
    np.testing.assert_allclose(found, dragged(q, play), rtol=0, atol=1e-12)
    assert np.all(np.abs(found - q) <= play / 2 + 1e-12)
    held = q[0]
    for angle, expected in zip(q, found, strict=True):
        held = follow(held, angle, play)
        assert held == pytest.approx(expected, abs=1e-12)


def test_play_remembers_what_happened_between_two_samples() -> None:
    """Out and back between two samples: the slot was dragged all the same."""
    q = np.array([0.0, 0.5, 1.0, 0.5, 0.0])
    found = sampled(q, np.zeros(5), 0.0, 0.1, np.array([0.0, 1.0, 0.0, 0.2]), np.array([0.0, 0.4]))
    np.testing.assert_allclose(found, [0.0, 0.1])


def test_samples_between_do_not_change_those_after() -> None:
    t = np.arange(0, 2, 0.01)
    sensor = np.array([0.1, 0.9, 0.033, 0.15])
    few = np.arange(0, 1.99, 0.25)
    many = np.unique(np.concatenate([few, np.arange(0, 1.99, 3e-3)]))
    sparse, dense = (sampled(np.sin(5 * t), 5 * np.cos(5 * t), 0.0, 0.01, sensor, times) for times in (few, many))
    # Between grid points the motion may turn, which only a sample there sees.
    np.testing.assert_allclose(sparse, dense[np.isin(many, few)], rtol=0, atol=25 * 0.005**2 / 2)


def test_factor_and_offset_come_after_play_and_delay() -> None:
    t = np.arange(0, 2, 1e-3)
    q, v = np.sin(5 * t), 5 * np.cos(5 * t)
    times = np.arange(0.1, 1.9, 0.01)
    found = sampled(q, v, 0.0, 1e-3, np.array([0.3, 1.1, 0.05, 0.2]), times)
    seen = dragged(np.where(t < 0.05, 0.0, np.sin(5 * (t - 0.05))), 0.2)
    np.testing.assert_allclose(found, 0.3 + 1.1 * np.interp(times, t, seen), atol=1e-5)


# --- in the engine ----------------------------------------------------------------------------------------------

TIMES = np.array([0.0, 0.25, 0.5, 0.75])
COMMANDS = np.array([[15e3, 2e3], [4e3, 12e3], [20e3, 1e3], [8e3, 9e3]])
START = np.array([1.3, 0.9])


def motion(effects: tuple[Effect, ...], times: Array) -> Array:
    one = Trial("t", TIMES, COMMANDS, COMMANDS[0], 0.0, START, times)
    found = simulate([Model(LEG, effects)], [one], threads=1)[0]
    assert found.sound.all()
    return found.position[0]


def test_a_late_sensor_shows_what_was() -> None:
    times = np.arange(0, 1, 1 / 97)
    found = motion((SensorDelay("knee", 0.0437),), times)
    true = motion((), np.maximum(times - 0.0437, 0.0))
    np.testing.assert_allclose(found[:, 1], true[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[:, 0], motion((), times)[:, 0])


def test_play_in_the_engine_is_the_plain_definition() -> None:
    fine = np.arange(0, 1, 1e-3)
    found = motion((Backlash("hip", 0.04),), fine)
    np.testing.assert_allclose(found[:, 0], dragged(motion((), fine)[:, 0], 0.04), rtol=0, atol=1e-12)


ALL: tuple[Effect, ...] = (
    SensorOffset("hip", 0.05),
    SensorScale("knee", 1.07),
    SensorDelay("hip", 0.031),
    Backlash("knee", 0.03),
    SensorOffset("knee", -0.02),
    Backlash("hip", 0.02),
)


@pytest.mark.parametrize(
    "effects", [ALL[:1], ALL[1:2], ALL[2:3], ALL[3:4], ALL], ids=["offset", "scale", "delay", "play", "all"]
)
def test_the_plant_sees_what_the_engine_predicts(effects: tuple[Effect, ...]) -> None:
    """MuJoCo's motion is within 1e-4 rad of the reduced engine's; its sensors are the same."""
    plant = MujocoPlant(Model(LEG, effects), rates=PlantRates(control=120, sensor=240, physics=480))
    seen = [plant.reset(Start(position=START, command=COMMANDS[0]))]
    for k in range(119):
        seen.append(plant.step(COMMANDS[int(k / 120 / 0.25)]))
    times = np.array([o.stamp for o in seen])
    found = np.array([o.position for o in seen])
    np.testing.assert_allclose(found, motion(effects, times), rtol=0, atol=1.5e-4)
    plain = motion((), times)
    assert np.abs(found - plain).max() > 0.005


def test_a_plant_reset_forgets_what_its_sensors_remembered() -> None:
    plant = MujocoPlant(Model(LEG, ALL))
    runs = []
    for _ in range(2):
        seen = [plant.reset(Start(position=START))]
        seen += [plant.step(COMMANDS[k // 20]) for k in range(60)]
        runs.append(np.array([o.position for o in seen]))
    np.testing.assert_array_equal(runs[0], runs[1])


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_a_prediction_starts_at_what_was_measured_not_beside_it(engine: str) -> None:
    """The first measurement passed through the sensor already; the joint stands where that sensor says so."""
    time = np.arange(0, 0.5, 0.01)
    position = np.tile([1.4, 0.5], (len(time), 1))
    recording = Recording("r", time, np.tile([1e4, 2e3], (len(time), 1)), position, LEG.actuator_names, LEG.joint_names)
    effects = (SensorOffset("hip", 0.05), SensorScale("knee", 1.2), SensorOffset("knee", -0.1))
    found = predict(Model(LEG, effects), recording, engine=engine)  # type: ignore[arg-type]
    np.testing.assert_allclose(found[0], measured_start(recording), rtol=1e-12)
    true = predict(Model(LEG), recording, engine=engine, start=np.array([1.35, (0.5 + 0.1) / 1.2]))  # type: ignore[arg-type]
    np.testing.assert_allclose(found, true * [1.0, 1.2] + [0.05, -0.1], rtol=0, atol=1e-12)


def test_a_start_handed_in_is_where_the_joints_are() -> None:
    time = np.arange(0, 0.1, 0.01)
    recording = Recording(
        "r", time, np.zeros((10, 2)), np.tile([1.4, 0.5], (10, 1)), LEG.actuator_names, LEG.joint_names
    )
    found = predict(Model(LEG, (SensorOffset("hip", 0.05),)), recording, start=np.array([1.5, 0.2]))
    np.testing.assert_allclose(found[0], [1.55, 0.2], rtol=1e-15)
