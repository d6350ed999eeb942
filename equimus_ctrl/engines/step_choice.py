"""A physics step of the reduced engine that is short enough for what a robot does."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.field import Field
from equimus_ctrl.engines.limits import MOST_DIVISOR
from equimus_ctrl.engines.steps import FEW, STABLE
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


class StepChoice:
    """The physics step of one engine: chosen at its first simulation, and kept from then on.

    It is all that an engine remembers. The order of calls matters by it: what is simulated first decides. In a
    diagnosis that is the initial model for the engine of fits, and the fitted models for the coarser engine that
    screens candidates and for the finer one that compares alternatives. Were the step to follow each hypothesis, two of
    them would differ by their discretisation error, too.

    Attributes:
        step: [s]; None before the first simulation.
    """

    def __init__(self) -> None:
        self.step: float | None = None

    def kept(self, choose: Callable[[], float]) -> float:
        """The step [s], by ``choose`` where there is none yet."""
        if self.step is None:
            self.step = choose()
        return self.step


SAMPLED = 6
"""So many trials decide how short a step has to be."""
UNSEEN, LEAST_UNSEEN = 1e-4, 1e-6
"""Share of a joint's motion that is seen by no sensor, and share that need not be followed whatever the sensor."""
SHARE_OF_NOISE = 0.1
"""An error of so much of the noise is not seen either."""
LEAST_MOTION = 1e-6
"""A motion that is none [rad or m]."""


def noise_of(positions: Sequence[Array]) -> Array | None:
    """(nj,) the noise of measured positions (n, nj) each, or more: from their third differences; None without any.

    White noise of size σ has third differences of size √20 σ; what moves within a few samples counts as noise here.
    """
    long = [p for p in positions if len(p) > 3]
    if not long:
        return None
    differences = np.concatenate([np.diff(p, 3, axis=0) for p in long])
    return np.asarray(np.sqrt((differences**2).mean(axis=0) / 20.0))


def followed_step(
    model: Model, trials: Sequence[Trial], starts: Sequence[Array], longest: float, noise: Array | None = None
) -> float:
    """A physics step at which the reduced engine's own error is far below what any sensor shows [s].

    It is halved until halving it changes predictions by less than ``UNSEEN`` of what the joints move, and than
    ``SHARE_OF_NOISE`` of the noise where that is known, or it is ``MOST_DIVISOR`` times shorter. A servo that follows
    its goal closely shows how it does by far less than it moves.

    Args:
        model: what moves.
        trials: what is done; a few of them are simulated.
        starts: for each (2 nj,) positions and velocities at its start.
        longest: to begin with [s].
        noise: (nj,) of the sensors [rad or m].
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
    moved = np.maximum(reached.std(axis=0), LEAST_MOTION)
    seen = UNSEEN * moved
    if noise is not None:
        seen = np.minimum(seen, np.maximum(SHARE_OF_NOISE * noise, LEAST_UNSEEN * moved))
    while dt > longest / MOST_DIVISOR:
        fine = paths(dt / 2)
        pairs = [(a[: len(b)], b[: len(a)]) for a, b in zip(coarse, fine, strict=True) if len(a) and len(b)]
        if not pairs:
            break
        off = [np.sqrt(((a - b) ** 2).mean(axis=0)) for a, b in pairs]
        with np.errstate(all="ignore"):
            share = np.nanmedian(np.array(off) / seen, axis=0).max()
        if not share > 1.0:
            break
        dt, coarse = dt / 2, fine
    return dt


def fastest_rate(model: Model, trials: Sequence[Trial], starts: Sequence[Array]) -> float:
    """Largest |λ| [1/s] about the starts, with forces that nothing limits."""
    coded = encode([model], trials[0])
    own = coded.mechanics[0]
    nj = len(own.joints)
    rows = [own[:, :nj] for own in starts]
    begun = [trial.begun(model.robot, q, q)[0] for trial, q in zip(trials, rows, strict=True)]
    poses = np.concatenate(begun)[:FEW, own.starts]
    field = Field(coded.lanes, own.form.unlimited(coded.parameters[0]))
    return field.fastest(field.states(poses, np.zeros_like(poses)))
