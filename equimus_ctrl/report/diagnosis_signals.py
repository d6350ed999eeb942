"""Curves of effects on signals: between a command and the pressure, and between an angle and what is shown of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.sensors import OFFSET, PLAY, SCALE, SENSOR_DELAY, sample, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_panels import Line, Panel, Scene, band, changes, in_time, name_of, settled
from equimus_ctrl.report.diagnosis_words import number, quantity
from equimus_ctrl.types import Array

POINTS = 241
STEP = 1e-3
"""Of pressures and angles over time [s]."""
SHORTEST, LONGEST = 0.1, 10.0
"""Half of what is drawn of a response [s]."""
TYPICAL = (0.15, 0.85)
"""Quantiles of the commands between which a step is typical."""
TIMES_THE_PLAY = 8.0
"""So many times as far as it is changed goes the motion by which a sensor is shown."""


def command_panels(scene: Scene, best: Sequence[Effect], others: Sequence[Sequence[Effect]]) -> list[Panel]:
    """Pressure against command where that is changed, and the pressure after a step up and one down.

    Args:
        scene: what was recorded.
        best: the effects.
        others: the same with other parameters.
    """
    valve = _Valve.of(scene, best)
    shown_in = display_units.command(scene.model, valve.name)
    factor, commands = shown_in.factor, scene.commands[:, valve.place]
    pressures = scene.model.robot.traits.commands_are_pressures
    label = "pressure" if pressures else "what acts"
    x, plain, curve = (values * factor for values in (valve.grid, valve.static(()), valve.static(best)))
    drawn = []
    if changes(curve, plain):
        demand = valve.demand
        title = f"while {quantity(demand, 'Pa')} are asked of the others" if demand else "once it has settled"
        lines = (Line(x, plain, "without", True), Line(x, curve, name_of(best)))
        around = band(x, curve, [valve.static(o) * factor for o in others])
        axis = f"command of {valve.name} {shown_in.bracket}"
        drawn.append(Panel(title, axis, f"{label} {shown_in.bracket}", lines, around, commands * factor))
    low, high = _typical_step(commands)
    if changes(curve, plain) and np.allclose(np.interp([low, high], valve.grid, curve - plain), 0.0):
        low, high = 0.0, float(valve.grid[-1])  # such as a level that a typical command does not reach
    half = valve.settles_within(best, low, high)
    shown, axis = in_time(_clock(half))
    before, after = (valve.response(effects, low, high, half) * factor for effects in ((), best))
    lines = (Line(shown, before, "without", True), Line(shown, after, name_of(best)))
    around = band(shown, after, [valve.response(o, low, high, half) * factor for o in others])
    ends = [f"{number(value * factor)} {shown_in.unit}".rstrip() for value in (high, low)]
    if pressures:
        ends = [quantity(high, "Pa"), quantity(low, "Pa")]
    title = f"a step to {ends[0]} and back to {ends[1]}"
    return [*drawn, Panel(title, axis, f"{label} of {valve.name} {shown_in.bracket}", lines, around)]


@dataclass(frozen=True, eq=False)
class _Valve:
    """What reaches one actuator of a model.

    Attributes:
        model: with effects of its own.
        place: of the actuator.
        grid: (POINTS,) its commands, from 0 to the largest.
        demand: what is asked of all others meanwhile, where that matters; else 0.
    """

    model: Model
    place: int
    grid: Array
    demand: float

    @classmethod
    def of(cls, scene: Scene, best: Sequence[Effect]) -> _Valve:
        """The one that effects are at."""
        names, commands = scene.model.robot.actuator_names, scene.commands
        place = names.index(best[0].location)
        others = [i for i in range(len(names)) if i != place]
        grid = np.linspace(0.0, max(float(commands[:, place].max()), 1.0), POINTS)
        idle = cls(scene.model, place, grid, 0.0)
        busy = replace(idle, demand=float(np.quantile(commands[:, others], 0.9)) if others else 0.0)
        return busy if changes(busy.static(best), idle.static(best)) else idle

    @property
    def name(self) -> str:
        return self.model.robot.actuator_names[self.place]

    def static(self, effects: Sequence[Effect]) -> Array:
        """(POINTS,) what each command of the grid comes to."""
        names = self.model.robot.actuator_names
        asked = np.full((POINTS, len(names)), self.demand)
        asked[:, self.place] = self.grid
        ranges = self.model.robot.command_ranges
        return np.asarray(shaped_commands((*self.model.effects, *effects), names, asked, ranges)[:, self.place])

    def response(self, effects: Sequence[Effect], low: float, high: float, half: float) -> Array:
        """(n,) what reaches it from a tenth of ``half`` [s] before the step up to ``half`` after the one down."""
        names, whole = self.model.robot.actuator_names, (*self.model.effects, *effects)
        asked = np.full((3, len(names)), self.demand)
        asked[:, self.place] = low, high, low
        shaped = shaped_commands(whole, names, asked, self.model.robot.command_ranges)
        out = np.empty((round(2.1 * half / STEP), 2, len(names)))
        times = np.array([0.0, half])
        pressure_history(times, shaped[1:], shaped[0], valve_settings(whole, names), -0.1 * half, STEP, out)
        return np.asarray(out[:, 0, self.place])

    def settles_within(self, effects: Sequence[Effect], low: float, high: float) -> float:
        """Half of what is drawn of the response to a step [s]."""
        whole, time = self.response(effects, low, high, LONGEST), _clock(LONGEST)
        up, down = time < LONGEST, time >= LONGEST
        lasts = max(settled(time[up], whole[up]), settled(time[down], whole[down]) - LONGEST)
        return float(np.clip(1.4 * lasts, SHORTEST, LONGEST))


def _clock(half: float) -> Array:
    """(n,) instants of a response [s]."""
    return np.asarray(np.arange(round(2.1 * half / STEP)) * STEP + STEP / 2 - 0.1 * half)


def _typical_step(commands: Array) -> tuple[float, float]:
    low, high = (float(v) for v in np.quantile(commands, TYPICAL))
    return (low, high) if high - low > 0.1 * float(commands.max()) else (0.0, max(float(commands.max()), 1.0))


def sensor_panels(scene: Scene, best: Sequence[Effect], others: Sequence[Sequence[Effect]]) -> list[Panel]:
    """What is shown of an angle: at rest where that is changed, and in a motion to and fro where that is.

    Args: as of ``command_panels``.
    """
    m = scene.model.robot
    joint = best[0].location
    place, what = display_units.position(scene.model, joint), display_units.noun(scene.model, joint)
    column = m.joint_names.index(joint)
    seen = scene.seen[joint]

    def sensor(effects: Sequence[Effect]) -> Array:
        return np.asarray(sensor_settings((*scene.model.effects, *effects), m.joint_names)[column])

    now, plain = sensor(best), sensor(())
    drawn = []
    true = np.linspace(seen.low, seen.high, POINTS)

    def error(row: Array) -> Array:
        return np.asarray((row[OFFSET] + (row[SCALE] - 1) * true) * place.factor)

    x = true * place.factor
    if changes(error(now), error(plain)):
        data = scene.position(joint) * place.factor
        lines = (Line(x, error(plain), "without", True), Line(x, error(now), name_of(best)))
        around = band(x, error(now), [error(sensor(o)) for o in others])
        axis = f"true {what} of {joint} {place.bracket}"
        drawn.append(Panel("error of what is shown", axis, f"shown − true {place.bracket}", lines, around, data))
        lines = (Line(x, x + error(plain), "without", True), Line(x, x + error(now), name_of(best)))
        around = band(x, x + error(now), [x + error(sensor(o)) for o in others])
        drawn.append(Panel("what is shown", axis, f"shown {what} {place.bracket}", lines, around, data))
    if any(now[key] != plain[key] for key in (SENSOR_DELAY, PLAY)):
        sensors = plain, now, [sensor(o) for o in others]
        drawn += _to_and_fro(scene.model, joint, seen.low, seen.high, seen.speed, sensors, best)
    return drawn


def _to_and_fro(
    model: Model,
    joint: str,
    low: float,
    high: float,
    speed: float,
    sensors: tuple[Array, Array, list[Array]],
    best: Sequence[Effect],
) -> list[Panel]:
    """A triangular motion about the middle, as wide as lets the effect be seen."""
    plain, now, others = sensors
    place, what = display_units.position(model, joint), display_units.noun(model, joint)
    wide = min(high - low, TIMES_THE_PLAY * (now[PLAY] + now[SENSOR_DELAY] * speed))
    quarter = wide / 2 / speed
    time = np.linspace(0.0, 8 * quarter, 8 * POINTS)
    knots = np.arange(9) * quarter
    true = (low + high) / 2 + wide / 2 * np.interp(time, knots, [0, 1, 0, -1, 0, 1, 0, -1, 0])
    rate = np.gradient(true, time)
    kept = time > 3 * quarter

    def shown(row: Array) -> Array:
        out = np.empty(len(time))
        sample(true, rate, 0.0, float(time[1]), row, time, out)
        return np.asarray(out[kept] * place.factor)

    clock, axis = in_time(time[kept] - time[kept][0])
    with_it, without, rest = shown(now), shown(plain), [shown(row) for row in others]
    angle = true[kept] * place.factor
    around = band(clock, with_it, rest)
    lines = (Line(clock, without, "without", True), Line(clock, with_it, name_of(best)))
    ends = np.array([true.min(), true.max()]) * place.factor
    bare = Line(ends, plain[OFFSET] * place.factor + plain[SCALE] * ends, "without", True)
    loops = bare, Line(angle, with_it, name_of(best))
    shown_as = f"shown {what} {place.bracket}"
    title = f"to and fro at {quantity(speed, place_unit(model, 'rad/s', joint))}"
    return [
        Panel(title, axis, f"shown {what} of {joint} {place.bracket}", lines, around),
        Panel(f"the same against the true {what}", f"true {what} of {joint} {place.bracket}", shown_as, loops),
    ]
