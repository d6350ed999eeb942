"""What differs between units of a robot, and between a robot and its nominal model: what a report and a record give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from equimus_ctrl.diagnosis.estimates import Estimate, Named


@dataclass(frozen=True)
class Difference:
    """A parameter that differs between groups of trials, such as units of a robot.

    Attributes:
        parameter: of the model, dotted, or of the effect.
        named: the effect whose parameter it is; None for the model's.
        values: for each group; None where the effect does not act.
        gain: by how much −2 ln L of the trials fitted falls with values of their own, everything else refitted.
        threshold: acceptance threshold of the gain.
        log10_p_value: log₁₀ of the p-value of such a gain where there is no difference.
        validation_gain: the same fall on validation trials; nan where there are none.
    """

    parameter: str
    named: Named | None
    values: Mapping[str, Estimate | None]
    gain: float
    threshold: float
    log10_p_value: float
    validation_gain: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "parameter": self.parameter,
            **(self.named.to_dict() if self.named else {}),
            "values": {group: own.to_dict() if own else None for group, own in self.values.items()},
            "gain": self.gain,
            "threshold": self.threshold,
            "log10_p_value": self.log10_p_value,
            "validation_gain": self.validation_gain if math.isfinite(self.validation_gain) else None,
        }


@dataclass(frozen=True)
class Departure:
    """A parameter of the model that is not the nominal one.

    Attributes:
        parameter: dotted name.
        group: of trials; "" for all.
        nominal: value given.
        estimate: value found.
    """

    parameter: str
    group: str
    nominal: float
    estimate: Estimate

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        own = {"parameter": self.parameter, "nominal": self.nominal, **self.estimate.to_dict()}
        return {**own, "group": self.group} if self.group else own


@dataclass(frozen=True)
class AnotherUnit:
    """A robot whose parameters are not those of its nominal model.

    Attributes:
        gain: by how much −2 ln L of the trials fitted falls from the nominal values to the refitted ones.
        threshold: acceptance threshold of the gain.
        validation_gain: the same fall on validation trials; nan where there are none.
        departures: the parameters that differ each by itself; none where only several together do.
    """

    gain: float
    threshold: float
    validation_gain: float
    departures: tuple[Departure, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "gain": self.gain,
            "threshold": self.threshold,
            "validation_gain": self.validation_gain if math.isfinite(self.validation_gain) else None,
            "departures": [departure.to_dict() for departure in self.departures],
        }
