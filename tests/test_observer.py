"""The observer against a plant whose inner state is known: what it knows, how sure it is, and what it does without data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.effects import Effect, make
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation import filter_kernel
from equimus_ctrl.estimation.observer import Estimate, Observer, ObserverFault, ObserverSettings, ObserverState
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Observation, PlantSpec

LEG, NOISE, DT = nominal_leg(), 2e-3, 1 / 120
LAG = (make("first_order_lag", "maa", {"time_constant": 0.12}), make("first_order_lag", "baa", {"time_constant": 0.08}))
DELAYS = (make("transport_delay", "maa", {"delay": 0.05}), make("transport_delay", "baa", {"delay": 0.1}))
LATE = (make("sensor_delay", "knee", {"delay": 0.021}), make("sensor_scale", "hip", {"scale": 1.03}))


def true_state(plant: MujocoPlant) -> Array:
    """(6,) angles, velocities and pressures."""
    dof = [int(plant.mujoco_model.joint(name).dofadr[0]) for name in LEG.joint_names]
    return np.concatenate([plant.position, plant.data.qvel[dof], plant.data.ctrl[:2]])


def driven(
    effects: tuple[Effect, ...], known: tuple[Effect, ...], steps: int = 480, noise: float = NOISE, rate: float = 120.0
) -> Iterator[tuple[MujocoPlant, Observation]]:
    """A plant under commands that jump twice a second."""
    plant = MujocoPlant(
        Model(LEG, effects), nominal=Model(LEG, known), noise=noise, rates=PlantRates(sensor=rate, physics=480.0)
    )
    rng = np.random.default_rng(4)
    yield plant, plant.reset(seed=3)
    for k in range(steps):
        if k % 60 == 0:
            command = rng.uniform((2e3, 0), (2.5e4, 1.2e4))
        yield plant, plant.step(command)


def watched(
    effects: tuple[Effect, ...], known: tuple[Effect, ...] | None = None, **options: float
) -> tuple[list[Array], list[Estimate], Observer, list[ObserverState]]:
    """True states and estimates, instant by instant."""
    truth, told, states = [], [], []
    for plant, observation in driven(effects, effects if known is None else known, **options):  # type: ignore[arg-type]
        if not states:
            observer = Observer.of(plant.spec)
            states.append(observer.init(observation))
        else:
            states.append(observer.update(observation, states[-1]))
        truth.append(true_state(plant))
        told.append(observer.estimate(states[-1]))
    return truth, told, observer, states


@pytest.mark.parametrize(("effects", "rate"), [((), 120.0), (LAG, 120.0), ((*LAG, *LATE), 120.0), (LAG, 60.0)])
def test_angles_velocities_and_pressures_are_known_better_than_they_are_measured(
    effects: tuple[Effect, ...], rate: float
) -> None:
    truth, told, _, states = watched(effects, rate=rate)
    error = np.array([t[:4] - e.state[:4] for t, e in zip(truth, told, strict=True)])[60:]
    rms = np.sqrt((error**2).mean(axis=0))
    assert np.all(rms[:2] < NOISE) and np.all(rms[2:] < [0.03, 0.06])
    pressure = np.array([t[4:] - e.pressure for t, e in zip(truth, told, strict=True)])[60:]
    # ctrl is the mean over a physics step, the estimate is at its end.
    assert np.sqrt((pressure**2).mean()) < 0.02 * np.ptp([t[4] for t in truth])
    assert states[-1].status == ("tracking" if rate == 120.0 else states[-1].status)


def test_it_is_as_sure_as_it_may_be() -> None:
    truth, told, _, _ = watched(LAG)
    ratio = np.array([(t[:4] - e.state[:4]) / e.deviation[:4] for t, e in zip(truth, told, strict=True)])[60:]
    mean = (ratio**2).mean(axis=0)
    assert np.all(mean < 1.6) and np.all(mean > 0.02)
    for e in (told[60], told[-1]):
        np.testing.assert_allclose(e.covariance, e.covariance.T)
        assert np.linalg.eigvalsh(e.covariance / np.outer(e.deviation, e.deviation)).min() > 0


def test_a_torque_that_the_model_lacks_is_found() -> None:
    spring = make("parallel_spring", "knee", {"stiffness": 0.15, "rest": 0.1})
    truth, told, _, _ = watched((*LAG, spring), LAG, steps=120 * 4 + 59, noise=1e-4)
    expected = np.array([-0.15 * (t[1] - 0.1) for t in truth])[::60][2:]
    found = np.array([e.disturbance[1] for e in told])
    at_rest = np.array([found[k - 6 : k].mean() for k in range(120, len(found), 60)])
    np.testing.assert_allclose(at_rest, expected[: len(at_rest)], atol=0.15 * np.abs(expected).max())


def test_what_is_on_its_way_is_foreseen() -> None:
    effects = (*LAG, *DELAYS)
    truth, _, observer, states = watched(effects, noise=0.0)
    ahead = 6  # 0.05 s, the shorter delay
    for k in range(60, len(truth) - ahead, 25):
        seen, fast = (f(states[k], states[k].now + ahead * DT) for f in (observer.estimate, observer.foresee))
        np.testing.assert_allclose(seen.position, truth[k + ahead][:2], atol=2e-3)
        np.testing.assert_allclose(fast.state, seen.state, rtol=1e-9, atol=1e-9)
        assert np.all(seen.deviation[:2] > observer.estimate(states[k]).deviation[:2])


def test_without_data_it_coasts_then_says_so_and_comes_back() -> None:
    runs = driven(LAG, LAG, steps=60)
    plant, first = next(runs)
    observer = Observer.of(plant.spec, ObserverSettings(patience=0.1))
    state, seen = observer.init(first), []
    for k, (_, observation) in enumerate(runs):
        if 20 <= k < 40:
            kind = k % 2
            bad = np.array([np.nan, observation.position[1]])
            observation = replace(observation, position=bad) if kind else replace(observation, stamp=state.stamp)
        state = observer.update(observation, state)
        seen.append(state.status)
        if state.status == "fault":
            with pytest.raises(ObserverFault, match=r"^hip was last measured at 0\.\d+ s and it is .*every 0\.1 s$"):
                observer.require_sound(state)
        else:
            observer.require_sound(state)
        assert np.all(np.isfinite(state.mean)) and np.all(np.isfinite(state.covariance))
    assert set(seen[:20]) == {"tracking"} and set(seen[20:31]) == {"coasting"}
    assert set(seen[33:40]) == {"fault"} and set(seen[40:]) == {"tracking"}


def test_it_grows_unsure_while_it_coasts() -> None:
    runs = driven(LAG, LAG, steps=40)
    plant, first = next(runs)
    observer = Observer.of(plant.spec)
    state, unsure = observer.init(first), []
    for k, (_, observation) in enumerate(runs):
        state = observer.update(observation if k < 30 else replace(observation, stamp=0.0), state)
        unsure.append(observer.estimate(state).deviation[0])
    assert np.all(np.diff(unsure[30:]) > 0)


def test_the_same_measurements_give_the_same_bits() -> None:
    one, two = (watched((*LAG, *DELAYS), steps=40)[3][-1] for _ in range(2))
    assert one.mean.tobytes() == two.mean.tobytes() and one.covariance.tobytes() == two.covariance.tobytes()


def test_it_needs_a_model_and_a_first_measurement() -> None:
    plant = MujocoPlant(Model(LEG))
    first = plant.reset()
    observer = Observer.of(plant.spec)
    with pytest.raises(ControllerError, match="the first measured angles are"):
        observer.init(replace(first, position=np.array([np.nan, 0.0])))
    bare: PlantSpec = replace(plant.spec, model=None)
    with pytest.raises(ControllerError, match="needs a model"):
        Observer.of(bare)


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("noise", 0.0, "observer: noise is 0.0, expected a number of at least 1e-09"),
        ("torque", -1.0, "observer: torque is -1.0, expected a number of at least 0"),
        ("patience", float("nan"), "observer: patience is nan, expected a number of at least 0"),
    ],
)
def test_settings_that_make_no_sense(key: str, value: float, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ObserverSettings(**{key: value})
    assert str(caught.value) == sentence


def test_at_rest_it_finds_the_leg_where_it_is() -> None:
    plant = MujocoPlant(Model(LEG))
    observer = Observer.of(plant.spec)
    q = plant.reset().position
    state = observer.init(plant.reset())
    np.testing.assert_allclose(observer.estimate(state).position, q)
    np.testing.assert_allclose(observer.estimate(state, 0.5).position, Kinematics(LEG).equilibrium([0, 0]), atol=1e-4)


@pytest.mark.parametrize(("nj", "na"), [(2, 3), (1, 1)])
def test_compiled_matrices_are_those_of_the_filter(nj: int, na: int) -> None:
    rng = np.random.default_rng(nj)
    n, first = 2 * nj + na + 1, 2 * nj
    m = n + nj
    by_x, by_u, by_d = (rng.normal(size=(n, k)) for k in (n, na, nj))
    walk, kick, gain = rng.uniform(0.1, 1.0, m), rng.uniform(0.1, 1.0, nj), np.empty(m)
    root, f, g = rng.normal(size=(m, m)), rng.normal(size=(m, m)), rng.normal(size=(m, na))
    a, b, q = np.eye(m), np.zeros((m, na)), np.diag(walk)
    a[:n, :n], a[:n, n:] = by_x, by_d
    b[:n] = by_x[:, first : first + na] + by_u
    b[first : first + na] = 0.0
    q[:n, :n] += by_d @ np.diag(kick) @ by_d.T
    covariance = root @ root.T
    wanted = a @ covariance @ a.T + q, a @ f, a @ g + b
    filter_kernel.carried_on(by_x.T.copy(), by_u.T.copy(), by_d.T.copy(), walk, kick, first, covariance, f, g)
    for found, known in zip((covariance, f, g), wanted, strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-12, atol=1e-12)

    offset, scale, noise, angle, joint = 0.1, 1.2, 0.3, 0.7, nj - 1
    mean, row = rng.normal(size=m), np.zeros(m)
    row[joint] = scale
    variance = row @ covariance @ row + noise**2
    best, expected = covariance @ row / variance, angle - offset - row @ mean
    after = mean + best * expected, covariance - np.outer(best, best) * variance
    told = filter_kernel.corrected(mean, covariance, joint, angle, offset, scale, noise, gain)
    assert told == pytest.approx((expected, variance))
    for found, known in zip((gain, mean, covariance), (best, *after), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-10, atol=1e-10)
