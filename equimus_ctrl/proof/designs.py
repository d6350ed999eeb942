"""Trials that move the leg through its workspace and onto its stops, without leaving it there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, frozen_array

SAMPLE_RATE = 120.0
JITTER = 4e-4
"""Standard deviation of the independent intervals between samples in shared/recordings/concealed [s]."""
DURATION = 12.0
TRIALS = 8
TOP = 5e4
"""Highest command [Pa]."""
GRID = 11
PRESSED = 0.3
"""Greatest share of a trial that the nominal leg may be on its knee's stop."""
CLEAR = 0.1
"""Angle at rest above which the nominal knee is taken to be off its stop, other legs in mind [rad]."""
LEAST_RANGE = 0.2
"""Least range of the nominal knee at rest over a trial [rad]."""


@dataclass(frozen=True, eq=False)
class TrialDesign:
    """What is commanded and when it is measured.

    Attributes:
        name: of the trial.
        kind: steps, staircase, multisine or releases; as recorded where it was.
        time: (n,) sample times, ascending from 0 [s].
        command: (n, na) in force from each of them on, in units of the robot's commands.
        start: (nj,) where the joints are at the first, at rest [rad or m]; None where the robot is at equilibrium
            under the first command.
        notes: what differs in this trial, see ``Recording``.
    """

    name: str
    kind: str
    time: Array
    command: Array
    start: Array | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def settles(self) -> bool:
        """Whether the robot is at equilibrium under the first command when the trial starts."""
        return self.start is None

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", frozen_array(self.time, 1, self.name))
        object.__setattr__(self, "command", frozen_array(self.command, 2, self.name))


def sample_times(rng: np.random.Generator, duration: float) -> Array:
    """(n,) jittered times from 0 to just below ``duration``, to 0.1 ms [s]."""
    count = int(1.1 * duration * SAMPLE_RATE) + 10
    steps = np.clip(rng.normal(1 / SAMPLE_RATE, JITTER, count), 0.5 / SAMPLE_RATE, 2.0 / SAMPLE_RATE)
    times = np.round(np.concatenate([[0.0], np.cumsum(steps)]), 4)
    return np.asarray(times[times < duration - 0.5 / SAMPLE_RATE])


@lru_cache(maxsize=1)
def _knee_map() -> Array:
    """(GRID, GRID) the nominal leg's knee at rest over both pressures [rad]."""
    kinematics = Kinematics(nominal_leg())
    axis = np.linspace(0.0, TOP, GRID)
    return np.array([[kinematics.equilibrium(np.array([a, b]))[1] for b in axis] for a in axis])


def resting_knee(command: Array) -> Array:
    """(n,) the nominal leg's knee at rest under commands (n, 2) [Pa], interpolated [rad]."""
    grid = _knee_map()
    place = np.clip(command / TOP, 0.0, 1.0) * (GRID - 1)
    low = np.minimum(place.astype(int), GRID - 2)
    (a, b), (s, t) = low.T, (place - low).T
    return np.asarray(
        (1 - s) * ((1 - t) * grid[a, b] + t * grid[a, b + 1]) + s * ((1 - t) * grid[a + 1, b] + t * grid[a + 1, b + 1])
    )


def _level(rng: np.random.Generator) -> Array:
    """(2,) pressures, mostly such that the knee is off its stop [Pa]."""
    for _ in range(1000):
        level = rng.uniform(0.0, (0.85 * TOP, 0.6 * TOP))
        if resting_knee(level[None])[0] > CLEAR or rng.random() < 0.05:
            return np.asarray(level)
    raise AssertionError("no pressures were found that free the knee")


def _held(rng: np.random.Generator, time: Array, levels: list[Array], shortest: float, longest: float) -> Array:
    """Levels held one after the other, over and over."""
    switches = [rng.uniform(0.3, 0.8)]
    while switches[-1] < time[-1]:
        switches.append(switches[-1] + rng.uniform(shortest, longest))
    index = np.searchsorted(switches, time, side="right")
    return np.array(levels)[index % len(levels)]


def _steps(rng: np.random.Generator, time: Array) -> Array:
    return _held(rng, time, [_level(rng) for _ in range(40)], 0.7, 2.6)


def _staircase(rng: np.random.Generator, time: Array) -> Array:
    low, high = _level(rng), _level(rng)
    shares = np.linspace(0.0, 1.0, int(rng.integers(4, 8)))
    rise = [low + share * (high - low) for share in shares]
    return _held(rng, time, [*rise, *rise[-2:0:-1]], 0.4, 1.0)


def _releases(rng: np.random.Generator, time: Array) -> Array:
    levels: list[Array] = []
    for _ in range(10):
        vented = _level(rng)
        levels += [vented, vented * [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0)][int(rng.integers(3))]]
    return _held(rng, time, levels, 1.2, 3.2)


def _multisine(rng: np.random.Generator, time: Array) -> Array:
    middle = _level(rng)
    count = int(rng.integers(4, 8))
    command = np.empty((len(time), 2))
    for i, greatest in enumerate((1.3e4, 7e3)):
        frequency = np.exp(rng.uniform(np.log(0.1), np.log(3.0), count))
        phase = rng.uniform(0.0, 2 * np.pi, count)
        weight = rng.uniform(0.3, 1.0, count) / np.sqrt(frequency)
        wave = (weight * np.sin(2 * np.pi * frequency * time[:, None] + phase)).sum(axis=1)
        command[:, i] = middle[i] + rng.uniform(0.4, 1.0) * greatest * wave / np.abs(wave).max()
    command[time < rng.uniform(0.3, 0.8)] = middle
    # A valve's bus is served at every other sample.
    return command[np.arange(len(time)) // 2 * 2]


KINDS: dict[str, Callable[[np.random.Generator, Array], Array]] = {
    "steps": _steps,
    "multisine": _multisine,
    "staircase": _staircase,
    "releases": _releases,
}


def design(rng: np.random.Generator, count: int = TRIALS, duration: float = DURATION) -> tuple[TrialDesign, ...]:
    """``count`` trials of ``duration`` [s], the kinds in turn."""
    designs = []
    names = list(KINDS)
    for k in range(count):
        kind = names[k % len(names)]
        time = sample_times(rng, duration)
        for _ in range(100):
            command = frozen_array(np.round(np.clip(KINDS[kind](rng, time), 0.0, TOP)))
            knee = resting_knee(command)
            if np.mean(knee < CLEAR) <= PRESSED and np.ptp(knee) >= LEAST_RANGE:
                break
        designs.append(TrialDesign(f"trial_{k:02d}", kind, time, command))
    return tuple(designs)
