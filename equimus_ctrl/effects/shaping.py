"""The laws that act on a command's value at once, before valves, as compiled functions, see ``effects.command``."""

from __future__ import annotations

import numpy as np
from numba import njit

from equimus_ctrl.types import Array

DEAD_ZONE, COUPLING, SATURATION, CUTOFF = 0, 1, 2, 3
"""The laws that act on a command's value at once, in the order in which they do."""


@njit(cache=True, nogil=True, error_model="numpy")
def shaped(law: int, own: float, others: float, number: float) -> float:
    """An actuator's command after shaping [Pa].

    Args:
        law: DEAD_ZONE: max(u − number, 0); COUPLING: max(u − number·others, 0); SATURATION: min(u, number);
            ``CUTOFF``: u where it is at least number, else 0.
        own: u [Pa].
        others: sum of the other actuators' commands [Pa].
        number: threshold [Pa], share, level or least command [Pa].
    """
    if law == DEAD_ZONE:
        return max(own - number, 0.0)
    if law == COUPLING:
        return max(own - number * others, 0.0)
    if law == SATURATION:
        return min(own, number)
    return own if own >= number else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def shape_column(law: int, commands: Array, own: int, number: float, out: Array) -> None:
    """Write ``shaped`` of column ``own`` of commands (n, na) into out (n,) [Pa]."""
    for k in range(len(commands)):
        total = 0.0
        for i in range(commands.shape[1]):
            total += commands[k, i]
        out[k] = shaped(law, commands[k, own], total - commands[k, own], number)


@njit(cache=True, nogil=True, error_model="numpy")
def shape_command(laws: Array, command: Array, out: Array) -> None:
    """Write what reaches the valves of a command.

    Args:
        laws: (m, 3) law, actuator and number, in the order of the laws; those of one kind act side by side.
        command: (na,) [Pa].
        out: (na,) written [Pa].
    """
    given = np.empty(len(command))
    for i in range(len(command)):
        out[i] = command[i]
    for k in range(len(laws)):
        if k == 0 or laws[k, 0] > laws[k - 1, 0]:
            total = 0.0
            for i in range(len(command)):
                given[i] = out[i]
                total += out[i]
        own = int(laws[k, 1])
        out[own] = shaped(int(laws[k, 0]), given[own], total - given[own], laws[k, 2])
