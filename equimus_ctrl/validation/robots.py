"""Random robots under pulses: both engines against the reference, robot by robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.computer import Workers
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array
from equimus_ctrl.validation.engines import Progress, finer, mujoco_runs, reduced_runs, silent
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.generator import REACH, SHAPES, hanging, pulsed_runs, random_robot
from equimus_ctrl.validation.plan import Errors, Plan
from equimus_ctrl.validation.reference import SHORTEST, own_error, reference_runs, shortest
from equimus_ctrl.validation.responses import Responses

MOST_ANGLE = 2.5
"""Runs in which a joint turns further from its start are omitted: a limb does not go through itself [rad]."""


@dataclass(frozen=True, eq=False)
class RobotErrors:
    """One random robot.

    Attributes:
        name: of the robot.
        shape: of ``generator.SHAPES``.
        step_factor: by how much MuJoCo's step is shorter than usual for it.
        engines: engine → errors over its scored runs.
    """

    name: str
    shape: str
    step_factor: int
    engines: dict[str, Errors]

    def worst(self, engine: str) -> float:
        """The largest of the joints' RMSE [rad]; NaN where no run is scored."""
        return float(self.engines[engine].rmse.max())


@dataclass(frozen=True, eq=False)
class RobotsResult:
    """Random robots.

    Attributes:
        robots: one entry each.
        responses: shape → its runs.
        counts: what became of the runs.
    """

    robots: tuple[RobotErrors, ...]
    responses: dict[str, Responses]
    counts: dict[str, int]

    @property
    def engines(self) -> tuple[str, ...]:
        """Which engines ran them."""
        return tuple(self.robots[0].engines)

    def worst(self, engine: str) -> float:
        """The largest RMSE of any joint of any robot [rad]."""
        return float(np.nanmax([robot.worst(engine) for robot in self.robots]))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {
            "worst_rmse_rad": self.worst("mujoco"),
            "engines": {name: {"worst_rmse_rad": self.worst(name)} for name in self.engines},
            "counts": self.counts,
            "reference_error_rad": max(r.reference_error for r in self.responses.values()),
            "robots": [
                {
                    "name": r.name,
                    "shape": r.shape,
                    "step_factor": r.step_factor,
                    **{k: e.to_dict() for k, e in r.engines.items()},
                }
                for r in self.robots
            ],
        }


def three_dof_case(
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    threads: int | None = None,
    pool: Workers | None = None,
    progress: Progress = silent,
) -> Responses:
    """Random robots of three joints under pulses, all runs together.

    Args:
        plan: how many robots and runs.
        rng: where they come from.
        dt: step of the reduced engine [s].
        threads: at most.
        pool: processes for the reference; this one by default.
        progress: called with the share done.
    """
    robots = tuple(random_robot("three_joints", rng, f"three_dof_{i}") for i in range(plan.three_dof_robots))
    runs = pulsed_runs(robots, plan.runs_per_robot, plan.robot_duration, rng)
    return _responses(runs, plan, dt, threads, pool, progress)


def robots_case(
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    shapes: Sequence[str] = tuple(SHAPES),
    threads: int | None = None,
    pool: Workers | None = None,
    ready: Callable[[str], None] = lambda shape: None,
    progress: Progress = silent,
) -> RobotsResult:
    """Random robots of every shape under pulses, each with errors of its own.

    Args: as of ``three_dof_case``; ``shapes`` are names of ``generator.SHAPES``, and ``ready`` returns when the reduced
        engine may run one of them.
    """
    found: list[RobotErrors] = []
    responses: dict[str, Responses] = {}
    counts: Counter[str] = Counter()
    for k, shape in enumerate(shapes):
        robots = tuple(random_robot(shape, rng, f"{shape}_{i}") for i in range(plan.robots_per_shape))
        runs = pulsed_runs(robots, plan.runs_per_robot, plan.robot_duration, rng)

        def part(share: float, error: float | None = None, k: int = k) -> None:
            worst = max((robot.worst("mujoco") for robot in found), default=None)
            progress((k + share) / len(shapes), worst)

        ready(shape)
        done = _responses(runs, plan, dt, threads, pool, part)
        responses[shape] = done
        counts.update(done.counts)
        for i, robot in enumerate(robots):
            rows = slice(i * plan.runs_per_robot, (i + 1) * plan.runs_per_robot)
            own = done.scored[rows]
            errors = {name: Errors.of(q[rows][own, 1:] - done.exact[rows][own, 1:]) for name, q in done.found.items()}
            found.append(RobotErrors(robot.name, shape, robot_factor(robot, FAST_SETTINGS.timestep), errors))
    return RobotsResult(tuple(found), responses, dict(counts))


def _responses(
    runs: Experiment, plan: Plan, dt: float, threads: int | None, pool: Workers | None, progress: Progress
) -> Responses:
    exact = reference_runs(runs, progress=lambda share: progress(0.6 * share), pool=pool)
    scored = (shortest(runs, exact) >= SHORTEST) & (_turned(exact) <= MOST_ANGLE)
    found = {"mujoco": _stepped(runs, FAST_SETTINGS.timestep, lambda r, k: mujoco_runs(r, finer(k), threads))}
    progress(0.8)
    if plan.more_kernels:
        found["reduced"] = _stepped(runs, dt, lambda r, k: reduced_runs(r, dt / k, threads))
    counts = {"runs": runs.size, "beyond_sense": int((~scored).sum()), "scored": int(scored.sum())}
    checked = own_error(runs, exact, np.flatnonzero(scored)[: plan.checked_robots], pool=pool)
    progress(1.0)
    return Responses(runs, exact, found, scored, runs.touches(exact), checked, counts)


def _stepped(runs: Experiment, dt: float, simulate: Callable[[Experiment, int], Array]) -> Array:
    """(n, m, nj) of all runs, each robot at the step that ``engines.steps.step_divisor`` finds for it."""
    factors = {m: robot_factor(m, dt) for m in dict.fromkeys(runs.morphologies)}
    own = np.array([factors[m] for m in runs.morphologies])
    out = np.empty((runs.size, len(runs.times), runs.start.shape[1]))
    for factor in np.unique(own):
        rows = np.flatnonzero(own == factor)
        out[rows] = simulate(runs.part(rows), int(factor))
    return out


def robot_factor(robot: Morphology, dt: float) -> int:
    """By how much the step dt [s] is divided for a random robot: it depends on the robot alone."""
    rng = np.random.default_rng(0)
    poses = hanging(robot) + rng.uniform(-REACH, REACH, (100, len(robot.joints)))
    return step_divisor(robot, "swing", list(poses), dt, stops=False)


def _turned(q: Array) -> Array:
    """(n,) how far any joint gets from its start [rad]; infinite where the run has NaN."""
    return np.asarray(np.nan_to_num(np.abs(q - q[:, :1]).max(axis=(1, 2)), nan=np.inf))
