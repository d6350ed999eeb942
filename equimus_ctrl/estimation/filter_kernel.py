"""The matrices of an extended Kalman filter, compiled: they are multiplied several times at every control instant."""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def carried_on(
    by_x: Array, by_u: Array, by_d: Array, walk: Array, kick: Array, first: int, covariance: Array, f: Array, g: Array
) -> None:
    """One step's share in how a filter is carried on: P ← A P Aᵀ + Q, F ← A F, G ← A G + B.

        A = [∂x'/∂x, ∂x'/∂d; 0, 1],    Q = diag(walk) + ∂x'/∂d diag(kick) (∂x'/∂d)ᵀ

    of a state x, n numbers of it, with unknown torques d, nj of them; m = n + nj. B is what a pressure does that
    differs over the whole step, at its begin and in what follows; of the pressures themselves it is 0.

    Args:
        by_x: (n, n) transposed derivatives of the next state.
        by_u: (na, n) alike.
        by_d: (nj, n) alike.
        walk: (m,) variances that states and torques walk over the step.
        kick: (nj,) of the torques that act all of it as white ones do.
        first: number of the first pressure among the states.
        covariance: (m, m) P, changed.
        f: (m, m) F, changed; without rows where nobody asks.
        g: (m, na) G, changed.
    """
    n, nj, na = by_x.shape[0], by_d.shape[0], by_u.shape[0]
    m = n + nj
    half, gain = np.empty((m, m)), np.empty((n, nj))
    _led(by_x, by_d, covariance, half)
    for i in range(m):
        for j in range(m):
            covariance[i, j] = half[j, i]
    _led(by_x, by_d, covariance, half)
    for i in range(m):
        for j in range(m):
            covariance[i, j] = half[j, i]
        covariance[i, i] += walk[i]
    for i in range(n):
        for k in range(nj):
            gain[i, k] = by_d[k, i] * kick[k]
    for i in range(n):
        for j in range(n):
            for k in range(nj):
                covariance[i, j] += gain[i, k] * by_d[k, j]
    if len(f) == 0:
        return
    _led(by_x, by_d, f, half)
    f[:] = half
    whole = np.empty((m, na))
    _led(by_x, by_d, g, whole)
    for i in range(n):
        if not first <= i < first + na:
            for k in range(na):
                whole[i, k] += by_x[first + k, i] + by_u[k, i]
    g[:] = whole


@njit(cache=True, nogil=True, error_model="numpy")
def _led(by_x: Array, by_d: Array, columns: Array, found: Array) -> None:
    """Write A times columns (m, k), see ``carried_on``."""
    n, nj = by_x.shape[0], by_d.shape[0]
    for i in range(n):
        for k in range(columns.shape[1]):
            own = 0.0
            for j in range(n):
                own += by_x[j, i] * columns[j, k]
            for j in range(nj):
                own += by_d[j, i] * columns[n + j, k]
            found[i, k] = own
    found[n:] = columns[n:]


@njit(cache=True, nogil=True, error_model="numpy")
def corrected(
    mean: Array, covariance: Array, joint: int, angle: float, offset: float, scale: float, noise: float, gain: Array
) -> tuple[float, float]:
    """After a measured position; the covariance in Joseph's form.

        ν = y − offset − scale q,    s = scale² P_qq + noise²,    K = scale P_q / s
        x ← x + K ν,    P ← (1 − K H) P (1 − K H)ᵀ + noise² K Kᵀ

    Args:
        mean: (m,) x, changed.
        covariance: (m, m) P, changed.
        joint: number of q among the states.
        angle: y [rad or m].
        offset: of its sensor [rad or m].
        scale: likewise.
        noise: standard deviation of y [rad or m].
        gain: (m,) K, written.

    Returns:
        ν and s.
    """
    m = len(mean)
    variance = scale * scale * covariance[joint, joint] + noise * noise
    off = angle - offset - scale * mean[joint]
    for i in range(m):
        gain[i] = scale * covariance[joint, i] / variance
    seen = scale * covariance[joint]
    for i in range(m):
        mean[i] += gain[i] * off
        for j in range(m):
            covariance[i, j] -= gain[i] * seen[j]
    shown = scale * covariance[:, joint]
    for i in range(m):
        for j in range(m):
            covariance[i, j] += (noise * noise * gain[i] - shown[i]) * gain[j]
    for i in range(m):
        for j in range(i):
            covariance[i, j] = covariance[j, i] = (covariance[i, j] + covariance[j, i]) / 2
    return off, variance
