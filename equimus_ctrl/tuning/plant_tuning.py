"""Tuning any controller on the plant of any robot, in MuJoCo: what is searched is what its entry declares."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.registry import tunable
from equimus_ctrl.controllers.search_space import SearchSpace, space_of
from equimus_ctrl.errors import ConfigError, ControllerError, NotAvailable
from equimus_ctrl.executors.where import Where
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning.autotune import HERE, UNSEEN, best_feasible, source, time_is_up
from equimus_ctrl.tuning.ensemble import hardest, make_members
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.plant_problem import HARDEST, PlantProblem, PlantTask
from equimus_ctrl.tuning.result import TuningResult, versions
from equimus_ctrl.tuning.search import Journal, Search, Trial
from equimus_ctrl.tuning.study import PlantStudy
from equimus_ctrl.types import Array

TRIED = 10
"""Control periods of the try that shows whether a controller can drive the robot at all."""
SLOWER, SLOWINGS = 2**-0.25, 9
"""Factor on the speed of loops that are too fast to begin with, and how many speeds are tried: down to a quarter."""
SERVOS_MORE = 0.1
"""Share by which joints may overshoot more than with their servos alone, where these overshoot more than the limit."""


def make_plant_problem(
    study: PlantStudy, model: Model, scenarios: Sequence[Scenario], controller: str = "pid", where: str = "study"
) -> PlantProblem:
    """The problem of a study.

    Args:
        study: what to look for.
        model: the centre of the ensemble, and what the controller computes with.
        scenarios: one for each of the study's objectives, in their order.
        controller: by its name.
        where: the study's file, for messages.

    Raises:
        ControllerError: for a controller that declares no search space, or that cannot drive the robot.
        ConfigError: where the study says what does not fit the space.
    """
    entry, search = tunable(controller)
    if missing := entry.lacks(model.robot):
        raise ControllerError(f"{controller} computes with {missing}")
    plant = MujocoPlant(model)
    first = np.array(plant.reset(scenarios[0].start).position)
    try:
        space = space_of(search, plant.spec, first).narrowed(study.search, study.settings)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    tasks = [
        PlantTask(scenario, objective.weight, objective.duration or scenario.duration)
        for scenario, objective in zip(scenarios, study.objectives, strict=True)
    ]
    low, high = plant.spec.command_low, plant.spec.command_high
    bounded = np.isfinite(high - low)
    span = np.where(bounded, high - low, 1.0)
    members = make_members(model, study.ensemble, study.ensemble.members, study.seed)
    problem = PlantProblem(
        controller, entry, space, model, members, tasks, study.weights, study.limits, study.ensemble.noise, study.seed,
        _driven(model, first), span, plant.spec.control_dt, space.growth is None and study.limits.delay_margin > 0,
        0 if study.ensemble.corners_count else min(hardest(model, study.ensemble), max(len(members) - HARDEST, 0)),
    )  # fmt: skip
    problem = replace(problem, space=_slowed(problem))
    # What fails at once fails here, in a sentence.
    brief = replace(tasks[0], duration=min(tasks[0].duration, TRIED * problem.control_dt))
    problem.driven_by(problem.first, model, brief)
    problem = replace(problem, starts=[problem.begun(member) for member in members])
    most = max(study.limits.overshoot, (1 + SERVOS_MORE) * problem.servos_alone())
    problem = replace(problem, limits=replace(study.limits, overshoot=most))
    if bounded.all():
        return problem
    used = np.vstack([problem.driven_by(problem.first, members[0], task).command for task in tasks])
    return replace(problem, span=np.where(bounded, span, np.maximum(np.ptp(used, axis=0), 1e-9)))


def _slowed(problem: PlantProblem) -> SearchSpace:
    """The space, begun with loops that keep the limits on all robots; as it is where none of those tried do.

    Placed gains are looked at on the model as it is known; an ensemble has lighter robots behind later drives.
    """
    space = problem.space
    if space.growth is None or not space.speed:
        return space
    for step in range(SLOWINGS):
        slower = replace(problem, space=space.begun_at(SLOWER**step))
        if all(problem.keeps(*slower.moduli(slower.first, member)) for member in problem.members[::-1]):
            return slower.space
    return space


def _driven(model: Model, pose: Array) -> NDArray[np.bool_]:
    """(nj,) joints on which an actuator acts; all where no equations tell."""
    try:
        return np.asarray(np.any(Dynamics(model).authority(pose, np.zeros_like(pose))[0] != 0, axis=1))
    except NotAvailable:
        return np.ones(len(pose), dtype=bool)


def study_key(study: PlantStudy, problem: PlantProblem) -> str:
    """A fingerprint of everything an evaluation depends on, see ``autotune.study_key``."""
    model, space = problem.model, problem.space
    told = [
        asdict(study),
        model_to_dict(model),
        versions(),
        problem.controller,
        source(type(problem.made(problem.first))),
        [model_to_dict(member) for member in problem.members],
    ]
    ranges = {name: asdict(own) for name, own in space.ranges.items()}
    text = json.dumps([*told, ranges, problem.first.to_dict()], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    digest.update(model.robot.fingerprint.encode())
    for task in problem.tasks:
        times = np.arange(0.0, task.duration, problem.control_dt).tolist()
        digest.update(np.array([task.scenario.reference.position(t) for t in times]).tobytes())
        digest.update(repr((task.name, task.weight, task.duration, task.scenario.step_at)).encode())
    return digest.hexdigest()


class PlantTuning(TuningResult):
    """What a study found of a robot on its plant, beginning with the settings that nobody has tuned."""

    schema, robots, noun, member = "equimus-ctrl/plant-tuning-record/2", "robots", "candidates", "robot"

    @property
    def heading(self) -> str:
        """What the settings file begins with."""
        return f"Settings of {self.problem.controller}"

    def found(self) -> tuple[str, tuple[str, ...], list[tuple[Any, ...]]]:
        """What was found as a table for people, see ``TuningResult``."""
        rows = [(name, first, self.settings.values[name]) for name, first in self.start.values.items()]
        return self.heading, ("setting", "first", "tuned"), rows

    def record(self) -> dict[str, Any]:
        """Everything worth keeping, in plain types."""
        searched = {"first": dict(self.start.values), "tuned": dict(self.settings.values)}
        limits = asdict(self.problem.limits)
        return {**super().record(), "controller": self.problem.controller, "searched": searched, "limits": limits}


def tune_on_plant(
    study: PlantStudy,
    problem: PlantProblem,
    journal: Journal,
    notify: Callable[[Trial], None] = lambda trial: None,
    where: Where = HERE,
    budget: float | None = None,
    prepare: Callable[[], object] | None = None,
    stage: Callable[[str], None] = lambda name: None,
) -> PlantTuning:
    """Search, then try the result on robots that took no part.

    A KeyboardInterrupt ends the search and keeps the best so far.

    Args:
        study: what to look for.
        problem: see ``make_plant_problem``.
        journal: where evaluations are kept and found again.
        notify: called after each candidate.
        stage: told what is done after the last candidate.
        where: candidates are tried; in processes of this computer by default.
        budget: longest time of the search [s]; none by default.
        prepare: called first in every process.

    Raises:
        NothingFeasible: where no candidate was stable and within the limits on every robot.
    """
    search = Search.of(list(problem.space.ranges.values()), study, journal, notify)
    search.over = time_is_up(budget)
    on_unseen, start_unseen = list[Evaluation](), list[Evaluation]()
    with where.opened(prepare=prepare) as pool:
        search.evaluate = lambda batch: problem.evaluations(
            [problem.candidate(values) for values in batch], pool, [trial.evaluation for trial in search.history]
        )
        interrupted = search.interrupted()
        best = best_feasible(search.history, noun=PlantTuning.noun, member=PlantTuning.member)
        settings, first = problem.candidate(np.array(best.values)), problem.first
        try:
            seed = study.seed + UNSEEN
            stage("robots never tuned on")
            others = make_members(problem.model, study.ensemble, study.ensemble.unseen, seed, fixed=False)
            on_unseen, start_unseen = replace(
                problem, members=others, seed=seed, starts=(), margin=False, hardest=0
            ).on_each([settings, first], pool)
        except KeyboardInterrupt:
            interrupted = True
    return PlantTuning(
        study, problem, search.history, best, settings, first, search.history[0].evaluation, on_unseen, start_unseen,
        interrupted, timed_out=search.timed_out,
    )  # fmt: skip
