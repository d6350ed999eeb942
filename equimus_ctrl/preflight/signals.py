"""What the signals of one recording are like, whatever the model: motion, clipping, bandwidth, commands."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from equimus_ctrl.identification.noise import LEAST
from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.preflight.scatter import Clock, JointScatter, block_noise, runs_of, scatter_and_rests
from equimus_ctrl.types import Array, Recording

FAST = 2.0
"""Steps of the sensor from one row to the next from which on a joint is in motion."""
LARGE = 4.0
"""Standard deviations of the noise, likewise."""
MOST_UNEVEN = 2
"""Rows between the shortest and the longest times, but for a tenth each, that a clock of its own holds values for."""
MOST_HELD = 20
"""Rows that a value is held at most; what stays for longer rests."""
LEAST_MOVING = 50
"""Fewer rows in motion say nothing of how often values are new."""
GOES_ON = 0.5
"""Share of its speed that a measurement that is clipped would have had in the next rows, at least."""
LEAST_FLAT = 3
"""Rows that a clipped measurement stays at its extreme at least."""
MOST = 0.99
"""Share of the speed's power that is below the bandwidth."""
SEGMENT = 4.0
"""Length of the periodograms whose mean is the spectrum [s]."""
LEAST_PERIODOGRAM = 16
"""Rows of one at least."""


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
class JointSignal(JointScatter):
    """What was measured of one joint in one recording.

    Attributes:
        speed: usual speed, its root mean square [rad/s or m/s].
        peak_speed: largest speed, smoothed over a quarter of a period of the bandwidth [rad/s or m/s].
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


def signals_of(recording: Recording, command_range: tuple[Array, Array], limits: CheckLimits = LIMITS) -> Signals:
    """What the signals of a recording are like.

    Args:
        recording: of any robot.
        command_range: (low, high), each (na,): between what commands make a difference, ±inf where nothing says so.
        limits: by which motion is told from noise.
    """
    time = np.array(recording.time)
    clock = Clock.of(time, limits)
    scatter, resting = scatter_and_rests(recording, clock)
    joints = tuple(_joint(own, time, recording.position[:, j], clock, limits) for j, own in enumerate(scatter))
    rests = tuple((float(time[a]), float(time[b - 1] - time[a])) for a, b in runs_of(resting))
    commands = tuple(
        _command(name, recording.command[:, k], float(command_range[0][k]), float(command_range[1][k]))
        for k, name in enumerate(recording.actuators)
    )
    return Signals(recording.name, clock, joints, commands, rests, resting)


def _joint(own: JointScatter, time: Array, x: Array, clock: Clock, limits: CheckLimits) -> JointSignal:
    # Of held values second differences are larger than the noise; those of new ones alone are not.
    noise = own.noise if own.at_rest else min(own.noise, float(block_noise(_fresh(x)[:, None])[0]))
    held = _held(x, own.step, noise)
    if held > limits.held:  # steps from value to value would be motion of all frequencies
        kept = np.concatenate([[True], np.diff(x) != 0])
        even = np.interp(time, time[kept], x[kept])
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
        flats=_flats(time, x, own, noise, held, limits),
    )


def _fresh(x: Array) -> Array:
    """(k,) values (n,) without those that repeat the one before."""
    return np.asarray(x[np.concatenate([[True], np.diff(x) != 0])])


def _held(x: Array, step: float, noise: float) -> float:
    """Share of the rows in motion that repeat the value before; 0 where too few are in motion.

    Such rows stand between two that go the same way, by so much that neighbours are alike by no chance. Of a sensor
    with a clock of its own about as many come each time; where friction holds a joint for a moment, any number do.
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


def _flats(
    time: Array, x: Array, own: JointScatter, noise: float, held: float, limits: CheckLimits
) -> tuple[Flat, ...]:
    """Stretches at the extremes that hide motion, see ``Flat``.

    A measurement that comes to rest slows down, and noise goes on. So what counts enters in motion that would go on;
    where steps are larger than the noise, with more than ``CheckLimits.flat`` steps a row, else for as long as noise
    never repeats a value. What goes on at the speed v of entering, and comes back at once, hides v/4 of the stretch's
    length; that has to be as many steps or standard deviations. Where dry friction holds joints, stretches of the kind
    are elsewhere too: of these an extreme has to have more than all other values together.
    """
    least = LEAST_FLAT if held < limits.held else round(LEAST_FLAT / (1.0 - min(held, 0.95)))
    steps = own.step if own.step > noise else 0.0
    if 0 < own.step <= noise:
        alike = own.step / (2 * math.sqrt(math.pi) * noise)  # of two neighbours in white noise
        least = max(least, 1 + math.ceil(math.log(limits.significance / len(x)) / math.log(alike)))
    starts = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0]))
    lengths = np.diff(np.append(starts, len(x)))
    chosen = lengths >= least
    starts, lengths = starts[chosen], lengths[chosen]
    speeds, goes_on, back = _entering(x, starts, noise, least)
    hidden = speeds * lengths / 4 > limits.flat * max(noise, own.step)
    entered = goes_on & (speeds > limits.flat * steps) & hidden
    found = []
    for value in (own.low, own.high):
        here = entered & (x[starts] == value)
        if np.count_nonzero(here) <= np.count_nonzero(entered & (x[starts] != value)):
            continue
        for k in np.flatnonzero(here):
            a, n = starts[k], lengths[k]
            speed = float(speeds[k]) * int(back[k]) / float(time[a - 1] - time[a - 1 - back[k]])
            found.append(Flat(float(time[a]), float(time[a + n - 1] - time[a]), value, speed))
    return tuple(sorted(found, key=lambda flat: flat.start))


def _entering(
    x: Array, starts: NDArray[np.int_], noise: float, least: int
) -> tuple[Array, NDArray[np.bool_], NDArray[np.int_]]:
    """With what speed a row stretches are entered, whether it would have gone on, and the rows that say so.

    These are as few as tell the speed from the noise; where none do, it does not go on.
    """
    speeds, goes_on, back = np.zeros(len(starts)), np.zeros(len(starts), dtype=bool), np.full(len(starts), least)
    for rows in (least, 2 * least, 4 * least, 8 * least):
        k = np.flatnonzero((speeds == 0) & (starts > 2 * rows))
        later = (x[starts[k] - 1] - x[starts[k] - 1 - rows]) / rows
        earlier = (x[starts[k] - 1 - rows] - x[starts[k] - 1 - 2 * rows]) / rows
        clear = np.abs(later) > LARGE * math.sqrt(2) * noise / rows
        k, later, earlier = k[clear], later[clear], earlier[clear]
        speeds[k], back[k] = np.abs(later), rows
        # What slows down to a rest would not.
        goes_on[k] = (2 * later - earlier) * np.sign(later) > GOES_ON * np.abs(later)
    return speeds, goes_on, back


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
    """Speed and acceleration of local parabolas, a quarter of the bandwidth's period wide (Savitzky & Golay, 1964)."""
    from scipy.signal import savgol_filter

    even = _uniform(time, x, clock.interval)
    if len(even) < 5:
        slope = np.diff(x) / np.diff(time)
        return slope, np.zeros(1)
    half = 0.125 / (bandwidth * clock.interval) if bandwidth > 0 else len(even)
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
