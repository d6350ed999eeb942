"""What a scenario is: a start, a reference, perhaps commands to play, and what the outcome is scored against."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from equimus_ctrl.errors import ConfigError, EquimusError, unknown_name
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.plants.events import Event
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array, Recording, Reference, Start, frozen_array

RANGE_MARGIN = 0.1
"""How far into a joint's stop a reference may go [rad]: an equilibrium may press on a stop."""
LOOKED_AT = 20.0
"""How often a reference is looked at before anything runs [Hz]."""


@dataclass(frozen=True, eq=False)
class CommandProfile:
    """Pressures over time, each held until the next (zero-order hold).

    Attributes:
        times: (n,) ascending, the first at or before 0 [s].
        values: (n, na) [Pa].
    """

    times: Array
    values: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen_array(self.times, 1, "command times"))
        object.__setattr__(self, "values", frozen_array(self.values, 2, "command values"))
        if len(self.times) != len(self.values) or len(self.times) == 0 or not np.all(np.diff(self.times) > 0):
            raise ConfigError("a command profile needs one row of pressures for each of its ascending times")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise ConfigError("a command profile's times and pressures must be finite numbers")

    def at(self, time: float) -> Array:
        """(na,) the commands in force at ``time`` [Pa]."""
        k = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
        return np.asarray(self.values[max(k, 0)])


@dataclass(frozen=True, eq=False)
class Scenario:
    """One thing to do with a robot, and how it is judged.

    Attributes:
        name: what it is called.
        summary: one line for lists.
        duration: [s].
        reference: wanted joint angles.
        start: where the run begins.
        commands: what ``open_loop`` plays; None means the reference's static pressures.
        controller: the one used when none is asked for.
        recorded: what the real robot did, or None.
        score_window: (from, to) [s] that is scored.
        score_rate: of the grid that runs and recordings are compared on [Hz].
        published: figures of others to stand beside ours, joint → RMSE [rad].
        published_controller: the controller those figures are of.
        step_like: whether the reference is one constant pose, so that overshoot and settling mean something.
        missing: why there is no ``recorded``, for a person to read, or None.
        events: what befalls the robot meanwhile, see ``plants.events``; unknown to controllers.
    """

    name: str
    summary: str
    duration: float
    reference: Reference
    start: Start = field(default_factory=Start)
    commands: CommandProfile | None = None
    controller: str = "pid"
    recorded: Recording | None = None
    score_window: tuple[float, float] | None = None
    score_rate: float = 100.0
    published: Mapping[str, float] | None = None
    published_controller: str = "open_loop"
    step_like: bool = False
    missing: str | None = None
    events: tuple[Event, ...] = ()

    def __post_init__(self) -> None:
        if not 0 < self.duration < float("inf"):
            raise ConfigError(f"scenario {self.name}: duration is {self.duration:g} s, expected more than 0")


@dataclass(frozen=True, eq=False)
class ScenarioContext:
    """What a scenario may build on.

    Attributes:
        morphology: the nominal robot.
        phase: base fixed or foot pinned.
        recording: file kind (``"triangle"``, ``"step_release"``) → its trials, empty where there are none.
        missing: sentence that says how to get recordings.
    """

    morphology: Morphology
    phase: Phase = "swing"
    recording: Callable[[str], tuple[Recording, ...]] = lambda kind: ()
    missing: str = "there are no recordings"

    @property
    def kinematics(self) -> Kinematics:
        """Geometry and statics of the nominal robot."""
        return Kinematics(self.morphology, self.phase)

    def require(self, joints: tuple[str, ...], actuators: tuple[str, ...], scenario: str) -> None:
        """Raise ConfigError unless the robot has exactly these joints and actuators."""
        m = self.morphology
        if (m.joint_names, m.actuator_names) != (joints, actuators):
            raise ConfigError(
                f"scenario {scenario} is for a robot with joints {', '.join(joints)} and actuators "
                f"{', '.join(actuators)}; {m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
            )

    def profile(self, times: Any, values: Any) -> CommandProfile:
        """A command profile, checked against the robot's actuators and range.

        Raises:
            ConfigError: where a command is missing or outside the range.
        """
        m = self.morphology
        profile = CommandProfile(times, values)
        if profile.values.shape[1] != len(m.actuators):
            raise ConfigError(f"a command profile for {m.name} needs {len(m.actuators)} pressures in each row")
        worst = profile.values[
            np.abs(profile.values - (m.command_low + m.command_high) / 2).argmax() // len(m.actuators)
        ]
        if profile.values.min() < m.command_low or profile.values.max() > m.command_high:
            raise ConfigError(
                f"a command of {np.array2string(worst / 1e3, precision=3)} kPa lies outside the range of {m.name}, "
                f"{m.command_low / 1e3:g} to {m.command_high / 1e3:g} kPa"
            )
        return profile


def build_scenario(
    build: Callable[..., Scenario], context: ScenarioContext, options: Mapping[str, str] | None = None, where: str = ""
) -> Scenario:
    """Call a scenario script's ``build`` with options given as text.

    The options are the function's keyword parameters after the context; a text is read as the type of the default.

    Raises:
        ConfigError: for an unknown option or a text that is not of the default's type.
    """
    known = option_defaults(build)
    for key, default in known.items():
        if default is inspect.Parameter.empty:
            raise ConfigError(f"{where}: build's parameter {key!r} has no default; each option of a scenario needs one")
    values: dict[str, Any] = {}
    for key, text in (options or {}).items():
        if key not in known:
            raise ConfigError(unknown_name("option", key, known, where))
        values[key] = _read_option(key, text, type(known[key]), where)
    given = "".join(f" with {key} = {text}" for key, text in (options or {}).items())
    try:
        scenario = build(context, **values)
        _check_scenario(scenario, context)
    except EquimusError as error:
        raise type(error)(f"{where}{given}: {error}" if where or given else str(error)) from None
    except Exception as error:
        raise ConfigError(f"{where}{given}: build fails: {type(error).__name__}: {error}") from error
    return scenario


def _read_option(key: str, text: str, kind: type, where: str) -> Any:
    if kind is bool:
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if text.lower() not in words:
            raise ConfigError(f"{where}: option {key} is {text!r}, expected true or false")
        return words[text.lower()]
    try:
        value = kind(text)
    except (TypeError, ValueError):
        raise ConfigError(f"{where}: option {key} is {text!r}, expected {kind.__name__}") from None
    if kind is float and math.isnan(value):
        raise ConfigError(f"{where}: option {key} is {text!r}, expected a number")
    return value


def _check_scenario(scenario: object, context: ScenarioContext) -> None:
    """Raise ConfigError unless ``build`` returned a scenario whose reference fits the robot."""
    if not isinstance(scenario, Scenario):
        raise ConfigError(f"build returned {scenario!r}, expected a Scenario")
    m = context.morphology
    pose = np.asarray(scenario.reference.position(0.0), dtype=np.float64)
    if pose.shape != (len(m.joints),) or not np.all(np.isfinite(pose)):
        raise ConfigError(
            f"the reference of scenario {scenario.name} begins at {pose.tolist()}, expected one finite angle in rad "
            f"for each of {', '.join(m.joint_names)}"
        )
    low, high = m.joint_range
    for time in np.arange(0.0, scenario.duration, 1 / LOOKED_AT).tolist():
        pose = np.asarray(scenario.reference.position(time), dtype=np.float64)
        for joint, angle, least, most in zip(m.joint_names, pose, low, high, strict=True):
            if not least - RANGE_MARGIN <= angle <= most + RANGE_MARGIN:
                when = "begins with" if time == 0 else f"at {time:.2f} s has"
                raise ConfigError(
                    f"the reference of scenario {scenario.name} {when} {joint} at {math.degrees(angle):.1f}°, outside "
                    f"the joint's range of {math.degrees(least):.1f}° to {math.degrees(most):.1f}°"
                )


def option_defaults(build: Callable[..., Scenario]) -> dict[str, Any]:
    """Option name → default of a scenario script's ``build``."""
    return {p.name: p.default for p in list(inspect.signature(build).parameters.values())[1:]}
