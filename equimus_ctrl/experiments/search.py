"""The search for an experiment: CMA-ES over each family of commands under each condition, the better ones for longer.

A point is an amplitude and what the family makes of z in [0, 1]^d. What leaves the limits with the estimates of a
rival, or with a few draws of its parameters, is worse than all that does not, by how far it leaves them; else it costs
−``divergence`` (Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772). The evaluations are shared by
successive halving (Karnin, Koren & Somekh, ICML 2013): all families have a part, the better half of them the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cmaes
import numpy as np

from equimus_ctrl.experiments.families import Family
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.separation import Bases, Separation, divergence, leading, separations
from equimus_ctrl.types import Array

LEAST = 1e-3
"""Smallest amplitude; amplitudes lie on a logarithmic scale from there to 1."""
AMPLITUDES = 11
"""So many of them are tried at first, with one z: where that moves, one of them keeps the limits."""
WITHIN = (0.2, 0.8)
"""Between these that z is drawn; in the very middle of the cube commands may be those at rest."""
SIGMA = 0.3
"""Standard deviation with which CMA-ES begins."""
FARTHEST = 1e3
"""What leaves the limits by more than so many ranges counts as this much."""
ALIKE = 0.05
"""Designs whose divergences differ by less are alike."""
EXAMPLES = 2
"""Trials by which the directions are found along which free numbers count, where simulations take long."""

Over = Callable[[], bool]
"""Whether the time is up."""


@dataclass(frozen=True, eq=False)
class Tried:
    """A design that was evaluated, within the limits as far as it was looked at.

    Attributes:
        point: (1 + d,) its amplitude on the scale of the search, and z.
        value: its divergence.
        separation: of the rivals, along the first one.
    """

    point: Array
    value: float
    separation: Separation


class Arm:
    """A family under a condition, and how far its search has come.

    Attributes:
        ground: the condition, with the rivals at rest.
        family: of commands.
        best: the best design within the limits; None where there is none.
        points: (k, 1 + d) of all designs within the limits, in order, and ``values`` of each.
        values: see above.
        nearest: pair → the design in which its distance is largest of all that were tried.
        largest: of the first designs the one with the largest amplitude within the limits; None where none is.
        spent: evaluations.
    """

    def __init__(self, ground: Ground, family: Family, seed: int, crowd: Crowd) -> None:
        self.ground, self.family, self.crowd = ground, family, crowd
        self.best: Tried | None = None
        self.points: list[Array] = []
        self.values: list[float] = []
        self.largest: Array | None = None
        self.nearest: dict[tuple[int, int], Tried] = {}
        self.spent = 0
        self._seed, self._bases = seed, list[Separation]() if ground.takes_long else None
        self._found: Bases | None = None
        self._cma: cmaes.CMA | None = None

    @property
    def value(self) -> float:
        """Of the best; −inf where there is none."""
        return -math.inf if self.best is None else self.best.value

    @property
    def candidates(self) -> list[Array]:
        """Points that are worth a closer look: the best, and of all that are as good but for a little the smallest.

        Where all pairs are settled to first order, that says little of large motions: there refits find what
        linearising does not, and what they leave is taken for noise.
        """
        if self.best is None:
            return []
        alike = [p for p, value in zip(self.points, self.values, strict=True) if value > self.best.value - ALIKE]
        span = [float(np.abs(self.commands(p).course - self.ground.rest).max(axis=0).sum()) for p in alike]
        smallest = alike[int(np.argmin(span))]
        return [self.best.point] if smallest is self.best.point else [self.best.point, smallest]

    def commands(self, point: Array) -> Commands:
        """Of a point."""
        return self.ground.commands(self.family, point[1:], LEAST ** (1.0 - float(point[0])))

    def step(self) -> None:
        """One generation."""
        n = 1 + self.family.dimension(len(self.ground.rest))
        if self._cma is None:
            middle = np.tile(np.random.default_rng(self._seed).uniform(*WITHIN, n), (AMPLITUDES, 1))
            middle[:, 0] = np.linspace(0.0, 1.0, AMPLITUDES)
            costs = self._costs(middle)
            self.largest = next((p for p, cost in zip(middle[::-1], costs[::-1], strict=True) if cost <= 0), None)
            self._cma = cmaes.CMA(
                mean=middle[int(np.argmin(costs))],
                sigma=SIGMA,
                bounds=np.tile([0.0, 1.0], (n, 1)),
                seed=self._seed,
            )
            return
        points = [np.clip(self._cma.ask(), 0.0, 1.0) for _ in range(self._cma.population_size)]
        self._cma.tell(list(zip(points, self._costs(np.array(points)), strict=True)))

    def _costs(self, points: Array) -> list[float]:
        """Of points (k, 1 + d), which are noted."""
        designs = [self.commands(point) for point in points]
        by = [self.ground.limits.excess(own).worst for own in self.crowd.motions(designs)]
        inside = [k for k, excess in enumerate(by) if excess <= 0]
        costs = [1.0 + min(excess, FARTHEST) for excess in by]
        for k, apart in zip(inside, self._apart([designs[k] for k in inside]), strict=True):
            own = Tried(points[k], divergence(apart), apart)
            costs[k] = -own.value
            self._note(own)
        self.spent += len(points)
        return costs

    def _note(self, own: Tried) -> None:
        self.points.append(own.point)
        self.values.append(own.value)
        if own.value > self.value:
            self.best = own
        for pair in self.ground.rivals.pairs:
            best = self.nearest.get(pair)
            if best is None or own.separation.distance(*pair) > best.separation.distance(*pair):
                self.nearest[pair] = own

    def _apart(self, designs: Sequence[Commands]) -> list[Separation]:
        """How far rivals are apart; where simulations take long along the directions that count."""
        rivals, simulator = self.ground.rivals, self.ground.simulator
        found = list[Separation]()
        if self._bases is not None and self._found is None and designs:
            found = separations(rivals, designs[: EXAMPLES - len(self._bases)], simulator=simulator)
            self._bases += found
            if len(self._bases) == EXAMPLES:
                self._found = leading(rivals, self._bases)
        rest = designs[len(found) :]
        return [*found, *(separations(rivals, rest, bases=self._found, simulator=simulator) if rest else ())]


def search(
    arms: Sequence[Arm],
    evaluations: int,
    over: Over = lambda: False,
    told: Callable[[float], None] = lambda share: None,
) -> bool:
    """Spend about so many evaluations; whether time ended it before.

    Args:
        arms: that share them.
        evaluations: in all; a generation that has begun is finished.
        over: whether the time is up; asked after each generation.
        told: the share done.
    """
    rounds = math.ceil(math.log2(len(arms))) + 1
    left, done = list(arms), 0
    for k in range(rounds):
        until = [arm.spent + evaluations / rounds / len(left) for arm in left]
        for arm, last in zip(left, until, strict=True):
            while arm.spent < last:
                before = arm.spent
                arm.step()
                done += arm.spent - before
                told(min(done / evaluations, 1.0))
                if over():
                    return True
        left = sorted(left, key=lambda arm: -arm.value)[: max(math.ceil(len(left) / 2), 1)]
        if k and all(arm.best is None for arm in left):
            break
    return False
