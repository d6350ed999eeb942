"""What a scenario is: a start, a reference, perhaps commands to play, and what the outcome is scored against."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from equimus_ctrl.errors import FAILURES, ConfigError, EquimusError, unknown_name
from equimus_ctrl.plants.events import Event, Load
from equimus_ctrl.robots.reading import position_word, reading
from equimus_ctrl.scenarios.context import POSITION, out_of_range
from equimus_ctrl.scenarios.context import CommandProfile as CommandProfile
from equimus_ctrl.scenarios.context import ScenarioContext as ScenarioContext
from equimus_ctrl.scenarios.site_path import SitePath
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Controller, Recording, Reference, Start

OPTION = "option."
"""Before an option's name where a joint has that name too."""
HALF_TURN = 180.0
"""No hinge that turns on is farther from a pose than this [°]."""
DURATION, LONGEST = "duration", 86_400.0
"""The option of a scenario that says how long it lasts, and how long that is at most [s]: a day."""
LOOKED_AT = 20.0
"""How often a reference is looked at before anything runs [Hz]."""


@dataclass(frozen=True)
class Arrival:
    """That a run is to bring every joint to the reference's pose, and keep it there.

    Attributes:
        angle: how near hinges have to come [°].
        slide: how near slides have to come [mm].

    Raises:
        ConfigError: for a number that is no distance.
    """

    angle: float
    slide: float

    def __post_init__(self) -> None:
        for size in (self.angle, self.slide):
            if not (math.isfinite(size) and size > 0):
                raise ConfigError(f"a pose is to be reached within {size:g}, expected more than 0")
        if self.angle >= HALF_TURN:
            raise ConfigError(f"a pose is to be reached within {self.angle:g}°, expected less than half a turn")

    def near(self, units: Iterable[str]) -> Array:
        """(nj,) how near joints of some SI units have to come [rad or m]."""
        own = {"rad": self.angle}
        return np.array([own.get(unit, self.slide) / reading(unit).factor for unit in units])


@dataclass(frozen=True, eq=False, repr=False)
class Scenario(Short):
    """One thing to do with a robot, and how it is judged.

    Attributes:
        name: what it is called.
        summary: one line for lists.
        duration: [s].
        reference: wanted positions of the joints.
        start: where the run begins.
        commands: what ``open_loop`` plays; None means the reference's static pressures.
        controller: the one used when none is asked for, by name or itself.
        recorded: what the real robot did, or None.
        score_window: (from, to) [s] that is scored.
        score_rate: of the grid that runs and recordings are compared on [Hz].
        published: figures of others to stand beside ours, joint → RMSE [rad].
        published_controller: the controller those figures are of.
        step_like: whether the reference is one constant pose, so that overshoot and settling mean something.
        step_at: when the reference steps to a pose at which it stays [s]; of one that is constant at once, by default.
        missing: why there is no ``recorded``, for a person to read, or None.
        events: what befalls the robot meanwhile, see ``plants.events``; unknown to controllers.
        arrival: what counts as being there, where that is what is asked; then hinges without range may have turned
            whole turns more.
        site: where a point of the robot should be, of which the reference is the joints' motion; None of none.
        different: notes of what is known to be different of the robot, see ``engines.predict.noted``: a simulated one
            is made so, and recordings say it.
    """

    name: str
    summary: str
    duration: float
    reference: Reference
    start: Start = field(default_factory=Start)
    commands: CommandProfile | None = None
    controller: str | Controller = "pid"
    recorded: Recording | None = None
    score_window: tuple[float, float] | None = None
    score_rate: float = 100.0
    published: Mapping[str, float] | None = None
    published_controller: str = "open_loop"
    step_like: bool = False
    step_at: float | None = None
    missing: str | None = None
    events: tuple[Event, ...] = ()
    arrival: Arrival | None = None
    site: SitePath | None = None
    different: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if problem := duration_problem(self.duration):
            raise ConfigError(f"scenario {self.name}: {problem}")
        low, high = self.score_window or (0.0, self.duration)
        if self.score_window and min(high, self.duration) - low < 1 / self.score_rate:
            raise ConfigError(
                f"scenario {self.name}: the scored window {low:g} to {high:g} s holds no samples of the first "
                f"{self.duration:g} s, its duration"
            )
        for event in self.events:
            begins, ends = event.time, math.inf if isinstance(event, Load) else event.time + event.duration
            if begins >= self.duration or ends <= 0:
                raise ConfigError(
                    f"scenario {self.name}: what befalls the robot {begins:g} s after the start never does, expected a "
                    f"time from 0 to {self.duration:g} s, its duration"
                )
        if self.step_like and self.step_at is None:
            object.__setattr__(self, "step_at", 0.0)


def duration_problem(duration: float) -> str:
    """What is wrong with how long a scenario lasts [s]; empty where nothing is."""
    return "" if 0 < duration <= LONGEST else f"duration is {duration:g} s, expected more than 0, up to {LONGEST:g}"


def build_scenario(
    build: Callable[..., Scenario],
    context: ScenarioContext,
    options: Mapping[str, str] | None = None,
    where: str = "",
    name: str = "",
) -> Scenario:
    """Call a scenario script's ``build`` with options given as text.

    The options are the function's keyword parameters after the context; a text is read as the type of the default.
    What the robot's description asks of the scenario stands in the place of its defaults. Where an option and a joint
    have one name, they are ``option.<name>`` and ``pos.<joint>``.

    Args:
        build: of the script.
        context: what it builds on.
        options: name → text.
        where: the script, for messages.
        name: of the scenario, by which the robot's description knows it.

    Raises:
        ConfigError: for an unknown option or a text that is not of the default's type.
    """
    joints = context.robot.joint_names if takes_joints(build) else ()
    own = option_defaults(build)
    for key, default in own.items():
        if default is inspect.Parameter.empty:
            raise ConfigError(f"{where}: build's parameter {key!r} has no default; each option of a scenario needs one")
    known = {
        **{POSITION + joint if joint in own else joint: 0.0 for joint in joints},
        **{OPTION + key if key in joints else key: default for key, default in own.items()},
    }
    described = context.robot.scenario_options.get(name, {})
    usual = {}
    for key, text in described.items():
        at = f"{context.robot.name}: scenarios.{name}"
        if key not in own and key not in joints:
            raise ConfigError(unknown_name("option", key, [*own, *joints], at))
        usual[key] = _read_option(key, text, type(own.get(key, 0.0)), at)
    values: dict[str, Any] = {}
    for key, text in (options or {}).items():
        if key in own and key in joints:
            raise ConfigError(
                f"{where}: {key} is an option of the scenario and a joint of {context.robot.name}; expected "
                f"{OPTION}{key} or {POSITION}{key}"
            )
        if key not in known:
            raise ConfigError(unknown_name("option", key, known, where))
        values[key] = _read_option(key, text, type(known[key]), where)

    def built(given: Mapping[str, Any]) -> Scenario:
        own = {key.removeprefix(OPTION): value for key, value in given.items()}
        scenario = build(replace(context, given=frozenset(own)), **{**usual, **own})
        _check_scenario(scenario, context)
        return scenario

    try:
        return built(values)
    except FAILURES as error:
        said = "".join(f" with {key} = {(options or {})[key]}" for key in _at_fault(built, values, error))
        if isinstance(error, EquimusError):
            raise type(error)(f"{where}{said}: {error}" if where or said else str(error)) from None
        raise ConfigError(f"{where}{said}: build fails: {type(error).__name__}: {error}") from error


def _at_fault(
    built: Callable[[Mapping[str, Any]], Scenario], values: Mapping[str, Any], error: BaseException
) -> list[str]:
    """Options without which a scenario would not fail, or not in this way; of none, if none alone is at fault."""
    if len(values) < 2:
        return list(values)
    found = []
    for key in values:
        try:
            built({other: value for other, value in values.items() if other != key})
        except FAILURES as other:
            if str(other) == str(error):
                continue
        found.append(key)
    return found


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
    if key.removeprefix(OPTION) == DURATION and kind is float and (problem := duration_problem(value)):
        raise ConfigError(f"{where}: {problem}")  # a script makes arrays of so many seconds before anybody sees it
    return value


def _check_scenario(scenario: object, context: ScenarioContext) -> None:
    """Raise ConfigError unless ``build`` returned a scenario whose reference fits the robot."""
    if not isinstance(scenario, Scenario):
        raise ConfigError(f"build returned {scenario!r}, expected a Scenario")
    m = context.robot
    pose = np.asarray(scenario.reference.position(0.0), dtype=np.float64)
    if pose.shape != (len(m.joints),) or not np.all(np.isfinite(pose)):
        raise ConfigError(
            f"the reference of scenario {scenario.name} begins at {pose.tolist()}, expected one finite "
            f"{position_word(m.joint_units)} for each of {', '.join(m.joint_names)}"
        )
    for time in np.arange(0.0, scenario.duration, 1 / LOOKED_AT).tolist():
        pose = np.asarray(scenario.reference.position(time), dtype=np.float64)
        if outside := out_of_range(m, pose):
            when = "begins with" if time == 0 else f"at {time:.2f} s has"
            raise ConfigError(f"the reference of scenario {scenario.name} {when} {outside}")


def option_defaults(build: Callable[..., Scenario]) -> dict[str, Any]:
    """Option name → default of a scenario script's ``build``."""
    return {p.name: p.default for p in _options(build) if p.kind is not inspect.Parameter.VAR_KEYWORD}


def takes_joints(build: Callable[..., Scenario]) -> bool:
    """Whether each joint of the robot is an option, a position as people read it: ``build`` has ``**`` of them."""
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in _options(build))


def _options(build: Callable[..., Scenario]) -> list[inspect.Parameter]:
    return list(inspect.signature(build).parameters.values())[1:]
