"""How hypotheses are compared: what an effect has to gain, and which of two is better, or as good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from equimus_ctrl.diagnosis.block_scatter import BlockScatter, block_scatter, stands_out
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.thresholds import Thresholds


def extra_parameters(simple: Fitted, rich: Fitted) -> int:
    """Degrees of freedom by which a hypothesis is richer than another; at least 1, for it may only be another one."""
    return max(rich.n_parameters - simple.n_parameters, 1)


@dataclass(frozen=True, eq=False)
class Scoring:
    """By what hypotheses over some candidates are compared.

    Attributes:
        data: what was measured.
        pool: the candidates.
        settings: how a search goes.
    """

    data: Data
    pool: Sequence[Candidate]
    settings: SearchSettings = field(default_factory=SearchSettings)

    def score(self, fitted: Fitted) -> float:
        """Bayesian information criterion, deviance + k·ln n of k parameters and n numbers measured (Schwarz, 1978)."""
        return fitted.deviance + fitted.n_parameters * float(np.log(self.data.n))

    def accepts(self, simple: Fitted, rich: Fitted) -> bool:
        """Whether the gain of the richer hypothesis exceeds the acceptance threshold on −2Δln L."""
        gain = simple.deviance - rich.deviance
        return self.data.thresholds.decides(lambda t: gain > self.threshold(extra_parameters(simple, rich), t))

    def threshold(self, parameters: int, thresholds: Thresholds | None = None) -> float:
        """Acceptance threshold on −2Δln L of an effect with k parameters: max(F⁻¹(1 − α/N; k), ε·n) + scatter.

        F is the distribution function of χ², α the ``significance``, N the number of candidates (Bonferroni), ε the
        ``simulation_error``, n how many numbers were measured; see ``scatter``.

        Args:
            parameters: k.
            thresholds: those of the data by default.
        """
        t = thresholds or self.data.thresholds
        quantile = float(chdtri(parameters, t.significance / max(len(self.pool), 1)))
        return max(quantile, t.simulation_error * self.data.n) + self.scatter(t)

    def outdoes(self, other: Fitted, best: Fitted) -> bool:
        """Whether another hypothesis scores so much better that it is taken, see ``Thresholds.exchange``."""
        theirs, own = self.score(other), self.score(best)
        return self.data.thresholds.decides(lambda t: theirs < own - t.exchange)

    def over_scatter(self, simple: Fitted, rich: Fitted, t: Thresholds) -> float:
        """How far a gain stands out from the residuals' scatter, see ``block_scatter``: not where it is below 1."""
        return stands_out(self.scatter_beside(simple, rich, t), extra_parameters(simple, rich), len(self.pool), t)

    def lost(self, simple: Fitted, rich: Fitted) -> bool:
        """Whether a gain does not stand out from the residuals' scatter, so that no part is confirmed by it."""
        return self.data.thresholds.decides(lambda t: self.over_scatter(simple, rich, t) < 1)

    def scatter_beside(self, simple: Fitted, rich: Fitted, t: Thresholds) -> BlockScatter:
        """The residuals' scatter along what a richer hypothesis changes."""
        return block_scatter(self.data.times, simple, rich, round(t.blocks))

    def about_as_good(self, other: Fitted, best: Fitted) -> bool:
        """Whether another hypothesis fits as well as one, or better, see ``equally_good``."""
        more = self.score(other) - self.score(best)
        return self.data.thresholds.decides(lambda t: more < self.equally_good(t))

    def scatter(self, t: Thresholds) -> float:
        """By how much deviances scatter with the local minimum that a fit ends in; 0 where there is one minimum."""
        return _scatter(t, self.settings.many_minima)

    def equally_good(self, t: Thresholds, share: float = 0.0) -> float:
        """Largest difference of score of two hypotheses that fit as well, see ``equally_good``."""
        return equally_good(t, self.data.n, self.settings.many_minima, share)


def equally_good(t: Thresholds, n: int, many_minima: bool, share: float = 0.0) -> float:
    """Largest difference of score of two hypotheses that fit as well: max(max(δ, share) + scatter, ε·n).

    δ is ``indistinguishable``, ε the ``simulation_error``, scatter what deviances scatter by with the local minimum
    that a fit ends in.

    Args:
        t: the thresholds.
        n: how many numbers were measured.
        many_minima: whether there is more than one.
        share: of a gain, where that is more than δ.
    """
    return max(max(t.indistinguishable, share) + _scatter(t, many_minima), t.simulation_error * n)


def _scatter(t: Thresholds, many_minima: bool) -> float:
    return t.minima_scatter if many_minima else 0.0
