"""What a set of gains is worth: its cost and its limits over scenarios and an ensemble of legs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import chain, islice

import numpy as np

from equimus_ctrl.computer import worker_count
from equimus_ctrl.controllers import precompile
from equimus_ctrl.controllers.inverse import Inverse
from equimus_ctrl.controllers.pid_kernel import KD
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.effects.sensors import behind, sensor_settings, shown
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.executors.base import Submits
from equimus_ctrl.models.model import Model
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.tuning import closed_loop
from equimus_ctrl.tuning.closed_loop import Loop, Plan, Tracked, make_plan, track
from equimus_ctrl.tuning.ensemble import Member
from equimus_ctrl.tuning.evaluation import BAND, TERMS, Evaluation, LegOutcome, Outcome, judged
from equimus_ctrl.tuning.stability import SampledLeg, largest_modulus, linear_legs, load_response, sample
from equimus_ctrl.tuning.study import Limits, Weights
from equimus_ctrl.types import Array

CONTROL_RATE = 120.0
"""Of the loop that is tuned [Hz]."""
LOAD = 0.1
"""Of the command range: the load that a leg is looked at with, a size that commands have to spare in most poses."""


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


def make_task(scenario: Scenario, weight: float, duration: float | None, model: Model, noise: float, seed: int) -> Task:
    """Sample a scenario's reference and draw its noise."""
    n = round((duration or scenario.duration) * CONTROL_RATE)
    times = np.arange(n) / CONTROL_RATE
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
        control_dt=1 / CONTROL_RATE,
    )


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
        inverse: whether the controller knows the inverse of the model.
        lateness: of the controller, see ``PidSettings`` [s].
    """

    model: Model
    members: Sequence[Member]
    tasks: Sequence[Task]
    weights: Weights
    limits: Limits
    steps: int = 4
    inverse: bool = False
    lateness: float = 0.0
    _starts: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)
    _legs: dict[tuple[str, int, int], list[SampledLeg]] = field(default_factory=dict, repr=False)
    _plans: dict[tuple[int, int, float, float], Plan] = field(default_factory=dict, repr=False)

    def warm_up(self) -> None:
        """Compile, or load, the kernel and find every leg's rest pose."""
        other = precompile.start(self.model)
        try:
            closed_loop.compile_motion(self.model.morphology, self.model.phase, self.model.effects)
        finally:
            precompile.finish(other)
        for i, member in enumerate(self.members):
            for j, task in enumerate(self.tasks):
                pose = task.position
                self._starts[i, j] = member.rest(task.command_before, self.model.phase) if pose is None else pose

    def poses(self, along: int = 1) -> list[Array]:
        """What is seen where loops are linearised: each step-like target, ``along`` poses of each moving reference."""
        found: list[Array] = []
        for index, task in enumerate(self.tasks):
            n, seen = len(task.reference), self.seen(index)
            found += [
                seen[k] for k in ([n - 1] if task.step_like else [n * (2 * i + 1) // (2 * along) for i in range(along)])
            ]
        return found

    def moduli(self, settings: PidSettings, member: int, along: int = 1, raised: bool = True) -> tuple[float, float]:
        """The largest eigenvalue of a leg's linearised sampled loops: as they are, and with all gains raised.

        Args:
            settings: the gains.
            member: whose loops.
            along: poses of each moving reference.
            raised: whether the second is wanted; it is 0 otherwise.
        """
        m, phase, dt = self.model.morphology, self.model.phase, self.tasks[0].control_dt
        key = (settings.space, member, along)
        if key not in self._legs:
            self._legs[key] = [
                sample(leg, dt)
                for pose in self.poses(along)
                for leg in linear_legs(self.members[member], m, pose, settings.space, phase, self.fed(pose))
            ]
        gains = settings.gain_matrix(settings.channels(m))
        modulus = largest_modulus(self._legs[key], gains)
        if modulus >= 1:
            return modulus, math.nan
        if not raised:
            return modulus, 0.0
        gains[: KD + 1] *= self.limits.gain_margin
        return modulus, largest_modulus(self._legs[key], gains)

    def give(self, settings: PidSettings, member: int) -> float:
        """How far a leg gives way to loads of ``LOAD`` of the command range; the most over all poses [rad √s]."""
        m = self.model.morphology
        load = LOAD * (m.command_high - m.command_low) * np.ones(len(m.actuators))
        gains = settings.gain_matrix(settings.channels(m))
        return max(load_response(leg, gains, load) for leg in self._legs[settings.space, member, 1])

    def verified(self, settings: PidSettings) -> bool:
        """Whether the loops of every leg keep the gain margin at eight poses along each moving reference too.

        The slowest mode may come half as close again to 1 there as the limit says.
        """
        slowest = (1 + self.limits.modulus) / 2
        pairs = [self.moduli(settings, i, 8) for i in range(len(self.members))]
        return all(modulus <= slowest and raised < 1 for modulus, raised in pairs)

    def code(self) -> str:
        """Which compiled closed loop and which equations of motion there are."""
        robot, phase = self.model.morphology, self.model.phase
        lanes = closed_loop.lanes_of(robot, phase, self.model.effects)
        return f"{closed_loop.kernel_of(robot, phase).__name__} {lanes.key}"

    def simulate_all(self, runs: Sequence[tuple[PidSettings, int]], task: int) -> list[Tracked]:
        """Closed-loop runs of one scenario on the reduced engine, side by side.

        Args:
            runs: settings and leg of each.
            task: the scenario.
        """
        if any((member, task) not in self._starts for _, member in runs):
            self.warm_up()
        loops = [
            Loop(
                settings,
                self.members[i],
                np.array(self._starts[i, task]),
                self._plan(i, task, settings) if self.inverse else None,
            )
            for settings, i in runs
        ]
        return track(self.model.morphology, self.model.phase, self.tasks[task], loops, self.steps)

    def _plan(self, member: int, task: int, settings: PidSettings) -> Plan:
        starts = settings.start_time, settings.late_start
        key = (member, task, *starts)
        if key not in self._plans:
            begin = self._starts[member, task]
            self._plans[key] = make_plan(self.model, self.tasks[task], self.members[member], begin, *starts)
        return self._plans[key]

    def simulate(self, settings: PidSettings, member: int, task: int) -> tuple[Array, Array, int]:
        """(angles (n, nj), commands (n, na), steps that went well) of one closed-loop run on the reduced engine."""
        (run,) = self.simulate_all([(settings, member)], task)
        return run.position, run.command, run.sound

    def outcomes(self, runs: Sequence[tuple[PidSettings, int]], task: int) -> list[Outcome]:
        """Judge runs of one scenario, see ``simulate_all``."""
        return [self._judged(run, task) for run in self.simulate_all(runs, task)]

    def outcome(self, settings: PidSettings, member: int, task: int) -> Outcome:
        """Judge one run."""
        return self.outcomes([(settings, member)], task)[0]

    def wanted(self, task: int) -> Array:
        """(n, nj) the true angles that are to be [rad].

        Where the controller knows no inverse, those that the sensors show as the reference: no gains undo a sensor.
        """
        reference, sensor = self.tasks[task].reference, self._sensor()
        return reference if self.inverse else behind(sensor, reference)

    def seen(self, task: int) -> Array:
        """(n, nj) what the sensors show then, once they have caught up [rad]."""
        reference, sensor = self.tasks[task].reference, self._sensor()
        return shown(sensor, reference) if self.inverse else reference

    def fed(self, pose: Array) -> Array | None:
        """(na,) what is fed forward at rest where ``pose`` is seen [Pa]; None for the static pressures."""
        if not self.inverse:
            return None
        known = Inverse(self.model, self.tasks[0].control_dt, 0.0)
        return known.hold(known.start(0.0, pose))

    def _sensor(self) -> Array:
        return sensor_settings(self.model.effects, self.model.morphology.joint_names)

    def _judged(self, run: Tracked, task: int) -> Outcome:
        q, u, wanted = run.position, run.command, self.wanted(task)
        t, m = self.tasks[task], self.model.morphology
        if run.sound < len(q):
            return Outcome(np.full(len(TERMS), math.inf), 1.0, math.inf, True)
        span = m.command_high - m.command_low
        error = q - wanted
        overshoot, settling, offset, restless = 0.0, 0.0, 0.0, 0.0
        if t.step_like:
            step = wanted[-1] - q[0]
            size = np.maximum(np.abs(step), BAND)
            # A joint that is to stay about where it is overshoots in either direction.
            beyond = np.where(np.abs(step) > BAND, error * np.sign(step), np.abs(error))
            overshoot = float(np.max(beyond.max(axis=0) / size, initial=0.0))
            outside = np.flatnonzero(np.any(np.abs(error) > self.weights.settled, axis=1))
            settling = 0.0 if len(outside) == 0 else float((outside[-1] + 1) * t.control_dt)
            last_quarter = slice(-(len(q) // 4), None)
            restless = float(np.ptp(q[last_quarter], axis=0).max())
            offset = math.sqrt(float((error[last_quarter] ** 2).mean()))
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

    def leg_outcomes(self, runs: Sequence[tuple[PidSettings, int]], raised: bool = True) -> list[LegOutcome]:
        """Judge legs: every scenario, and the linearised loop where the runs went well.

        Args:
            runs: settings and leg of each.
            raised: whether the gain margin counts on every leg; else, as while searching, on the first two only: the
                model, and the one that is hardest to keep stable. ``verified`` looks at all of them.
        """
        found = []
        by_task = [self.outcomes(runs, task) for task in range(len(self.tasks))]
        for (settings, member), *own in zip(runs, *by_task, strict=True):
            calm = not any(run.diverged or run.restless > BAND for run in own)
            moduli = self.moduli(settings, member, raised=raised or member <= 1) if calm else (math.nan, math.nan)
            give = self.give(settings, member) if self.weights.give and moduli[0] < 1 else 0.0
            found.append(LegOutcome(own, *moduli, give))
        return found

    def judge(self, legs: Sequence[LegOutcome]) -> Evaluation:
        """The cost of what happened on every leg, see ``judged``."""
        return judged(legs, [task.weight for task in self.tasks], self.weights, self.limits)

    def evaluate(
        self, candidates: Sequence[PidSettings], pool: Submits, workers: int | None = None
    ) -> Iterator[Evaluation]:
        """Judge candidates in their order, legs of several candidates running side by side.

        Candidates that fail on the leg that is hardest to keep stable are not tried on the others.

        Args:
            candidates: sets of gains.
            pool: where the work is done.
            workers: so many; as many as there are cores by default. The result does not depend on it.
        """
        hardest = min(1, len(self.members) - 1)
        rest = [i for i in range(len(self.members)) if i != hardest]
        jobs: list[Future[list[LegOutcome]]] = []

        def submit(runs: Sequence[tuple[PidSettings, int]]) -> list[Future[list[LegOutcome]]]:
            # Few runs are shared out over all threads rather than put side by side.
            size = max(min(LANES, math.ceil(len(runs) / worker_count(workers))), 1)
            own = [pool.submit(self.leg_outcomes, runs[k : k + size], False) for k in range(0, len(runs), size)]
            jobs.extend(own)
            return own

        try:
            begun, left = [], iter(candidates)
            for job in submit([(settings, hardest) for settings in candidates]):
                first = job.result()
                calm = [settings for leg, settings in zip(first, left, strict=False) if leg.calm]
                begun.append((first, submit([(settings, i) for settings in calm for i in rest])))
            for first, later in begun:
                others = chain.from_iterable(job.result() for job in later)
                for leg in first:
                    legs = list(islice(others, len(rest))) if leg.calm else []
                    legs.insert(hardest, leg)
                    yield self.judge(legs)
        finally:
            for job in jobs:
                job.cancel()
