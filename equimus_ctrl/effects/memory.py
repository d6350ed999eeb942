"""Effects along actuators whose force depends on what was: relaxation and hysteresis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from equimus_ctrl.effects.base import parameter, register
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect, Parameters
from equimus_ctrl.effects.native import Draft, add_presliding_friction, add_relaxing_spring
from equimus_ctrl.effects.sizes import Size


def presliding(rate: ca.SX, z: ca.SX, way: ca.SX) -> ca.SX:
    """dz/dt = (rate − |rate|·z)/way of what gives way before it slides: z goes to ±1 over this way (Dahl, 1968)."""
    return (rate - ca.fabs(rate) * z) / way


@register
@dataclass(frozen=True)
class Creep(ForceEffect):
    """A standard linear solid's relaxing branch: −stiffness·(x − z), dz/dt = (x − z)/time_constant."""

    name = "creep"
    sits_at = ("actuator",)
    summary = "slow relaxation (standard linear solid)"
    mjcf_form = "a passive `dcmotor` with shorted terminals and `inductance`"
    exclusive = "creep"
    n_states = 1
    neutral = {"stiffness": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("stiffness", 1.0, 60.0, "0.4 to 23 % of MAA's own, up to half of BAA's"),
        Size("time_constant", 0.3, 8.0, "slower than the leg, faster than a trial"),
    )
    leg_alike = True
    stiffness: float = parameter("N/m", 0.0, 1e4, "that relaxes with time")
    time_constant: float = parameter("s", 0.02, 100.0, "of the relaxation")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"stiffness": size, "time_constant": share * excitation.duration}
            for size in excitation.sizes("N/m")
            for share in (0.03, 0.1, 0.4)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["stiffness"] * (x - z[0])

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        return ((x - z[0]) / p["time_constant"],)

    def write_mjcf(self, draft: Draft) -> str:
        return add_relaxing_spring(draft, self.location, self.stiffness, self.time_constant, self.name)

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (x,)

    @classmethod
    def sentence(cls, t: Description) -> str:
        who = t.one_or(f"{t.at} creeps", f"{t.at} creep")
        return f"{who}: beside the modelled spring {t['stiffness']} relax with a time constant of {t['time_constant']}."


@register
@dataclass(frozen=True)
class Hysteresis(ForceEffect):
    """Bouc–Wen with exponent 1: −size·z, dz/dt = (rate − |rate|·z)/width, so that z follows the path within ±1.

    Of friction it is Dahl's law of what gives way before it slides (*A solid friction model*, 1968), its stiffness at
    rest being size/width.
    """

    name = "hysteresis"
    sits_at = ("actuator",)
    summary = "force depends on the path of the length (Bouc–Wen)"
    mjcf_form = "`lugre` of a passive `dcmotor`"
    exclusive = "hysteresis"
    n_states = 1
    begins_anywhere = True
    neutral = {"size": 0.0}  # noqa: RUF012
    leg_sizes = (
        Size("size", 0.02, 1.5, "as dry friction along an actuator"),
        Size("width", 1e-3, 1.5e-2, "a small part of an actuator's stroke of 6 to 10 cm"),
    )
    leg_alike = True
    size: float = parameter("N", 0.0, 1e3, "force after a long way in one direction")
    width: float = parameter("m", 5e-4, 1.0, "way over which it builds up")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [
            {"size": size, "width": share * excitation.span} for size in excitation.sizes("N") for share in (0.03, 0.15)
        ]

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["size"] * z[0]

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        return (presliding(rate, z[0], p["width"]),)

    def write_mjcf(self, draft: Draft) -> str:
        return add_presliding_friction(draft, self.location, self.size, self.width, self.name)

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (ca.SX(0),)

    @classmethod
    def sentence(cls, t: Description) -> str:
        force = t.one_or(f"The force of {t.at} depends", f"The forces of {t.at} depend")
        return f"{force} on the path of the length: a hysteresis of ±{t['size']} that builds up over {t['width']}."
