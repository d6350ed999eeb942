"""Runs of the MuJoCo batch that come near a joint's stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mujoco_runs import rms, varied

from equimus_ctrl.effects import ParallelSpring
from equimus_ctrl.engines import mujoco_batch
from equimus_ctrl.engines.limits import FOLLOWED
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch, near_stop, stop_divisor
from equimus_ctrl.engines.mujoco_trials import simulate_mujoco
from equimus_ctrl.engines.steps import rates_at
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import JointStop, Morphology, Phase
from equimus_ctrl.types import Array
from equimus_ctrl.validation import reference
from equimus_ctrl.validation.experiment import Experiment

PHASES: tuple[Phase, ...] = ("swing", "stance")

every_phase = pytest.mark.parametrize("phase", PHASES)


def onto_stops(phase: Phase, *robots: Morphology) -> Experiment:
    """The first leg is thrown at a stop of its knee; in swing the second stays clear of all."""
    start = np.array([[1.6, 0.05], [1.2, 0.7], [2.0, 1.6]])
    pressure = np.array([[[0.0, 4e4], [3e4, 0.0]], [[1e4, 1e3], [1.2e4, 1e3]], [[3e4, 0.0], [0.0, 4e4]]])
    return Experiment(robots or (nominal_leg(),), phase, start, np.array([0.0, 0.3]), pressure, 0.5)


def simulated(runs: Experiment, batch: MujocoBatch) -> Array:
    """Angles at the experiment's times."""
    held = runs.held(batch.settings.timestep)
    q, _ = batch.run(runs.start, np.zeros_like(runs.start), held)
    return q[:, :: held.shape[1] // (len(runs.times) - 1)]


def exact(runs: Experiment) -> Array:
    return reference.integrate(runs, rtol=1e-9, atol=1e-11)[0]


@every_phase
def test_runs_on_stops_are_those_of_the_exact_model(phase: Phase) -> None:
    runs = onto_stops(phase)
    expected = exact(runs)
    assert runs.touches(expected, -1e-3).tolist() == [True, phase == "stance", phase == "stance"]
    found = simulated(runs, MujocoBatch(nominal_leg(), phase))
    assert [rms(error) for error in found - expected] == pytest.approx([0.0] * 3, abs=1e-4)
    assert rms(exact(runs.without_stops()) - expected) > 0.01


@every_phase
def test_each_run_is_on_stops_of_its_own(phase: Phase) -> None:
    m = nominal_leg()
    hip, knee = m.joints
    stiff = replace(knee, lower=JointStop(-0.02, 900.0, 3.0), upper=JointStop(1.7, 40.0, 0.2))
    runs = onto_stops(phase, replace(m, joints=(hip, stiff)), m.without_stops(), m)
    assert stop_divisor(runs.morphologies[0], phase, runs.start[0], 1 / 120) > stop_divisor(
        m, phase, runs.start[2], 1 / 120
    )
    found = simulated(runs, MujocoBatch.of(runs.morphologies, phase))
    assert [rms(error) for error in found - exact(runs)] == pytest.approx([0.0] * 3, abs=1e-4)
    reverse = runs.part(np.array([2, 1, 0]))
    np.testing.assert_array_equal(simulated(reverse, MujocoBatch.of(reverse.morphologies, phase))[::-1], found)


@pytest.mark.parametrize("mixed", [False, True])
def test_the_bits_on_stops_depend_neither_on_threads_nor_on_neighbours_nor_on_blocks(
    mixed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots = varied(nominal_leg(), 3) if mixed else []
    runs = onto_stops("stance", *robots)

    def batch(some: Experiment, threads: int) -> MujocoBatch:
        if mixed:
            return MujocoBatch.of(some.morphologies, "stance", threads=threads)
        return MujocoBatch(nominal_leg(), "stance", threads=threads)

    single = batch(runs, 1)
    q = simulated(runs, single)
    assert runs.touches(q).all()
    np.testing.assert_array_equal(simulated(runs, single), q)
    np.testing.assert_array_equal(simulated(runs, batch(runs, 3)), q)
    for i in range(3):
        alone = runs.part(slice(i, i + 1))
        np.testing.assert_array_equal(simulated(alone, batch(alone, 1))[0], q[i])
    monkeypatch.setattr(mujoco_batch, "FINE_VALUES", 1)
    np.testing.assert_array_equal(simulated(runs, batch(runs, 1)), q)


def test_only_runs_near_a_stop_are_simulated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[float] = []

    def divisor(m: Morphology, phase: Phase, pose: Array, dt: float) -> int:
        looked_at.append(float(pose[0]))
        return stop_divisor(m, phase, pose, dt)

    monkeypatch.setattr(mujoco_batch, "stop_divisor", divisor)
    runs = onto_stops("swing")
    q = simulated(runs, MujocoBatch(nominal_leg()))
    assert looked_at == [1.6]
    free = runs.without_stops()
    bare = simulated(free, MujocoBatch(free.morphologies[0]))
    assert looked_at == [1.6]
    np.testing.assert_array_equal(bare[1:], q[1:])


def test_a_stop_between_two_samples_is_near() -> None:
    m, dt = nominal_leg(), 1 / 120
    times = np.array([0.4, 1.4, 2.4])[:, None] * dt
    q = np.tile([1.5, 0.5], (4, 3, 1))
    v = np.zeros_like(q)
    # Thrown up into the stop at 2 and back by 500 rad/s²: at no sample beyond it, 1e-3 so between them.
    q[1, :, 1:] = 2.001 - 250.0 * (times - dt) ** 2
    v[1, :, 1:] = -500.0 * (times - dt)
    assert q[1, :, 1].max() < 2.0
    q[2, 1, 0] = 0.5  # beyond the hip's lower stop
    q[3, 1:] = v[3, 1:] = np.nan
    assert near_stop([m], q, v, dt).tolist() == [False, True, True, False]
    assert near_stop([m.without_stops(), m, m.without_stops(), m], q, v, dt).tolist() == [False, True, False, False]


@every_phase
def test_steps_are_divided_until_they_follow_the_push_of_a_stop(phase: Phase) -> None:
    m, pose, dt = nominal_leg(), np.array([1.5, 0.5]), 1 / 120
    rate = max(rates_at(m, phase, [pose]))
    n = stop_divisor(m, phase, pose, dt)
    assert rate * dt / n <= FOLLOWED < rate * dt / (n - 1)
    assert stop_divisor(m, phase, pose, dt / n) == 1


def test_a_stop_too_stiff_for_any_step_is_told() -> None:
    m = nominal_leg().with_parameters({"knee.lower.damping": 1e4})
    with pytest.warns(UserWarning, match=r"nominal_leg: a joint stop is too stiff even for a physics step of 0\.13 ms"):
        MujocoBatch(m).run(np.array([[1.6, -0.034]]), np.zeros((1, 2)), np.zeros((1, 2, 2)))


def test_a_run_beside_effects_that_push_follows_stops_too() -> None:
    runs = onto_stops("swing").part(slice(0, 1))
    times, start = runs.times, runs.start[0]
    trial = Trial("on a stop", runs.switch, runs.pressure[0], runs.pressure[0, 0], 0.0, start, times)
    model = Model(nominal_leg(), (ParallelSpring("hip", 0.0, 0.0),))
    found = simulate_mujoco([model], [trial], settings=FAST_SETTINGS)[0].position[0]
    np.testing.assert_allclose(found, exact(runs)[0], atol=2e-4)
