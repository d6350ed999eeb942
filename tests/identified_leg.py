"""A leg with other numbers than the nominal one, and what it does under steps of pressure and at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.recordings import StaticPoses
from equimus_ctrl.types import Array, Recording

NOMINAL = nominal_model()
TRUE = NOMINAL.with_parameters(
    {
        "maa.stiffness": 300.0,
        "baa.stiffness": 95.0,
        "maa.area": 3.7e-4,
        "baa.area": 4.7e-4,
        "maa.rest_length": 0.185,
        "baa.rest_length": 0.25,
        "maa.damping": 15.0,
        "baa.damping": 20.0,
        "hip.damping": 0.4,
        "knee.damping": 0.08,
    }
)
STEPS = (
    ((10e3, 5e3), (25e3, 5e3), (5e3, 12e3)),
    ((20e3, 3e3), (8e3, 10e3), (30e3, 2e3)),
    ((5e3, 15e3), (18e3, 8e3), (28e3, 4e3)),
)
FEW = ("knee.damping", "maa.stiffness", "baa.area")


def trial(
    steps: Sequence[tuple[float, float]],
    model: Model = TRUE,
    noise: float = 0.0,
    seed: int = 0,
    engine: EngineName = "reduced",
    duration: float = 2.0,
    **more: Any,
) -> Recording:
    """What a model does under commands of equal length, from rest under the first of them."""
    time = np.arange(round(60 * duration)) / 60
    command = np.array(steps, dtype=float)[np.minimum((time / duration * len(steps)).astype(int), len(steps) - 1)]
    start = Kinematics(model.morphology).equilibrium(steps[0])
    m = model.morphology
    name = f"trial_{round(steps[0][0])}_{round(steps[0][1])}"
    bare = Recording(name, time, command, np.tile(start, (len(time), 1)), m.actuator_names, m.joint_names, **more)
    angles = predict(model, bare, engine=engine)
    return replace(bare, position=angles + np.random.default_rng(seed).normal(0, 1, angles.shape) * noise)


@lru_cache
def trials(noise: float = 0.0, engine: EngineName = "reduced") -> tuple[Recording, ...]:
    return tuple(trial(steps, noise=noise, seed=k, engine=engine) for k, steps in enumerate(STEPS))


def values(model: Model, names: Sequence[str]) -> Array:
    return np.array([model.parameters()[name] for name in names])


@lru_cache
def small_problem() -> tuple[Model, tuple[Segment, ...]]:
    start = TRUE.with_parameters(dict(zip(FEW, 1.03 * values(TRUE, FEW), strict=True)))
    return start, tuple(cut(start, [trial(steps[:2], duration=1.5) for steps in STEPS[:2]]))


def poses_of(model: Model, noise: float = 0.0) -> StaticPoses:
    grid = np.array([(a, b) for a in (0, 8e3, 16e3, 24e3) for b in (0, 5e3, 10e3)])
    kinematics = Kinematics(model.morphology)
    angles = np.array([kinematics.equilibrium(p) for p in grid])
    low, high = model.morphology.joint_range
    clear = np.all((angles > low + 0.1) & (angles < high - 0.1), axis=1)
    assert clear.sum() >= 9
    spread = np.random.default_rng(2).normal(0, noise, angles.shape) if noise else 0.0
    return StaticPoses("made_up", grid[clear], (angles + spread)[clear])
