"""Numbers and names for people: in units that they read, with as many digits as are known."""

from __future__ import annotations

import math
from collections.abc import Sequence

from equimus_ctrl.diagnosis.coordinates import Coordinate, Kind
from equimus_ctrl.diagnosis.display_units import Reading
from equimus_ctrl.diagnosis.results import Estimate, Named
from equimus_ctrl.models.model import Model

DIGITS, MOST_DIGITS = 3, 5
"""Significant digits of a number without an interval, and of any."""
MANY = 4
"""So many joints or actuators are counted where all of them are meant, and not listed by name."""
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_DEGREES = 180.0 / math.pi

_SMALL = ("N·m", "N·m/rad", "N·m·s/rad", "N·m·s/rad/s")
# Below which SI size, the unit that a person reads, and how many of it one of the SI unit is.
_READ: dict[str, tuple[tuple[float, str, float], ...]] = {
    "Pa": ((math.inf, "kPa", 1e-3),),
    "Pa/s": ((math.inf, "kPa/s", 1e-3),),
    "s": ((1.0, "ms", 1e3), (math.inf, "s", 1.0)),
    "kg": ((1.0, "g", 1e3), (math.inf, "kg", 1.0)),
    "m": ((1.0, "mm", 1e3), (math.inf, "m", 1.0)),
    "m/s": ((1.0, "mm/s", 1e3), (math.inf, "m/s", 1.0)),
    "m²": ((0.01, "mm²", 1e6), (math.inf, "m²", 1.0)),
    "kg·m²": ((0.1, "g·m²", 1e3), (math.inf, "kg·m²", 1.0)),
    "rad": ((math.inf, "°", _DEGREES),),
    "rad/s": ((math.inf, "°/s", _DEGREES),),
    "1": ((math.inf, "", 1.0),),
    "N/Pa": ((math.inf, "N/kPa", 1e3),),
    **{unit: ((0.01, f"m{unit}", 1e3), (math.inf, unit, 1.0)) for unit in _SMALL},
    "N": ((0.01, "mN", 1e3), (math.inf, "N", 1.0)),
}


def reading(unit: str, size: float) -> Reading:
    """The unit in which a person reads an SI number of about this size."""
    for below, name, factor in _READ.get(unit, ()):
        if abs(size) < below:
            return Reading(name, factor)
    return Reading(unit, 1.0)


def number(value: float, decimals: int | None = None, digits: int = DIGITS) -> str:
    """A number to so many decimals (below 0: tens, hundreds …), or where none are given to significant digits."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "−∞" if value < 0 else "∞"
    if decimals is None and value == 0:
        return "0"
    places = digits - 1 - _order(value) if decimals is None else decimals
    if value and (_order(value) >= 6 or places > 7):
        kept = max(places + _order(value), 0)
        mantissa, _, exponent = f"{value:.{kept}e}".partition("e")
        return f"{mantissa}·10{str(int(exponent)).translate(_SUPERSCRIPT)}".replace("-", "−")
    text = f"{round(value, places) + 0.0:.{max(places, 0)}f}"
    return text.replace("-", "−") if float(text) else text.lstrip("-")


def _order(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0


def quantity(value: float, unit: str, digits: int = DIGITS) -> str:
    """An SI number without an interval as a person reads it: ``2.80 kPa``."""
    shown = reading(unit, value)
    return shown(number(value * shown.factor, digits=digits))


def interval_digits(value: float, low: float, high: float) -> int:
    """Decimals that an interval is worth: to half its half width, but never more than five digits of the number."""
    ends = [abs(end - value) for end in (low, high) if math.isfinite(end) and end != value]
    most = MOST_DIGITS - 1 - _order(value)
    if not ends:
        return min(DIGITS - 1 - _order(value), most)
    worth = -_order(max(ends) / 2)
    return min(max(worth, min(-_order(value), worth + 1)), most)


def estimate_text(estimate: Estimate) -> str:
    """Such as ``2.80 kPa (2.78 to 2.82)``."""
    size = max(abs(v) for v in (estimate.value, estimate.low, estimate.high) if math.isfinite(v))
    shown = reading(estimate.unit, abs(estimate.value) or size)
    value, low, high = (v * shown.factor for v in (estimate.value, estimate.low, estimate.high))
    return f"{shown(number(value, interval_digits(value, low, high)))} ({interval_text(value, low, high)})"


def interval_text(value: float, low: float, high: float) -> str:
    """``2.78 to 2.82``, or in words where it has no ends or is too narrow to be shown."""
    decimals = interval_digits(value, low, high)
    first, last = number(low, decimals), number(high, decimals)
    if not math.isfinite(low) and not math.isfinite(high):
        return "not identifiable"
    if not math.isfinite(low):
        return f"at most {last}"
    if not math.isfinite(high):
        return f"at least {first}"
    return "certain to all digits shown" if first == last else f"{first} to {last}"


def percent(share: float) -> str:
    """A share, to two digits below ten percent."""
    return f"{number(100 * share, 1 if abs(share) < 0.0995 else 0)} %" if math.isfinite(share) else "–"


def power_of_ten(exponent: float) -> str:
    """10 to a power that need not be whole, such as ``2·10⁻⁴``; beyond 10⁻¹⁰ the power alone."""
    if not math.isfinite(exponent):
        return "below 10⁻³⁰⁰" if exponent < 0 else "–"
    whole = math.floor(exponent)
    if whole < -10:
        return f"10{str(round(exponent)).translate(_SUPERSCRIPT)}"
    if whole >= -2:
        return number(10**exponent, 2 if exponent >= -1 else 3)
    digit = round(10 ** (exponent - whole))
    digit, whole = (1, whole + 1) if digit == 10 else (digit, whole)
    return f"{digit}·10{str(whole).translate(_SUPERSCRIPT)}"


def listed(items: Sequence[str], last: str = "and") -> str:
    """``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {last} {items[-1]}" if items else ""


def short(named: Named, model: Model | None = None) -> str:
    """Such as ``dead zone at baa``.

    Args:
        named: what and where.
        model: of the robot, for ``all 6 joints`` in the place of their names, and ``each of the 6 joints``.
    """
    what = named.effect.replace("_", " ")
    if model is not None and (whole := _all_of(named, model)):
        return f"{what} at {whole}"
    own = ", each with its own size" if named.each else ""
    return f"{what} at {listed(named.locations)}{own}"


def _all_of(named: Named, model: Model) -> str:
    """All places of a kind in words, where these are all of them and too many to be listed; else ""."""
    kinds = {"joints": model.robot.joint_names, "actuators": model.robot.actuator_names}
    for kind, names in kinds.items():
        if len(names) >= MANY and set(named.locations) == set(names):
            return f"each of the {len(names)} {kind}" if named.each else f"all {len(names)} {kind}"
    return ""


_COORDINATES: dict[Kind, str] = {
    "pos": "the angle of {}",
    "vel": "the speed of {}",
    "cmd": "the pressure of {}",
    "len": "the length of {}",
    "rate": "the rate of length of {}",
    "path": "the path that the length of {} has taken",
    "past": "what the length of {} has been",
    "time": "the time since a trial's start",
}


def coordinates_text(coordinates: Sequence[Coordinate], model: Model | None = None) -> str:
    """What a residual force depends on, in words: ``the angle of hip and the speed of hip``.

    Args:
        coordinates: on which.
        model: of the robot, whose joints may slide and whose commands may be no pressures.
    """
    return listed([_coordinate(c, model) for c in coordinates])


def _coordinate(coordinate: Coordinate, model: Model | None) -> str:
    if coordinate.sign:
        return f"the direction in which {coordinate.place} moves"
    words = _COORDINATES[coordinate.kind]
    if model is not None and coordinate.kind == "cmd" and not model.robot.traits.commands_are_pressures:
        words = "the command of {}"
    if model is not None and coordinate.kind == "pos" and model.robot.slides(coordinate.place):
        words = "the position of {}"
    text = words.format(coordinate.place)
    if coordinate.less:
        text += f" less {words.format(coordinate.less)}"
    return text if coordinate.frequency is None else f"{text} at {coordinate.frequency:.4g} Hz"
