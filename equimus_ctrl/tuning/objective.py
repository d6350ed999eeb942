"""What a set of gains is worth: its cost and its limits over scenarios and an ensemble of legs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from equimus_ctrl.controllers import pid_kernel
from equimus_ctrl.controllers.pid import PidSettings
from equimus_ctrl.engines import compiled
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.morphology import pack
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning import loop_kernel
from equimus_ctrl.tuning.ensemble import Member
from equimus_ctrl.tuning.study import Limits, Weights
from equimus_ctrl.types import Array

BAND = 0.03
"""A joint has settled when it stays this close to its reference [rad]."""
TERMS = ("error", "overshoot", "settling", "effort", "chatter")


@dataclass(frozen=True, eq=False)
class Task:
    """A scenario as the kernel takes it.

    Attributes:
        name: of the scenario.
        weight: how much it counts.
        reference: (n, nj) at each control instant [rad].
        command_before: (na,) in force before the start [Pa].
        position: (nj,) pose at the start, or None for each leg's own rest under ``command_before`` [rad].
        step_like: whether overshoot and settling mean something.
        noise: (n, nj) of the measurements [rad].
        control_dt: control period [s].
    """

    name: str
    weight: float
    reference: Array
    command_before: Array
    position: Array | None
    step_like: bool
    noise: Array
    control_dt: float


def make_task(
    scenario: Scenario, weight: float, duration: float, model: Model, noise: float, seed: int, control_rate: float = 120.0
) -> Task:
    """Sample a scenario's reference and draw its noise."""
    n = round((duration or scenario.duration) * control_rate)
    times = np.arange(n) / control_rate
    m = model.morphology
    before = np.full(len(m.actuators), m.command_low) if scenario.start.command is None else scenario.start.command
    rng = np.random.default_rng(seed)
    return Task(
        name=scenario.name,
        weight=weight,
        reference=np.array([scenario.reference.position(float(t)) for t in times]),
        command_before=np.array(before),
        position=None if scenario.start.position is None else np.array(scenario.start.position),
        step_like=scenario.step_like,
        noise=rng.normal(0.0, noise, (n, len(m.joints))) if noise > 0 else np.zeros((n, len(m.joints))),
        control_dt=1 / control_rate,
    )


@dataclass(frozen=True, eq=False)
class Outcome:
    """One candidate on one leg in one scenario.

    Attributes:
        terms: (5,) error, overshoot, settling, effort, chatter.
        saturation: share of the time at a pressure limit.
        restless: how far the joints still swing in the last quarter of a step-like scenario [rad].
        diverged: whether the simulation left the range where its numbers mean anything.
    """

    terms: Array
    saturation: float
    restless: float
    diverged: bool


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one set of gains is worth.

    Attributes:
        cost: what is minimised; candidates outside the limits lie above all within them.
        terms: weighted sum of each term of the cost over scenarios, over the ensemble's mean.
        member_costs: (n_members,) cost of each leg.
        overshoot: largest over the ensemble, as a share of the step.
        saturation: largest over the ensemble.
        stable: False where any leg diverged or would not come to rest.
        feasible: stable and within the limits.
    """

    cost: float
    terms: dict[str, float]
    member_costs: tuple[float, ...]
    overshoot: float
    saturation: float
    stable: bool
    feasible: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for a journal."""
        return {
            "cost": self.cost,
            "terms": self.terms,
            "member_costs": list(self.member_costs),
            "overshoot": self.overshoot,
            "saturation": self.saturation,
            "stable": self.stable,
            "feasible": self.feasible,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Evaluation:
        """The evaluation in a journal's line."""
        return cls(**{**data, "member_costs": tuple(data["member_costs"])})


@dataclass(frozen=True, eq=False)
class Problem:
    """Scenarios, legs, weights and limits: everything a candidate is judged by.

    Attributes:
        model: the nominal model the controller computes with.
        members: the legs.
        tasks: the scenarios.
        weights: of the terms.
        limits: hard ones.
        steps: physics steps in each control period.
    """

    model: Model
    members: Sequence[Member]
    tasks: Sequence[Task]
    weights: Weights
    limits: Limits
    steps: int = 4
    _starts: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)

    def warm_up(self) -> None:
        """Compile, or load, the kernel and find every leg's rest pose."""
        self.kernel()
        for i, member in enumerate(self.members):
            for j, task in enumerate(self.tasks):
                pose = task.position
                self._starts[i, j] = member.rest(task.command_before, self.model.phase) if pose is None else pose

    def kernel(self) -> Any:
        """The compiled closed loop."""
        return compiled.load(self.model.morphology, self.model.phase, pid_kernel, loop_kernel)

    def simulate(self, settings: PidSettings, member: int, task: int) -> tuple[Array, Array, int]:
        """(angles (n, nj), commands (n, na), steps that went well) of one closed-loop run on the reduced engine."""
        m, t, leg = self.model.morphology, self.tasks[task], self.members[member]
        n, nj = t.reference.shape
        na = len(m.actuators)
        if (member, task) not in self._starts:
            self.warm_up()
        q, u = np.empty((n, nj)), np.empty((n, na))
        done = self.kernel().run_loop(
            leg.parameters,
            pack(m),
            leg.valve,
            settings.gain_matrix(settings.channels(m)),
            settings.space == "length",
            settings.feedforward,
            settings.start_time,
            t.reference,
            np.array(self._starts[member, task]),
            t.command_before,
            np.full(na, m.command_low),
            np.full(na, m.command_high),
            t.control_dt,
            self.steps,
            t.noise,
            q,
            u,
        )
        return q, u, int(done)

    def outcome(self, settings: PidSettings, member: int, task: int) -> Outcome:
        """Judge one run."""
        q, u, done = self.simulate(settings, member, task)
        t, m = self.tasks[task], self.model.morphology
        if done < len(q):
            return Outcome(np.full(len(TERMS), math.inf), 1.0, math.inf, True)
        span = m.command_high - m.command_low
        error = q - t.reference
        overshoot, settling, restless = 0.0, 0.0, 0.0
        if t.step_like:
            step = t.reference[-1] - q[0]
            moved = (q - q[0]) * np.sign(step)
            size = np.maximum(np.abs(step), BAND)
            overshoot = float(np.max((moved.max(axis=0) - np.abs(step)) / size, initial=0.0))
            outside = np.flatnonzero(np.any(np.abs(error) > BAND, axis=1))
            settling = 0.0 if len(outside) == 0 else float((outside[-1] + 1) * t.control_dt)
            restless = float(np.ptp(q[-(len(q) // 4) :], axis=0).max())
        terms = np.array(
            [
                math.sqrt(float((error**2).mean())),
                max(overshoot, 0.0),
                settling,
                math.sqrt(float((((u - m.command_low) / span) ** 2).mean())),
                float(np.abs(np.diff(u, axis=0)).mean()) / span / t.control_dt,
            ]
        )
        saturation = float(((u <= m.command_low) | (u >= m.command_high)).mean())
        return Outcome(terms, saturation, restless, False)

    def judge(self, outcomes: Sequence[Sequence[Outcome]]) -> Evaluation:
        """The cost of outcomes[member][task].

        Stable candidates within the limits cost their weighted terms; those beyond a limit cost 1e3 and more, those
        that diverge or do not come to rest 1e6 and more.
        """
        weights = np.array([getattr(self.weights, key) for key in TERMS])
        shares = np.array([task.weight for task in self.tasks]) / sum(task.weight for task in self.tasks)
        terms = np.array([[o.terms for o in row] for row in outcomes])  # (members, tasks, terms)
        restless = max(o.restless for row in outcomes for o in row)
        diverged = sum(o.diverged for row in outcomes for o in row)
        saturation = max(o.saturation for row in outcomes for o in row)
        overshoot = float(terms[:, :, 1].max())
        stable = diverged == 0 and restless <= 2 * BAND
        if diverged:
            nothing = dict.fromkeys(TERMS, math.nan)
            members = (math.nan,) * len(outcomes)
            return Evaluation(1e9 * diverged, nothing, members, math.inf, saturation, False, False)
        weighted = np.einsum("mtk,t->mk", terms, shares) * weights
        member_costs = weighted.sum(axis=1)
        cost = (1 - self.weights.worst) * member_costs.mean() + self.weights.worst * member_costs.max()
        beyond = max(overshoot - self.limits.overshoot, 0.0) + max(saturation - self.limits.saturation, 0.0)
        if not stable:
            cost = 1e6 * (1 + restless)
        elif beyond > 0:
            cost = 1e3 * (1 + beyond)
        return Evaluation(
            float(cost),
            {key: float(value) for key, value in zip(TERMS, weighted.mean(axis=0), strict=True)},
            tuple(float(c) for c in member_costs),
            overshoot,
            saturation,
            stable,
            bool(stable and beyond == 0),
        )

    def evaluate(self, candidates: Sequence[PidSettings], pool: ThreadPoolExecutor) -> list[Evaluation]:
        """Judge candidates, every leg of every candidate being a job of its own; the order of results is fixed."""
        jobs = [(c, i) for c in range(len(candidates)) for i in range(len(self.members))]

        def work(job: tuple[int, int]) -> list[Outcome]:
            c, i = job
            return [self.outcome(candidates[c], i, j) for j in range(len(self.tasks))]

        rows = list(pool.map(work, jobs))
        n = len(self.members)
        return [self.judge(rows[c * n : (c + 1) * n]) for c in range(len(candidates))]
