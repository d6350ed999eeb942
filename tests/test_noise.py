"""Noise of sensors: estimated, whitened, judged."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.noise import (
    LONGEST,
    JointNoise,
    estimate_noise,
    largest_noise,
    log_likelihood,
    noise_of_differences,
    white_noise,
    whiten,
)
from equimus_ctrl.types import Array


def series(
    white: float, coloured: float, time: float, seed: int = 0, count: int = 6
) -> tuple[list[Array], list[Array]]:
    """Jittered times [s] and noise (n, 2) [rad]."""
    rng = np.random.default_rng(seed)
    times, found = [], []
    for _ in range(count):
        t = np.cumsum(np.clip(rng.normal(1 / 120, 1e-3, 1200), 2e-3, None))
        x = rng.normal(size=(len(t), 2))
        kept = np.exp(-np.diff(t) / time)
        for k, share in enumerate(kept, start=1):
            x[k] = share * x[k - 1] + math.sqrt(1 - share**2) * x[k]
        times.append(t)
        found.append(coloured * x + white * rng.normal(size=x.shape))
    return times, found


@pytest.mark.parametrize(
    ("white", "coloured", "time"), [(2e-3, 0.0, 0.01), (0.0, 3e-3, 0.08), (1e-3, 2e-3, 0.03), (0.0, 1e-3, 0.01)]
)
def test_size_and_colour_are_found_and_the_innovations_are_white(white: float, coloured: float, time: float) -> None:
    times, residuals = series(white, coloured, time)
    noise = estimate_noise(times, residuals)
    for own in noise:
        assert own.sigma == pytest.approx(math.hypot(white, coloured), rel=0.06)
        if coloured > white:
            assert own.time == pytest.approx(time, rel=0.2)
        else:
            assert own.coloured == 0.0
    e = [whiten(noise, t, r) for t, r in zip(times, residuals, strict=True)]
    stacked = np.concatenate(e)
    assert stacked.std(axis=0) == pytest.approx(1.0, rel=0.02)
    neighbours = np.concatenate([x[1:] * x[:-1] for x in e]).mean(axis=0)
    assert np.all(np.abs(neighbours) < 5 / math.sqrt(len(stacked)))


def test_the_likelihood_is_that_of_the_dense_covariance() -> None:
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.005, 0.02, 40))
    y = rng.normal(size=(40, 1)) * 1e-3
    own = JointNoise(7e-4, 1.3e-3, 0.02)
    covariance = own.coloured**2 * np.exp(-np.abs(t[:, None] - t) / own.time) + own.white**2 * np.eye(40)
    _, logdet = np.linalg.slogdet(covariance)
    dense = -0.5 * (logdet + y[:, 0] @ np.linalg.solve(covariance, y[:, 0]))
    assert log_likelihood((own,), [t], [y]) == pytest.approx(dense, rel=1e-10)


def test_whitening_is_linear_and_keeps_shapes() -> None:
    times, residuals = series(1e-3, 1e-3, 0.02, count=1)
    noise = (JointNoise(1e-3, 2e-3, 0.03), JointNoise(1e-3))
    values = np.random.default_rng(1).normal(size=(len(times[0]), 2, 3))
    both = whiten(noise, times[0], values)
    assert both.shape == values.shape
    for k in range(3):
        np.testing.assert_allclose(both[:, :, k], whiten(noise, times[0], values[:, :, k]), rtol=1e-12)
    np.testing.assert_allclose(whiten(noise, times[0], 2 * residuals[0]), 2 * whiten(noise, times[0], residuals[0]))


def test_rough_sizes_do_not_see_slow_motion() -> None:
    times, residuals = series(2e-3, 0.0, 0.01, count=2)
    moving = [0.2 * np.sin(t)[:, None] + r for t, r in zip(times, residuals, strict=True)]
    for own in noise_of_differences(moving):
        assert own.white == pytest.approx(2e-3, rel=0.1)
    assert white_noise(residuals)[0].white == pytest.approx(2e-3, rel=0.05)


@pytest.mark.parametrize(
    ("white", "coloured", "time"), [(2e-3, 0.0, 0.01), (0.0, 3e-3, LONGEST), (1e-3, 2e-3, 0.03), (0.0, 1e-3, 0.01)]
)
def test_noise_is_within_what_its_second_differences_allow(white: float, coloured: float, time: float) -> None:
    times, residuals = series(white, coloured, time)
    ratio = largest_noise(times, residuals, 1e-3) / math.hypot(white, coloured)
    assert np.all(ratio > 1.0) and np.all(ratio < 2.0)


@pytest.mark.parametrize("count", [1, 4, 20])
def test_the_bound_holds_on_short_recordings_of_the_slowest_noise(count: int) -> None:
    short = [series(0.0, 1e-3, LONGEST, seed, count=1) for seed in range(200)]
    cut = 36 * count  # so many disjoint second differences over the longest lag
    bounds = np.array([largest_noise([t[0][:cut]], [r[0][:cut]], 1e-3) for t, r in short])
    assert np.mean(bounds < 1e-3) < 0.01


def test_what_is_slower_than_noise_hardly_raises_the_bound_however_it_is_sampled() -> None:
    times, residuals = series(1e-3, 0.0, 0.01, count=3)
    wrong = [0.014 * np.sin(3.0 * t)[:, None] + r for t, r in zip(times, residuals, strict=True)]
    taken_for_noise = np.array([own.sigma for own in estimate_noise(times, wrong)])
    bound = largest_noise(times, wrong, 1e-3)
    assert np.all(taken_for_noise > 2 * bound) and np.all(bound < 2e-3)
    fewer = [slice(None, None, 5)] * 3
    bound = largest_noise(
        [t[s] for t, s in zip(times, fewer, strict=True)], [r[s] for r, s in zip(wrong, fewer, strict=True)], 1e-3
    )
    assert np.all(bound < 2e-3)


def test_noise_of_filtered_measurements_is_not_far_above_the_bound() -> None:
    white = np.random.default_rng(4).normal(size=(20_000, 1))
    filtered = sosfiltfilt(butter(2, 6.0, fs=500.0, output="sos"), white, axis=0)
    assert largest_noise([np.arange(20_000) / 500], [filtered], 1e-3)[0] > filtered.std() / 2


def test_series_too_short_for_a_second_difference_do_not_bound_noise() -> None:
    assert np.all(np.isinf(largest_noise([np.array([0.0, 0.01])], [np.zeros((2, 3))], 1e-3)))


def judged(time: Array, measured: Array, true: Array) -> tuple[float, float]:
    """How large noise is taken to be, and root mean square residuals, where a model predicts the true motion."""
    residuals = [(measured - true)[:, None]]
    segments = [SimpleNamespace(outputs=measured[:, None])]
    data: Any = SimpleNamespace(times=[time], segments=segments, thresholds=Thresholds(), least_noise=None)
    fitted: Any = SimpleNamespace(fit=SimpleNamespace(residuals=residuals), noise=estimate_noise([time], residuals))
    return float(noise_sizes(data, fitted)[0]), float(np.sqrt(np.mean(residuals[0] ** 2)))


@pytest.mark.parametrize("reach", [2.0, 40.0], ids=["few values", "many values"])
def test_an_encoders_steps_are_noise_however_slowly_a_joint_moves(reach: float) -> None:
    """Reach in steps. The error of a step lasts as long as the joint rests within it, far longer than noise."""
    time, step = np.arange(0.0, 60.0, 0.01), 1e-3
    true = step * (0.3 + reach * np.sin(0.05 * time))
    sigma, left = judged(time, step * np.round(true / step), true)
    assert 0 < left < 2 * sigma < 2 * step


def test_what_changes_by_rounding_alone_comes_in_no_steps() -> None:
    """A constant of 0.3 that is sometimes the next number: its steps of 5.6e-17 are no encoder's."""
    time = np.arange(400) / 100
    constant = np.full(400, 0.3)
    jittered = np.where(np.arange(400) % 3, constant, np.nextafter(constant, 1))
    still, _ = judged(time, constant, constant + 0.01)
    assert judged(time, jittered, constant + 0.01)[0] == pytest.approx(still)


def test_of_a_measurement_that_never_changes_the_estimate_is_taken() -> None:
    time = np.arange(0.0, 9.0, 0.01)
    true = 0.3 * np.sin(2.0 * time)
    estimated = estimate_noise([time], [-true[:, None]])[0].sigma
    assert judged(time, np.zeros_like(time), true)[0] == estimated


def test_what_a_model_leaves_out_is_not_noise() -> None:
    time = np.arange(0.0, 30.0, 0.01)
    measured = np.sin(2.0 * time) + 1e-3 * np.random.default_rng(2).normal(size=len(time))
    sigma, left = judged(time, measured, np.sin(2.0 * time) + 0.01 * np.sin(5.0 * time))
    assert 1e-3 < sigma < 2.5e-3 and left > 6e-3
