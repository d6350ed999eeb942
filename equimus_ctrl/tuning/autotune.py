"""Tuning a PID: a study, a model and its scenarios in; gains that work on every leg of the ensemble out."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.effects.valves import valve_effects
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.errors import NothingFeasible
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.where import Where
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates
from equimus_ctrl.scenarios.references import SampledReference
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning.ensemble import Member, make_ensemble, most_lateness
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.objective import Problem, make_task
from equimus_ctrl.tuning.result import CrossCheck, TuningResult, versions
from equimus_ctrl.tuning.search import Journal, Search, Trial
from equimus_ctrl.tuning.stability import Margins, least_margins, margins
from equimus_ctrl.tuning.study import Study
from equimus_ctrl.types import Array, Start

HERE = Where()
"""This computer."""
UNSEEN = 1_000_003
"""Beyond the study's seed, of robots that take no part in the tuning."""


def make_problem(study: Study, model: Model, scenarios: Sequence[Scenario]) -> Problem:
    """What candidates of a study are judged by.

    Args:
        study: the study.
        model: the centre of the ensemble, and what the controller computes with.
        scenarios: one for each of the study's objectives, in their order.
    """
    members = make_ensemble(model, study.ensemble, study.ensemble.members, study.seed)
    tasks = [
        make_task(scenario, objective.weight, objective.duration, model, study.ensemble.noise, study.seed + k)
        for k, (scenario, objective) in enumerate(zip(scenarios, study.objectives, strict=True))
    ]
    late = most_lateness(model, study.ensemble, study.inverse)
    return Problem(model, members, tasks, study.weights, study.limits, inverse=study.inverse, lateness=late)


def unseen_problem(problem: Problem, study: Study) -> Problem:
    """The same problem on legs that took no part in the tuning."""
    legs = make_ensemble(problem.model, study.ensemble, study.ensemble.unseen, study.seed + UNSEEN, fixed=False)
    return replace(problem, members=legs, _starts={}, _legs={}, _plans={})


def study_key(study: Study, problem: Problem) -> str:
    """A fingerprint of everything an evaluation depends on; journals of another fingerprint are of no use."""
    kernel = problem.code()
    classes = {type(effect) for effect in problem.model.effects}
    laws = sorted(source(cls) for cls in classes if not cls.__module__.startswith("equimus_ctrl."))
    text = json.dumps([asdict(study), model_to_dict(problem.model), versions(), kernel, laws], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for task in problem.tasks:
        digest.update(task.reference.tobytes() + task.noise.tobytes() + task.command_before.tobytes())
        start = None if task.position is None else task.position.tolist()
        digest.update(repr((task.name, task.weight, start, task.step_like, task.control_dt)).encode())
    return digest.hexdigest()


def source(cls: type) -> str:
    """What a user's effect says; its name where that cannot be read."""
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):
        return cls.__qualname__


def autotune(
    study: Study,
    problem: Problem,
    journal: Journal,
    notify: Callable[[Trial], None] = lambda trial: None,
    where: Where = HERE,
    budget: float | None = None,
    prepare: Prepare | None = None,
    stage: Callable[[str], None] = lambda name: None,
) -> TuningResult:
    """Search, then look hard at what was found.

    A KeyboardInterrupt ends the search and keeps the best so far.

    Args:
        study: what to look for.
        problem: see ``make_problem``.
        journal: where evaluations are kept and found again.
        notify: called after each candidate.
        where: candidates are tried; in threads of this process by default.
        budget: longest time of the search [s]; none by default.
        prepare: done first in every other process.
        stage: told what is done after the last candidate.

    Raises:
        NothingFeasible: where no candidate was stable and within the limits on every leg.
    """
    channels = study.settings(np.ones(64), ()).channels(problem.model.morphology)
    ranges = [r for _, r in study.ranges(channels)]
    search = Search.of(ranges, study, journal, notify)
    search.over = time_is_up(budget)

    def made(values: Sequence[float] | Array) -> PidSettings:
        return replace(study.settings(np.array(values), channels), lateness=problem.lateness)

    # Linear algebra keeps to one thread each: the cores are busy with candidates, and the bits stay the same on any
    # number of them.
    with threadpool_limits(1), where.shared(prepare) as pool:
        search.evaluate = lambda batch: problem.evaluate([made(v) for v in batch], pool, pool.count)
        problem.warm_up()
        interrupted = search.interrupted()
        stage("verifying the best")
        best = best_feasible(search.history, lambda t: problem.verified(made(t.values)))
        settings = made(best.values)
        start = search.history[0]
        start_settings = made(start.values)
        on_unseen: list[Evaluation] = []
        start_unseen: list[Evaluation] = []
        checks: list[CrossCheck] = []
        try:
            stage("robots never tuned on")
            unseen = unseen_problem(problem, study)
            unseen.warm_up()
            on_unseen = _one_by_one(unseen, settings, pool)
            start_unseen = _one_by_one(unseen, start_settings, pool)
            stage("MuJoCo plant")
            checks = [cross_check(problem, settings, k) for k in range(len(problem.tasks))]
        except KeyboardInterrupt:
            # The gains are found; what is missing is only how they do elsewhere.
            interrupted = True
    stage("margins")
    return TuningResult(
        study,
        problem,
        search.history,
        best,
        settings,
        start_settings,
        start.evaluation,
        on_unseen,
        start_unseen,
        interrupted,
        _margins_of(problem, settings, problem.members[0], problem.poses()[0]),
        _least_margins(problem, settings),
        checks,
        search.timed_out,
    )


def time_is_up(budget: float | None) -> Callable[[], bool]:
    """Tells whether a time has passed since now [s]; never of None."""
    if budget is None:
        return lambda: False
    end = clock.monotonic() + budget
    return lambda: clock.monotonic() >= end


def best_feasible(
    history: Sequence[Trial],
    verified: Callable[[Trial], bool] = lambda trial: True,
    noun: str = TuningResult.noun,
    member: str = TuningResult.member,
) -> Trial:
    """The cheapest candidate that is stable and within the limits on every leg, and ``verified``.

    Args:
        history: what was tried.
        verified: looks at one more closely.
        noun: what candidates are, in messages.
        member: what a robot of the ensemble is, in messages.

    Raises:
        NothingFeasible: where there is none, saying what the nearest one lacked.
    """
    allowed = sorted((t for t in history if t.evaluation.feasible), key=lambda t: t.evaluation.cost)
    for trial in allowed:
        if verified(trial):
            return trial
    if allowed:
        raise NothingFeasible(
            f"{len(allowed)} of {len(history)} {noun} kept all limits while searching, but none of them keeps "
            "the gain margin at every pose along the moving references"
        )
    if not history:
        raise NothingFeasible(f"the search was stopped before any {noun} were tried")
    nearest = min(history, key=lambda trial: trial.evaluation.cost).evaluation
    ran = ""
    if not math.isnan(nearest.overshoot):
        overshoot, saturated = (f"{100 * share:.0f} %" for share in (nearest.overshoot, nearest.saturation))
        ran = f"overshoots by {overshoot}, is saturated {saturated} of the time, "
    why = (
        f"is unstable on some {member}"
        if not nearest.stable
        else f"{ran}its slowest mode has modulus {nearest.modulus:.4f}, and {nearest.raised_modulus:.4f} with the gain "
        "margin"
    )
    raise NothingFeasible(
        f"none of {len(history)} {noun} is stable and within the limits on every {member}; the nearest {why}"
    )


def _one_by_one(problem: Problem, settings: PidSettings, pool: Executor) -> list[Evaluation]:
    """What gains are worth on each leg of a problem alone."""
    runs = [(settings, member) for member in range(len(problem.members))]
    size = max(min(LANES, math.ceil(len(runs) / pool.count)), 1)
    blocks = [runs[k : k + size] for k in range(0, len(runs), size)]
    begun = [pool.submit(problem.leg_outcomes, block) for block in blocks]
    return [problem.judge([leg]) for legs in begun for leg in legs.result()]


def _margins_of(problem: Problem, settings: PidSettings, member: Member, pose: Array) -> list[Margins]:
    model, dt = problem.model, problem.tasks[0].control_dt
    return margins(settings, member, model.morphology, pose, dt, model.phase, problem.fed(pose))


def _least_margins(problem: Problem, settings: PidSettings) -> list[Margins]:
    return least_margins(
        [_margins_of(problem, settings, member, pose) for member in problem.members for pose in problem.poses()]
    )


class _Watched:
    """A plant whose measurements carry a given noise and whose true angles are kept, to compare two engines with."""

    def __init__(self, plant: MujocoPlant, noise: Array) -> None:
        self._plant, self._noise = plant, noise
        self.spec = plant.spec
        self.close = plant.close
        self.position: list[Array] = []

    def reset(self, start: Start | None = None, seed: int | None = None) -> Any:
        self.position.clear()
        return self._noisy(self._plant.reset(start, seed))

    def step(self, command: Any) -> Any:
        return self._noisy(self._plant.step(command))

    def _noisy(self, observation: Any) -> Any:
        row = self._noise[min(len(self.position), len(self._noise) - 1)]
        self.position.append(self._plant.position)
        return replace(observation, position=observation.position + row)


def cross_check(problem: Problem, settings: PidSettings, task: int) -> CrossCheck:
    """Run the first leg in MuJoCo and compare with the compiled loop."""
    model, t, leg = problem.model, problem.tasks[task], problem.members[0]
    rows = zip(leg.valve, model.morphology.actuator_names, strict=True)
    valves = [effect for row, actuator in rows for effect in valve_effects(row, actuator)]
    rate = 1 / t.control_dt
    plant = _Watched(
        MujocoPlant(
            Model(leg.morphology, (*valves, *leg.effects), model.phase),
            nominal=model,
            rates=PlantRates(control=rate, sensor=rate, physics=rate * problem.steps),
        ),
        t.noise,
    )
    times = np.asarray(np.arange(len(t.reference)) * t.control_dt, dtype=np.float64)
    run(
        plant,
        PidController(settings),
        SampledReference(times, t.reference),
        len(times) * t.control_dt,
        start=Start(command=t.command_before, position=t.position),
    )
    true = np.array(plant.position[: len(times)])
    compiled_q, _, _ = problem.simulate(settings, 0, task)
    error = true - problem.wanted(task)
    return CrossCheck(t.name, np.sqrt((error**2).mean(axis=0)), float(np.abs(true - compiled_q).max()))
