"""What one set of gains is worth: what happened on each robot, and its cost and limits over all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.tuning.study import Limits, Weights
from equimus_ctrl.types import Array

BAND = 0.03
"""A joint has settled when it stays this close to its reference [rad]."""
TERMS = ("error", "overshoot", "settling", "offset", "effort", "chatter")


@dataclass(frozen=True, eq=False)
class Outcome:
    """One candidate on one leg in one scenario.

    Attributes:
        terms: (6,) error, overshoot, settling, offset, effort, chatter; NaN where it was not run, for its linearised
            loops are beyond the limits.
        saturation: share of the time at a pressure limit; NaN likewise.
        restless: how far the joints still swing in the last quarter of a step-like scenario [rad].
        diverged: whether the simulation left the range where its numbers mean anything.
    """

    terms: Array
    saturation: float
    restless: float
    diverged: bool


@dataclass(frozen=True, eq=False)
class LegOutcome:
    """One candidate on one leg.

    Attributes:
        runs: one for each scenario.
        modulus: largest eigenvalue of its linearised sampled loops; NaN where a run already failed.
        raised_modulus: the same with all gains raised by the gain margin asked for.
        give: how far it gives way to loads, see ``stability.load_response`` [rad √s]; 0 where that has no weight.
    """

    runs: Sequence[Outcome]
    modulus: float
    raised_modulus: float
    give: float = 0.0

    @property
    def calm(self) -> bool:
        """Whether every run stayed in range and came to rest, and the linearised loops are stable."""
        return not any(run.diverged or run.restless > BAND for run in self.runs) and self.modulus < 1


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one set of gains is worth.

    Attributes:
        cost: what is minimised; candidates outside the limits lie above all within them.
        terms: weighted sum of each term of the cost over scenarios, over the ensemble's mean.
        member_costs: (n_members,) cost of each leg.
        overshoot: largest over the ensemble, as a share of the step.
        saturation: largest over the ensemble.
        modulus: largest eigenvalue of the linearised sampled loops; NaN where a run failed, 0 of none.
        raised_modulus: the same with all gains raised by the gain margin asked for.
        stable: False where any leg diverged, would not come to rest, or has a loop that is not stable.
        feasible: stable and within the limits.
        beaten: not tried to the end, for it was not to become the cheapest; its cost is then what it is at least where
            it does as well on the remaining robots as is thought possible.
    """

    cost: float
    terms: dict[str, float]
    member_costs: tuple[float, ...]
    overshoot: float
    saturation: float
    modulus: float
    raised_modulus: float
    stable: bool
    feasible: bool
    beaten: bool = False

    @property
    def within(self) -> bool:
        """Whether its cost is no penalty."""
        return self.feasible or self.beaten

    @property
    def told(self) -> str:
        """Its cost for people, who have no use for a penalty."""
        if self.within:
            return f"{'at least ' if self.beaten else ''}{self.cost:.4f}"
        return "beyond a limit" if self.stable else "unstable"

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for a journal."""
        return {
            "cost": self.cost,
            "terms": self.terms,
            "member_costs": list(self.member_costs),
            "overshoot": self.overshoot,
            "saturation": self.saturation,
            "modulus": self.modulus,
            "raised_modulus": self.raised_modulus,
            "stable": self.stable,
            "feasible": self.feasible,
            "beaten": self.beaten,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Evaluation:
        """The evaluation in a journal's line."""
        return cls(**{**data, "member_costs": tuple(data["member_costs"])})


def judged(
    legs: Sequence[LegOutcome],
    counts: Sequence[float],
    weighing: Weights,
    limits: Limits,
    paying: Sequence[bool] | None = None,
) -> Evaluation:
    """The cost of what happened on every leg, or other robot.

    Stable candidates within the limits cost their weighted terms; those beyond a limit cost 1e3 and more, those
    that diverge, do not come to rest or have an unstable linearised loop 1e6 and more.

    Args:
        legs: what happened on each.
        counts: weights of the scenarios.
        weighing: of the terms.
        limits: hard ones, of all.
        paying: of which legs the cost is taken; all by default, and where it would be of none.
    """
    weights = np.array([getattr(weighing, key) for key in TERMS])
    own = np.array(paying if paying is not None and any(paying) else [True] * len(legs))
    shares = np.array(counts) / sum(counts)
    terms = np.array([[run.terms for run in leg.runs] for leg in legs])  # (members, tasks, terms)
    runs = [run for leg in legs for run in leg.runs]
    restless = max(run.restless for run in runs)
    diverged = sum(run.diverged for run in runs)
    saturation = max(run.saturation for run in runs)
    overshoot = float(terms[:, :, 1].max())
    calm = diverged == 0 and restless <= BAND
    if diverged:
        nothing = dict.fromkeys(TERMS, math.nan)
        members = (math.nan,) * len(legs)
        return Evaluation(1e9 * diverged, nothing, members, math.inf, saturation, math.nan, math.nan, False, False)
    weighted = np.einsum("mtk,t->mk", terms, shares) * weights
    gives = weighing.give * np.array([leg.give for leg in legs])
    member_costs = weighted.sum(axis=1) + gives
    cost = (1 - weighing.worst) * member_costs[own].mean() + weighing.worst * member_costs[own].max()
    told = ((overshoot, limits.overshoot), (saturation, limits.saturation))
    beyond = sum(max(own - most, 0.0) for own, most in told if not math.isnan(own))
    modulus = max(leg.modulus for leg in legs) if calm else math.nan
    stable = calm and modulus < 1
    raised = max(leg.raised_modulus for leg in legs) if stable else math.nan
    feasible = bool(stable and beyond == 0 and modulus <= limits.modulus and raised < 1)
    if not calm:
        cost = 1e6 * (1 + restless)
    elif not stable:
        cost = 1e6 * modulus
    elif not feasible:
        slow = max(modulus - limits.modulus, 0.0) / (1 - limits.modulus)
        cost = 1e3 * (1 + beyond + slow + 10 * max(raised - 1, 0.0))
    return Evaluation(
        float(cost),
        {key: float(value) for key, value in zip(TERMS, weighted[own].mean(axis=0), strict=True)}
        | ({"give": float(gives[own].mean())} if gives.any() else {}),
        tuple(float(c) for c in member_costs),
        overshoot,
        saturation,
        modulus,
        raised,
        stable,
        feasible,
    )
