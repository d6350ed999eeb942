"""The whole validation: every case, what it came to, and whether the goals are reached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.computer import workers
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.engines.batch import compile_kernel
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.frames import dataframe
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology, structure
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array
from equimus_ctrl.validation.conservation import ConservationResult, conservation_case
from equimus_ctrl.validation.engines import Progress
from equimus_ctrl.validation.generator import FLOATING, SHAPES, random_robot
from equimus_ctrl.validation.plan import (
    ACCURACY_GOALS,
    PUBLISHED,
    PUBLISHED_ON_THE_LEG,
    PUBLISHED_SPEED,
    REDUCED_STEP,
    SPEED_GOALS,
    STAGES,
    Errors,
    Plan,
)
from equimus_ctrl.validation.reference import ATOL, RTOL
from equimus_ctrl.validation.responses import (
    Responses,
    StanceResult,
    native_swing,
    stance_case,
    swing_case,
)
from equimus_ctrl.validation.robots import RobotsResult, robots_case, three_dof_case
from equimus_ctrl.validation.speed import SpeedResult, speed_case
from equimus_ctrl.validation.static import StaticResult, native_static, static_case

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "equimus-ctrl/validation/1"
BASELINE_RUNS = 1000
"""Poses and step responses that the baseline gets, at most; its errors need no more to be seen."""

Notify = Callable[[str, float, float | None], None]
"""Called with a stage of ``plan.STAGES``, the share of it done, and the worst joint's RMSE so far [rad] where known."""


@dataclass(frozen=True, eq=False, repr=False)
class Baseline(Short):
    """Native massless actuators on the same cases.

    Attributes:
        static: errors of resting angles.
        swing: errors of step responses.
        swing_error: (n, m, nj) of those [rad].
    """

    static: Errors
    swing: Errors
    swing_error: Array

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {
            "static": self.static.to_dict(),
            "swing": self.swing.to_dict(),
            "published_on_the_leg_rmse_rad": dict(PUBLISHED_ON_THE_LEG),
        }


@dataclass(frozen=True)
class Goal:
    """One figure against its goal.

    Attributes:
        name: of ``plan.ACCURACY_GOALS`` or ``plan.SPEED_GOALS``.
        value: what was reached.
        goal: what was to be reached.
        met: whether it is.
    """

    name: str
    value: float
    goal: float
    met: bool


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Short):
    """All that was found.

    Attributes:
        morphology: the robot.
        plan: how much was run.
        seed: of everything random.
        effects_omitted: the model's effects that took no part.
        static: poses at rest.
        swing: step responses.
        stance: on the pinned foot.
        three_dof: random robots of three joints.
        robots: random robots of two to four joints.
        conservation: what motion must keep.
        baseline: massless actuators.
        speed: of both engines.
    """

    morphology: Morphology
    plan: Plan
    seed: int
    effects_omitted: tuple[str, ...]
    static: StaticResult
    swing: Responses
    stance: StanceResult
    three_dof: Responses
    robots: RobotsResult
    conservation: ConservationResult
    baseline: Baseline
    speed: SpeedResult

    def told(self) -> str:
        """Whether goals are met, and the errors of the first cases."""
        missed = [goal.name for goal in self.accuracy if not goal.met]
        judged = f"missed {', '.join(missed)}" if missed else "every goal of accuracy met"
        static, swing = (float(self.errors[name].rmse.max()) for name in ("static", "swing"))
        return f" of {self.morphology.name}: {judged}; RMSE at rest {static:.1e} rad, in step responses {swing:.1e} rad"

    def to_dataframe(self) -> DataFrame:
        """A row for each case and joint: runs, RMSE and largest error against the exact equations [rad].

        Raises:
            NotAvailable: where pandas is not installed.
        """
        columns = ("case", "joint", "runs", "rmse", "largest")
        rows = [
            (case, j, own.runs, float(rmse), float(largest))
            for case, own in self.errors.items()
            for j, (rmse, largest) in enumerate(zip(own.rmse, own.largest, strict=True))
        ]
        return dataframe({name: [row[k] for row in rows] for k, name in enumerate(columns)})

    @property
    def errors(self) -> dict[str, Errors]:
        """Goal → errors, in the order of the report, without random robots; what no run belongs to is not there."""
        swing, stance = self.swing, self.stance.robot
        published = self.stance.published()
        found = {
            "static": self.static.errors,
            "swing": swing.errors("mujoco"),
            "swing_on_stops": swing.on_stops("mujoco"),
            "stance": stance.errors("mujoco"),
            "stance_published": published.errors("mujoco") if published.scored.any() else None,
            "stance_without_stops": self.stance.free.errors("mujoco"),
            "three_dof": self.three_dof.errors("mujoco"),
            "reduced_swing": swing.errors("reduced"),
            "reduced_swing_on_stops": swing.on_stops("reduced"),
            "reduced_stance": stance.errors("reduced") if "reduced" in stance.found else None,
        }
        return {name: errors for name, errors in found.items() if errors is not None}

    @property
    def accuracy(self) -> tuple[Goal, ...]:
        """RMSE of the worst joint against each goal [rad]; nothing scored meets none."""
        reached = {name: float(errors.rmse.max()) for name, errors in self.errors.items()}
        reached["morphologies"] = self.robots.worst("mujoco")
        goals = [(name, reached[name], goal) for name, goal in ACCURACY_GOALS.items() if name in reached]
        return tuple(Goal(name, value, goal, value <= goal) for name, value, goal in goals)

    @property
    def speeds(self) -> tuple[Goal, ...]:
        """Speeds against their goals; they depend on the computer and its load."""
        reached = self.speed.to_dict()
        return tuple(Goal(name, reached[name], goal, reached[name] >= goal) for name, goal in SPEED_GOALS.items())

    @property
    def accurate(self) -> bool:
        """Whether every goal of accuracy is met."""
        return all(goal.met for goal in self.accuracy)

    def to_dict(self) -> dict[str, Any]:
        """What ``validate --json`` prints: plain JSON types, SI units."""
        settings = {
            "plan": asdict(self.plan),
            "mujoco": asdict(FAST_SETTINGS),
            "reduced_step_s": REDUCED_STEP,
            "reference": {"method": "DOP853", "rtol": RTOL, "atol": ATOL},
        }
        return {
            "schema": SCHEMA,
            "model": self.morphology.name,
            "joints": list(self.morphology.joint_names),
            "seed": self.seed,
            "effects_omitted": list(self.effects_omitted),
            "accurate": self.accurate,
            "goals": [asdict(goal) for goal in (*self.accuracy, *self.speeds)],
            "static": self.static.to_dict(),
            "swing": self.swing.to_dict(),
            "stance": self.stance.to_dict(),
            "three_dof": self.three_dof.to_dict(),
            "morphologies": self.robots.to_dict(),
            "conservation": self.conservation.to_dict(),
            "baseline": self.baseline.to_dict(),
            "speed": self.speed.to_dict(),
            "published": {
                **{name: {"rmse_rad": p.rmse, "max_abs_rad": p.largest} for name, p in PUBLISHED.items()},
                "speed_x_realtime": PUBLISHED_SPEED,
            },
            "settings": settings,
        }


def validate(
    model: Model,
    plan: Plan,
    seed: int = 0,
    *,
    threads: int | None = None,
    notify: Notify = lambda stage, share, error: None,
) -> Validation:
    """Run every case. The same seed gives the same accuracy to the bit, on any number of threads.

    Args:
        model: the robot of the static, swing and stance cases, with its changes to bodies; its other effects (valves,
            friction, sensors) are omitted, for the equations under test have none.
        plan: how much is run.
        seed: of everything random; every stage has a stream of its own.
        threads: at most; all usable processors by default.
        notify: see ``Notify``.

    Raises:
        ConfigError: for a seed below 0, or a robot that its actuators cannot hold.
        ModelError: where MuJoCo cannot simulate the robot.
    """
    if seed < 0:
        raise ConfigError(f"seed is {seed}, expected at least 0")
    effects_omitted = tuple(f"{e.name} at {e.location}" for e in model.effects if not isinstance(e, BodyEffect))
    robot = changed_bodies(model.effects, model.morphology)
    streams = np.random.SeedSequence(seed).spawn(len(STAGES))
    rngs = {stage: np.random.default_rng(stream) for stage, stream in zip(STAGES, streams, strict=True)}
    dt = REDUCED_STEP

    def reporting(stage: str) -> Progress:
        notify(stage, 0.0, None)
        return lambda share, error=None: notify(stage, min(share, 0.999), error)

    def done(stage: str, error: float | None) -> None:
        notify(stage, 1.0, error)

    with workers(threads) as pool:
        compiled = {name: pool.start(compile_kernel, m) for name, m in _kernels(robot, plan).items()}

        def ready(name: str) -> None:
            if name in compiled:
                compiled[name]()

        static = static_case(robot, plan.poses, rngs["static"], threads=threads, progress=reporting("static"))
        done("static", float(static.errors.rmse.max()))
        ready("swing")
        swing = swing_case(robot, plan, rngs["swing"], dt, threads=threads, pool=pool, progress=reporting("swing"))
        if not swing.clear.any():
            raise ConfigError(
                f"{robot.name}: none of {plan.pairs} random step responses clear of the stops could be scored "
                f"({swing.counts}); a robot whose poses need pressures between its lowest and highest command would do"
            )
        done("swing", float(swing.errors("mujoco").rmse.max()))
        ready("stance")
        stance = stance_case(robot, plan, rngs["stance"], dt, threads=threads, pool=pool, progress=reporting("stance"))
        done("stance", float(stance.errors.rmse.max()))
        ready("three_joints")
        three_dof = three_dof_case(
            plan, rngs["three_dof"], dt, threads=threads, pool=pool, progress=reporting("three_dof")
        )
        done("three_dof", float(three_dof.errors("mujoco").rmse.max()))
        robots = robots_case(
            plan, rngs["morphologies"], dt, threads=threads, pool=pool, ready=ready, progress=reporting("morphologies")
        )
        done("morphologies", robots.worst("mujoco"))
        ready("floating")
        kept = conservation_case(robot, plan, rngs["conservation"], threads=threads, progress=reporting("conservation"))
        done("conservation", None)
        report = reporting("baseline")
        at_rest = native_static(static, robot, BASELINE_RUNS, threads)
        report(0.7)
        stepped, error = native_swing(swing, BASELINE_RUNS, threads)
        baseline = Baseline(at_rest, stepped, error)
        done("baseline", float(baseline.static.rmse.max()))
        speed = speed_case(swing, stance.robot, plan, dt, threads=threads, progress=reporting("speed"))
        done("speed", None)
    return Validation(
        robot, plan, seed, effects_omitted, static, swing, stance, three_dof, robots, kept, baseline, speed
    )  # fmt: skip


def _kernels(robot: Morphology, plan: Plan) -> dict[str, Model]:
    """What is run on the reduced engine → a model with its kernel, in the order of need."""
    found = {"swing": Model(robot)}
    if plan.more_kernels:
        found["stance"] = Model(robot, phase="stance")
        own = structure(robot)
        for shape in sorted(SHAPES, key=lambda shape: shape != "three_joints"):
            other = random_robot(shape, np.random.default_rng(0))
            if structure(other) != own:
                found[shape] = Model(other)
    found["floating"] = Model(random_robot(FLOATING, np.random.default_rng(0)))
    return found
