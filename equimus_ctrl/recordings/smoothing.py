"""Measured positions as a smooth motion: cubic splines, as many knots as the measurements' noise allows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array, PrescribedMotion, Recording

LEAST_ROWS = 8
"""Fewer rows tell no motion."""
WIDER = 1.25
"""Ratio of knot distances that are compared."""
EXACT = 4.0
"""Where the distance from three rows to two lowers the score by more, what is left is the spline's own error and not
noise: of a cubic spline the first falls by 25 (the eighth power of 3/2), the second not at all."""


ORDER = 4
"""Of the splines: so many of them are not 0 at an instant."""
_SMOOTHING, _KEEPING = Lock(), Lock()


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """The motion that a recording shows, worked out where somebody asks for it.

    Attributes:
        name: of the recording, for messages.
        joints: names of the columns.
        time: (n,) of the rows [s].
        position: (n, np) measured [rad or m].
        beside: motions of other joints, that go behind.
        reading: over how long the motion at one instant is read off it [s].
    """

    name: str
    joints: tuple[str, ...]
    time: Array
    position: Array
    beside: tuple[PrescribedMotion, ...]
    reading: float

    @cached_property
    def motion(self) -> PrescribedMotion:
        """Its joints smoothed, see ``smoothed``, then prescribed joints, then unmeasured ones as they may move."""
        with _SMOOTHING:  # who asks at the same time waits for the first
            found: PrescribedMotion | None = vars(self).get("motion")
            if found is None:
                found = smoothed(self.name, self.joints, self.time, self.position)
                for beside in self.beside:
                    found = together(found, beside)
                vars(self)["motion"] = found
        return found


_KNOWN: WeakKeyDictionary[Recording, dict[float, RecordedMotion]] = WeakKeyDictionary()


def recorded_motion(recording: Recording, reading: float) -> RecordedMotion:
    """The same of a recording whenever it is asked for, so that it is smoothed once; forgotten with the recording."""
    own = recording
    beside = tuple(motion for motion in (own.prescribed, own.supposed) if motion is not None)
    found = RecordedMotion(own.name, own.joints, own.time, np.asarray(own.position), beside, reading)
    with _KEEPING:
        return _KNOWN.setdefault(recording, {}).setdefault(reading, found)


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
            whole = np.concatenate([[time[0]] * ORDER, knots, [time[-1]] * ORDER])
            spline = least_squares(time, values, whole)
            count, left = len(whole) - ORDER, float(((values - spline(time)) ** 2).sum())
            scores.append((n * left / (n - count) ** 2, every, spline, float(np.sqrt(left / (n - count)))))
        distance *= WIDER
    if len(scores) > 1 and scores[0][0] * EXACT < scores[1][0]:
        return make_interp_spline(time, values, k=ORDER - 1), 0.0
    best = min(scores, key=lambda own: own[0])
    return best[2], best[3]


def least_squares(time: Array, values: Array, knots: Array) -> BSpline:
    """The cubic spline that is nearest to values (n,) at ascending instants (n,); knots (m,) with those at the ends.

    Takes time in proportion to the rows, as scipy's ``make_lsq_spline``, of the same digits, does not.
    """
    rows = BSpline.design_matrix(time, knots, ORDER - 1)
    first = np.asarray(rows.indices[::ORDER], dtype=np.int64)
    return BSpline(knots, _solved(rows.data.reshape(-1, ORDER), first, values, len(knots) - ORDER), ORDER - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _solved(rows: Array, first: NDArray[np.int64], values: Array, count: int) -> Array:
    """Least squares of rows in a band, by Givens' rotations.

    After Cox, "The least squares solution of overdetermined linear equations having band or augmented band structure",
    1981.

    Args:
        rows: (n, ``ORDER``) what is not 0 in each.
        first: (n,) ascending, in which columns that begins.
        values: (n,).
        count: of the columns.

    Returns:
        (count,) coefficients.
    """
    triangle, right = np.zeros((count, ORDER)), np.zeros(count)
    row = np.empty(ORDER)
    for i in range(len(rows)):
        row[:] = rows[i]
        value = values[i]
        for j in range(first[i], min(first[i] + ORDER, count)):
            pivot, other = row[0], triangle[j, 0]
            if pivot != 0.0:
                size = abs(pivot)
                if size >= other:
                    length = size * math.sqrt(1.0 + (other / pivot) * (other / pivot))
                else:
                    length = other * math.sqrt(1.0 + (pivot / other) * (pivot / other))
                c, s = other / length, pivot / length
                triangle[j, 0] = length
                for k in range(1, ORDER):
                    above, below = triangle[j, k], row[k]
                    triangle[j, k], row[k] = c * above + s * below, c * below - s * above
                right[j], value = c * right[j] + s * value, c * value - s * right[j]
            row[:-1] = row[1:]
            row[-1] = 0.0
    for j in range(count - 1, -1, -1):
        rest = right[j]
        for k in range(1, min(ORDER, count - j)):
            rest -= right[j + k] * triangle[j, k]
        right[j] = rest / triangle[j, 0]
    return right
