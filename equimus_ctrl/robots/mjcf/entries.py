"""Entries of what an MJCF file says: joints, actuators, parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.types import Array

SLIDING = {
    "rad": "m", "rad/s": "m/s", "N·m": "N", "N·m/rad": "N/m", "N·m·s/rad": "N·s/m", "N·m·s²/rad²": "N·s²/m²",
    "N·m·s/rad/s": "N·s/m/s", "kg·m²": "kg",
}  # fmt: skip
"""Units of a hinge → those of a slide."""


Write = Callable[[Any, float], None]


@dataclass(frozen=True)
class ModelParameter:
    """One parameter of an MJCF robot.

    Attributes:
        name: dotted.
        value: in the file.
        unit: SI.
        write: sets it in an ``mujoco.MjModel``.
    """

    name: str
    value: float
    unit: str
    write: Write

    @property
    def kind(self) -> str:
        """What follows the dot."""
        return self.name.rpartition(".")[2]


@dataclass(frozen=True)
class Axis:
    """One joint of an MJCF robot.

    Attributes:
        name: its name.
        index: of the joint in MuJoCo's model.
        position: its place in qpos.
        dof: its place in qvel.
        slides: whether it is a slide, else a hinge.
        range: its ends [rad or m]; ±inf where it has none.
    """

    name: str
    index: int
    position: int
    dof: int
    slides: bool
    range: tuple[float, float]


@dataclass(frozen=True)
class Tie:
    """How a joint follows another by an equality: q − q₀ = Σ cₖ (q' − q'₀)ᵏ, k from 0 to 4.

    Attributes:
        leader: q'; None where the joint is held.
        zeros: q₀ and q'₀ of the file's own pose [rad or m].
        coefficients: cₖ.
    """

    leader: str | None
    zeros: tuple[float, float]
    coefficients: tuple[float, ...]

    def follow(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """Where the joint is and how fast, of its leader's position and rate."""
        along = np.polynomial.Polynomial(self.coefficients)
        off = position - self.zeros[1]
        return self.zeros[0] + along(off), along.deriv()(off) * velocity


@dataclass(frozen=True)
class Drive:
    """One command of an actuator of an MJCF robot, mostly its only one.

    Attributes:
        name: its name.
        index: of the actuator in MuJoCo's model.
        joint: name of the joint it drives, or drives most in the file's own pose.
        servo: whether its force depends on where its joint is, so that its command is a goal.
        unit: of its command.
        range: of its commands.
        state: place of what it follows its command with, a first-order filter's value or a muscle's activation, among
            MuJoCo's activations; None where it follows at once.
        control: place of its command among MuJoCo's.
        actuator: the actuator's name: an actuator with several commands has a drive for each.
        at_joint: whether it acts on that joint alone.
        activates: whether that state is a muscle's activation.
    """

    name: str
    index: int
    joint: str
    servo: bool
    unit: str
    range: tuple[float, float]
    state: int | None = None
    control: int = 0
    actuator: str = ""
    at_joint: bool = True
    activates: bool = False


def setter(kind: str, name: str, array: str, *entry: int) -> Write:
    """Sets one entry of an array; by name, for models with rotors have other indices."""

    def write(model: Any, value: float) -> None:
        getattr(model, array)[(_index(model, kind, name, array), *entry)] = value

    return write


def _index(model: Any, kind: str, name: str, array: str) -> int:
    part = getattr(model, kind)(name)
    if array.startswith("dof_"):
        return int(part.dofadr[0])
    return int(part.qposadr[0]) if array.startswith("qpos_") else int(part.id)
