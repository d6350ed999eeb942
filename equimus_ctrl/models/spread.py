"""Robots like a given one with other parameters: which of them vary together, and draws that cover their ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array

Group = tuple[tuple[str, ...], float]
"""Parameter names that vary together, and by which share at most."""


def groups(robot: Robot, shares: Mapping[str, float]) -> list[Group]:
    """Everything of a robot that varies.

    Args:
        robot: whose parameters.
        shares: by which share at most, of ``stiffness``, ``area``, ``damping``, ``rest_length`` and ``mass``, that of
            inertias too; what is not there does not vary.
    """
    return [(names, shares[kind]) for kind, names in robot.varying() if kind in shares]


R = TypeVar("R", bound=Robot)


def perturbed(robot: R, spread: Sequence[Group], row: Array) -> R:
    """The robot with its parameters at places (m,) of their ranges, 0 the lowest and 1 the highest."""
    nominal = robot.parameters()
    values = {
        name: nominal[name] * (1 + share * (2 * place - 1))
        for (names, share), place in zip(spread, row.tolist(), strict=True)
        for name in names
    }
    return robot.with_parameters(values)


def latin_hypercube(count: int, dimensions: int, rng: np.random.Generator) -> Array:
    """(count, dimensions) points of the unit cube, one in each of ``count`` slices along every axis (McKay, 1979)."""
    slices = np.stack([rng.permutation(count) for _ in range(dimensions)], axis=1)
    return np.asarray((slices + rng.random((count, dimensions))) / max(count, 1))
