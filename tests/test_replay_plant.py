"""A recording behind the plant protocol: row by row what was measured, whatever is commanded."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.plants.replay import ReplayPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Recording, Start

LEG = nominal_leg()


def trial(n: int = 50, rate: float = 59.0, first: float = 12.0, seed: int = 0) -> Recording:
    """Jittered times that start late; every row differs from every other."""
    rng = np.random.default_rng(seed)
    time = first + np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 1.5, n - 1) / rate)])
    rows = np.arange(n)
    return Recording(
        "trial",
        time,
        np.stack([1e3 * (rows % 40), 50.0 * rows], axis=1),
        np.stack([1 + rows / 100, rows / 50], axis=1),
        LEG.actuator_names,
        LEG.joint_names,
    )


@pytest.mark.parametrize("rate", [120.0, 30.0, 59.0])
def test_each_instant_shows_the_last_row_measured_by_then(rate: float) -> None:
    recording = trial()
    plant = ReplayPlant(recording, LEG, rate)
    seen = [plant.reset()]
    seen += [plant.step([0.0, 0.0]) for _ in range(int(plant.duration * rate))]
    clock = recording.time - recording.time[0]
    for k, observation in enumerate(seen):
        assert observation.time == pytest.approx(k / rate, abs=1e-12)
        row = max(i for i, t in enumerate(clock) if t <= k / rate)
        np.testing.assert_array_equal(observation.position, recording.position[row])
        np.testing.assert_array_equal(observation.command, recording.command[row])
        assert observation.stamp == pytest.approx(clock[row])
    assert plant.duration == pytest.approx(clock[-1])


def test_rows_on_the_control_instants_are_seen_in_time() -> None:
    """k/120 s and what a recording's clock makes of it may differ in the last bit."""
    recording = trial(121)
    on_time = replace(recording, time=0.1 + np.arange(121) / 120)
    plant = ReplayPlant(on_time, LEG)
    seen = [plant.reset().position, *(plant.step([0.0, 0.0]).position for _ in range(120))]
    np.testing.assert_array_equal(seen, recording.position)


def test_nothing_is_stamped_later_than_now() -> None:
    recording = replace(trial(3), time=np.array([0.0, 1 / 120 + 5e-10, 1.0]))
    plant = ReplayPlant(recording, LEG)
    observation = plant.step([0.0, 0.0])
    assert observation.stamp <= observation.time


def test_commands_change_nothing_but_are_checked_against_the_range() -> None:
    recording = trial()
    plant, other = ReplayPlant(recording, LEG), ReplayPlant(recording, LEG)
    clipped = plant.step([60e3, -1.0])
    within = other.step([50e3, 0.0])
    np.testing.assert_array_equal(clipped.clipped, [True, True])
    np.testing.assert_array_equal(within.clipped, [False, False])
    np.testing.assert_array_equal(clipped.position, within.position)
    np.testing.assert_array_equal(clipped.command, within.command)
    np.testing.assert_array_equal(plant.reset().clipped, [False, False])


def test_a_reset_rewinds_wherever_it_is_told_to_start() -> None:
    plant = ReplayPlant(trial(), LEG)
    first = plant.step([0.0, 0.0])
    plant.step([0.0, 0.0])
    again = plant.reset(Start(position=np.array([2.0, 1.0])), seed=5)
    assert again.time == 0.0
    np.testing.assert_array_equal(again.position, plant.recording.position[0])
    np.testing.assert_array_equal(plant.step([1e4, 0.0]).position, first.position)


def test_the_end_is_a_sentence() -> None:
    plant = ReplayPlant(trial(20), LEG)
    last = plant.reset()
    for _ in range(int(plant.duration / plant.spec.control_dt) + 1):
        last = plant.step([0.0, 0.0])
    with pytest.raises(ConfigError) as caught:
        plant.step([0.0, 0.0])
    assert str(caught.value) == f"trial: the recording ends after {plant.duration:.3f} s"
    assert last.time >= plant.duration
    np.testing.assert_array_equal(last.position, plant.recording.position[-1])


def test_a_recording_of_one_row_can_be_reset() -> None:
    one = Recording("one", [3.0], [[0, 0]], [[1.0, 0.2]], LEG.actuator_names, LEG.joint_names)  # type: ignore[arg-type]
    plant = ReplayPlant(one, LEG)
    assert plant.duration == 0.0
    np.testing.assert_array_equal(plant.reset().position, [1.0, 0.2])


def test_a_recording_of_another_robot_is_refused() -> None:
    other = replace(trial(), joints=("knee", "hip"))
    with pytest.raises(ConfigError) as caught:
        ReplayPlant(other, LEG)
    assert str(caught.value) == (
        "trial: has joints knee, hip and actuators maa, baa, but nominal_leg has hip, knee and maa, baa"
    )


@pytest.mark.parametrize("rate", [0.0, -1.0, math.inf, math.nan])
def test_a_rate_that_cannot_be_is_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match=rf"control rate is {rate:g} Hz, expected more than 0"):
        ReplayPlant(trial(), LEG, rate)


@pytest.mark.parametrize("command", [[0.0], [0.0, 0.0, 0.0], 0.0])
def test_a_command_of_the_wrong_size_is_refused(command: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"command has shape \(.*\), expected \(2,\)"):
        ReplayPlant(trial(), LEG).step(command)
