"""Runs of robots with the batch of MuJoCo."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.models.mjcf import SolverSettings
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array

FINE = SolverSettings(timestep=1 / 480, integrator="RK4", softness=0.01)


def rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def varied(m: Morphology, n: int, seed: int = 0) -> list[Morphology]:
    """Every number of a morphology changed, in each of n in another way, the two stops of a joint unlike."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(n):
        values = {}
        for key, value in m.parameters().items():
            if key not in ("command_low", "command_high"):
                values[key] = value * rng.uniform(0.8, 1.25) + (rng.uniform(0, 0.05) if key == "tilt" else 0.0)
        out.append(m.with_parameters({**values, "command_high": m.command_high * rng.uniform(0.9, 1.1)}))
    return out
