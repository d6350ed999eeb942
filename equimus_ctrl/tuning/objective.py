"""What a set of gains is worth: its cost and its limits over scenarios and an ensemble of legs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from equimus_ctrl.controllers import precompile
from equimus_ctrl.controllers.pid import PidSettings
from equimus_ctrl.controllers.pid_kernel import KD
from equimus_ctrl.engines import compiled
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.morphology import pack
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning import loop_kernel
from equimus_ctrl.tuning.ensemble import Member
from equimus_ctrl.tuning.stability import SampledLeg, largest_modulus, linear_leg, sample
from equimus_ctrl.tuning.study import Limits, Weights
from equimus_ctrl.types import Array

BAND = 0.03
"""A joint has settled when it stays this close to its reference [rad]."""
TERMS = ("error", "overshoot", "settling", "offset", "effort", "chatter")


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
    scenario: Scenario,
    weight: float,
    duration: float,
    model: Model,
    noise: float,
    seed: int,
    control_rate: float = 120.0,
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
        terms: (6,) error, overshoot, settling, offset, effort, chatter.
        saturation: share of the time at a pressure limit.
        restless: how far the joints still swing in the last quarter of a step-like scenario [rad].
        diverged: whether the simulation left the range where its numbers mean anything.
    """

    terms: Array
    saturation: float
    restless: float
    diverged: bool


@dataclass(frozen=True, eq=False)
class LegOutcome:
    """One candidate on one leg.

    Attributes:
        runs: one for each scenario.
        modulus: largest eigenvalue of its linearised sampled loops; NaN where a run already failed.
        raised_modulus: the same with all gains raised by the gain margin asked for.
    """

    runs: Sequence[Outcome]
    modulus: float
    raised_modulus: float

    @property
    def calm(self) -> bool:
        """Whether every run stayed in range and came to rest, and the linearised loops are stable."""
        return not any(run.diverged or run.restless > BAND for run in self.runs) and self.modulus < 1


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one set of gains is worth.

    Attributes:
        cost: what is minimised; candidates outside the limits lie above all within them.
        terms: weighted sum of each term of the cost over scenarios, over the ensemble's mean.
        member_costs: (n_members,) cost of each leg.
        overshoot: largest over the ensemble, as a share of the step.
        saturation: largest over the ensemble.
        modulus: largest eigenvalue of the linearised sampled loops; NaN where a run already failed.
        raised_modulus: the same with all gains raised by the gain margin asked for.
        stable: False where any leg diverged, would not come to rest, or has a loop that is not stable.
        feasible: stable and within the limits.
    """

    cost: float
    terms: dict[str, float]
    member_costs: tuple[float, ...]
    overshoot: float
    saturation: float
    modulus: float
    raised_modulus: float
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
            "modulus": self.modulus,
            "raised_modulus": self.raised_modulus,
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
    _legs: dict[tuple[str, int, int], list[SampledLeg]] = field(default_factory=dict, repr=False)

    def warm_up(self) -> None:
        """Compile, or load, the kernel and find every leg's rest pose."""
        other = precompile.start(self.model)
        try:
            compiled.compile_motion(self.model.morphology, self.model.phase)
        finally:
            precompile.finish(other)
        for i, member in enumerate(self.members):
            for j, task in enumerate(self.tasks):
                pose = task.position
                self._starts[i, j] = member.rest(task.command_before, self.model.phase) if pose is None else pose

    def poses(self, along: int = 1) -> list[Array]:
        """Where the loops are linearised: each step-like target, and ``along`` poses of each moving reference."""
        found: list[Array] = []
        for task in self.tasks:
            n = len(task.reference)
            found += [
                task.reference[k]
                for k in ([n - 1] if task.step_like else [n * (2 * i + 1) // (2 * along) for i in range(along)])
            ]
        return found

    def moduli(self, settings: PidSettings, member: int, along: int = 1) -> tuple[float, float]:
        """The largest eigenvalue of a leg's linearised sampled loops: as they are, and with all gains raised.

        While searching (``along`` = 1) the second is computed on the first two legs only, the model and the one that
        is hardest to keep stable, and is 0 on the others; ``verified`` looks at all of them.
        """
        m, phase, dt = self.model.morphology, self.model.phase, self.tasks[0].control_dt
        key = (settings.space, member, along)
        if key not in self._legs:
            self._legs[key] = [
                sample(linear_leg(self.members[member], m, pose, settings.space, phase), dt)
                for pose in self.poses(along)
            ]
        gains = settings.gain_matrix(settings.channels(m))
        modulus = largest_modulus(self._legs[key], gains)
        if modulus >= 1:
            return modulus, math.nan
        if along == 1 and member > 1:
            return modulus, 0.0
        gains[: KD + 1] *= self.limits.gain_margin
        return modulus, largest_modulus(self._legs[key], gains)

    def verified(self, settings: PidSettings) -> bool:
        """Whether the loops of every leg keep the gain margin at eight poses along each moving reference too.

        The slowest mode may come half as close again to 1 there as the limit says.
        """
        slowest = (1 + self.limits.modulus) / 2
        pairs = [self.moduli(settings, i, 8) for i in range(len(self.members))]
        return all(modulus <= slowest and raised < 1 for modulus, raised in pairs)

    def kernel(self) -> Any:
        """The compiled closed loop."""
        return compiled.load(self.model.morphology, self.model.phase, loop_kernel)

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
            np.zeros(nj),
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
        overshoot, settling, offset, restless = 0.0, 0.0, 0.0, 0.0
        if t.step_like:
            step = t.reference[-1] - q[0]
            size = np.maximum(np.abs(step), BAND)
            # A joint that is to stay about where it is overshoots in either direction.
            beyond = np.where(np.abs(step) > BAND, error * np.sign(step), np.abs(error))
            overshoot = float(np.max(beyond.max(axis=0) / size, initial=0.0))
            outside = np.flatnonzero(np.any(np.abs(error) > BAND, axis=1))
            settling = 0.0 if len(outside) == 0 else float((outside[-1] + 1) * t.control_dt)
            late = slice(-(len(q) // 4), None)
            restless = float(np.ptp(q[late], axis=0).max())
            offset = math.sqrt(float((error[late] ** 2).mean()))
        terms = np.array(
            [
                math.sqrt(float((error**2).mean())),
                max(overshoot, 0.0),
                settling,
                offset,
                math.sqrt(float((((u - m.command_low) / span) ** 2).mean())),
                float(np.abs(np.diff(u, axis=0)).mean()) / span / t.control_dt,
            ]
        )
        saturation = float(((u <= m.command_low) | (u >= m.command_high)).mean())
        return Outcome(terms, saturation, restless, False)

    def leg_outcome(self, settings: PidSettings, member: int) -> LegOutcome:
        """Judge one leg: every scenario, and the linearised loop where the runs went well."""
        runs = [self.outcome(settings, member, task) for task in range(len(self.tasks))]
        calm = not any(run.diverged or run.restless > BAND for run in runs)
        modulus, raised = self.moduli(settings, member) if calm else (math.nan, math.nan)
        return LegOutcome(runs, modulus, raised)

    def judge(self, legs: Sequence[LegOutcome]) -> Evaluation:
        """The cost of what happened on every leg.

        Stable candidates within the limits cost their weighted terms; those beyond a limit cost 1e3 and more, those
        that diverge, do not come to rest or have an unstable linearised loop 1e6 and more.
        """
        weights = np.array([getattr(self.weights, key) for key in TERMS])
        shares = np.array([task.weight for task in self.tasks]) / sum(task.weight for task in self.tasks)
        terms = np.array([[run.terms for run in leg.runs] for leg in legs])  # (members, tasks, terms)
        runs = [run for leg in legs for run in leg.runs]
        restless = max(run.restless for run in runs)
        diverged = sum(run.diverged for run in runs)
        saturation = max(run.saturation for run in runs)
        overshoot = float(terms[:, :, 1].max())
        calm = diverged == 0 and restless <= BAND
        if diverged:
            nothing = dict.fromkeys(TERMS, math.nan)
            members = (math.nan,) * len(legs)
            return Evaluation(1e9 * diverged, nothing, members, math.inf, saturation, math.nan, math.nan, False, False)
        weighted = np.einsum("mtk,t->mk", terms, shares) * weights
        member_costs = weighted.sum(axis=1)
        cost = (1 - self.weights.worst) * member_costs.mean() + self.weights.worst * member_costs.max()
        beyond = max(overshoot - self.limits.overshoot, 0.0) + max(saturation - self.limits.saturation, 0.0)
        modulus = max(leg.modulus for leg in legs) if calm else math.nan
        stable = calm and modulus < 1
        raised = max(leg.raised_modulus for leg in legs) if stable else math.nan
        feasible = bool(stable and beyond == 0 and modulus <= self.limits.modulus and raised < 1)
        if not calm:
            cost = 1e6 * (1 + restless)
        elif not stable:
            cost = 1e6 * modulus
        elif not feasible:
            slow = max(modulus - self.limits.modulus, 0.0) / (1 - self.limits.modulus)
            cost = 1e3 * (1 + beyond + slow + 10 * max(raised - 1, 0.0))
        return Evaluation(
            float(cost),
            {key: float(value) for key, value in zip(TERMS, weighted.mean(axis=0), strict=True)},
            tuple(float(c) for c in member_costs),
            overshoot,
            saturation,
            modulus,
            raised,
            stable,
            feasible,
        )

    def evaluate(self, candidates: Sequence[PidSettings], pool: ThreadPoolExecutor) -> Iterator[Evaluation]:
        """Judge candidates in their order, every leg of every candidate being a job of its own.

        Candidates that fail on the leg that is hardest to keep stable are not tried on the others.
        """
        n = len(self.members)
        hardest = min(1, n - 1)
        rest = [i for i in range(n) if i != hardest]
        jobs = [{hardest: pool.submit(self.leg_outcome, settings, hardest)} for settings in candidates]
        try:
            for settings, job in zip(candidates, jobs, strict=True):
                if job[hardest].result().calm:
                    job.update({i: pool.submit(self.leg_outcome, settings, i) for i in rest})
            for job in jobs:
                yield self.judge([job[i].result() for i in sorted(job)])
        finally:
            for job in jobs:
                for future in job.values():
                    future.cancel()
