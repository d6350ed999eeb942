"""What is simulated, and what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.engines.limits import MOST_STEPS
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.recordings.smoothing import RecordedMotion
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, PrescribedMotion, Recording

R = TypeVar("R", bound=Robot)
Condition = tuple[tuple[tuple[str, float], ...], ...]


class Same:
    """An array as a key: equal to itself alone, whatever it holds, and alive as long as the key is."""

    __slots__ = ("array",)

    def __init__(self, array: Array) -> None:
        self.array = array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.array is self.array

    def __hash__(self) -> int:
        return object.__hash__(self.array)


def robot_with(
    robot: R, settings: Mapping[str, float], factors: Mapping[str, float], payloads: Mapping[str, float]
) -> R:
    """A robot with some numbers that are known to be others, factors on some, and masses [kg] that it carries."""
    if settings or factors:
        own = robot.parameters()
        robot = robot.with_parameters({**settings, **{name: factor * own[name] for name, factor in factors.items()}})
    for place, mass in payloads.items():
        robot = robot.with_payload(place, mass)
    return robot


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Short):
    """A command history and the times at which joint positions are wanted.

    Commands are pressures [Pa] of robots with elastic actuators, else in the unit of each actuator's command
    (``Robot.command_unit``). Positions are in rad at hinges and in m at slides, velocities in rad/s and m/s.

    Attributes:
        name: for messages.
        times: (n,) ascending instants from which each command holds [s].
        commands: (n, na).
        before: (na,) command in force before times[0]: what follows it (pressures, filters) has settled under it.
        start: when the motion starts [s].
        position: (nj,) of the joints there [rad or m].
        sample_times: (m,) ascending, none before ``start`` [s].
        velocity: (nj,) of the joints at the start [rad/s or m/s]; 0 by default.
        settings: parameters of the model that are known to be others in this trial, by dotted name.
        factors: the same, in units of what the model has.
        payloads: place of the robot → mass that is known to be there beside in this trial [kg].
        linear: commands go along a line from each instant to the next, in place of being held.
        inner: whether the true motion at the sample times is wanted too, see ``Predicted.motion``.
        forces: whether the forces of the drives there are wanted too, see ``Predicted.forces``.
        activation: (na,) what integrators of commands begin with; by default where their actuators are, at the start of
            what was ``recorded`` where that is known.
        prescribed: how joints move whose motion is an input; they have no part in the vectors of joints above.
        supposed: how joints may move that were not measured; they begin so where nothing else is said.
        recorded: the motion that the trial is a part of, from the first command on: what no sensor shows is at the
            start as it left it. Without, it is there as if nothing had been before.
    """

    name: str
    times: Array
    commands: Array
    before: Array
    start: float
    position: Array
    sample_times: Array
    velocity: Array | None = None
    settings: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    payloads: Mapping[str, float] = field(default_factory=dict)
    activation: Array | None = None
    linear: bool = False
    inner: bool = False
    forces: bool = False
    prescribed: PrescribedMotion | None = None
    supposed: PrescribedMotion | None = None
    recorded: RecordedMotion | None = None

    @property
    def led(self) -> RecordedMotion | None:
        """The motion before the start; None where there is none, or nobody knows it."""
        return self.recorded if self.start > self.times[0] else None

    @cached_property
    def going(self) -> tuple[Array, Array] | None:
        """(nj + np + nu,) what was recorded at the start, and its rate; None where nobody knows the motion before."""
        return None if self.led is None else self.led.motion.at(self.start)[:2]

    @cached_property
    def condition(self) -> Condition:
        """Key that differs between trials in which a model has other parameter values."""
        return tuple(tuple(sorted(own.items())) for own in (self.settings, self.factors, self.payloads))

    def robot_in(self, robot: R) -> R:
        """A robot as it is in this trial: with ``settings``, with ``factors`` times what it has, with ``payloads``."""
        return robot_with(robot, self.settings, self.factors, self.payloads)

    @property
    def history(self) -> tuple[Same, Same, bytes, bool, PrescribedMotion | None, RecordedMotion | None]:
        """Which commands and motion these are, the same for shooting intervals of one recording: a key."""
        own = self.linear, self.prescribed, self.recorded
        return Same(self.times), Same(self.commands), self.before.tobytes(), *own

    def motion_of(self, joints: Sequence[str]) -> PrescribedMotion:
        """How joints move whose motion is an input.

        Raises:
            ConfigError: where the trial does not say how these move.
        """
        if self.prescribed is None or self.prescribed.joints != tuple(joints):
            own = "none" if self.prescribed is None else ", ".join(self.prescribed.joints)
            raise ConfigError(
                f"{self.name}: has the motion of {own}, expected that of {', '.join(joints)}, which is prescribed"
            )
        return self.prescribed

    @property
    def moved(self) -> Array | None:
        """(m, np) where joints whose motion is prescribed are at the sample times; None where there are none."""
        return None if self.prescribed is None else self.prescribed.at(self.sample_times)[0]

    def begun(self, robot: Robot, position: Array, velocity: Array, beside: Array | None = None) -> tuple[Array, Array]:
        """Positions and velocities (…, nj) at the start with those of prescribed and unmeasured joints behind them.

        Args:
            robot: whose.
            position: of its joints [rad or m].
            velocity: theirs [rad/s or m/s].
            beside: (…, 2 nl) those of unmeasured joints that begin anywhere; where it is empty as they are supposed to.

        Raises:
            ConfigError: where the trial does not say how prescribed joints move, or unmeasured ones begin.
        """
        if robot.prescribed_names:
            q, v, _ = self.motion_of(robot.prescribed_names).at(self.start)
            shape = (*position.shape[:-1], len(q))
            position = np.concatenate([position, np.broadcast_to(q, shape)], axis=-1)
            velocity = np.concatenate([velocity, np.broadcast_to(v, shape)], axis=-1)
        if not robot.unmeasured_names:
            return position, velocity
        if beside is None or not beside.shape[-1]:
            beside = self.loose_start(robot)
        whole = np.broadcast_to(beside, (*position.shape[:-1], 2 * robot.loose_count))
        return robot.with_unmeasured(position, velocity, whole)

    def loose_start(self, robot: Robot) -> Array:
        """(2 nl,) where unmeasured joints that begin anywhere are supposed to begin, and their rates.

        Raises:
            ConfigError: where the trial does not say so.
        """
        if self.supposed is None or self.supposed.joints != robot.unmeasured_names:
            raise ConfigError(
                f"{self.name}: does not say where {', '.join(robot.unmeasured_names)} may begin, expected a recording "
                "that workflow.gather has read for the model"
            )
        q, v, _ = self.supposed.at(self.start)
        return np.concatenate([q[: robot.loose_count], v[: robot.loose_count]])

    def with_accelerations(self, robot: Robot, rows: Array) -> Array:
        """(1 + n, na + np) rows of commands, the one before first, and accelerations of prescribed joints behind them.

        Each is the command of the actuator by which its joint is moved, see ``robots.mjcf.prescribing``.
        """
        if not robot.prescribed_names:
            return rows
        found = self.motion_of(robot.prescribed_names).at(self.times)[2]
        return np.column_stack([rows, np.vstack([found[:1], found])])

    def lines(self, robot: Robot) -> NDArray[np.bool_]:
        """(na + np,) which of these go along a line from row to row: accelerations do."""
        counts = len(robot.actuator_names), len(robot.prescribed_names)
        return np.repeat([self.linear, True], counts)

    def command_at(self, times: Array) -> Array:
        """(n, na) the commands in force at instants (n,) [s]."""
        rows = np.vstack([self.before, self.commands])
        at = np.searchsorted(self.times, times, side="right")
        if not self.linear or not self.commands.shape[1]:
            return np.asarray(rows[at])
        between = np.column_stack([np.interp(times, self.times, column) for column in self.commands.T])
        return np.where(at[:, None] == 0, self.before, between)

    @classmethod
    def of(cls, recording: Recording, position: ArrayLike, window: tuple[float, float] | None = None) -> Trial:
        """A recording's commands and times, the motion starting at its first row, or where a window begins.

        Args:
            recording: whose.
            position: (nj,) of the joints at the start [rad or m].
            window: (from, to) the part of it that is sampled and simulated [s]; the whole recording by default.
        """
        time = recording.time
        inside = np.ones(len(time), dtype=bool)
        if window is not None:
            inside = (time >= window[0]) & (time <= window[1])
        start = time[0] if window is None else max(window[0], time[0])
        return cls(
            recording.name,
            np.array(time),
            np.array(recording.command),
            np.array(recording.command_before),
            float(start),
            np.array(position, dtype=np.float64),
            np.array(time[inside]),
            linear=recording.linear,
            prescribed=recording.prescribed,
            supposed=recording.supposed,
        )

    def starting_from(self, position: ArrayLike) -> Trial:
        """The same from other joint positions (nj,) [rad or m]."""
        return replace(self, position=np.array(position, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Predicted:
    """What ``simulate`` found for one trial.

    Attributes:
        position: (k, m, nj) measured positions of each model [rad or m]; numbers after a divergence mean nothing.
        reached: (k,) m where all is well, else the index of the first sample that could not be had.
        motion: (k, m, 2 nj) true positions and rates, of a trial that asks for them [rad or m, rad/s or m/s].
        forces: (k, m, na) for each command the force of its actuator before the gear, of a trial that asks for them
            [N·m or N].
    """

    position: Array
    reached: NDArray[np.int64]
    motion: Array | None = None
    forces: Array | None = None

    @classmethod
    def empty(cls, models: int, trial: Trial, joints: int) -> Predicted:
        """Room for what so many models and joints do in a trial."""
        shape = (models, len(trial.sample_times))
        motion = np.empty((*shape, 2 * joints)) if trial.inner else None
        forces = np.empty((*shape, trial.commands.shape[1])) if trial.forces else None
        return cls(np.empty((*shape, joints)), np.zeros(models, dtype=np.int64), motion, forces)

    @property
    def sound(self) -> NDArray[np.bool_]:
        """(k,) which models went through without diverging."""
        return np.asarray(self.reached == self.position.shape[1])


def check_size(trials: Sequence[Trial], dt: float) -> None:
    """Raise ConfigError where a trial takes more steps of ``dt`` [s] than there may be, before memory is taken."""
    for trial in trials:
        end = float(trial.sample_times[-1]) if len(trial.sample_times) else trial.start
        begin = min(trial.start, float(trial.times[0]))
        if not (end - begin) / dt <= MOST_STEPS:
            raise ConfigError(
                f"{trial.name}: {end - begin:g} s take {(end - begin) / dt:.3g} physics steps of {dt:g} s, expected at "
                f"most {MOST_STEPS:,}; cut what was recorded"
            )
