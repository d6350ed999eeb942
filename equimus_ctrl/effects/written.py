"""A model's effects written into what MuJoCo's XML has, and what of them it has nothing for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.effects.sensors import SCALE, SENSOR_DELAY, SensorDelay
from equimus_ctrl.effects.valves import TransportDelay, shaping_effects
from equimus_ctrl.types import Array

SHORT = (
    "it is shorter than a physics step, and MuJoCo reads what was a step before at the earliest; a smaller --timestep "
    "holds it"
)


@dataclass(frozen=True)
class Unwritten:
    """An effect that MuJoCo's XML cannot hold.

    Attributes:
        name: of the effect.
        place: where it sits.
        reason: a phrase.
    """

    name: str
    place: str
    reason: str

    @property
    def label(self) -> str:
        """What it is called in a sentence."""
        return f"{self.name} at {self.place}"


def write_effects(
    draft: Draft, effects: Sequence[Effect], actuators: Mapping[str, int], joints: Sequence[str], valve: Array,
    sensor: Array, given: Array,
) -> tuple[list[Unwritten], dict[str, tuple[float, float]]]:  # fmt: skip
    """Write effects into a draft.

    Args:
        draft: changed in place; its actuators have no delay that ``valve`` does not know of.
        effects: all of the model's.
        actuators: name of each command → its actuator in the draft's model.
        joints: names of all.
        valve: (na, 6) see ``effects.command.DELAY``, the XML's own delays included.
        sensor: (nj, 4) see ``effects.sensors.OFFSET``.
        given: (na,) the XML's own delays alone, which stay as they are where no effect adds to them [s].

    Returns:
        What was not written, and joint → (delay [s], scale) of its measurements where they are not as it moves.
    """
    shaping = shaping_effects(effects)
    unwritten = []
    for effect in (*shaping, *(e for e in effects if e not in shaping)):
        if reason := effect.write_mjcf(draft):
            unwritten.append(Unwritten(effect.name, effect.location, reason))
    step = float(draft.model.opt.timestep)
    late = zip(actuators.items(), valve[:, DELAY].tolist(), given.tolist(), strict=True)
    for (name, index), delay, own in late:
        held = delay == own or delay >= step
        draft.model.actuator_delay[index] = delay if held else own
        if not held:
            unwritten.append(Unwritten(TransportDelay.name, name, SHORT))
    measured = {}
    for joint, row in zip(joints, sensor, strict=True):
        delay = float(row[SENSOR_DELAY])
        if 0 < delay < step:
            unwritten.append(Unwritten(SensorDelay.name, joint, SHORT))
            delay = 0.0
        if delay or row[SCALE] != 1.0:
            measured[joint] = delay, float(row[SCALE])
    return unwritten, measured
