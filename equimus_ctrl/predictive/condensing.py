"""A horizon's linearised steps folded into a quadratic program in its inputs alone.

    δx_{k+1} = A_k δx_k + B_k δu_k + c_k,  δx_0 = 0    gives    δx = G δu + g

and what it costs is ½ |J δu + r|², a row for every weighted state. Compiled by numba; no compiler is needed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.types import Array


@njit(cache=True, nogil=True)
def fold(a: Array, b: Array, gap: Array, scale: Array, big: Array, small: Array) -> None:
    """Write G and g.

    Args:
        a: (nx, n·nx) the steps' derivatives by their state, side by side.
        b: (nx, n·nu) the same by their input.
        gap: (n, nx) by what each step misses the next state, c.
        scale: (nu,) of the inputs: columns of G are for δu/scale.
        big: (n, nx, n·nu) G is written here, a matrix for each state after the first.
        small: (n, nx) g.
    """
    n, nx = gap.shape
    nu = len(scale)
    for k in range(n):
        for i in range(nx):
            for j in range(nu):
                big[k, i, k * nu + j] = b[i, k * nu + j] * scale[j]
            value = gap[k, i]
            if k > 0:
                big[k, i, : k * nu] = 0.0
                for m in range(nx):
                    share = a[i, k * nx + m]
                    if share != 0.0:  # what follows its command at once remembers nothing
                        value += share * small[k - 1, m]
                        for j in range(k * nu):
                            big[k, i, j] += share * big[k - 1, m, j]
            small[k, i] = value


@njit(cache=True, nogil=True)
def weigh(
    big: Array, small: Array, error: Array, weight: Array, last: Array, effort: Array, span: Array, rows: Array,
    hessian: Array, gradient: Array,
) -> float:  # fmt: skip
    """Write the Hessian and the gradient of what states and inputs cost, and return what the present ones cost.

    Args:
        big: G.
        small: g.
        error: (n, nx) of the present states after the first from where they are wanted.
        weight: (n − 1, nx) square roots of what these cost, all but the last.
        last: (nx, nx) L of the last one's ½ |L δ|².
        effort: (n·nu,) how far the present inputs are from where they are wanted, in scales.
        span: (n·nu,) what a unit of that costs, twice.
        rows: (m, n·nu) room for J.
        hessian: (n·nu, n·nu).
        gradient: (n·nu,).
    """
    n, nx = error.shape
    size = big.shape[2]
    at = 0
    residual = np.empty(rows.shape[0])
    cost = 0.0
    for k in range(n - 1):
        for i in range(nx):
            w = weight[k, i]
            if w > 0.0:
                residual[at] = w * (error[k, i] + small[k, i])
                cost += 0.5 * (w * error[k, i]) ** 2
                for j in range(size):
                    rows[at, j] = w * big[k, i, j]
                at += 1
    for i in range(nx):
        value, now = 0.0, 0.0
        for m in range(nx):
            value += last[i, m] * (error[n - 1, m] + small[n - 1, m])
            now += last[i, m] * error[n - 1, m]
        residual[at] = value
        cost += 0.5 * now**2
        for j in range(size):
            total = 0.0
            for m in range(nx):
                total += last[i, m] * big[n - 1, m, j]
            rows[at, j] = total
        at += 1
    used = rows[:at]
    hessian[:] = np.dot(used.T, used)
    gradient[:] = np.dot(used.T, residual[:at])
    for j in range(size):
        hessian[j, j] += span[j]
        gradient[j] += span[j] * effort[j]
        cost += 0.5 * span[j] * effort[j] ** 2
    return cost


@njit(cache=True, nogil=True)
def steepest(a: Array, error: Array, weight: Array, last: Array, found: Array) -> None:
    """Write what a unit of each state's jump costs at most along the horizon, by the adjoint recursion.

    Args:
        a: (nx, n·nx) as of ``fold``.
        error: as of ``weigh``.
        weight: as of ``weigh``.
        last: as of ``weigh``.
        found: (nx,) the largest magnitude of each multiplier.
    """
    n, nx = error.shape
    now, before = np.zeros(nx), np.zeros(nx)
    for i in range(nx):
        for m in range(nx):
            total = 0.0
            for j in range(nx):
                total += last[m, j] * error[n - 1, j]
            now[i] += last[m, i] * total
        found[i] = abs(now[i])
    for k in range(n - 1, 0, -1):
        for i in range(nx):
            before[i] = weight[k - 1, i] ** 2 * error[k - 1, i]
            for m in range(nx):
                before[i] += a[m, k * nx + i] * now[m]
        for i in range(nx):
            now[i] = before[i]
            found[i] = max(found[i], abs(now[i]))
