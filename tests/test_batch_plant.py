"""Many robots in one batch go as the simulated plant goes."""

from __future__ import annotations

import numpy as np
import pytest
from learning_cases import FORCES, SENSORS, VALVES, arm, leg

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.batch import BatchPlant
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.types import Array, Start

CASES = {
    "leg": leg(),
    "leg with valves and sensors": leg(*VALVES, *SENSORS),
    "leg with forces": leg(*VALVES[:1], *FORCES),
    "leg with masses": leg("payload_mass:foot:mass=0.1", "gravity_tilt:base:angle=0.05"),
    "arm": arm(),
    "arm with forces": arm("stribeck_friction:shoulder:friction=0.1,breakaway=0.1,velocity=0.1", *SENSORS[:0]),
    "arm with lag": arm("first_order_lag:first:time_constant=0.05", "sensor_delay:elbow:delay=0.011"),
}


def commands(model: Model, n: int, seed: int = 3, periods: int = 40) -> Array:
    low, high = model.robot.command_limits
    return np.random.default_rng(seed).uniform(low, high, (periods, n, len(low)))


@pytest.mark.parametrize("name", CASES)
def test_a_robot_in_a_batch_goes_as_the_plant(name: str) -> None:
    model = CASES[name]
    batch = BatchPlant(2, model, 100)
    plant = MujocoPlant(model, rates=batch.rates)
    plant.reset(Start())
    for row in range(2):
        batch.begin(row, batch.prepare(model), Start())
    assert np.array_equal(batch.position[0], plant.position)
    far = batch.position[0].copy()
    for given in commands(model, 2):
        shown = plant.step(given[0])
        batch.step(np.arange(2), given)
        assert batch.position[0] == pytest.approx(plant.position, abs=1e-9)
        assert batch.measured[0] == pytest.approx(shown.position, abs=1e-9)
        far = np.maximum(far, np.abs(batch.position[0] - batch.position[1]))
    assert far.max() > 0.05  # the other one was commanded otherwise


def test_robots_with_other_parameters_and_effects_stand_side_by_side() -> None:
    """Each goes as alone: other masses, stops of its own, other laws, taken up and left again."""
    models = [CASES["leg"], CASES["leg with forces"], CASES["leg with masses"], CASES["leg with valves and sensors"]]
    models.append(models[0].with_parameters({"maa.stiffness": 300.0, "hip.upper.stiffness": 150.0}))
    given = commands(models[0], 1)

    def alone(model: Model) -> Array:
        plant = BatchPlant(1, model, 100)
        plant.begin(0, plant.prepare(model), Start())
        return np.array([_stepped(plant, np.arange(1), c)[0] for c in given])

    together = BatchPlant(3, models[0], 100, threads=2)
    units = [together.prepare(model) for model in models]
    for some in ((0, 1, 2), (3, 4, 0), (1, 0, 4)):
        for row, k in enumerate(some):
            together.begin(row, units[k], Start())
        found = np.array([_stepped(together, np.arange(3), np.repeat(c, 3, axis=0)) for c in given])
        for row, k in enumerate(some):
            assert np.array_equal(found[:, row], alone(models[k]))


def _stepped(plant: BatchPlant, rows: np.ndarray, command: Array) -> Array:
    plant.step(rows, command)
    return plant.position.copy()


def test_a_robot_that_loses_its_numbers_leaves_the_others_alone() -> None:
    stiff = leg().with_parameters({"baa.mass": 1e-4, "baa.damping": 1e4})
    plant = BatchPlant(2, leg(), 100)
    plant.begin(0, plant.prepare(leg()), Start())
    plant.begin(1, plant.prepare(stiff), Start())
    sound = np.ones(2, dtype=bool)
    for given in commands(leg(), 2):
        for step in plant.step(np.arange(2), given):
            sound[step.rows] &= step.moved.sound
    assert sound[0]
    assert np.isfinite(plant.position).all()


def test_wrong_robots_and_rates_are_sentences() -> None:
    plant = BatchPlant(1, leg(), 5)
    with pytest.raises(ConfigError, match=r"has joints hip, knee .*arm has shoulder, elbow"):
        plant.prepare(arm())
    with pytest.raises(ConfigError, match=r"480 Hz is not a whole multiple of 70 Hz"):
        BatchPlant(1, leg(), 5, control=70.0)
    plant.begin(0, plant.prepare(leg()), Start())
    for _ in range(5):
        plant.step(np.arange(1), np.zeros((1, 2)))
    with pytest.raises(ConfigError, match="more than 5 control periods"):
        plant.step(np.arange(1), np.zeros((1, 2)))
