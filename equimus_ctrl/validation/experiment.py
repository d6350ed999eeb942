"""Runs of robots of one structure: where they start and what drives them, whatever engine then makes them move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack
from equimus_ctrl.types import Array
from equimus_ctrl.validation.plan import SAMPLE_RATE


@dataclass(frozen=True, eq=False)
class Experiment:
    """Open-loop runs under piecewise constant pressures.

    Attributes:
        morphologies: one for all runs, or one for each; of one structure, with the same names.
        phase: base fixed or foot pinned.
        start: (n, nj) angles at rest at time 0 [rad].
        switch: (k,) ascending instants from which each row of pressures holds, the first 0 [s]; multiples of the
            sampling period.
        pressure: (n, k, na) [Pa].
        duration: of every run [s].
    """

    morphologies: tuple[Morphology, ...]
    phase: Phase
    start: Array
    switch: Array
    pressure: Array
    duration: float

    @property
    def size(self) -> int:
        """How many runs."""
        return len(self.start)

    @property
    def times(self) -> Array:
        """(m,) when angles are compared, 0 included [s]."""
        return np.arange(round(self.duration * SAMPLE_RATE) + 1, dtype=np.float64) / SAMPLE_RATE

    @property
    def force(self) -> Array:
        """(n, k, na) forces along the actuators [N]."""
        area = np.array([[a.area for a in m.actuators] for m in self.morphologies])
        return np.asarray(self.pressure * area[:, None, :])

    @property
    def parameters(self) -> Array:
        """(1 or n, np) packed morphologies."""
        return np.array([pack(m) for m in self.morphologies])

    def held(self, dt: float) -> Array:
        """(n, steps, na) pressures of each step of dt [s]; dt divides the sampling period."""
        ratio = round(1 / (SAMPLE_RATE * dt))
        row = np.searchsorted(self.switch, self.times[:-1] + 1e-9, side="right") - 1
        return np.repeat(self.pressure[:, row], ratio, axis=1)

    def part(self, rows: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Experiment:
        """Some of the runs."""
        own = self.morphologies
        if len(own) > 1:
            own = tuple(own[i] for i in np.arange(self.size)[rows])
        return replace(self, morphologies=own, start=self.start[rows], pressure=self.pressure[rows])

    def without_stops(self) -> Experiment:
        """The same robots with joints that turn freely."""
        return replace(self, morphologies=tuple(m.without_stops() for m in self.morphologies))

    def touches(self, q: Array, margin: float = 1e-4) -> NDArray[np.bool_]:
        """(n,) whether a run (n, m, nj) comes within ``margin`` [rad] of a stop; a NaN does not."""
        ranges = np.array([m.joint_range for m in self.morphologies])[:, :, None, :]  # (n, 2, 1, nj)
        with np.errstate(invalid="ignore"):
            return np.asarray(((q <= ranges[:, 0] + margin) | (q >= ranges[:, 1] - margin)).any(axis=(1, 2)))


def undamped(morphology: Morphology) -> Morphology:
    """A robot in which nothing is lost: no stops, no damping in joints or actuators."""
    free = morphology.without_stops()
    return replace(
        free,
        joints=tuple(replace(j, damping=0.0) for j in free.joints),
        actuators=tuple(replace(a, damping=0.0) for a in free.actuators),
    )


def any_force(morphology: Morphology) -> Morphology:
    """A robot whose commands are not bounded: its actuators exert forces of either sign."""
    return replace(morphology, command_low=-1e9, command_high=1e9)
