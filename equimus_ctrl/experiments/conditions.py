"""Known conditions: what a user can make different of a robot for a trial, and knows by how much.

They tell explanations apart that no command does, such as friction that grows with the load from friction that does
not. A text says what can be had:

    payload:foot=0.2             a mass [kg] at a site, foot, link or body
    pose:elbow=30                at rest elsewhere, joints in degrees, slides in mm
    supply:all=0.8               drives exert this share of what they exert otherwise; of one by its name
    arm.mass=2.1                 a parameter of the robot that was made another, by its value [SI]
    times:servo.kp=0.5           the same by a factor

and several of them together, with commas between.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from equimus_ctrl.engines.predict import PAYLOAD, SET, TIMES, robot_as_noted
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError, ModelError, NotAvailable, unknown_name
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array

KINDS = ("payload", "pose", "supply", "times")
EVERY, GAIN = "all", "gain"
"""Every drive; and the parameter of a drive that its supply is a factor on."""
THERE = 1e-3
"""How near to a pose a robot has to rest that is to rest there [rad or m]."""


@dataclass(frozen=True, eq=False)
class KnownCondition:
    """What is known to be different in a trial.

    Attributes:
        text: as it was given; empty where nothing is.
        settings: parameters that are others, by dotted name, see ``Trial``.
        factors: the same as factors on what the model has.
        payloads: place → mass that is there beside [kg].
        pose: joint → where it rests, in place of where it usually does [rad or m].
    """

    text: str = ""
    settings: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    payloads: Mapping[str, float] = field(default_factory=dict)
    pose: Mapping[str, float] = field(default_factory=dict)

    @property
    def notes(self) -> dict[str, str]:
        """Those of a recording under it, see ``engines.predict.noted``; a pose shows in what is recorded."""
        parts = ((SET, self.settings), (TIMES, self.factors), (PAYLOAD, self.payloads))
        return {f"{prefix}{name}": repr(value) for prefix, own in parts for name, value in own.items()}

    def trial(self, trial: Trial) -> Trial:
        """The same trial under it; where it begins is another matter, see ``rest_command``."""
        return replace(
            trial,
            settings={**trial.settings, **self.settings},
            factors={**trial.factors, **self.factors},
            payloads={**trial.payloads, **self.payloads},
        )

    def model(self, model: Model) -> Model:
        """A model as it is under it."""
        return replace(model, robot=robot_as_noted(model.robot, self.text, self.notes)) if self.notes else model

    def rest_command(self, model: Model, usual: Array) -> Array:
        """(na,) the command under which a trial rests: that which holds the pose, or the usual one where there is none.

        Args:
            model: of the robot as it usually is.
            usual: (na,) what is commanded at rest without it.

        Raises:
            ConfigError: where no command makes it rest in the pose.
        """
        if not self.pose:
            return np.array(usual)
        here, robot = self.model(model), model.robot
        wanted = np.array(rest_pose(here, usual))
        for joint, value in self.pose.items():
            wanted[robot.joint_names.index(joint)] = value
        low, high = robot.command_limits
        try:
            command = np.clip(Dynamics(here).holding(wanted)[0], low, high)
            rests = rest_pose(here, command, wanted)
        except (ModelError, NotAvailable) as error:
            raise ConfigError(f"{self.text}: {error}") from None
        own = [robot.joint_names.index(joint) for joint in self.pose]
        j = own[int(np.abs(rests - wanted)[own].argmax())]
        if abs(rests[j] - wanted[j]) > THERE:
            unit = reading(robot.joint_units[j])
            raise ConfigError(
                f"{self.text}: {robot.name} does not rest there under any command; {robot.joint_names[j]} comes to "
                f"{unit.text(rests[j])}, expected a pose in which it can rest"
            )
        return command


def known_condition(text: str, model: Model) -> KnownCondition:
    """What a text says can be had of a robot.

    Raises:
        ConfigError: where it says nothing that can be.
    """
    found: dict[str, dict[str, float]] = {"settings": {}, "factors": {}, "payloads": {}, "pose": {}}
    for part in (own.strip() for own in text.split(",")):
        name, equals, number = (own.strip() for own in part.partition("="))
        if not (name and equals):
            raise ConfigError(f"condition {part!r}: expected such as payload:SITE=0.2, pose:JOINT=30 or arm.mass=2.1")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ConfigError(f"condition {part!r}: {number!r} is no finite number")
        kind, colon, place = name.partition(":")
        if not colon:
            kind, place = "set", name
        elif kind not in KINDS:
            raise ConfigError(f"condition {part!r}: {unknown_name('kind of condition', kind, KINDS)}")
        where, values = _meaning(model.robot, kind, place, value, part)
        if again := sorted(set(found[where]) & set(values)):
            raise ConfigError(f"condition {text!r}: {again[0]} is said twice")
        found[where] |= values
    whole = KnownCondition(text, **found)
    try:
        whole.model(model)
    except (ConfigError, ModelError) as error:
        raise ConfigError(f"condition {str(error).removeprefix(f'{text}: ')}") from None
    return whole


def known_conditions(texts: Sequence[str], model: Model) -> tuple[KnownCondition, ...]:
    """The usual condition first, then what texts say can be had, each once.

    Raises:
        ConfigError: see ``known_condition``.
    """
    return (KnownCondition(), *(known_condition(text, model) for text in dict.fromkeys(texts)))


def _meaning(robot: Robot, kind: str, place: str, value: float, part: str) -> tuple[str, dict[str, float]]:
    """Which field of a condition has it, and what."""
    if kind == "payload":
        return "payloads", {place: value}
    if kind == "set":
        return "settings", {place: value}
    if kind == "times":
        return "factors", {place: value}
    if kind == "supply":
        return "factors", _supplied(robot, place, value, part)
    if place not in robot.joint_names:
        raise ConfigError(unknown_name("joint", place, robot.joint_names, f"condition {part!r}"))
    j = robot.joint_names.index(place)
    own = reading(robot.joint_units[j])
    low, high = (float(side[j]) for side in robot.joint_range)
    if not low <= value / own.factor <= high:
        raise ConfigError(
            f"condition {part!r}: {place} at {own.text(value / own.factor)} is outside its range, {own.text(low)} to "
            f"{own.text(high)}"
        )
    return "pose", {place: value / own.factor}


def _supplied(robot: Robot, place: str, value: float, part: str) -> dict[str, float]:
    """Parameter → factor, of drives on another supply."""
    if place != EVERY and place not in robot.actuator_names:
        raise ConfigError(unknown_name("actuator", place, (EVERY, *robot.actuator_names), f"condition {part!r}"))
    if value <= 0:
        raise ConfigError(f"condition {part!r}: expected a share of the usual supply, more than 0")
    names = [f"{name}.{GAIN}" for name in robot.actuator_names if place in (EVERY, name)]
    given = [name for name in names if robot.has_parameters([name])]
    if len(given) < len(names) or not given:
        missing = next(name for name in names if name not in given)
        raise ConfigError(
            f"condition {part!r}: the model of {robot.name} has no {missing} that a supply would change; expected the "
            "numbers that it changes, as times:NAME=FACTOR"
        )
    return dict.fromkeys(given, value)
