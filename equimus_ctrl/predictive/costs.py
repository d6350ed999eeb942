"""What a plan costs: errors and efforts over its horizon, and what its last state costs from there on.

Σ ½ hₖ (|qₖ − q*ₖ|²/α² + |vₖ − v*ₖ|²/β² + |uₖ − u*ₖ|²/ρ² + (‖qₖ beyond its range‖/λ)²)  +  ½ |L (x_N − x*_N)|²
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.types import Array


@dataclass(frozen=True)
class Weights:
    """What errors and efforts cost: as much as each other where both are as large as their acceptable deviation.

    One number for all joints or actuators, or one for each.

    Attributes:
        angle: α [rad].
        rate: β [rad/s].
        pressure: ρ [Pa], or in the commands' unit.
        limit: λ, of angles beyond a joint's range [rad].
    """

    angle: float | Array
    rate: float | Array
    pressure: float | Array
    limit: float | Array


@dataclass(frozen=True, eq=False)
class Wanted:
    """Where the robot is to be along the horizon.

    Attributes:
        states: (n + 1, 2 nj + na) angles [rad], velocities [rad/s] and pressures behind the valves [Pa].
        feed: (n, na) what is to reach the valves meanwhile [Pa].
        last: (nx, nx) L.
    """

    states: Array
    feed: Array
    last: Array


def costs(weights: Weights, durations: Array, angles: Array, wanted: Wanted, states: Array, inputs: Array) -> Array:
    """(m,) what plans cost that all begin in the same state; the law stands above.

    The first state, which no plan can change, does not count, and neither does what the last one would over an
    interval of its own, except its range.

    Args:
        weights: of errors and efforts.
        durations: (n,) of the intervals [s].
        angles: (2, nj) range of the joints [rad].
        wanted: where the robot is to be.
        states: (m, n + 1, k) with the angles, velocities and pressures first.
        inputs: (m, n, na) what reaches the valves [Pa].
    """
    nj, k = angles.shape[1], min(states.shape[2], wanted.states.shape[1])
    off = states[:, 1:, :k] - wanted.states[1:, :k]
    scale = np.concatenate([np.broadcast_to(x, nj) for x in (weights.angle, weights.rate)])
    span = np.sqrt(durations[1:, None])
    q = states[:, 1:, :nj]
    beyond = (q - np.minimum(np.maximum(q, angles[0]), angles[1])) / weights.limit
    own = np.append(durations[1:], durations[-1])
    parts = (
        off[:, :-1, : 2 * nj] * (span / scale),
        (inputs - wanted.feed) * (np.sqrt(durations)[:, None] / weights.pressure),
        beyond * np.sqrt(own)[:, None],
        off[:, -1] @ wanted.last[:, :k].T,
    )
    return np.asarray(sum(0.5 * (part.reshape(len(states), -1) ** 2).sum(axis=1) for part in parts))
