"""How a run is judged: against its reference, and against what the real robot did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, PlantSpec, Run


@dataclass(frozen=True, eq=False)
class ErrorFigures:
    """Root mean square, mean absolute and largest error of each joint.

    Attributes:
        rmse: (nj,) [rad or m].
        mae: (nj,) [rad or m].
        largest: (nj,) [rad or m].
    """

    rmse: Array
    mae: Array
    largest: Array

    @classmethod
    def of(cls, error: Array) -> ErrorFigures:
        """Figures of (n, nj) errors [rad or m]."""
        return cls(np.sqrt((error**2).mean(axis=0)), np.abs(error).mean(axis=0), np.abs(error).max(axis=0))


SMALLEST_STEP = 1e-2
"""Step of a reference of which more is told than what is left of it [rad or m]."""
SETTLED = 0.02
"""Share of a step within which a joint has settled (Åström & Murray, *Feedback Systems*, chapter 6)."""
LAST = 0.1
"""Share of the time after a step, its last, over which what is left is averaged."""


@dataclass(frozen=True, eq=False)
class StepFigures:
    """How joints answer a step of the reference; nan where one does not step, or does not get there.

    Attributes:
        size: (nj,) from where each was to where it is to be [rad or m].
        rise: (nj,) time from a tenth of the step to nine tenths [s].
        overshoot: (nj,) beyond the step, as a share of it.
        settling: (nj,) time after which it stays within ``SETTLED`` of the step [s].
        offset: (nj,) mean of what is left at the end, position less reference [rad or m].
    """

    size: Array
    rise: Array
    overshoot: Array
    settling: Array
    offset: Array

    @classmethod
    def of(cls, time: Array, position: Array, first: Array, target: Array) -> StepFigures:
        """Of a joint's answer.

        Args:
            time: (n,) since the step [s].
            position: (n, nj) of the joints [rad or m].
            first: (nj,) from where they step.
            target: (nj,) where they are to be.
        """
        size, nj = target - first, position.shape[1]
        rise, overshoot, settling = np.full((3, nj), np.nan)
        for j in np.flatnonzero(np.abs(size) >= SMALLEST_STEP):
            share = (position[:, j] - first[j]) / size[j]
            low, high = (int(np.argmax(share >= level)) for level in (0.1, 0.9))
            if share.max() >= 0.9:
                rise[j] = time[high] - time[low]
            overshoot[j] = max(float(share.max()) - 1.0, 0.0)
            outside = np.flatnonzero(np.abs(share - 1.0) > SETTLED)
            if len(outside) == 0 or outside[-1] < len(time) - 1:
                settling[j] = time[outside[-1] + 1] if len(outside) else 0.0
        last = time >= time[-1] - LAST * (time[-1] - time[0])
        return cls(size, rise, overshoot, settling, (position[last] - target).mean(axis=0))


STAYING = 1.0
"""How long a robot has to have been in a pose at the end of a run that is to bring it there [s]."""


@dataclass(frozen=True, eq=False)
class ArrivalFigures:
    """Whether a robot came to a pose, and stayed.

    Attributes:
        near: (nj,) how near each joint had to come [rad or m].
        time: from when on all joints stayed that near, for ``STAYING`` at least [s]; nan where they did not.
        left: (nj,) the largest distance of each joint over the last ``STAYING`` [rad or m].
    """

    near: Array
    time: float
    left: Array

    @property
    def arrived(self) -> bool:
        """Whether it did."""
        return not np.isnan(self.time)

    @classmethod
    def of(cls, time: Array, off: Array, near: Array) -> ArrivalFigures:
        """Of a run.

        Args:
            time: (n,) since it began [s].
            off: (n, nj) from the pose [rad or m].
            near: (nj,) how near is there [rad or m].
        """
        outside = np.flatnonzero((np.abs(off) > near).any(axis=1))
        first = outside[-1] + 1 if len(outside) else 0
        stays = first < len(time) and time[-1] - time[first] >= STAYING - 1e-9
        last = time >= time[-1] - STAYING
        return cls(near, float(time[first]) if stays else np.nan, np.abs(off[last]).max(axis=0))


def off_reference(position: Array, wanted: Array, spec: PlantSpec, scenario: Scenario) -> Array:
    """(n, nj) by how much positions are off; where a pose is to be reached, without whole turns of endless hinges."""
    off = position - wanted
    if scenario.arrival is None:
        return off
    endless = np.array([unit == "rad" for unit in spec.joint_units]) & ~np.isfinite(spec.joint_high - spec.joint_low)
    return np.where(endless, off - 2 * np.pi * np.round(off / (2 * np.pi)), off)


@dataclass(frozen=True, eq=False, repr=False)
class Score(Short):
    """Figures of one run.

    Attributes:
        tracking: measured against reference.
        recorded: simulated against recorded, or None without a recording.
        saturated: share of commands that were at a limit or had to be clipped.
        effort: (na,) root mean square command [Pa, or the unit of commands].
        solve_time: (median, 99th percentile) of the controller's step [s].
        window: (from, to) [s] that was scored.
        approach: measured against reference before the window; None where there is nothing before.
        step: of a reference that steps; of the true positions where they are known.
        arrival: at a pose that was to be reached; of the true positions where they are known.
        site: of the distance of a point of the robot from its path, (1,) each [m]; None where it has none.
    """

    tracking: ErrorFigures
    recorded: ErrorFigures | None
    saturated: float
    effort: Array
    solve_time: tuple[float, float]
    window: tuple[float, float]
    approach: ErrorFigures | None = None
    step: StepFigures | None = None
    arrival: ArrivalFigures | None = None
    site: ErrorFigures | None = None


def on_grid(time: Array, values: Array, grid: Array) -> Array:
    """(m, k) columns of ``values`` (n, k) interpolated linearly on ``grid`` (m,)."""
    return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)


def score_run(run: Run, scenario: Scenario) -> Score:
    """Score a run over the scenario's window, on its grid.

    Args:
        run: what happened.
        scenario: what was to be done.

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
    wanted = on_grid(run.time, run.reference, grid)
    tracking = ErrorFigures.of(off_reference(measured, wanted, run.spec, scenario))
    site = None
    if (path := scenario.site) is not None:
        off = np.linalg.norm(path.places(measured) - path.wanted_at(grid), axis=1)
        site = ErrorFigures.of(off[:, None])
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
        approach=_approach(run, float(grid[0])),
        step=_step(run, scenario.step_at),
        arrival=_arrival(run, scenario),
        site=site,
    )


def _approach(run: Run, begins: float) -> ErrorFigures | None:
    before = run.time < begins - run.spec.control_dt / 2
    return ErrorFigures.of((run.position - run.reference)[before]) if before.any() else None


def _arrival(run: Run, scenario: Scenario) -> ArrivalFigures | None:
    if scenario.arrival is None:
        return None
    seen = run.position if run.truth is None else run.truth
    off = off_reference(seen, run.reference, run.spec, scenario)
    return ArrivalFigures.of(run.time, off, scenario.arrival.near(run.spec.joint_units))


def _step(run: Run, begins: float | None) -> StepFigures | None:
    if begins is None:
        return None
    after = run.time >= begins - run.spec.control_dt / 2
    if after.sum() < 2:
        return None
    seen = run.position if run.truth is None else run.truth
    first = seen[0] if after.all() else run.reference[~after][-1]
    return StepFigures.of(run.time[after] - run.time[after][0], seen[after], first, run.reference[-1])
