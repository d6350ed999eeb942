"""How far rivals are apart in a trial that nobody has made: by matrices as they are, and by simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosed_arm import six_joints
from rival_legs import rivals_of, steps
from scipy.stats import multivariate_normal

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.experiments.predicted import Commands, predicted_recordings, predicted_trials, resting
from equimus_ctrl.experiments.separation import Separation, divergence, leading, separations
from equimus_ctrl.experiments.starts import Starts
from equimus_ctrl.identification.information import start_precision
from equimus_ctrl.identification.noise import whiten
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

RNG = np.random.default_rng(3)
APART, SLOPES = 5 * RNG.standard_normal((40, 3)), [RNG.standard_normal((40, k)) for k in (2, 4, 3)]


def made_up(apart: Array = APART, sound: tuple[bool, bool, bool] = (True, True, True)) -> Separation:
    """Of three rivals that predict 40 numbers."""
    whole = np.column_stack([apart, *SLOPES])
    return Separation(0, whole.T @ whole, (slice(3, 5), slice(5, 9), slice(9, 12)), np.array(sound), 40)


def test_a_gap_is_the_least_that_refitting_leaves() -> None:
    d, slopes = APART[:, 0] - APART[:, 1], SLOPES[1]
    system = np.vstack([slopes, np.eye(4)])
    z, (least,), _, _ = np.linalg.lstsq(system, np.append(d, np.zeros(4)), rcond=None)
    apart = made_up()
    assert apart.gap(0, 1) == pytest.approx(least)
    assert apart.undone(0, 1) == pytest.approx(z)


def test_a_distance_is_over_the_uncertainty_of_both() -> None:
    d = APART[:, 2] - APART[:, 1]
    whole = np.eye(40) + SLOPES[1] @ SLOPES[1].T + SLOPES[2] @ SLOPES[2].T
    apart = made_up()
    assert apart.distance(2, 1) == pytest.approx(d @ np.linalg.solve(whole, d)) == apart.distance(1, 2)
    assert np.all(apart.distances <= apart.gaps) and np.all(np.diag(apart.gaps) == 0)


def test_repeats_are_as_many_trials_behind_each_other() -> None:
    apart = np.vstack([APART] * 3)
    d, slopes = apart[:, 0] - apart[:, 1], np.vstack([SLOPES[1]] * 3)
    whole = np.eye(120) + slopes @ slopes.T
    assert made_up().gap(0, 1, repeats=3) == pytest.approx(d @ np.linalg.solve(whole, d))


def test_what_cannot_be_simulated_is_at_no_distance() -> None:
    gaps = made_up(sound=(True, False, True)).gaps
    assert gaps[0, 1] == gaps[1, 2] == 0 < gaps[0, 2]


def test_the_divergence_is_the_entropy_of_the_mixture_less_theirs() -> None:
    """Rényi's, of order 2: by Monte Carlo, of three normal densities of unit covariance in the plane."""
    means = np.array([[0.0, 0.0], [2.0, 0.5], [-1.0, 1.5]])
    weights = np.array([0.5, 0.3, 0.2])
    distances = ((means[:, None] - means) ** 2).sum(axis=2)
    apart = Separation(0, means @ means.T, (slice(3, 3), slice(3, 3), slice(3, 3)), np.ones(3, dtype=bool), 2)
    assert apart.distances == pytest.approx(distances)
    axis = np.linspace(-9, 10, 400)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    mixture = sum(w * multivariate_normal(m).pdf(grid) for w, m in zip(weights, means, strict=True))
    area = (axis[1] - axis[0]) ** 2
    entropy = -np.log((mixture**2).sum() * area)
    assert divergence(apart, weights) == pytest.approx(entropy - np.log(4 * np.pi), abs=5e-3)
    assert divergence(made_up()) > divergence(made_up(APART / 10)) > 0


def test_starts_are_eliminated_with_their_prior(diagnosis: Diagnosis) -> None:
    segment, noise = diagnosis.train[0], diagnosis.best.noise
    shape = segment.outputs.shape
    slopes = np.random.default_rng(0).standard_normal((*shape, len(segment.free_at)))
    values = np.random.default_rng(1).standard_normal((*shape, 1))
    starts = Starts.of(noise, [segment], [slopes])
    time = segment.trial.sample_times
    by_start, whole = (whiten(noise, time, own).reshape(-1, own.shape[2]) for own in (slopes, values))
    system = np.vstack([by_start, np.diag(start_precision(segment, noise))])
    s, (least,), _, _ = np.linalg.lstsq(system, np.append(whole, np.zeros(system.shape[1])), rcond=None)
    assert (starts.reduced(0, values) ** 2).sum() == pytest.approx(least)
    assert starts.left(0, values[..., 0]) == pytest.approx(values[..., 0] - slopes @ s)


def test_a_trial_begins_at_rest_under_its_first_command(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    simulator, truth, commands = rivals.simulator(1), rivals.rivals[0].model, steps()
    (recording,) = predicted_recordings(rivals, truth, [commands], simulator)
    still = recording.time < 0.6
    assert recording.position[still] == pytest.approx(
        np.tile(rest_pose(truth, commands.commands[0]), (still.sum(), 1)), abs=1e-6
    )
    assert np.ptp(recording.position, axis=0).min() > 0.01
    assert 1 / np.diff(recording.time) == pytest.approx(rivals.rate)
    ((segment,),) = predicted_trials(rivals, truth, [commands], simulator)
    assert segment.free_at == [0, 1]


def test_several_trials_at_once_are_each_by_itself(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    several = [steps(k, duration=1.5) for k in range(3)]
    together = separations(rivals, several)
    for own, commands in zip(together, several, strict=True):
        (alone,) = separations(rivals, [commands])
        assert own.gap(0, 1) == pytest.approx(alone.gap(0, 1), rel=1e-6)
    assert len({round(own.gap(0, 1), 6) for own in together}) == 3


def test_only_what_will_be_fitted_of_a_trial_counts(diagnosis: Diagnosis) -> None:
    """Of its end, which is held out, nothing does, whatever is commanded there."""
    rivals = replace(rivals_of(diagnosis), fitted=0.75)
    levels = np.array([[12e3, 6e3], [2e4, 2e3], [8e3, 9e3]])
    at_first, at_last = (Commands(np.array([0.0, 1.0, at]), levels, 4.0) for at in (2.0, 3.2))
    two, same = (replace(own, commands=levels[[0, 1, 1]]) for own in (at_first, at_last))
    early, late, none, _ = separations(rivals, [at_first, at_last, two, same])
    assert late.n == none.n == pytest.approx(0.75 * separations(rivals_of(diagnosis), [two])[0].n, abs=4)
    assert np.array_equal(late.gram, none.gram) and not np.array_equal(early.gram, none.gram)


def test_a_rival_is_at_no_distance_from_itself(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    same = replace(rivals, rivals=(rivals.rivals[0], rivals.rivals[0], rivals.rivals[1]))
    (apart,) = separations(same, [steps()])
    assert apart.gap(0, 1) == 0 < apart.gap(0, 2)


def test_whole_bases_change_nothing_and_leading_ones_little(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    commands = [steps(k, duration=2.0) for k in range(3)]
    whole = separations(rivals, commands)
    turned = [np.linalg.qr(np.random.default_rng(0).standard_normal((len(r.theta),) * 2))[0] for r in rivals.rivals]
    (by_all,) = separations(rivals, commands[:1], bases=turned)
    assert by_all.distance(0, 1) == pytest.approx(whole[0].distance(0, 1), rel=0.02)
    few = leading(rivals, whole[1:])
    assert all(0 < basis.shape[1] < len(r.theta) for basis, r in zip(few, rivals.rivals, strict=True))
    (by_few,) = separations(rivals, commands[:1], bases=few)
    assert by_few.distance(0, 1) == pytest.approx(whole[0].distance(0, 1), rel=0.1)


def arm(rivals: Rivals) -> Rivals:
    """Of six joints on which nothing but motors and damping acts."""
    return replace(rivals, model=Model(six_joints()), start=np.zeros(6), noise=rivals.noise[:1] * 6, engine="reduced")


def test_a_robot_that_does_not_come_to_rest_is_told_so(diagnosis: Diagnosis) -> None:
    rivals = arm(rivals_of(diagnosis))
    simulator = rivals.simulator(1)
    assert resting(rivals, rivals.model, np.zeros(6), simulator) == pytest.approx(np.zeros(6), abs=1e-9)
    with pytest.raises(ConfigError, match="does not come to rest within 20 s"):
        resting(rivals, rivals.model, np.full(6, 1.0), simulator)


@pytest.mark.parametrize(
    ("times", "count", "duration", "said"),
    [((0.0, 1.0), 1, 2.0, "1 commands at 2 times"), ((1.0, 1.0), 2, 2.0, "ascending"), ((3.0,), 1, 2.0, "before its")],
)
def test_commands_that_are_none_are_refused(times: tuple[float, ...], count: int, duration: float, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Commands(np.array(times), np.zeros((count, 2)), duration)


def test_commands_hold_from_their_instants_on() -> None:
    commands = Commands(np.array([0.0, 0.1, 0.3]), np.array([[1.0], [2.0], [3.0]]), 0.5)
    times, rows = commands.sampled(10.0)
    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert rows[:, 0].tolist() == [1.0, 2.0, 2.0, 3.0, 3.0]
    assert commands.sampled(10.0, linear=True)[1][:, 0] == pytest.approx([1.0, 2.0, 2.5, 3.0, 3.0])
