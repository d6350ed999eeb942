"""The reference over a horizon and what it takes to follow it, each instant worked out once.

Poses and velocities are read on a grid of control periods from where the controller began, pressures half a period
later; where control instants deviate from the grid, both are interpolated. A motion that the actuators cannot do, such
as a step's, is toned down to what they can do of it: what is cut off of braking would be left over as speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from equimus_ctrl.controllers.inverse import SMOOTHING, Inverse, InverseState
from equimus_ctrl.types import Array, Reference

ON_GRID = 1e-6
"""An instant so near to one of the grid is that [control periods]."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What is known of the grid's instants from ``first`` on.

    Attributes:
        reference: of which.
        first: the first one's number.
        position: (m, nj) [rad].
        velocity: (m, nj) [rad/s].
        middle: (m, 3 nj) angles, velocities and accelerations half a period later.
        pressure: (m, na) then [Pa]; empty where effects have states of their own, which only the present shows.
        share: (m,) of the motion then, beside what holds its pose, that the actuators can do.
    """

    reference: Reference
    first: int
    position: Array
    velocity: Array
    middle: Array
    pressure: Array
    share: Array


@dataclass(frozen=True, eq=False)
class Ahead:
    """A robot that follows, at the instants that a horizon's intervals begin and end at.

    Attributes:
        position: (n + 1, nj) [rad].
        velocity: (n + 1, nj) [rad/s].
        pressure: (n + 1, na) behind the valves [Pa].
        feed: (n, na) what is to reach the valves over each interval [Pa].
    """

    position: Array
    velocity: Array
    pressure: Array
    feed: Array


class Preview:
    """Looks ahead of time.

    Args:
        inverse: of the model.
        periods: (n,) of the horizon's intervals, in control periods.
        control_dt: a control period [s].
        delay: how much later than now the horizon begins [s].
    """

    def __init__(self, inverse: Inverse, periods: NDArray[np.int64], control_dt: float, delay: float) -> None:
        self._inverse, self._dt, self._delay = inverse, control_dt, delay
        self._ends = np.concatenate([[0], np.cumsum(periods)])
        self._periods = periods
        self._around = math.ceil(SMOOTHING / control_dt - ON_GRID) + 1

    def look(self, reference: Reference, time: float, state: InverseState, sight: Sight | None) -> tuple[Ahead, Sight]:
        """What lies ahead at a control instant.

        Args:
            reference: of the true angles; each instant of it is read once.
            time: of the control instant [s].
            state: when the robot began and where, and its effects' states now, which are carried on along the motion.
            sight: what is known from before.
        """
        place = (time - state.begun) / self._dt
        base = int(np.floor(place + ON_GRID))
        part = place - base if place - base > ON_GRID else 0.0
        last, around = base + int(self._ends[-1]) + 2, self._around
        sight = self._seen(reference, base - 1 - around, last + around, state, sight)
        at = 1 + self._ends
        position, velocity, motion = (
            rows[around : len(rows) - around] for rows in (sight.position, sight.velocity, sight.middle)
        )
        if len(sight.pressure):
            middle = sight.pressure[around : len(sight.pressure) - around]
        else:
            middle = self._pressures(motion, state.states[0])
        # A step is differentiated to a motion there and back, of which half may be possible.
        share = sliding_window_view(sight.share, 2 * around + 1).min(axis=1)
        if share.min() < 1:
            velocity = velocity * np.minimum(share, np.append(share[:1], share[:-1]))[:, None]
            middle = middle.copy()
            for k in np.flatnonzero(share < 1):
                rest = self._inverse.resting(motion[k, : position.shape[1]], state.states[0])
                middle[k] = rest + share[k] * (middle[k] - rest)
        rate = np.zeros_like(middle)
        rate[1:-1] = (middle[2:] - middle[:-2]) / (2 * self._dt)
        whole = np.cumsum(middle + self._inverse.lead(rate), axis=0)

        def between(rows: Array, k: NDArray[np.int64]) -> Array:
            return rows[k] if part == 0 else np.asarray((1 - part) * rows[k] + part * rows[k + 1])

        feed = (between(whole, at[1:] - 1) - between(whole, at[:-1] - 1)) / self._periods[:, None]
        on = np.vstack([middle[:1], (middle[1:] + middle[:-1]) / 2])
        return Ahead(between(position, at), between(velocity, at), between(on, at), feed), sight

    def _seen(self, reference: Reference, first: int, last: int, state: InverseState, sight: Sight | None) -> Sight:
        """The grid's instants from first to last, those that are known taken over."""
        if (
            sight is not None
            and sight.reference is reference
            and sight.first <= first <= sight.first + len(sight.position)
        ):
            known = [
                rows[first - sight.first :]
                for rows in (sight.position, sight.velocity, sight.middle, sight.pressure, sight.share)
            ]
        else:
            nj = len(state.pose)
            known = [np.zeros((0, k)) for k in (nj, nj, 3 * nj, len(self._inverse.actuators))]
            known.append(np.zeros(0))
        new = np.arange(first + len(known[0]), last + 1)
        if len(new) == 0:
            return Sight(reference, first, *known)
        instants = np.asarray(state.begun + self._delay + self._dt * new, dtype=np.float64)
        q, v, _ = self._inverse.motion(reference, instants, state)
        middle = np.vstack(self._inverse.motion(reference, instants + self._dt / 2, state)).T
        still = state.states[0]
        pressure = known[3] if len(still) else np.vstack([known[3], self._pressures(middle, still)])
        seen = [np.vstack(pair) for pair in zip(known[:3], (q.T, v.T, middle), strict=True)]
        share = np.append(known[4], [self._inverse.share(*np.split(row, 3)) for row in middle])
        return Sight(reference, first, seen[0], seen[1], seen[2], pressure, share)

    def _pressures(self, middle: Array, states: Array) -> Array:
        """(m, na) [Pa] along a motion (m, 3 nj), the effects' states being these (nz,) at the second row."""
        q, v, a = np.split(middle.T, 3)
        z = np.tile(states[:, None], (1, len(middle)))
        if len(states):
            z[:, 1:] = self._inverse.states(q[:, 1:], v[:, 1:], states)[0]
        return self._inverse.pressures(q, v, a, z)
