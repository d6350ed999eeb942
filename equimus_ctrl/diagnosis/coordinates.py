"""The coordinates that an unstructured residual force may depend on, and how a report's data write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

from equimus_ctrl.errors import ConfigError

Kind = Literal["pos", "vel", "cmd", "len", "rate", "path", "past", "time"]
"""A joint's position and speed; an actuator's command, length and rate of length, the path that its length has taken
and what it has been; the time since a trial's start."""


@dataclass(frozen=True)
class Coordinate:
    """A quantity along a motion that a force may depend on, written as in ``sign(vel.hip)`` or ``cmd.maa−cmd.baa``.

    Attributes:
        kind: of the quantity.
        place: joint or actuator that it is of; "" for the time.
        less: another place, whose quantity of the same kind is subtracted; "" for none.
        sign: whether its sign alone counts.
        frequency: of sine and cosine of it [Hz]; None where it is no wave.
    """

    kind: Kind
    place: str = ""
    less: str = ""
    sign: bool = False
    frequency: float | None = None

    def __str__(self) -> str:
        """As a report's data have it."""
        text = f"{self.kind}.{self.place}" if self.place else self.kind
        if self.less:
            text += f"−{self.kind}.{self.less}"
        if self.frequency is not None:
            text += f" at {self.frequency:.4g} Hz"
        return f"sign({text})" if self.sign else text


TIME = Coordinate("time")
_WRITTEN = re.compile(
    rf"(?P<sign>sign\()?(?P<kind>{'|'.join(get_args(Kind))})(\.(?P<place>[^−()·]+))?"
    r"(−\w+\.(?P<less>[^−()·]+))?( at (?P<frequency>\S+) Hz)?\)?"
)


def written(coordinates: Sequence[Coordinate]) -> str:
    """Such as ``pos.hip·sign(vel.hip)``: what a force depends on, as a report's data have it."""
    return "·".join(map(str, coordinates))


def read(text: str) -> tuple[Coordinate, ...]:
    """The coordinates of a text, see ``written``.

    Raises:
        ConfigError: where it is none.
    """
    coordinates = []
    for part in text.split("·") if text else []:
        match = _WRITTEN.fullmatch(part)
        if match is None:
            raise ConfigError(f"{part!r} is no coordinate; expected one such as pos.hip, sign(vel.hip) or time")
        frequency = None if match["frequency"] is None else float(match["frequency"])
        kind, place, less = cast(Kind, match["kind"]), match["place"] or "", match["less"] or ""
        coordinates.append(Coordinate(kind, place, less, match["sign"] is not None, frequency))
    return tuple(coordinates)
