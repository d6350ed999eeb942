"""The laws of MuJoCo's actuators: gain and bias, ``pid`` and ``dcmotor``; see its XML reference, "actuator"."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import casadi as ca

from equimus_ctrl.robots.mjcf.form import FAR, ActuatorForm

TINY = 1e-15


@dataclass(frozen=True, eq=False)
class Law:
    """What an actuator makes of its commands.

    Attributes:
        gain: force for each unit of its first command.
        force: (commands) → force along its length [N or N·m].
        rates: (commands) → rates of its own states.
        beside: force along its length that no bound of forces limits.
        kept: its own states within their bounds.
    """

    gain: ca.SX
    force: Callable[[Sequence[ca.SX]], ca.SX]
    rates: Callable[[Sequence[ca.SX]], Sequence[ca.SX]] = field(default=lambda u: ())
    beside: ca.SX = field(default_factory=lambda: ca.SX(0))
    kept: Sequence[ca.SX] = ()


def actuator_law(own: ActuatorForm, parameters: Sequence[ca.SX], length: ca.SX, rate: ca.SX, states: ca.SX) -> Law:
    """The law of an actuator.

    Args:
        own: its form.
        parameters: in the order of ``robots.mjcf.packing``.
        length: along which it acts, gear included.
        rate: of the length.
        states: its own.
    """
    if own.law == "affine":
        g0, g1, g2, b0, b1, b2, _, _, low, high = parameters
        gain = g0 + g1 * length + g2 * rate if own.affine_gain else g0
        return Law(gain, lambda u: gain * ca.fmin(ca.fmax(u[0], low), high) + b0 + b1 * length + b2 * rate)
    bounds = [(parameters[32 + 2 * k], parameters[33 + 2 * k]) for k in range(len(own.inputs))]
    inside = dict(zip(own.states, ca.vertsplit(states) if own.states else [], strict=True))

    def commands(u: Sequence[ca.SX]) -> dict[str, ca.SX]:
        kept = [ca.fmin(ca.fmax(x, low), high) for x, (low, high) in zip(u, bounds, strict=True)]
        return dict.fromkeys(("pos", "vel", "ff", "voltage"), ca.SX(0)) | dict(zip(own.inputs, kept, strict=True))

    make = _pid if own.law == "pid" else _motor
    return make(own, parameters[:10], parameters[10:20], parameters[20:30], length, rate, inside, commands)


Parameters = Sequence[ca.SX]
Commands = Callable[[Sequence[ca.SX]], dict[str, ca.SX]]


def _integral(error: ca.SX, state: ca.SX, most: ca.SX) -> ca.SX:
    """Rate of an integral that stays within ±most; 0 for no bound."""
    held = (most > 0) * (((state >= most) * (error > 0)) + ((state <= -most) * (error < 0)))
    return error * (1 - held)


def _kept(inside: dict[str, ca.SX], most: ca.SX) -> list[ca.SX]:
    """States of which an integral stays within ±most; 0 for no bound."""
    bound = ca.if_else(most > 0, most, FAR)
    return [ca.fmin(ca.fmax(s, -bound), bound) if name == "integral" else s for name, s in inside.items()]


def _pid(
    own: ActuatorForm, gain: Parameters, bias: Parameters, dynamics: Parameters, length: ca.SX, rate: ca.SX,
    inside: dict[str, ca.SX], commands: Commands,
) -> Law:  # fmt: skip
    kp, kv, ki = -bias[1], -bias[2], gain[0]

    def force(u: Sequence[ca.SX]) -> ca.SX:
        c = commands(u)
        total = kp * (c["pos"] - length) + kv * (c["vel"] - rate) + c["ff"] + bias[0]
        return total + ki * inside["integral"] if "integral" in inside else total

    def rates(u: Sequence[ca.SX]) -> Sequence[ca.SX]:
        return [_integral(commands(u)["pos"] - length, state, dynamics[0]) for state in inside.values()]

    return Law(kp, force, rates, kept=_kept(inside, dynamics[0]))


def _motor(
    own: ActuatorForm, gain: Parameters, bias: Parameters, dynamics: Parameters, length: ca.SX, rate: ca.SX,
    inside: dict[str, ca.SX], commands: Commands,
) -> Law:  # fmt: skip
    resistance, constant, slope, reference, kp, ki, kd, most_voltage = gain[:8]
    amplitude, poles, phase, sliding, sticking, stribeck = bias[:6]
    lag, most_rate, thermal, capacity, ambient, stiffness, damping, _, most_integral = dynamics[:9]
    hot = resistance
    if "temperature" in inside:
        hot = resistance * (1 + slope * (inside["temperature"] + ambient - reference))

    def voltage(u: Sequence[ca.SX]) -> ca.SX:
        c = commands(u)
        if not {"pos", "vel", "ff"} & set(own.inputs):
            return c["voltage"]
        torque = kp * (c["pos"] - length) + kd * (c["vel"] - rate) + c["ff"]
        if "integral" in inside:
            torque = torque + ki * inside["integral"]
        asked = resistance / constant * torque + constant * rate
        if own.limited_voltage:
            asked = ca.fmin(ca.fmax(asked, -most_voltage), most_voltage)
        return asked + c["voltage"]

    def at_once(u: Sequence[ca.SX]) -> ca.SX:
        return (voltage(u) - constant * rate) / hot

    def current(u: Sequence[ca.SX]) -> ca.SX:
        return inside.get("current", at_once(u))

    bristle = ca.SX(0)
    if "bristle" in inside:
        least = sliding + (sticking - sliding) * ca.exp(-((rate / stribeck) ** 2))
        bristle = rate - stiffness * ca.fabs(rate) / ca.fmax(TINY, least) * inside["bristle"]

    def rates(u: Sequence[ca.SX]) -> Sequence[ca.SX]:
        found = []
        for name, state in inside.items():
            if name == "integral":
                found.append(_integral(commands(u)["pos"] - length, state, most_integral))
            elif name == "temperature":
                found.append((hot * current(u) ** 2 - state / thermal) / capacity)
            elif name == "bristle":
                found.append(bristle)
            else:
                slewed = (at_once(u) - state) / lag
                bound = ca.if_else(most_rate > 0, most_rate, FAR)
                found.append(ca.fmin(ca.fmax(slewed, -bound), bound))
        return found

    beside = amplitude * ca.sin(poles * length + phase)
    if "bristle" in inside:
        beside = beside - stiffness * inside["bristle"] - damping * bristle
    kept = _kept(inside, most_integral)
    return Law(constant / resistance, lambda u: constant * current(u), rates, beside, kept)
