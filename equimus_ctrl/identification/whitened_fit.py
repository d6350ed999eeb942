"""Residuals and derivatives of a fit, whitened by a noise, initial states projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl import computer
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
        threads: among which segments are shared out.
        held: (p,) −1 or 1 of the robot's parameters at a lower or upper bound that the residual would have them cross,
            else 0; none by default. Bounds of effects' parameters are only where these are looked for.
    """

    noise: Noise
    residual: Array
    slopes: Array
    starts: list[Nuisance]
    threads: int = 1
    held: Array | None = None

    @property
    def movable(self) -> Array:
        """(N, p) the derivatives by what may take part of a residual: 0 by parameters at an active bound.

        To first order these would cross their bounds, and what is missing would look as though they explained it.
        """
        if self.held is None or not self.held.any():
            return self.slopes
        return np.where(self.held != 0, 0.0, self.slopes)

    def narrowed(self, kept: Sequence[int] | Array) -> WhitenedFit:
        """The same with some of the parameters alone, by their indices."""
        rows = np.asarray(kept, dtype=int)
        return replace(self, slopes=self.slopes[:, rows], held=None if self.held is None else self.held[rows])

    def inside(self, moved: Array) -> Array:
        """(...) whether changes (p, ...) of the parameters take none beyond its active bound."""
        held = np.zeros(len(moved)) if self.held is None else self.held
        return np.asarray(np.all(moved[held < 0] >= 0, axis=0) & np.all(moved[held > 0] <= 0, axis=0))

    def columns(self, times: Sequence[Array], changes: Sequence[Array]) -> Array:
        """(N, k) changes (m, nj, k) of predictions, whitened likewise."""

        def rows(time: Array, change: Array, start: Nuisance) -> Array:
            return start.project_out(whiten(self.noise, time, change).reshape(len(start.basis), -1))

        return np.concatenate(computer.in_threads(self.threads, rows, times, changes, self.starts))


def whiten_fit(times: Sequence[Array], fit: Fit, noise: Noise) -> WhitenedFit:
    """The residuals (m, nj) and derivatives of a fit at each segment's times (m,) [s], under a noise."""
    scale = fit.parameters.scale

    def parts(time: Array, residual: Array, by_theta: Array, by_start: Array) -> tuple[Nuisance, Array]:
        start = Nuisance.of(whiten(noise, time, by_start).reshape(residual.size, -1))
        both = np.concatenate([residual[:, :, None], by_theta * scale], axis=2)
        return start, start.project_out(whiten(noise, time, both).reshape(residual.size, -1))

    threads = computer.worker_count(fit.problem.simulator.threads, len(times))
    rows = (times, fit.residuals, fit.jacobians, fit.start_jacobians)
    with threadpool_limits(limits=1, user_api="blas"):  # threads of their own would only fight with these
        starts, both = zip(*computer.in_threads(threads, parts, *rows), strict=True)
    residual, slopes = (np.concatenate(own) for own in ([b[:, 0] for b in both], [b[:, 1:] for b in both]))
    laws = fit.parameters.model.effect_parameters()
    own = np.array([parameter.name not in laws for parameter in fit.parameters.free])
    held = np.where(own & (fit.at_bound * (residual @ slopes) > 0), fit.at_bound, 0)
    return WhitenedFit(noise, residual, slopes, list(starts), threads, held)
