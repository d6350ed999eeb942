"""Each effect in plain words, with its numbers and intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from equimus_ctrl.diagnosis import units
from equimus_ctrl.diagnosis.results import Estimate, Finding
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_words import estimate_text, listed, quantity


@dataclass(frozen=True, eq=False)
class _Told:
    """A finding as the sentences below see it."""

    finding: Finding
    model: Model

    @property
    def places(self) -> tuple[str, ...]:
        return self.finding.part.candidate.locations

    @property
    def at(self) -> str:
        return listed(self.places)

    @property
    def the(self) -> str:
        """``the hip and the knee``."""
        return listed([f"the {place}" for place in self.places])

    @property
    def noun(self) -> str:
        """What the coordinate of the first place is called."""
        return units.noun(self.model, self.places[0])

    def one_or(self, one: str, several: str) -> str:
        return one if len(self.places) == 1 else several

    def __getitem__(self, key: str) -> str:
        return estimate_text(self.finding.parameters[key])

    def unit(self, key: str) -> str:
        return self.finding.parameters[key].unit

    def value(self, key: str) -> float:
        return self.finding.parameters[key].value

    def scaled(self, key: str, unit: str, factor: float, away: float = 0.0) -> str:
        """(parameter − away)·factor in another unit, ends in the order of their size."""
        estimate = self.finding.parameters[key]
        ends = sorted(factor * (v - away) for v in (estimate.low, estimate.high))
        return estimate_text(Estimate(factor * (estimate.value - away), ends[0], ends[1], unit))


def _pressures(t: _Told) -> str:
    if t.model.robot.traits.commands_are_pressures:
        return f"The {t.one_or('pressure', 'pressures')} of {t.at}"
    return f"The {t.one_or('push', 'pushes')} of {t.at}"


def _transport_delay(t: _Told) -> str:
    return f"Every command reaches {t.at} {t['delay']} after it was given: a transport delay."


def _first_order_lag(t: _Told) -> str:
    verb = t.one_or("follows its command", "follow their commands")
    return f"{_pressures(t)} {verb} with a time constant of {t['time_constant']}."


def _asymmetric_lag(t: _Told) -> str:
    rises, falls = t.one_or("rises", "rise"), t.one_or("falls", "fall")
    return f"{_pressures(t)} {rises} with a time constant of {t['fill']} and {falls} with one of {t['vent']}."


def _rate_limit(t: _Told) -> str:
    return f"{_pressures(t)} {t.one_or('changes', 'change')} no faster than {t['rate']}: the flow is limited."


def _filling_flow(t: _Told) -> str:
    return (
        f"{_pressures(t)} {t.one_or('rises', 'rise')} no faster than {t['rate']} under a command of 10 kPa, and as its "
        f"power {t['power']} under others: the flow grows with the command."
    )


def _cutoff(t: _Told) -> str:
    who = t.one_or(f"The valve of {t.at} stays", f"The valves of {t.at} stay")
    return (
        f"{who} shut under commands below {t['least']}, and {t.one_or('follows', 'follow')} others in full: a cutoff."
    )


def _dead_zone(t: _Told) -> str:
    who = t.one_or(f"The valve of {t.at} loses", f"The valves of {t.at} each lose")
    return f"{who} the first {t['threshold']} of every command: a dead zone."


def _saturation(t: _Told) -> str:
    return f"{_pressures(t)} {t.one_or('stops', 'stop')} rising at {t['level']}: a saturation."


def _supply_coupling(t: _Told) -> str:
    lost = t.scaled("share", "%", 100.0)
    return f"{_pressures(t)} {t.one_or('falls', 'fall')} by {lost} of what is asked of the others: a shared supply."


def _coulomb_friction(t: _Told) -> str:
    if t.places[0] in t.model.robot.joint_names:
        return f"Dry friction at {t.the} of {t['friction']}{t.one_or('', ' each')}."
    return f"Dry friction along {t.at} of {t['friction']}{t.one_or('', ' each')}."


def _stribeck_friction(t: _Told) -> str:
    return (
        f"Dry friction at {t.the} of {t['friction']} in fast motion and {t['breakaway']} more at rest, half of it "
        f"gone at {t['velocity']}: static friction above the sliding one."
    )


def _parallel_spring(t: _Told) -> str:
    return f"A spring of {t['stiffness']} beside {t.the} that is not in the model, at rest at {t['rest']}."


def _nonlinear_stiffness(t: _Told) -> str:
    cubic = t.value("cubic")
    what = "stiffens" if cubic > 0 else "softens"
    return (
        f"The spring of {t.at} {what} away from a length of {t['centre']}: by {t['cubic']} times the cube of the way, "
        f"{quantity(abs(cubic) * 0.03**3, 'N')} at 30 mm."
    )


def _narrowing_area(t: _Told) -> str:
    loss = t.value("loss")
    what = f"{t.one_or('shrinks', 'shrink')} as {t.one_or('it lengthens', 'they lengthen')}"
    if loss < 0:
        what = f"{t.one_or('grows', 'grow')} with {t.one_or('its length', 'their lengths')}"
    area = t.one_or(f"The area of {t.at}", f"The areas of {t.at}")
    return (
        f"{area} {what}: near the rest length by {t['loss']} times the share of length gained, by "
        f"{abs(1 - 1 / (1 + loss / 5)):.0%} at a fifth more."
    )


def _hysteresis(t: _Told) -> str:
    force = t.one_or(f"The force of {t.at} depends", f"The forces of {t.at} depend")
    return f"{force} on the path of the length: a hysteresis of ±{t['size']} that builds up over {t['width']}."


def _creep(t: _Told) -> str:
    who = t.one_or(f"{t.at} creeps", f"{t.at} creep")
    return f"{who}: beside the modelled spring {t['stiffness']} relax with a time constant of {t['time_constant']}."


def _joint_stop(t: _Told) -> str:
    place, m = t.places[0], t.model.morphology
    joint, lower = m.joint(place), t.value("angle") < m.middle(place)
    side, modelled = ("lower", joint.lower) if lower else ("upper", joint.upper)
    instead = "which the model does not have" if modelled is None else f"not at {quantity(modelled.angle, 'rad')}"
    return (
        f"The {side} stop of the {place} begins at {t['angle']}, {instead}, with a stiffness of {t['stiffness']} and a "
        f"damping of {t['damping']}."
    )


def _viscous_friction(t: _Told) -> str:
    return f"Friction at {t.the} in proportion to speed, of {t['damping']}{t.one_or('', ' each')}."


def _quadratic_damping(t: _Told) -> str:
    return f"A drag at {t.the} that grows with the square of speed, of {t['drag']}{t.one_or('', ' each')}."


def _asymmetric_damping(t: _Told) -> str:
    more = "forwards" if t.value("difference") > 0 else "backwards"
    size = t.scaled("difference", t.unit("difference"), math.copysign(1.0, t.value("difference")))
    return f"Viscous friction at {t.the} is larger {more}, by {size}."


def _asymmetric_friction(t: _Told) -> str:
    return f"Dry friction at {t.the} differs between directions: {t['forward']} forwards and {t['backward']} backwards."


def _load_friction(t: _Told) -> str:
    share = t.scaled("share", "%", 100.0)
    return f"Dry friction at {t.the} of {share} of what the drive pushes: a gear's losses."


def _constant_force(t: _Told) -> str:
    return f"A constant push on {t.the} of {t['size']}."


def _joint_compliance(t: _Told) -> str:
    return (
        f"Between {t.the} and its drive there is a spring of {t['stiffness']} with a damping of {t['damping']}: the "
        "drive gives way."
    )


def _drive_play(t: _Told) -> str:
    return f"Between {t.the} and its drive there is a play of {t['play']}."


def _actuator_gain(t: _Told) -> str:
    side = "more" if t.value("factor") > 1 else "less"
    size = t.scaled("factor", "%", math.copysign(100.0, t.value("factor") - 1), 1.0)
    return f"{t.at} {t.one_or('pushes', 'push')} {size} {side} than {t.one_or('it is', 'they are')} taken to."


def _torque_saturation(t: _Told) -> str:
    return f"{_pressures(t)} {t.one_or('stops', 'stop')} growing at {t['level']}: a saturation."


def _payload_mass(t: _Told) -> str:
    return f"At {t.model.robot.carrying_point(t.places[0])} sits a mass of {t['mass']} that is not in the model."


def _gravity_tilt(t: _Told) -> str:
    return f"The base is not level: gravity leans by {t['angle']} against the model's."


def _sensor_offset(t: _Told) -> str:
    too = "much" if t.value("offset") > 0 else "little"
    size = t.scaled("offset", t.unit("offset"), math.copysign(1.0, t.value("offset")))
    return f"The measured {t.noun} of {t.the} is {size} too {too}: a sensor's offset."


def _sensor_scale(t: _Told) -> str:
    too = "much" if t.value("scale") > 1 else "little"
    size = t.scaled("scale", "%", math.copysign(100.0, t.value("scale") - 1), 1.0)
    return f"The measured {t.noun} of {t.the} is {size} too {too}: a sensor's scale."


def _sensor_delay(t: _Told) -> str:
    return f"The measured {t.noun} of {t.the} is {t['delay']} older than its time stamp: a sensor's delay."


def _backlash(t: _Told) -> str:
    sensor = t.one_or("its sensor", "their sensors")
    return f"Between {t.the} and {sensor} there is a play of {t['play']}."


SENTENCES: Mapping[str, Callable[[_Told], str]] = {
    "transport_delay": _transport_delay,
    "first_order_lag": _first_order_lag,
    "asymmetric_lag": _asymmetric_lag,
    "rate_limit": _rate_limit,
    "filling_flow": _filling_flow,
    "cutoff": _cutoff,
    "dead_zone": _dead_zone,
    "saturation": _saturation,
    "supply_coupling": _supply_coupling,
    "coulomb_friction": _coulomb_friction,
    "stribeck_friction": _stribeck_friction,
    "parallel_spring": _parallel_spring,
    "narrowing_area": _narrowing_area,
    "nonlinear_stiffness": _nonlinear_stiffness,
    "hysteresis": _hysteresis,
    "creep": _creep,
    "joint_stop": _joint_stop,
    "payload_mass": _payload_mass,
    "gravity_tilt": _gravity_tilt,
    "sensor_offset": _sensor_offset,
    "sensor_scale": _sensor_scale,
    "sensor_delay": _sensor_delay,
    "backlash": _backlash,
    "viscous_friction": _viscous_friction,
    "quadratic_damping": _quadratic_damping,
    "asymmetric_damping": _asymmetric_damping,
    "asymmetric_friction": _asymmetric_friction,
    "load_friction": _load_friction,
    "constant_force": _constant_force,
    "joint_compliance": _joint_compliance,
    "drive_play": _drive_play,
    "actuator_gain": _actuator_gain,
    "torque_saturation": _torque_saturation,
}
"""Effect → its sentence; others get the general one."""


def sentence(finding: Finding, model: Model) -> str:
    """What was left out, as a sentence of physics with its numbers and intervals.

    Args:
        finding: what.
        model: as it came.
    """
    told, cls = _Told(finding, model), finding.part.candidate.effect
    known = SENTENCES.get(cls.name)
    if known is not None:
        return known(told)
    info = cls.parameter_info()
    numbers = [f"{key} ({info[key]['doc']}) {told[key]}" for key in finding.parameters]
    what = cls.summary[:1].upper() + cls.summary[1:].rstrip(".")
    return f"{what}, at {told.at}: {listed(numbers)}."
