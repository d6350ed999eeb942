"""What arrives of commands at an MJCF robot's actuators piece by piece, and integrators that follow it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.following import (
    CARRIED,
    FOLLOW_HIGH,
    FOLLOW_KIND,
    FOLLOW_LEAST,
    FOLLOW_LOW,
    FOLLOW_MOST,
    INTEGRATED,
    first_carried,
    go_on,
    integrate,
)
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.mjcf_realised import Realised
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Arriving:
    """Commands of one history.

    Attributes:
        times: (n,) from when each row holds [s].
        before: (na,) in force before; na with accelerations that are prescribed.
        columns: (na, n).
        valve: (na, 6), see ``effects.command.DELAY``.
        linear: (na,) whether they go along a line from row to row.
    """

    times: Array
    before: Array
    columns: Array
    valve: Array
    linear: NDArray[np.bool_]

    @classmethod
    def of(cls, own: Realised, trial: Trial, rows: Array) -> Arriving:
        """Of a trial's history; ``rows`` (1 + n, na) see ``mjcf.rows_of``."""
        columns = np.ascontiguousarray(rows[1:].T)
        return cls(trial.times, rows[0].copy(), columns, valves_of(own), trial.lines(own.robot))

    def at(self, start: float) -> Array:
        """(na, ``CARRIED``) what is carried along from a start on [s]."""
        carried = np.empty((len(self.columns), CARRIED))
        for i, row in enumerate(carried):
            first_carried(self.before[i], np.zeros(6), 0.0, row)
        if start > self.times[0]:
            self.piece(carried, float(self.times[0]), start - float(self.times[0]), 1)
        return carried

    def piece(self, carried: Array, start: float, dt: float, steps: int) -> Array:
        """(steps, na) means over steps from a start on; what is carried along is replaced by that at the end."""
        out = np.empty((steps, 2, len(self.columns)))
        for i, row in enumerate(carried):
            go_on(
                self.times, self.columns[i], self.before[i], self.valve[i], np.zeros(6), start, dt, i, self.linear[i],
                row, out,
            )  # fmt: skip
        return np.ascontiguousarray(out[:, 0])


def valves_of(own: Realised) -> Array:
    """(na + np, 6) of the actuators, and of accelerations that are prescribed."""
    return np.vstack([own.valve, valve_settings((), own.robot.prescribed_names)])


def integrate_from_here(model: Any, data: Any) -> None:
    """Let integrators of commands begin where their actuators are."""
    chosen = _integrators(model)
    if len(chosen):
        mujoco.mj_fwdPosition(model, data)
        for i in chosen:
            data.act[model.actuator_actadr[i]] = data.actuator_length[model.actuator_outadr[i]]


def integrate_since(own: Realised, trial: Trial, rows: Array, act: Array) -> None:
    """What integrators have come to at a trial's start, of those that began with the commands.

    Args:
        own: the robot.
        trial: whose start.
        rows: (1 + n, na) see ``mjcf.rows_of``.
        act: MuJoCo's activations at the first row; those of integrators are replaced.
    """
    model = own.mujoco
    chosen = _integrators(model)
    if not len(chosen):
        return
    columns, places = model.actuator_ctrladr[chosen], model.actuator_actadr[chosen]
    follow, first = np.zeros((rows.shape[1], 6)), np.zeros(rows.shape[1])
    follow[:, [FOLLOW_LOW, FOLLOW_LEAST]], follow[:, [FOLLOW_HIGH, FOLLOW_MOST]] = -np.inf, np.inf
    clamped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    for i, column in zip(chosen, columns, strict=True):
        follow[column, FOLLOW_KIND] = INTEGRATED
        if clamped and model.actuator_ctrllimited[column]:
            follow[column, [FOLLOW_LOW, FOLLOW_HIGH]] = model.actuator_ctrlrange[column]
        if model.actuator_actlimited[i]:
            follow[column, [FOLLOW_LEAST, FOLLOW_MOST]] = model.actuator_actrange[i]
    first[columns] = np.clip(act[places], follow[columns, FOLLOW_LEAST], follow[columns, FOLLOW_MOST])
    out = np.zeros((1, len(first)))
    integrate(
        trial.times, rows[1:].copy(), rows[0].copy(), valves_of(own), follow, first, np.array([trial.start]),
        float(model.opt.timestep), trial.lines(own.robot), out,
    )  # fmt: skip
    act[places] = out[0, columns]


def _integrators(model: Any) -> NDArray[np.int64]:
    """Which actuators integrate their command."""
    return np.flatnonzero(model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR))
