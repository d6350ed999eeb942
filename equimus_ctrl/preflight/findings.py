"""One thing that is to be known of recordings; and what makes an answer from them mean nothing, by signals alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from scipy.special import chdtrc

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.display_units import Reading
from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.preflight.scatter import JointScatter

Severity = Literal["note", "warning", "stop"]
"""Good to know; makes answers worse; an answer would mean nothing."""
Scatter = Sequence[Sequence[JointScatter]]
"""Of each recording its joints."""
SEVERITIES: tuple[Severity, ...] = ("stop", "warning", "note")
"""The worst first."""
HALF = 0.5
"""Of a step: travels are whole numbers of them but for rounding."""


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


def text_of(reading: Reading, value: float, digits: int = 2) -> str:
    """A value as a person reads it, in so many figures, without an exponent where it is large."""
    shown = reading.factor * value
    return reading(f"{shown:.0f}" if abs(shown) >= 10**digits else f"{shown:.{digits}g}")


def coarse(model: Model, scatter: Scatter, limits: CheckLimits) -> list[Finding]:
    """Joints whose motion is less than some steps of their sensor, see ``CheckLimits.coarse``."""
    found = list[Finding]()
    for name, own in _by_joint(scatter):
        step, travel = max(joint.step for joint in own), max(joint.travel for joint in own)
        if step == 0 or travel > (limits.coarse - HALF) * step:
            continue
        unit = display_units.error(model, name)
        found.append(
            Finding(
                "warning",
                "quantisation",
                f"pos.{name} comes in steps of {text_of(unit, step, 3)} and never moves by more than "
                f"{text_of(unit, travel, 3)}: whatever the model, these steps are what is seen; move it by several "
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
    """Joints that never move, or whose positions are white noise as large as it is at rest and no more.

    Of n samples of white noise Σ (x − mean)²/σ² is χ² of n − 1 degrees of freedom; what motion adds counts however
    short it is, for that is the most by which any model of it could be better than none. Motion that second
    differences take for noise, so that its σ is too large, shows in the spectrum; and where there was no rest to see
    the noise in, nothing is called noise.
    """
    found = list[Finding]()
    for name, own in _by_joint(scatter):
        if not all(j.fresh == 0 or _is_noise(j, limits.significance / len(own)) for j in own):
            continue
        joint = max(own, key=lambda j: j.deviation)
        unit = display_units.error(model, name)
        if all(j.fresh == 0 for j in own):
            moves = "stays exactly where it is in every recording"
        else:
            moves = (
                f"scatters by {text_of(unit, joint.deviation)} (standard deviation) where it moves most, which is "
                f"its noise of {text_of(unit, joint.noise)} and nothing else"
            )
        found.append(
            Finding(
                "warning",
                "noise",
                f"pos.{name} {moves}: nothing can be told of what moves it; record motion well above the noise",
                channel=f"pos.{name}",
                value=joint.deviation,
                unit="m" if model.robot.slides(name) else "rad",
            )
        )
    return _stop_if_all(found, len(scatter[0]))


def _is_noise(joint: JointScatter, level: float) -> bool:
    """Whether noise alone scatters as much, and with as uneven a spectrum, by chance, at a level."""
    size = joint.rows * (joint.deviation / joint.noise) ** 2
    return joint.at_rest and min(float(chdtrc(joint.rows - 1, size)), joint.white) > level
