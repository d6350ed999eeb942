"""When rows were stamped, how positions scatter, and where they rest: what takes no time to find out.

Positions are x(t) = motion + noise, and the noise is seen where the motion is none: at rest, or in second differences

    d = x(t − h) − 2 x(t) + x(t + h),    σ² = E[d²]/6,

of white noise over one row h. Rests are windows in which x scatters no more than noise and steps of the sensor do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import kolmogorov

from equimus_ctrl.identification.noise import LEAST, noise_of_differences, step_of
from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.types import Array, Recording

REST = 0.25
"""Shortest rest [s], and width of the window that looks for it."""
LEAST_ROWS = 8
"""Rows of that window at least."""
STILL = 1.5
"""At rest positions scatter by at most so many times what noise and steps make."""
ENOUGH = 60
"""So many rows at rest say how large the noise is."""
BLOCK = 50
"""Rows of the blocks over whose second differences the median is taken where there is no rest."""


@dataclass(frozen=True)
class Clock:
    """When rows were stamped.

    Attributes:
        rows: how many.
        duration: from the first to the last [s].
        interval: median time between rows [s].
        jitter: standard deviation of the time between rows, gaps left out [s].
        gaps: (from, length) of times without rows [s], see ``CheckLimits.gap``.
        bursts: share of rows that come at once after the one before, see ``CheckLimits.burst``.
    """

    rows: int
    duration: float
    interval: float
    jitter: float
    gaps: tuple[tuple[float, float], ...]
    bursts: float

    @property
    def rate(self) -> float:
        """Rows a second [Hz]."""
        return 1.0 / self.interval

    @classmethod
    def of(cls, time: Array, limits: CheckLimits = LIMITS) -> Clock:
        """Of the stamps (n,) of a recording, which ascend [s]."""
        steps = np.diff(time)
        if not len(steps):
            return cls(len(time), 0.0, math.inf, 0.0, (), 0.0)
        usual = float(np.median(steps))
        wide = steps > limits.gap * usual
        gaps = tuple((float(time[k]), float(steps[k])) for k in np.flatnonzero(wide))
        kept = steps[~wide]
        bursts = float(np.mean(steps < limits.burst * usual))
        return cls(len(time), float(time[-1] - time[0]), usual, float(kept.std()), gaps, bursts)


@dataclass(frozen=True)
class JointScatter:
    """How the positions of one joint scatter in one recording.

    Attributes:
        name: of the joint.
        low: lowest position [rad or m].
        high: highest position [rad or m].
        deviation: standard deviation of the positions [rad or m].
        step: in which measurements come [rad or m]; 0 where they come in none.
        noise: standard deviation, at rest where there is rest; not less than the error of the steps [rad or m].
        at_rest: whether it is that at rest; else accelerations may make it larger.
        fresh: rows whose value is not that of the row before.
        rows: how many.
        white: probability that white noise has a spectrum as uneven as that of the positions.
    """

    name: str
    low: float
    high: float
    deviation: float
    step: float
    noise: float
    at_rest: bool
    fresh: int
    rows: int
    white: float

    @property
    def travel(self) -> float:
        """From the lowest to the highest position [rad or m]."""
        return self.high - self.low


def scatter_of(recording: Recording, limits: CheckLimits = LIMITS) -> tuple[JointScatter, ...]:
    """How the positions of each joint scatter: the part of ``signals_of`` that takes no time."""
    return scatter_and_rests(recording, Clock.of(np.array(recording.time), limits))[0]


def scatter_and_rests(recording: Recording, clock: Clock) -> tuple[tuple[JointScatter, ...], NDArray[np.bool_]]:
    """The same, and which rows are at rest."""
    position = np.array(recording.position)
    steps = np.array([step_of(column) for column in position.T])
    steps[np.isinf(steps)] = 0.0  # of a joint that does not move nothing is known
    noise, at_rest, resting = noise_and_rests(clock, position, steps)
    rows = zip(recording.joints, position.T, steps.tolist(), noise.tolist(), at_rest.tolist(), strict=True)
    return tuple(
        JointScatter(
            name,
            float(x.min()),
            float(x.max()),
            float(x.std()),
            step,
            size,
            rest,
            int(np.count_nonzero(np.diff(x))),
            len(x),
            whiteness(x),
        )
        for name, x, step, size, rest in rows
    ), resting


def noise_and_rests(clock: Clock, position: Array, steps: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """(nj,) the noise of positions (n, nj), (nj,) whether it is that at rest, and (n,) which rows are at rest.

    The noise by second differences is too large where the joints accelerate. So rests are looked for by it, the noise
    is taken from these, and they are looked for once more.

    Args:
        clock: of the rows.
        position: measured [rad or m].
        steps: (nj,) of the sensors [rad or m].
    """
    floor = np.maximum(steps / math.sqrt(12), LEAST)
    noise = np.maximum(block_noise(position), floor)
    resting, at_rest = np.zeros(len(position), dtype=bool), np.zeros(position.shape[1], dtype=bool)
    for _ in range(2):
        resting = _resting(clock, position, np.maximum(noise, floor))
        pieces = [position[a:b] for a, b in runs_of(resting) if b - a > 2]
        if sum(len(piece) for piece in pieces) >= ENOUGH:
            rested = np.array([own.sigma for own in noise_of_differences(pieces)])
            # Where positions are exactly the same in all rests, these say nothing.
            at_rest = rested > LEAST
            noise = np.maximum(np.where(at_rest, rested, noise), floor)
    return noise, at_rest, resting


def block_noise(position: Array) -> Array:
    """(nj,) the median over blocks of rows of what second differences say: a few fast moments do not count."""
    second = np.diff(position, 2, axis=0) ** 2
    if len(second) == 0:
        return np.zeros(position.shape[1])
    means = np.array([block.mean(axis=0) for block in np.array_split(second, max(len(second) // BLOCK, 1))])
    # Blocks in which nothing changes at all say nothing.
    return np.array([math.sqrt(float(np.median(own[own > 0])) / 6.0) if np.any(own > 0) else 0.0 for own in means.T])


def whiteness(x: Array) -> float:
    """Probability that white noise (n,) has a spectrum as uneven as x has, by Bartlett's test (1955).

    The periodogram of white noise, summed from low to high frequencies and divided by the whole sum, is the empirical
    distribution of uniform numbers: how far it is from a straight line has Kolmogorov's distribution.
    """
    power = np.abs(np.fft.rfft(x - x.mean())[1 : (len(x) + 1) // 2]) ** 2
    count = len(power) - 1
    if count < 1 or not power.sum() > 0:
        return 1.0
    summed = np.cumsum(power)[:-1] / power.sum()
    even = np.arange(1, count + 1) / (count + 1)
    return float(kolmogorov(math.sqrt(count) * float(np.abs(summed - even).max())))


def _resting(clock: Clock, position: Array, noise: Array) -> NDArray[np.bool_]:
    """(n,) rows in a window that scatters no more than noise does, at every joint."""
    n = len(position)
    width = max(round(REST / clock.interval), LEAST_ROWS)
    found = np.zeros(n, dtype=bool)
    if n < width:
        return found
    centred = position - np.median(position, axis=0)
    sums = np.vstack([np.zeros(centred.shape[1]), np.cumsum(centred, axis=0)])
    squares = np.vstack([np.zeros(centred.shape[1]), np.cumsum(centred**2, axis=0)])
    mean = (sums[width:] - sums[:-width]) / width
    variance = (squares[width:] - squares[:-width]) / width - mean**2
    rounding = 1e-12 * squares[-1] / n  # cumulative sums are no better than that
    still = np.all(variance <= (STILL * noise) ** 2 + rounding, axis=1)
    count = np.zeros(n + 1, dtype=int)
    np.add.at(count, np.flatnonzero(still), 1)
    np.add.at(count, np.flatnonzero(still) + width, -1)
    return np.asarray(np.cumsum(count)[:n] > 0)


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(from, behind) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
