"""What is known of recordings before anything is fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.findings import SEVERITIES, Finding
from equimus_ctrl.preflight.information import EffectInformation, Information, ParameterInformation
from equimus_ctrl.preflight.latency import Latency
from equimus_ctrl.preflight.runs import Repeats
from equimus_ctrl.preflight.signals import CommandSignal, JointSignal, Signals

SCHEMA = "equimus-ctrl/check/1"


@dataclass(frozen=True, eq=False)
class CheckResult:
    """What recordings are like, and what they could show of a model.

    Attributes:
        model: the nominal one.
        findings: sentences, the worst first.
        signals: of each recording.
        latencies: of each actuator.
        repeats: recordings with the same commands.
        information: which parameters and effects they show; None where that was not asked for, or cannot be said.
        seconds: how long it took.
    """

    model: Model
    findings: tuple[Finding, ...]
    signals: tuple[Signals, ...]
    latencies: tuple[Latency, ...]
    repeats: tuple[Repeats, ...]
    information: Information | None
    seconds: float

    @property
    def stops(self) -> bool:
        """Whether a diagnosis of them would mean nothing."""
        return any(finding.severity == "stop" for finding in self.findings)

    def of(self, severity: str) -> tuple[Finding, ...]:
        """The findings of a severity."""
        return tuple(finding for finding in self.findings if finding.severity == severity)

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(self.of(s))} {s}{'s' * (len(self.of(s)) != 1)}" for s in SEVERITIES)
        return f"<Check of {len(self.signals)} recordings with {self.model.name}: {counts}>"

    def as_json(self) -> dict[str, Any]:
        """As JSON data: SI, null for what is not finite."""
        known = self.information
        return {
            "schema": SCHEMA,
            "model": self.model.name,
            "stops": self.stops,
            "findings": [finding.as_json() for finding in self.findings],
            "recordings": [_recording(own) for own in self.signals],
            "latency_s": {
                own.actuator: {"low": own.low, "high": own.high, "steps": own.steps} if own.shows else None
                for own in self.latencies
            },
            "repeats": [
                {
                    "recordings": list(own.names),
                    "joints": {
                        joint: {"spread": own.spread[j], "constant": own.offset[j], "noise": own.noise[j]}
                        for j, joint in enumerate(self.model.robot.joint_names)
                    },
                }
                for own in self.repeats
            ],
            "engine": None if known is None else known.engine.to_dict(),
            "parameters": [] if known is None else [_parameter(own) for own in known.parameters],
            "trade_offs": []
            if known is None
            else [{"weights": own.weights, "correlation": own.correlation} for own in known.trade_offs],
            "effects": [] if known is None else [_effect(own) for own in known.effects],
            "not_done": [] if known is None else list(known.not_done),
            "intervals": None
            if known is None
            else {"looked_at": known.intervals[0], "fitted": known.intervals[1], "share": known.share},
            "seconds": self.seconds,
        }


def _recording(own: Signals) -> dict[str, Any]:
    clock = own.clock
    return {
        "name": own.name,
        "rows": clock.rows,
        "duration_s": clock.duration,
        "rate_hz": clock.rate,
        "jitter_s": clock.jitter,
        "gaps": [{"after_s": start, "length_s": length} for start, length in clock.gaps],
        "bursts_share": clock.bursts,
        "rests": [{"after_s": start, "length_s": length} for start, length in own.rests],
        "joints": {joint.name: _joint(joint) for joint in own.joints},
        "commands": {command.name: _command(command) for command in own.commands},
    }


def _joint(own: JointSignal) -> dict[str, Any]:
    return {
        "low": own.low,
        "high": own.high,
        "deviation": own.deviation,
        "speed": own.speed,
        "peak_speed": own.peak_speed,
        "peak_acceleration": own.peak_acceleration,
        "bandwidth_hz": own.bandwidth,
        "step": own.step,
        "noise": own.noise,
        "repeated_share": own.held,
        "clipped": [
            {"after_s": flat.start, "length_s": flat.length, "value": flat.value, "speed": flat.speed}
            for flat in own.flats
        ],
    }


def _command(own: CommandSignal) -> dict[str, Any]:
    return {
        "low": own.low,
        "high": own.high,
        "at_low_share": own.at_low,
        "at_high_share": own.at_high,
        "beyond_share": own.beyond,
        "changes": own.changes,
    }


def _parameter(own: ParameterInformation) -> dict[str, Any]:
    return {
        "name": own.name,
        "unit": own.unit,
        "value": own.value,
        "standard_deviation": _finite(own.deviation),
        "standard_deviation_alone": _finite(own.alone),
    }


def _effect(own: EffectInformation) -> dict[str, Any]:
    return {
        **own.smallest.to_dict(),
        "compares_with": own.scale,
        "detectable": own.possible,
        "confounded": own.confounded,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
