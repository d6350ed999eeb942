"""What the signals of one recording are like, whatever the model: clock, steps, noise, rests, travel, bandwidth.

Positions are x(t) = motion + noise, and the noise is seen where the motion is none: at rest, or in second differences

    d = x(t − h) − 2 x(t) + x(t + h),    σ² = E[d²]/6,

of white noise over one row h. Rests are windows in which x scatters no more than noise and steps of the sensor do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

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
FAST = 2.0
"""Steps of the sensor from one row to the next from which on a joint is in motion."""
LARGE = 4.0
"""Standard deviations of the noise, likewise."""
MOST_UNEVEN = 2
"""Between the few and the many rows that a clock of its own holds values for: of a camera at 60 Hz in rows at 97 "
"Hz, 2."""
MOST_HELD = 20
"""Rows that a value is held at most; what stays for longer rests."""
LEAST_MOVING = 50
"""Fewer rows in motion say nothing of how often values are new."""
LEAST_FLAT = 3
"""Rows that a clipped measurement stays at its extreme at least."""
MOST = 0.99
"""Share of the speed's power that is below the bandwidth."""
SEGMENT = 4.0
"""Length of the periodograms whose mean is the spectrum [s]."""
LEAST_PERIODOGRAM = 16
"""Rows of one at least."""


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
        backward: rows whose stamp repeats or goes back.
    """

    rows: int
    duration: float
    interval: float
    jitter: float
    gaps: tuple[tuple[float, float], ...]
    bursts: float
    backward: int

    @property
    def rate(self) -> float:
        """Rows a second [Hz]."""
        return 1.0 / self.interval

    @classmethod
    def of(cls, time: Array, limits: CheckLimits = LIMITS) -> Clock:
        """Of the stamps (n,) of a recording [s]."""
        steps = np.diff(time)
        if not len(steps):
            return cls(len(time), 0.0, math.inf, 0.0, (), 0.0, 0)
        usual = float(np.median(steps))
        wide = steps > limits.gap * usual
        gaps = tuple((float(time[k]), float(steps[k])) for k in np.flatnonzero(wide))
        kept = steps[~wide]
        bursts = float(np.mean((steps > 0) & (steps < limits.burst * usual)))
        backward = int(np.count_nonzero(steps <= 0))
        return cls(len(time), float(time[-1] - time[0]), usual, float(kept.std()), gaps, bursts, backward)


@dataclass(frozen=True)
class Flat:
    """A stretch in which a measurement stays exactly at its extreme, entered in motion.

    Attributes:
        start: of it [s].
        length: of it [s].
        value: at which it stays [rad or m].
        speed: with which it was entered [rad/s or m/s].
    """

    start: float
    length: float
    value: float
    speed: float


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
    """

    name: str
    low: float
    high: float
    deviation: float
    step: float
    noise: float
    at_rest: bool
    fresh: int

    @property
    def travel(self) -> float:
        """From the lowest to the highest position [rad or m]."""
        return self.high - self.low


@dataclass(frozen=True)
class JointSignal(JointScatter):
    """What was measured of one joint in one recording.

    Attributes:
        speed: usual speed, its root mean square [rad/s or m/s].
        peak_speed: largest speed, smoothed over half a period of the bandwidth [rad/s or m/s].
        peak_acceleration: likewise [rad/s² or m/s²].
        bandwidth: frequency below which ``MOST`` of the speed's power is, above white noise [Hz]; 0 where none is.
        held: share of the rows in motion that repeat the value before.
        flats: see ``Flat``.
    """

    speed: float
    peak_speed: float
    peak_acceleration: float
    bandwidth: float
    held: float
    flats: tuple[Flat, ...]


@dataclass(frozen=True)
class CommandSignal:
    """What was commanded of one actuator in one recording.

    Attributes:
        name: of the actuator.
        low: lowest command [its unit].
        high: highest command [its unit].
        at_low: share of the rows at the lower limit of the model.
        at_high: share of the rows at the upper one.
        beyond: share of the rows beyond either.
        changes: how often the command changes.
    """

    name: str
    low: float
    high: float
    at_low: float
    at_high: float
    beyond: float
    changes: int


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording.

    Attributes:
        name: of it.
        clock: see ``Clock``.
        joints: in the robot's order.
        commands: of the actuators, in the robot's order.
        rests: (from, length) of the times in which all joints rest [s].
        resting: (n,) whether a row is in a rest.
    """

    name: str
    clock: Clock
    joints: tuple[JointSignal, ...]
    commands: tuple[CommandSignal, ...]
    rests: tuple[tuple[float, float], ...]
    resting: NDArray[np.bool_]

    @property
    def noise(self) -> Array:
        """(nj,) standard deviations [rad or m]."""
        return np.array([joint.noise for joint in self.joints])


def scatter_of(recording: Recording, limits: CheckLimits = LIMITS) -> tuple[JointScatter, ...]:
    """How the positions of each joint scatter: the part of ``signals_of`` that takes no time."""
    return _scatter(recording, Clock.of(np.array(recording.time), limits))[0]


def _scatter(recording: Recording, clock: Clock) -> tuple[tuple[JointScatter, ...], NDArray[np.bool_]]:
    """The same, and which rows are at rest."""
    position = np.array(recording.position)
    steps = np.array([step_of(column) for column in position.T])
    steps[np.isinf(steps)] = 0.0  # of a joint that does not move nothing is known
    noise, at_rest, resting = noise_and_rests(clock, position, steps)
    rows = zip(recording.joints, position.T, steps.tolist(), noise.tolist(), at_rest.tolist(), strict=True)
    return tuple(
        JointScatter(
            name, float(x.min()), float(x.max()), float(x.std()), step, size, rest, int(np.count_nonzero(np.diff(x)))
        )
        for name, x, step, size, rest in rows
    ), resting


def signals_of(recording: Recording, command_range: tuple[Array, Array], limits: CheckLimits = LIMITS) -> Signals:
    """What the signals of a recording are like.

    Args:
        recording: of any robot.
        command_range: (low, high), each (na,): between what commands make a difference, ±inf where nothing says so.
        limits: by which motion is told from noise.
    """
    time = np.array(recording.time)
    clock = Clock.of(time, limits)
    scatter, resting = _scatter(recording, clock)
    joints = tuple(_joint(own, time, recording.position[:, j], clock, limits) for j, own in enumerate(scatter))
    rests = tuple((float(time[a]), float(time[b - 1] - time[a])) for a, b in _runs(resting))
    commands = tuple(
        _command(name, recording.command[:, k], float(command_range[0][k]), float(command_range[1][k]))
        for k, name in enumerate(recording.actuators)
    )
    return Signals(recording.name, clock, joints, commands, rests, resting)


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
    noise = np.maximum(_block_noise(position), floor)
    resting, at_rest = np.zeros(len(position), dtype=bool), np.zeros(position.shape[1], dtype=bool)
    for _ in range(2):
        resting = _resting(clock, position, np.maximum(noise, floor))
        pieces = [position[a:b] for a, b in _runs(resting) if b - a > 2]
        if sum(len(piece) for piece in pieces) >= ENOUGH:
            rested = np.array([own.sigma for own in noise_of_differences(pieces)])
            # Where positions are exactly the same in all rests, these say nothing.
            at_rest = rested > LEAST
            noise = np.maximum(np.where(at_rest, rested, noise), floor)
    return noise, at_rest, resting


def _block_noise(position: Array) -> Array:
    """(nj,) the median over blocks of rows of what second differences say: a few fast moments do not count."""
    second = np.diff(position, 2, axis=0) ** 2
    if len(second) == 0:
        return np.zeros(position.shape[1])
    means = np.array([block.mean(axis=0) for block in np.array_split(second, max(len(second) // BLOCK, 1))])
    # Blocks in which nothing changes at all say nothing.
    return np.array([math.sqrt(float(np.median(own[own > 0])) / 6.0) if np.any(own > 0) else 0.0 for own in means.T])


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


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(from, behind) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _joint(own: JointScatter, time: Array, x: Array, clock: Clock, limits: CheckLimits) -> JointSignal:
    held = _held(x, own.step, own.noise)
    if held > limits.held:  # steps from value to value would be motion of all frequencies
        fresh = np.concatenate([[True], np.diff(x) != 0])
        even = np.interp(time, time[fresh], x[fresh])
    else:
        even = x
    bandwidth = _bandwidth(even, clock, max(own.noise, LEAST), limits.significance)
    speed, acceleration = _derivatives(time, even, clock, bandwidth)
    return JointSignal(
        **vars(own),
        speed=float(np.sqrt(np.mean(speed**2))),
        peak_speed=float(np.abs(speed).max()),
        peak_acceleration=float(np.abs(acceleration).max()),
        bandwidth=bandwidth,
        held=held,
        flats=_flats(time, x, max(own.noise, own.step), held, limits),
    )


def _held(x: Array, step: float, noise: float) -> float:
    """Share of the rows in motion that repeat the value before; 0 where too few are in motion.

    Such rows stand between two that go the same way, by so much that neighbours are alike by no chance. Of a sensor
    with
    a clock of its own about as many come each time; where friction holds a joint for a moment, any number do.
    """
    change = np.diff(x)
    large = np.abs(change) > max(FAST * step, LARGE * noise, np.finfo(float).eps * float(np.abs(x).max(initial=0.0)))
    moving = np.flatnonzero(large)
    if len(moving) < LEAST_MOVING:
        return 0.0
    between = np.diff(moving) - 1
    none = np.concatenate([[0], np.cumsum(change == 0)])
    all_repeat = none[moving[1:]] - none[moving[:-1] + 1] == between
    one_way = change[moving[1:]] * change[moving[:-1]] > 0
    counted = all_repeat & one_way & (between <= MOST_HELD)
    if np.count_nonzero(counted) < LEAST_MOVING:
        return 0.0
    rows = between[counted]
    if np.quantile(rows, 0.9) - np.quantile(rows, 0.1) > MOST_UNEVEN:
        return 0.0
    return float(rows.sum() / (rows + 1).sum())


def _flats(time: Array, x: Array, size: float, held: float, limits: CheckLimits) -> tuple[Flat, ...]:
    """Stretches at the extremes that hide motion, see ``Flat``: entered with more than ``CheckLimits.flat`` a row.

    What goes on at the speed v of entering, and comes back at once, hides v/4 of the stretch's length; that has to be
    as many steps or standard deviations. Where dry friction holds joints, stretches of the kind are elsewhere too: of
    these an extreme has to have more than all other values together.
    """
    least = LEAST_FLAT if held < limits.held else round(LEAST_FLAT / (1.0 - min(held, 0.95)))
    starts = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0]))
    lengths = np.diff(np.append(starts, len(x)))
    chosen = (lengths >= least) & (starts >= least)
    starts, lengths = starts[chosen], lengths[chosen]
    # Of held values the last change stands some rows back.
    speeds = np.abs(x[starts] - x[starts - least]) / least
    entered = (speeds > limits.flat * size) & (speeds * lengths / 4 > limits.flat * size)
    found = []
    for value in (float(x.min()), float(x.max())):
        here = entered & (x[starts] == value)
        if np.count_nonzero(here) <= np.count_nonzero(entered & (x[starts] != value)):
            continue
        for a, n, v in zip(starts[here], lengths[here], speeds[here], strict=True):
            speed = float(v) * least / float(time[a] - time[a - least])
            found.append(Flat(float(time[a]), float(time[a + n - 1] - time[a]), value, speed))
    return tuple(sorted(found, key=lambda flat: flat.start))


def _uniform(time: Array, x: Array, interval: float) -> Array:
    return np.interp(np.arange(time[0], time[-1], interval), time, x)


def _bandwidth(x: Array, clock: Clock, noise: float, level: float) -> float:
    """The frequency below which ``MOST`` of the power of the speed is [Hz], as far as it exceeds white noise's.

    By Welch's mean of periodograms (1967). Rows are taken to be evenly spaced.
    """
    from scipy.signal import welch

    length = min(len(x), max(round(SEGMENT / clock.interval), LEAST_PERIODOGRAM))
    if length < LEAST_PERIODOGRAM:
        return 0.0
    frequency, power = welch(x, fs=clock.rate, nperseg=length, detrend="linear")
    count = max(2 * len(x) // length - 1, 1)
    # Half-overlapping Hann windows: so many periodograms are worth 9/11 as many independent ones (Welch, 1967).
    freedom = 2.0 * max(count * 9 / 11, 1.0)
    # Noise is larger in motion than at rest, of cameras say: the upper half of the spectrum shows it.
    floor = max(2.0 * noise**2 * clock.interval, float(np.median(power[len(power) // 2 :])))
    bound = floor * float(chdtri(freedom, level / len(frequency))) / freedom
    of_speed = np.cumsum(np.where(power > bound, frequency**2 * power, 0.0))
    return float(frequency[np.searchsorted(of_speed, MOST * of_speed[-1])]) if of_speed[-1] > 0 else 0.0


def _derivatives(time: Array, x: Array, clock: Clock, bandwidth: float) -> tuple[Array, Array]:
    """Speed and acceleration of local parabolas half a period of the bandwidth wide (Savitzky & Golay, 1964)."""
    from scipy.signal import savgol_filter

    even = _uniform(time, x, clock.interval)
    if len(even) < 5:
        slope = np.diff(x) / np.diff(time)
        return slope, np.zeros(1)
    half = 0.25 / (bandwidth * clock.interval) if bandwidth > 0 else len(even)
    width = 2 * int(np.clip(round(half), 2, (len(even) - 1) // 2)) + 1
    speed, acceleration = (
        savgol_filter(even, width, 2, deriv=order, delta=clock.interval)[width // 2 : len(even) - width // 2]
        for order in (1, 2)
    )
    return np.asarray(speed), np.asarray(acceleration)


def _command(name: str, u: Array, low: float, high: float) -> CommandSignal:
    span = high - low if math.isfinite(high - low) else max(float(np.abs(u).max(initial=0.0)), 1e-300)
    slack = 1e-6 * span
    return CommandSignal(
        name,
        float(u.min()),
        float(u.max()),
        float(np.mean(np.abs(u - low) <= slack)) if math.isfinite(low) else 0.0,
        float(np.mean(np.abs(u - high) <= slack)) if math.isfinite(high) else 0.0,
        float(np.mean((u < low - slack) | (u > high + slack))),
        int(np.count_nonzero(np.diff(u) != 0)),
    )
