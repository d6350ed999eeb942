"""What people read in the place of SI units: degrees, millimetres, kilopascals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
        """A value in SI units, as people read it; what rounds to zero has no sign."""
        return f"{value * self.factor:z{digits}}{self.space if self.unit else ''}{self.unit}"


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
        inside = ", ".join(f"{value * own.factor:zg}" for value in given)
        return f"({inside})" + (f" {own.unit}" if own.unit and named else "")
    return "(" + ", ".join(reading(unit).text(value, "g") for value, unit in zip(given, kinds, strict=True)) + ")"


def position_word(units: Iterable[str]) -> str:
    """What positions of some SI units are, in messages: ``angle in rad``, ``position in m``, or both."""
    words = {"rad": "angle in rad", "m": "position in m"}
    return " or ".join(words[unit] for unit in dict.fromkeys(units))


def shown_pose(pose: ArrayLike, units: Iterable[str]) -> str:
    """A pose as people read it, with the unit of each joint.

    Args:
        pose: (nj,) [rad or m].
        units: SI, of each joint.
    """
    values = np.asarray(pose, dtype=np.float64).tolist()
    return "(" + ", ".join(reading(unit).text(value) for value, unit in zip(values, units, strict=True)) + ")"


def by_unit(what: str, names: Sequence[str], units: Sequence[str], values: ArrayLike) -> dict[str, dict[str, float]]:
    """JSON tables of values in SI units, one a unit: ``rmse_rad``, ``rmse_m``, ``effort_pa``, ``effort_nm``.

    Args:
        what: the keys begin with.
        names: of joints or actuators.
        units: of each.
        values: (n,) of each.
    """
    found: dict[str, dict[str, float]] = {}
    for name, unit, value in zip(names, units, np.asarray(values, dtype=np.float64).tolist(), strict=True):
        key = f"{what}_{unit.lower().replace('·', '').replace('/', '_per_')}"
        found.setdefault(key, {})[name] = value
    return found


def command_words(units: Iterable[str]) -> tuple[str, str]:
    """What commands of some SI units are, in messages: ``pressures in Pa``, and of one ``one pressure in Pa``."""
    kinds = list(dict.fromkeys(units))
    if kinds == ["Pa"]:
        return "pressures in Pa", "one pressure in Pa"
    said = " or ".join(unit for unit in kinds if unit != "1")
    return (f"commands in {said}", f"one command in {said}") if said else ("commands", "one command")
