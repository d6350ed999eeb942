"""Residuals and derivatives of a fit as a noise weighs them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Weighing:
    """Residuals and derivatives as one noise weighs them, what starts can do taken out.

    Attributes:
        residual: (N,).
        slopes: (N, p) in units of the parameters' scale.
        starts: for each segment what its start can do.
    """

    noise: Noise
    residual: Array
    slopes: Array
    starts: list[Nuisance]

    def columns(self, times: Sequence[Array], changes: Sequence[Array]) -> Array:
        """(N, k) changes (m, nj, k) of predictions, weighed."""
        rows = []
        for time, change, start in zip(times, changes, self.starts, strict=True):
            rows.append(start.without(whiten(self.noise, time, change).reshape(len(start.basis), -1)))
        return np.concatenate(rows)


def weigh(times: Sequence[Array], fit: Fit, noise: Noise) -> Weighing:
    """The residuals (m, nj) and derivatives of a fit at each segment's times (m,) [s], under a noise."""
    scale = fit.parameters.scale
    residuals, slopes, starts = [], [], []
    rows = zip(times, fit.residuals, fit.jacobians, fit.start_jacobians, strict=True)
    for time, r, j, s in rows:
        count = r.size
        start = Nuisance.of(whiten(noise, time, s).reshape(count, -1))
        both = whiten(noise, time, np.concatenate([r[:, :, None], j * scale], axis=2)).reshape(count, -1)
        both = start.without(both)
        residuals.append(both[:, 0])
        slopes.append(both[:, 1:])
        starts.append(start)
    return Weighing(noise, np.concatenate(residuals), np.concatenate(slopes), starts)
