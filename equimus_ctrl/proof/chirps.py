"""Small chirps: recordings that show little, as those often are from which somebody begins."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.proof.designs import TrialDesign, sample_times
from equimus_ctrl.types import Array

TRIALS, DURATION = 2, 6.0
"""How many there are of each robot, and how long each is [s]."""
LOWEST, HIGHEST = 0.1, (0.8, 2.5)
"""Frequency with which a chirp begins, and between which it ends [Hz]."""
SLOWER = 0.7
"""Each further actuator's phase goes by so much slower than the one before it: all together would move alike."""
LEVEL, SWING = np.array([[12e3, 5e3], [20e3, 9e3]]), (0.3, 0.5)
"""Between what levels of a leg's chirps are [Pa], and how far they swing in shares of these."""
BEFORE = 0.5
"""How long a leg rests first [s]."""


def chirp(rng: np.random.Generator, times: Array, level: Array, swing: Array, before: float) -> Array:
    """(n, na) commands whose frequency grows with time.

    Args:
        rng: of where the frequency ends.
        times: (n,) of the commands [s].
        level: (na,) about which they swing.
        swing: (na,) how far.
        before: how long they rest first [s].
    """
    top, swept = rng.uniform(*HIGHEST), np.maximum(times - before, 0.0)
    phase = 2 * np.pi * (LOWEST * swept + (top - LOWEST) * swept**2 / (2 * (times[-1] - before)))
    return np.asarray(level + swing * np.sin(phase[:, None] * SLOWER ** np.arange(len(level))))


def leg_chirps(rng: np.random.Generator, count: int, duration: float) -> tuple[TrialDesign, ...]:
    """``count`` chirps of a leg, of ``duration`` [s]."""
    found = []
    for k in range(count):
        times, level = sample_times(rng, duration), rng.uniform(*LEVEL)
        rows = chirp(rng, times, level, rng.uniform(*SWING) * level, BEFORE)
        found.append(TrialDesign(f"trial_{k:02d}", "chirp", times, np.round(rows)))
    return tuple(found)
