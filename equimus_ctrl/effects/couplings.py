"""Effects of gears that couple a joint with the next one down its chain: friction against both rates together.

A wrist whose two motors sit before it turns its last joint by both: bearings and gears in between then rub against the
sum of the two joints' rates, or against their difference, by which way the joints count (Gautier, Janot & Vandanjon, "A
new closed-loop output error method for parameter identification of robot dynamics", 2013, has it of the Stäubli TX40's
joints 5 and 6). In MuJoCo it is a fixed tendon over both joints with the coefficients 1 and ±1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from equimus_ctrl.effects.base import parameter, register
from equimus_ctrl.effects.bodies import BodyEffect
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.sizes import Share


@dataclass(frozen=True)
class JointCoupling(BodyEffect):
    """What acts between a driven hinge i and the next one down its chain, j, against v_i + side·v_j.

    A subclass says how large it is. Joints that branch off side by side are coupled with none before them.
    """

    robots = ("mjcf",)
    sits_at = ("joint",)
    alike = False
    own_equations = True
    mjcf_form = "a fixed `tendon` over both joints with `frictionloss` or `damping`"
    sign: ClassVar[int]
    """1 for the sum of both rates, −1 for their difference."""

    @classmethod
    def places_on(cls, robot: Any) -> Mapping[str, tuple[str, ...]]:
        return {**robot.places(), "joint": tuple(robot.next_hinges)}

    @classmethod
    def depends(cls) -> set[str]:
        return {"vel"}

    @classmethod
    def _rates(cls, t: Description) -> str:
        (first,) = t.places
        what = "sum" if cls.sign > 0 else "difference"
        return f"the {what} of the rates of {first} and {t.robot.next_hinges[first]}"


@register
@dataclass(frozen=True)
class CoupledFriction(JointCoupling):
    """Dry friction over two joints: τ_i = τ_j = −friction·sign(v_i + v_j); while that is 0, whatever keeps it at 0."""

    name = "coupled_friction"
    summary = "dry friction against the sum of the rates of a joint and the next one: a gear couples them"
    sign = 1
    exclusive = "coupled friction"
    mujoco_flags = ("constraint", "frictionloss")
    mjcf_sizes = (Share("friction", 0.003, 0.1),)
    friction: float = parameter("N·m", 0.0, 100.0, "size of the friction, at either joint")

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_coupling(self.location, self.sign, friction=self.friction)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Dry friction of {t['friction']} against {cls._rates(t)}, at both joints: a gear couples them."


@register
@dataclass(frozen=True)
class CoupledFrictionDifference(CoupledFriction):
    """The same over the difference: τ_i = −τ_j = −friction·sign(v_i − v_j)."""

    name = "coupled_friction_difference"
    summary = "dry friction against the difference of the rates of a joint and the next one: a gear couples them"
    sign = -1
    mjcf_sizes = CoupledFriction.mjcf_sizes


@register
@dataclass(frozen=True)
class CoupledDamping(JointCoupling):
    """Viscous friction over two joints: τ_i = τ_j = −damping·(v_i + v_j)."""

    name = "coupled_damping"
    summary = "viscous friction against the sum of the rates of a joint and the next one: a gear couples them"
    sign = 1
    exclusive = "coupled damping"
    mujoco_flags = ("damper",)
    mjcf_sizes = (Share("damping", 0.01, 0.3),)
    damping: float = parameter("N·m·s/rad", 0.0, 1e4, "torque at either joint for each of that rate")

    def changed(self, robot: Any, modelled: Any) -> Any:
        return robot.with_coupling(self.location, self.sign, damping=self.damping)

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"Viscous friction of {t['damping']} against {cls._rates(t)}, at both joints: a gear couples them."


@register
@dataclass(frozen=True)
class CoupledDampingDifference(CoupledDamping):
    """The same over the difference: τ_i = −τ_j = −damping·(v_i − v_j)."""

    name = "coupled_damping_difference"
    summary = "viscous friction against the difference of the rates of a joint and the next one: a gear couples them"
    sign = -1
    mjcf_sizes = CoupledDamping.mjcf_sizes
