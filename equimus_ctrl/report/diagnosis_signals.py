"""Curves of effects on signals: between a command and the pressure, and between an angle and what is shown of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from equimus_ctrl.diagnosis import units
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
    names = scene.model.robot.actuator_names
    own = names.index(best[0].location)
    shown_in = units.command(scene.model, names[own])
    factor = shown_in.factor
    pressures = scene.model.robot.traits.commands_are_pressures
    label = "pressure" if pressures else "what acts"
    commands = scene.commands
    rest = [i for i in range(len(names)) if i != own]
    grid = np.linspace(0.0, max(float(commands[:, own].max()), 1.0), POINTS)

    def static(effects: Sequence[Effect], demand: float) -> Array:
        asked = np.full((POINTS, len(names)), demand)
        asked[:, own] = grid
        return np.asarray(shaped_commands((*scene.model.effects, *effects), names, asked)[:, own] * factor)

    busy = float(np.quantile(commands[:, rest], 0.9)) if rest else 0.0
    demand = busy if changes(static(best, busy), static(best, 0.0)) else 0.0
    plain, curve = static((), demand), static(best, demand)
    found = []
    if changes(curve, plain):
        title = f"while {quantity(demand, 'Pa')} are asked of the others" if demand else "once it has settled"
        lines = (Line(grid * factor, plain, "without", True), Line(grid * factor, curve, name_of(best)))
        around = band(grid * factor, curve, [static(o, demand) for o in others])
        axis = f"command of {names[own]} {shown_in.bracket}"
        found.append(Panel(title, axis, f"{label} {shown_in.bracket}", lines, around, commands[:, own] * factor))
    low, high = _typical_step(commands[:, own])
    if changes(curve, plain) and np.allclose(np.interp([low, high], grid, curve - plain), 0.0):
        low, high = 0.0, float(grid[-1])  # such as a level that a typical command does not reach

    def response(effects: Sequence[Effect], half: float) -> Array:
        """Pressures from a tenth of ``half`` before the step up to ``half`` after the one down, which comes then."""
        asked = np.full((3, len(names)), demand)
        asked[:, own] = low, high, low
        whole = (*scene.model.effects, *effects)
        shaped = shaped_commands(whole, names, asked)
        out = np.empty((round(2.1 * half / STEP), 2, len(names)))
        times = np.array([0.0, half])
        pressure_history(times, shaped[1:], shaped[0], valve_settings(whole, names), -0.1 * half, STEP, out)
        return np.asarray(out[:, 0, own] * factor)

    def clock(half: float) -> Array:
        return np.asarray(np.arange(round(2.1 * half / STEP)) * STEP + STEP / 2 - 0.1 * half)

    long, time = response(best, LONGEST), clock(LONGEST)
    up, down = time < LONGEST, time >= LONGEST
    lasts = max(settled(time[up], long[up]), settled(time[down], long[down]) - LONGEST)
    half = float(np.clip(1.4 * lasts, SHORTEST, LONGEST))
    shown, axis = in_time(clock(half))
    moving = response(best, half)
    lines = (Line(shown, response((), half), "without", True), Line(shown, moving, name_of(best)))
    around = band(shown, moving, [response(o, half) for o in others])
    ends = [f"{number(value * factor)} {shown_in.unit}".rstrip() for value in (high, low)]
    if pressures:
        ends = [quantity(high, "Pa"), quantity(low, "Pa")]
    title = f"a step to {ends[0]} and back to {ends[1]}"
    return [*found, Panel(title, axis, f"{label} of {names[own]} {shown_in.bracket}", lines, around)]


def _typical_step(commands: Array) -> tuple[float, float]:
    low, high = (float(v) for v in np.quantile(commands, TYPICAL))
    return (low, high) if high - low > 0.1 * float(commands.max()) else (0.0, max(float(commands.max()), 1.0))


def sensor_panels(scene: Scene, best: Sequence[Effect], others: Sequence[Sequence[Effect]]) -> list[Panel]:
    """What is shown of an angle: at rest where that is changed, and in a motion to and fro where that is.

    Args: as of ``command_panels``.
    """
    m = scene.model.robot
    joint = best[0].location
    place, what = units.position(scene.model, joint), units.noun(scene.model, joint)
    own = m.joint_names.index(joint)
    seen = scene.seen[joint]

    def sensor(effects: Sequence[Effect]) -> Array:
        return np.asarray(sensor_settings((*scene.model.effects, *effects), m.joint_names)[own])

    now, plain = sensor(best), sensor(())
    found = []
    true = np.linspace(seen.low, seen.high, POINTS)

    def error(row: Array) -> Array:
        return np.asarray((row[OFFSET] + (row[SCALE] - 1) * true) * place.factor)

    x = true * place.factor
    if changes(error(now), error(plain)):
        data = scene.position(joint) * place.factor
        lines = (Line(x, error(plain), "without", True), Line(x, error(now), name_of(best)))
        around = band(x, error(now), [error(sensor(o)) for o in others])
        axis = f"true {what} of {joint} {place.bracket}"
        found.append(Panel("error of what is shown", axis, f"shown − true {place.bracket}", lines, around, data))
        lines = (Line(x, x + error(plain), "without", True), Line(x, x + error(now), name_of(best)))
        around = band(x, x + error(now), [x + error(sensor(o)) for o in others])
        found.append(Panel("what is shown", axis, f"shown {what} {place.bracket}", lines, around, data))
    if any(now[key] != plain[key] for key in (SENSOR_DELAY, PLAY)):
        sensors = plain, now, [sensor(o) for o in others]
        found += _to_and_fro(scene.model, joint, seen.low, seen.high, seen.speed, sensors, best)
    return found


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
    place, what = units.position(model, joint), units.noun(model, joint)
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
