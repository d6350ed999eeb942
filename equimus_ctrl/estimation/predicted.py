"""Positions and rates of any robot that can be rolled out: a model predicts, an α–β filter corrects.

    x⁻ = F(x, u),    q = q⁻ + α (y − q⁻),    v = v⁻ + β (y − q⁻)/T

F is one control period of the robot, contacts and all, under the commands that have arrived meanwhile. α and β are
those of least variance for white noise σ on what is measured and accelerations of variance w² that the model does not
explain, by the tracking index λ = w T²/σ (Kalata, "The tracking index", IEEE Transactions on Aerospace and Electronic
Systems, 1984).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.errors import ControllerError
from equimus_ctrl.types import Array

EARLY = 1e-9
"""Times that differ by less are the same [s]."""


def tracking_gains(index: Array) -> tuple[Array, Array]:
    """α and β for tracking indices λ."""
    r = (4 + index - np.sqrt(8 * index + index**2)) / 4
    alpha = 1 - r**2
    return alpha, 2 * (2 - alpha) - 4 * np.sqrt(1 - alpha)


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a robot at a control instant.

    Attributes:
        state: (nx,) of the rollouts.
        time: of it [s].
        past: (time [s], (nj,) positions) where it was thought to be at the latest instants, the newest last.
        stamp: of the latest measurement [s].
        seen: (nj,) when each joint was last measured [s].
    """

    state: Array
    time: float
    past: tuple[tuple[float, Array], ...]
    stamp: float
    seen: Array


class Predicted:
    """The filter of one robot.

    Args:
        period: of control [s].
        joints: their names.
        index: (nj,) tracking index.
        late: (nj,) what each sensor is late by [s].
        patience: how long a joint may go without measurement before that is a fault [s].
    """

    def __init__(self, period: float, joints: tuple[str, ...], index: Array, late: Array, patience: float) -> None:
        self._period, self._names, self._late, self._patience = period, joints, late, patience
        self._alpha, self._beta = tracking_gains(index)
        self._kept = int(np.ceil(late.max(initial=0.0) / period)) + 3

    def begin(self, state: Array, position: Array, time: float, stamp: float) -> Known:
        """A robot at rest where it is measured."""
        return Known(state, time, ((time, position),), stamp, np.full(len(position), stamp))

    def corrected(
        self,
        known: Known,
        ahead: Array,
        joints: Callable[[Array], Array],
        placed: Callable[[Array, Array, Array], Array],
        measured: tuple[float, float, Array],
    ) -> Known:
        """What is known a control period later.

        Args:
            known: before.
            ahead: (nx,) the state that the model predicts.
            joints: of a state its positions and rates (2 nj,).
            placed: a state with other positions and rates.
            measured: (time now [s], stamp [s], positions (nj,) behind offset and scale, NaN where there is none).

        Raises:
            ControllerError: where a joint was not measured for too long.
        """
        now, stamp, y = measured
        x = joints(ahead)
        q, v = x[: len(y)].copy(), x[len(y) :].copy()
        past = (*known.past, (now, q))[-self._kept :]
        times, places = np.array([own[0] for own in past]), np.array([own[1] for own in past])
        fresh = np.isfinite(y) & (stamp > known.stamp + EARLY)
        for j in np.flatnonzero(fresh):
            off = y[j] - float(np.interp(stamp - self._late[j], times, places[:, j]))
            q[j] += self._alpha[j] * off
            v[j] += self._beta[j] * off / self._period
        seen = np.where(fresh, stamp, known.seen)
        if now - seen.min() > self._patience + EARLY:
            joint = int(np.argmin(seen))
            raise ControllerError(
                f"{self._names[joint]} was last measured at {seen[joint]:.3f} s and it is {now:.3f} s, expected a "
                f"number at least every {self._patience:g} s"
            )
        past = (*past[:-1], (now, q))
        return replace(
            known, state=placed(ahead, q, v), time=now, past=past, stamp=max(stamp, known.stamp), seen=seen
        )  # fmt: skip
