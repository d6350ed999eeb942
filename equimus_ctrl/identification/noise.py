"""Measurement noise: how large, how coloured, and the filter that turns it into white noise of unit variance.

Each joint's noise is white noise plus an Ornstein–Uhlenbeck process, seen at any sample times:

    y = c + w,    w ~ N(0, white²),    E[c(t) c(t')] = coloured² · exp(−|t − t'| / time)

Its innovations, from a Kalman filter with one state, are white, so that sums of their squares are χ².
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import minimize
from scipy.special import chdtri

from equimus_ctrl.types import Array

COLOUR = 12.0
"""Least gain in −2 ln L of correlated noise over white noise: χ² of its two parameters at the level 0.0025."""
LONGEST = 0.12
"""Longest correlation that counts as noise [s]; what lasts longer is motion that the model ought to give."""
SHORTEST = 2e-3
"""Shortest; at the rates of motion capture it is as good as white [s]."""
LAGS = (LONGEST / 4, LONGEST / 2, LONGEST)
"""Over these, second differences bound noise [s]. Shorter ones would see more, but noise of measurements that were
low-passed is smooth: of a Butterworth filter of second order at 6 Hz, run both ways, as motion capture has it, the
shortest gives 0.37 of the true variance, half of it 0.07."""
LEAST = 1e-7
"""Least noise [rad]: a simulation's recording may have none."""
SAME = 1e-9
"""Of the largest value: nearer values are the same but for rounding."""
LEAST_STEPS = 10
"""Fewer different values say nothing of a step."""


@dataclass(frozen=True)
class JointNoise:
    """Of one joint.

    Attributes:
        white: standard deviation of the white part [rad].
        coloured: of the correlated part [rad].
        time: correlation time of that [s].
    """

    white: float
    coloured: float = 0.0
    time: float = SHORTEST

    @property
    def sigma(self) -> float:
        """Standard deviation of both together [rad]."""
        return math.hypot(self.white, self.coloured)


Noise = tuple[JointNoise, ...]
"""Of every joint."""


@njit(cache=True, nogil=True, error_model="numpy")
def _innovations(time: Array, rows: Array, white: float, coloured: float, tau: float, out: Array) -> float:
    """Σ log S of the innovations of columns; ``out`` (m, k) is written with the innovations over √S."""
    m, k = rows.shape
    state = np.zeros(k)
    r, whole = white * white, coloured * coloured
    p, logs = whole, 0.0
    for i in range(m):
        if i > 0:
            kept = math.exp(-(time[i] - time[i - 1]) / tau)
            p = kept * kept * p + (1.0 - kept * kept) * whole
            for c in range(k):
                state[c] *= kept
        s = p + r
        gain, scale = p / s, 1.0 / math.sqrt(s)
        logs += math.log(s)
        for c in range(k):
            e = rows[i, c] - state[c]
            out[i, c] = e * scale
            state[c] += gain * e
        p *= 1.0 - gain
    return logs


def whiten(noise: Noise, time: Array, values: Array) -> Array:
    """The innovations of series whose noise is that of the joints, in units of their standard deviations.

    Args:
        noise: of every joint.
        time: (m,) sample times [s].
        values: (m, nj, ...) residuals or derivatives of predictions.

    Returns:
        An array of the same shape.
    """
    m, nj = values.shape[:2]
    if all(own.coloured == 0.0 for own in noise):
        return np.asarray(values / np.array([own.white for own in noise]).reshape(nj, *[1] * (values.ndim - 2)))
    flat = values.reshape(m, nj, -1)
    out = np.empty_like(flat)
    for j, own in enumerate(noise):
        if own.coloured == 0.0:
            out[:, j] = flat[:, j] / own.white
            continue
        column = np.empty((m, flat.shape[2]))
        _innovations(time, np.ascontiguousarray(flat[:, j]), own.white, own.coloured, own.time, column)
        out[:, j] = column
    return out.reshape(values.shape)


def log_likelihood(noise: Noise, times: Sequence[Array], residuals: Sequence[Array]) -> float:
    """Gaussian log likelihood of residual series (m, nj), without the constant terms."""
    total = 0.0
    for time, residual in zip(times, residuals, strict=True):
        for j, own in enumerate(noise):
            column = np.empty((len(time), 1))
            rows = np.ascontiguousarray(residual[:, j : j + 1])
            total -= 0.5 * _innovations(time, rows, own.white, own.coloured, own.time, column)
            total -= 0.5 * float((column**2).sum())
    return total


def white_noise(residuals: Sequence[Array]) -> Noise:
    """White noise as large as residual series (m, nj) are."""
    size = np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0))
    return tuple(JointNoise(max(float(s), LEAST)) for s in size)


def noise_of_differences(positions: Sequence[Array]) -> Noise:
    """White noise as large as second differences of measured angles (m, nj) say; colour makes it too small."""
    second = np.concatenate([np.diff(position, 2, axis=0) for position in positions])
    size = np.sqrt((second**2).mean(axis=0) / 6.0)
    return tuple(JointNoise(max(float(s), LEAST)) for s in size)


def resolution(values: Array) -> float:
    """What differences of values are whole multiples of, as far as they say; 0 where there is no such step."""
    differences = np.diff(np.unique(values))
    differences = differences[differences > SAME * np.abs(values).max(initial=1e-300)]
    if len(differences) < LEAST_STEPS:
        return 0.0
    step = float(np.quantile(differences, 0.1))
    counts = differences / step
    step = float(np.median(differences[counts < 1.5]))
    even = np.abs(differences / step - np.round(differences / step)) < 0.05
    return step if even.mean() > 0.95 else 0.0


def largest_noise(times: Sequence[Array], residuals: Sequence[Array], level: float, longest: float = LONGEST) -> Array:
    """(nj,) the largest standard deviation that the noise in residual series can have [rad or m]; inf if too short.

    What a model leaves out makes residuals that last, and an estimate of coloured noise takes them for noise. Their
    second differences d = y(t − h) − 2·y(t) + y(t + h) over a lag h hardly see what is slower than h. Noise of variance
    s² whose correlation lasts ``longest`` or less makes

        E[d²] ≥ s²·(6 − 4ρ₁ − 4ρ₂ + 2ρ₁ρ₂),    ρᵢ = exp(−hᵢ/longest),

    with h₁, h₂ before and behind t: the right side falls in both ρ, so noise that forgets sooner, white noise at last,
    and any sum of such noises makes more. Errors of the model, and spikes where it misses an impact, add to d². So each
    lag bounds s² from above, and the least of ``LAGS`` counts. The mean of d² is known from finitely many: its upper
    confidence limit at a level, χ² of as many as share no samples, is taken.

    Args:
        times: for each series (m,) [s].
        residuals: for each series (m, nj) [rad or m].
        level: probability that noise is larger by chance.
        longest: upper bound of the correlation time [s].
    """
    steps = np.concatenate([np.diff(time) for time in times])
    bound = np.full(residuals[0].shape[1], np.inf)
    if not len(steps):
        return bound
    for lag in LAGS:
        k = max(round(lag / float(np.median(steps))), 1)
        squares, least, count = np.zeros(len(bound)), 0.0, 0
        for time, rows in zip(times, residuals, strict=True):
            second = rows[: -2 * k] - 2 * rows[k:-k] + rows[2 * k :]
            kept = np.exp((time[:-k] - time[k:]) / longest)
            before, behind = kept[:-k], kept[k:]
            squares += (second**2).sum(axis=0)
            least += float((6 - 4 * before - 4 * behind + 2 * before * behind).sum())
            count += (len(time) - 1) // (2 * k)
        if count:
            bound = np.minimum(bound, squares / least * count / chdtri(count, 1 - level))
    return np.asarray(np.sqrt(bound))


def estimate_noise(
    times: Sequence[Array],
    residuals: Sequence[Array],
    longest: float = LONGEST,
    correlated: Callable[[float], bool] = lambda gain: not gain < COLOUR,
) -> Noise:
    """The noise that makes residual series (m, nj) most likely, joint by joint.

    Args:
        times: for each series (m,) [s].
        residuals: for each series (m, nj) [rad or m].
        longest: upper bound of the correlation time [s].
        correlated: whether noise that is correlated over time is taken, for its gain in −2 ln L over white noise.
    """
    return tuple(
        _estimate(times, [np.ascontiguousarray(r[:, j : j + 1]) for r in residuals], longest, correlated)
        for j in range(residuals[0].shape[1])
    )


def _estimate(
    times: Sequence[Array], series: Sequence[Array], longest: float, correlated: Callable[[float], bool]
) -> JointNoise:
    count = sum(len(s) for s in series)
    columns = [np.empty_like(s) for s in series]

    def profile(share: float, tau: float) -> tuple[float, float]:
        """(−2 log L/n with the best size, that size squared) for a share of coloured variance."""
        logs = squares = 0.0
        for time, rows, out in zip(times, series, columns, strict=True):
            logs += _innovations(time, rows, math.sqrt(1.0 - share), math.sqrt(share), tau, out)
            squares += float((out**2).sum())
        size = max(squares / count, LEAST**2)
        return math.log(size) + logs / count, size

    def objective(x: Array) -> float:
        return profile(float(x[0]), math.exp(float(x[1])))[0]

    bounds = [(0.0, 1.0 - 1e-6), (math.log(SHORTEST), math.log(longest))]
    tried = [(objective(np.array([s, math.log(t)])), s, t) for s in (0.1, 0.5, 0.95) for t in (0.01, 0.03, longest)]
    _, share, tau = min(tried)
    found = minimize(
        objective,
        np.array([share, math.log(tau)]),
        method="Nelder-Mead",
        bounds=bounds,
        options={"xatol": 1e-3, "fatol": 1e-7, "maxiter": 120},
    )
    share, tau = float(found.x[0]), math.exp(float(found.x[1]))
    value, size = profile(share, tau)
    plain, plain_size = profile(0.0, tau)
    if not correlated((plain - value) * count):
        return JointNoise(math.sqrt(plain_size))
    return JointNoise(math.sqrt((1.0 - share) * size), math.sqrt(share * size), tau)
