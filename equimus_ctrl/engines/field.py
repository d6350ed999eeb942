"""A model's equations of motion at many states at once, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np

from equimus_ctrl.engines.encoding import Encoded
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
        kernel: compiled.
        parameters: (np,) of the model.
    """

    kernel: ModuleType
    parameters: Array

    @classmethod
    def of(cls, coded: Encoded, index: int = 0) -> Field:
        """Of one of some models."""
        return cls(coded.kernel, coded.parameters[index].copy())

    def states(self, q: Array, v: Array, z: Array | None = None, pressure: Array | None = None) -> States:
        """States with nothing pressed and no friction; no commands and no states of effects by default."""
        n, k = len(q), self.kernel
        z = np.zeros((n, k.N_STATES)) if z is None else z
        pressure = np.zeros((n, k.N_ACTUATORS)) if pressure is None else pressure
        q, v, z, pressure = (np.ascontiguousarray(part, dtype=np.float64) for part in (q, v, z, pressure))
        return States(q, v, z, pressure, np.zeros((n, k.N_LIMITS)), np.zeros((n, k.N_ROWS)))

    def at(self, s: States) -> Array:
        """(n, nv + nz) accelerations and rates of the effects' states."""
        out = np.empty((len(s.q), self.kernel.N_JOINTS + self.kernel.N_STATES))
        self.kernel.field(self.parameters, s.q, s.v, s.z, s.pressure, s.pressed, s.side, out)
        return out

    def slopes(self, s: States) -> Array:
        """(n, nv + nz, 2 nv + nz) their derivatives by (q, v, z)."""
        whole = np.concatenate([s.q, s.v, s.z], axis=1)
        found = np.empty((len(s.q), self.kernel.N_JOINTS + self.kernel.N_STATES, whole.shape[1]))
        for column in range(whole.shape[1]):
            by = STEP * np.maximum(np.abs(whole[:, column]), 1.0)
            change = self.at(s.moved(column, by)) - self.at(s.moved(column, -by))
            found[:, :, column] = change / (2 * by)[:, None]
        return found

    def rub(self, s: States) -> Rub:
        """What dry friction does, whatever ``side`` says."""
        n, nv, nr = len(s.q), self.kernel.N_JOINTS, self.kernel.N_ROWS
        out = np.empty((n, nr * (nv + nr + 3)))
        if nr:
            self.kernel.rubbing_field(self.parameters, s.q, s.v, s.z, s.pressure, s.pressed, out)
        per_impulse, delassus, bound, _, rate = np.split(out, np.cumsum([nv * nr, nr * nr, nr, nr]), axis=1)
        columns = per_impulse.reshape(n, nr, nv).transpose(0, 2, 1)
        return Rub(columns, delassus.reshape(n, nr, nr).transpose(0, 2, 1), rate, bound)

    def rows(self, s: States) -> Array:
        """(n, nr, nv) along which dry friction acts."""
        nv = self.kernel.N_JOINTS
        found = np.empty((len(s.q), self.kernel.N_ROWS, nv))
        for j in range(nv):
            unit = np.zeros_like(s.v)
            unit[:, j] = 1.0
            found[:, :, j] = self.rub(States(s.q, unit, s.z, s.pressure, s.pressed, s.side)).rate
        return found

    def limits(self, s: States) -> tuple[Array, Array]:
        """(n, nl) how far states are beyond each limit, and 1 where one is pressed, of those that are beyond theirs."""
        depths, gaps = np.empty((2, len(s.q), self.kernel.N_LIMITS))
        for pressed in (np.zeros_like(depths), None):
            given = (depths > 0).astype(np.float64) if pressed is None else pressed
            self.kernel.limit_gaps(self.parameters, s.q, s.v, s.z, s.pressure, given, depths, gaps)
        return depths, (gaps > 0).astype(np.float64)

    def fastest(self, s: States) -> float:
        """Largest |eigenvalue| of the motion about the states [1/s]."""
        slopes, nv = self.slopes(s), self.kernel.N_JOINTS
        system = np.zeros((len(slopes), slopes.shape[2], slopes.shape[2]))
        system[:, range(nv), range(nv, 2 * nv)] = 1.0
        system[:, nv:] = slopes
        usable = np.isfinite(system).all(axis=(1, 2))
        return float(np.abs(np.linalg.eigvals(system[usable])).max(initial=0.0))
