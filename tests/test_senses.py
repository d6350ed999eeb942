"""What is measured beside positions, and controllers that need it."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from mjcf_models import PENDULUM, refusal

from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.effects.sensors import SensorDelay, SensorScale
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates
from equimus_ctrl.plants.replay import ReplayPlant
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.types import Observation, PlantSpec, Recording, Reference, Start

RATES = PlantRates(100.0, 100.0, 1000.0)
SWINGS = Start(command=np.array([0.4]), position=np.array([0.3]), velocity=np.array([2.0]))


def watched(*effects: Any, steps: int = 60) -> tuple[list[Observation], np.ndarray]:
    """A pendulum under 0.4 N·m: what is seen of it, and its true rates."""
    plant = MujocoPlant(Model(PENDULUM, effects), rates=RATES)
    seen, true = [plant.reset(SWINGS)], [float(plant.data.qvel[0])]
    for _ in range(steps):
        seen.append(plant.step([0.4]))
        true.append(float(plant.data.qvel[0]))
    return seen, np.array(true)


def test_velocities_and_torques_are_those_of_the_joints() -> None:
    seen, true = watched()
    assert seen[0].velocity is not None and seen[0].velocity.tolist() == [2.0]
    np.testing.assert_array_equal([own.velocity for own in seen], true[:, None])
    np.testing.assert_allclose([own.torque for own in seen[1:]], 0.4)
    with pytest.raises(ValueError):
        seen[0].velocity[0] = 1.0


def test_velocities_are_as_late_and_scaled_as_positions() -> None:
    late, scale = 0.0204, 1.1
    seen, true = watched(SensorDelay("pivot", delay=late), SensorScale("pivot", scale=scale))
    times = np.arange(len(true)) / 100
    velocities = np.array([own.velocity for own in seen])[5:, 0]
    wanted = scale * np.interp(times[5:] - late, times, true)
    np.testing.assert_allclose(velocities, wanted, atol=2e-3 * np.abs(true).max())


class Damped:
    senses: ClassVar[tuple[str, ...]] = ("velocities",)

    def init(self, spec: PlantSpec, observation: Observation) -> None:
        return None

    def step(self, observation: Observation, reference: Reference, state: None) -> tuple[Any, None]:
        assert observation.velocity is not None
        error = reference.position(observation.time) - observation.position
        return 12.0 * error - 1.5 * observation.velocity, None


def test_a_controller_that_needs_velocities_has_them() -> None:
    done = run(MujocoPlant(Model(PENDULUM), rates=RATES), Damped(), HoldReference(np.array([0.0])), 3.0, start=SWINGS)
    assert np.abs(done.position[-50:]).max() < 0.02


class Torques(Damped):
    senses = ("torques",)


def follows(observation: Observation, reference: Reference) -> list[float]:
    return [0.0]


def test_a_plant_that_lacks_what_a_controller_needs_is_refused_before_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    leg = MujocoPlant(nominal_model())
    monkeypatch.setattr(leg, "reset", lambda *given: pytest.fail("it moved"))
    hold = HoldReference(np.array([1.4, 0.6]))
    said = refusal(lambda: run(leg, Torques(), hold, 1.0))
    assert said == "Torques needs measured torques, which this plant does not give; it gives positions, velocities"
    time = np.arange(50) / 100
    moved = np.sin(time)[:, None]
    for velocity, needs in ((None, "velocities"), (np.cos(time)[:, None], "")):
        recording = Recording("one", time, 0 * moved, moved, ("motor",), ("pivot",), velocity=velocity)
        replayed = ReplayPlant(recording, PENDULUM, 100.0)
        if needs:
            assert f"needs measured {needs}" in refusal(lambda: run(replayed, Damped(), HoldReference([0.0]), 0.3))  # noqa: B023
        else:
            assert run(replayed, Damped(), HoldReference(np.array([0.0])), 0.3).asked[0, 0] == pytest.approx(-1.5)


def test_a_function_says_what_it_needs_too_and_what_there_is_not_is_told() -> None:
    plant = MujocoPlant(Model(PENDULUM), rates=RATES)
    follows.senses = ("velocity",)  # type: ignore[attr-defined]
    said = refusal(lambda: run(plant, as_controller(follows, "follows"), HoldReference(np.array([0.0])), 0.3))
    assert "there is no sense 'velocity'; did you mean 'velocities'" in said and said.startswith("follows")
