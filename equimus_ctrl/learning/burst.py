"""The plain way: a burst of two commands, found by CMA-ES on the same task and score."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cmaes
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.evaluation import judge
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Burst:
    """Hold one command, then another.

    Attributes:
        first: (na,) action within ±1.
        then: (na,) the same.
        switch: control periods of the first; not whole, the period between holds a mixture.
    """

    first: Array
    then: Array
    switch: float

    def act(self, observed: NDArray[np.float32], period: int) -> Array:
        """As of ``evaluation.Act``."""
        return np.tile(bursts(self.vector[None], period)[0], (len(observed), 1))

    @property
    def vector(self) -> Array:
        """(2 na + 1,)."""
        return np.concatenate([self.first, self.then, [self.switch]])

    @classmethod
    def of(cls, vector: Array) -> Burst:
        """Of its ``vector``."""
        na = len(vector) // 2
        return cls(vector[:na].copy(), vector[na : 2 * na].copy(), float(vector[-1]))

    def to_dict(self, control_dt: float) -> dict[str, Any]:
        """As JSON data."""
        return {"first": self.first.tolist(), "then": self.then.tolist(), "switch_s": self.switch * control_dt}


def bursts(vectors: Array, period: int) -> Array:
    """(n, na) actions of bursts (n, 2 na + 1) in a control period."""
    na = vectors.shape[1] // 2
    share = np.clip(vectors[:, -1:] - period, 0.0, 1.0)
    return np.asarray(share * vectors[:, :na] + (1 - share) * vectors[:, na : 2 * na])


POPULATION = 8
"""Bursts a generation of each of the searches beside each other."""


def search_burst(
    episodes: Episodes,
    seed: int = 0,
    generations: int = 40,
    robots: Array | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Burst, float]:
    """The burst of the greatest mean return, by as many searches as there is room for.

    A kick with a backswing is another local optimum than one without, so each search begins elsewhere.

    Args:
        episodes: a multiple of ``POPULATION`` times the number of robots.
        seed: of the searches, starts and noise.
        generations: of CMA-ES.
        robots: (r,) by number, on each of which a burst is tried; the first by default.
        progress: called with the share done.

    Returns:
        The burst, and that mean.

    Raises:
        ConfigError: where there is no room for one search.
    """
    own = np.array([0]) if robots is None else np.asarray(robots)
    count = episodes.n // (POPULATION * len(own))
    if count < 1:
        raise ConfigError(f"there are {episodes.n} episodes, expected {POPULATION * len(own)} or more")
    size, scale = count * POPULATION, np.array([*(1.0,) * (2 * episodes.action_size), float(episodes.periods)])
    bounds = np.tile([-1.0, 1.0], (len(scale), 1))
    bounds[-1, 0] = 0.0
    starts = np.random.default_rng(seed).uniform(bounds[:, 0], bounds[:, 1], (count, len(scale)))
    searches = [
        cmaes.CMA(start, 0.4, bounds=bounds, seed=seed + 1000 * k, population_size=POPULATION)
        for k, start in enumerate(starts)
    ]
    best, most = starts[0] * scale, -np.inf
    numbers, rows = np.tile(own, size), np.repeat(np.arange(size), len(own))
    for generation in range(generations):
        asked = np.array([search.ask() for search in searches for _ in range(POPULATION)])
        told = judge_rows(episodes, (asked * scale)[rows], seed, numbers).reshape(size, len(own)).mean(axis=1)
        for k, search in enumerate(searches):
            part = slice(k * POPULATION, (k + 1) * POPULATION)
            search.tell([(one, -float(value)) for one, value in zip(asked[part], told[part], strict=True)])
        k = int(told.argmax())
        if told[k] > most:
            best, most = asked[k] * scale, float(told[k])
        if progress is not None:
            progress((generation + 1) / generations)
    return Burst.of(best), most


def judge_rows(episodes: Episodes, vectors: Array, seed: int, robots: Array) -> Array:
    """(n,) returns of a burst (2 na + 1) for each row."""
    used = len(vectors)
    rest = np.zeros((episodes.n - used, vectors.shape[1]))
    whole = np.vstack([vectors, rest])
    numbers = np.concatenate([robots, np.zeros(len(rest), dtype=int)])
    return judge(episodes, lambda observed, period: bursts(whole, period), seed, numbers).returns[:used]
