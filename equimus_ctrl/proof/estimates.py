"""Errors of estimates: sizes of effects, coverage of intervals, and the share of the variance that is explained."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.proof.answers import OURS, STRONG, Case, Method
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.sizes import leg_table, measured_by, size_of
from equimus_ctrl.robots.elastic.leg import nominal_leg


@dataclass(frozen=True)
class ParameterEstimate:
    """An estimated parameter and its true value.

    Attributes:
        case: where.
        of: effect, or "" of the robot's own.
        name: of the parameter.
        main: whether it is the effect's first.
        true: SI.
        value: estimated.
        low: end of the 95 % interval, −inf where it has none.
        high: upper end.
        scale: what the error is relative to [SI].
        zero: where the effect does nothing; None where the parameter is only a position.
    """

    case: int
    of: str
    name: str
    main: bool
    true: float
    value: float
    low: float
    high: float
    scale: float
    zero: float | None = 0.0

    @property
    def error(self) -> float:
        """Relative to ``scale``."""
        return abs(self.value - self.true) / self.scale

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high

    @property
    def bounded(self) -> bool:
        """Whether the interval has both ends."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null for ends that are not there."""
        ends = {key: v if math.isfinite(v) else None for key, v in (("low", self.low), ("high", self.high))}
        return {**asdict(self), **ends, "error": self.error, "covered": self.covered}


def measure_of(effect: str, parameter: str, location: str, true: float) -> tuple[float, float | None]:
    """(what an error is relative to, where the effect does nothing).

    An error is relative to the distance from where the effect does nothing. Angles and lengths that say where something
    sits (a spring's rest, a centre, a stop's angle) have no zero of their own; theirs are relative to the range that
    they are drawn from.
    """
    kind = next(kind for kind, names in nominal_leg().places().items() if location in names)
    return measured_by(size_of(leg_table(), effect, parameter, kind, location), REGISTRY[effect], true)


def effect_estimates(cases: Sequence[Case], method: Method = OURS) -> list[ParameterEstimate]:
    """All parameters of effects that were named right in their places and are strong alone.

    Where a law has a size of its own at each of several places, each is compared with what was said of that place.
    """
    found: list[ParameterEstimate] = []
    for case in cases:
        named, wanted = case.named(method), case.wanted
        for truth in case.truth["findings"]:
            ((effect, where),) = case.places.parts([truth]).items()
            if truth["alone"] < STRONG or named.get(effect) != wanted[effect] or case.answer(method).failed:
                continue
            for finding in case.answer(method).findings:
                if finding["effect"] == effect and where & case.places.parts([finding])[effect]:
                    found += _estimates(case.number, truth, finding["parameters"])
    return found


def _estimates(case: int, truth: Mapping[str, Any], found: Mapping[str, Any]) -> Iterable[ParameterEstimate]:
    for k, name in enumerate(REGISTRY[truth["effect"]].parameter_info()):
        if name in found:
            true, own = float(truth["parameters"][name]), found[name]
            if "scales" in truth:
                scale, zero = truth["scales"][name]
            else:
                scale, zero = measure_of(truth["effect"], name, truth["locations"][0], true)
            yield ParameterEstimate(
                case, truth["effect"], name, k == 0, true, float(own["value"]), *_ends(own), scale, zero
            )


def robot_estimates(cases: Sequence[Case]) -> list[ParameterEstimate]:
    """The robot's own parameters where exactly the missing physics was found: elsewhere they compensate it."""
    found = []
    for case in cases:
        if case.kind == "outside" or not case.exact(OURS):
            continue
        for name, true in case.truth["parameters"].items():
            own = case.report["parameters"].get(name)
            if own is not None:
                found.append(
                    ParameterEstimate(case.number, "", name, False, true, float(own["value"]), *_ends(own), abs(true))
                )
    return found


def _ends(estimate: Mapping[str, Any]) -> tuple[float, float]:
    low, high = estimate.get("low"), estimate.get("high")
    return -math.inf if low is None else float(low), math.inf if high is None else float(high)


def coverage(estimates: Sequence[ParameterEstimate]) -> Share:
    """Intervals that hold the truth."""
    return Share.among(n.covered for n in estimates)


@dataclass(frozen=True)
class HeldOut:
    """Share of the excess residual variance on test trials that the augmented model explains.

    Attributes:
        case: where.
        share: of the refitted model's excess residual variance.
    """

    case: int
    share: float


def held_out(cases: Sequence[Case]) -> list[HeldOut]:
    """Of the strong cases where exactly what is missing was found."""
    found = []
    for case in cases:
        if case.kind in ("single", "pair", "triple") and case.strength >= STRONG and case.exact(OURS):
            before, after = (heldout_excess_variance(case, state) for state in ("refitted", "corrected"))
            if before > 0:
                found.append(HeldOut(case.number, 1.0 - after / before))
    return found


def heldout_excess_variance(case: Case, state: str) -> float:
    """Mean over the joints of rmse²/noise² − 1 on held-out trials; nan where there are none."""
    noise, parts = case.truth["noise_rad"], case.report["rmse_rad"]
    rmse = parts["test" if case.report["trials"]["test"] else "validation"][state]
    if any(rmse.get(joint) is None for joint in noise):
        return math.nan
    return float(sum((rmse[joint] / size) ** 2 - 1.0 for joint, size in noise.items())) / len(noise)
