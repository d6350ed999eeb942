"""The sums of a bank of valves (``estimation.valve_bank``), compiled: they are taken at every control instant."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.types import Array

SMALL = 1e-9
"""Time constants and times that are none [s]."""


@njit(cache=True, nogil=True, error_model="numpy")
def in_force(times: Array, time: float) -> int:
    """Number of the command in force at a time [s], the first before all.

    Args:
        times: (n,) ascending, from when each was in force [s].
        time: [s].
    """
    k = len(times) - 1
    while k > 0 and times[k] > time + SMALL:
        k -= 1
    return k


@njit(cache=True, nogil=True, error_model="numpy")
def passed(
    times: Array, values: Array, start: float, until: float, late: Array, pressure: Array, after: Array, mean: Array
) -> None:
    """What passes the valves of all hypotheses from ``start`` to ``until`` [s].

    Args:
        times: (n,) from when each command was in force [s].
        values: (n, na) what reaches the valves of them [Pa].
        start: of the interval [s].
        until: its end [s].
        late: (na, k, 2) whole dead times and time constants [s].
        pressure: (na, k) behind the valves at ``start`` [Pa].
        after: (na, k) written: at ``until`` [Pa].
        mean: (na, k) written: in between [Pa].
    """
    na, count = pressure.shape
    for i in range(na):
        for h in range(count):
            begin, end = start - late[i, h, 0], until - late[i, h, 0]
            tau = max(late[i, h, 1], SMALL)
            k, p, area = in_force(times, begin), pressure[i, h], 0.0
            while begin < end:
                last = k + 1 == len(times) or times[k + 1] >= end - SMALL
                stop = end if last else times[k + 1]
                span, command = stop - begin, values[k, i]
                decay = np.exp(-span / tau)
                area += command * span + (p - command) * tau * (1 - decay)
                p = command + (p - command) * decay
                begin = stop
                k += 1
                if last:
                    break
            after[i, h], mean[i, h] = p, area / (until - start)


@njit(cache=True, nogil=True, error_model="numpy")
def seen(row: Array, gain: Array, off: float, variance: float, deviation: Array, fits: Array, alike: Array) -> None:
    """A measurement's share in all sums.

    Args:
        row: (m,) H.
        gain: (m,) K.
        off: ν.
        variance: s.
        deviation: (m, n) δ of all hypotheses, changed to what it is after the measurement.
        fits: (n,) Σ ν Hδ/s, added to.
        alike: (n, n) Σ Hδ (Hδ)ᵀ/s, added to.
    """
    m, n = deviation.shape
    own = np.zeros(n)
    for j in range(m):
        if row[j] != 0.0:
            for h in range(n):
                own[h] += row[j] * deviation[j, h]
    for j in range(m):
        for h in range(n):
            deviation[j, h] -= gain[j] * own[h]
    for h in range(n):
        fits[h] += off / variance * own[h]
        for g in range(n):
            alike[h, g] += own[h] * own[g] / variance


@njit(cache=True, nogil=True, error_model="numpy")
def unlikely(fits: Array, alike: Array, choice: NDArray[np.int64], count: int) -> float:
    """Σ ν_h²/s of a hypothesis beyond that of the filter that is run.

    Args:
        fits: (na count,) see ``seen``.
        alike: (na count, na count) see ``seen``.
        choice: (na,) the hypothesis of each actuator.
        count: of hypotheses of one actuator.
    """
    found = 0.0
    for i in range(len(choice)):
        a = i * count + choice[i]
        found -= 2 * fits[a]
        for j in range(len(choice)):
            found += alike[a, j * count + choice[j]]
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def improved(total: float, fits: Array, alike: Array, choice: NDArray[np.int64], count: int) -> float:
    """Change one actuator's hypothesis at a time until none is likelier; Σ ν_h²/s of what ``choice`` is then.

    Args:
        total: Σ ν²/s of the filter that is run.
        fits: (na count,) see ``seen``.
        alike: (na count, na count) see ``seen``.
        choice: (na,) where to begin, changed.
        count: of hypotheses of one actuator.
    """
    cost = total + unlikely(fits, alike, choice, count)
    while True:
        before = cost
        for i in range(len(choice)):
            best, least = 0, np.inf
            for h in range(count):
                a = i * count + h
                own = alike[a, a] - 2 * fits[a]
                for j in range(len(choice)):
                    if j != i:
                        own += 2 * alike[a, j * count + choice[j]]
                if own < least:
                    best, least = h, own
            choice[i] = best
        cost = total + unlikely(fits, alike, choice, count)
        if cost >= before - 1e-9 * abs(before):
            return cost


@njit(cache=True, nogil=True, error_model="numpy")
def alike_for_all(fits: Array, alike: Array, na: int, count: int) -> int:
    """The likeliest hypothesis of those that are the same for all actuators.

    Args:
        fits: (na count,) see ``seen``.
        alike: (na count, na count) see ``seen``.
        na: actuators.
        count: of hypotheses of one actuator.
    """
    best, least = 0, np.inf
    own = np.zeros(na, dtype=np.int64)
    for h in range(count):
        own[:] = h
        cost = unlikely(fits, alike, own, count)
        if cost < least:
            best, least = h, cost
    return best
