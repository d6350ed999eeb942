"""Motions of the leg: step responses in swing, and the leg on its pinned foot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.computer import Workers
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array
from equimus_ctrl.validation.engines import Progress, mujoco_runs, native_runs, reduced_runs, silent
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.plan import Errors, Plan
from equimus_ctrl.validation.poses import holding_pressure, workspace
from equimus_ctrl.validation.reference import SHORTEST, own_error, reference_runs, shortest

NEAR = 0.02
"""Runs that an engine brings this near to a stop are integrated separately; a guess that costs no accuracy [rad]."""

PUBLISHED_FORCE = 10.0
"""Of each actuator in the published stance run [N]."""


@dataclass(frozen=True, eq=False)
class Responses:
    """Runs by the reference and by engines.

    Attributes:
        experiment: the runs.
        exact: (n, m, nj) the reference [rad].
        found: engine → (n, m, nj) [rad].
        scored: (n,) runs that count.
        touching: (n,) runs that touch a stop.
        reference_error: the reference's own, the largest found on some of the runs [rad].
        counts: what became of the runs drawn.
    """

    experiment: Experiment
    exact: Array
    found: dict[str, Array]
    scored: NDArray[np.bool_]
    touching: NDArray[np.bool_]
    reference_error: float
    counts: dict[str, int] = field(default_factory=dict)

    def error(self, engine: str) -> Array:
        """(k, m − 1, nj) of the scored runs, without the common start [rad]."""
        return self.found[engine][self.scored, 1:] - self.exact[self.scored, 1:]

    def errors(self, engine: str) -> Errors:
        """Over all scored runs."""
        return Errors.of(self.error(engine))

    @property
    def clear(self) -> NDArray[np.bool_]:
        """(n,) scored runs that touch no stop."""
        return self.scored & ~self.touching

    def only(self, rows: NDArray[np.bool_]) -> Responses:
        """The same with fewer runs scored."""
        return replace(self, scored=self.scored & rows)

    def on_stops(self, engine: str) -> Errors | None:
        """Over the scored runs that touch a stop; None where there is none."""
        some = self.only(self.touching)
        return some.errors(engine) if some.scored.any() else None

    def to_dict(self) -> dict[str, Any]:
        """MuJoCo's errors, then every engine's; plain JSON types, SI units."""
        on_stops = {name: errors.to_dict() for name in self.found if (errors := self.on_stops(name))}
        return {
            **self.errors("mujoco").to_dict(),
            "engines": {name: self.errors(name).to_dict() for name in self.found},
            "on_stops": on_stops or None,
            "counts": self.counts,
            "duration_s": self.experiment.duration,
            "reference_error_rad": self.reference_error,
        }


def swing_case(
    morphology: Morphology,
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    threads: int | None = None,
    pool: Workers | None = None,
    progress: Progress = silent,
) -> Responses:
    """Step responses: from rest at one random pose, under the pressures that hold another.

    Omitted are pairs whose second pose needs pressures outside the command range, and runs in which an actuator
    becomes shorter than 3 cm.

    Args:
        morphology: the robot.
        plan: how many pairs, and for how long.
        rng: where poses come from.
        dt: step of the reduced engine [s].
        threads: at most.
        pool: processes for the reference; this one by default.
        progress: called with the share done.
    """
    low, high = workspace(morphology)
    start, target = rng.uniform(low, high, (2, plan.pairs, len(low)))
    pressure, left = holding_pressure(morphology, target)
    allowed = np.all((pressure >= morphology.command_low) & (pressure <= morphology.command_high), axis=1)
    allowed &= left < 1e-9
    runs = Experiment((morphology,), "swing", start, np.zeros(1), pressure[:, None], plan.duration).part(allowed)
    reduced = reduced_runs(runs, dt, threads)
    near = runs.touches(reduced, NEAR)
    exact = reference_runs(runs, near, lambda share: progress(0.7 * share), pool=pool)
    scored = shortest(runs, exact) >= SHORTEST
    touching = runs.touches(exact)
    found = {
        "mujoco": mujoco_runs(runs, threads=threads),
        "reduced": reduced,
    }
    progress(0.9, _worst(found["mujoco"], exact, scored))
    counts = {
        "pairs": plan.pairs,
        "pressure_out_of_range": int((~allowed).sum()),
        "actuator_too_short": int((~scored).sum()),
        "scored": int(scored.sum()),
        "touching_a_stop": int((scored & touching).sum()),
    }
    checked = own_error(runs, exact, _some(scored, touching, plan.checked), near, pool)
    progress(1.0)
    return Responses(runs, exact, found, scored, touching, checked, counts)


def native_swing(result: Responses, count: int, threads: int | None = None) -> tuple[Errors, Array]:
    """The baseline on the first ``count`` scored runs that touch no stop: errors, and (k, m − 1, nj) themselves [rad].

    Its steps do not resolve a stop's force.
    """
    rows = np.flatnonzero(result.clear)[:count]
    error = native_runs(result.experiment.part(rows), threads=threads)[:, 1:] - result.exact[rows, 1:]
    return Errors.of(error), error


@dataclass(frozen=True, eq=False)
class StanceResult:
    """The leg on its pinned foot, the published start and pressures first.

    Attributes:
        robot: as it is.
        free: with joints without stops, as the published equations are.
    """

    robot: Responses
    free: Responses

    @property
    def errors(self) -> Errors:
        """MuJoCo's over all runs of the robot as it is."""
        return self.robot.errors("mujoco")

    def published(self, *, stops: bool = True) -> Responses:
        """The published run alone, of the robot as it is or without its stops."""
        case = self.robot if stops else self.free
        alone = case.only(np.arange(case.experiment.size) == 0)
        return replace(alone, counts={"runs": 1, "scored": int(alone.scored.sum())})

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {
            **self.robot.to_dict(),
            "published_run": self.published().to_dict(),
            "without_stops": {**self.free.to_dict(), "published_run": self.published(stops=False).to_dict()},
        }


def stance_case(
    morphology: Morphology,
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    threads: int | None = None,
    pool: Workers | None = None,
    progress: Progress = silent,
) -> StanceResult:
    """Runs on the pinned foot: the published one first, then random starts under random pressures.

    Nothing holds the base, so nearly every run falls into a stop. All are run once more with joints that turn freely.

    Args: as of ``swing_case``.
    """
    low, high = workspace(morphology)
    nj, na = len(low), len(morphology.actuators)
    start = rng.uniform(low, high, (plan.stance_runs, nj))
    pressure = rng.uniform(morphology.command_low, morphology.command_high, (plan.stance_runs, na))
    start[0], pressure[0] = published_stance(morphology)
    robot = Experiment((morphology,), "stance", start, np.zeros(1), pressure[:, None], plan.duration)
    free = _stance_runs(robot.without_stops(), plan, dt, threads, pool, lambda share, error=None: progress(0.3 * share))
    own = _stance_runs(robot, plan, dt, threads, pool, lambda share, error=None: progress(0.3 + 0.7 * share, error))
    return StanceResult(own, free)


def _stance_runs(
    runs: Experiment, plan: Plan, dt: float, threads: int | None, pool: Workers | None, progress: Progress
) -> Responses:
    found = {"mujoco": mujoco_runs(runs, threads=threads)}
    if plan.more_kernels:
        found["reduced"] = reduced_runs(runs, dt, threads)
    progress(0.1)
    near = runs.touches(found["mujoco"], NEAR)
    exact = reference_runs(runs, near, lambda share: progress(0.1 + 0.7 * share), pool=pool)
    scored = shortest(runs, exact) >= SHORTEST
    touching = runs.touches(exact)
    progress(0.8, _worst(found["mujoco"], exact, scored))
    counts = {
        "runs": runs.size,
        "actuator_too_short": int((~scored).sum()),
        "scored": int(scored.sum()),
        "touching_a_stop": int((scored & touching).sum()),
    }
    checked = own_error(runs, exact, _some(scored, touching, plan.checked), near, pool)
    progress(1.0)
    return Responses(runs, exact, found, scored, touching, checked, counts)


def _some(scored: NDArray[np.bool_], touching: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """The first scored runs, and the first that touch a stop, up to ``count`` of each kind."""
    return np.concatenate([np.flatnonzero(scored & kind)[:count] for kind in (~touching, touching)])


def published_stance(morphology: Morphology) -> tuple[Array, Array]:
    """(nj,) start [rad] and (na,) pressures [Pa] of the published run: straight up, 10 N in every actuator.

    A robot that has no such pose within its stops starts in the middle of its workspace; pressures stay in range.
    """
    low, high = morphology.joint_range
    middle = sum(workspace(morphology)) / 2
    straight = np.zeros(len(low))
    straight[0] = math.pi / 2
    inside = bool(np.all((straight >= low) & (straight <= high)))
    area = np.array([a.area for a in morphology.actuators])
    pressure = np.clip(PUBLISHED_FORCE / area, morphology.command_low, morphology.command_high)
    return (straight if inside else np.asarray(middle)), pressure


def _worst(q: Array, exact: Array, rows: NDArray[np.bool_]) -> float | None:
    """The larger RMSE of the joints over some runs [rad]."""
    return float(Errors.of(q[rows, 1:] - exact[rows, 1:]).rmse.max()) if rows.any() else None
