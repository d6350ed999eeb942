"""A physics step of the reduced engine that is short enough for what a robot does."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from equimus_ctrl.engines.batch import Trial, encode, simulate
from equimus_ctrl.engines.field import Field
from equimus_ctrl.engines.limits import MOST_DIVISOR
from equimus_ctrl.engines.steps import FEW, STABLE
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SAMPLED = 6
"""So many trials tell how fine a step has to be."""
UNSEEN = 1e-4
"""Share of a joint's motion that nobody sees: a hundredth of the noise where that is a hundredth of the motion."""
LEAST_MOTION = 1e-6
"""A motion that is none [rad or m]."""


def followed_step(model: Model, trials: Sequence[Trial], starts: Sequence[Array], longest: float) -> float:
    """A physics step at which the reduced engine's own error is far below what any sensor shows [s].

    It is halved until halving it changes predictions by less than ``UNSEEN`` of what the joints move, or it is
    ``MOST_DIVISOR`` times shorter.

    Args:
        model: what moves.
        trials: what is done; a few of them are simulated.
        starts: for each (2 nj,) positions and velocities at its start.
        longest: to begin with [s].
    """
    chosen = list(range(0, len(trials), max(math.ceil(len(trials) / SAMPLED), 1)))
    some, begin = [trials[i] for i in chosen], [starts[i][None] for i in chosen]
    dt = longest / min(max(math.ceil(fastest_rate(model, some, begin) * longest / STABLE), 1), MOST_DIVISOR)

    def paths(step: float) -> list[Array]:
        found = simulate([model], some, starts=begin, dt=step, threads=1, check=False)
        return [f.position[0, : f.reached[0]] for f in found]

    coarse = paths(dt)
    reached = np.concatenate(coarse)
    if not len(reached):
        return dt
    moved = reached.std(axis=0)
    while dt > longest / MOST_DIVISOR:
        fine = paths(dt / 2)
        pairs = [(a[: len(b)], b[: len(a)]) for a, b in zip(coarse, fine, strict=True) if len(a) and len(b)]
        if not pairs:
            break
        off = [np.sqrt(((a - b) ** 2).mean(axis=0)) for a, b in pairs]
        with np.errstate(all="ignore"):
            share = np.nanmedian(np.array(off) / np.maximum(moved, LEAST_MOTION), axis=0).max()
        if not share > UNSEEN:
            break
        dt, coarse = dt / 2, fine
    return dt


def fastest_rate(model: Model, trials: Sequence[Trial], starts: Sequence[Array]) -> float:
    """Largest |λ| [1/s] about the starts, with forces that nothing limits."""
    coded = encode([model], trials[0])
    own = coded.mechanics[0]
    poses = np.concatenate(starts)[:FEW, : len(own.joints)][:, own.starts]
    field = Field(coded.kernel, own.form.unlimited(coded.parameters[0]))
    return field.fastest(field.states(poses, np.zeros_like(poses)))
