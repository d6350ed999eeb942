"""What candidates for a controller of any robot are judged by, on its plant in MuJoCo.

Candidates are numbers of ``controllers.search_space``; each is driven through the scenarios on every robot of an
ensemble. Cost, limits and search are those of the leg's PID (``tuning.objective``, ``tuning.search``); a mm of a slide
counts as a degree of a hinge, and joints without actuator do not count. Where a controller has linearised loops, these
must be stable with all gains raised; else the robot that is latest must also come to rest when it is later still.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.registry import ControllerEntry, ControllerRequest
from equimus_ctrl.controllers.search_space import SearchSpace
from equimus_ctrl.errors import ConfigError, ControllerError, SimulationDiverged
from equimus_ctrl.executors.base import Executor
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning.ensemble import later
from equimus_ctrl.tuning.evaluation import BAND, TERMS, Evaluation, LegOutcome, Outcome, judged
from equimus_ctrl.tuning.overshoot import ServosAlone, as_hinges, overshoots, servos_of
from equimus_ctrl.tuning.study import Limits, Weights
from equimus_ctrl.types import Array, Controller, Run, Start

JUST_STABLE = 1 - 1e-9
"""Modulus of a loop of which some joints die away as slowly as they do by themselves."""
AHEAD = 2
"""Candidates by process that are begun together: what is done when the time is up is not lost."""
HARDEST = 1
"""Number of the first robot of an ensemble that is hardest to keep stable, the one that is latest."""
HARDEST_MORE = 0.2
"""Share by which a candidate may cost more than the first one on a robot that is hardest."""
CHEAPER = 0.1
"""Share by which a candidate is thought to be cheaper on a robot than any before it, where it was not tried there."""
NOT_RUN = Outcome(np.full(len(TERMS), math.nan), math.nan, 0.0, False)
"""Of a run that was not made."""
LOST = Outcome(np.full(len(TERMS), math.inf), 1.0, math.inf, True)
"""Of a run that came to nothing."""


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
        seed: of that noise, which is another on each robot: what came of one draw alone would be learnt by heart.
        driven: (nj,) joints on which an actuator acts.
        span: (na,) range of each command, of one without limits what the first candidate uses of it.
        control_dt: time between two commands [s].
        margin: whether the second robot also has to come to rest with the limits' further dead time.
        hardest: how many robots behind the first are hardest to keep stable: these have to keep the limits, and what
            they cost does not count, for hardly any robot is like them, see ``kept_on_hardest``.
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
    hardest: int = 0
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

    def driven_by(
        self, candidate: Candidate, member: Model, task: PlantTask, start: Start | None = None, number: int = 0
    ) -> Run:
        """One run; it ends early where it diverges.

        Args:
            candidate: which controller.
            member: which robot.
            task: what it does.
            start: in place of the scenario's.
            number: of the robot, for its noise.
        """
        return self.run_of(self.made(candidate), member, task, start, number)

    def run_of(
        self, controller: Controller, member: Model, task: PlantTask, start: Start | None = None, number: int = 0
    ) -> Run:
        """The same of any controller."""
        scenario = task.scenario
        try:
            return run(
                self.plant(member), controller, scenario.reference, task.duration,
                start=start or scenario.start, seed=self.seed + number,
            )  # fmt: skip
        except SimulationDiverged as error:
            return error.run  # type: ignore[no-any-return]

    def outcome(
        self, candidate: Candidate, member: Model, task: PlantTask, start: Start | None = None, number: int = 0
    ) -> Outcome:
        """What a run is worth, see ``driven_by``; one whose controller gives up is worth nothing."""
        try:
            done = self.driven_by(candidate, member, task, start, number)
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
            runs = [self.outcome(candidate, member, task, start, number) for task, start in pairs]
            calm = not any(own.diverged or own.restless > BAND for own in runs)
            found.append(LegOutcome(runs, *(moduli if calm else (math.nan, math.nan))))
        return found

    def delayed_outcomes(self, candidate: Candidate) -> list[Outcome]:
        """A candidate on the robot that is latest, when it is later still by the limits' further dead time."""
        number = self._latest
        member = self.members[number]
        starts = self.starts[number] if self.starts else self.begun(member)
        slower = later(member, self.limits.delay_margin)
        return [
            self.outcome(candidate, slower, task, start, number)
            for task, start in zip(self.tasks, starts, strict=True)
        ]  # fmt: skip

    def judge(self, outcomes: Mapping[int, LegOutcome]) -> Evaluation:
        """Of what happened on some robots, by their numbers, see ``tuning.evaluation.judged``."""
        numbers = sorted(outcomes)
        paying = [number in self.paying for number in numbers]
        counts = [task.weight for task in self.tasks]
        return judged([outcomes[n] for n in numbers], counts, self.weights, self._limits, paying)

    def evaluations(
        self, candidates: Sequence[Candidate], pool: Executor, so_far: Sequence[Evaluation] = ()
    ) -> Iterator[Evaluation]:
        """Of candidates on all robots, in their order, as they are known.

        What cannot make one the result is left out: other robots, where it fails on those before or costs too much
        there for the others to make up; where no linearised loops tell beforehand who fails on the robots that are
        hardest, also these, and the further dead time, where it costs too much on all others.

        Args:
            candidates: to try.
            pool: where.
            so_far: of candidates tried before these, by which they are beaten.
        """
        incumbent = min((own.cost for own in so_far if own.feasible), default=math.inf)
        # On each robot as cheap as the cheapest candidate there, and some more, is as much as is thought possible.
        whole = [costs for own in so_far if own.within and len(costs := self._paid(own))]
        possible = (1 - CHEAPER) * np.min(whole, axis=0) if whole else np.zeros(len(self.paying))
        size, first = AHEAD * pool.count, so_far[0] if so_far else None
        for begin in range(0, len(candidates), size):
            part = candidates[begin : begin + size]
            found: list[dict[int, LegOutcome]] = [{} for _ in part]
            known: dict[int, Evaluation] = {}
            going = list(range(len(part)))
            for stage in self.stages:
                # Whose costs are known is tried further only to become the result.
                if going and all(set(self.paying) <= set(found[k]) for k in going):
                    going = self._cheaper(going, known, incumbent)
                tried = iter(self._shared(pool, [([part[k]], number) for k in going for number in stage]))
                for k in going:
                    found[k] |= {number: next(tried)[0] for number in stage}
                    own = self.judge(found[k])
                    if own.feasible and not set(self.paying) <= set(found[k]):
                        known_costs = dict(zip(sorted(found[k]), own.member_costs, strict=True))
                        least = self._at_least(known_costs, possible)
                        own = replace(own, cost=least, feasible=least < incumbent, beaten=least >= incumbent)
                    known[k] = own
                going = [k for k in going if known[k].feasible]
            if self.margin:
                going = self._cheaper(going, known, incumbent)
                slower = dict(pool.each(self.delayed_outcomes, [(part[k],) for k in going]))
                latest = self._latest
                for index, k in enumerate(going):
                    found[k][latest] = _the_worse(found[k][latest], slower[index])
                    known[k] = self.judge(found[k])
            first = first or known[0]
            for k in range(len(part)):
                yield self.kept_on_hardest(known[k], first)

    def kept_on_hardest(self, own: Evaluation, first: Evaluation) -> Evaluation:
        """A candidate's; beyond a limit where on a robot that is hardest it costs far more than the first candidate.

        What hardly any robot is like is not to be tuned for, nor to be given up for the others.
        """
        count = len(self.members)
        if not own.feasible or not first.feasible or not len(own.member_costs) == len(first.member_costs) == count:
            return own
        hard = [n for n in range(count) if n not in self.paying]
        more = max((own.member_costs[n] / first.member_costs[n] - 1 - HARDEST_MORE for n in hard), default=0.0)
        return replace(own, cost=1e3 * (1 + more), feasible=False) if more > 0 else own

    @staticmethod
    def _cheaper(going: Sequence[int], known: dict[int, Evaluation], incumbent: float) -> list[int]:
        """Those that are cheaper than all before; the others are beaten."""
        for k in going:
            if known[k].cost >= incumbent:
                known[k] = replace(known[k], feasible=False, beaten=True)
        return [k for k in going if known[k].feasible]

    @property
    def paying(self) -> list[int]:
        """Numbers of the robots whose costs count."""
        own = [n for n in range(len(self.members)) if not HARDEST <= n < HARDEST + self.hardest]
        return own or list(range(len(self.members)))

    @property
    def stages(self) -> list[list[int]]:
        """Numbers of the robots that candidates are tried on one after the other: two by themselves, then the rest.

        Those that are hardest come last, for the fewest get there, or first where linearised loops tell who fails.
        """
        first, rest = self.paying[:2], self.paying[2:]
        hardest = [n for n in range(len(self.members)) if n not in self.paying]
        usual = [*([number] for number in first), *([rest] if rest else [])]
        if not hardest:
            return usual
        return [*usual, hardest] if self.space.growth is None else [hardest, *usual]

    @property
    def _latest(self) -> int:
        return min(HARDEST, len(self.members) - 1)

    def _paid(self, own: Evaluation) -> tuple[float, ...]:
        """What a candidate cost on each robot whose costs count; empty where it was not tried on all of these."""
        costs = own.member_costs
        if len(costs) == len(self.members):
            return tuple(costs[n] for n in self.paying)
        return costs if len(costs) == len(self.paying) and self.space.growth is None else ()

    def _at_least(self, costs: Mapping[int, float], possible: Array) -> float:
        """What a candidate costs at least that costs so much on some robots, and what is thought possible on others."""
        each = np.array([costs.get(n, least) for n, least in zip(self.paying, possible, strict=True)])
        return float((1 - self.weights.worst) * each.mean() + self.weights.worst * each.max())

    def on_each(self, candidates: Sequence[Candidate], pool: Executor) -> list[list[Evaluation]]:
        """Of each candidate what it is worth on each robot alone."""
        legs = self._shared(pool, [(candidates, number) for number in range(len(self.members))])
        return [[self.judge({n: own[k]}) for n, own in enumerate(legs)] for k in range(len(candidates))]

    def _shared(self, pool: Executor, tasks: Sequence[tuple[Sequence[Candidate], int]]) -> list[list[LegOutcome]]:
        found = dict(pool.each(self.member_outcomes, tasks))
        return [found[k] for k in range(len(tasks))]

    def poses(self) -> list[Array]:
        """Where loops are linearised: at the start, at the end and half way of each reference."""
        found = []
        for task in self.tasks:
            at = task.scenario.reference.position
            found += [np.asarray(at(share * task.duration)) for share in (0.0, 0.5, 1.0)]
        return list({pose.tobytes(): pose for pose in found}.values())


def _the_worse(leg: LegOutcome, slower: Sequence[Outcome]) -> LegOutcome:
    """A robot's outcome that comes to rest only where it also does when it is later still."""
    runs = [
        LOST if other.diverged else replace(own, restless=max(own.restless, other.restless))
        for own, other in zip(leg.runs, slower, strict=True)
    ]
    return replace(leg, runs=runs)
