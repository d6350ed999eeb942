"""What people read in the place of SI units: degrees, millimetres, kilopascals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Reading:
    """How a quantity is shown.

    Attributes:
        unit: that people read; empty where it has none.
        factor: how many of them one SI unit is.
        space: what stands between number and unit.
    """

    unit: str
    factor: float = 1.0
    space: str = " "

    def text(self, value: float, digits: str = ".4g") -> str:
        """A value in SI units, as people read it."""
        return f"{value * self.factor:{digits}}{self.space if self.unit else ''}{self.unit}"


_READINGS = {"rad": Reading("°", 180 / math.pi, ""), "m": Reading("mm", 1e3), "Pa": Reading("kPa", 1e-3)}


def reading(unit: str) -> Reading:
    """How quantities of an SI unit are shown; most as they are.

    Args:
        unit: ``1`` for none.
    """
    return _READINGS.get(unit, Reading("" if unit == "1" else unit))


def shown(values: ArrayLike, units: Iterable[str], named: bool = True) -> str:
    """Values in SI units as people read them, in brackets; the unit once where all have the same.

    Args:
        values: (n,) of them.
        units: SI units of each.
        named: whether a unit that all have is said.
    """
    given, kinds = np.atleast_1d(np.asarray(values, dtype=np.float64)).tolist(), list(units)
    if len(set(kinds)) == 1:
        own = reading(kinds[0])
        inside = ", ".join(f"{value * own.factor:g}" for value in given)
        return f"({inside})" + (f" {own.unit}" if own.unit and named else "")
    return "(" + ", ".join(reading(unit).text(value, "g") for value, unit in zip(given, kinds, strict=True)) + ")"
