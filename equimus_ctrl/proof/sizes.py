"""How large the missing physics of a simulated leg is: one table, from hardly visible to plain to the eye.

A knee of this leg gives way by 1 rad for about 0.8 N·m and its hip for about 3 N·m, so 2 mrad of noise are 1.6 and
6 mN·m, or some 0.05 N along an actuator. What lasts for a whole rest shows far below that. With middling noise the weak
ends leave an excess of mostly 0.01 to 0.1, the strong ones 10 to 200. Commands reach 42 kPa (MAA) and 30 kPa (BAA), but
BAA is mostly below 22 kPa.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.errors import ConfigError

Law = Literal["log", "linear", "either sign", "about one"]


@dataclass(frozen=True)
class Size:
    """From where to where a parameter is drawn.

    Attributes:
        effect: its name.
        parameter: its name.
        low: smallest size, above 0 for the laws that are logarithmic [SI].
        high: largest.
        reason: why these.
        law: how it is spread between them: evenly, evenly in its logarithm, that with either sign, or that as the
            distance from 1 to either side.
        at: kind of place or location that the row is for; every one by default.
    """

    effect: str
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
        """Whether the table could have given the value, to its rounding."""
        size = abs(value - 1.0) if self.law == "about one" else abs(value) if self.law == "either sign" else value
        return self.low * (1 - 1e-3) <= size <= self.high * (1 + 1e-3)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


CATALOGUE = (
    Size("transport_delay", "delay", 4e-3, 0.2, "half a sample to many; valves with long hoses"),
    Size("first_order_lag", "time_constant", 5e-3, 0.4, "less than a sample to a valve that feeds a large volume"),
    Size("asymmetric_lag", "fill", 6e-3, 0.4, "as the symmetric lag"),
    Size("asymmetric_lag", "vent", 6e-3, 0.4, "as the symmetric lag"),
    Size("rate_limit", "rate", 1.5e4, 5e5, "a step of 15 kPa takes from 0.03 s to 1 s"),
    Size("filling_flow", "rate", 1e4, 2e5, "to fill to 10 kPa takes from 0.05 s to 1 s"),
    Size("filling_flow", "power", 0.3, 2.0, "filling to much takes longer than to little, or less long", "linear"),
    Size("dead_zone", "threshold", 100.0, 5e3, "0.2 to 10 % of the range"),
    Size("cutoff", "least", 300.0, 6e3, "0.7 to 15 % of the range"),
    Size("saturation", "level", 1.4e4, 3.2e4, "below what the trials ask for", "linear", "maa"),
    Size("saturation", "level", 1e4, 2e4, "below what the trials ask for", "linear", "baa"),
    Size("supply_coupling", "share", 3e-3, 0.12, "a stiff supply to a common narrow hose"),
    Size("coulomb_friction", "friction", 1.2e-3, 0.1, "from far below the noise to 2° of hip", at="hip"),
    Size("coulomb_friction", "friction", 5e-4, 0.03, "from far below the noise to 2° of knee", at="knee"),
    Size("coulomb_friction", "friction", 0.012, 1.0, "the joints' sizes over moment arms of 6 to 10 cm", at="actuator"),
    Size("stribeck_friction", "friction", 8e-4, 0.07, "a little less than dry friction alone", at="hip"),
    Size("stribeck_friction", "friction", 3e-4, 0.025, "a little less than dry friction alone", at="knee"),
    Size("stribeck_friction", "breakaway", 1e-3, 0.08, "about as much again", at="hip"),
    Size("stribeck_friction", "breakaway", 4e-4, 0.025, "about as much again", at="knee"),
    Size("stribeck_friction", "velocity", 0.03, 0.3, "within the joints' speeds, which reach 1 to 3 rad/s"),
    Size("hysteresis", "size", 0.02, 1.5, "as dry friction along an actuator"),
    Size("hysteresis", "width", 1e-3, 1.5e-2, "a small part of an actuator's stroke of 6 to 10 cm"),
    Size("creep", "stiffness", 1.0, 60.0, "0.4 to 23 % of MAA's own, up to half of BAA's"),
    Size("creep", "time_constant", 0.3, 8.0, "slower than the leg, faster than a trial"),
    Size("nonlinear_stiffness", "cubic", 1e3, 1e5, "0.03 N to 2.7 N at 3 cm from the centre", "either sign"),
    Size("nonlinear_stiffness", "centre", 0.20, 0.27, "within the stroke", "linear", "maa"),
    Size("nonlinear_stiffness", "centre", 0.24, 0.33, "within the stroke", "linear", "baa"),
    Size("narrowing_area", "loss", 0.05, 1.2, "to a little more than a bag that keeps its volume"),
    Size("parallel_spring", "stiffness", 0.1, 3.0, "up to the hip's own; the actuators' take up most of it", at="hip"),
    Size("parallel_spring", "stiffness", 6e-3, 0.25, "0.8 to 30 % of the knee's own", at="knee"),
    Size("parallel_spring", "rest", 1.0, 2.0, "about the hip's middle", "linear", "hip"),
    Size("parallel_spring", "rest", 0.0, 1.0, "about the knee's middle", "linear", "knee"),
    Size("joint_stop", "angle", 1.6, 1.75, "where the hip often comes, far inside its modelled stop", "linear", "hip"),
    Size("joint_stop", "angle", -0.02, 0.35, "above the modelled stop at -0.035 rad", "linear", "knee"),
    Size("joint_stop", "stiffness", 2.0, 100.0, "a rubber to half the modelled stop"),
    Size("joint_stop", "damping", 0.02, 0.5, "at most half the modelled stop's"),
    Size("payload_mass", "mass", 0.01, 0.3, "up to three times the calf's own; other numbers take up most of it"),
    Size(
        "gravity_tilt", "angle", 0.015, 0.3, "1° to 17°; stiffness and rest lengths take up most of it", "either sign"
    ),
    Size(
        "sensor_offset",
        "offset",
        0.01,
        0.25,
        "a marker that sits 0.6° to 14° off; rest lengths take up most of it",
        "either sign",
    ),
    Size("sensor_scale", "scale", 0.008, 0.15, "a wrong gear or encoder resolution", "about one"),
    Size("sensor_delay", "delay", 0.004, 0.1, "half a sample to a slow camera pipeline"),
    Size("backlash", "play", 2e-3, 0.06, "the noise to thirty times as much"),
)
"""Of every effect in the catalogue."""

BEYOND = (
    Size("square_drag", "drag", 0.02, 0.5, "as the hip's damping at 1 rad/s at most", at="hip"),
    Size("square_drag", "drag", 0.006, 0.15, "twice the knee's damping at 1 rad/s at most", at="knee"),
    Size("cross_spring", "stiffness", 2e-3, 0.15, "a twentieth of the hip's own at a knee of 1 rad at most"),
    Size("rough_spot", "friction", 3e-3, 0.15, "as dry friction, in a part of the range", at="hip"),
    Size("rough_spot", "friction", 1e-3, 0.05, "as dry friction, in a part of the range", at="knee"),
    Size("rough_spot", "centre", 1.35, 1.65, "where the hip often passes", "linear", "hip"),
    Size("rough_spot", "centre", 0.2, 0.8, "where the knee often passes", "linear", "knee"),
    Size("rough_spot", "width", 0.05, 0.2, "a fraction of the range"),
    Size("angle_damping", "damping", 0.05, 1.0, "up to twice the hip's own", at="hip"),
    Size("angle_damping", "damping", 0.015, 0.25, "up to four times the knee's own", at="knee"),
    Size("angle_damping", "centre", 1.2, 1.7, "within the hip's range", "linear", "hip"),
    Size("angle_damping", "centre", 0.0, 0.9, "within the knee's range", "linear", "knee"),
    Size("angle_damping", "width", 0.2, 0.4, "half the range"),
    Size("cogging", "size", 1e-3, 0.1, "from below the noise to 2° of hip", at="hip"),
    Size("cogging", "size", 4e-4, 0.03, "from below the noise to 2° of knee", at="knee"),
    Size("cogging", "pitch", 0.12, 0.35, "once to several times within the range"),
    Size("stiffness_drift", "share", 6e-4, 0.03, "0.7 to 36 % within a trial", "either sign"),
    Size("periodic_torque", "size", 2e-3, 0.1, "from below the noise to 2° of hip", at="hip"),
    Size("periodic_torque", "size", 8e-4, 0.04, "from below the noise to 3° of knee", at="knee"),
    Size("periodic_torque", "frequency", 0.3, 3.0, "slow enough to move the leg, several periods a trial"),
    Size("pressure_growth", "growth", 1e-4, 6e-3, "at 30 kPa nine times this", at="maa"),
    Size("pressure_growth", "growth", 2.5e-4, 2e-2, "at 15 kPa twice this, and BAA is softer", at="baa"),
    Size("pressure_damping", "damping", 0.8, 20.0, "up to the actuators' own at 10 kPa"),
    Size("leak", "share", 3e-3, 0.12, "0.3 to 12 % of the difference"),
    Size("fade", "share", 6e-3, 0.35, "0.6 to 35 % of the force"),
    Size("fade", "time_constant", 2.0, 10.0, "slower than the leg, within a trial"),
)
"""Of everything from outside it."""


UNLIKE = 1.3
"""Least factor between dry friction forwards and backwards that is called different."""


def by_another_name(effect: str, values: Mapping[str, float]) -> bool:
    """Whether an effect with these values would rightly be called by a simpler one's name."""
    if effect == "asymmetric_lag":
        return abs(math.log(values["fill"] / values["vent"])) < math.log(1.5)
    if effect == "stribeck_friction":
        return values["breakaway"] < values["friction"] / 3
    if effect == "asymmetric_friction":
        return max(values.values()) < UNLIKE * min(values.values())
    return False


def measured_by(row: Size, effect: type[Effect], true: float) -> tuple[float, float | None]:
    """(what an error is relative to, where the effect does nothing), see ``estimates.measure_of``."""
    info = effect.parameter_info()
    if row.law == "linear" and info[row.parameter]["unit"] in ("rad", "m"):
        return row.high - row.low, None
    zero = (effect.grows_from() if row.parameter == next(iter(info)) else None) or 0.0
    return abs(true - zero), zero


def size_of(effect: str, parameter: str, kind: str, location: str) -> Size:
    """The row for a parameter of an effect at a place of a leg, see ``row_of``."""
    return row_of((*CATALOGUE, *BEYOND), effect, parameter, kind, location)


def row_of(table: Sequence[Size], effect: str, parameter: str, kind: str, location: str) -> Size:
    """The row of a table for a parameter of an effect at a place.

    Raises:
        ConfigError: where the table has none or more than one.
    """
    found = [
        row for row in table if (row.effect, row.parameter) == (effect, parameter) and row.at in ("", kind, location)
    ]
    if len(found) != 1:
        raise ConfigError(
            f"the table of sizes has {len(found)} rows for {parameter!r} of {effect!r} at {location!r}, expected one"
        )
    return found[0]
