"""How effects describe themselves: sentences with estimated parameters, and curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from equimus_ctrl.types import Array

CURVE_MARGIN, CURVE_POINTS = 0.12, 240
"""A curve goes on beyond what recordings cover, by so much of that span on either side; points of a curve."""


class Description(Protocol):
    """What a sentence on an effect can contain: where it acts, and its estimated parameters in readable units."""

    @property
    def places(self) -> tuple[str, ...]:
        """Where it acts with the same parameters."""
        ...

    @property
    def at(self) -> str:
        """``hip and knee``."""
        ...

    @property
    def the(self) -> str:
        """``the hip and the knee``."""
        ...

    @property
    def noun(self) -> str:
        """What the coordinate of the first place is called: angle, position."""
        ...

    @property
    def actuation(self) -> str:
        """What commands become there, to begin a sentence: ``The pressure of maa``, ``The forces of a and b``."""
        ...

    @property
    def numbers(self) -> str:
        """All parameters with what they mean and their estimates."""
        ...

    @property
    def robot(self) -> Any:
        """The robot as it is modelled."""
        ...

    def one_or(self, one: str, several: str) -> str:
        """One of two texts, by the number of places."""
        ...

    def __getitem__(self, key: str) -> str:
        """A parameter's estimate with its interval: ``2.80 kPa (2.78 to 2.82)``."""
        ...

    def scaled(self, key: str, unit: str, factor: float, away: float = 0.0) -> str:
        """The same of (parameter − away)·factor in another unit."""
        ...

    def unit(self, key: str) -> str:
        """A parameter's unit there."""
        ...

    def value(self, key: str) -> float:
        """A parameter's estimate [SI]."""
        ...

    def quantity(self, value: float, unit: str) -> str:
        """An SI number without an interval: ``2.80 kPa``."""
        ...


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve that shows an effect.

    Attributes:
        title: what it is about.
        x: what it runs along.
        x_unit: SI.
        y: what it shows.
        y_unit: SI; ``1`` for a share.
        along: (n,) [x_unit].
        values: (n,) [y_unit].
        without: what there is without the effect [y_unit].
        where_seen: whether x is the coordinate of the effect's place, so that one can show where recordings lie.
    """

    title: str
    x: str
    x_unit: str
    y: str
    y_unit: str
    along: Array
    values: Array
    without: float = 0.0
    where_seen: bool = False
