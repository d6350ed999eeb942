"""Units that files are written in, as what they mean in SI."""

from __future__ import annotations

import math

from equimus_ctrl.errors import ConfigError, unknown_name

TURN = 2.0 * math.pi
UNITS: dict[str, tuple[str, float]] = {
    "rad": ("rad", 1.0), "mrad": ("rad", 1e-3), "deg": ("rad", math.pi / 180.0), "turn": ("rad", TURN),
    "m": ("m", 1.0), "cm": ("m", 1e-2), "mm": ("m", 1e-3),
    "Pa": ("Pa", 1.0), "hPa": ("Pa", 1e2), "kPa": ("Pa", 1e3), "MPa": ("Pa", 1e6), "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5),
    "N": ("N", 1.0), "mN": ("N", 1e-3), "kN": ("N", 1e3),
    "N·m": ("N·m", 1.0), "Nm": ("N·m", 1.0), "mNm": ("N·m", 1e-3), "Ncm": ("N·m", 1e-2),
    "rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", math.pi / 180.0), "rpm": ("rad/s", TURN / 60.0),
    "turn/s": ("rad/s", TURN),
    "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3),
    "1": ("1", 1.0), "%": ("1", 1e-2),
}  # fmt: skip
"""Unit → the SI unit of what it measures, and how many of these one of it is."""
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""Unit of a clock → in seconds."""
RATES = {"rad": "rad/s", "m": "m/s"}


def factor(unit: str, wanted: str | None, where: str) -> float:
    """How many SI units one of a unit is.

    Args:
        unit: of a file's numbers.
        wanted: SI unit of what they are of; None where nobody knows it.
        where: for messages.

    Raises:
        ConfigError: for a unit that there is not, or that measures something else.
    """
    if unit not in UNITS:
        raise ConfigError(unknown_name("unit", unit, UNITS, where))
    own, size = UNITS[unit]
    if wanted is not None and own != wanted:
        fitting = ", ".join(name for name, (kind, _) in UNITS.items() if kind == wanted) or wanted
        raise ConfigError(f"{where}: unit is {unit!r}, which measures {own}; expected {fitting}")
    return size
