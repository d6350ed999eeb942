"""Fits of an arm whose motion is so sensitive that small errors grow a thousandfold along a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.engines.choice import MujocoEngine, engine_for
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification import residuals
from equimus_ctrl.identification.problem import Problem
from equimus_ctrl.identification.residuals import DIFFERENCE, difference, followed, residuals_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator, reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array, Recording

ARM = """<mujoco model="arm"><option timestep="0.002" integrator="RK4"/><worldbody>
  <body name="upper"><inertial pos="0.14 0 0" mass="1.2" diaginertia="0.0015 0.011 0.011"/>
    <joint name="shoulder" axis="0 1 0" damping="0.05" armature="0.02"/>
    <body name="fore" pos="0.3 0 0"><inertial pos="0.11 0 0" mass="0.8" diaginertia="0.0008 0.006 0.006"/>
      <joint name="elbow" axis="0 1 0" damping="0.02" armature="0.01"/>
    </body></body></worldbody>
  <actuator><motor name="m_shoulder" joint="shoulder"/><motor name="m_elbow" joint="elbow"/></actuator></mujoco>"""
NOISE, TIME = 1e-3, np.arange(0, 4, 0.01)


@pytest.fixture(scope="module")
def nominal() -> Model:
    return Model(MjcfRobot("arm", ARM))


@pytest.fixture(scope="module")
def real(nominal: Model) -> Model:
    rng, own = np.random.default_rng(1), nominal.parameters()
    return nominal.with_parameters(
        {name: own[name] * rng.uniform(0.9, 1.1) for name in default_free_parameters(nominal).names}
    )


@pytest.fixture(scope="module")
def trials(real: Model) -> list[Recording]:
    """Three of 4 s under open-loop torques, from poses anywhere, upright ones too."""
    rng, robot, found = np.random.default_rng(2), real.robot, []
    for name in ("a", "b", "c"):
        waves = [rng.uniform(1, 4) * np.sin(2 * np.pi * rng.uniform(0.3, 1) * TIME + rng.uniform(0, 6)) for _ in "12"]
        command = np.column_stack(waves)
        trial = Trial(name, TIME, command, command[0], 0.0, rng.uniform(-3, 3, 2), TIME)
        angle = simulate_mjcf([real], [trial], threads=1, dt=5e-4)[0].position[0]
        measured = angle + rng.normal(0, NOISE, angle.shape)
        found.append(Recording(name, TIME, command, measured, robot.actuator_names, robot.joint_names))
    return found


@pytest.fixture(scope="module")
def simulator(nominal: Model, trials: list[Recording]) -> Simulator:
    return Simulator(engine_for(nominal, positions=[r.position for r in trials]), threads=1)


def rms(series: list[Array]) -> Array:
    return np.array([np.sqrt((r**2).mean()) for r in series])


@pytest.mark.slow
def test_starts_follow_what_was_measured_ever_farther(
    real: Model, trials: list[Recording], simulator: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments = cut(real, trials)
    starts, left = followed(real, segments, simulator)
    assert np.all(rms(left) < 1.1 * NOISE)
    assert all(np.abs(x - s.start)[2:].max() < 0.5 for x, s in zip(starts, segments, strict=True))
    monkeypatch.setattr(residuals, "PARTS", ())
    # Over whole trials at once the start ends in another local minimum.
    assert rms(residuals_of(real, segments, simulator)).max() > 100 * NOISE


@pytest.mark.slow
def test_the_model_alone_is_fitted_to_the_noise_from_where_short_windows_lead(
    nominal: Model, real: Model, trials: list[Recording], simulator: Simulator
) -> None:
    free = default_free_parameters(nominal)
    whole, short = (cut(nominal, trials, shoot=length, fit_start=True) for length in (None, 0.5))
    data = Data(free, whole, simulator, policy=SearchPolicy.of(nominal.robot.traits, simulator.engine))
    alone = data.base()
    assert alone.fit.rmse.max() > 100 * NOISE
    found = data.base_from(replace(data, segments=short).base(), alone)
    assert np.all(found.fit.rmse < 1.1 * NOISE)
    true = np.array([real.parameters()[name] for name in free.names])
    assert np.all(np.abs(found.fit.theta / true - 1) < 0.02)


@pytest.mark.slow
def test_differences_are_small_where_changes_grow(
    nominal: Model, real: Model, trials: list[Recording], simulator: Simulator
) -> None:
    segments = cut(real, trials, fit_start=True)
    starts, _ = followed(real, segments, simulator)
    problem = Problem(default_free_parameters(real), segments, simulator)
    point = problem.points([problem.parameters.start], [[starts]])[0]
    _, by_start = problem.derivatives(point)
    for segment, start, found in zip(segments, starts, by_start, strict=True):
        for k in range(4):
            rows = np.array([start + side * 3e-8 * np.eye(4)[k] for side in (1, -1)])
            ahead, behind = simulator([real, real], [segment], [rows])[0].position
            central = (ahead - behind) / 6e-8
            assert np.abs(found[:, :, k] - central).max() < 0.02 * np.abs(central).max()
    leg = nominal_model()
    assert difference(leg, reduced_simulator()) == DIFFERENCE
    assert difference(nominal, Simulator(MujocoEngine(mjcf_of(nominal.robot)))) == DIFFERENCE
