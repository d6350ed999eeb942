"""By how much a trial would favour the true rival: refitted, with noise estimated along, and as it then turns out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from poor_legs import poor_trials_and_one_more
from rival_legs import by_hand, of_a_pendulum, part_of, rivals_of, steps

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects import ParallelSpring
from equimus_ctrl.experiments.power import Power, powers
from equimus_ctrl.experiments.predicted import Commands, predicted_trials
from equimus_ctrl.experiments.refitting import NoiseScale, Target, Task, refitted, refitted_all
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.identification.noise import JointNoise, drawn_noise, estimate_noise, whiten

SWING = Commands(np.array([0.0, 0.5, 1.2]), np.array([[0.3], [-0.8], [0.9]]), 2.0)


def target(rivals: Rivals, commands: Commands, truth: int = 0) -> Target:
    simulator, model = rivals.simulator(1), rivals.rivals[truth].model
    (segments,) = predicted_trials(rivals, model, [commands], simulator)
    return Target.of(rivals, model, segments, simulator)


def test_the_true_rival_refits_at_no_cost() -> None:
    rivals = of_a_pendulum()
    found = refitted(rivals.rivals[0], target(rivals, SWING))
    assert found.cost == pytest.approx(0.0, abs=1e-6)
    assert found.theta == pytest.approx(rivals.rivals[0].theta)
    assert max(np.abs(own).max() for own in found.left) < 1e-6


def test_what_needs_no_refit_gets_none_however_sure_one_of_its_parameters_is() -> None:
    """Without a slope and with parameters that hardly count beside another, least squares divide 0 by 0."""
    rivals = of_a_pendulum()
    own = rivals.rivals[0]
    sure = np.zeros_like(own.information)
    sure[0, 0] = 1e40
    found = refitted(replace(own, information=sure), target(rivals, SWING))
    assert found.converged and found.cost < 1e-9 and found.theta == pytest.approx(own.theta)


def test_an_estimate_at_a_bound_that_is_no_multiple_of_its_scale_is_refitted() -> None:
    """A bound divided by a scale and multiplied by it may lie beyond itself, where the law does not exist."""
    high = ParallelSpring.parameter_info()["rest"]["high"]
    scale = next(s for s in np.linspace(0.5, 2.0, 1000) if high / s * s > high)
    spring = part_of(ParallelSpring, ("hinge",), stiffness=0.2, rest=high)
    (own,) = by_hand(of_a_pendulum().model, (spring,), names=("arm.mass",)).rivals
    place = own.parameters.names.index("hinge.parallel_spring.rest")
    free = [replace(f, size=float(scale)) if k == place else f for k, f in enumerate(own.parameters.free)]
    at_bound = replace(own, parameters=replace(own.parameters, free=tuple(free)))
    found = refitted(at_bound, target(of_a_pendulum(), SWING))
    assert np.all(found.theta <= at_bound.parameters.high) and found.cost > 0


def test_another_is_refitted_to_about_what_the_first_order_says() -> None:
    """Small changes of what is free: there both are the same problem."""
    rivals = of_a_pendulum()
    (apart,) = separations(rivals, [SWING])
    other = rivals.rivals[1]
    found = refitted(other, target(rivals, SWING))
    assert found.converged
    assert found.cost == pytest.approx(apart.gap(0, 1), rel=0.1)
    led = other.theta + other.parameters.scale * (other.spread @ apart.undone(0, 1))
    assert found.theta == pytest.approx(led, rel=0.05)


def test_the_refit_is_a_minimum(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    other, shown = rivals.rivals[1], target(rivals, steps(duration=2.0))
    found = refitted(other, shown)
    scale, root = other.parameters.scale, np.linalg.cholesky(other.precision).T

    def cost(theta: np.ndarray) -> float:
        away = root @ ((theta - other.theta) / scale)
        return float((shown.residuals([other.model_at(theta)]) ** 2).sum() + away @ away)

    assert cost(found.theta) == pytest.approx(found.cost, rel=1e-6)
    assert found.cost < cost(other.theta)
    for k in range(len(scale)):
        for step in (-1e-2, 1e-2):
            moved = found.theta + step * scale * (np.arange(len(scale)) == k)
            if np.all((moved >= other.parameters.low) & (moved <= other.parameters.high)):
                assert cost(moved) > 0.999 * found.cost


def test_refits_beside_each_other_are_those_alone(diagnosis: Diagnosis) -> None:
    """The same bits, whatever the truth of each is."""
    rivals = rivals_of(diagnosis)
    shown = [target(rivals, steps(duration=1.5), truth) for truth in (0, 1)]
    tasks = [Task(rivals.rivals[j], shown[i]) for i, j in ((0, 1), (1, 0), (0, 0))]
    for own, task in zip(refitted_all(tasks), tasks, strict=True):
        alone = refitted(task.rival, task.target)
        assert own.cost == alone.cost and own.theta.tobytes() == alone.theta.tobytes()


def test_drawn_noise_is_the_noise_that_it_is_said_to_be() -> None:
    noise = (JointNoise(1e-3), JointNoise(5e-4, 2e-3, 0.05))
    time = np.arange(6000) / 100
    found = estimate_noise([time], [drawn_noise(noise, time, np.random.default_rng(0).standard_normal((2, 6000, 2)))])
    for own, said in zip(found, noise, strict=True):
        assert own.white == pytest.approx(said.white, rel=0.1)
        assert own.coloured == pytest.approx(said.coloured, rel=0.15)
    assert found[1].time == pytest.approx(0.05, rel=0.3)


def test_where_noise_is_estimated_along_a_large_gap_is_smaller() -> None:
    rivals = of_a_pendulum()
    same = tuple(replace(rival, noise=rivals.noise) for rival in rivals.rivals)
    rivals = replace(rivals, rivals=same)
    time = np.arange(200) / rivals.rate
    wave = np.sin(7 * time)[:, None]
    sigma = rivals.noise[0].sigma

    def seen(size: float) -> float:
        return NoiseScale(rivals).estimated(0, 1, 1, [time], [size * sigma * wave])

    assert seen(0.0) == 0.0
    # Of a small one, χ² of what is left, give or take what noise does.
    assert seen(0.5) == pytest.approx(0.25 * (wave**2).sum(), abs=2 * 2 * np.sqrt(0.25 * (wave**2).sum()))
    assert seen(5.0) < seen(20.0) < 0.1 * 400 * (wave**2).sum()


def test_what_the_recordings_so_far_lose_counts_as_well() -> None:
    """Under noise that is estimated along, as much as if it were left in so long a trial."""
    rivals = of_a_pendulum()
    same = tuple(replace(rival, noise=rivals.noise) for rival in rivals.rivals)
    rivals = replace(rivals, rivals=same, n=200)
    time = np.arange(200) / rivals.rate
    wave = 0.7 * rivals.noise[0].sigma * np.sin(7 * time)[:, None]
    cost = float((whiten(rivals.noise, time, wave[..., None]) ** 2).sum())

    def seen(earlier: float) -> float:
        return NoiseScale(rivals).estimated(0, 1, 1, [time], [wave], earlier)

    assert seen(0.0) < seen(0.5 * cost) < seen(cost) < 2 * cost
    assert seen(cost) == pytest.approx(2 * seen(0.0), rel=0.3)
    found = refitted(rivals.rivals[1], target(rivals, SWING))
    own = rivals.rivals[1]
    away = (found.theta - own.theta) / own.parameters.scale
    assert found.earlier == pytest.approx(away @ own.precision @ away) and 0 < found.earlier < found.cost


def test_power_grows_with_what_is_ahead_and_with_the_gap() -> None:
    rivals = of_a_pendulum()
    (found,) = powers(rivals, SWING, np.random.default_rng(0), draws=4, pairs=[(0, 1)])
    low, high = found.interval
    assert 0 < low < found.gap < high
    assert found.needed >= 10 and 0 <= found.chance <= 1
    assert (
        powers(rivals, SWING, np.random.default_rng(0), draws=4, pairs=[(0, 1)])[0].gaps.tolist() == found.gaps.tolist()
    )
    behind = replace(rivals.rivals[1], deviance=rivals.rivals[0].deviance - 3 * found.gap)
    (hard,) = powers(
        replace(rivals, rivals=(rivals.rivals[0], behind)), SWING, np.random.default_rng(0), draws=4, pairs=[(0, 1)]
    )
    assert hard.ahead < 0 and hard.chance < found.chance and hard.repeats > found.repeats
    written = hard.to_dict()
    assert written["gap"] == hard.gap and set(written) >= {"low", "high", "chance", "repeats"}


def test_a_trial_that_shows_nothing_settles_nothing() -> None:
    rivals = of_a_pendulum()
    equal = replace(rivals.rivals[1], deviance=rivals.rivals[0].deviance)
    rivals = replace(rivals, rivals=(rivals.rivals[0], equal))
    still = Commands(np.zeros(1), np.zeros((1, 1)), 1.0, start=np.zeros(1))
    (found,) = powers(rivals, still, np.random.default_rng(0), draws=3, pairs=[(0, 1)])
    assert found.gap < 1 and found.chance < 0.01
    assert found.repeats == np.inf and found.to_dict()["repeats"] is None


def test_the_interval_holds_gaps_that_are_normal_about_what_is_expected() -> None:
    one = Power(0, 1, np.array([100.0]), 0.0, 10.0, 1.0, 1.0)
    assert one.interval == pytest.approx((100 - 1.645 * 20, 100 + 1.645 * 20), rel=0.02)


@pytest.mark.slow
def test_a_predicted_gap_comes_true() -> None:
    """On legs in MuJoCo with a hidden effect and noise: both rivals fitted to what they were fitted to, and the trial.

    Two trials of 6 s say little; the third is predicted, then made. Goal: within a factor of 2, beside what noise does.
    """
    for seed, case, other in ((78, 4, "sensor_scale"), (78, 7, "creep"), (77, 3, "sensor_offset")):
        predicted, realised = poor_trials_and_one_more(seed, case, other)
        assert predicted / 2 - 2 * np.sqrt(predicted) < realised < 2 * predicted + 2 * np.sqrt(predicted), (seed, case)
        assert realised > 10
