"""What an experiment must never leave: ranges, rates and accelerations of commands, ranges and rates of joints, time.

A limits file is TOML, in SI units (Pa or the unit of each actuator's command, rad or m, s); what it does not say is the
robot's own:

    format = "equimus-ctrl/limits/1"
    duration = 6.0              # of a trial
    before = 0.5                # at rest at first
    after = 0.5                 # and in the end

    [actuators.maa]
    low = 0.0
    high = 40e3
    rate = 2e5                  # per second
    acceleration = 4e6          # per second squared

    [joints.knee]
    low = 0.0
    high = 1.8
    margin = 0.05               # kept from either end
    rate = 6.0

What the limits promise. A design is kept where no motion under it leaves them, of none of the rivals with none of n
draws of its parameters. Let the true robot be one of them, its parameters from the same distribution as the draws.
Then it and the n draws are exchangeable: by how much each of the n + 1 leaves the limits is equally likely to be the
most. Where none of n draws leaves them, the chance that the true robot does is at most 1/(n + 1), whatever the design
and the robot, also where the design was shrunk until none of these draws leaves them: 99 draws for 1 % (conformal
prediction, Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World, 2005, chapter 2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.experiments.families import CommandBounds
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array, frozen_array

FORMAT = "equimus-ctrl/limits/1"
MARGIN = 0.02
"""Share of a joint's range that is kept from either end where nobody says how much."""
GIVE = 2.5e-3
"""Share of its range by which a joint that rests at its limit may go farther than at rest: an end gives way under what
presses on it while other joints move. The leg's knee, 5 mrad, goes 2.4 mrad farther at most in 300 random designs."""
ONE_TURN = 2 * math.pi
"""How far a hinge without a range of its own may go either way from where its model has it at zero [rad]: cables and
hoses are not in a model."""
NEAR = 1e-2
"""How exactly an amplitude is found."""
TIMES = ("duration", "before", "after")
PARTS = {
    "actuators": ("command", ("low", "high", "rate", "acceleration")),
    "joints": ("joint", ("low", "high", "margin", "rate")),
}
"""Table of a limits file → whose numbers it has, and which."""


@dataclass(frozen=True, eq=False)
class Motions:
    """What several models do under the same commands, or along the same reference.

    Attributes:
        times: (n,) [s].
        position: (k, n, nj) true positions [rad or m]; nan where a simulation was lost.
        rate: (k, n, nj) [rad/s or m/s].
        rest: (k, nj) where each rests [rad or m].
        command: (k, n, na) what feedback asks for, where joints track references; nan where a simulation was lost. None
            where commands are the same for all and keep their limits by construction.
    """

    times: Array
    position: Array
    rate: Array
    rest: Array
    command: Array | None = None

    @classmethod
    def of(cls, predicted: Sequence[Predicted], times: Array) -> Motions:
        """Of simulations under the same commands, one for each explanation, that begin at rest.

        Args:
            predicted: of trials that ask for their inner motion, see ``Trial.inner``.
            times: (n,) of their samples, the first at the start [s].
        """
        parts = []
        for own in predicted:
            assert own.motion is not None, "the trial asks for its inner motion"
            lost = np.arange(len(times)) >= own.reached[:, None]
            parts.append(np.where(lost[:, :, None], np.nan, own.motion))
        whole = np.concatenate(parts)
        position, rate = np.split(whole, 2, axis=2)
        return cls(times, position, rate, position[:, 0])


@dataclass(frozen=True, eq=False)
class Excess:
    """By how much motions leave limits.

    Attributes:
        by: (m,) how far beyond each limit the farthest motion goes, in units of the limit's range; at most 0 within.
            First the lower ends of all joints, then the upper ones, then their rates, and behind them the same of
            commands that feedback asks for, with their accelerations; +inf where a simulation was lost.
        names: (m,) of the limits.
        values: (m,) what was reached there, and (m,) ``limits`` what may be.
        limits: what may be.
        units: (m,) SI units of both.
        when: (m,) instants at which each is left farthest, or come nearest to [s].
        model: (m,) which model does so.
    """

    by: Array
    names: tuple[str, ...]
    values: Array
    limits: Array
    units: tuple[str, ...]
    when: Array
    model: tuple[int, ...]

    @property
    def worst(self) -> float:
        """How far the limit is left that is left farthest; at most 0 where none is."""
        return float(self.by.max())

    @property
    def left(self) -> bool:
        """Whether any is."""
        return self.worst > 0

    def __str__(self) -> str:
        """The limit that is left farthest, or come nearest to, as a sentence."""
        k = int(self.by.argmax())
        if self.by[k] == -math.inf:
            return "no joint has one"
        if math.isinf(self.by[k]) or math.isnan(self.values[k]):
            return f"the simulation of model {self.model[k]} is lost at {self.when[k]:.3g} s"
        unit, _, per = self.units[k].partition("/")
        own = reading(unit)
        reached, may = (own.text(value) + (f"/{per}" if per else "") for value in (self.values[k], self.limits[k]))
        return f"{self.names[k]}: {reached} at {self.when[k]:.3g} s with model {self.model[k]}, where {may} may be"


@dataclass(frozen=True, eq=False)
class Limits:
    """What an experiment must never leave.

    Attributes:
        robot: whose they are.
        command_low: (na,) lowest commands [Pa, or the unit of each actuator's command]; −inf where nothing says so.
        command_high: (na,) highest.
        command_rate: (na,) greatest change in a second, +inf where nothing says so.
        command_acceleration: (na,) greatest change of that in a second.
        joint_low: (nj,) where ranges begin, −inf where they do not [rad or m].
        joint_high: (nj,) where they end, +inf where they do not.
        joint_margin: (nj,) kept from either end [rad or m].
        joint_rate: (nj,) how fast joints may be, +inf where nothing says so [rad/s or m/s].
        duration: of a trial [s].
        before: how long it rests at first [s].
        after: how long it rests in the end [s].

    Raises:
        ConfigError: where a range is none, or something else cannot be.
    """

    robot: Robot
    command_low: Array
    command_high: Array
    command_rate: Array
    command_acceleration: Array
    joint_low: Array
    joint_high: Array
    joint_margin: Array
    joint_rate: Array
    duration: float = 6.0
    before: float = 0.5
    after: float = 0.5

    def __post_init__(self) -> None:
        for own in fields(self):
            if isinstance(value := getattr(self, own.name), np.ndarray):
                object.__setattr__(self, own.name, frozen_array(value, 1, own.name))
        robot = self.robot
        for i, name in enumerate(robot.actuator_names):
            _check_range(f"commands of {name}", self.command_low[i], self.command_high[i], 0.0)
            _check_rates(f"commands of {name}", rate=self.command_rate[i], acceleration=self.command_acceleration[i])
        for j, name in enumerate(robot.joint_names):
            _check_range(name, self.joint_low[j], self.joint_high[j], float(self.joint_margin[j]))
            _check_rates(name, rate=self.joint_rate[j])
        for key in ("before", "after"):
            if not 0 <= (value := getattr(self, key)) < self.duration:
                raise ConfigError(f"{key} is {value:g} s, expected 0 to less than the duration, {self.duration:g} s")
        if not (math.isfinite(self.duration) and self.before + self.after < self.duration):
            raise ConfigError(
                f"duration is {self.duration:g} s, expected more than both rests, {self.before + self.after:g} s"
            )

    @classmethod
    def of(cls, robot: Robot) -> Limits:
        """A robot's own: its ranges, with margins, and how fast its commands may change.

        A hinge that may turn without end in the model goes one turn either way, unless a user says more.
        Goals without limits of their own may be anywhere in the ranges of the joints that they are for.
        """
        low, high = robot.joint_range
        span = high - low
        turns = np.array([not robot.slides(joint) for joint in robot.joint_names])
        with np.errstate(invalid="ignore"):
            ends = np.sort([robot.goals_at(low), robot.goals_at(high)], axis=0)
        given = np.array(robot.command_limits)
        known = np.array(robot.goals, dtype=bool) & np.isfinite(ends).all(axis=0)
        given = np.where(known & ~np.isfinite(given), ends, given)
        return cls(
            robot,
            given[0],
            given[1],
            robot.command_rates,
            np.full(len(robot.actuator_names), np.inf),
            np.where(turns & ~np.isfinite(low), -ONE_TURN, low),
            np.where(turns & ~np.isfinite(high), ONE_TURN, high),
            np.where(np.isfinite(span), MARGIN * np.where(np.isfinite(span), span, 0.0), 0.0),
            np.full(len(low), np.inf),
        )

    @classmethod
    def read(
        cls, robot: Robot, data: Mapping[str, Any] | None = None, options: Mapping[str, str] | None = None,
        where: str = "limits",
    ) -> Limits:  # fmt: skip
        """A robot's own where nothing else is said.

        Args:
            robot: whose.
            data: what a limits file holds.
            options: what comes before that: ``duration=6``, ``maa.high=40e3``, ``knee.margin=0.05``; where a joint and
                an actuator have one name, ``joints.arm.rate=3`` and ``actuators.arm.rate=3``.
            where: the file, for messages.

        Raises:
            ConfigError: for a key that there is not, a value that cannot be, or a range that is wider than the robot's.
        """
        found, changes = cls.of(robot), dict[str, Any]()
        for key, value in _flat(data or {}, where).items():
            found._change(changes, key, value, where)
        for key, text in (options or {}).items():
            try:
                value = float(text)
            except ValueError:
                raise ConfigError(f"limits: {key} is {text!r}, expected a number") from None
            found._change(changes, _full_name(robot, key), value, "limits")
        try:
            return replace(found, **changes)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def _change(self, changes: dict[str, Any], key: str, value: float, where: str) -> None:
        """Note in ``changes`` what a number means, by its name in a file."""
        if math.isnan(value):
            raise ConfigError(f"{where}: {key} is nan, expected a number")
        if key in TIMES:
            changes[key] = value
            return
        kind, _, rest = key.partition(".")
        own, _, what = rest.rpartition(".")
        if kind not in PARTS or not own:
            raise ConfigError(unknown_name("key", key, [*TIMES, "actuators.NAME.low", "joints.NAME.low"], where))
        robot = self.robot
        names, widest = (
            (robot.actuator_names, robot.command_limits)
            if kind == "actuators"
            else (robot.joint_names, robot.joint_range)
        )
        prefix, known = PARTS[kind]
        if own not in names:
            raise ConfigError(unknown_name(kind[:-1], own, names, where))
        if what not in known:
            raise ConfigError(unknown_name("key", what, known, f"{where}: {kind}.{own}"))
        k = names.index(own)
        low, high = (float(side[k]) for side in widest)
        if what in ("low", "high") and not low <= value <= high:
            raise ConfigError(f"{where}: {key} is {value:g}, outside the robot's own range, {low:g} to {high:g}")
        field = f"{prefix}_{what}"
        changes.setdefault(field, np.array(getattr(self, field)))[k] = value

    def bounds(self, rest: Array) -> CommandBounds:
        """Of commands that rest at (na,), see ``families``.

        Raises:
            ConfigError: where a range has no end.
        """
        self._check_commands()
        return CommandBounds(
            self.command_low, self.command_high, rest, self.command_rate, self.command_acceleration, self.before,
            self.after,
        )  # fmt: skip

    def _check_commands(self) -> None:
        """Raise ConfigError where commands of an actuator have no limits."""
        for i, name in enumerate(self.robot.actuator_names):
            if not (np.isfinite(self.command_low[i]) and np.isfinite(self.command_high[i])):
                raise ConfigError(
                    f"{self.robot.name}: commands of {name} have no limits of their own; expected {name}.low and "
                    f"{name}.high in --limits"
                )

    def reference_bounds(self, rest: Array, acceleration: Array) -> CommandBounds:
        """Of references of joints, see ``families``: their ranges less the margins, and their rates.

        Args:
            rest: (nj,) where they rest [rad or m].
            acceleration: (nj,) that may be asked for [rad/s² or m/s²].

        Raises:
            ConfigError: where a range has no end.
        """
        robot = self.robot
        self._check_commands()
        low, high = self.joint_low + self.joint_margin, self.joint_high - self.joint_margin
        for j, name in enumerate(robot.joint_names):
            if not (np.isfinite(low[j]) and np.isfinite(high[j])):
                raise ConfigError(
                    f"{robot.name}: {name}, which is to track a reference, has no range of its own; expected "
                    f"{name}.low and {name}.high in --limits"
                )
        return CommandBounds(
            np.minimum(low, rest), np.maximum(high, rest), rest, self.joint_rate, acceleration, self.before, self.after,
        )  # fmt: skip

    def rests_outside(self, pose: Array) -> str:
        """Which joint is beyond its range in a pose (nj,), by more than an end gives way, as a clause; else empty."""
        span = self.joint_high - self.joint_low
        room = GIVE * np.where(np.isfinite(span), span, 0.0)
        beyond = np.maximum(self.joint_low - room - pose, pose - self.joint_high - room)
        j = int(np.argmax(beyond))
        if beyond[j] <= 0:
            return ""
        own = reading(self.robot.joint_units[j])
        low, high = (own.text(float(side[j])) for side in (self.joint_low, self.joint_high))
        return f"{self.robot.joint_names[j]} at {own.text(float(pose[j]))}, outside {low} to {high}"

    def excess(self, motions: Motions) -> Excess:
        """By how much motions leave the limits of joints, each in units of its limit's range.

        Where commands follow from feedback, also by how much these leave theirs.

        A joint may go as far as its range less the margin; one that rests beyond that as far as it rests, and a little
        farther, for an end gives way (``GIVE``).
        """
        robot, q, v, rest = self.robot, motions.position, motions.rate, motions.rest[:, None]
        low, high = self.joint_low + self.joint_margin, self.joint_high - self.joint_margin
        span = self.joint_high - self.joint_low
        span = np.where(np.isfinite(span), span, 1.0)
        low = np.where(rest < low, np.minimum(low, rest - GIVE * span), low)  # (k, 1, nj)
        high = np.where(rest > high, np.maximum(high, rest + GIVE * span), high)
        speed = np.where(np.isfinite(self.joint_rate), self.joint_rate, 1.0)
        beyond = np.concatenate([(low - q) / span, (q - high) / span, (np.abs(v) - self.joint_rate) / speed], axis=2)
        reached = np.concatenate([q, q, np.abs(v)], axis=2)
        may = np.concatenate(np.broadcast_arrays(low, high, self.joint_rate), axis=2)
        names = [f"{joint} {what}" for what in ("below its range", "above its range", "too fast") for joint in
                 robot.joint_names]  # fmt: skip
        units = [*robot.joint_units, *robot.joint_units, *(f"{unit}/s" for unit in robot.joint_units)]
        if motions.command is not None:
            of_commands = self._of_commands(motions.command, motions.times)
            beyond, reached = (
                np.concatenate(both, axis=2) for both in zip((beyond, reached), of_commands, strict=True)
            )
            ends = np.concatenate(
                [self.command_low, self.command_high, self.command_rate, self.command_acceleration]
            )  # fmt: skip
            may = np.concatenate([may, np.broadcast_to(ends, (*may.shape[:2], len(ends)))], axis=2)
            whats = ("below its range", "above its range", "too fast", "too sudden")
            names += [f"command of {own} {what}" for what in whats for own in robot.actuator_names]
            units += [f"{unit}{per}" for per in ("", "", "/s", "/s²") for unit in robot.command_units]
        beyond = np.where(np.isfinite(reached), beyond, np.inf)
        flat = beyond.reshape(-1, beyond.shape[2])  # (k n, m)
        at = flat.argmax(axis=0)
        model, row = np.divmod(at, len(motions.times))
        every = np.arange(flat.shape[1])
        return Excess(
            flat[at, every], tuple(names), reached[model, row, every], may[model, 0, every], tuple(units),
            motions.times[row], tuple(int(k) for k in model),
        )  # fmt: skip

    def _of_commands(self, command: Array, times: Array) -> tuple[Array, Array]:
        """(k, n, 4 na) by how much commands (k, n, na) leave their limits, in units of these, and what they reach."""
        steps = np.diff(times)[:, None]
        rates = np.diff(command, axis=1, prepend=command[:, :1]) / np.vstack([steps[:1], steps])
        turning = np.diff(rates, axis=1, prepend=rates[:, :1]) / np.vstack([steps[:1], steps])
        span = self.command_high - self.command_low
        span, most, sudden = (np.where(np.isfinite(x), x, 1.0) for x in (span, self.command_rate,
                                                                        self.command_acceleration))  # fmt: skip
        reached = [command, command, np.abs(rates), np.abs(turning)]
        beyond = [
            (self.command_low - command) / span, (command - self.command_high) / span,
            (reached[2] - self.command_rate) / most, (reached[3] - self.command_acceleration) / sudden,
        ]  # fmt: skip
        return np.concatenate(beyond, axis=2), np.concatenate(reached, axis=2)


def shrunk(motions: Callable[[float], Motions], limits: Limits, near: float = NEAR) -> tuple[float, Excess]:
    """The amplitude of a design with which no motion leaves the limits, and how near they come to them.

    1 where that stays within them; else by bisection the largest that does, down to 0: none that is not looked at is
    given, so that what is offered stays within them whether or not smaller designs move less.

    Args:
        motions: amplitude, 0 to 1 → what all rivals do with all draws of their parameters.
        limits: of the robot.
        near: how exactly the amplitude is found.

    Raises:
        ConfigError: where even a robot at rest leaves them.
    """
    found = limits.excess(motions(1.0))
    if not found.left:
        return 1.0, found
    low, high, within = 0.0, 1.0, limits.excess(motions(0.0))
    if within.left:
        raise ConfigError(f"a robot at rest leaves the limits: {within}")
    while high - low > near:
        middle = (low + high) / 2
        found = limits.excess(motions(middle))
        if found.left:
            high = middle
        else:
            low, within = middle, found
    return low, within


def _check_range(what: str, low: float, high: float, margin: float) -> None:
    if not 0 <= margin < math.inf:
        raise ConfigError(f"the margin of {what} is {margin:g}, expected at least 0")
    if not low + margin < high - margin:
        between = f" with a margin of {margin:g}" if margin else ""
        raise ConfigError(f"the range of {what} is {low:g} to {high:g}{between}, expected some room between")


def _check_rates(what: str, **values: float) -> None:
    for key, value in values.items():
        if not value > 0:
            raise ConfigError(f"the {key} of {what} is limited to {value:g}, expected more than 0")


def _flat(data: Mapping[str, Any], where: str, before: str = "") -> dict[str, float]:
    """Dotted key → number of what a file holds."""
    found: dict[str, float] = {}
    for key, value in data.items():
        if key == "format" and not before:
            if value != FORMAT:
                raise ConfigError(f"{where}: format is {value!r}, expected {FORMAT!r}")
        elif isinstance(value, Mapping):
            found |= _flat(value, where, f"{before}{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[before + key] = float(value)
        else:
            raise ConfigError(f"{where}: {before}{key} is {value!r}, expected a number")
    return found


def _full_name(robot: Robot, key: str) -> str:
    """A dotted name as it is in a file, of one that may lack ``actuators`` or ``joints``."""
    if key in TIMES or key.startswith(("actuators.", "joints.")):
        return key
    own, _, what = key.rpartition(".")
    kinds = [
        kind for kind, names in (("actuators", robot.actuator_names), ("joints", robot.joint_names)) if own in names
    ]
    if len(kinds) > 1:
        raise ConfigError(f"limits: {own} is an actuator and a joint; expected actuators.{key} or joints.{key}")
    if not kinds:
        known = [*TIMES, *(f"{name}.{what or 'low'}" for name in (*robot.actuator_names, *robot.joint_names))]
        raise ConfigError(unknown_name("limit", key, known, robot.name))
    return f"{kinds[0]}.{key}"
