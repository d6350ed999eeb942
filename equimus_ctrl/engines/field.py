"""A model's equations of motion at many states at once, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.engines.encoding import Encoded
from equimus_ctrl.engines.lane_equations import Lanes
from equimus_ctrl.types import Array

STEP = 1e-5
"""Central differences are taken over this, in units of a coordinate or rate of its size, at least 1."""


@dataclass(frozen=True, eq=False)
class States:
    """Where a model is, n times.

    Attributes:
        q: (n, nv) coordinates of its equations [rad or m].
        v: (n, nv) their rates.
        z: (n, nz) states of the effects.
        pressure: (n, na) what its forces are made of.
        pressed: (n, nl) 1 where a limit is pressed.
        side: (n, nr) signs of the rates against which dry friction acts; 0 where it does not.
    """

    q: Array
    v: Array
    z: Array
    pressure: Array
    pressed: Array
    side: Array

    def moved(self, column: int, by: Array) -> States:
        """The same with one entry of (q, v, z) moved by (n,)."""
        parts = [self.q, self.v, self.z]
        for k, part in enumerate(parts):
            if column < part.shape[1]:
                parts[k] = part.copy()
                parts[k][:, column] += by
                break
            column -= part.shape[1]
        q, v, z = parts
        return States(q, v, z, self.pressure, self.pressed, self.side)


@dataclass(frozen=True, eq=False)
class Rub:
    """What dry friction does at n states.

    Attributes:
        per_impulse: (n, nv, nr) change of the velocities per unit impulse at each row, M⁻¹Gᵀ.
        delassus: (n, nr, nr) rates that it makes.
        rate: (n, nr).
        bound: (n, nr) the greatest friction.
    """

    per_impulse: Array
    delassus: Array
    rate: Array
    bound: Array


@dataclass(frozen=True, eq=False)
class Field:
    """The equations of motion of one model.

    Attributes:
        lanes: their compiled form.
        parameters: (np,) of the model.
    """

    lanes: Lanes
    parameters: Array

    @classmethod
    def of(cls, coded: Encoded, index: int = 0) -> Field:
        """Of one of some models."""
        return cls(coded.lanes, coded.parameters[index].copy())

    def states(self, q: Array, v: Array, z: Array | None = None, pressure: Array | None = None) -> States:
        """States with nothing pressed and no friction; no commands and no states of effects by default."""
        n, k = len(q), self.lanes
        z = np.zeros((n, k.n_states)) if z is None else z
        pressure = np.zeros((n, k.n_actuators)) if pressure is None else pressure
        q, v, z, pressure = (np.ascontiguousarray(part, dtype=np.float64) for part in (q, v, z, pressure))
        return States(q, v, z, pressure, np.zeros((n, k.n_limits)), np.zeros((n, k.n_rows)))

    def at(self, s: States) -> Array:
        """(n, nv + nz) accelerations and rates of the effects' states."""
        out = np.empty((len(s.q), self.lanes.n_joints + self.lanes.n_states))
        self.lanes.kernel.field(self.lanes.robot, self.parameters, s.q, s.v, s.z, s.pressure, s.pressed, s.side, out)
        return out

    def slopes(self, s: States) -> Array:
        """(n, nv + nz, 2 nv + nz) their derivatives by (q, v, z)."""
        whole = np.concatenate([s.q, s.v, s.z], axis=1)
        found = np.empty((len(s.q), self.lanes.n_joints + self.lanes.n_states, whole.shape[1]))
        for column in range(whole.shape[1]):
            by = STEP * np.maximum(np.abs(whole[:, column]), 1.0)
            change = self.at(s.moved(column, by)) - self.at(s.moved(column, -by))
            found[:, :, column] = change / (2 * by)[:, None]
        return found

    def rub(self, s: States) -> Rub:
        """What dry friction does, whatever ``side`` says."""
        n, nv, nr = len(s.q), self.lanes.n_joints, self.lanes.n_rows
        out = np.empty((n, nr * (nv + nr + 3)))
        if nr:
            self.lanes.kernel.rubbing_field(
                self.lanes.robot, self.parameters, s.q, s.v, s.z, s.pressure, s.pressed, out
            )
        per_impulse, delassus, bound, _, rate = np.split(out, np.cumsum([nv * nr, nr * nr, nr, nr]), axis=1)
        columns = per_impulse.reshape(n, nr, nv).transpose(0, 2, 1)
        return Rub(columns, delassus.reshape(n, nr, nr).transpose(0, 2, 1), rate, bound)

    def rows(self, s: States) -> Array:
        """(n, nr, nv) along which dry friction acts."""
        nv = self.lanes.n_joints
        found = np.empty((len(s.q), self.lanes.n_rows, nv))
        for j in range(nv):
            unit = np.zeros_like(s.v)
            unit[:, j] = 1.0
            found[:, :, j] = self.rub(States(s.q, unit, s.z, s.pressure, s.pressed, s.side)).rate
        return found

    def limits(self, s: States) -> tuple[Array, Array]:
        """(n, nl) how far states are beyond each limit, and 1 where one is pressed, of those that are beyond theirs."""
        depths, gaps = np.empty((2, len(s.q), self.lanes.n_limits))
        for pressed in (np.zeros_like(depths), None):
            given = (depths > 0).astype(np.float64) if pressed is None else pressed
            self.lanes.kernel.limit_gaps(
                self.lanes.robot, self.parameters, s.q, s.v, s.z, s.pressure, given, depths, gaps
            )
        return depths, (gaps > 0).astype(np.float64)

    def fastest(self, s: States) -> float:
        """Largest |eigenvalue| of the motion about the states [1/s]."""
        slopes, nv = self.slopes(s), self.lanes.n_joints
        system = np.zeros((len(slopes), slopes.shape[2], slopes.shape[2]))
        system[:, range(nv), range(nv, 2 * nv)] = 1.0
        system[:, nv:] = slopes
        usable = np.isfinite(system).all(axis=(1, 2))
        return float(np.abs(np.linalg.eigvals(system[usable])).max(initial=0.0))
