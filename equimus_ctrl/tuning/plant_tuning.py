"""Tuning the PID of any robot on its plant in MuJoCo: factors on the gains that the mass matrix places.

One factor for k_p, one for k_i, k_d and the derivative's time constant, the same for every joint: decoupled joints are
alike (``controllers.placement``), so that the search has four numbers however many joints there are. Cost, limits and
search are those of the leg's tuning (``tuning.objective``, ``tuning.search``); a mm of a slide counts as a degree of a
hinge, and joints without actuator do not count.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl import computer
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings
from equimus_ctrl.controllers.placement import Loop, placed_gains
from equimus_ctrl.effects import TransportDelay
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.sensors import SENSOR_DELAY, sensor_settings
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.models.spread import groups, latin_hypercube, perturbed
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.simulate import run
from equimus_ctrl.tuning.autotune import best_feasible
from equimus_ctrl.tuning.objective import BAND, TERMS, Evaluation, LegOutcome, Outcome, judged
from equimus_ctrl.tuning.result import TuningResult, versions
from equimus_ctrl.tuning.search import Journal, Search, Trial
from equimus_ctrl.tuning.study import GAINS, EnsembleSettings, Limits, Study, Weights
from equimus_ctrl.types import Array, Run

KINDS = ("mass", "damping", "stiffness")
"""What varies between the robots of an ensemble, see ``Robot.varying``."""
JUST_STABLE = 1 - 1e-9
"""Modulus of a loop of which some joints die away as slowly as they do by themselves."""


def make_members(model: Model, settings: EnsembleSettings, count: int, seed: int, fixed: bool = True) -> list[Model]:
    """Robots around a model, drawn by a Latin hypercube.

    Args:
        model: at the centre.
        settings: how far its numbers spread, and how late commands may be.
        count: how many.
        seed: the same seed gives the same robots.
        fixed: whether the first is the model itself, late by the mean, and the second the latest with the least damping
            and mass.
    """
    robot = changed_bodies(model.effects, model.robot)
    spreads = groups(robot, {key: getattr(settings, key) for key in KINDS})
    n = len(spreads) + 1
    known = [np.full(n, 0.5), np.append(np.zeros(n - 1), 1.0)][:count] if fixed else []
    rows = [*known, *latin_hypercube(count - len(known), n, np.random.default_rng(seed))]
    kept = tuple(effect for effect in model.effects if not isinstance(effect, BodyEffect))
    members = []
    for row in rows:
        late = settings.delay[0] + row[-1] * (settings.delay[1] - settings.delay[0])
        own = {effect.location: effect for effect in kept if isinstance(effect, TransportDelay)}
        delays = [
            TransportDelay(name, late + (own[name].delay if name in own else 0.0)) for name in robot.actuator_names
        ]
        others = tuple(effect for effect in kept if not isinstance(effect, TransportDelay))
        members.append(Model(perturbed(robot, spreads, row[:-1]), (*others, *delays), model.phase))
    return members


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


@dataclass(frozen=True, eq=False)
class PlantProblem:
    """What candidates are judged by.

    Attributes:
        model: what the controller computes with.
        members: the robots.
        tasks: what they do.
        weights: of the cost's terms.
        limits: hard ones.
        noise: standard deviation of measured positions [rad or m].
        seed: of that noise.
        placed: the gains that factors are of, see ``controllers.placement.Placed.searched``.
        driven: (nj,) joints on which an actuator acts.
        span: (na,) range of each command, of one without limits what the placed gains use of it.
        control_dt: time between two commands [s].
    """

    model: Model
    members: Sequence[Model]
    tasks: Sequence[PlantTask]
    weights: Weights
    limits: Limits
    noise: float
    seed: int
    placed: PidSettings
    driven: NDArray[np.bool_]
    span: Array
    control_dt: float

    def settings(self, values: Array) -> PidSettings:
        """Gains of factors (4,) on k_p, k_i, k_d and the derivative's time constant, to six digits."""
        factors = [float(f"{value:.6g}") for value in values]
        gains = {}
        for joint, own in self.placed.gains.items():
            numbers = zip((own.kp, own.ki, own.kd), factors, strict=False)
            gains[joint] = PidGains(*(float(f"{gain * factor:.6g}") for gain, factor in numbers))
        time = float(f"{self.placed.derivative_time * factors[3]:.6g}")
        return replace(self.placed, gains=gains, derivative_time=time)

    def driven_by(self, settings: PidSettings, member: int, task: int) -> Run:
        """One run; it ends early where it diverges."""
        own, robot = self.tasks[task], self.members[member]
        plant = MujocoPlant(robot, nominal=self.model, noise=self.noise)
        scenario = own.scenario
        try:
            return run(
                plant, PidController(settings), scenario.reference, own.duration, start=scenario.start, seed=self.seed
            )
        except SimulationDiverged as error:
            return error.run  # type: ignore[no-any-return]

    def outcome(self, settings: PidSettings, member: int, task: int) -> Outcome:
        """What a run is worth."""
        own, done = self.tasks[task], self.driven_by(settings, member, task)
        dt = done.spec.control_dt
        if len(done.time) < round(own.duration / dt) or done.truth is None:
            return Outcome(np.full(len(TERMS), math.inf), 1.0, math.inf, True)
        scale = np.array([math.radians(reading(unit).factor) for unit in done.spec.joint_units])[self.driven]
        error = scale * (done.truth - done.reference)[:, self.driven]
        overshoot, settling, offset, restless = 0.0, 0.0, 0.0, 0.0
        if own.scenario.step_at is not None:
            begins = round(own.scenario.step_at / dt)
            after, wanted = error[begins:], done.reference[:, self.driven]
            way = scale * (wanted[-1] - (wanted[begins - 1] if begins else done.truth[0, self.driven]))
            size = np.maximum(np.abs(way), BAND)
            beyond = np.where(np.abs(way) > BAND, after * np.sign(way), np.abs(after))
            overshoot = float(np.max(beyond.max(axis=0) / size, initial=0.0))
            outside = np.flatnonzero(np.any(np.abs(after) > BAND, axis=1))
            settling = 0.0 if len(outside) == 0 else float((outside[-1] + 1) * dt)
            last = slice(-(len(after) // 4), None)
            restless = float(np.ptp(after[last], axis=0).max())
            offset = math.sqrt(float((after[last] ** 2).mean()))
        u = done.command / self.span
        effort = math.sqrt(float(((u - u.mean(axis=0)) ** 2).mean()))
        chatter = float(np.abs(np.diff(u, axis=0)).mean()) / dt
        terms = np.array([math.sqrt(float((error**2).mean())), max(overshoot, 0.0), settling, offset, effort, chatter])
        return Outcome(terms, float(done.clipped.mean()), restless, False)

    def moduli(self, settings: PidSettings, member: int) -> tuple[float, float]:
        """Largest eigenvalue of a robot's linearised sampled loops, as they are and with all gains raised."""
        known, robot = Dynamics(self.model), self.members[member]
        own, valve = Dynamics(robot), valves_of(robot)
        late = sensor_settings(robot.effects, robot.robot.joint_names)[:, SENSOR_DELAY]
        loops = [
            Loop(pose, own.linear(pose), self.driven, known, valve, self.control_dt, late) for pose in self.poses()
        ]
        both = [max(loop.growth(settings, f)[0] for loop in loops) for f in (1.0, self.limits.gain_margin)]
        return both[0], both[1]

    def member_outcome(self, settings: PidSettings, member: int) -> LegOutcome:
        """One candidate on one robot."""
        runs = [self.outcome(settings, member, task) for task in range(len(self.tasks))]
        calm = not any(own.diverged or own.restless > BAND for own in runs)
        return LegOutcome(runs, *(self.moduli(settings, member) if calm else (math.nan, math.nan)))

    def judge(self, outcomes: Sequence[LegOutcome]) -> Evaluation:
        """See ``tuning.objective.judged``; what joints without actuator do may die away as slowly as it does."""
        limits = self.limits if self.driven.all() else replace(self.limits, modulus=JUST_STABLE)
        return judged(outcomes, [task.weight for task in self.tasks], self.weights, limits)

    def evaluation(self, settings: PidSettings) -> Evaluation:
        """Of one candidate on all robots."""
        return self.judge([self.member_outcome(settings, k) for k in range(len(self.members))])

    def poses(self) -> list[Array]:
        """Where loops are linearised: at the start, at the end and half way of each reference."""
        found = []
        for task in self.tasks:
            at = task.scenario.reference.position
            found += [np.asarray(at(share * task.duration)) for share in (0.0, 0.5, 1.0)]
        return list({pose.tobytes(): pose for pose in found}.values())


def make_plant_problem(study: Study, model: Model, scenarios: Sequence[Scenario]) -> PlantProblem:
    """The problem of a study.

    Raises:
        ControllerError: where no gains that are placed keep the robot where it is.
        NotAvailable: where no equations hold the robot.
    """
    plant, dynamics = MujocoPlant(model), Dynamics(model)
    first = np.array(plant.reset(scenarios[0].start).position)
    placed = placed_gains(dynamics, plant.spec, first).searched
    driven = np.any(dynamics.authority(first, np.zeros_like(first))[0] != 0, axis=1)
    tasks = [
        PlantTask(scenario, objective.weight, objective.duration or scenario.duration)
        for scenario, objective in zip(scenarios, study.objectives, strict=True)
    ]
    low, high = plant.spec.command_low, plant.spec.command_high
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    members = make_members(model, study.ensemble, study.ensemble.members, study.seed)
    problem = PlantProblem(
        model, members, tasks, study.weights, study.limits, study.ensemble.noise, study.seed, placed, driven, span,
        plant.spec.control_dt,
    )  # fmt: skip
    used = np.vstack([problem.driven_by(placed, 0, k).command for k in range(len(tasks))])
    own = np.where(np.isfinite(high - low), span, np.maximum(np.ptp(used, axis=0), 1e-9))
    return replace(problem, span=own)


def study_key(study: Study, problem: PlantProblem) -> str:
    """A fingerprint of everything an evaluation depends on, see ``autotune.study_key``."""
    model = problem.model
    digest = hashlib.sha256(json.dumps([asdict(study), model_to_dict(model), versions()], sort_keys=True).encode())
    digest.update(model.robot.fingerprint.encode())
    for task in problem.tasks:
        times = np.arange(0.0, task.duration, problem.control_dt).tolist()
        digest.update(np.array([task.scenario.reference.position(t) for t in times]).tobytes())
        digest.update(repr((task.name, task.weight, task.duration, task.scenario.step_at)).encode())
    return digest.hexdigest()


class PlantTuning(TuningResult):
    """What a study found of a robot on its plant, beginning with the placed gains."""

    schema, robots = "equimus-ctrl/plant-tuning-record/1", "robots"


def tune_on_plant(
    study: Study,
    problem: PlantProblem,
    journal: Journal,
    notify: Callable[[Trial], None] = lambda trial: None,
    workers: int | None = None,
) -> PlantTuning:
    """Search, then try the result on robots that took no part.

    A KeyboardInterrupt ends the search and keeps the best so far.

    Args:
        study: what to look for.
        problem: see ``make_plant_problem``.
        journal: where evaluations are kept and found again.
        notify: called after each candidate.
        workers: processes; all cores by default.

    Raises:
        NothingFeasible: where no candidate was stable and within the limits on every robot.
    """
    ranges = [study.search[key] for key in (*GAINS, "derivative_time")]
    search = Search.over(ranges, study, journal, notify)
    on_unseen, start_unseen = list[Evaluation](), list[Evaluation]()
    with computer.workers(workers) as pool:

        def evaluate(tasks: Sequence[tuple[PlantProblem, PidSettings]]) -> Iterator[Evaluation]:
            found = dict(pool.each(PlantProblem.evaluation, tasks))
            return (found[k] for k in range(len(tasks)))

        search.evaluate = lambda batch: evaluate([(problem, problem.settings(values)) for values in batch])
        interrupted = search.interrupted()
        best = best_feasible(search.history)
        settings, first = problem.settings(np.array(best.values)), problem.settings(search.start)
        try:
            others = make_members(
                problem.model, study.ensemble, study.ensemble.unseen, study.seed + 1_000_003, fixed=False
            )
            each = [replace(problem, members=[other]) for other in others]
            on_unseen = list(evaluate([(own, settings) for own in each]))
            start_unseen = list(evaluate([(own, first) for own in each]))
        except KeyboardInterrupt:
            interrupted = True
    return PlantTuning(
        study, problem, search.history, best, settings, first, search.history[0].evaluation, on_unseen, start_unseen,
        interrupted,
    )  # fmt: skip
