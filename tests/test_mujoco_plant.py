"""The simulated plant: how it moves, what its sensor shows and when, what its valves do, and what it tells."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from morphologies import integrate, pendulum, random_morphology
from plant_runs import LEG, STEP, drive, positions

from equimus_ctrl.effects import AsymmetricLag, FirstOrderLag, TransportDelay
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates, make_spec, whole_ratio
from equimus_ctrl.robots.elastic.leg import ideal_leg
from equimus_ctrl.types import Start

# --- motion -----------------------------------------------------------------------------------------------------


def test_the_leg_moves_as_the_exact_model() -> None:
    plant = MujocoPlant(Model(LEG))
    start = np.array([1.3, 0.9])
    plant.reset(Start(position=start))
    found = positions(drive(plant, lambda t: STEP, 120))
    k = Kinematics(LEG)
    expected, _ = integrate(
        lambda t, q, v: k.acceleration(q, v, STEP), start, np.zeros(2), np.arange(121) / 120, rtol=1e-8, atol=1e-10
    )
    np.testing.assert_allclose(found, expected[1:], atol=1e-5)


def test_stance_starts_on_the_foothold_and_moves_as_the_exact_model() -> None:
    free = replace(LEG, joints=tuple(replace(j, lower=None, upper=None) for j in LEG.joints))
    plant = MujocoPlant(Model(free, phase="stance"))
    start = Start(position=np.array([1.4, 0.5]), velocity=np.array([0.4, -0.3]))
    plant.reset(start)
    np.testing.assert_allclose(plant.data.site("foot").xpos, 0, atol=1e-12)
    found = positions(drive(plant, lambda t: STEP, 36))
    k = Kinematics(free, "stance")
    assert start.position is not None
    assert start.velocity is not None
    expected, _ = integrate(
        lambda t, q, v: k.acceleration(q, v, STEP), start.position, start.velocity, np.arange(37) / 120, rtol=1e-8
    )
    np.testing.assert_allclose(found, expected[1:], atol=1e-4)
    np.testing.assert_allclose(plant.data.site("foot").xpos, 0, atol=1e-6)
    assert plant.spec.phase == "stance"


def test_a_start_with_velocity_moves_on_with_it(plant: MujocoPlant) -> None:
    first = plant.reset(Start(position=np.array([1.3, 0.9]), velocity=np.array([0.5, -1.0]), command=STEP))
    np.testing.assert_array_equal(first.position, [1.3, 0.9])
    after = plant.step(STEP)
    k = Kinematics(LEG)
    expected, _ = integrate(
        lambda t, q, v: k.acceleration(q, v, STEP), np.array([1.3, 0.9]), np.array([0.5, -1.0]), np.array([0, 1 / 120])
    )
    np.testing.assert_allclose(after.position, expected[-1], atol=1e-6)


@pytest.mark.parametrize("command", [(0.0, 0.0), (12e3, 3e3), (50e3, 0.0), (0.0, 50e3), (50e3, 50e3)])
def test_a_start_at_the_equilibrium_stays_there(plant: MujocoPlant, command: tuple[float, float]) -> None:
    """Two seconds; (0, 50) and (50, 50) kPa press the knee onto its stop."""
    first = plant.reset(Start(command=np.array(command)))
    np.testing.assert_allclose(first.position, Kinematics(LEG).equilibrium(command), atol=1e-12)
    np.testing.assert_array_equal(first.command, command)
    seen = positions(drive(plant, lambda t: np.array(command), 240))
    assert np.abs(seen - first.position).max() < (2e-6 if command == (50e3, 0.0) else 1e-6)


def test_by_default_a_run_starts_at_rest_under_the_lowest_command(plant: MujocoPlant) -> None:
    first = plant.reset()
    np.testing.assert_allclose(first.position, Kinematics(LEG).equilibrium([0, 0]), atol=1e-12)
    np.testing.assert_array_equal(first.command, [0, 0])


def test_an_ideal_leg_and_robots_of_other_shapes_are_plants_too() -> None:
    for m in (ideal_leg(), random_morphology("one_joint", 1), random_morphology("more_drives_than_joints", 1)):
        plant = MujocoPlant(Model(m))
        plant.reset(Start(position=np.full(len(m.joints), 0.3)))
        after = plant.step(np.full(len(m.actuators), 1e4))
        assert after.position.shape == (len(m.joints),)
        assert plant.spec.joints == m.joint_names


# --- what the sensor shows --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("control", "sensor", "physics"),
    [(120, 120, 480), (60, 120, 480), (240, 120, 480), (480, 120, 480), (120, 40, 480), (30, 20, 480), (50, 100, 500)],
)
def test_the_sensor_samples_at_its_own_rate_and_holds(control: float, sensor: float, physics: float) -> None:
    """What is seen at a control instant is the truth at the last sensor instant, read off a plant seen at each step."""
    rates = PlantRates(control=control, sensor=sensor, physics=physics)
    plant = MujocoPlant(Model(LEG), rates=rates)
    every_step = MujocoPlant(Model(LEG), rates=PlantRates(control=physics, sensor=physics, physics=physics))
    start = Start(position=np.array([1.3, 0.9]))
    truth = [every_step.reset(start).position]
    seen = [plant.reset(start)]
    n = round(0.2 * control)
    per_control, per_sensor = round(physics / control), round(physics / sensor)
    seen += drive(plant, lambda t: STEP, n)
    truth += [o.position for o in drive(every_step, lambda t: STEP, n * per_control)]
    for k, observation in enumerate(seen):
        assert observation.time == pytest.approx(k / control, abs=1e-12)
        sampled = k * per_control // per_sensor * per_sensor
        assert observation.stamp == pytest.approx(sampled / physics, abs=1e-12)
        assert observation.stamp <= observation.time + 1e-12
        np.testing.assert_allclose(observation.position, truth[sampled], atol=1e-12)


def test_a_controller_twice_as_fast_as_the_sensor_sees_each_sample_twice() -> None:
    plant = MujocoPlant(Model(LEG), rates=PlantRates(control=240, sensor=120, physics=480), noise=1e-3)
    plant.reset(seed=1)
    seen = positions(drive(plant, lambda t: STEP, 41))
    np.testing.assert_array_equal(seen[1:-1:2], seen[2::2])
    assert np.all(np.any(seen[1:-2:2] != seen[3::2], axis=1))


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        ({"control": 100}, "physics rate over control rate: 480 Hz is not a whole multiple of 100 Hz"),
        ({"sensor": 100}, "physics rate over sensor rate: 480 Hz is not a whole multiple of 100 Hz"),
        ({"physics": 100}, "physics rate over control rate: 100 Hz is not a whole multiple of 120 Hz"),
        ({"control": 960}, "physics rate over control rate: 480 Hz is not a whole multiple of 960 Hz"),
        ({"physics": 500}, "physics rate over control rate: 500 Hz is not a whole multiple of 120 Hz"),
        ({"control": 0}, "control rate is 0 Hz, expected more than 0"),
        ({"sensor": -120}, "sensor rate is -120 Hz, expected more than 0"),
        ({"physics": math.inf}, "physics rate is inf Hz, expected more than 0"),
        ({"sensor": math.nan}, "sensor rate is nan Hz, expected more than 0"),
    ],
)
def test_rates_that_do_not_fit_are_refused_in_one_sentence(rates: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        PlantRates(**rates)
    assert str(caught.value) == message


def test_a_ratio_may_be_whole_but_for_rounding() -> None:
    assert whole_ratio(1 / 0.1, 1 / 0.3, "x") == 3
    assert whole_ratio(120.0, 120.0, "x") == 1


def test_noise_is_white_normal_and_of_the_size_asked_for() -> None:
    """Against the same run without noise; the sensor's noise never enters the motion."""
    sigma = 2e-3
    every_step = PlantRates(control=480, sensor=480, physics=480)
    noisy, clean = (MujocoPlant(Model(LEG), noise=size, rates=every_step) for size in (sigma, 0.0))
    noisy.reset(seed=7)
    clean.reset()
    error = positions(drive(noisy, lambda t: STEP, 1500)) - positions(drive(clean, lambda t: STEP, 1500))
    np.testing.assert_allclose(noisy.position, clean.position, rtol=1e-15)
    n = len(error)
    assert np.abs(error.mean(axis=0)).max() < 4 * sigma / math.sqrt(n)
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=4 / math.sqrt(2 * n))
    unit = error / sigma
    assert np.abs((unit[1:] * unit[:-1]).mean(axis=0)).max() < 4 / math.sqrt(n)
    assert abs((unit[:, 0] * unit[:, 1]).mean()) < 4 / math.sqrt(n)
    assert (unit**4).mean() == pytest.approx(3.0, abs=4 * math.sqrt(96 / (2 * n)))


def test_the_first_observation_is_noisy_too() -> None:
    plant = MujocoPlant(Model(LEG), noise=1e-3)
    assert np.all(plant.reset(seed=1).position != plant.position)


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    plant = MujocoPlant(Model(LEG, (TransportDelay("maa", 0.03), FirstOrderLag("baa", 0.1))), noise=1e-3)

    def run(seed: int) -> bytes:
        first = plant.reset(seed=seed)
        return positions([first, *drive(plant, lambda t: STEP * math.sin(9 * t) ** 2, 60)]).tobytes()

    one = run(3)
    assert run(4) != one
    assert run(3) == one


@pytest.mark.parametrize("noise", [-1e-3, math.nan, math.inf, 1e6])
def test_noise_that_cannot_be_is_refused(noise: float) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"noise is {noise:g} rad or m, expected 0 to 1")):
        MujocoPlant(Model(LEG), noise=noise)


# --- valves -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("periods", [1, 3, 7])
def test_a_delay_shifts_the_response_by_exactly_itself(periods: int) -> None:
    delayed = MujocoPlant(Model(LEG, tuple(TransportDelay(name, periods / 120) for name in ("maa", "baa"))))
    prompt = MujocoPlant(Model(LEG))
    delayed.reset()
    prompt.reset()
    at = 5
    late = positions(drive(delayed, lambda t: STEP if round(120 * t) >= at else 0 * STEP, 60))
    soon = positions(drive(prompt, lambda t: STEP if round(120 * t) >= at + periods else 0 * STEP, 60))
    np.testing.assert_allclose(late, soon, rtol=0, atol=1e-12)
    moved = np.flatnonzero(np.abs(late - late[0]).max(axis=1) > 1e-4)
    assert moved[0] == at + periods


def test_a_delay_of_one_actuator_leaves_the_other_alone() -> None:
    plant = MujocoPlant(Model(LEG, (TransportDelay("baa", 0.1),)))
    plant.reset()
    plant.step(STEP)
    np.testing.assert_array_equal(plant.pressure, [STEP[0], 0.0])
    drive(plant, lambda t: STEP, 11)
    np.testing.assert_array_equal(plant.pressure, [STEP[0], 0.0])
    plant.step(STEP)
    np.testing.assert_allclose(plant.pressure, STEP, rtol=1e-12)


def test_the_past_is_remembered_as_long_as_the_delay_and_beyond_the_first_buffer() -> None:
    """Two seconds of delay under a command that changes at every instant, over more than the 256 first kept."""
    plant = MujocoPlant(Model(LEG, (TransportDelay("maa", 2.0),)))
    plant.reset()
    sent = [np.array([1e3 * (k % 50), 0.0]) for k in range(600)]
    for k, command in enumerate(sent):
        plant.step(command)
        # The mean over the last physics step: at its very end the pressure jumps.
        assert plant.data.ctrl[0] == pytest.approx(sent[k - 240][0] if k >= 240 else 0.0, abs=1e-6)


def test_pressures_rise_and_fall_with_their_time_constants() -> None:
    plant = MujocoPlant(Model(LEG, (FirstOrderLag("maa", 0.15), AsymmetricLag("baa", 0.08, 0.3))))
    plant.reset()
    times = np.arange(1, 61) / 120
    found = []
    for _ in times:
        plant.step(STEP)
        found.append(plant.pressure)
    rising = STEP * (1 - np.exp(-times[:, None] / [0.15, 0.08]))
    np.testing.assert_allclose(found, rising, rtol=1e-9)
    full, found = plant.pressure, []
    for _ in times:
        plant.step([0.0, 0.0])
        found.append(plant.pressure)
    np.testing.assert_allclose(found, full * np.exp(-times[:, None] / [0.15, 0.3]), rtol=1e-9)


def test_a_run_starts_with_the_pressures_settled() -> None:
    plant = MujocoPlant(Model(LEG, (TransportDelay("maa", 0.5), FirstOrderLag("baa", 1.0))))
    first = plant.reset(Start(command=STEP))
    np.testing.assert_array_equal(plant.pressure, STEP)
    seen = positions(drive(plant, lambda t: STEP, 60))
    np.testing.assert_allclose(seen, np.tile(first.position, (60, 1)), atol=1e-6)


# --- what a controller may know ---------------------------------------------------------------------------------


def test_the_spec_tells_names_limits_and_a_nominal_model() -> None:
    other = LEG.with_parameters({"maa.stiffness": 300.0})
    plant = MujocoPlant(Model(other), nominal=LEG, rates=PlantRates(control=60))
    spec = plant.spec
    assert (spec.joints, spec.actuators) == (("hip", "knee"), ("maa", "baa"))
    assert spec.control_dt == pytest.approx(1 / 60)
    np.testing.assert_array_equal(spec.command_low, [0, 0])
    np.testing.assert_array_equal(spec.command_high, [50e3, 50e3])
    np.testing.assert_array_equal([spec.joint_low, spec.joint_high], LEG.joint_range)
    assert spec.model is LEG
    assert MujocoPlant(Model(other)).spec.model is other
    effects = (TransportDelay("maa", 0.5),)
    assert MujocoPlant(Model(other, effects)).spec.effects == effects
    known = MujocoPlant(Model(other), nominal=Model(LEG, effects)).spec
    assert known.model is LEG and known.effects == effects and spec.effects == ()
    with pytest.raises(ConfigError, match=r"nominal model \S+ has joints .*, but \S+ has hip, knee and maa, baa"):
        MujocoPlant(Model(LEG), nominal=pendulum())
    for array in (spec.command_low, spec.command_high, spec.joint_low, spec.joint_high):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    assert make_spec(LEG, 0.01, None).model is None


def test_what_is_handed_out_cannot_be_used_to_change_the_plant(plant: MujocoPlant) -> None:
    first = plant.reset()
    seen = [first, plant.step(STEP)]
    for observation in seen:
        for array in (observation.position, observation.command, observation.clipped):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0
    plant.position[:] = 9.0
    plant.pressure[:] = 9.0
    after = plant.step(STEP).position
    plant.reset()
    np.testing.assert_array_equal(drive(plant, lambda t: STEP, 2)[-1].position, after)
    held = first.position.copy()
    np.testing.assert_array_equal(first.position, held)
