"""Where experiments are looked for: rivals under one known condition, at rest, and how they move from there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.mjcf_tracked import Followed
from equimus_ctrl.engines.predict import in_its_condition
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError, ModelError, NotAvailable
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import CommandBounds, Family
from equimus_ctrl.experiments.limits import Excess, Limits, Motions, shrunk
from equimus_ctrl.experiments.predicted import SETTLING, STILL, Commands, as_noted, closed_loop_engine, resting
from equimus_ctrl.identification.noise import drawn_noise
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, FeedbackLaw, Recording

THERE = 1e-2
"""How near to a pose a robot has to rest that is to rest there [rad or m]."""
FEW_JOINTS = 3
"""Robots of more take long to simulate: their equations grow with the square of that, their parameters with it."""
FASTEST, SAMPLES_A_PERIOD = 4.0, 30.0
"""Natural frequency of feedback that nobody chose [Hz], and how many samples a period of it has at least."""
SLOWER = 4
"""So many frequencies are tried, each half the one before."""
LEAST_ACCELERATION = 1e-6
"""Of a reference where drives can only just hold the pose [rad/s² or m/s²]."""
LEAD = 2.0
"""How long robots that need not start at rest are held by the command at rest before a trial, so that each explanation
comes to where it rests by itself [s]."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Rivals under a known condition, at rest.

    Attributes:
        rivals: between which an experiment is to decide.
        limits: that it must not leave.
        condition: that is known to be different in it.
        simulator: of the rivals.
        rest: of the course that is designed, with which it begins and ends: (na,) the command at rest, or where joints
            track references (nj,) their pose [rad or m].
        pose: (nj,) where robots that need not start at rest are then [rad or m]; None where each model says it.
        law: of the feedback, where joints track references; None where commands are played.
        acceleration: (nj,) that references may have then [rad/s² or m/s²], see ``_possible``.
    """

    rivals: Rivals
    limits: Limits
    condition: KnownCondition
    simulator: Simulator
    rest: Array
    pose: Array | None
    law: FeedbackLaw | None = None
    acceleration: Array | None = None

    @classmethod
    def of(
        cls, rivals: Rivals, limits: Limits, condition: KnownCondition, simulator: Simulator, track: float | None = None
    ) -> Ground:
        """Where the robot rests under the condition.

        It rests under the command that was in force before its recordings, where it does; else under that which holds
        the pose in which they began, or under none. Where it rests under none of them within the limits of its joints,
        it is held by feedback.

        Args:
            rivals: between which an experiment is to decide.
            limits: that it must not leave.
            condition: that is known to be different in it.
            simulator: of the rivals.
            track: natural frequency of the feedback by which joints track references [Hz]; by default they do where
                the robot rests under no constant command, as quickly as all rivals can.

        Raises:
            ConfigError: where it rests neither under a constant command nor held by feedback.
        """
        if track is not None:
            return cls._held(rivals, limits, condition, simulator, [track])
        try:
            return cls._at_rest(rivals, limits, condition, simulator)
        except ConfigError as refused:
            try:
                most = min(FASTEST, rivals.rate / SAMPLES_A_PERIOD)
                return cls._held(rivals, limits, condition, simulator, [most * 0.5**k for k in range(SLOWER)])
            except ConfigError as error:
                raise ConfigError(f"{refused}; nor can it track references by feedback: {error}") from None

    @classmethod
    def _held(
        cls,
        rivals: Rivals,
        limits: Limits,
        condition: KnownCondition,
        simulator: Simulator,
        frequencies: Sequence[float],
    ) -> Ground:
        """By feedback in the pose in which recordings began; of some frequencies by the first that holds all rivals."""
        robot = rivals.model.robot
        if rivals.linear:
            raise ConfigError(f"commands of {robot.name} go along lines from row to row, expected held ones")
        begin = rivals.start.copy()
        for joint, value in condition.pose.items():
            begin[robot.joint_names.index(joint)] = value
        nominal = as_noted(rivals.model, condition.notes)
        engine = closed_loop_engine(nominal)
        begin = engine.balanced(nominal, begin[None])[0]
        unsteady = ""
        for frequency in frequencies:
            law = engine.law_at(nominal, begin, float(frequency), 1 / rivals.rate)
            found = cls(rivals, limits, condition, simulator, begin, begin, law)
            if not (unsteady := found._unsteady()):
                return replace(found, acceleration=found._possible(engine.by_acceleration(nominal, begin)))
        tried = " or ".join(f"{frequency:.3g} Hz" for frequency in frequencies)
        raise ConfigError(f"{unsteady} does not come to rest under feedback of {tried}, expected another --track")

    def _possible(self, by_acceleration: Array) -> Array:
        """(nj,) accelerations of each joint alone that the drives can do beside holding the nominal robot's pose.

        What they ask for in other poses, together and at speed, closed loops tell.

        Args:
            by_acceleration: (na, nj) commands by accelerations.
        """
        limits, held = self.limits, self.trial(np.tile(self.rest, (len(self.times), 1))).commands[0]
        room = np.minimum(limits.command_high - held, held - limits.command_low)
        with np.errstate(divide="ignore"):
            found = (room[:, None] / np.abs(by_acceleration)).min(axis=0)
        return np.asarray(np.maximum(found, LEAST_ACCELERATION))

    def _unsteady(self) -> str:
        """A rival that feedback does not bring to rest within ``SETTLING``, by its name; empty where there is none."""
        models = [rival.model for rival in self.rivals.rivals]
        still = self.trial(np.tile(self.rest, (len(self.times), 1)))
        nj, sigma = len(self.rest), np.array([own.sigma for own in self.rivals.noise[: len(self.rest)]])
        for rival, model in zip(self.rivals.rivals, models, strict=True):
            starts = np.concatenate([self.rest, np.zeros(nj)])[None]
            found = self._followed([model], still, starts, SETTLING, None).predicted
            assert found.motion is not None
            late = found.motion[0, -max(round(STILL * self.rivals.rate), 2) :, :nj]
            if not (found.sound[0] and np.all(np.ptp(late, axis=0) < sigma)):
                return f"{model.robot.name} with {rival.label}"
        return ""

    @classmethod
    def _at_rest(cls, rivals: Rivals, limits: Limits, condition: KnownCondition, simulator: Simulator) -> Ground:
        """Under a constant command."""
        robot, first = rivals.model.robot, rivals.rivals[0].model
        low, high = limits.command_low, limits.command_high
        if robot.traits.starts_at_rest:
            rest = condition.rest_command(first, rivals.rest)
            return cls(rivals, limits, condition, simulator, np.clip(rest, low, high), None)
        here = as_noted(first, condition.notes)
        begin = rivals.start.copy()
        for joint, value in condition.pose.items():
            begin[robot.joint_names.index(joint)] = value
        refused: ConfigError | None = None
        for command in _at_rest(rivals, here, begin, condition):
            try:
                own = np.clip(command, low, high)
                pose = resting(rivals, here, own, simulator, begin, beside=True)
            except ConfigError as error:
                refused = refused or error
                continue
            if outside := limits.rests_outside(pose):
                refused = refused or ConfigError(f"{robot.name} rests under a constant command with {outside}")
                continue
            if all(abs(pose[robot.joint_names.index(j)] - v) <= THERE for j, v in condition.pose.items()):
                return cls(rivals, limits, condition, simulator, own, pose)
        raise refused or ConfigError(f"{condition.text}: {robot.name} does not rest there under any command")

    @property
    def takes_long(self) -> bool:
        """Whether a simulation takes long: of an engine that is costly, or of a robot of many joints."""
        return self.simulator.engine.costly or len(self.rivals.model.robot.joint_names) > FEW_JOINTS

    @cached_property
    def bounds(self) -> CommandBounds:
        """Of the course that is designed."""
        if self.law is None or self.acceleration is None:
            return self.limits.bounds(self.rest)
        return self.limits.reference_bounds(self.rest, self.acceleration)

    @cached_property
    def times(self) -> Array:
        """(n,) instants of the commands: those at which positions are recorded [s]."""
        count = round(self.limits.duration * self.rivals.rate)
        return np.asarray(np.arange(max(count, 2)) / self.rivals.rate)

    def commands(self, family: Family, z: Array, amplitude: float) -> Commands:
        """A design, see ``Family.commands``."""
        return self.trial(family.commands(z, self.times, self.bounds, amplitude))

    def trial(self, course: Array) -> Commands:
        """Of a course at the instants of the ground: commands (n, na), or references of joints (n, nj)."""
        notes, lasts = self.condition.notes, self.limits.duration
        if self.law is None:
            return Commands(self.times, course, lasts, self.pose, notes)
        nominal = as_noted(self.rivals.model, notes)
        engine = closed_loop_engine(nominal)
        course = engine.balanced(nominal, course)
        feed = engine.fed_forward(nominal, self.times, course)
        feed = np.clip(feed, self.limits.command_low, self.limits.command_high)
        return Commands(self.times, feed, lasts, self.pose, notes, course, self.law)

    def _followed(
        self, models: Sequence[Model], own: Commands, starts: Array, lead: float, noise: Array | None
    ) -> Followed:
        """What models do in closed loop; what is sampled begins after the lead [s]."""
        robot, rate = self.rivals.model.robot, self.rivals.rate
        times, feed, reference = own.tracked(rate, lead)
        bare = Recording(
            "trial", np.zeros(1), np.zeros((1, len(robot.actuator_names))), np.zeros((1, len(robot.joint_names))),
            robot.actuator_names, robot.joint_names, notes=self.condition.notes,
        )  # fmt: skip
        shown = times[round(lead * rate) :]
        trial = Trial("trial", times, feed, feed[0], float(times[0]), starts[0, : len(robot.joint_names)], shown)
        trial = in_its_condition(self.rivals.model, bare, trial)
        assert own.law is not None
        engine = closed_loop_engine(self.rivals.model)
        return engine.tracked(models, trial, reference, own.law, starts, noise, self.simulator.threads)

    def crowd(self, models: Sequence[Model]) -> Crowd:
        """Models at rest here, without those that rest nowhere: the robot did before it was recorded.

        Raises:
            ModelError: where none rests.
        """
        nj = len(self.rivals.model.robot.joint_names)
        if self.pose is not None:
            starts = np.tile(np.append(self.pose, np.zeros(nj)), (len(models), 1))
            disturbed = None if self.law is None else self._noise(len(models))
            return Crowd(self, tuple(models), starts, LEAD, disturbed)
        resting, rests, refused = list[Model](), list[Array](), list[ModelError]()
        for model in models:
            try:
                rests.append(rest_pose(as_noted(model, self.condition.notes), self.rest))
                resting.append(model)
            except ModelError as error:
                refused.append(error)
        if not resting:
            raise refused[0]
        return Crowd(self, tuple(resting), np.column_stack([rests, np.zeros((len(rests), nj))]), 0.0)

    def _noise(self, count: int) -> Array:
        """(count, n, nj) that sensors of so many models have through a lead and a trial, the same for all designs."""
        rate, nj = self.rivals.rate, len(self.rivals.model.robot.joint_names)
        times = np.arange(round(LEAD * rate) + len(self.times)) / rate
        rng, noise = np.random.default_rng(count), self.rivals.noise[:nj]
        return np.array([drawn_noise(noise, times, rng.standard_normal((2, len(times), nj))) for _ in range(count)])


@dataclass(frozen=True, eq=False)
class Crowd:
    """Models that begin at rest.

    Attributes:
        ground: where.
        models: k of one robot.
        starts: (k, 2 nj) of each.
        lead: how long the command at rest is in force before a trial [s].
        noise: (k, n, nj) of their sensors, as feedback sees them, through the lead and a trial; None where commands are
            played.
    """

    ground: Ground
    models: tuple[Model, ...]
    starts: Array
    lead: float
    noise: Array | None = None

    def motions(self, commands: Sequence[Commands]) -> list[Motions]:
        """What they do under each of some commands."""
        if self.ground.law is not None:
            skipped = round(self.lead * self.ground.rivals.rate)
            return [
                replace(
                    Motions.of([own.predicted], c.sampled(self.ground.rivals.rate)[0]), command=own.asked[:, skipped:]
                )
                for own, c in zip(self._tracked(commands), commands, strict=True)
            ]
        found = self.predicted(commands)
        return [
            Motions.of([own], c.sampled(self.ground.rivals.rate)[0]) for own, c in zip(found, commands, strict=True)
        ]

    def predicted(self, commands: Sequence[Commands]) -> list[Predicted]:
        """The same as their sensors show it, with their true motion."""
        if self.ground.law is not None:
            return [own.predicted for own in self._tracked(commands)]
        ground, trials = self.ground, list[Trial]()
        robot, linear = ground.rivals.model.robot, ground.rivals.linear
        nj, na = len(robot.joint_names), len(robot.actuator_names)
        bare = Recording(
            "trial", np.zeros(1), np.zeros((1, na)), np.zeros((1, nj)), robot.actuator_names, robot.joint_names,
            notes=ground.condition.notes,
        )  # fmt: skip
        for own in commands:
            times, rows = own.sampled(ground.rivals.rate, linear)
            start = float(times[0]) - self.lead
            trial = Trial("trial", times, rows, rows[0], start, self.starts[0, :nj], times, linear=linear, inner=True)
            trials.append(in_its_condition(ground.rivals.model, bare, trial))
        starts = [self.starts] * len(trials)
        return ground.simulator.engine.simulate(self.models, trials, starts, ground.simulator.threads)

    def _tracked(self, commands: Sequence[Commands]) -> list[Followed]:
        return [self.ground._followed(self.models, own, self.starts, self.lead, self.noise) for own in commands]

    def part(self, places: Sequence[int]) -> Crowd:
        """Some of them."""
        chosen = list(places)
        noise = None if self.noise is None else self.noise[chosen]
        return replace(self, models=tuple(self.models[k] for k in places), starts=self.starts[chosen], noise=noise)

    def within(self, course: Array) -> tuple[float, Excess]:
        """The share of a course about rest with which none of them leaves the limits, see ``limits.shrunk``.

        It is shrunk until those stay within the limits that left them farthest, then all of them are looked at again:
        what is given holds for all.

        Raises:
            ConfigError: where even one at rest leaves them.
        """
        ground, share, farthest = self.ground, 1.0, list[int]()

        def at(amplitude: float) -> Commands:
            return ground.trial(ground.rest + amplitude * (course - ground.rest))

        while True:
            (motions,) = self.motions([at(share)])
            found = ground.limits.excess(motions)
            if not found.left:
                return share, found
            if share == 0.0:
                raise ConfigError(f"a robot at rest leaves the limits: {found}")
            farthest += [k for k, by in zip(found.model, found.by, strict=True) if by > 0 and k not in farthest]
            smaller, _ = shrunk(self.part(farthest)._scaled(at, share), ground.limits)
            share *= smaller if smaller < 1.0 else 0.0

    def _scaled(self, at: Callable[[float], Commands], largest: float) -> Callable[[float], Motions]:
        return lambda share: self.motions([at(share * largest)])[0]


def _at_rest(rivals: Rivals, model: Model, begin: Array, condition: KnownCondition) -> list[Array]:
    """Commands (na,) under which a robot that need not start at rest may rest, the likeliest first."""
    found = [] if condition.pose else [rivals.rest]
    # What holds a pose is the same without dry friction that grows with the load, which no equations hold.
    loading = [own for own in model.effects if isinstance(own, ForceEffect) and own.loads]
    for own in (model, replace(model, effects=tuple(e for e in model.effects if e not in loading))):
        with suppress(ModelError, NotAvailable):
            found.append(Dynamics(own).holding(begin)[0])
            break
    return found if condition.pose else [*found, np.zeros(len(rivals.rest))]
