"""Effects between a command and an actuator's pressure; their laws are in ``effects.command``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.effects.base import Effect, parameter, register
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array

DELAY, FILL, VENT = 0, 1, 2


@dataclass(frozen=True)
class ValveEffect(Effect):
    """An effect that is a setting of the valve between command and pressure."""

    def apply(self, valve: Array) -> None:
        """Write this effect into its actuator's row (3,): delay, filling and venting time constants [s]."""
        raise NotImplementedError


@register
@dataclass(frozen=True)
class TransportDelay(ValveEffect):
    """P(t) = u(t − delay)."""

    name = "transport_delay"
    side = "command"
    sits_at = "actuator"
    summary = "the command arrives late"
    delay: float = parameter("s", 0.0, 2.0, "time between command and its arrival")

    def apply(self, valve: Array) -> None:
        valve[DELAY] += self.delay


@register
@dataclass(frozen=True)
class FirstOrderLag(ValveEffect):
    """dP/dt = (u − P)/time_constant."""

    name = "first_order_lag"
    side = "command"
    sits_at = "actuator"
    summary = "the pressure follows the command with one time constant"
    exclusive = "lag"
    time_constant: float = parameter("s", 0.0, 5.0, "of the pressure")

    def apply(self, valve: Array) -> None:
        valve[FILL] = valve[VENT] = self.time_constant


@register
@dataclass(frozen=True)
class AsymmetricLag(ValveEffect):
    """dP/dt = (u − P)/τ with τ = fill while the pressure rises and vent while it falls."""

    name = "asymmetric_lag"
    side = "command"
    sits_at = "actuator"
    summary = "filling and venting have different time constants"
    exclusive = "lag"
    fill: float = parameter("s", 0.0, 5.0, "time constant of a rising pressure")
    vent: float = parameter("s", 0.0, 5.0, "time constant of a falling pressure")

    def apply(self, valve: Array) -> None:
        valve[FILL], valve[VENT] = self.fill, self.vent


def valve_settings(effects: Sequence[Effect], actuators: Sequence[str]) -> Array:
    """(na, 3) transport delay, filling and venting time constants of each actuator [s]; zeros mean none.

    Raises:
        ConfigError: for an effect that is no valve's: nothing would simulate it.
    """
    valve = np.zeros((len(actuators), 3))
    for effect in effects:
        if not isinstance(effect, ValveEffect):
            raise ConfigError(f"effect {effect.name} at {effect.location!r}: the {effect.side} side is not simulated")
        effect.apply(valve[list(actuators).index(effect.location)])
    return valve
