"""Tuning any controller on the plant of any robot, in MuJoCo: what is searched is what its entry declares.

Candidates are numbers of ``controllers.search_space``; each is driven through the scenarios on every robot of an
ensemble. Cost, limits and search are those of the leg's PID (``tuning.objective``, ``tuning.search``); a mm of a slide
counts as a degree of a hinge, and joints without actuator do not count. Where a controller has linearised loops, these
must be stable with all gains raised; else the robot that is latest must also come to rest when it is later still.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl import computer
from equimus_ctrl.controllers.registry import ControllerEntry, ControllerRequest, tunable
from equimus_ctrl.controllers.search_space import SearchSpace, space_of
from equimus_ctrl.errors import ConfigError, ControllerError, NotAvailable, SimulationDiverged
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.simulate import run
from equimus_ctrl.tuning.autotune import UNSEEN, best_feasible, source, time_is_up
from equimus_ctrl.tuning.ensemble import later, make_members
from equimus_ctrl.tuning.objective import BAND, TERMS, Evaluation, LegOutcome, Outcome, judged
from equimus_ctrl.tuning.overshoot import ServosAlone, as_hinges, overshoots, servos_of
from equimus_ctrl.tuning.result import TuningResult, versions
from equimus_ctrl.tuning.search import Journal, Search, Trial
from equimus_ctrl.tuning.study import Limits, PlantStudy, Weights
from equimus_ctrl.types import Array, Controller, Run, Start

JUST_STABLE = 1 - 1e-9
"""Modulus of a loop of which some joints die away as slowly as they do by themselves."""
TRIED = 10
"""Control periods of the try that shows whether a controller can drive the robot at all."""
AHEAD = 2
"""Candidates by process that are begun together: what is done when the time is up is not lost."""


@dataclass(frozen=True, eq=False)
class PlantTask:
    """A scenario, how much it counts, and how long it runs [s]."""

    scenario: Scenario
    weight: float
    duration: float

    @property
    def name(self) -> str:
        """Of the scenario."""
        return self.scenario.name


@dataclass(frozen=True)
class Candidate:
    """Numbers that were searched, and the settings they make.

    Attributes:
        values: name → number.
        table: what the settings file holds.
    """

    values: Mapping[str, float]
    table: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """What the settings file holds."""
        return dict(self.table)


@dataclass(frozen=True, eq=False)
class PlantProblem:
    """What candidates are judged by.

    Attributes:
        controller: its name.
        entry: how it is made.
        space: what is searched of its settings.
        model: what it computes with.
        members: the robots.
        tasks: what they do.
        weights: of the cost's terms.
        limits: hard ones.
        noise: standard deviation of measured positions [rad or m].
        seed: of that noise.
        driven: (nj,) joints on which an actuator acts.
        span: (na,) range of each command, of one without limits what the first candidate uses of it.
        control_dt: time between two commands [s].
        margin: whether the second robot also has to come to rest with the limits' further dead time.
        starts: of each robot where its runs begin; found when they are needed where there are none.
    """

    controller: str
    entry: ControllerEntry
    space: SearchSpace
    model: Model
    members: Sequence[Model]
    tasks: Sequence[PlantTask]
    weights: Weights
    limits: Limits
    noise: float
    seed: int
    driven: NDArray[np.bool_]
    span: Array
    control_dt: float
    margin: bool = False
    starts: Sequence[Sequence[Start]] = ()

    def candidate(self, values: Array) -> Candidate:
        """Of a vector of the searched numbers, to six digits."""
        named = {name: float(f"{v:.6g}") for name, v in zip(self.space.ranges, values.tolist(), strict=True)}
        return Candidate(named, self.space.settings(named))

    @property
    def first(self) -> Candidate:
        """Where the search begins."""
        return self.candidate(np.array([own.start for own in self.space.ranges.values()]))

    def made(self, candidate: Candidate) -> Controller:
        """A controller with a candidate's settings.

        Raises:
            ConfigError: where they do not fit together.
        """
        settings, where = candidate.table, f"controller {self.controller}"
        return self.entry.made(ControllerRequest(settings, None, self.model.robot, where, True, in_time=False))

    def begun(self, member: Model) -> list[Start]:
        """Where a robot's runs begin; the pose at which it rests there takes as long to find as a run."""
        found = []
        for start in (task.scenario.start for task in self.tasks):
            if start.position is None and start.command is not None:
                plant = self.plant(member)
                plant.reset(start)
                start = replace(start, position=plant.position)
            found.append(start)
        return found

    def plant(self, member: Model) -> MujocoPlant:
        """One robot, of which the controller knows the model in the middle."""
        return MujocoPlant(member, nominal=self.model, noise=self.noise)

    def driven_by(self, candidate: Candidate, member: Model, task: PlantTask, start: Start | None = None) -> Run:
        """One run; it ends early where it diverges.

        Args:
            candidate: which controller.
            member: which robot.
            task: what it does.
            start: in place of the scenario's.
        """
        return self.run_of(self.made(candidate), member, task, start)

    def run_of(self, controller: Controller, member: Model, task: PlantTask, start: Start | None = None) -> Run:
        """The same of any controller."""
        scenario = task.scenario
        try:
            return run(
                self.plant(member), controller, scenario.reference, task.duration,
                start=start or scenario.start, seed=self.seed,
            )  # fmt: skip
        except SimulationDiverged as error:
            return error.run  # type: ignore[no-any-return]

    def outcome(self, candidate: Candidate, member: Model, task: PlantTask, start: Start | None = None) -> Outcome:
        """What a run is worth; one whose controller gives up is worth nothing."""
        try:
            done = self.driven_by(candidate, member, task, start)
        except (ControllerError, ConfigError):
            return LOST
        dt = done.spec.control_dt
        if len(done.time) < round(task.duration / dt) or done.truth is None:
            return LOST
        error = (as_hinges(done.spec) * (done.truth - done.reference))[:, self.driven]
        overshoot, settling, offset, restless = 0.0, 0.0, 0.0, 0.0
        if task.scenario.step_at is not None:
            overshoot = float(np.max(overshoots(done, task.scenario.step_at)[self.driven], initial=0.0))
            after = error[round(task.scenario.step_at / dt) :]
            outside = np.flatnonzero(np.any(np.abs(after) > self.weights.settled, axis=1))
            settling = 0.0 if len(outside) == 0 else float((outside[-1] + 1) * dt)
            last = slice(-(len(after) // 4), None)
            restless = float(np.ptp(after[last], axis=0).max())
            offset = math.sqrt(float((after[last] ** 2).mean()))
        u = done.command / self.span
        effort = math.sqrt(float(((u - u.mean(axis=0)) ** 2).mean()))
        chatter = float(np.abs(np.diff(u, axis=0)).mean()) / dt
        terms = np.array([math.sqrt(float((error**2).mean())), max(overshoot, 0.0), settling, offset, effort, chatter])
        return Outcome(terms, float(done.clipped.mean()), restless, False)

    def servos_alone(self) -> float:
        """The largest overshoot, as a share of the step, of joints whose servos get the reference as their goal.

        That is none of a candidate's doing. Other actuators are driven as by the first candidate.
        """
        robot = self.model.robot
        moved = np.isin(robot.joint_names, [*set[str]().union(*map(robot.driven_joints, servos_of(robot)))])
        controller, largest = ServosAlone(self.made(self.first), robot), 0.0
        for member, starts in zip(self.members, self.starts, strict=True) if moved.any() else ():
            for task, start in zip(self.tasks, starts, strict=True):
                if task.scenario.step_at is not None:
                    done = self.run_of(controller, member, task, start)
                    if done.truth is not None and len(done.time) > round(task.scenario.step_at / done.spec.control_dt):
                        largest = max(largest, float(overshoots(done, task.scenario.step_at)[moved].max()))
        return largest

    def moduli(self, candidate: Candidate, member: Model) -> tuple[float, float]:
        """Largest eigenvalue of a robot's linearised loops, as they are and with all gains raised; 0 of none."""
        growth = self.space.growth
        if growth is None:
            return 0.0, 0.0
        own, raised = growth(candidate.table, member, self.poses(), (1.0, self.limits.gain_margin))
        return float(own), float(raised)

    @property
    def _limits(self) -> Limits:
        """What joints without actuator do may die away as slowly as it does."""
        return self.limits if self.driven.all() else replace(self.limits, modulus=JUST_STABLE)

    def keeps(self, modulus: float, raised: float) -> bool:
        """Whether a robot's linearised loops keep the limits."""
        return modulus <= self._limits.modulus and raised < 1

    def member_outcomes(self, candidates: Sequence[Candidate], number: int) -> list[LegOutcome]:
        """Candidates on one robot of the ensemble; those whose linearised loops are beyond limits there do not run."""
        member = self.members[number]
        starts = self.starts[number] if self.starts else self.begun(member)
        pairs = list(zip(self.tasks, starts, strict=True))
        found = []
        for candidate in candidates:
            moduli = self.moduli(candidate, member)
            if not self.keeps(*moduli):
                found.append(LegOutcome([NOT_RUN] * len(pairs), *moduli))
                continue
            runs = [self.outcome(candidate, member, task, start) for task, start in pairs]
            calm = not any(own.diverged or own.restless > BAND for own in runs)
            found.append(LegOutcome(runs, *(moduli if calm else (math.nan, math.nan))))
        return found

    def delayed_outcomes(self, candidate: Candidate) -> list[Outcome]:
        """A candidate on the robot that is latest, when it is later still by the limits' further dead time."""
        number = min(HARDEST, len(self.members) - 1)
        member = self.members[number]
        starts = self.starts[number] if self.starts else self.begun(member)
        slower = later(member, self.limits.delay_margin)
        return [self.outcome(candidate, slower, task, start) for task, start in zip(self.tasks, starts, strict=True)]

    def judge(self, outcomes: Sequence[LegOutcome]) -> Evaluation:
        """See ``tuning.objective.judged``."""
        return judged(outcomes, [task.weight for task in self.tasks], self.weights, self._limits)

    def evaluations(
        self, candidates: Sequence[Candidate], pool: computer.Workers, so_far: Sequence[Evaluation] = ()
    ) -> Iterator[Evaluation]:
        """Of candidates on all robots, in their order, as they are known.

        What cannot make one the result is left out: other robots, where it fails on those that are latest or costs too
        much there for the others to make up; the further dead time, where it costs too much on all.

        Args:
            candidates: to try.
            pool: where.
            so_far: of candidates tried before these, by which they are beaten.
        """
        everybody = range(len(self.members))
        incumbent = min((own.cost for own in so_far if own.feasible), default=math.inf)
        # On each robot as cheap as the cheapest candidate there, and some more, is as much as is thought possible.
        whole = [own.member_costs for own in so_far if own.within and len(own.member_costs) == len(self.members)]
        possible = (1 - CHEAPER) * np.min(whole, axis=0) if whole else np.zeros(len(self.members))
        size = AHEAD * pool.count
        for begin in range(0, len(candidates), size):
            part = candidates[begin : begin + size]
            found: list[dict[int, LegOutcome]] = [{} for _ in part]
            known: dict[int, Evaluation] = {}
            going = list(range(len(part)))
            for stage in self._stages:
                tried = iter(self._shared(pool, [([part[k]], number) for k in going for number in stage]))
                for k in going:
                    found[k] |= {number: next(tried)[0] for number in stage}
                    own = self.judge([found[k][number] for number in everybody if number in found[k]])
                    if own.feasible and len(found[k]) < len(self.members):
                        least = self._at_least(dict(zip(sorted(found[k]), own.member_costs, strict=True)), possible)
                        own = replace(own, cost=least, feasible=least < incumbent, beaten=least >= incumbent)
                    known[k] = own
                going = [k for k in going if known[k].feasible]
            if self.margin:
                cheap = [k for k in going if known[k].cost < incumbent]
                known |= {k: replace(known[k], feasible=False, beaten=True) for k in going if k not in cheap}
                slower = dict(pool.each(PlantProblem.delayed_outcomes, [(self, part[k]) for k in cheap]))
                latest = self._stages[0][0]
                for index, k in enumerate(cheap):
                    found[k][latest] = _the_worse(found[k][latest], slower[index])
                    known[k] = self.judge([found[k][number] for number in everybody])
            yield from (known[k] for k in range(len(part)))

    @property
    def _stages(self) -> list[list[int]]:
        """Numbers of the robots that candidates are tried on one after the other: two by themselves, then the rest."""
        first = [min(HARDEST, len(self.members) - 1), *range(HARDEST + 1, len(self.members))][:2]
        rest = [number for number in range(len(self.members)) if number not in first]
        return [*([number] for number in first), *([rest] if rest else [])]

    def _at_least(self, costs: Mapping[int, float], possible: Array) -> float:
        """What a candidate costs at least that costs so much on some robots, and what is thought possible on others."""
        each = possible.copy()
        each[list(costs)] = list(costs.values())
        return float((1 - self.weights.worst) * each.mean() + self.weights.worst * each.max())

    def on_each(self, candidates: Sequence[Candidate], pool: computer.Workers) -> list[list[Evaluation]]:
        """Of each candidate what it is worth on each robot alone."""
        legs = self._shared(pool, [(candidates, number) for number in range(len(self.members))])
        return [[self.judge([own[k]]) for own in legs] for k in range(len(candidates))]

    def _shared(
        self, pool: computer.Workers, tasks: Sequence[tuple[Sequence[Candidate], int]]
    ) -> list[list[LegOutcome]]:
        found = dict(pool.each(PlantProblem.member_outcomes, [(self, *task) for task in tasks]))
        return [found[k] for k in range(len(tasks))]

    def poses(self) -> list[Array]:
        """Where loops are linearised: at the start, at the end and half way of each reference."""
        found = []
        for task in self.tasks:
            at = task.scenario.reference.position
            found += [np.asarray(at(share * task.duration)) for share in (0.0, 0.5, 1.0)]
        return list({pose.tobytes(): pose for pose in found}.values())


HARDEST = 1
"""Number of the robot of an ensemble that is hardest to keep stable."""
SLOWER, SLOWINGS = 2**-0.25, 9
"""Factor on the speed of loops that are too fast to begin with, and how many speeds are tried: down to a quarter."""
CHEAPER = 0.1
"""Share by which a candidate is thought to be cheaper on a robot than any before it, where it was not tried there."""
SERVOS_MORE = 0.1
"""Share by which joints may overshoot more than with their servos alone, where these overshoot more than the limit."""
NOT_RUN = Outcome(np.full(len(TERMS), math.nan), math.nan, 0.0, False)
"""Of a run that was not made."""
LOST = Outcome(np.full(len(TERMS), math.inf), 1.0, math.inf, True)
"""Of a run that came to nothing."""


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


def _the_worse(leg: LegOutcome, slower: Sequence[Outcome]) -> LegOutcome:
    """A robot's outcome that comes to rest only where it also does when it is later still."""
    runs = [
        LOST if other.diverged else replace(own, restless=max(own.restless, other.restless))
        for own, other in zip(leg.runs, slower, strict=True)
    ]
    return replace(leg, runs=runs)


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
    workers: int | None = None,
    budget: float | None = None,
    prepare: Callable[[], object] | None = None,
) -> PlantTuning:
    """Search, then try the result on robots that took no part.

    A KeyboardInterrupt ends the search and keeps the best so far.

    Args:
        study: what to look for.
        problem: see ``make_plant_problem``.
        journal: where evaluations are kept and found again.
        notify: called after each candidate.
        workers: processes; all cores by default.
        budget: longest time of the search [s]; none by default.
        prepare: called first in every process.

    Raises:
        NothingFeasible: where no candidate was stable and within the limits on every robot.
    """
    search = Search.of(list(problem.space.ranges.values()), study, journal, notify)
    search.over = time_is_up(budget)
    on_unseen, start_unseen = list[Evaluation](), list[Evaluation]()
    with computer.workers(workers, prepare=prepare) as pool:
        search.evaluate = lambda batch: problem.evaluations(
            [problem.candidate(values) for values in batch], pool, [trial.evaluation for trial in search.history]
        )
        interrupted = search.interrupted()
        best = best_feasible(search.history, noun=PlantTuning.noun, member=PlantTuning.member)
        settings, first = problem.candidate(np.array(best.values)), problem.first
        try:
            seed = study.seed + UNSEEN
            others = make_members(problem.model, study.ensemble, study.ensemble.unseen, seed, fixed=False)
            on_unseen, start_unseen = replace(problem, members=others, starts=(), margin=False).on_each(
                [settings, first], pool
            )
        except KeyboardInterrupt:
            interrupted = True
    return PlantTuning(
        study, problem, search.history, best, settings, first, search.history[0].evaluation, on_unseen, start_unseen,
        interrupted, timed_out=search.timed_out,
    )  # fmt: skip
