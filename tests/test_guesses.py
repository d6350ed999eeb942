"""Sizes worth trying follow from what recordings show, in whatever units: equations between quantities are homogeneous."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.effects.excitation import Excitation

UNITS = {"N·m": 1.07, "N": 1.07, "rad": 1.1, "m": 1.1, "s": 0.93, "Pa": 1.05, "command": 1.05, "kg": 0.96, "1": 1.0}
"""By so much more a quantity is in another unit; a joint's angle and an actuator's length are told alike."""
SEEN = Excitation(
    low=0.2, high=1.4, speed=3.0, force=0.8, command=2e4, interval=0.01, duration=8.0, mass=0.5, drive=0.9, reach=0.2,
    middle=(0.3, -0.2, 0.7), roams=0.4, lowest=-0.2, rises=0.6,
)  # fmt: skip
FORCE, PLACE, TIME = UNITS["N"], UNITS["rad"], UNITS["s"]
OTHER = Excitation(
    low=PLACE * SEEN.low,
    high=PLACE * SEEN.high,
    speed=PLACE / TIME * SEEN.speed,
    force=FORCE * SEEN.force,
    command=UNITS["Pa"] * SEEN.command,
    interval=TIME * SEEN.interval,
    duration=TIME * SEEN.duration,
    mass=UNITS["kg"] * SEEN.mass,
    drive=FORCE * SEEN.drive,
    reach=UNITS["m"] * SEEN.reach,
    middle=(0.3 * UNITS["m"], -0.2 * UNITS["m"], 0.7 * UNITS["m"]),
    roams=UNITS["m"] * SEEN.roams,
    lowest=UNITS["m"] * SEEN.lowest,
    rises=UNITS["m"] * SEEN.rises,
)
OWN = sorted(name for name, cls in REGISTRY.items() if cls.__module__.startswith("equimus_ctrl."))
ABSOLUTE = {
    ("gravity_tilt", "angle"): 1.0,
    ("position_dependent_friction", "angle"): 1.0,
    ("rate_limit", "rate"): UNITS["Pa"],
    ("rotor_inertia", "inertia"): FORCE * TIME**2 / PLACE,
}
"""What is tried whatever was seen: by so much more it is. A valve takes its time, in seconds, however long a trial is;
what comes back every turn is looked for at its quarters. An inertia is what a force turns."""


def factor(unit: str) -> float:
    """By so much more a quantity of a unit is."""
    found = 1.0
    for k, side in enumerate(unit.partition(" | ")[0].replace("N·m", "N").split("/")):
        for part in side.split("·"):
            power = {"²": 2, "³": 3}.get(part[-1], 1)
            found *= UNITS[part.rstrip("²³")] ** (power if k == 0 else -power)
    return found


def guessed(cls: Any, seen: Excitation) -> dict[str, np.ndarray]:
    rows = cls.guesses(seen)
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


@pytest.mark.parametrize("name", OWN)
def test_guesses_are_the_same_sizes_in_other_units(name: str) -> None:
    cls = REGISTRY[name]
    one, other = guessed(cls, SEEN), guessed(cls, OTHER)
    for key, values in one.items():
        unit = cls.parameter_info()[key]["unit"]
        assert np.all(np.isfinite(values)) and len(values) == len(other[key])
        by = ABSOLUTE.get((name, key), factor(unit))
        if (name, key) == ("filling_flow", "rate"):  # of the power of the command in 10 kPa
            by = UNITS["Pa"] ** (1.0 - one["power"])
        np.testing.assert_allclose(other[key], by * values, rtol=1e-12, err_msg=f"{key} [{unit}]")


@pytest.mark.parametrize(
    ("name", "key"), [("joint_stop", "angle"), ("parallel_spring", "rest"), ("nonlinear_stiffness", "centre")]
)
def test_places_are_looked_for_where_it_was(name: str, key: str) -> None:
    found = guessed(REGISTRY[name], SEEN)[key]
    assert found.min() >= SEEN.low and found.max() <= SEEN.high and np.ptp(found) > 0.6 * SEEN.span


def test_sizes_go_from_hardly_visible_to_strong() -> None:
    """Shares of the force that moves it from one end to the other, given at the whole of speed and span."""
    for unit, whole in (
        ("N·m", 1.0), ("N·m/rad", SEEN.span), ("N·m·s/rad", SEEN.speed), ("N·m·s²/rad²", SEEN.speed**2),
        ("N·m/rad³", SEEN.span**3),
    ):  # fmt: skip
        shares = np.array(SEEN.sizes(unit)) * whole / SEEN.force
        assert np.all((shares > 1e-3) & (shares < 0.5)) and np.all(np.diff(shares) > 0)
    assert math.isclose(SEEN.sizes("s")[0], 2.5 * SEEN.interval) and SEEN.sizes("furlong") == ()


TURNED = ("torque_ripple",)
"""Sums of a sine and a cosine, linear in both: a step of least squares gives the phase, and so the sign."""


@pytest.mark.parametrize("name", OWN)
def test_what_can_go_either_way_is_tried_either_way(name: str) -> None:
    """A size that bounds allow on both sides of nothing is guessed on both, all guesses within the bounds."""
    cls = REGISTRY[name]
    found, info = guessed(cls, SEEN), cls.parameter_info()
    for key, values in found.items():
        assert np.all((info[key]["low"] <= values) & (values <= info[key]["high"]))
    size, nothing = next(iter(info)), cls.grows_from()
    if name not in TURNED and nothing is not None and info[size]["low"] < nothing < info[size]["high"]:
        assert found[size].min() < nothing < found[size].max()
