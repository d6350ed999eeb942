"""What the simulated plant clips and refuses, where it starts, and how it ends."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from plant_runs import LEG, STEP, drive, positions

from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.morphology import ElasticActuator, Joint, Link, Morphology, Point
from equimus_ctrl.types import Start

# --- commands ---------------------------------------------------------------------------------------------------


def test_a_command_out_of_range_is_clipped_and_reported(plant: MujocoPlant) -> None:
    plant.reset()
    clipped = plant.step([60e3, -1.0])
    np.testing.assert_array_equal(clipped.command, [50e3, 0.0])
    np.testing.assert_array_equal(clipped.clipped, [True, True])
    half = plant.step([60e3, 12e3])
    np.testing.assert_array_equal(half.command, [50e3, 12e3])
    np.testing.assert_array_equal(half.clipped, [True, False])
    limits = plant.step([50e3, 0.0])
    np.testing.assert_array_equal(limits.clipped, [False, False])
    # What was clipped acts as the limit does.
    plant.reset()
    plant.step([50e3, 0.0])
    plant.step([50e3, 12e3])
    np.testing.assert_array_equal(plant.step([50e3, 0.0]).position, limits.position)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ([1e4], "command has shape (1,), expected (2,)"),
        ([1e4, 1e4, 1e4], "command has shape (3,), expected (2,)"),
        ([[1e4, 1e4]], "command has shape (1, 2), expected (2,)"),
        (1e4, "command has shape (), expected (2,)"),
        ([math.nan, 0.0], "command at 0.017 s is [nan  0.], not finite"),
        ([0.0, math.inf], "command at 0.017 s is [ 0. inf], not finite"),
    ],
)
def test_a_command_that_cannot_be_is_refused_and_moves_nothing(
    plant: MujocoPlant, command: list[float], message: str
) -> None:
    plant.reset()
    drive(plant, lambda t: STEP, 2)
    before = plant.position
    with pytest.raises(ConfigError) as caught:
        plant.step(command)
    assert str(caught.value) == message
    np.testing.assert_array_equal(plant.position, before)
    after = plant.step(STEP).position
    plant.reset()
    np.testing.assert_array_equal(drive(plant, lambda t: STEP, 3)[-1].position, after)


def test_a_plant_that_was_not_reset_cannot_be_stepped() -> None:
    with pytest.raises(ConfigError) as caught:
        MujocoPlant(Model(LEG)).step(STEP)
    assert str(caught.value) == "nominal_leg: the plant was stepped before it was reset"


def test_the_pressure_of_a_plant_that_was_not_reset_is_refused_likewise() -> None:
    with pytest.raises(ConfigError, match="reset"):
        _ = MujocoPlant(Model(LEG)).pressure


def test_the_array_handed_in_may_be_used_again(plant: MujocoPlant) -> None:
    plant.reset()
    command = STEP.copy()
    seen = plant.step(command)
    command[:] = 0
    np.testing.assert_array_equal(seen.command, STEP)
    expected = plant.step(STEP).position
    plant.reset()
    np.testing.assert_array_equal(drive(plant, lambda t: STEP, 2)[-1].position, expected)


# --- reset ------------------------------------------------------------------------------------------------------


def test_a_reset_leaves_nothing_of_the_run_before() -> None:
    effects = (TransportDelay("maa", 0.1), FirstOrderLag("baa", 0.2))
    used, new = (MujocoPlant(Model(LEG, effects), noise=1e-3) for _ in range(2))
    used.reset(seed=1)
    drive(used, lambda t: np.array([70e3, 50e3 * math.sin(20 * t)]), 300)
    start = Start(command=np.array([5e3, 2e3]))
    first, second = used.reset(start, seed=9), new.reset(start, seed=9)
    assert (first.time, first.stamp) == (0.0, 0.0)
    np.testing.assert_array_equal(first.clipped, [False, False])
    np.testing.assert_array_equal(first.position, second.position)
    np.testing.assert_array_equal(used.pressure, start.command)
    a, b = (drive(plant, lambda t: STEP, 50) for plant in (used, new))
    assert positions(a).tobytes() == positions(b).tobytes()
    assert [o.time for o in a] == [o.time for o in b]


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (Start(command=np.zeros(3)), "start command has shape (3,), expected (2,)"),
        (Start(position=np.zeros(1)), "start position has shape (1,), expected (2,)"),
        (Start(velocity=np.zeros(3)), "start velocity has shape (3,), expected (2,)"),
        (Start(command=np.array([60e3, 0])), "start command (60, 0) kPa lies outside (0, 0) to (50, 50) kPa"),
        (Start(command=np.array([math.inf, 0])), "start command (inf, 0) kPa lies outside (0, 0) to (50, 50) kPa"),
        (Start(command=np.array([0, -1e3])), "start command (0, -1) kPa lies outside (0, 0) to (50, 50) kPa"),
    ],
)
def test_a_start_that_cannot_be_is_refused(plant: MujocoPlant, start: Start, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plant.reset(start)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "start",
    [
        Start(command=np.array([math.nan, 0])),
        Start(command=np.array([math.nan, 0]), position=np.array([1.3, 0.5])),
        Start(position=np.array([math.nan, 0.5])),
        Start(position=np.array([1.3, math.inf])),
        Start(position=np.array([1.3, 0.5]), velocity=np.array([math.nan, 0])),
        Start(position=np.array([1.3, 0.5]), velocity=np.array([math.inf, 0])),
    ],
    ids=str,
)
def test_a_start_that_is_no_number_is_refused(
    plant: MujocoPlant, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo's log
    with pytest.raises(ConfigError, match="start"):
        plant.reset(start)


def test_a_start_without_an_equilibrium_is_a_sentence() -> None:
    plant = MujocoPlant(Model(LEG, phase="stance"))
    with pytest.raises(ModelError, match=r"nominal_leg: no pose at rest was found under pressures of 10, 10 kPa"):
        plant.reset(Start(command=np.array([1e4, 1e4])))


# --- divergence -------------------------------------------------------------------------------------------------


def absurd() -> Morphology:
    """A feather of a link on a spring of steel."""
    drive = ElasticActuator("drive", Point("base", 0.2), Point("rod", 0.1), 1e-3, 1e9, 0.0, 0.2, 4e-4)
    return Morphology("absurd", (Link("rod", 0.2, 1e-3, 0.1, 1e-6),), (Joint("pivot", "base", "rod"),), (drive,), "rod")


TOO_STIFF = [
    pytest.param(LEG.with_parameters({"knee.damping": 60.0}), id="overdamped"),
    pytest.param(LEG.with_parameters({"maa.stiffness": 1e8}), id="stiff"),
]


def diverge(plant: MujocoPlant) -> SimulationDiverged:
    command = np.full(len(plant.spec.actuators), 2e4)
    with pytest.raises(SimulationDiverged) as caught:
        drive(plant, lambda t: command, 100)
    return caught.value


@pytest.mark.parametrize(
    "m",
    [
        *TOO_STIFF,
        pytest.param(absurd(), id="absurd"),
    ],
)
def test_a_diverged_simulation_raises_one_sentence_and_no_more(
    m: Morphology, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nothing of MuJoCo's own on the screen or in its log."""
    monkeypatch.chdir(tmp_path)
    plant = MujocoPlant(Model(m))
    plant.reset(Start(position=np.full(len(m.joints), 0.8)))
    sentence = str(diverge(plant))
    assert sentence.startswith(f"{m.name}: the simulation diverged at ")
    kpa = ", ".join(["20"] * len(m.actuators))
    assert f"under commands of ({kpa}) kPa" in sentence
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("m", [*TOO_STIFF, pytest.param(absurd(), id="absurd")])
def test_a_diverged_plant_gives_no_numbers_until_it_is_reset(
    m: Morphology, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plant = MujocoPlant(Model(m))
    plant.reset(Start(position=np.full(len(m.joints), 0.8)))
    diverge(plant)
    for _ in range(20):
        with pytest.raises(SimulationDiverged):
            plant.step(np.full(len(m.actuators), 2e4))


def test_a_plant_that_was_too_fast_gives_no_numbers_until_it_is_reset(plant: MujocoPlant) -> None:
    plant.reset(Start(position=np.array([1.3, 0.5]), velocity=np.array([0.0, 1.1e3])))
    with pytest.raises(SimulationDiverged):
        plant.step(STEP)
    for _ in range(200):
        with pytest.raises(SimulationDiverged):
            plant.step(STEP)


def test_after_a_divergence_a_reset_gives_a_working_plant_again(plant: MujocoPlant) -> None:
    plant.reset(Start(position=np.array([1.3, 0.5]), velocity=np.array([0.0, 1e5])))
    with pytest.raises(SimulationDiverged):
        drive(plant, lambda t: STEP, 10)
    plant.reset()
    after = drive(plant, lambda t: STEP, 10)[-1].position
    fresh = MujocoPlant(Model(LEG))
    fresh.reset()
    np.testing.assert_array_equal(after, drive(fresh, lambda t: STEP, 10)[-1].position)
