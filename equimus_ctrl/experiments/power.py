"""The power of a trial: by how much it would favour the true rival, and the chance that it settles a pair.

If rival i is true with parameters θᵢ, −2Δln L of a trial against rival j is close to G + 2√G ξ, G what it is without
noise and ξ standard normal. Both are refitted to the trial and what the recordings so far say of them, and the noise is
estimated anew with what either leaves. The pair is settled where that, and what the recordings so far say, D, is more
than what a diagnosis asks for, δ (``margin``); the chance of it is the mean over what is known of θᵢ of

    Φ((G + D − δ)/(2√G))
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.diagnosis.scoring import equally_good
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.experiments.predicted import Commands, predicted_trials
from equimus_ctrl.experiments.refitting import NoiseScale, Target, Task, refitted_all
from equimus_ctrl.experiments.separation import Separation, separations
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

DRAWS = 16
"""Of the true rival's parameters."""
LIKELY = 0.95
"""Chance from which on so many trials are said to settle a pair."""
MOST_REPEATS = 100
INTERVAL = (0.05, 0.95)
"""Between these quantiles is the gap that is told."""
NODES = ndtri((np.arange(64) + 0.5) / 64)
"""Of a standard normal distribution, equally likely."""
LEAST = 1e-12


@dataclass(frozen=True, eq=False, repr=False)
class Power(Short):
    """How a trial would tell one rival from another, were that one true.

    Attributes:
        first: the rival that is true, by its place.
        second: the other.
        gaps: (n,) G for each draw of the true one's parameters.
        ahead: D, see ``Rivals.ahead``.
        needed: δ.
        chance: that one trial settles the pair.
        repeats: of the trial that settle it with ``LIKELY``; inf where more than ``MOST_REPEATS`` would not.
    """

    first: int
    second: int
    gaps: Array
    ahead: float
    needed: float
    chance: float
    repeats: float

    @property
    def gap(self) -> float:
        """The median of what is expected without noise."""
        return float(np.median(self.gaps))

    @property
    def interval(self) -> tuple[float, float]:
        """Between what the gap will be, noise and parameters in mind."""
        realised = self.gaps[:, None] + 2.0 * np.sqrt(self.gaps)[:, None] * NODES
        low, high = np.quantile(realised, INTERVAL)
        return float(low), float(high)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null where no number of repeats would do."""
        low, high = self.interval
        return {
            "first": self.first,
            "second": self.second,
            "gap": self.gap,
            "low": low,
            "high": high,
            "ahead": self.ahead,
            "needed": self.needed,
            "chance": self.chance,
            "repeats": self.repeats if math.isfinite(self.repeats) else None,
        }


def powers(
    rivals: Rivals,
    commands: Commands,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    pairs: Sequence[tuple[int, int]] | None = None,
    simulator: Simulator | None = None,
) -> list[Power]:
    """The power of a trial for pairs of rivals, the second refitted to each draw of the first.

    Args:
        rivals: between which it is to decide.
        commands: of the trial.
        rng: by which parameters are drawn.
        draws: how often for each rival that is taken for the truth; 0 for its estimates alone.
        pairs: (true, other); all by default.
        simulator: that of the rivals by default.

    Raises:
        ConfigError: where the robot does not come to rest under the first command.
        SimulationDiverged: where every draw of a rival diverges.
    """
    simulator = simulator or rivals.simulator()
    wanted = rivals.pairs if pairs is None else list(pairs)
    apart, truths = dict[int, Separation](), dict[int, list[_Truth]]()
    for first in dict.fromkeys(i for i, _ in wanted):
        (apart[first],) = separations(rivals, [commands], along=first, simulator=simulator)
        rival = rivals.rivals[first]
        thetas = rival.draws(rng, draws) if draws else rival.theta[None]
        truths[first] = _truths(rivals, first, commands, thetas, simulator)
    whole = list(dict.fromkeys([*((i, i) for i in truths), *wanted]))
    tasks = [(i, j, truth) for i, j in whole for truth in truths[i]]
    refits = refitted_all([_task(rivals, apart[i], j, truth) for i, j, truth in tasks])
    scale, seen = NoiseScale(rivals), dict[tuple[int, int], list[float]]()
    for (i, j, truth), refit in zip(tasks, refits, strict=True):
        seen.setdefault((i, j), []).append(scale.seen(i, j, truth.number, truth.target.times, refit))
    return [_power(rivals, apart[i], j, np.array(seen[i, j]) - seen[i, i]) for i, j in wanted]


@dataclass(frozen=True, eq=False)
class _Truth:
    """A draw of the true rival's parameters.

    Attributes:
        number: of the draw.
        theta: (p,) it [unit of each].
        target: what it shows in the trial.
    """

    number: int
    theta: Array
    target: Target


def _truths(rivals: Rivals, first: int, commands: Commands, thetas: Array, simulator: Simulator) -> list[_Truth]:
    """Draws of a rival; those that diverge are left out."""
    rival = rivals.rivals[first]
    threads = computer.worker_count(simulator.threads, name="threads")

    def shown(draw: tuple[int, Array]) -> _Truth | None:
        number, theta = draw
        truth = rival.model_at(theta)
        try:
            ((segments),) = predicted_trials(rivals, truth, [commands], simulator)
        except SimulationDiverged:
            return None
        return _Truth(number, theta, Target.of(rivals, truth, segments, simulator))

    found = [truth for _, truth in computer.side_by_side(threads, shown, enumerate(thetas)) if truth is not None]
    if not found:
        raise SimulationDiverged(f"{rival.label}: the simulation diverges with every draw of its parameters")
    return found


def _task(rivals: Rivals, apart: Separation, second: int, truth: _Truth) -> Task:
    """A rival, begun where the first order leads as well, the true one at the truth."""
    other = rivals.rivals[second]
    if second == apart.along:
        return Task(other, truth.target, [truth.theta])
    led = other.theta + other.parameters.scale * (other.spread @ apart.undone(apart.along, second))
    return Task(other, truth.target, [led])


def _power(rivals: Rivals, apart: Separation, second: int, gaps: Array) -> Power:
    """Of what one trial says, and several: their gap grows as it does to first order."""
    first, gaps = apart.along, np.maximum(gaps, LEAST)
    ahead, needed = rivals.ahead(first, second), margin(rivals, apart.n)

    def chance(repeats: int) -> float:
        once = max(apart.gap(first, second), LEAST)
        whole = gaps * apart.gap(first, second, repeats) / once
        need = margin(rivals, repeats * apart.n)
        return float(ndtr((whole + ahead - need) / (2.0 * np.sqrt(np.maximum(whole, LEAST)))).mean())

    enough = next((r for r in range(1, MOST_REPEATS + 1) if chance(r) >= LIKELY), math.inf)
    return Power(first, second, gaps, ahead, needed, chance(1), float(enough))


def margin(rivals: Rivals, more: int = 0, thresholds: Thresholds | None = None) -> float:
    """By how much one rival has to be ahead to be told from another, see ``diagnosis.scoring.equally_good``.

    Args:
        rivals: of a robot, in fits of which minima may be many.
        more: numbers measured beside those so far.
        thresholds: as of diagnoses by default.
    """
    policy = SearchPolicy.of(rivals.model.robot.traits, rivals.simulator(1).engine)
    return equally_good(thresholds or Thresholds(), rivals.n + more, policy.many_minima)
