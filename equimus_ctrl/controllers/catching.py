"""From where a regulator whose commands have limits brings back a robot that falls.

Along a mode that grows by itself, with rate p and left eigenvector w, commands within limits h can do no more than

    |wᵀx| < Σ |wᵀB| h / p

so that no controller at all catches the robot from beyond (its null-controllable region; Hu & Lin, *Control Systems
with Actuator Saturation*, 2001, chapter 2). A linear regulator whose commands are cut off catches it from less, the
less the more it asks for. Where a joint has no actuator, errors as large as a first pose may be are there from the
start, and nothing fades them out: a third of what could be caught at all, or of a joint's half range where that is
less, is to be brought back then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from equimus_ctrl.types import Array

CAUGHT = 1 / 3
"""Share of what commands within their limits can catch at all, and of a joint's half range, that is to be caught: the
more, the slower. A regulator that asks as little as stabilises, and is never cut off, catches half."""
GROWING = 0.05
"""Rate below which a mode does not fall [1/s]: it takes as long as anybody looks on."""
PERIODS = 4.0
"""How long is looked on, in periods of the bandwidth: what comes back has done so long before."""
BACK = 0.1
"""Share of itself to which an error has come down by then."""


class Closed(Protocol):
    """A sampled loop whose commands are cut off, see ``controllers.allowances.Loop``."""

    def run(self, gains: tuple[Array, Array], first: Array, reach: Array, steps: int, unknown: int) -> Array:
        """(steps, n, k) states from (n, k) on."""
        ...


@dataclass(frozen=True, eq=False)
class Falls:
    """Departures from a pose at rest that are to be caught.

    Attributes:
        first: (n, k) states.
        reach: (2, na) commands beyond what holds the pose.
    """

    first: Array
    reach: Array

    @classmethod
    def of(cls, a: Array, b: Array, nj: int, half: Array, reach: Array) -> Falls | None:
        """Of a robot about a pose; None where nothing falls there, or nothing limits what holds it.

        Args:
            a: (n, n) of angles, velocities and what is behind drives.
            b: (n, na).
            nj: joints.
            half: (nj,) half their ranges [rad or m].
            reach: (2, na) commands beyond what holds the pose; infinite where nothing limits them.
        """
        values, vectors = np.linalg.eig(a.T)
        falling = np.flatnonzero((values.real > GROWING) & (values.imag == 0.0))
        most = np.minimum(-reach[0], reach[1])  # either way alike
        if not len(falling) or not np.isfinite(most).all():
            return None
        aside = half.copy()
        for k in falling:
            left = vectors[:, k].real
            bound = float(np.abs(left @ b) @ most) / float(values[k].real)
            with np.errstate(divide="ignore"):
                aside = np.minimum(aside, bound / np.abs(left[:nj]))
        first = np.zeros((len(a), 2 * nj))
        first[:nj] = CAUGHT * np.hstack([np.diag(aside), -np.diag(aside)])
        return cls(first, reach)

    def caught(self, loop: Closed, gains: tuple[Array, Array], bandwidth: float, dt: float, unknown: int) -> bool:
        """Whether a loop brings all of them back.

        Args:
            loop: about the pose.
            gains: of regulator and observer.
            bandwidth: of the loop [rad/s].
            dt: control period [s].
            unknown: by how many periods commands are later than is known.
        """
        steps = int(np.ceil(PERIODS * 2 * np.pi / bandwidth / dt))
        states = loop.run(gains, self.first, self.reach, steps, unknown)
        nj = self.first.shape[1] // 2
        scale = np.abs(self.first[:nj]).max(axis=1)
        left = np.abs(states[-max(steps // 8, 1) :, :nj]) / scale[:, None]
        return bool(np.isfinite(states).all() and left.max() <= BACK)
