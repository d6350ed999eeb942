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
LAGS = (0.25, 0.5, 1.0)
"""Over these shares of the longest correlation second differences bound noise. Shorter ones would see more, but noise
of measurements that were low-passed is smooth: of a Butterworth filter of second order at 6 Hz, run both ways, as
motion capture has it, the shortest gives 0.37 of the true variance, half of it 0.07."""
LEAST = 1e-7
"""Least noise [rad, m or a channel's own unit]: a simulation's recording may have none."""
SAME = 1e-9
"""Of the largest value: nearer values are the same but for rounding."""
LEAST_STEPS = 10
"""Fewer differences of values say nothing of a step."""
SMALL_DIFFERENCES = 0.1
"""Share of the differences between neighbouring values that are smaller than the one which is about one step."""
ONE_STEP = 1.5
"""Differences below so many times that one are of one step; their median is the step."""
OFF_STEP = 0.05
"""A difference is a whole multiple of the step up to this share of it."""
WHOLE_STEPS = 0.95
"""Share of the differences that have to be whole multiples: a few are of values that were filtered or joined."""
GUESSED_SHARES, GUESSED_TIMES = (0.1, 0.5, 0.95), (0.01, 0.03)
"""Coloured shares of the variance, and correlation times [s] beside the longest: the search for the most likely noise
begins at the best of these."""
TOLERANCES = {"xatol": 1e-3, "fatol": 1e-7, "maxiter": 120}
"""Of that search, in the share and ln τ, in −2 ln L for each sample, and in steps."""


@dataclass(frozen=True)
class JointNoise:
    """Noise of one joint, or of another channel that was measured.

    Attributes:
        white: standard deviation of the white part [rad, m or the channel's own unit].
        coloured: of the correlated part [same].
        time: correlation time of that [s].
    """

    white: float
    coloured: float = 0.0
    time: float = SHORTEST

    @property
    def sigma(self) -> float:
        """Standard deviation of both together [rad, m or the channel's own unit]."""
        return math.hypot(self.white, self.coloured)


Noise = tuple[JointNoise, ...]
"""Of every joint, and of every other channel after them."""


def drawn_noise(noise: Noise, time: Array, normal: Array) -> Array:
    """(m, nc) noise at times (m,) [s], from standard normal numbers (2, m, nc): white parts, then correlated ones."""
    white, steps = normal
    found: Array = np.empty((len(time), len(noise)))
    for c, own in enumerate(noise):
        found[:, c] = own.white * white[:, c]
        if own.coloured == 0.0:
            continue
        kept = np.exp(-np.diff(time) / own.time)
        state = steps[:, c].copy()
        for k, (share, rest) in enumerate(zip(kept.tolist(), np.sqrt(1.0 - kept**2).tolist(), strict=True), start=1):
            state[k] = share * state[k - 1] + rest * state[k]
        found[:, c] += own.coloured * state
    return found


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

    With e = y − ĉ, ĉ what a Kalman filter predicts of c, and S the variance of e, they are e/√S: white, of unit
    variance, where the noise is as it is said.

    Args:
        noise: of every joint and other channel.
        time: (m,) sample times [s].
        values: (m, nj + ne, ...) residuals or derivatives of predictions [rad, m or the channel's own unit].

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
    """Gaussian log likelihood −½ Σ (ln S + e²/S) of residual series, without the constant terms, see ``whiten``.

    Args:
        noise: of every joint and other channel.
        times: for each series (m,) [s].
        residuals: for each series (m, nj + ne) [rad, m or the channel's own unit].
    """
    total = 0.0
    for time, residual in zip(times, residuals, strict=True):
        for j, own in enumerate(noise):
            column = np.empty((len(time), 1))
            rows = np.ascontiguousarray(residual[:, j : j + 1])
            total -= 0.5 * _innovations(time, rows, own.white, own.coloured, own.time, column)
            total -= 0.5 * float((column**2).sum())
    return total


def white_noise(residuals: Sequence[Array]) -> Noise:
    """White noise as large as residual series (m, nj + ne) are, their root mean square; at least ``LEAST``."""
    size = np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0))
    return tuple(JointNoise(max(float(s), LEAST)) for s in size)


def noise_of_differences(positions: Sequence[Array]) -> Noise:
    """White noise as large as second differences d of measured positions (m, nj) say, √(mean of d²/6).

    Colour makes it too small, accelerations too large.
    """
    second = np.concatenate([np.diff(position, 2, axis=0) for position in positions])
    size = np.sqrt((second**2).mean(axis=0) / 6.0)
    return tuple(JointNoise(max(float(s), LEAST)) for s in size)


def resolution(values: Array) -> float:
    """What differences of values are whole multiples of, as far as they say; 0 where there is no such step."""
    differences = np.diff(np.unique(values))
    differences = differences[differences > SAME * np.abs(values).max(initial=1e-300)]
    if len(differences) < LEAST_STEPS:
        return 0.0
    step = float(np.quantile(differences, SMALL_DIFFERENCES))
    counts = differences / step
    step = float(np.median(differences[counts < ONE_STEP]))
    even = np.abs(differences / step - np.round(differences / step)) < OFF_STEP
    return step if even.mean() > WHOLE_STEPS else 0.0


def step_of(values: Array) -> float:
    """In which measured values come; of few values the least difference, inf of a single one: it says nothing."""
    few = np.diff(np.unique(values))
    few = few[few > SAME * np.abs(values).max(initial=1e-300)]
    return resolution(values) if len(few) >= LEAST_STEPS else float(few.min(initial=math.inf))


def largest_noise(times: Sequence[Array], residuals: Sequence[Array], level: float, longest: float = LONGEST) -> Array:
    """(nj + ne,) the largest standard deviation that noise in residual series can have; inf if they are too short.

    What a model leaves out makes residuals that last, and an estimate of coloured noise takes them for noise. Their
    second differences d = y(t − h) − 2·y(t) + y(t + h) over a lag h hardly see what is slower than h. Noise of variance
    s² whose correlation lasts ``longest`` or less makes

        E[d²] ≥ s²·(6 − 4ρ₁ − 4ρ₂ + 2ρ₁ρ₂),    ρᵢ = exp(−hᵢ/longest),

    with h₁, h₂ before and behind t: the right side falls in both ρ, so noise that forgets sooner, white noise at last,
    and any sum of such noises makes more. Errors of the model, and spikes where it misses an impact, add to d². So each
    lag bounds s² from above, and the least over ``LAGS`` counts. The mean of d² is known from finitely many: its upper
    confidence limit at a level, χ² of as many as share no samples, is taken.

    Args:
        times: for each series (m,) [s].
        residuals: for each series (m, nj + ne) [rad, m or the channel's own unit].
        level: probability that noise is larger by chance.
        longest: upper bound of the correlation time [s].
    """
    steps = np.concatenate([np.diff(time) for time in times])
    bound = np.full(residuals[0].shape[1], np.inf)
    if not len(steps):
        return bound
    for share in LAGS:
        k = max(round(share * longest / float(np.median(steps))), 1)
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
    least: Array | None = None,
) -> Noise:
    """The noise that makes residual series most likely, joint by joint and channel by channel.

    Args:
        times: for each series (m,) [s].
        residuals: for each series (m, nj + ne) [rad, m or the channel's own unit].
        longest: upper bound of the correlation time [s].
        correlated: whether noise that is correlated over time is taken, for its gain in −2 ln L over white noise.
        least: (nj + ne,) standard deviation, in units of the residuals; ``LEAST`` by default.
    """
    count = residuals[0].shape[1]
    bounds = np.full(count, LEAST) if least is None else np.maximum(least, LEAST)
    return tuple(
        _estimate(times, [np.ascontiguousarray(r[:, j : j + 1]) for r in residuals], longest, correlated, bounds[j])
        for j in range(count)
    )


def _estimate(
    times: Sequence[Array],
    series: Sequence[Array],
    longest: float,
    correlated: Callable[[float], bool],
    least: float,
) -> JointNoise:
    count = sum(len(s) for s in series)
    columns = [np.empty_like(s) for s in series]

    def profile(share: float, tau: float) -> tuple[float, float]:
        """(−2 log L/n with the best size, that size squared) for a share of coloured variance."""
        logs = squares = 0.0
        for time, rows, out in zip(times, series, columns, strict=True):
            logs += _innovations(time, rows, math.sqrt(1.0 - share), math.sqrt(share), tau, out)
            squares += float((out**2).sum())
        size = max(squares / count, least**2)
        return math.log(size) + logs / count, size

    def objective(x: Array) -> float:
        return profile(float(x[0]), math.exp(float(x[1])))[0]

    bounds = [(0.0, 1.0 - 1e-6), (math.log(SHORTEST), math.log(longest))]
    guesses = [(s, t) for s in GUESSED_SHARES for t in (*GUESSED_TIMES, longest)]
    tried = [(objective(np.array([s, math.log(t)])), s, t) for s, t in guesses]
    _, share, tau = min(tried)
    found = minimize(
        objective,
        np.array([share, math.log(tau)]),
        method="Nelder-Mead",
        bounds=bounds,
        options=TOLERANCES,
    )
    share, tau = float(found.x[0]), math.exp(float(found.x[1]))
    value, size = profile(share, tau)
    plain, plain_size = profile(0.0, tau)
    if not correlated((plain - value) * count):
        return JointNoise(math.sqrt(plain_size))
    return JointNoise(math.sqrt((1.0 - share) * size), math.sqrt(share * size), tau)
