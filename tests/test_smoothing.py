"""Splines by least squares, in time that grows with the rows."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from time import perf_counter

import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline

from equimus_ctrl.recordings import smoothing
from equimus_ctrl.recordings.smoothing import ORDER, least_squares, recorded_motion
from equimus_ctrl.types import Array, Recording


def noisy(n: int, uneven: float = 0.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(2)
    time = 0.002 * (np.arange(n) + uneven * rng.uniform(-1, 1, n))
    return time, np.sin(3.0 * time) + 1e-3 * rng.normal(size=n)


@pytest.mark.parametrize("every", [2, 3, 40])
@pytest.mark.parametrize("uneven", [0.0, 0.4])
def test_coefficients_are_those_of_scipy(every: int, uneven: float) -> None:
    time, values = noisy(1003, uneven)
    inside = time[every : len(time) - every // 2 - 1 : every]
    knots = np.concatenate([[time[0]] * ORDER, inside, [time[-1]] * ORDER])
    expected = make_lsq_spline(time, values, knots, k=ORDER - 1)
    np.testing.assert_allclose(least_squares(time, values, knots).c, expected.c, rtol=0, atol=1e-13)


def test_ten_times_the_rows_take_no_hundred_times_the_time() -> None:
    def taken(n: int) -> float:
        time, values = noisy(n)
        knots = np.concatenate([[time[0]] * ORDER, time[2:-2:2], [time[-1]] * ORDER])
        spans = []
        for _ in range(3):
            begun = perf_counter()
            least_squares(time, values, knots)
            spans.append(perf_counter() - begun)
        return min(spans)

    taken(100)
    assert taken(100_000) < 30 * taken(10_000)


def test_threads_that_ask_at_once_smooth_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, own = [], smoothing.smoothed
    monkeypatch.setattr(smoothing, "smoothed", lambda *given: calls.append(1) or own(*given))
    time, values = noisy(3000)
    recording = Recording("t", time, np.zeros((3000, 1)), values[:, None], ("motor",), ("pivot",))
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: recorded_motion(recording, 0.02).motion, range(8)))
    assert len(calls) == 1 and all(motion is found[0] for motion in found)
