"""Paths in space for a named point of a robot: corners joined by straight lines, circles, from rest to rest."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.scenarios.references import joint_path, minimum_jerk
from equimus_ctrl.types import Array

CORNERS = {"line": 2, "triangle": 3, "square": 4}
"""Shapes of straight lines, and their corners, evenly round a circle."""
SHAPES = (*CORNERS, "circle")
AXES = {"x": 0, "y": 1, "z": 2}


def plane_of(text: str) -> Array:
    """(3, 2) columns: unit vectors along two axes of the room, of a text such as ``xz``.

    Raises:
        ConfigError: for anything else.
    """
    if len(text) != 2 or not set(text) <= set(AXES) or text[0] == text[1]:
        raise ConfigError(f"plane is {text!r}, expected two of x, y and z, such as xz")
    return np.eye(3)[:, [AXES[text[0]], AXES[text[1]]]]


def vector_of(what: str, text: str) -> Array:
    """(3,) of a text such as ``0.3 0 0.2``.

    Raises:
        ConfigError: where it is not three finite numbers.
    """
    try:
        found = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        found = np.empty(0)
    if found.shape != (3,) or not np.all(np.isfinite(found)):
        raise ConfigError(f"{what} is {text!r}, expected three numbers, such as '0.3 0 0.2'")
    return found


def shape_path(shape: str, size: float, leg_time: float, rounds: int) -> tuple[Array, Array]:
    """Times (n,) [s] and places (n, 2) [m] about the middle of a closed path, from rest to rest with the least jerk.

    A line, triangle or square stops at each corner. A circle takes as long as a square and stops at its end.

    Args:
        shape: of ``SHAPES``.
        size: diameter of the circle in which it lies [m].
        leg_time: from corner to corner [s].
        rounds: how often.

    Raises:
        ConfigError: for a shape that there is not.
    """
    if shape not in SHAPES:
        raise ConfigError(unknown_name("shape", shape, SHAPES))
    if shape == "circle":
        whole = CORNERS["square"] * leg_time * rounds
        times = np.linspace(0.0, whole, max(round(120 * whole), 2) + 1)
        angles = 2 * np.pi * rounds * minimum_jerk(times / whole)
        return times, size / 2 * np.column_stack([np.cos(angles), np.sin(angles)])
    n = CORNERS[shape]
    # A line along the first axis; other shapes stand on a side.
    angles = 2 * np.pi * np.arange(n) / n + (0.0 if n == 2 else np.pi / 2 + (n % 2 == 0) * np.pi / n)
    corners = size / 2 * np.column_stack([np.cos(angles), np.sin(angles)])
    return joint_path(np.vstack([*[corners] * rounds, corners[:1]]), leg_time)


def resampled(times: Array, places: Array, rate: float = 120.0) -> tuple[Array, Array]:
    """Times (m,) [s] and places (m, k) along straight lines between given ones (n,), (n, k), the last included."""
    whole = float(times[-1])
    grid = np.linspace(0.0, whole, max(round(rate * whole), 1) + 1)
    return grid, np.stack([np.interp(grid, times, column) for column in places.T], axis=1)
