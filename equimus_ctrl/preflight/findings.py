"""One thing that is to be known of recordings; and what makes an answer from them mean nothing, by signals alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.display_units import Reading
from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.preflight.scatter import Clock, JointScatter

Severity = Literal["note", "warning", "stop"]
"""Good to know; makes answers worse; an answer would mean nothing."""
Scatter = Sequence[Sequence[JointScatter]]
"""Of each recording its joints."""
SEVERITIES: tuple[Severity, ...] = ("stop", "warning", "note")
"""The worst first."""


@dataclass(frozen=True)
class Finding:
    """One thing that is to be known of recordings.

    Attributes:
        severity: see ``Severity``.
        about: what of them, such as ``clock`` or ``quantisation``.
        sentence: what, where, how much, and what would be right.
        recording: the one that it is of; "" where it is of all.
        channel: the column that it is of; "" where it is of none.
        value: what was found [SI]; None where no number says it.
        unit: of the value.
    """

    severity: Severity
    about: str
    sentence: str
    recording: str = ""
    channel: str = ""
    value: float | None = None
    unit: str = ""

    def as_json(self) -> dict[str, Any]:
        """As JSON data."""
        value = None if self.value is None or not math.isfinite(self.value) else self.value
        return {
            "severity": self.severity,
            "about": self.about,
            "sentence": self.sentence,
            "recording": self.recording or None,
            "channel": self.channel or None,
            "value": value,
            "unit": self.unit,
        }


def stops(model: Model, scatter: Scatter, limits: CheckLimits = LIMITS) -> list[Finding]:
    """What makes an answer mean nothing, by signals alone: all motion below the sensors' steps, or within the noise."""
    return [f for f in [*coarse(model, scatter, limits), *buried(model, scatter, limits)] if f.severity == "stop"]


def too_few(scatter: Scatter, parameters: int) -> list[Finding]:
    """Fewer new values than parameters to estimate: any model could be fitted to them."""
    fresh = sum(joint.fresh for own in scatter for joint in own)
    if fresh > parameters:
        return []
    return [
        Finding(
            "stop",
            "samples",
            f"positions change {fresh} times in all recordings together, too few for {parameters} parameters to "
            "estimate: any model would fit; record more motion, or free fewer (--free, --fix)",
            value=float(fresh),
        )
    ]


def _by_joint(scatter: Scatter) -> Iterator[tuple[str, list[JointScatter]]]:
    for j, joint in enumerate(scatter[0]):
        yield joint.name, [own[j] for own in scatter]


def _spread(own: Sequence[JointScatter]) -> float:
    """Standard deviation of a joint's positions in the recording where it moves most [rad or m]."""
    return max(joint.deviation for joint in own)


def text_of(reading: Reading, value: float, digits: int = 2) -> str:
    """A value as a person reads it, in so many figures, without an exponent where it is large."""
    shown = reading.factor * value
    return reading(f"{shown:.0f}" if abs(shown) >= 10**digits else f"{shown:.{digits}g}")


def coarse(model: Model, scatter: Scatter, limits: CheckLimits) -> list[Finding]:
    """Joints whose motion is less than their sensor's steps, see ``CheckLimits.coarse``."""
    found = list[Finding]()
    for name, own in _by_joint(scatter):
        unit, step, spread = display_units.error(model, name), max(joint.step for joint in own), _spread(own)
        if step == 0 or spread >= limits.coarse * step:
            continue
        found.append(
            Finding(
                "warning",
                "quantisation",
                f"pos.{name} comes in steps of {text_of(unit, step, 3)}, more than its motion (standard deviation "
                f"{text_of(unit, spread)}): whatever the model, these steps are what is seen; move it by several "
                f"steps, or use a finer sensor",
                channel=f"pos.{name}",
                value=step,
                unit="m" if model.robot.slides(name) else "rad",
            )
        )
    return _stop_if_all(found, len(scatter[0]))


def _stop_if_all(found: list[Finding], joints: int) -> list[Finding]:
    """One joint of which nothing can be told makes an answer poorer, all of them make it mean nothing."""
    return [replace(finding, severity="stop") for finding in found] if len(found) == joints else found


def buried(model: Model, scatter: Scatter, limits: CheckLimits) -> list[Finding]:
    """Joints whose motion is less than their noise, see ``CheckLimits.buried``."""
    found = list[Finding]()
    for name, own in _by_joint(scatter):
        # Noise is part of how far positions scatter.
        ratio, joint = max(
            ((math.sqrt(max(j.deviation**2 / j.noise**2 - 1, 0.0)), j) for j in own),
            key=lambda pair: (pair[0], pair[1].deviation),
        )
        if ratio > limits.buried:
            continue
        unit = display_units.error(model, name)
        if all(j.fresh == 0 for j in own):
            moves = "stays exactly where it is in every recording"
        else:
            moves = (
                f"scatters by {text_of(unit, joint.deviation)} (standard deviation) where it moves most, which is "
                f"its noise of {text_of(unit, joint.noise)} and little else"
            )
        found.append(
            Finding(
                "warning",
                "noise",
                f"pos.{name} {moves}: nothing can be told of what moves it; record motion well above the noise",
                channel=f"pos.{name}",
                value=ratio,
            )
        )
    return _stop_if_all(found, len(scatter[0]))


def backward(name: str, clock: Clock) -> list[Finding]:
    """Stamps that do not ascend: no time between rows means anything."""
    if not clock.backward:
        return []
    rows = "1 stamp repeats" if clock.backward == 1 else f"{clock.backward} stamps repeat"
    return [
        Finding(
            "stop",
            "clock",
            f"{name}: {rows} the one before or lie before it; times must ascend: drop rows that were written twice, or "
            "sort them",
            name,
            "time",
            float(clock.backward),
        )
    ]
