"""What differs between groups of trials, and between the robot and its nominal model, in words."""

from __future__ import annotations

import math

from equimus_ctrl.diagnosis.differences import Departure, Difference
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.report.diagnosis_words import estimate_text, listed, number, power_of_ten, quantity, short

ABSENT = "not seen"


def differing(diagnosis: Diagnosis) -> list[str]:
    """What differs between groups of trials, or that nothing does, in sentences; none without groups."""
    if not diagnosis.groups:
        return []
    if not diagnosis.differences:
        return [f"One set of parameters fits {listed(diagnosis.groups)}: no difference is seen."]
    return [_difference(difference) for difference in diagnosis.differences]


def _difference(difference: Difference) -> str:
    values = [f"{ABSENT if own is None else estimate_text(own)} in {group}" for group, own in difference.values.items()]
    gains = f"−2 log likelihood falls by {number(difference.gain)} (threshold {number(difference.threshold)})"
    if math.isfinite(difference.validation_gain):
        gains += f", on validation trials by {number(difference.validation_gain)}"
    p_value = power_of_ten(difference.log10_p_value)
    return f"{parameter(difference)}: {', '.join(values)}; {gains}, p-value {p_value}."


def parameter(difference: Difference) -> str:
    """Which parameter differs: ``arm.mass``, or what has it and where, and where that has several which."""
    if difference.named is None:
        return difference.parameter
    several = len(REGISTRY[difference.named.effect].parameter_info()) > 1
    text = short(difference.named) + (f", {difference.parameter.replace('_', ' ')}" if several else "")
    return text[:1].upper() + text[1:]


def unit_answer(diagnosis: Diagnosis) -> str:
    """Whether the robot is another unit than the nominal model is of; "" where the nominal parameters fit as well."""
    other = diagnosis.another_unit
    if other is None:
        return ""
    groups = {departure.group for departure in other.departures}
    beside = "Beside the missing physics, the" if diagnosis.findings else "The"
    if not other.departures:
        return f"{beside} parameters are not the nominal ones, though which of them only several together show."
    if "" not in groups and len(groups) < len(diagnosis.groups):
        agree = listed([group for group in diagnosis.groups if group not in groups])
        theirs = listed([group for group in diagnosis.groups if group in groups])
        return (
            f"{beside} parameters of {theirs} are those of another unit than the nominal model; {agree} agrees with it."
        )
    return f"{beside} parameters are those of another unit than the nominal model."


def departures(diagnosis: Diagnosis) -> list[str]:
    """Parameters that are not nominal, one sentence each."""
    return [_departure(departure) for departure in diagnosis.another_unit.departures] if diagnosis.another_unit else []


def _departure(departure: Departure) -> str:
    where = f" in {departure.group}" if departure.group else ""
    nominal = quantity(departure.nominal, departure.estimate.unit)
    return f"{departure.parameter}{where}: {estimate_text(departure.estimate)}, nominal {nominal}"
