"""Where a robot rests under constant commands by its exact equations of motion, whatever it is described by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.robots.reading import shown
from equimus_ctrl.types import Array

AT_REST = 1e-9
"""Share of a torque, and of 1 N·m or N, that is none."""
LARGEST_STEP, STEPS = 0.3, 200
"""Of a search [rad or m], and how many at most; those after the first quarter are ever smaller, so that none goes on
between two sides of a kink."""
NUDGE = 1e-3
"""By which a pose is left in which a robot is balanced but does not stay [rad or m]."""
NEUTRAL = 1e-9
"""Share of the stiffest mode below which a mode has no stiffness."""


def equilibrium(dynamics: Dynamics, command: Array, near: Array) -> Array:
    """(nj,) a stable pose at rest under constant commands, within the joints' ranges, nothing held by dry friction.

    Solved is τ(q, 0, u) = h(q, 0) for free joints; one at an end of its range may be pressed against it. The search is
    Newton's along the modes of stiffness K and mass M, K x = w M x, each by |w| in the place of w: so it goes down the
    potential everywhere and leaves saddle points (saddle-free Newton method, Dauphin et al., NeurIPS 2014), by at most
    ``LARGEST_STEP``. A mode without stiffness, as of a carriage, stays where it is.

    Args:
        dynamics: of a robot with its effects.
        command: (na,) [unit of each actuator's command].
        near: (nj,) where the search begins [rad or m].

    Raises:
        ModelError: where no such pose is found.
    """
    low, high = dynamics.robot.joint_range
    still = np.zeros(len(near))
    q = np.clip(near, low, high)
    for k in range(STEPS):
        needed = dynamics.needed(q, still, still)
        push = dynamics.exerted(q, still, command) - needed  # (nj,) what accelerates the joints
        free = ~(((q <= low) & (push <= 0)) | ((q >= high) & (push >= 0)))
        if not free.any():
            return q
        rates, modes = _modes(dynamics, q, command, free)
        balanced = bool(np.all(np.abs(push[free]) <= AT_REST * np.maximum(1.0, np.abs(needed[free]))))
        if balanced and rates[0] >= -NEUTRAL * max(1.0, float(np.abs(rates).max())):
            return q
        if balanced:
            change = NUDGE * modes[:, 0] / np.abs(modes[:, 0]).max()
        else:
            along = modes.T @ push[free]
            change = modes @ (along / np.maximum(np.abs(rates), NEUTRAL * max(1.0, float(np.abs(rates).max()))))
            longest = LARGEST_STEP * min(1.0, STEPS / 4 / (k + 1))
            change *= min(1.0, longest / max(float(np.abs(change).max()), AT_REST**2))
        moved = q.copy()
        moved[free] += change
        q = np.clip(moved, low, high)
    units = dynamics.robot.command_units
    raise ModelError(f"{dynamics.robot.name}: rests in no pose under commands of {shown(command, units)}")


def _modes(dynamics: Dynamics, q: Array, command: Array, free: NDArray[np.bool_]) -> tuple[Array, Array]:
    """W (k,), the lowest first, and x (k, k) in columns of K x = w M x of the free joints."""
    own = np.ix_(free, free)
    linear = dynamics.linear(q, command)
    stiffness = linear.stiffness[own]
    rates, modes = eigh((stiffness + stiffness.T) / 2, linear.mass[own])
    return np.asarray(rates), np.asarray(modes)
