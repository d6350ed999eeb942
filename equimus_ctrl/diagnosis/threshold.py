"""What is said of a number that decides: its unit, all that it decides, where, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Basis = Literal["theory", "convention", "calibration"]
"""Where a number comes from: what follows from statistics, what a field agrees on, or what proofs showed to work."""


@dataclass(frozen=True)
class Origin:
    """Where a threshold comes from.

    Attributes:
        basis: what kind of reason there is.
        why: the reason, with its source or the script that reproduces it.
    """

    basis: Basis
    why: str


@dataclass(frozen=True)
class Threshold:
    """One number that decides.

    Attributes:
        name: in ``Thresholds``.
        value: by default.
        unit: of it; "" for a ratio.
        meaning: what it decides, all of it.
        origin: where it comes from.
        where: modules of ``diagnosis`` that ask it.
        read: whether another number is made of it before anything is asked, so that no decision shows what it does.
    """

    name: str
    value: float
    unit: str
    meaning: str
    origin: Origin
    where: tuple[str, ...]
    read: bool


def decided_by(value: float, unit: str, meaning: str, basis: Basis, why: str, where: str, read: bool = False) -> Any:
    """A field of a dataclass with a number that decides, see ``Threshold``."""
    origin = Origin(basis, why)
    return field(
        default=value,
        metadata={"unit": unit, "meaning": meaning, "origin": origin, "where": tuple(where.split()), "read": read},
    )
