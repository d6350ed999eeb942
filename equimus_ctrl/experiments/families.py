"""Families of commands among which an experiment is chosen: a point of a cube is a course of commands.

Each is a map z in [0, 1]^d -> (n, na) commands, defined for every z and continuous in it, so that a search can go
anywhere. All begin and end at the command at rest u₀. With s the family's own course, which stays within the range,

    u(t) = u₀ + a·c·(s(t) − u₀),    c = min(1, r/max|ṡ|, b/max|s̈|)

for each actuator, with its greatest rate r and acceleration b: as the range holds u₀, it holds u for every amplitude a
in [0, 1]. Rates and accelerations are those of a row to the next.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.types import Array, frozen_array

FADE = 0.15
"""Share of the time in which waves grow, and in which they fade."""
WAVES = 5
"""Sines of each actuator in a multisine."""
HIGHEST, SAMPLES_A_PERIOD = 5.0, 10.0
"""Highest frequency of a multisine [Hz], and how many rows a period of it has at least."""
LEAST_SHARE = 0.1
"""Of the time between switches that are far apart, that of those which are near each other."""
ROUND = 0.98
"""Of a wave's quarter in a triangle: how sharp its corners are, 1 for a kink."""
MOST_PERIODS = 6.0
"""Of a triangle."""
PEAK_RATE, PEAK_ACCELERATION = 15 / 8, 10 / 3**0.5
"""Of the step 10s³ − 15s⁴ + 6s⁵ of size 1 in time 1."""
LEAST_ROWS = 20
"""Between the rests."""
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class CommandBounds:
    """Between what commands have to stay.

    Attributes:
        low: (na,) lowest commands [Pa, or the unit of each actuator's command].
        high: (na,) highest.
        rest: (na,) those at rest, with which a trial begins and ends.
        rate: (na,) by how much each may change in a second, +inf where nothing limits that.
        acceleration: (na,) the same of the rate.
        before: how long they rest at first [s].
        after: how long they rest in the end [s].

    Raises:
        ConfigError: where a range has no end, is none, or does not hold the command at rest.
    """

    low: Array
    high: Array
    rest: Array
    rate: Array
    acceleration: Array
    before: float = 0.5
    after: float = 0.5

    def __post_init__(self) -> None:
        for key in ("low", "high", "rest", "rate", "acceleration"):
            object.__setattr__(self, key, frozen_array(getattr(self, key), 1, key))
        for i, (low, high, rest) in enumerate(zip(self.low, self.high, self.rest, strict=True)):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise ConfigError(f"command {i + 1} may go from {low:g} to {high:g}, expected a range with ends")
            if not low <= rest <= high:
                raise ConfigError(f"command {i + 1} at rest is {rest:g}, expected {low:g} to {high:g}")
        if np.any(self.rate <= 0) or np.any(self.acceleration <= 0):
            raise ConfigError("limits of rates and accelerations of commands have to be more than 0")


@dataclass(frozen=True, eq=False)
class Stage:
    """Where a course takes place.

    Attributes:
        times: (n,) from 0 on, of the part between the rests [s].
        span: its length [s].
        dt: longest time between rows [s].
        bounds: of the commands.
    """

    times: Array
    span: float
    dt: float
    bounds: CommandBounds


class Family(ABC):
    """Courses of commands.

    Attributes:
        name: of the family.
        summary: one line.
        shared: numbers that all actuators share.
        each: numbers of each actuator.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    shared: ClassVar[int]
    each: ClassVar[int]

    def dimension(self, actuators: int) -> int:
        """Numbers that describe a course for so many actuators."""
        return self.shared + self.each * actuators

    def commands(self, z: Array, times: Array, bounds: CommandBounds, amplitude: float = 1.0) -> Array:
        """(n, na) commands from each of some instants (n,) on [s].

        Args:
            z: (dimension,) each from 0 to 1: first what is shared, then the numbers of each actuator.
            times: ascending, from 0 on or later.
            bounds: within which they stay.
            amplitude: 0 to 1, of what they do beside resting.

        Raises:
            ConfigError: for a point that is in no such cube, or too short a time.
        """
        na = len(bounds.rest)
        given = np.asarray(z, dtype=np.float64)
        if given.shape != (self.dimension(na),) or not np.all((given >= 0) & (given <= 1)):
            raise ConfigError(
                f"{self.name}: expected {self.dimension(na)} numbers from 0 to 1 for {na} actuators, got "
                f"{np.array2string(given, precision=3, threshold=8)}"
            )
        begin, end = float(times[0]) + bounds.before, float(times[-1]) - bounds.after
        active = (times > begin) & (times < end)
        if np.count_nonzero(active) < LEAST_ROWS:
            raise ConfigError(
                f"{self.name}: {times[-1] - times[0]:g} s with rests of {bounds.before:g} and {bounds.after:g} s leave "
                f"{np.count_nonzero(active)} rows for commands, expected at least {LEAST_ROWS}"
            )
        stage = Stage(times[active] - begin, end - begin, float(np.diff(times).max()), bounds)
        course = np.tile(bounds.rest, (len(times), 1))
        course[active] = self.course(given[: self.shared], given[self.shared :].reshape(na, self.each), stage)
        return scaled(np.clip(course, bounds.low, bounds.high), times, bounds, amplitude)

    @abstractmethod
    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """(n, na) commands at ``stage.times``, within the range, that begin and end at rest.

        Args:
            shared: (shared,) numbers from 0 to 1.
            each: (na, each) of them.
            stage: where it takes place.
        """


def scaled(course: Array, times: Array, bounds: CommandBounds, amplitude: float) -> Array:
    """A course (n, na) about its rest by an amplitude, and less where rates or accelerations ask for it."""
    away = course - bounds.rest
    steps = np.diff(times)[:, None]
    rates = np.diff(away, axis=0) / steps
    around = np.vstack([np.zeros(away.shape[1]), rates, np.zeros(away.shape[1])])
    turning = np.diff(around, axis=0) / np.vstack([steps[:1], steps])
    with np.errstate(divide="ignore"):
        share = np.minimum(
            bounds.rate / np.abs(rates).max(axis=0, initial=0.0),
            bounds.acceleration / np.abs(turning).max(axis=0, initial=0.0),
        )
    return np.asarray(bounds.rest + amplitude * np.minimum(1.0, (1 - ROUNDING) * share) * away)


def smooth_step(share: Array) -> Array:
    """10s³ − 15s⁴ + 6s⁵ for s clipped to 0…1: from rest to rest with the least jerk (Flash & Hogan, 1985)."""
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def moves(stage: Stage, begins: Array, levels: Array, quickest: Array) -> Array:
    """(n, na) from rest to one level after the other and back to rest.

    A move takes as long as it is asked to, longer where rates and accelerations ask for that, and no longer than until
    the next one.

    Args:
        stage: where.
        begins: (k + 1,) when each move begins, the last of which is back to rest [s].
        levels: (k, na) commands.
        quickest: (k + 1,) how long each takes at least [s].
    """
    bounds, whole = stage.bounds, np.vstack([stage.bounds.rest, levels, stage.bounds.rest])
    rooms = np.diff(np.append(begins, stage.span))
    found = np.tile(bounds.rest, (len(stage.times), 1))
    for k, (begin, room, least) in enumerate(zip(begins, rooms, quickest, strict=True)):
        size = np.abs(whole[k + 1] - whole[k])
        needed = np.maximum(PEAK_RATE * size / bounds.rate, np.sqrt(PEAK_ACCELERATION * size / bounds.acceleration))
        lasts = np.minimum(np.maximum(needed, max(least, stage.dt)), max(room, stage.dt))
        share = smooth_step((stage.times[:, None] - begin) / lasts)
        found += share * (whole[k + 1] - whole[k])
    return found


def waves(stage: Stage, each: Array, shapes: Array) -> Array:
    """(n, na) waves (n, na) within ±1 about levels, from rest and back.

    The first number of each actuator is its level in its range, the second its swing of what the range leaves about
    that.
    """
    bounds = stage.bounds
    level = bounds.low + each[:, 0] * (bounds.high - bounds.low)
    swing = each[:, 1] * np.minimum(level - bounds.low, bounds.high - level)
    fade = FADE * stage.span
    envelope = smooth_step(np.minimum(stage.times, stage.span - stage.times) / fade)
    return np.asarray(bounds.rest + envelope[:, None] * (level + swing * shapes - bounds.rest))


def spans(shares: Array, whole: float) -> Array:
    """(k,) parts of a time that numbers (k,) from 0 to 1 say [s]."""
    parts = LEAST_SHARE + shares
    return np.asarray(whole * parts / parts.sum())


class Multisine(Family):
    """Sums of sines in a band, each actuator with frequencies of its own.

    Frequencies go evenly in their logarithm from the lowest to the highest, dealt to the actuators in turn; phases are
    Schroeder's (IEEE Transactions on Information Theory 16, 1970), shifted for each actuator. Shared: the highest
    frequency, the lowest, and how amplitudes fall with frequency.
    """

    name, summary, shared, each = "multisine", "sums of sines in a band", 3, 3

    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """See ``Family``."""
        na = len(each)
        least = 1 / stage.span
        most = max(min(HIGHEST, 1 / (SAMPLES_A_PERIOD * stage.dt)), least)
        high = least * (most / least) ** shared[0]
        low = least * (high / least) ** shared[1]
        place = np.arange(WAVES * na) / max(WAVES * na - 1, 1)
        frequency = (low * (high / low) ** place).reshape(WAVES, na)
        size = (frequency / low) ** -(2 * shared[2])
        phase = np.pi * np.arange(WAVES) * (np.arange(WAVES) + 1) / WAVES
        angle = 2 * np.pi * (frequency * stage.times[:, None, None] + each[:, 2]) - phase[:, None]
        found = np.sum(size * np.cos(angle), axis=1)
        return waves(stage, each, found / np.abs(found).max(axis=0))


class Steps(Family):
    """Smooth steps from level to level, staircases among them; all actuators switch together.

    Shared: the time at each level, and how quick the steps are.
    """

    LEVELS: ClassVar[int] = 4
    name, summary, shared, each = "steps", "smooth steps and staircases", LEVELS + 2, LEVELS

    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """See ``Family``."""
        parts = spans(shared[:-1], stage.span)
        begins = np.concatenate([[0.0], np.cumsum(parts)[:-1]])
        bounds = stage.bounds
        levels = bounds.low + each.T * (bounds.high - bounds.low)
        return moves(stage, begins, levels, (1 - shared[-1]) * parts)


class Triangle(Family):
    """Slow ramps up and down, through reversals, with round corners; actuators one after the other.

    Shared: how many periods.
    """

    name, summary, shared, each = "triangle", "slow ramps through reversals", 1, 3

    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """See ``Family``."""
        periods = MOST_PERIODS ** shared[0]
        angle = 2 * np.pi * (periods * stage.times[:, None] / stage.span + each[:, 2])
        return waves(stage, each, np.arcsin(ROUND * np.sin(angle)) / np.arcsin(ROUND))


class Hold(Family):
    """To a level by way of another, so that it is come to from either side, and a long hold there: creep, stiction.

    Shared: the time of the first move, of the second, of the hold and of the way back.
    """

    name, summary, shared, each = "hold", "a long hold, come to from either side", 4, 2

    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """See ``Family``."""
        parts = spans(shared * [0.5, 0.5, 1.0, 0.5] + [0.0, 0.0, 1.0, 0.0], stage.span)
        begins = np.array([0.0, parts[0], parts[:3].sum()])
        bounds = stage.bounds
        levels = bounds.low + each[:, ::-1].T * (bounds.high - bounds.low)  # the second number is where it goes first
        return moves(stage, begins, levels, parts[[0, 1, 3]])


class Release(Family):
    """Slowly to a level, a hold until all is still, and a quick release to the command at rest: free swings.

    Shared: the time of loading, of the hold and of the swings, and how quick the release is.
    """

    name, summary, shared, each = "release", "loaded slowly, released at once", 4, 1

    def course(self, shared: Array, each: Array, stage: Stage) -> Array:
        """See ``Family``."""
        parts = spans(shared[:3], stage.span)
        bounds = stage.bounds
        level = bounds.low + each.T * (bounds.high - bounds.low)
        quickest = np.array([parts[0], (1 - shared[3]) * parts[2] / 2])
        return moves(stage, np.array([0.0, parts[0] + parts[1]]), level, quickest)


FAMILIES: dict[str, Family] = {own.name: own for own in (Multisine(), Steps(), Triangle(), Hold(), Release())}
"""All families by name."""


def families(names: Sequence[str] = ()) -> tuple[Family, ...]:
    """Families by name; all by default.

    Raises:
        ConfigError: for a name that there is not.
    """
    for name in names:
        if name not in FAMILIES:
            raise ConfigError(unknown_name("family of commands", name, FAMILIES))
    return tuple(FAMILIES[name] for name in names or FAMILIES)
