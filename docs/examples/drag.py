"""An effect of one's own: drag that grows with the square of a joint's speed, as of a fluid it moves through."""

from dataclasses import dataclass

import casadi as ca

from equimus_ctrl.effects import ForceEffect, parameter, register


@register
@dataclass(frozen=True)
class QuadraticDrag(ForceEffect):
    """−coefficient·rate·|rate|."""

    name = "quadratic_drag"
    sits_at = ("joint",)
    summary = "drag that grows with the square of the speed"
    neutral = {"coefficient": 0.0}  # noqa: RUF012
    coefficient: float = parameter("N·m·s²/rad²", 0.0, 10.0, "torque at 1 rad/s")

    @classmethod
    def force(cls, x, rate, z, p):
        """The torque [N·m] at angle x and speed rate; p are the parameters, z the effect's own states."""
        return -p["coefficient"] * rate * ca.fabs(rate)
