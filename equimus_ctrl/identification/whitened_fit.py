"""Residuals and derivatives of a fit, whitened by a noise, initial states projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class WhitenedFit:
    """Residuals and derivatives of a fit, whitened, the derivatives by free initial states projected out.

    Attributes:
        noise: by which they are whitened.
        residual: (N,) of standard deviation 1 where the noise is all there is.
        slopes: (N, p) ∂prediction/∂θ in units of the parameters' scale.
        starts: for each segment its whitened derivatives by the initial state.
    """

    noise: Noise
    residual: Array
    slopes: Array
    starts: list[Nuisance]

    def columns(self, times: Sequence[Array], changes: Sequence[Array]) -> Array:
        """(N, k) changes (m, nj, k) of predictions, whitened likewise."""
        rows = []
        for time, change, start in zip(times, changes, self.starts, strict=True):
            rows.append(start.project_out(whiten(self.noise, time, change).reshape(len(start.basis), -1)))
        return np.concatenate(rows)


def whiten_fit(times: Sequence[Array], fit: Fit, noise: Noise) -> WhitenedFit:
    """The residuals (m, nj) and derivatives of a fit at each segment's times (m,) [s], under a noise."""
    scale = fit.parameters.scale
    residuals, slopes, starts = [], [], []
    rows = zip(times, fit.residuals, fit.jacobians, fit.start_jacobians, strict=True)
    for time, r, j, s in rows:
        count = r.size
        start = Nuisance.of(whiten(noise, time, s).reshape(count, -1))
        both = whiten(noise, time, np.concatenate([r[:, :, None], j * scale], axis=2)).reshape(count, -1)
        both = start.project_out(both)
        residuals.append(both[:, 0])
        slopes.append(both[:, 1:])
        starts.append(start)
    return WhitenedFit(noise, np.concatenate(residuals), np.concatenate(slopes), starts)
