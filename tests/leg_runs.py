"""What a leg with wrong numbers and effects does under steps of its pressures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Array, Recording

DURATION, RATE = 5.0, 100.0
REST = 400
"""Samples of a rest before a recording."""


def recordings(
    effects: tuple[Effect, ...],
    *,
    count: int = 4,
    noise: float = 1e-3,
    seed: int = 0,
    commanded: Callable[[int, Array], Array] = lambda trial, levels: levels,
    unseen: bool = False,
) -> list[Recording]:
    """Trials of a leg with wrong numbers and effects, stepped by pressures, on the reduced engine.

    ``commanded`` says which pressures (8, 2) a trial gets in the place of those drawn. Of ``unseen`` trials other
    pressures came before, and a rest of ``REST`` seconds under the first ones, which nobody recorded.
    """
    rng = np.random.default_rng(seed)
    nominal = nominal_model()
    names = [f"{a}.{key}" for a in ("maa", "baa") for key in ("stiffness", "area", "damping")]
    wrong = {name: nominal.parameters()[name] * (1 + 0.1 * rng.uniform(-1, 1)) for name in names}
    leg = Model(nominal.morphology.with_parameters(wrong), effects)
    found = []
    for k in range(count):
        time = np.arange(0, DURATION, 1 / RATE)
        levels = commanded(k, rng.uniform((0.0, 0.0), (3e4, 2.2e4), (8, 2)))
        command = levels[np.minimum((time / 0.7).astype(int), 7)]
        earlier = rng.uniform((0.0, 0.0), (3e4, 2.2e4), (4 if unseen else 0, 2))
        before = np.vstack([np.repeat(earlier, round(0.7 * RATE), axis=0), np.tile(command[0], (unseen * REST, 1))])
        whole, n = np.vstack([before, command]), len(before)
        at = np.arange(len(whole)) / RATE
        trial = Trial(f"trial_{k}", at, whole, whole[0], 0.0, rest_pose(leg, whole[0]), at[n:])
        clean = simulate([leg], [trial], dt=1e-3, check=False)[0].position[0]
        measured = clean + noise * rng.normal(size=clean.shape)
        found.append(Recording(f"trial_{k}", time, command, measured, ("maa", "baa"), ("hip", "knee")))
    return found
