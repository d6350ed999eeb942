"""How a run is judged: against its reference, and against what the real robot did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.types import Array, Run


@dataclass(frozen=True, eq=False)
class ErrorFigures:
    """Root mean square, mean absolute and largest error of each joint.

    Attributes:
        rmse: (nj,) [rad].
        mae: (nj,) [rad].
        largest: (nj,) [rad].
    """

    rmse: Array
    mae: Array
    largest: Array

    @classmethod
    def of(cls, error: Array) -> ErrorFigures:
        """Figures of (n, nj) errors [rad]."""
        return cls(np.sqrt((error**2).mean(axis=0)), np.abs(error).mean(axis=0), np.abs(error).max(axis=0))


@dataclass(frozen=True, eq=False)
class Score:
    """Figures of one run.

    Attributes:
        tracking: measured against reference.
        recorded: simulated against recorded, or None without a recording.
        saturated: share of commands that were at a limit or had to be clipped.
        effort: (na,) root mean square command [Pa].
        solve_time: (median, 99th percentile) of the controller's step [s].
        window: (from, to) [s] that was scored.
    """

    tracking: ErrorFigures
    recorded: ErrorFigures | None
    saturated: float
    effort: Array
    solve_time: tuple[float, float]
    window: tuple[float, float]


def on_grid(time: Array, values: Array, grid: Array) -> Array:
    """(m, k) columns of ``values`` (n, k) interpolated linearly on ``grid`` (m,)."""
    return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)


def score_run(run: Run, scenario: Scenario) -> Score:
    """Score a run over the scenario's window, on its grid.

    Raises:
        ConfigError: where the window holds no sample.
    """
    low, high = scenario.score_window or (0.0, scenario.duration)
    if scenario.recorded is not None:
        recorded_time = scenario.recorded.time
        high = min(high, float(recorded_time[-1])) if scenario.score_window else high
    high = min(high, float(run.time[-1]))
    grid = low + np.arange(int(np.floor((high - low) * scenario.score_rate + 1e-9)) + 1) / scenario.score_rate
    if len(grid) < 2:
        raise ConfigError(f"scenario {scenario.name}: the scored window {low:g} to {high:g} s holds no samples")
    measured = on_grid(run.time, run.position, grid)
    tracking = ErrorFigures.of(measured - on_grid(run.time, run.reference, grid))
    recorded = None
    if scenario.recorded is not None:
        shown = grid[(grid >= recorded_time[0]) & (grid <= recorded_time[-1])]
        if len(shown) == 0:
            raise ConfigError(
                f"scenario {scenario.name}: the recording lasts from {recorded_time[0]:g} to {recorded_time[-1]:g} s, "
                f"outside what is scored, {grid[0]:g} to {grid[-1]:g} s"
            )
        difference = on_grid(run.time, run.position, shown) - on_grid(recorded_time, scenario.recorded.position, shown)
        recorded = ErrorFigures.of(difference)
    at_limit = run.clipped | (run.command <= run.spec.command_low) | (run.command >= run.spec.command_high)
    return Score(
        tracking=tracking,
        recorded=recorded,
        saturated=float(at_limit.mean()),
        effort=np.sqrt((run.command**2).mean(axis=0)),
        solve_time=(float(np.median(run.solve_time)), float(np.quantile(run.solve_time, 0.99))),
        window=(float(grid[0]), float(grid[-1])),
    )
