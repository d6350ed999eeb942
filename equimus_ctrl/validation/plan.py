"""How much is validated, what is to be reached, and what was published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.types import Array

SAMPLE_RATE = 120.0
"""At which angles are compared [Hz]: that of the leg's motion capture."""

REDUCED_STEP = 4e-3
"""Step of the reduced engine [s], the longest whose swing error stays below its goal; see the front in the report."""

STAGES = ("static", "swing", "stance", "three_dof", "morphologies", "conservation", "baseline", "speed")


@dataclass(frozen=True)
class Plan:
    """How many runs of each kind.

    Attributes:
        poses: random poses that are to be held.
        pairs: random pairs of poses for step responses.
        duration: of a swing or stance run [s].
        stance_runs: starts and pressures in stance, the published one first.
        three_dof_robots: morphologies of three joints.
        robots_per_shape: random morphologies of each shape of ``generator.SHAPES``.
        runs_per_robot: starts and inputs of each.
        robot_duration: of those runs [s].
        more_kernels: whether the reduced engine runs in stance and on random robots too; each structure is one more
            kernel to compile, unless an earlier run has left it in the cache.
        conserving: length of the runs that should conserve something [s].
        checked: runs repeated at tighter tolerances to see the reference's own error.
        checked_robots: the same, of each shape of random robot.
        front: runs at every step of the front of accuracy and speed; none leaves the front out.
        timed: runs in a measurement of speed.
        timed_on_stops: the same of those that touch a stop.
        repeats: measurements of which the median is taken.
    """

    poses: int = 10_000
    pairs: int = 10_000
    duration: float = 3.0
    stance_runs: int = 80
    three_dof_robots: int = 10
    robots_per_shape: int = 4
    runs_per_robot: int = 6
    robot_duration: float = 3.0
    more_kernels: bool = True
    conserving: float = 20.0
    checked: int = 50
    checked_robots: int = 2
    front: int = 100
    timed: int = 500
    timed_on_stops: int = 50
    repeats: int = 5


QUICK = Plan(
    poses=200,
    pairs=500,
    stance_runs=10,
    three_dof_robots=3,
    runs_per_robot=2,
    robot_duration=1.0,
    more_kernels=False,
    conserving=5.0,
    checked=10,
    checked_robots=0,
    front=0,
    timed=100,
    timed_on_stops=10,
    repeats=3,
)


@dataclass(frozen=True)
class Published:
    """Errors of the published verification, per joint [rad]; Zhu et al., "EquiMus" (2025)."""

    rmse: tuple[float, ...]
    largest: tuple[float, ...] | None = None


PUBLISHED = {
    "static": Published((0.00096, 0.00574), (0.00369, 0.01452)),
    "swing": Published((0.00094, 0.00586), (0.00379, 0.01559)),
    "stance": Published((0.01693, 0.03000), (0.04673, 0.08805)),
    "three_dof": Published((0.0035, 0.0066, 0.0041)),
}
PUBLISHED_SPEED = 141.9
"""× real time."""
PUBLISHED_ON_THE_LEG = {"mujoco": 0.03253, "native": 0.43214}
"""RMSE of 13 step releases of the real leg, both joints together [rad]: 3-2-1 elements and massless actuators."""

ACCURACY_GOALS = {
    "static": 3e-5,
    "swing": 2e-4,
    "swing_on_stops": 2e-4,
    "stance": 5e-4,
    "stance_published": 5e-4,
    "stance_without_stops": 5e-4,
    "three_dof": 2e-4,
    "morphologies": 5e-4,
    "reduced_swing": 1e-4,
    "reduced_swing_on_stops": 1e-4,
    "reduced_stance": 5e-4,
}
"""RMSE of every joint at most this [rad]."""
SPEED_GOALS = {"mujoco_x_realtime": 500.0, "reduced_x_realtime": 10_000.0, "reduced_steps_per_s": 5e6}


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a set of runs.

    Attributes:
        rmse: (nj,) root mean square over all samples of all runs [rad].
        largest: (nj,) the greatest magnitude [rad].
        runs: how many runs.
    """

    rmse: Array
    largest: Array
    runs: int

    @classmethod
    def of(cls, error: Array) -> Errors:
        """Of errors (n, …, nj) [rad]; a run that diverged makes them infinite."""
        flat = np.abs(np.where(np.isfinite(error), error, np.inf).reshape(-1, error.shape[-1]))
        if len(flat) == 0:
            return cls(np.full(error.shape[-1], np.nan), np.full(error.shape[-1], np.nan), 0)
        with np.errstate(over="ignore"):
            return cls(np.sqrt((flat**2).mean(axis=0)), flat.max(axis=0), len(error))

    def to_dict(self) -> dict[str, object]:
        """Plain JSON types, SI units."""
        return {"rmse_rad": self.rmse.tolist(), "max_abs_rad": self.largest.tolist(), "runs": self.runs}
