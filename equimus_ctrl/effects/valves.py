"""Effects between a command and an actuator's pressure; the valves' laws are in ``effects.command``.

A command passes first what acts on its value at once (dead zone, supply coupling, saturation, threshold with jump, in
this order), then the valve: transport delay, rate limit, filling flow and lag. Of motors a "valve" is whatever lies
between a command and the drive, and Pa stands for the unit of its command.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from equimus_ctrl.effects.base import Effect, parameter, register
from equimus_ctrl.effects.command import DELAY, FILL, FLOW, POWER, RATE, REFERENCE, VENT
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.native import Draft, bound_command, filter_command, limit_rate, lose_first
from equimus_ctrl.effects.shaping import COUPLING, CUTOFF, DEAD_ZONE, SATURATION, shape_column
from equimus_ctrl.effects.sizes import Share, Size
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class ValveEffect(Effect):
    """An effect that is a setting of the valve between command and pressure."""

    side = "command"
    simulated = True
    sits_at = ("actuator",)

    def apply(self, valve: Array) -> None:
        """Write this effect into its actuator's row (6,), see ``effects.command.DELAY``."""
        raise NotImplementedError


@dataclass(frozen=True)
class ShapingEffect(Effect):
    """An effect on the value of a command, without memory."""

    side = "command"
    simulated = True
    sits_at = ("actuator",)
    order: ClassVar[int]
    """Effects of lower order act first."""
    within_ranges: ClassVar[bool] = False
    """Whether it takes commands as drives do that clip them to their ranges."""

    def shape(self, commands: Array, own: int) -> Array:
        """(n,) the actuator's shaped commands [Pa].

        Args:
            commands: (n, na) of all actuators [Pa].
            own: the actuator's column.
        """
        raise NotImplementedError

    def columns(self, actuators: Sequence[str]) -> tuple[int, ...]:
        """Which of the actuators' commands it changes: that of its own place.

        Args:
            actuators: names of all.
        """
        return (list(actuators).index(self.location),)


@dataclass(frozen=True)
class CompiledShaping(ShapingEffect):
    """One whose law stands in ``effects.command``, numbered by ``order``, and takes the effect's only parameter."""

    @property
    def number(self) -> float:
        """The parameter."""
        (value,) = self.parameters().values()
        return value

    def shape(self, commands: Array, own: int) -> Array:
        given = np.array(commands, dtype=np.float64, order="C")
        out = np.empty(len(given))
        shape_column(self.order, given, own, self.number, out)
        return out


@register
@dataclass(frozen=True)
class TransportDelay(ValveEffect):
    """P(t) = u(t − delay)."""

    name = "transport_delay"
    robots = ("elastic", "mjcf")
    summary = "dead time between command and pressure"
    mjcf_form = "`delay` of the actuator, with a buffer (`nsample`) that holds it, from one step on"
    delays = True
    leg_sizes = (Size("delay", 4e-3, 0.2, "half a sample to many; valves with long hoses"),)
    leg_alike = True
    mjcf_sizes = (Share("delay", 0.005, 0.2),)
    delay: float = parameter("s", 0.0, 2.0, "time between command and its arrival")

    def apply(self, valve: Array) -> None:
        valve[DELAY] += self.delay

    def write_mjcf(self, draft: Draft) -> str:
        return ""  # with those of the XML, as the delay of its drive

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Every command reaches {t.at} {t['delay']} after it was given: a transport delay."


@register
@dataclass(frozen=True)
class FirstOrderLag(ValveEffect):
    """dP/dt = (u − P)/time_constant."""

    name = "first_order_lag"
    robots = ("elastic", "mjcf")
    summary = "the pressure follows the command with one time constant"
    mjcf_form = '`dyntype="filterexact"` of an actuator that has no dynamics yet'
    delays = True
    exclusive = "lag"
    leg_sizes = (Size("time_constant", 5e-3, 0.4, "less than a sample to a valve that feeds a large volume"),)
    leg_alike = True
    mjcf_sizes = (Share("time_constant", 0.005, 0.2),)
    time_constant: float = parameter("s", 0.0, 5.0, "of the pressure")

    def apply(self, valve: Array) -> None:
        valve[FILL] = valve[VENT] = self.time_constant

    def write_mjcf(self, draft: Draft) -> str:
        return filter_command(draft, self.location, self.time_constant)

    @classmethod
    def sentence(cls, t: Description) -> str:
        verb = t.one_or("follows its command", "follow their commands")
        return f"{t.actuation} {verb} with a time constant of {t['time_constant']}."


@register
@dataclass(frozen=True)
class AsymmetricLag(ValveEffect):
    """dP/dt = (u − P)/τ with τ = fill while the pressure rises and vent while it falls."""

    name = "asymmetric_lag"
    summary = "filling and venting have different time constants"
    mjcf_lacks = "MuJoCo's filters have one time constant"
    delays = True
    exclusive = "lag"
    leg_sizes = (
        Size("fill", 6e-3, 0.4, "as the symmetric lag"),
        Size("vent", 6e-3, 0.4, "as the symmetric lag"),
    )
    leg_alike = True
    fill: float = parameter("s", 0.0, 5.0, "time constant of a rising pressure")
    vent: float = parameter("s", 0.0, 5.0, "time constant of a falling pressure")

    @classmethod
    def fades_to(cls) -> Mapping[str, float]:
        return {"fill": 0.0, "vent": 0.0}

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        short, middle, long = excitation.sizes("s")
        pairs = ((short, middle), (middle, short), (middle, long), (long, middle), (short, long), (long, short))
        return [{"fill": fill, "vent": vent} for fill, vent in pairs]

    def apply(self, valve: Array) -> None:
        valve[FILL], valve[VENT] = self.fill, self.vent

    @classmethod
    def reduces_to_simpler(cls, values: Mapping[str, float]) -> bool:
        return abs(math.log(values["fill"] / values["vent"])) < math.log(1.5)

    @classmethod
    def sentence(cls, t: Description) -> str:
        rises, falls = t.one_or("rises", "rise"), t.one_or("falls", "fall")
        return f"{t.actuation} {rises} with a time constant of {t['fill']} and {falls} with one of {t['vent']}."


@register
@dataclass(frozen=True)
class RateLimit(ValveEffect):
    """|dP/dt| ≤ rate."""

    name = "rate_limit"
    summary = "the pressure changes no faster than the valve's flow allows"
    mjcf_form = "`dcmotor` under a torque command, with `slewmax`"
    nothing = None
    weaker = 1
    exclusive = "rate_limit"
    leg_sizes = (Size("rate", 1.5e4, 5e5, "a step of 15 kPa takes from 0.03 s to 1 s"),)
    leg_alike = True
    rate: float = parameter("Pa/s", 1e3, 1e7, "the fastest the pressure can change")

    def apply(self, valve: Array) -> None:
        valve[RATE] = self.rate

    def write_mjcf(self, draft: Draft) -> str:
        return limit_rate(draft, self.location, self.rate)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"{t.actuation} {t.one_or('changes', 'change')} no faster than {t['rate']}: the flow is limited."


@register
@dataclass(frozen=True)
class FillingFlow(ValveEffect):
    """dP/dt ≤ rate·(u/10 kPa)^power while the pressure rises towards the command u; it falls without such a limit.

    A proportional valve opens the farther the more is asked for. With power 0 filling takes the longer the more is
    asked for, with power 1 always as long, above 1 the shorter.
    """

    name = "filling_flow"
    summary = "the valve fills at a rate that grows with the command"
    mjcf_lacks = "MuJoCo's limits of rates are constants"
    nothing = None
    weaker = 1
    exclusive = "filling_flow"
    leg_sizes = (
        Size("rate", 1e4, 2e5, "to fill to 10 kPa takes from 0.05 s to 1 s"),
        Size("power", 0.3, 2.0, "filling to much takes longer than to little, or less long", "linear"),
    )
    leg_alike = True
    rate: float = parameter("Pa/s", 1e3, 1e7, "the fastest the pressure can rise under a command of 10 kPa")
    power: float = parameter("1", 0.0, 3.0, "of the command with which that rate grows")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        whole = excitation.command / REFERENCE
        return [
            {"rate": excitation.command / (time * whole**power), "power": power}
            for time in (0.2, 0.5, 1.0)
            for power in (0.0, 1.0, 1.5)
        ]

    def apply(self, valve: Array) -> None:
        valve[FLOW], valve[POWER] = self.rate, self.power

    @classmethod
    def sentence(cls, t: Description) -> str:
        return (
            f"{t.actuation} {t.one_or('rises', 'rise')} no faster than {t['rate']} under a command of 10 kPa, and as "
            f"its power {t['power']} under others: the flow grows with the command."
        )


@register
@dataclass(frozen=True)
class DeadZone(CompiledShaping):
    """u' = max(u − threshold, 0)."""

    name = "dead_zone"
    summary = "commands below a threshold do nothing"
    mjcf_form = "a constant `biasprm` and a `forcerange` from 0 on"
    exclusive = "dead_zone"
    order = DEAD_ZONE
    leg_sizes = (Size("threshold", 100.0, 5e3, "0.2 to 10 % of the range"),)
    leg_alike = True
    threshold: float = parameter("Pa", 0.0, 5e4, "pressure that a command loses, and below which it does nothing")

    def write_mjcf(self, draft: Draft) -> str:
        return lose_first(draft, self.location, self.threshold)

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        # Above the threshold all is as with another rest length: only commands below it identify it.
        return [{"threshold": share * excitation.command} for share in (0.02, 0.05, 0.08, 0.12, 0.16, 0.2, 0.26, 0.34)]

    @classmethod
    def sentence(cls, t: Description) -> str:
        who = t.one_or(f"The valve of {t.at} loses", f"The valves of {t.at} each lose")
        return f"{who} the first {t['threshold']} of every command: a dead zone."


@register
@dataclass(frozen=True)
class SupplyCoupling(CompiledShaping):
    """u' = max(u − share·Σ of the other actuators' commands, 0)."""

    name = "supply_coupling"
    summary = "the other channels' demand lowers this one's pressure"
    mjcf_lacks = "MuJoCo's actuators know their own commands alone"
    exclusive = "supply_coupling"
    order = COUPLING
    leg_sizes = (Size("share", 3e-3, 0.12, "a stiff supply to a common narrow hose"),)
    leg_alike = True
    share: float = parameter("1", 0.0, 1.0, "pressure lost for each pressure that the others ask for")

    @classmethod
    def sentence(cls, t: Description) -> str:
        lost = t.scaled("share", "%", 100.0)
        return f"{t.actuation} {t.one_or('falls', 'fall')} by {lost} of what is asked of the others: a shared supply."


@register
@dataclass(frozen=True)
class Saturation(CompiledShaping):
    """u' = min(u, level)."""

    name = "saturation"
    summary = "the pressure stops rising above a level"
    mjcf_form = "`ctrlrange`"
    nothing = None
    weaker = 1
    exclusive = "saturation"
    order = SATURATION
    leg_sizes = (
        Size("level", 1.4e4, 3.2e4, "below what the trials ask for", "linear", "maa"),
        Size("level", 1e4, 2e4, "below what the trials ask for", "linear", "baa"),
    )
    level: float = parameter("Pa", 0.0, 1e6, "the greatest pressure there is")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"level": share * excitation.command}
            for share in (0.97, 0.92, 0.86, 0.8, 0.72, 0.64, 0.56, 0.48, 0.4, 0.33)
        ]

    def write_mjcf(self, draft: Draft) -> str:
        return bound_command(draft, self.location, self.level)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"{t.actuation} {t.one_or('stops', 'stop')} rising at {t['level']}: a saturation."


@register
@dataclass(frozen=True)
class Cutoff(CompiledShaping):
    """Threshold with jump: u' = u where u ≥ least, else 0."""

    name = "cutoff"
    mjcf_lacks = "MuJoCo has no law with a jump"
    summary = "threshold with jump: the valve stays shut below a least command, and follows it in full above"
    nothing = None
    weaker = -1
    exclusive = "cutoff"
    order = CUTOFF
    discontinuous = ("least",)
    leg_sizes = (Size("least", 300.0, 6e3, "0.7 to 15 % of the range"),)
    leg_alike = True
    least: float = parameter("Pa", 0.0, 5e4, "the smallest command that the valve follows")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"least": share * excitation.command} for share in (0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.24, 0.32)]

    @classmethod
    def sentence(cls, t: Description) -> str:
        who = t.one_or(f"The valve of {t.at} stays", f"The valves of {t.at} stay")
        follow = t.one_or("follows", "follow")
        return f"{who} shut under commands below {t['least']}, and {follow} others in full: a threshold with jump."


def valve_settings(effects: Sequence[Effect], actuators: Sequence[str]) -> Array:
    """(na, 6) each actuator's valve, see ``effects.command.DELAY``."""
    valve = np.zeros((len(actuators), 6))
    valve[:, [RATE, FLOW]] = math.inf
    for effect in effects:
        if isinstance(effect, ValveEffect):
            effect.apply(valve[list(actuators).index(effect.location)])
    return valve


def valve_effects(valve: Array, actuator: str) -> list[ValveEffect]:
    """What makes an actuator's valve what its row (6,) of ``valve_settings`` says."""
    found: list[ValveEffect] = [TransportDelay(actuator, float(valve[DELAY]))] if valve[DELAY] > 0 else []
    if valve[FILL] == valve[VENT] > 0:
        found.append(FirstOrderLag(actuator, float(valve[FILL])))
    elif valve[FILL] != valve[VENT]:
        found.append(AsymmetricLag(actuator, float(valve[FILL]), float(valve[VENT])))
    if valve[RATE] < math.inf:
        found.append(RateLimit(actuator, float(valve[RATE])))
    if valve[FLOW] < math.inf:
        found.append(FillingFlow(actuator, float(valve[FLOW]), float(valve[POWER])))
    return found


def shaping_effects(effects: Sequence[Effect]) -> list[ShapingEffect]:
    """Those of a model's effects that act on a command's value, in the order in which they do."""
    return sorted((e for e in effects if isinstance(e, ShapingEffect)), key=lambda e: e.order)


def shaped_commands(
    effects: Sequence[Effect], actuators: Sequence[str], commands: Array, ranges: Array | None = None
) -> Array:
    """(n, na) what reaches the valves of commands (n, na) [Pa]; shaping effects of one order act side by side.

    Args:
        effects: all of one robot.
        actuators: names of all.
        commands: of all.
        ranges: (2, na) between what drives clip commands (``Robot.command_ranges``); None where they do not.
    """
    shapers = shaping_effects(effects)
    shaped: Array = np.array(commands)
    for order in sorted({e.order for e in shapers}):
        given = shaped.copy()
        for effect in shapers:
            if effect.order == order:
                taken = given if ranges is None or not effect.within_ranges else np.clip(given, *ranges)
                for own in effect.columns(actuators):
                    shaped[:, own] = effect.shape(taken, own)
    return shaped


TRIES = 50
"""How often a command is corrected by what shaping takes from it, or the range of useful ones is halved."""


def command_for(
    effects: Sequence[Effect], actuators: Sequence[str], pressure: Array, low: Array | float, high: Array | float
) -> Array:
    """(n, na) commands between low and high of which shaping leaves pressures (n, na), or comes near to them [Pa]."""
    if not shaping_effects(effects):
        return pressure
    command = best = np.clip(pressure, low, high)
    least = np.full((len(pressure), 1), math.inf)
    for _ in range(TRIES):
        missing = pressure - shaped_commands(effects, actuators, command)
        off = np.abs(missing).sum(axis=1, keepdims=True)
        # Around a jump the corrections go to and fro.
        best, least = np.where(off <= least, command, best), np.minimum(off, least)
        command = np.clip(command + missing, low, high)
    return np.asarray(best)


def useful_commands(
    effects: Sequence[Effect], actuators: Sequence[str], low: Array | float, high: Array | float
) -> tuple[Array, Array]:
    """(na,) between what each command makes a difference while the others are at their lowest [Pa].

    Args:
        effects: all of one robot; shaping is taken to fall nowhere as the command rises.
        actuators: names of all.
        low: lowest command [Pa]; one for all, or (na,).
        high: highest command [Pa]; alike.
    """
    na = len(actuators)
    least, most = np.array(np.broadcast_to(low, na), dtype=float), np.array(np.broadcast_to(high, na), dtype=float)
    if not shaping_effects(effects) or not np.isfinite([least, most]).all():
        return least, most

    def arrives(own: Array) -> Array:
        commands = np.tile(np.broadcast_to(low, na).astype(float), (na, 1))
        np.fill_diagonal(commands, own)
        return np.diagonal(shaped_commands(effects, actuators, commands))

    nothing, everything = arrives(least), arrives(most)
    without, whole = most.copy(), least.copy()
    for _ in range(TRIES):
        middle = (least + without) / 2
        idle = arrives(middle) <= nothing
        least, without = np.where(idle, middle, least), np.where(idle, without, middle)
        middle = (whole + most) / 2
        full = arrives(middle) >= everything
        whole, most = np.where(full, whole, middle), np.where(full, middle, most)
    return least, np.maximum(least, most)


def shaping_laws(effects: Sequence[Effect], actuators: Sequence[str]) -> Array | None:
    """(m, 3) the shaping effects as ``effects.shaping.shape_command`` takes them; None where one is Python alone."""
    shapers = shaping_effects(effects)
    rows = [
        (e.order, list(actuators).index(e.location), e.number)
        for e in shapers
        if isinstance(e, CompiledShaping) and type(e).shape is CompiledShaping.shape
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 3) if len(rows) == len(shapers) else None
