"""Hypotheses screened and refitted as the diagnosis does it, but under white noise, for baselines to choose from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import Begin
from equimus_ctrl.identification.noise import white_noise

TOP = 6
"""So many candidates are refitted."""
STEPS = 15
"""At most, of a refit."""


@dataclass(frozen=True, eq=False)
class Refits:
    """One way to add to a hypothesis for all baselines.

    Attributes:
        data: what was measured.
        pool: the candidates.
        base: the model without any, refitted.
    """

    data: Data
    pool: Sequence[Candidate]
    base: Fitted

    def options(self, fitted: Fitted) -> list[Fitted]:
        """A hypothesis with one more part, for each of the most promising ones, refitted."""
        weights = white_noise(fitted.fit.residuals)
        own = len(self.data.free.free)
        found = []
        for s in sorted(screen(self.data, fitted, self.pool), key=lambda s: -s.gains.white)[:TOP]:
            begin: list[Begin] = [(s.begin, fitted.fit.starts)]
            if not fitted.hypothesis:
                # The missing physics may have biased the refitted model far.
                begin.append((np.concatenate([self.data.free.start, s.begin[own:]]), fitted.fit.starts))
            try:
                found.append(self.data.coarse_fit(s.hypothesis, begin, weights, STEPS))
            except SimulationDiverged:  # so it cannot be what happened
                continue
        return found


def findings_of(hypothesis: Hypothesis) -> list[dict[str, Any]]:
    """As in a diagnosis report, without intervals."""
    return [
        {
            "effect": part.candidate.effect.name,
            "locations": list(part.candidate.locations),
            "parameters": {key: {"value": float(value)} for key, value in part.values.items()},
        }
        for part in hypothesis
    ]
