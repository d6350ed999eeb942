"""What every simulated plant known by name promises; a new one is held to it by being registered."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.registry import PLANTS, PlantRequest, make_plant
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.types import Observation, Plant, Recording

MODEL = nominal_model()
WITHIN = np.array([12e3, 3e3])


def recording() -> Recording:
    time = np.arange(100) / 97
    wave = np.sin(3 * time)[:, None]
    return Recording(
        "sway",
        time,
        1e4 + 5e3 * np.hstack([wave, -wave]),
        np.array([1.4, 0.6]) + 0.1 * np.hstack([wave, -wave]),
        MODEL.morphology.actuator_names,
        MODEL.morphology.joint_names,
    )


@pytest.fixture(params=sorted(name for name, entry in PLANTS.items() if not entry.real))
def plant(request: pytest.FixtureRequest) -> Iterator[Plant]:
    made = make_plant(request.param, PlantRequest(MODEL, recording()))
    yield made
    made.close()


def bits(seen: list[Observation]) -> list[bytes]:
    return [
        b"".join(
            [np.array([o.time, o.stamp]).tobytes(), o.position.tobytes(), o.command.tobytes(), o.clipped.tobytes()]
        )
        for o in seen
    ]


def drive(plant: Plant, n: int = 30) -> list[Observation]:
    return [plant.step(WITHIN * (1 + (k % 3) / 10)) for k in range(n)]


@pytest.mark.parametrize("name", sorted(PLANTS))
def test_a_plant_has_a_line_for_lists(name: str) -> None:
    assert PLANTS[name].summary
    assert "\n" not in PLANTS[name].summary
    assert name.isidentifier()


def test_the_spec_is_whole_and_read_only(plant: Plant) -> None:
    spec = plant.spec
    nj, na = len(spec.joints), len(spec.actuators)
    assert (spec.joints, spec.actuators) == (MODEL.morphology.joint_names, MODEL.morphology.actuator_names)
    assert 0 < spec.control_dt < 1
    assert spec.command_low.shape == spec.command_high.shape == (na,)
    assert spec.joint_low.shape == spec.joint_high.shape == (nj,)
    assert np.all(spec.command_low < spec.command_high)
    assert np.all(spec.joint_low < spec.joint_high)
    assert spec.phase == MODEL.phase
    for array in (spec.command_low, spec.command_high, spec.joint_low, spec.joint_high):
        assert not array.flags.writeable


def test_a_reset_shows_the_start(plant: Plant) -> None:
    first = plant.reset()
    spec = plant.spec
    assert (first.time, first.stamp) == (0.0, 0.0)
    assert first.position.shape == (len(spec.joints),)
    assert np.all(np.isfinite(first.position))
    assert first.command.shape == first.clipped.shape == (len(spec.actuators),)
    assert np.all((first.command >= spec.command_low) & (first.command <= spec.command_high))
    assert first.clipped.dtype == bool
    assert not first.clipped.any()


def test_time_goes_by_one_control_period_a_step(plant: Plant) -> None:
    stamp = plant.reset().stamp
    for k, seen in enumerate(drive(plant), start=1):
        assert seen.time == pytest.approx(k * plant.spec.control_dt, rel=1e-12)
        assert stamp <= seen.stamp <= seen.time
        assert np.all(np.isfinite(seen.position))
        stamp = seen.stamp


def test_a_command_out_of_range_is_reported_and_one_within_is_not(plant: Plant) -> None:
    spec = plant.spec
    plant.reset()
    np.testing.assert_array_equal(plant.step(np.add(spec.command_high, [1.0, 0.0])).clipped, [True, False])
    np.testing.assert_array_equal(plant.step(np.subtract(spec.command_low, [0.0, 1.0])).clipped, [False, True])
    for within in (spec.command_low, spec.command_high, WITHIN, list(WITHIN), tuple(WITHIN)):
        assert not plant.step(within).clipped.any()


def test_the_same_seed_gives_the_same_bits(plant: Plant) -> None:
    first = bits([plant.reset(seed=3), *drive(plant)])
    drive(plant, 5)
    assert bits([plant.reset(seed=3), *drive(plant)]) == first


def test_what_was_seen_stays_and_cannot_be_changed(plant: Plant) -> None:
    seen = [plant.reset(), plant.step(WITHIN)]
    before = bits(seen)
    for observation in seen:
        for array in (observation.position, observation.command, observation.clipped):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0
    drive(plant)
    plant.reset()
    assert bits(seen) == before


@pytest.mark.parametrize("command", [0.0, [0.0], [0.0, 0.0, 0.0], [[0.0, 0.0]], []])
def test_a_command_of_the_wrong_size_is_refused_with_both_sizes(plant: Plant, command: list[float]) -> None:
    plant.reset()
    with pytest.raises(ConfigError, match=r"command has shape \(.*\), expected \(2,\)"):
        plant.step(command)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_no_number_is_refused(plant: Plant, bad: float, request: pytest.FixtureRequest) -> None:
    plant.reset()
    with pytest.raises(ConfigError, match="not finite"):
        plant.step([bad, 0.0])


def test_it_can_be_closed_twice(plant: Plant) -> None:
    plant.reset()
    plant.close()
    plant.close()


def test_it_runs_in_the_closed_loop(plant: Plant) -> None:
    pose = np.array([1.4, 0.6])
    done = run(plant, OpenLoopController(), HoldReference(pose), 0.25)
    assert done.position.shape == (30, 2)
    np.testing.assert_array_equal(done.reference, np.tile(pose, (30, 1)))


def test_an_unknown_plant_names_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match=r"there is no plant 'mujocco'; did you mean 'mujoco'\? \(known: hardware, mujoco, replay"
    ):
        make_plant("mujocco", PlantRequest(MODEL))


def test_a_replay_needs_a_recording_and_has_the_noise_it_has() -> None:
    with pytest.raises(NotAvailable, match="the replay plant plays the scenario's recording, and there is none"):
        make_plant("replay", PlantRequest(MODEL))
    with pytest.raises(ConfigError, match="noise cannot be added"):
        make_plant("replay", PlantRequest(MODEL, recording(), noise=1e-3))


def test_noise_is_handed_on() -> None:
    noisy = make_plant("mujoco", PlantRequest(MODEL, noise=1e-3))
    assert np.any(noisy.reset(seed=1).position != noisy.reset(seed=2).position)
