"""The law of ``types.FeedbackLaw`` as a compiled function, which controllers and simulations of closed loops call."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from equimus_ctrl.types import Array

ERROR, RATE = 0, 1
"""Of each joint what the law remembers: the error of tracking [rad or m], and its filtered rate [the same in 1 s]."""


def nothing_remembered(joints: int) -> Array:
    """(2, nj) what the law remembers before its first command."""
    return np.full((2, joints), np.nan)


@njit(cache=True, nogil=True, error_model="numpy")
def tracking_command(
    reference: Array,
    measured: Array,
    feed: Array,
    stiffness: Array,
    damping: Array,
    smoothing: float,
    period: float,
    memory: Array,
    out: Array,
) -> None:
    """One command, not yet clipped.

    Args:
        reference: (nj,) r_k [rad or m].
        measured: (nj,) y_k.
        feed: (na,) f_k [unit of each command].
        stiffness: (na, nj) K.
        damping: (na, nj) D.
        smoothing: T [s].
        period: h [s].
        memory: (2, nj) see ``ERROR``, replaced by that for the next command.
        out: (na,) written.
    """
    for j in range(len(reference)):
        error = reference[j] - measured[j]
        if math.isnan(memory[ERROR, j]):
            memory[RATE, j] = 0.0
        else:
            rate = (error - memory[ERROR, j]) / period
            memory[RATE, j] += period / (smoothing + period) * (rate - memory[RATE, j])
        memory[ERROR, j] = error
    for i in range(len(feed)):
        out[i] = feed[i]
        for j in range(len(reference)):
            out[i] += stiffness[i, j] * memory[ERROR, j] + damping[i, j] * memory[RATE, j]
