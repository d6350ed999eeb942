"""Motions of the leg: step responses in swing, and the leg on its pinned foot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.models.morphology import Morphology
from equimus_ctrl.types import Array
from equimus_ctrl.validation.engines import Progress, finer, mujoco_runs, native_runs, reduced_runs, silent
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.plan import Errors, Plan
from equimus_ctrl.validation.poses import holding_pressure, workspace
from equimus_ctrl.validation.reference import SHORTEST, own_error, reference_runs, shortest

NEAR = 0.02
"""Runs that an engine brings this near to a stop are integrated apart; a guess that costs no accuracy [rad]."""

PUBLISHED_FORCE = 10.0
"""Of each actuator in the published stance run [N]."""

FINE = 10
"""How many times finer MuJoCo's steps are in the second row of runs that touch a stop."""


@dataclass(frozen=True, eq=False)
class Responses:
    """Runs by the reference and by engines.

    Attributes:
        experiment: the runs.
        exact: (n, m, nj) the reference [rad].
        found: engine → (n, m, nj) [rad].
        scored: (n,) runs that count.
        reference_error: the reference's own, the largest found on some of the runs [rad].
        counts: what became of the runs drawn.
    """

    experiment: Experiment
    exact: Array
    found: dict[str, Array]
    scored: NDArray[np.bool_]
    reference_error: float
    counts: dict[str, int] = field(default_factory=dict)

    def error(self, engine: str) -> Array:
        """(k, m − 1, nj) of the scored runs, without the common start [rad]."""
        return self.found[engine][self.scored, 1:] - self.exact[self.scored, 1:]

    def errors(self, engine: str) -> Errors:
        """Over all scored runs."""
        return Errors.of(self.error(engine))

    def to_dict(self) -> dict[str, Any]:
        """MuJoCo's errors, then every engine's; plain JSON types, SI units."""
        return {
            **self.errors("mujoco").to_dict(),
            "engines": {name: self.errors(name).to_dict() for name in self.found},
            "counts": self.counts,
            "duration_s": self.experiment.duration,
            "reference_error_rad": self.reference_error,
        }


@dataclass(frozen=True, eq=False)
class OnStops:
    """The same kind of runs where a joint touches a stop: engine → errors."""

    errors: dict[str, Errors]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {name: errors.to_dict() for name, errors in self.errors.items()}


def swing_case(
    morphology: Morphology,
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> tuple[Responses, OnStops | None]:
    """Step responses: from rest at one random pose, under the pressures that hold another.

    Left out are pairs whose second pose needs pressures outside the command range, and runs in which an actuator
    becomes shorter than 3 cm. Runs that touch a stop are returned apart.

    Args:
        morphology: the robot.
        plan: how many pairs, and for how long.
        rng: where poses come from.
        dt: step of the reduced engine [s].
        threads: at most.
        progress: called with the share done.
    """
    low, high = workspace(morphology)
    start, target = rng.uniform(low, high, (2, plan.pairs, len(low)))
    pressure, left = holding_pressure(morphology, target)
    allowed = np.all((pressure >= morphology.command_low) & (pressure <= morphology.command_high), axis=1)
    allowed &= left < 1e-9
    runs = Experiment((morphology,), "swing", start, np.zeros(1), pressure[:, None], plan.duration).part(allowed)
    reduced = reduced_runs(runs, dt, threads)
    exact = reference_runs(runs, runs.touches(reduced, NEAR), lambda share: progress(0.7 * share))
    meaningful = shortest(runs, exact) >= SHORTEST
    touching = runs.touches(exact)
    scored = meaningful & ~touching
    found = {
        "mujoco": mujoco_runs(runs, threads=threads),
        "reduced": reduced,
    }
    progress(0.9, _worst(found["mujoco"], exact, scored))
    counts = {
        "pairs": plan.pairs,
        "pressure_out_of_range": int((~allowed).sum()),
        "actuator_too_short": int((~meaningful).sum()),
        "touching_a_stop": int((meaningful & touching).sum()),
        "scored": int(scored.sum()),
    }
    checked = own_error(runs, exact, np.flatnonzero(scored)[: plan.checked])
    progress(1.0)
    main = Responses(runs, exact, found, scored, checked, counts)
    return main, _on_stops(runs, exact, found, meaningful & touching, threads)


def native_swing(result: Responses, count: int, threads: int | None = None) -> tuple[Errors, Array]:
    """The baseline on the first ``count`` scored runs: its errors, and (k, m − 1, nj) themselves [rad]."""
    rows = np.flatnonzero(result.scored)[:count]
    error = native_runs(result.experiment.part(rows), threads=threads)[:, 1:] - result.exact[rows, 1:]
    return Errors.of(error), error


@dataclass(frozen=True, eq=False)
class StanceResult:
    """The leg on its pinned foot.

    Attributes:
        published: the published run, joints without stops, as the published equations are.
        free: random starts and pressures, joints without stops.
        on_stops: the same runs of the robot as it is, those that touch a stop: engine → errors.
        published_on_stops: the published run of the robot as it is: engine → errors.
        touching: how many of the robot's own runs touch a stop, of how many.
    """

    published: Responses
    free: Responses
    on_stops: OnStops | None
    published_on_stops: OnStops | None
    touching: tuple[int, int]

    @property
    def errors(self) -> Errors:
        """MuJoCo's over the published run and all random ones."""
        return self.free.errors("mujoco")

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {
            **self.free.to_dict(),
            "published_run": self.published.to_dict(),
            "touching_a_stop": list(self.touching),
            "on_stops": None if self.on_stops is None else self.on_stops.to_dict(),
            "published_run_on_stops": None if self.published_on_stops is None else self.published_on_stops.to_dict(),
        }


def stance_case(
    morphology: Morphology,
    plan: Plan,
    rng: np.random.Generator,
    dt: float,
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> StanceResult:
    """Runs on the pinned foot: the published one first, then random starts under random pressures.

    Nothing holds the base, so nearly every run falls into a stop. Scored are the runs of the robot without stops,
    whose motion is smooth; those of the robot as it is stand in rows of their own.

    Args: as of ``swing_case``.
    """
    low, high = workspace(morphology)
    nj, na = len(low), len(morphology.actuators)
    start = rng.uniform(low, high, (plan.stance_runs, nj))
    pressure = rng.uniform(morphology.command_low, morphology.command_high, (plan.stance_runs, na))
    start[0], pressure[0] = published_stance(morphology)
    robot = Experiment((morphology,), "stance", start, np.zeros(1), pressure[:, None], plan.duration)
    runs = robot.without_stops()
    exact = reference_runs(runs, progress=lambda share: progress(0.3 * share))
    scored = shortest(runs, exact) >= SHORTEST
    found = _by_engines(runs, plan, dt, threads)
    progress(0.45, _worst(found["mujoco"], exact, scored))
    counts = {
        "runs": plan.stance_runs,
        "actuator_too_short": int((~scored).sum()),
        "scored": int(scored.sum()),
    }
    checked = own_error(runs, exact, np.flatnonzero(scored)[: plan.checked])
    free = Responses(runs, exact, found, scored, checked, counts)
    first = np.arange(plan.stance_runs) == 0
    published = Responses(runs, exact, found, scored & first, checked, {"runs": 1, "scored": int(scored[0])})
    robot = robot.part(slice(0, plan.stop_runs))
    both = _by_engines(robot, plan, dt, threads)
    near = robot.touches(both["mujoco"], NEAR)
    true = reference_runs(robot, near, lambda share: progress(0.45 + 0.45 * share))
    touching = robot.touches(true) & (shortest(robot, true) >= SHORTEST)
    first = np.arange(robot.size) == 0
    result = StanceResult(
        published,
        free,
        _on_stops(robot, true, both, touching, threads),
        _on_stops(robot, true, both, touching & first, threads),
        (int(touching.sum()), robot.size),
    )
    progress(1.0)
    return result


def _by_engines(runs: Experiment, plan: Plan, dt: float, threads: int | None) -> dict[str, Array]:
    found = {"mujoco": mujoco_runs(runs, threads=threads)}
    if plan.more_kernels:
        found["reduced"] = reduced_runs(runs, dt, threads)
    return found


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


def _on_stops(
    runs: Experiment, exact: Array, found: dict[str, Array], rows: NDArray[np.bool_], threads: int | None
) -> OnStops | None:
    if not rows.any():
        return None
    errors = {name: Errors.of(q[rows, 1:] - exact[rows, 1:]) for name, q in found.items()}
    fine = mujoco_runs(runs.part(rows), finer(FINE, FAST_SETTINGS), threads)
    errors["mujoco_fine"] = Errors.of(fine[:, 1:] - exact[rows, 1:])
    return OnStops(errors)
