"""Three simpler methods that find missing physics, on the same recordings, candidates and refits as the diagnosis."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.proof.refits import Refits, findings_of
from equimus_ctrl.proof.sindy_baseline import sparse_regression

MOST_PARTS = 3

TITLES = {
    "bic": "forward selection by BIC",
    "sparse": "sparse regression on accelerations",
    "validation": "best on held-out trials",
}
"""Name → for people."""


def baselines(data: Data, heldout: Sequence[Segment], base: Fitted | None = None) -> dict[str, dict[str, Any]]:
    """The answers of all baselines, name → findings as in a diagnosis report and the time taken.

    Args:
        data: what is fitted.
        heldout: trials that judge.
        base: the model without any effect, refitted, where that was done before.
    """
    pool = candidates(data.free.model, data.segments)
    refits = Refits(data, pool, base or data.base())
    first = Shared(refits)
    ways: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "bic": lambda: findings_of(forward_bic(first).hypothesis),
        "validation": lambda: findings_of(best_on_heldout(first, heldout).hypothesis),
        "sparse": lambda: sparse_regression(data.free, data.segments, pool),
    }
    answers: dict[str, dict[str, Any]] = {}
    for name, way in ways.items():
        begun = time.perf_counter()
        try:
            answers[name] = {"findings": way(), "failed": ""}
        except EquimusError as error:
            answers[name] = {"findings": [], "failed": str(error)}
        answers[name]["seconds"] = time.perf_counter() - begun
    return answers


class Shared:
    """Refits, of which the first round is made once for all."""

    def __init__(self, refits: Refits) -> None:
        self.refits = refits
        self._first: list[Fitted] | None = None

    @property
    def base(self) -> Fitted:
        """The model without any effect."""
        return self.refits.base

    def options(self, fitted: Fitted) -> list[Fitted]:
        """See ``Refits.options``."""
        if fitted is not self.base:
            return self.refits.options(fitted)
        if self._first is None:
            self._first = self.refits.options(fitted)
        return self._first


def bic(fitted: Fitted) -> float:
    """Σ n ln(RSS/n) over the joints + k ln n: what white noise of unknown size makes of it (Schwarz, 1978)."""
    residuals = np.concatenate(fitted.fit.residuals)
    n = residuals.size
    squares = (residuals**2).mean(axis=0)
    return float(len(residuals) * np.log(squares).sum() + fitted.n_parameters * math.log(n))


def forward_bic(refits: Shared) -> Fitted:
    """One effect more as long as the criterion falls."""
    best = refits.base
    for _ in range(MOST_PARTS):
        option = min(refits.options(best), key=bic, default=best)
        if bic(option) >= bic(best):
            break
        best = option
    return best


def best_on_heldout(refits: Shared, heldout: Sequence[Segment]) -> Fitted:
    """Of the model without any effect and those with one, the one with the least error on held-out trials."""

    def error(fitted: Fitted) -> float:
        left = residuals_of(fitted.fit.model, heldout, refits.refits.data.simulator)
        value = float((np.concatenate(left) ** 2).mean())
        return value if math.isfinite(value) else math.inf

    return min([refits.base, *refits.options(refits.base)], key=error)
