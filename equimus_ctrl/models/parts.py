"""What the equations of all robots are put together from: forces, constraints that give way, actuators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import casadi as ca


@dataclass(frozen=True, eq=False)
class Limit:
    """An end of a coordinate, whose force acts back along a row and never pulls.

    Either a spring and a damper, or MuJoCo's soft constraint: a force f ≥ 0 with row·a + softness·f = target.

    Attributes:
        depth: how far beyond it the coordinate is, below 0 short of it.
        row: (1, n) direction of its force: −∂depth/∂q.
        force: of its spring and damper; None for a soft constraint.
        target: acceleration along the row that a soft constraint asks for.
        softness: of a soft constraint.
        quickness: rate at which a soft constraint's motion dies away, about [1/s].
    """

    depth: ca.SX
    row: ca.SX
    force: ca.SX | None = None
    target: ca.SX = field(default_factory=lambda: ca.SX(0))
    softness: ca.SX = field(default_factory=lambda: ca.SX(1))
    quickness: ca.SX = field(default_factory=lambda: ca.SX(0))


@dataclass(frozen=True, eq=False)
class Held:
    """MuJoCo's soft equality: a force f with row·a + softness·f = target."""

    row: ca.SX
    target: ca.SX
    softness: ca.SX


@dataclass(frozen=True, eq=False)
class Rubbing:
    """A coordinate that may have dry friction: its kind and number, ∂/∂q (1, n), and what the robot itself has."""

    kind: str
    index: int
    row: ca.SX
    bound: ca.SX


@dataclass(frozen=True, eq=False)
class Actuation:
    """How commands become joint forces: (gain·u + passive) along lengths, limited where the robot limits it.

    Attributes:
        jacobian: (na, n) moment arms.
        gain: (na,) force for each unit of command.
        passive: (na,) force without command that is not in the equations' bias.
        along: (commands) → (na,) forces, where these are not gain·u + passive with a command for each actuator.
        force: (na,) lowest and highest force; None for no bounds.
        beside: (na,) further forces along the lengths, whatever the bounds.
        shared: (actuators, lowest, highest) whose forces' sum is limited before each is.
        joints: (joint, lowest, highest) where the sum at a joint is limited.
        added: (n,) further joint forces that are limited there too.
        at_joints: which actuators drive a joint by itself.
        through: (their forces on the joints (n,)) → (n,) what of them the joints feel, where drives may give way.
    """

    jacobian: ca.SX
    gain: ca.SX
    passive: ca.SX
    along: Callable[[ca.SX], ca.SX] | None = None
    force: tuple[ca.SX, ca.SX] | None = None
    beside: ca.SX | None = None
    shared: Sequence[tuple[Sequence[int], ca.SX, ca.SX]] = ()
    joints: Sequence[tuple[int, ca.SX, ca.SX]] = ()
    added: ca.SX | None = None
    at_joints: Sequence[int] = ()
    through: Callable[[ca.SX], ca.SX] | None = None

    def torque(self, command: ca.SX, gain: ca.SX | None = None, force: ca.SX | None = None) -> ca.SX:
        """(n,) what the joints feel, see ``drive``."""
        own, others = self.drive(command, gain, force)
        return (own if self.through is None else self.through(own)) + others

    def drive(self, command: ca.SX, gain: ca.SX | None = None, force: ca.SX | None = None) -> tuple[ca.SX, ca.SX]:
        """(n,) joint forces of actuators that drive a joint by itself, and (n,) those of the others.

        Args:
            command: of the actuators.
            gain: (na,) in place of its own.
            force: (na,) further forces along the lengths.
        """
        if self.along is not None:
            along = ca.vertsplit(self.along(command))
        else:
            along = ca.vertsplit((self.gain if gain is None else gain) * command + self.passive)
        for members, low, high in self.shared:
            whole = sum((along[i] for i in members), ca.SX(0))
            kept = ca.fmin(ca.fmax(whole, low), high)
            scale = ca.if_else(whole == kept, 1, kept / whole)
            for i in members:
                along[i] = along[i] * scale
        along_lengths = ca.vertcat(*along, ca.SX(0, 1))
        if self.force is not None:
            along_lengths = ca.fmin(ca.fmax(along_lengths, self.force[0]), self.force[1])
        for more in (self.beside, force):
            along_lengths = along_lengths if more is None else along_lengths + more
        at_joint = ca.SX(along_lengths.numel(), 1)
        if self.through is not None:
            for i in self.at_joints:
                at_joint[i], along_lengths[i] = along_lengths[i], 0
        torque = self.jacobian.T @ along_lengths
        if self.added is not None:
            torque = torque + self.added
        own = self.jacobian.T @ at_joint
        for j, low, high in self.joints:
            # A drive that gives way is limited before it does.
            part = own if self.through is not None else torque
            part[j] = ca.fmin(ca.fmax(part[j], low), high)
        return own, torque


@dataclass(frozen=True, eq=False)
class Inside:
    """States of a robot's own beside its motion, such as a motor's current.

    Attributes:
        state: (ny,) symbols.
        rate: (commands) → (ny,) their rates.
        rest: (ny,) what they begin with.
        kept: (ny,) the states within their bounds, where they have any.
        quickness: about the fastest rate of what they do with the motion [1/s].
    """

    state: ca.SX
    rate: Callable[[ca.SX], ca.SX]
    rest: ca.SX
    kept: ca.SX
    quickness: ca.SX = field(default_factory=lambda: ca.SX(0))


def grips(limits: Sequence[Limit], pressed: ca.SX) -> tuple[ca.SX, ca.SX]:
    """What limits that are pressed do: (nl,) what they add along their rows to the mass matrix, and to the load.

    A soft constraint's force (target − row·a)/softness is linear in the acceleration, so that it adds
    rowᵀrow/softness to the mass matrix and rowᵀtarget/softness to the load.

    Args:
        limits: (nl) of them.
        pressed: (nl,) 1 where one is pressed, else 0.
    """
    stiff, pull = [], []
    for k, limit in enumerate(limits):
        stiff.append(pressed[k] / limit.softness if limit.force is None else ca.SX(0))
        pull.append(stiff[-1] * limit.target if limit.force is None else pressed[k] * limit.force)
    return ca.vertcat(*stiff, ca.SX(0, 1)), ca.vertcat(*pull, ca.SX(0, 1))


def constrained(
    mass: ca.SX, load: ca.SX, held: Sequence[Held], limits: Sequence[Limit], grip: ca.SX, pull: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Mass matrix and load with equalities, and with the limits that are pressed.

    Args:
        mass: (n, n).
        load: (n,).
        held: always.
        limits: (nl) of them.
        grip: (nl,) what each adds to the mass matrix, see ``grips``.
        pull: (nl,) what each adds to the load.
    """
    for h in held:
        mass = mass + h.row.T @ h.row / h.softness
        load = load + h.row.T * (h.target / h.softness)
    for k, limit in enumerate(limits):
        if limit.force is None:
            mass = mass + limit.row.T @ limit.row * grip[k]
        load = load + limit.row.T * pull[k]
    return mass, load


def gaps(limits: Sequence[Limit], acceleration: ca.SX) -> ca.SX:
    """(nl,) above 0 where a limit would be pressed: the depth, or the force where that is less, for none ever pulls."""
    found = [ca.fmin(k.depth, k.force if k.force is not None else k.target - k.row @ acceleration) for k in limits]
    return ca.vertcat(*found, ca.SX(0, 1))
