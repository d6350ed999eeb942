"""Where experiments are looked for: rivals under one known condition, at rest, and how they move from there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.engines.predict import in_its_condition
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError, ModelError, NotAvailable
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import CommandBounds, Family
from equimus_ctrl.experiments.limits import Excess, Limits, Motions, shrunk
from equimus_ctrl.experiments.predicted import Commands, as_noted, resting
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, Recording

THERE = 1e-2
"""How near to a pose a robot has to rest that is to rest there [rad or m]."""
FEW_JOINTS = 3
"""Robots of more take long to simulate: their equations grow with the square of that, their parameters with it."""
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
        rest: (na,) command at rest, with which it begins and ends.
        pose: (nj,) where robots that need not start at rest are then [rad or m]; None where each model says it.
    """

    rivals: Rivals
    limits: Limits
    condition: KnownCondition
    simulator: Simulator
    rest: Array
    pose: Array | None

    @classmethod
    def of(cls, rivals: Rivals, limits: Limits, condition: KnownCondition, simulator: Simulator) -> Ground:
        """Where the robot rests under the condition.

        It rests under the command that was in force before its recordings, where it does; else under that which holds
        the pose in which they began, or under none.

        Raises:
            ConfigError: where it rests under none of them.
        """
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
                pose = resting(rivals, here, own, simulator, begin)
            except ConfigError as error:
                refused = refused or error
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
        """Of the commands."""
        return self.limits.bounds(self.rest)

    @cached_property
    def times(self) -> Array:
        """(n,) instants of the commands: those at which positions are recorded [s]."""
        count = round(self.limits.duration * self.rivals.rate)
        return np.asarray(np.arange(max(count, 2)) / self.rivals.rate)

    def commands(self, family: Family, z: Array, amplitude: float) -> Commands:
        """A design, see ``Family.commands``."""
        return self.trial(family.commands(z, self.times, self.bounds, amplitude))

    def trial(self, course: Array) -> Commands:
        """Of a course of commands (n, na) at the instants of the ground."""
        return Commands(self.times, course, self.limits.duration, self.pose, self.condition.notes)

    def crowd(self, models: Sequence[Model]) -> Crowd:
        """Models at rest here."""
        nj = len(self.rivals.model.robot.joint_names)
        if self.pose is not None:
            return Crowd(self, tuple(models), np.tile(np.append(self.pose, np.zeros(nj)), (len(models), 1)), LEAD)
        rests = [rest_pose(as_noted(model, self.condition.notes), self.rest) for model in models]
        return Crowd(self, tuple(models), np.column_stack([rests, np.zeros((len(models), nj))]), 0.0)


@dataclass(frozen=True, eq=False)
class Crowd:
    """Models that begin at rest.

    Attributes:
        ground: where.
        models: k of one robot.
        starts: (k, 2 nj) of each.
        lead: how long the command at rest is in force before a trial [s].
    """

    ground: Ground
    models: tuple[Model, ...]
    starts: Array
    lead: float

    def motions(self, commands: Sequence[Commands]) -> list[Motions]:
        """What they do under each of some commands."""
        found = self.predicted(commands)
        return [
            Motions.of([own], c.sampled(self.ground.rivals.rate)[0]) for own, c in zip(found, commands, strict=True)
        ]

    def predicted(self, commands: Sequence[Commands]) -> list[Predicted]:
        """The same as their sensors show it, with their true motion."""
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

    def part(self, places: Sequence[int]) -> Crowd:
        """Some of them."""
        return replace(self, models=tuple(self.models[k] for k in places), starts=self.starts[list(places)])

    def within(self, course: Array) -> tuple[float, Excess]:
        """The share of a course (n, na) about rest with which none of them leaves the limits, see ``limits.shrunk``.

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
    with suppress(ModelError, NotAvailable):
        found.append(Dynamics(model).holding(begin)[0])
    return found if condition.pose else [*found, np.zeros(len(rivals.rest))]
