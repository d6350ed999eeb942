"""The laws of what happens between a command and the pressure in an actuator, as compiled functions.

They stand here once and are called by every engine, one physics step at a time.
"""

from __future__ import annotations

import math

from numba import njit

from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def mean_command(
    times: Array, values: Array, before: float, cursor: int, start: float, end: float
) -> tuple[float, int]:
    """Mean of a zero-order-held command over [start, end], so that a change within a step counts by its share.

    Args:
        times: (n,) ascending instants from which each value holds [s].
        values: (n,) commands [Pa].
        before: the command in force before times[0] [Pa].
        cursor: index of the last instant at or before ``start``, or anything not above it; −1 for none.
        start: [s].
        end: [s], after ``start``.

    Returns:
        (mean [Pa], the cursor to hand in next).
    """
    n = len(times)
    while cursor + 1 < n and times[cursor + 1] <= start:
        cursor += 1
    value = values[cursor] if cursor >= 0 else before
    total, at, k = 0.0, start, cursor
    while k + 1 < n and times[k + 1] < end:
        total += value * (times[k + 1] - at)
        at = times[k + 1]
        k += 1
        value = values[k]
    if at == start:
        return value, cursor
    return (total + value * (end - at)) / (end - start), cursor


@njit(cache=True, nogil=True, error_model="numpy")
def lag(pressure: float, target: float, fill: float, vent: float, dt: float) -> tuple[float, float]:
    """dP/dt = (target − P)/τ with τ = fill [s] where the pressure rises and vent [s] where it falls, exact over dt.

    Returns:
        (pressure after dt, its mean over dt) [Pa]; a step driven by the mean is second-order accurate.
    """
    tau = fill if target > pressure else vent
    if tau <= 0.0:
        return target, target
    share = dt / tau
    decay = math.exp(-share)
    return target + (pressure - target) * decay, target + (pressure - target) * (1.0 - decay) / share
