"""Effects by name and place, and parameters with their intervals, as reports and records give them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect with its interval.

    Attributes:
        value: SI.
        low: lower end of the interval, −inf where there is none.
        high: upper end.
        unit: SI.
    """

    value: float
    low: float
    high: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null where an interval has no end."""
        ends = {key: v if math.isfinite(v) else None for key, v in (("low", self.low), ("high", self.high))}
        return {"value": self.value, **ends, "unit": self.unit}


@dataclass(frozen=True)
class Named:
    """An effect and where it acts.

    Attributes:
        effect: its name.
        locations: the places.
        each: whether it has its own parameters at each of several places, instead of the same.
    """

    effect: str
    locations: tuple[str, ...]
    each: bool = False

    def __str__(self) -> str:
        """For people."""
        return f"{self.effect} at {'each of ' * self.each}{' and '.join(self.locations)}"

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        named: dict[str, Any] = {"effect": self.effect, "locations": list(self.locations)}
        return named | ({"each": True} if self.each else {})
