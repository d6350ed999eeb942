"""The law of each effect as numbers to draw, from its own class: what it does, beside what there is without it.

One way for each kind of effect. A law without memory is drawn over its argument, one with a memory over time or around
a motion to and fro:

- an effect that has curves of its own (``Effect.curves``): the first of these;
- a force: over the drive's force, the coordinate or its rate, whichever it depends on; one with states of its own after
  a step of the coordinate where it goes on changing at rest, else over the coordinate that moves to and fro;
- a valve: what arrives of a command that steps to a half and back, and to its whole and back;
- what acts on a command's value: what is left of it over the command;
- a sensor: what is shown over the true angle, or over time where it remembers;
- another robot: what that robot exerts on a joint beside what the model exerts, over angle, rate or acceleration; what
  its drive exerts over the command; or its motion, where it has a joint that the model has not, or a constraint.

Parameters are guesses from which a search for the effect begins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
from effect_law import CHANGED, POINTS, Law
from effect_robots import at_rest, other_robot

from equimus_ctrl.effects import Effect, Excitation, ForceEffect, SensorEffect, ShapingEffect, ValveEffect
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, sample, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

ARM = """
<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/><site name="tip" pos="0 0 -0.3"/>
<body name="fore" pos="0 0 -0.3">
<joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/></body></body></worldbody>
<actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/></actuator></mujoco>
"""
"""An MJCF robot with effects: two links that hang from a hinge, one drive with a rotor and one without."""
TURNING = Excitation(
    low=-math.pi, high=math.pi, speed=3.0, force=3.0, command=3.0, interval=0.01, duration=4.0, mass=0.8, drive=3.0,
    reach=0.15, middle=(0.0, 0.0, -0.25), roams=0.2, lowest=-0.3, rises=0.14,
)  # fmt: skip
"""What recordings of that arm may show of a joint [SI]."""
PULLING = Excitation(
    low=0.18, high=0.26, speed=0.3, force=20.0, command=5e4, interval=0.01, duration=4.0, mass=1.0
)  # fmt: skip
"""The same of an actuator of the leg, which has a length."""
RAMP = 0.05
"""Duration of what is called a step of a coordinate [s]."""
CYCLES, CYCLE = 2, 400
"""A motion to and fro is gone through so often until states follow it; instants of each."""


@cache
def robot_of(cls: type[Effect]) -> Robot:
    """A robot that can have the effect."""
    return nominal_model().robot if "elastic" in cls.robots else MjcfRobot("arm", ARM)


def place_of(cls: type[Effect]) -> str:
    """The first place of that robot where it can sit."""
    places = cls.places_on(robot_of(cls))
    return next(name for kind in cls.sits_at for name in places.get(kind, ()))


def law(cls: type[Effect]) -> Law:
    """The law with the guess that does most; of those that do about as much, the one of the largest later parameters.

    The first parameter is mostly a size, and those after it give the law its shape.
    """
    seen = _seen(robot_of(cls), place_of(cls))
    laws = [_law(cls(place_of(cls), **guess)) for guess in cls.guesses(seen)]

    def rank(found: Law) -> tuple[int, tuple[float, ...]]:
        return (round(math.log2(max(found.strength, 1e-300))), tuple(reversed(found.effect.parameters().values())))

    return max(laws, key=rank)


def _seen(robot: Robot, place: str) -> Excitation:
    if not robot.traits.forces_along_actuators:
        return TURNING
    if place not in robot.joint_names:
        return PULLING
    low, high = (float(ends[robot.joint_names.index(place)]) for ends in robot.joint_range)
    return replace(TURNING, low=low, high=high)


def _law(effect: Effect) -> Law:
    robot = robot_of(type(effect))
    seen = _seen(robot, effect.location)
    if curves := effect.curves(robot, seen):
        own = curves[0]
        without = np.full(len(own.along), own.without)
        return Law(effect, own.title, own.along, own.x, own.x_unit, own.values, without, own.y, own.y_unit)
    if isinstance(effect, ForceEffect):
        return _remembered_force(effect, robot, seen) if effect.n_states else _force(effect, robot, seen)
    if isinstance(effect, ValveEffect):
        return _valve(effect, robot, seen)
    if isinstance(effect, ShapingEffect):
        return _shaped(effect, robot, seen)
    if isinstance(effect, SensorEffect):
        return _sensor(effect, robot, seen)
    return at_rest(effect, robot) if robot.traits.held_in_place else other_robot(effect, robot, seen)


def _coordinate(robot: Robot, place: str) -> tuple[str, str, str, str]:
    """What the coordinate of a place and a force there are called, and their units."""
    if place in robot.joint_names:
        return "joint angle", "rad", "torque on the joint", "N·m"
    return "actuator's length", "m", "force along the actuator", "N"


def _numbers(effect: Effect) -> dict[str, ca.SX]:
    return {key: ca.SX(value) for key, value in effect.parameters().items()}


def _force(effect: ForceEffect, robot: Robot, seen: Excitation) -> Law:
    """A force without memory over the first of its arguments: the drive's force, the coordinate, the rate."""
    what, unit, exerts, force_unit = _coordinate(robot, effect.location)
    names = {"drive": ca.SX.sym("drive"), "x": ca.SX.sym("x"), "rate": ca.SX.sym("rate")}
    exerted = effect.sliding_force(names["x"], names["rate"], (), names["drive"], _numbers(effect))
    function = ca.Function("law", [names["x"], names["rate"], names["drive"]], [exerted])
    middle, rubs = (seen.low + seen.high) / 2, effect.rubs or effect.loads
    axes = {
        "drive": (np.linspace(-seen.drive, seen.drive, POINTS), "drive's force", force_unit),
        "x": (np.linspace(seen.low, seen.high, POINTS), what, unit),
        "rate": (np.linspace(-seen.speed, seen.speed, POINTS), "rate", f"{unit}/s"),
    }
    own = next((key for key in axes if ca.depends_on(exerted, names[key])), "x")
    at = {"x": np.full(POINTS, middle), "rate": np.full(POINTS, seen.speed), "drive": np.zeros(POINTS)}
    at[own], x_axis, x_unit = axes[own]
    values = np.array(function(*(at[key][None] for key in ("x", "rate", "drive")))).ravel()
    shown = "while q̇ > 0" if rubs and own != "rate" else "whatever the motion" if np.ptp(values) == 0 else ""
    return Law(effect, shown, at[own], x_axis, x_unit, values, np.zeros(POINTS), exerts, force_unit)


def _remembered_force(effect: ForceEffect, robot: Robot, seen: Excitation) -> Law:
    """A force with states: after a step where it goes on changing at rest, else around a motion to and fro."""
    what, unit, exerts, force_unit = _coordinate(robot, effect.location)
    half, middle = seen.span / 2, (seen.low + seen.high) / 2
    time = np.linspace(-RAMP, seen.duration, 8 * POINTS)
    moved = np.clip(time / RAMP, 0.0, 1.0)
    rate = np.where((time >= 0) & (time < RAMP), half / RAMP, 0.0)
    after = _along(effect, time, middle + half * (moved - 0.5), rate)
    if np.ptp(after[time > RAMP]) > CHANGED * np.ptp(after):
        shown = "after a step of the coordinate"
        return Law(effect, shown, time, "time", "s", after, np.zeros(len(time)), exerts, force_unit)
    turn = np.linspace(0.0, 2 * np.pi * CYCLES, CYCLES * CYCLE + 1)
    x, rate = middle + half * np.sin(turn), seen.speed * np.cos(turn)
    around = _along(effect, turn * half / seen.speed, x, rate)[-CYCLE - 1 :]
    kept = x[-CYCLE - 1 :]
    return Law(effect, "to and fro", kept, what, unit, around, np.zeros(len(kept)), exerts, force_unit)


def _along(effect: ForceEffect, time: Array, x: Array, rate: Array, parts: int = 16) -> Array:
    """(n,) the force along a motion (n,) from rest, its states by Heun's rule in so many parts of each interval."""
    p, z = _numbers(effect), ca.SX.sym("z", effect.n_states)
    u = ca.SX.sym("u", 5)  # coordinate and rate at both ends, and the interval
    after = z
    for part in range(parts):
        ends = [
            (u[0] + (u[1] - u[0]) * share, u[2] + (u[3] - u[2]) * share) for share in (part / parts, (part + 1) / parts)
        ]
        dt = u[4] / parts
        slope = ca.vertcat(*effect.state_rate(*ends[0], ca.vertsplit(after), p))
        later = ca.vertcat(*effect.state_rate(*ends[1], ca.vertsplit(after + dt * slope), p))
        after = after + dt * (slope + later) / 2
    step = ca.Function("step", [z, u], [after]).mapaccum("steps", len(time) - 1)
    first = np.array(ca.DM(ca.vertcat(*effect.rest_state(ca.SX(x[0]), p))))
    states = np.hstack([first, np.array(step(first, np.array([x[:-1], x[1:], rate[:-1], rate[1:], np.diff(time)])))])
    at, speed = ca.SX.sym("x"), ca.SX.sym("rate")
    exerted = effect.sliding_force(at, speed, ca.vertsplit(z), ca.SX(0), p)
    return np.array(ca.Function("force", [at, speed, z], [exerted])(x[None], rate[None], states)).ravel()


def _valve(effect: ValveEffect, robot: Robot, seen: Excitation) -> Law:
    """What arrives of a command that steps to a half and back, and to its whole and back."""
    names = robot.actuator_names
    own, half, steps = names.index(effect.location), seen.duration / 4, 8 * POINTS
    dt = 4.25 * half / steps
    times, commands = half * np.arange(4.0), np.zeros((4, len(names)))
    commands[::2, own] = 0.5 * seen.command, seen.command

    def arrives(effects: Sequence[Effect]) -> Array:
        out = np.empty((steps, 2, len(names)))
        valve = valve_settings(effects, names)
        pressure_history(times, commands, np.zeros(len(names)), valve, -0.25 * half, dt, out)
        return out[:, 0, own]

    x = -0.25 * half + dt * (np.arange(steps) + 0.5)
    shown = "a command that steps up and back, twice"
    return Law(effect, shown, x, "time", "s", arrives([effect]), arrives([]), *_command(robot, effect.location))


def _command(robot: Robot, actuator: str) -> tuple[str, str]:
    """What arrives of a command, and its unit."""
    pressures = robot.traits.commands_are_pressures
    return "pressure" if pressures else "what acts", robot.command_unit(actuator)


def _shaped(effect: ShapingEffect, robot: Robot, seen: Excitation) -> Law:
    """What is left of a command over the command; half of the largest is asked of the others where that counts."""
    names = robot.actuator_names
    own = names.index(effect.location)
    x = np.linspace(0.0 if robot.traits.commands_are_pressures else -seen.command, seen.command, POINTS)

    def left(effects: Sequence[Effect], others: float) -> Array:
        commands = np.full((POINTS, len(names)), others)
        commands[:, own] = x
        return shaped_commands(effects, names, commands)[:, own]

    busy = seen.command / 2
    matters = not np.array_equal(left([effect], 0.0), left([effect], busy))
    values = left([effect], busy if matters else 0.0)
    what, unit = _command(robot, effect.location)
    shown = "while half as much is asked of the other" if matters else ""
    return Law(effect, shown, x, "command", unit, values, x, what, unit)


def _sensor(effect: SensorEffect, robot: Robot, seen: Excitation) -> Law:
    """What is shown of an angle: over the true one, or where the sensor remembers over time, to and fro."""
    joints = robot.joint_names
    own = joints.index(effect.location)
    row, plain = (sensor_settings(effects, joints)[own] for effects in ([effect], []))
    remembers = row[PLAY] > 0 or row[SENSOR_DELAY] > 0
    # As far as lets the play, or what the joint turns in the meantime, be seen.
    half = 3 * (row[PLAY] + row[SENSOR_DELAY] * seen.speed) if remembers else seen.span / 2
    quarter = half / seen.speed
    time = np.linspace(0.0, 8 * quarter, 8 * POINTS)
    true = half * np.interp(time / quarter, np.arange(9), [0, 1, 0, -1, 0, 1, 0, -1, 0])

    def shows(sensor: Array) -> Array:
        out = np.empty(len(time))
        sample(true, np.gradient(true, time), 0.0, float(time[1]), sensor, time, out)
        return out

    values, without = shows(row), shows(plain)
    if remembers:
        kept = time >= 3 * quarter
        x = time[kept] - 3 * quarter
        return Law(effect, "the joint to and fro", x, "time", "s", values[kept], without[kept], "measured angle", "rad")
    up = (time >= 3 * quarter) & (time <= 5 * quarter)
    return Law(effect, "", true[up], "true angle", "rad", values[up], without[up], "measured angle", "rad")
