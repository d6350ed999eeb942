"""From where to where a proof draws an effect's parameters: from hardly visible to plain to the eye.

An effect's class holds its own (``Effect.leg_sizes``, ``Effect.mjcf_sizes``). A diagnosis never looks at them.

On the nominal leg they are numbers. A knee of this leg gives way by 1 rad for about 0.8 N·m and its hip for about
3 N·m, so 2 mrad of noise are 1.6 and 6 mN·m, or some 0.05 N along an actuator. What lasts for a whole rest shows far
below that. With median noise the weak ends leave an excess residual variance of mostly 0.01 to 0.1, the strong ones 10
to 200. Commands reach 42 kPa (MAA) and 30 kPa (BAA), but BAA is mostly below 22 kPa.

On an MJCF robot they are shares of what its recordings show of each place: forces of the largest that the drive or
gravity exerts there, rates and ways of what is covered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from equimus_ctrl.effects.excitation import Excitation

Law = Literal["log", "linear", "either sign", "about one"]
Whole = Literal["unit", "drive", "range", "recording", "none"]


@dataclass(frozen=True)
class Size:
    """From where to where a parameter is drawn.

    Attributes:
        parameter: its name.
        low: smallest size, above 0 for the laws that are logarithmic [SI].
        high: largest.
        reason: why these.
        law: how it is spread between them: evenly, evenly in its logarithm, that with either sign, or that as the
            distance from 1 to either side.
        at: kind of place or location that it is for; every one by default.
    """

    parameter: str
    low: float
    high: float
    reason: str
    law: Law = "log"
    at: str = ""

    def draw(self, rng: np.random.Generator) -> float:
        """A value [SI], to four digits, so that what is written is what was simulated."""
        if self.law == "linear":
            return _rounded(rng.uniform(self.low, self.high))
        size = math.exp(rng.uniform(math.log(self.low), math.log(self.high)))
        if self.law == "log":
            return _rounded(size)
        signed = size if rng.random() < 0.5 else -size
        return _rounded(signed) if self.law == "either sign" else 1.0 + _rounded(signed)

    def holds(self, value: float) -> bool:
        """Whether it could have given the value, to its rounding."""
        size = abs(value - 1.0) if self.law == "about one" else abs(value) if self.law == "either sign" else value
        return self.low * (1 - 1e-3) <= size <= self.high * (1 + 1e-3)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


@dataclass(frozen=True)
class Share:
    """A size in shares of what recordings show of a place.

    Attributes:
        parameter: its name.
        low: smallest share.
        high: largest.
        law: as of ``Size``.
        of: what it is a share of: what goes with the parameter's unit (``Excitation.scale``), the drive's largest
            force, the range that the coordinate covers (from its lower end on), how long a recording lasts, or
            nothing: a number [SI].
    """

    parameter: str
    low: float
    high: float
    law: Law = "log"
    of: Whole = "unit"

    def size(self, unit: str, excitation: Excitation, at: str) -> Size:
        """The size at a place.

        Args:
            unit: of the parameter.
            excitation: what recordings show of the place.
            at: its name.
        """
        if self.of == "range":
            low, high = excitation.low + self.low * excitation.span, excitation.high - (1 - self.high) * excitation.span
            return Size(self.parameter, low, high, "within the range that is covered", self.law, at)
        known = {
            "unit": excitation.scale(unit),
            "drive": excitation.drive,
            "recording": excitation.lasts,
            "none": 1.0,
        }
        whole = known[self.of]
        return Size(self.parameter, self.low * whole, self.high * whole, "of what is seen there", self.law, at)


LAWS, WHOLES = get_args(Law), get_args(Whole)
