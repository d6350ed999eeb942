"""Dry friction of the lanes, at velocity level.

Dry friction is held over each step and corrected at its end by the impulses that velocity-level Coulomb friction asks
for: a box-constrained complementarity problem, solved by active sets from the last step's friction, and by projected
Gauss–Seidel where these do not settle. While something slides the held friction is exact and the method keeps its
order; where it sticks, velocities are zero to rounding and angles do not drift. Where it turns within a step, the
correction counts from the instant of the turn, so that a turn costs an error of the step squared.
"""

from __future__ import annotations

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
    Layout,
    bare,
    copy_rows,
    fill_row,
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


@bare
def sweep(robot: Layout, w: Array, rubbing: Array) -> None:
    """Find the friction of one row after another, in lanes where it is sought still (projected Gauss–Seidel).

    Args:
        robot: see ``lane_functions``.
        w: work array.
        rubbing: rows where any lane has dry friction.
    """
    n, worst, change, sought = robot[N_ROWS], robot[ROW_WORST], robot[ROW_RATE], robot[ROW_SOUGHT]
    delassus, bounds, phi = robot[ROW_DELASSUS], robot[ROW_BOUND], robot[ROW_PHI]
    spans, slip = robot[ROW_SPAN], robot[ROW_SLIP]
    fill_row(w, worst, 0.0)
    for r in rubbing:
        own = (delassus + r * (n + 1)) * LANES
        for l in range(LANES):  # noqa: E741
            bound = w[(bounds + r) * LANES + l]
            old = w[(phi + r) * LANES + l]
            # An actuator without a lever arm cannot rub.
            span = w[(spans + r) * LANES + l]
            correction = w[(slip + r) * LANES + l] / (w[own + l] * span) if w[own + l] > 0.0 else 0.0
            new = min(max(old - correction, -bound), bound) if w[sought * LANES + l] > 0.0 else old
            w[(phi + r) * LANES + l] = new
            w[change * LANES + l] = (new - old) * span
            w[worst * LANES + l] = max(w[worst * LANES + l], abs(new - old) * span * w[own + l])
        for s in rubbing:
            for l in range(LANES):  # noqa: E741
                w[(slip + s) * LANES + l] += w[(delassus + s + r * n) * LANES + l] * w[change * LANES + l]
    for l in range(LANES):  # noqa: E741
        w[sought * LANES + l] = 1.0 if w[worst * LANES + l] > RESIDUAL else 0.0


@bare
def sought_in_any(robot: Layout, w: Array) -> bool:
    """Whether friction is sought in any lane."""
    left = 0.0
    for l in range(LANES):  # noqa: E741
        left += w[robot[ROW_SOUGHT] * LANES + l]
    return left > 0.0


@bare
def find_at_once(robot: Layout, w: Array) -> bool:
    """Find the friction of all rows at once, see ``models.sticking``; what goes on changing is left to ``sweep``.

    Returns:
        Whether it is found in all lanes.
    """
    for row in range(robot[N_ROWS]):
        fill_row(w, robot[ROW_SIDE] + row, NO_SIDE)
    for _ in range(MOST_SOLUTIONS):
        lane_sides(robot, w)
        if not sought_in_any(robot, w):
            return True
        lane_hold(robot, w)
    return False


@bare
def correct_friction(robot: Layout, w: Array, dt: float, rubbing: Array) -> None:
    """Find the friction that the step's end asks for, and change angles and velocities by what is new in it.

    Each lane stops when its own friction is found, whatever the others do.

    Args:
        robot: see ``lane_functions``.
        w: work array.
        dt: [s].
        rubbing: rows where any lane has dry friction.
    """
    fill_row(w, robot[ROW_DT], dt)
    fill_row(w, robot[ROW_SOUGHT], 1.0)
    lane_friction(robot, w)
    copy_rows(w, robot[ROW_PHI], robot[ROW_SUM], robot[N_ROWS])
    if not find_at_once(robot, w):
        for _ in range(MOST_SWEEPS):
            sweep(robot, w, rubbing)
            if not sought_in_any(robot, w):
                break
    lane_rub(robot, w)
