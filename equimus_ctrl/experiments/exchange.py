"""Where distances to first order promise too much: rivals refitted in the best designs count in the search afterwards.

The largest gap that a design can have is a maximum over designs of a minimum over the rival's parameters. The search
looks for the maximum with the minimum to first order, from the parameters that are known. A refit in the best design
finds the minimum there. Where it is less than was promised, the refitted parameters are added to those that are known,
and the search goes on (the exchange for T-optimal designs: Atkinson & Fedorov 1975, Biometrika 62, 57; of saddle points
by relaxation: Shimizu & Aiyoshi 1980, IEEE Trans. Automatic Control 25). Each addition lowers what is promised, but
for the linearising never below what a refit comes to, and a refit is what a design does. So they bound the best gap
from above and from below. Once the best design settles all pairs by its refits, there is nothing to exchange.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtri

from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.experiments.power import INTERVAL, LIKELY, Power, powers
from equimus_ctrl.experiments.search import Arm, Over, search
from equimus_ctrl.experiments.separation import SETTLED, Nearby

ROUNDS = 3
"""Of exchanges, at most."""
LEADERS = 2
"""Designs, of as many families, in which rivals are refitted in a round."""
LEFT = 0.5
"""Of the evaluations, for what follows exchanges."""
WITHIN = float(ndtri(INTERVAL[1]))
"""Standard deviations of a gap by which it may be more than expected and still agree."""


def searched(
    arms: Sequence[Arm],
    evaluations: int,
    pairs: Sequence[tuple[int, int]],
    over: Over = lambda: False,
    told: Callable[[float], None] = lambda share: None,
) -> bool:
    """Spend about so many evaluations; whether time ended it before.

    Args:
        arms: families under conditions.
        evaluations: in all.
        pairs: (true, other) that the design is to tell apart.
        over: whether the time is up.
        told: the share done.
    """
    first, more = (1 - LEFT) * evaluations, LEFT * evaluations / ROUNDS
    if search(arms, round(first), over, lambda share: told(share * first / evaluations)):
        return True
    known = list[Nearby]()
    for k in range(ROUNDS):
        leaders = _leaders(arms, known)
        checked = [_checked(arm, pairs) for arm in leaders]
        if over() or not leaders:
            break
        settled = any(own for _, own in checked)
        known += [] if settled else [own for nearby, _ in checked for own in nearby]
        begun, count = first + k * more, more * (ROUNDS - k if settled else 1)

        def part(share: float, begun: float = begun, count: float = count) -> None:
            told((begun + share * count) / evaluations)

        if search(_leaders(arms, known), round(count), over, part):
            return True
        if settled:
            break
    _leaders(arms, known)
    told(1.0)
    return over()


def _leaders(arms: Sequence[Arm], known: Sequence[Nearby]) -> list[Arm]:
    """The families whose best designs are best, with all that is known of rivals: others promise less anyway."""
    while True:
        found = sorted((arm for arm in arms if arm.best is not None), key=lambda arm: -arm.value)[:LEADERS]
        behind = [arm for arm in found if len(arm.nearby) < len(known)]
        if not behind:
            return found
        for arm in behind:
            arm.reconsider(known[len(arm.nearby) :])


def _checked(arm: Arm, pairs: Sequence[tuple[int, int]]) -> tuple[list[Nearby], bool]:
    """Rivals as refitted in the best design, where less is left than promised; and whether that settles all pairs."""
    assert arm.best is not None
    apart, rivals = arm.best.separation, arm.ground.rivals
    promised = {pair: apart.gap(*pair) for pair in pairs}
    wanted = [pair for pair, gap in promised.items() if gap > SETTLED]
    if not wanted:
        return [], False
    commands = arm.commands(arm.best.point)
    try:
        found = powers(
            rivals, commands, np.random.default_rng(0), draws=0, pairs=wanted, simulator=arm.ground.simulator,
            nearby=arm.nearby,
        )  # fmt: skip
    except SimulationDiverged:
        return [], False
    less = [own for own in found if broken(promised[own.first, own.second], own)]
    settled = len(wanted) == len(pairs) and all(own.chance >= LIKELY for own in found)
    return [Nearby(own.second, own.first, own.thetas[0]) for own in less], settled


def broken(promised: float, found: Power) -> bool:
    """Whether more was promised than noise adds to what a refit leaves, and that does not settle the pair anyway."""
    cost = float(found.costs[0])
    return found.chance < LIKELY and promised > cost + WITHIN * 2.0 * math.sqrt(cost) + 1.0
