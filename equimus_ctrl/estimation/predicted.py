"""Positions and rates of any robot that can be rolled out: a model predicts, an extended Kalman filter corrects.

    x⁻ = F(x, u),    P⁻ = A P Aᵀ + Q,    x = x⁻ + K (y − q⁻),    A = ∂F/∂x

F is one control period of the robot, contacts and all, under the commands that have arrived meanwhile; its slopes are
differences of rollouts that begin beside each other. The noise on what is measured is white (σ), and so are
accelerations that the model does not explain (w), constant over a period T: Q = w² [T⁴/4, T³/2; T³/2, T²]. About a pose
that a robot falls from, gains without the slopes would lose it wherever w is small. Of a mass that nothing moves these
are the gains of Kalata, "The tracking index", IEEE Transactions on Aerospace and Electronic Systems, 1984.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.errors import ControllerError
from equimus_ctrl.types import Array

EARLY = 1e-9
"""Times that differ by less are the same [s]."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a robot at a control instant.

    Attributes:
        state: (nx,) of the rollouts.
        time: of it [s].
        past: (time [s], (nj,) positions) where it was thought to be at the latest instants, the newest last.
        stamp: of the latest measurement [s].
        seen: (nj,) when each joint was last measured [s].
        covariance: (2 nj, 2 nj) of positions and rates.
    """

    state: Array
    time: float
    past: tuple[tuple[float, Array], ...]
    stamp: float
    seen: Array
    covariance: Array


class Predicted:
    """The filter of one robot.

    Args:
        period: T, of control [s].
        joints: their names.
        unexplained: (nj,) w [rad/s² or m/s²].
        noise: σ [rad or m].
        late: (nj,) what each sensor is late by [s].
        patience: how long a joint may go without measurement before that is a fault [s].
    """

    def __init__(
        self,
        period: float,
        joints: tuple[str, ...],
        unexplained: Array,
        noise: float,
        late: Array,
        patience: float,
    ) -> None:
        self._names, self._late, self._patience = joints, late, patience
        self._noise = noise
        self._begins = np.concatenate([np.full(len(joints), noise), unexplained * period]) ** 2
        own = np.diag(unexplained**2 * period**2)
        self._walk: Array = np.block([[own * period**2 / 4, own * period / 2], [own * period / 2, own]])
        self._kept = int(np.ceil(late.max(initial=0.0) / period)) + 3

    def begin(self, state: Array, position: Array, time: float, stamp: float) -> Known:
        """A robot at rest where it is measured."""
        seen = np.full(len(position), stamp)
        return Known(state, time, ((time, position),), stamp, seen, np.diag(self._begins))

    def corrected(
        self,
        known: Known,
        ahead: Array,
        slopes: Array,
        joints: Callable[[Array], Array],
        placed: Callable[[Array, Array, Array], Array],
        measured: tuple[float, float, Array],
    ) -> Known:
        """What is known a control period later.

        Args:
            known: before.
            ahead: (nx,) the state that the model predicts.
            slopes: (2 nj, 2 nj) A.
            joints: of a state its positions and rates (2 nj,).
            placed: a state with other positions and rates.
            measured: (time now [s], stamp [s], positions (nj,) behind offset and scale, NaN where there is none).

        Raises:
            ControllerError: where a joint was not measured for too long.
        """
        now, stamp, y = measured
        before = joints(ahead)
        x, nj = before.copy(), len(y)
        cov = slopes @ known.covariance @ slopes.T + self._walk
        past = (*known.past, (now, before[:nj]))[-self._kept :]
        times, places = np.array([own[0] for own in past]), np.array([own[1] for own in past])
        fresh = np.isfinite(y) & (stamp > known.stamp + EARLY)
        for j in np.flatnonzero(fresh):
            off = y[j] - float(np.interp(stamp - self._late[j], times, places[:, j])) - (x[j] - before[j])
            gain = cov[:, j] / (cov[j, j] + self._noise**2)
            x += gain * off
            cov = cov - np.outer(gain, cov[j])
        seen = np.where(fresh, stamp, known.seen)
        if now - seen.min() > self._patience + EARLY:
            joint = int(np.argmin(seen))
            raise ControllerError(
                f"{self._names[joint]} was last measured at {seen[joint]:.3f} s and it is {now:.3f} s, expected a "
                f"number at least every {self._patience:g} s"
            )
        past = (*past[:-1], (now, x[:nj].copy()))
        return replace(
            known, state=placed(ahead, x[:nj], x[nj:]), time=now, past=past, stamp=max(stamp, known.stamp), seen=seen,
            covariance=(cov + cov.T) / 2,
        )  # fmt: skip
