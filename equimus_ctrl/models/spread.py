"""Robots like a given one with other parameters: which of them vary together, and draws that cover their ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array

OF_ACTUATORS = ("stiffness", "area", "damping", "rest_length")

Group = tuple[tuple[str, ...], float]
"""Parameter names that vary together, and by which share at most."""


def groups(morphology: Morphology, shares: Mapping[str, float]) -> list[Group]:
    """Everything of a robot that varies.

    Args:
        morphology: the robot.
        shares: by which share at most, of ``stiffness``, ``area``, ``damping``, ``rest_length`` and ``mass``, that of
            inertias too; what is not there does not vary.
    """
    found: list[Group] = []
    for a in morphology.actuators:
        found += [((f"{a.name}.{key}",), shares[key]) for key in OF_ACTUATORS if key in shares]
    if "damping" in shares:
        found += [((f"{joint.name}.damping",), shares["damping"]) for joint in morphology.joints]
    if "mass" in shares:
        found += [((f"{link.name}.mass", f"{link.name}.inertia"), shares["mass"]) for link in morphology.links]
    return found


def perturbed(morphology: Morphology, spread: Sequence[Group], row: Array) -> Morphology:
    """The robot with its parameters at places (m,) of their ranges, 0 the lowest and 1 the highest."""
    nominal = morphology.parameters()
    values = {
        name: nominal[name] * (1 + share * (2 * place - 1))
        for (names, share), place in zip(spread, row.tolist(), strict=True)
        for name in names
    }
    return morphology.with_parameters(values)


def latin_hypercube(count: int, dimensions: int, rng: np.random.Generator) -> Array:
    """(count, dimensions) points of the unit cube, one in each of ``count`` slices along every axis (McKay, 1979)."""
    slices = np.stack([rng.permutation(count) for _ in range(dimensions)], axis=1)
    return np.asarray((slices + rng.random((count, dimensions))) / max(count, 1))
