"""Ways to find a plan by trying many: predictive sampling, MPPI and the cross-entropy method.

A method is three functions: ``begin`` makes its memory, ``draw`` candidates around the nominal knots, ``update`` the
nominal knots and the memory of what the candidates cost. The rest is its caller's: the nominal plan is candidate 0, is
shifted in time from instant to instant, and what cannot be rolled out costs infinitely much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.types import Array

Memory = Any
"""Whatever a method carries from one update to the next; never changed in place."""


@dataclass(frozen=True)
class Spread:
    """How far and how boldly is looked.

    Attributes:
        least: standard deviation of the knots of the finest candidates [Pa].
        most: of the boldest [Pa].
        temperature: of MPPI, relative to the difference between the median and the least cost of the candidates.
        elites: share of the candidates that the cross-entropy method goes on with.
    """

    least: float
    most: float
    temperature: float
    elites: float


Begin = Callable[[tuple[int, int], Spread], Memory]
Draw = Callable[[np.random.Generator, Array, Memory, int, Spread], Array]
Update = Callable[[Array, Array, Memory, Spread], tuple[Array, Memory]]


@dataclass(frozen=True)
class Method:
    """A way to find a plan.

    Attributes:
        summary: one line for lists.
        begin: (shape of the knots (k, na), spread) → memory.
        draw: (generator, nominal knots (k, na), memory, how many n, spread) → (n, k, na) candidates [Pa].
        update: (candidates (n + 1, k, na), the nominal first, what each costs (n + 1,), memory, spread) → the nominal
            knots to go on with and the memory. At least one candidate costs finitely much.
    """

    summary: str
    begin: Begin
    draw: Draw
    update: Update


def _nothing(shape: tuple[int, int], spread: Spread) -> Memory:
    return None


def _alike(rng: np.random.Generator, nominal: Array, memory: Memory, count: int, spread: Spread) -> Array:
    """Candidates with deviations of their own, evenly from the least to the most on a logarithmic scale.

    Fine ones keep a good plan good, bold ones find another when much has changed; one deviation for all does either.
    """
    share = rng.random((count, 1, 1))
    deviation = spread.least ** (1 - share) * spread.most**share
    return np.asarray(nominal + deviation * rng.standard_normal((count, *nominal.shape)))


def _best(candidates: Array, cost: Array, memory: Memory, spread: Spread) -> tuple[Array, Memory]:
    return candidates[np.argmin(cost)], memory


def _weighed(candidates: Array, cost: Array, memory: Memory, spread: Spread) -> tuple[Array, Memory]:
    least = cost.min()
    more = float(np.median(cost[np.isfinite(cost)])) - least
    weights = np.exp(-(cost - least) / (spread.temperature * more)) if more > 0 else (cost == least) * 1.0
    return np.tensordot(weights / weights.sum(), candidates, axes=1), memory


def _wide(shape: tuple[int, int], spread: Spread) -> Array:
    return np.full(shape, spread.most)


def _within(rng: np.random.Generator, nominal: Array, memory: Array, count: int, spread: Spread) -> Array:
    # All from the memory's spread alone, it would shrink and stay so when much changes.
    own = count // 2
    within = nominal + memory * rng.standard_normal((own, *nominal.shape))
    return np.concatenate([within, _alike(rng, nominal, None, count - own, spread)])


def _elite(candidates: Array, cost: Array, memory: Array, spread: Spread) -> tuple[Array, Array]:
    count = min(max(round(spread.elites * len(cost)), 2), int(np.isfinite(cost).sum()))
    chosen = candidates[np.argsort(cost, kind="stable")[:count]]
    return chosen.mean(axis=0), np.clip(chosen.std(axis=0), spread.least, spread.most)


METHODS: dict[str, Method] = {
    "predictive_sampling": Method("the best of all candidates (Howell et al., 2022)", _nothing, _alike, _best),
    "mppi": Method("all candidates weighed by exp(−cost/λ) (Williams et al., 2017)", _nothing, _alike, _weighed),
    "cem": Method("mean and spread of the best, the cross-entropy method (Kobilarov, 2012)", _wide, _within, _elite),
}
