"""Dry friction of the lanes, at velocity level.

Dry friction is held over each step and corrected at its end by the impulses that velocity-level Coulomb friction asks
for: a box-constrained complementarity problem, solved by active sets from the last step's friction, and by projected
Gauss–Seidel where these do not settle. While something slides the held friction is exact and the method keeps its
order; where it sticks, velocities are zero to rounding and angles do not drift. Where it turns within a step, the
correction counts from the instant of the turn, so that a turn costs an error of the step squared.
"""

from __future__ import annotations

from numba import njit

from equimus_ctrl.engines.lane_functions import (
    LANES,
    N_ROWS,
    ROW_BOUND,
    ROW_DELASSUS,
    ROW_DT,
    ROW_PHI,
    ROW_RATE,
    ROW_SIDE,
    ROW_SLIP,
    ROW_SOUGHT,
    ROW_SPAN,
    ROW_SUM,
    ROW_WORST,
    lane_friction,
    lane_hold,
    lane_rub,
    lane_sides,
)
from equimus_ctrl.types import Array

MOST_SWEEPS, MOST_SOLUTIONS = 100, 8
RESIDUAL = 1e-9
"""Rate [rad/s or m/s] below which friction is taken as found."""
NO_SIDE = 2.0
"""In ROW_SIDE before it is known."""


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(w: Array, rubbing: Array) -> None:
    """Find the friction of one row after another, in lanes where it is sought still (projected Gauss–Seidel).

    Args:
        w: work array.
        rubbing: rows where any lane has dry friction.
    """
    for l in range(LANES):  # noqa: E741
        w[ROW_WORST * LANES + l] = 0.0
    for r in rubbing:
        own = (ROW_DELASSUS + r * (N_ROWS + 1)) * LANES
        for l in range(LANES):  # noqa: E741
            bound = w[(ROW_BOUND + r) * LANES + l]
            old = w[(ROW_PHI + r) * LANES + l]
            # An actuator without a lever arm cannot rub.
            span = w[(ROW_SPAN + r) * LANES + l]
            correction = w[(ROW_SLIP + r) * LANES + l] / (w[own + l] * span) if w[own + l] > 0.0 else 0.0
            new = min(max(old - correction, -bound), bound) if w[ROW_SOUGHT * LANES + l] > 0.0 else old
            w[(ROW_PHI + r) * LANES + l] = new
            w[ROW_RATE * LANES + l] = (new - old) * span
            w[ROW_WORST * LANES + l] = max(w[ROW_WORST * LANES + l], abs(new - old) * span * w[own + l])
        for s in rubbing:
            for l in range(LANES):  # noqa: E741
                w[(ROW_SLIP + s) * LANES + l] += (
                    w[(ROW_DELASSUS + s + r * N_ROWS) * LANES + l] * w[ROW_RATE * LANES + l]
                )
    for l in range(LANES):  # noqa: E741
        w[ROW_SOUGHT * LANES + l] = 1.0 if w[ROW_WORST * LANES + l] > RESIDUAL else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def sought_in_any(w: Array) -> bool:
    """Whether friction is sought in any lane."""
    left = 0.0
    for l in range(LANES):  # noqa: E741
        left += w[ROW_SOUGHT * LANES + l]
    return left > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def find_at_once(w: Array) -> bool:
    """Find the friction of all rows at once, see ``models.sticking``; what goes on changing is left to ``sweep``.

    Returns:
        Whether it is found in all lanes.
    """
    for i in range(N_ROWS * LANES):
        w[ROW_SIDE * LANES + i] = NO_SIDE
    for _ in range(MOST_SOLUTIONS):
        lane_sides(w)
        if not sought_in_any(w):
            return True
        lane_hold(w)
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def correct_friction(w: Array, dt: float, rubbing: Array) -> None:
    """Find the friction that the step's end asks for, and change angles and velocities by what is new in it.

    Each lane stops when its own friction is found, whatever the others do.

    Args:
        w: work array.
        dt: [s].
        rubbing: rows where any lane has dry friction.
    """
    for l in range(LANES):  # noqa: E741
        w[ROW_DT * LANES + l] = dt
        w[ROW_SOUGHT * LANES + l] = 1.0
    lane_friction(w)
    for i in range(N_ROWS * LANES):
        w[ROW_SUM * LANES + i] = w[ROW_PHI * LANES + i]
    if not find_at_once(w):
        for _ in range(MOST_SWEEPS):
            sweep(w, rubbing)
            if not sought_in_any(w):
                break
    lane_rub(w)
