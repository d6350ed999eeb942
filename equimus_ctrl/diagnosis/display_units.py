"""Units in which a person reads what joints and commands of a robot do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from equimus_ctrl.models.model import Model


@dataclass(frozen=True)
class Reading:
    """A unit that a person reads.

    Attributes:
        unit: its sign, "" for a pure number.
        factor: how many of it one of the SI unit is.
    """

    unit: str
    factor: float

    def __call__(self, number: str) -> str:
        """The number with its unit."""
        return f"{number}{'' if self.unit[:1] in ('', '°') else ' '}{self.unit}"

    @property
    def bracket(self) -> str:
        """For the label of an axis, such as ``[kPa]``."""
        return f"[{self.unit}]" if self.unit else ""


DEGREES, MILLIMETRES = Reading("°", 180 / math.pi), Reading("mm", 1e3)


def noun(model: Model, joint: str) -> str:
    """What the coordinate of a joint is called."""
    return "position" if model.robot.slides(joint) else "angle"


def position(model: Model, joint: str) -> Reading:
    """Of where a joint is."""
    return MILLIMETRES if model.robot.slides(joint) else DEGREES


def speed(model: Model, joint: str) -> Reading:
    """Of how fast it moves."""
    return Reading("mm/s", 1e3) if model.robot.slides(joint) else Reading("°/s", 180 / math.pi)


def error(model: Model, joint: str) -> Reading:
    """Of how far it is from where it was expected."""
    return MILLIMETRES if model.robot.slides(joint) else Reading("mrad", 1e3)


def command(model: Model, actuator: str) -> Reading:
    """Of an actuator's command."""
    unit = model.robot.command_unit(actuator)
    read = {"Pa": Reading("kPa", 1e-3), "rad": DEGREES, "m": MILLIMETRES, "1": Reading("", 1.0)}
    return read.get(unit, Reading(unit, 1.0))
