"""Measured positions as a smooth motion: cubic splines, as many knots as the measurements' noise allows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array, PrescribedMotion, Recording

LEAST_ROWS = 8
"""Fewer rows tell no motion."""
WIDER = 1.25
"""Ratio of knot distances that are compared."""
EXACT = 4.0
"""Where the distance from three rows to two lowers the score by more, what is left is the spline's own error and not
noise: of a cubic spline the first falls by 25 (the eighth power of 3/2), the second not at all."""


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """The motion that a recording shows, worked out where somebody asks for it.

    Attributes:
        recording: whose.
        reading: over how long the motion at one instant is read off it [s].
    """

    recording: Recording
    reading: float

    @cached_property
    def motion(self) -> PrescribedMotion:
        """Its joints smoothed, see ``smoothed``, then prescribed joints, then unmeasured ones as they may move."""
        own = self.recording
        found = smoothed(own.name, own.joints, own.time, np.asarray(own.position))
        for beside in (own.prescribed, own.supposed):
            if beside is not None:
                found = together(found, beside)
        return found


@lru_cache(maxsize=256)
def recorded_motion(recording: Recording, reading: float) -> RecordedMotion:
    """The same of a recording whenever it is asked for, so that it is smoothed once."""
    return RecordedMotion(recording, reading)


def together(first: PrescribedMotion, second: PrescribedMotion) -> PrescribedMotion:
    """The joints of two motions, at the instants of the first."""
    parts = zip((first.position, first.velocity, first.acceleration), second.at(first.times), strict=True)
    q, v, a = (np.column_stack(part) for part in parts)
    noise = np.append(first.noise, second.noise)
    return PrescribedMotion((*first.joints, *second.joints), first.times, q, v, a, noise)


def smoothed(name: str, joints: tuple[str, ...], time: Array, position: Array) -> PrescribedMotion:
    """The motion that measured positions are noisy samples of.

    Each joint's is a cubic spline fitted by least squares, with a knot at every m-th row. Of the m that are tried the
    one counts that predicts a row best from the others, by generalised cross-validation n RSS/(n − K)² with K
    coefficients (Craven & Wahba, "Smoothing noisy data with spline functions", 1979). Positions without noise to speak
    of are interpolated. White noise is removed; what is correlated over many rows counts as motion.

    Args:
        name: of the recording, for messages.
        joints: names of the columns.
        time: (n,) of the rows [s].
        position: (n, np) measured [rad or m].

    Raises:
        ConfigError: for fewer than ``LEAST_ROWS`` rows.
    """
    if len(time) < LEAST_ROWS:
        raise ConfigError(f"{name}: has {len(time)} rows, too few to smooth {joints[0]}, expected {LEAST_ROWS}")
    splines, noise = zip(*(_fitted(time, column) for column in position.T), strict=True)
    q, v, a = (np.column_stack([spline(time, k) for spline in splines]) for k in range(3))
    return PrescribedMotion(joints, np.array(time), q, v, a, np.array(noise))


def _fitted(time: Array, values: Array) -> tuple[BSpline, float]:
    """The spline, and the standard deviation of what is left."""
    n, distance = len(time), 2.0
    scores: list[tuple[float, int, BSpline, float]] = []
    while (every := round(distance)) <= max(n // 4, 2):
        if not scores or every > scores[-1][1]:
            knots = time[every : n - every // 2 - 1 : every]
            whole = np.concatenate([[time[0]] * 4, knots, [time[-1]] * 4])
            spline = make_lsq_spline(time, values, whole, k=3)
            count, left = len(whole) - 4, float(((values - spline(time)) ** 2).sum())
            scores.append((n * left / (n - count) ** 2, every, spline, float(np.sqrt(left / (n - count)))))
        distance *= WIDER
    if len(scores) > 1 and scores[0][0] * EXACT < scores[1][0]:
        return make_interp_spline(time, values, k=3), 0.0
    best = min(scores, key=lambda own: own[0])
    return best[2], best[3]
