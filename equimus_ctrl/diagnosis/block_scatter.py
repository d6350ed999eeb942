"""Whether a gain stands out from the scatter of the residuals, where these are more than noise.

−2Δln L takes what a model leaves for the noise that is estimated from it. Laws are approximations: dry friction that
creeps while it sticks, or an integrator's error, leaves residuals that go with the motion for longer than any noise
does. Along a slow change of the predictions they add up, and the best of many candidates then gains far more than it
would on noise. How much more they add up is seen from one block of the recordings to the next.

With r₀ the residuals without a part and r₁ those with it, whitened by the noise of the latter, c = r₀ − r₁ is what the
part changes. The slope b of r₀ over c is 1 where the fit is at its minimum, and is nothing where the part says nothing.
Its variance by blocks is (White, 1980; of clusters Liang & Zeger, 1986)

    Σ e_b²/(cᵀc)²,    e_b = c_bᵀ(r₀ − b·c)_b,

so t² = b²(cᵀc)²/Σ e_b² is the gain over the dispersion Σ e_b²/cᵀc, which is 1 where all that is left is the noise. Of
the blocks' shares s_b = c_bᵀc_b/cᵀc, f = 1/Σ s_b² − 1 degrees of freedom are left once b is estimated, as many as of so
many blocks with equal shares less one; so the sum is taken times (f + 1)/f, by which it is too small in the mean.
Likewise −2Δln L is compared with what it would be by chance, times the dispersion, under a model that is not quite
right (Kent, 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.noise import whiten
from equimus_ctrl.types import Array


@dataclass(frozen=True)
class BlockScatter:
    """How the residuals along what a part changes scatter from block to block.

    Attributes:
        dispersion: their variance over that of the noise, Σ e_b²/cᵀc·(f + 1)/f: as b was fitted, one of the f + 1
            degrees of freedom is gone.
        statistic: t², the gain over the dispersion.
        freedom: degrees of freedom by which the dispersion is known; 0 where one block has all of the change.
    """

    dispersion: float
    statistic: float
    freedom: float

    def more_than_noise(self, level: float) -> bool:
        """Whether the dispersion is above 1 by more than chance.

        Args:
            level: probability of that on noise.
        """
        return self.freedom >= 1 and self.freedom * self.dispersion > float(chdtri(self.freedom, level))

    def needed(self, level: float, parameters: int) -> float:
        """Least t² that a part with k parameters does not have by chance, k·F⁻¹(1 − level; k, freedom).

        Args:
            level: the probability.
            parameters: k.
        """
        return parameters * float(fdtri(parameters, self.freedom, 1 - level))


def block_scatter(times: Sequence[Array], without: Fitted, best: Fitted, count: int) -> BlockScatter:
    """The scatter along what the part changes by which a fit is richer than another.

    Blocks are cut in time where an equal share of c² is complete, whatever the segments. So each counts alike, and what
    a part changes in a few moments is told by as many.

    Args:
        times: for each segment (m,) [s].
        without: the fit without the part.
        best: that with it, whose noise counts.
        count: of blocks.
    """
    before, after = (
        np.concatenate([whiten(best.noise, t, r) for t, r in zip(times, fitted.fit.residuals, strict=True)])
        for fitted in (without, best)
    )
    change = before - after
    squares, products = (change**2).sum(axis=1), (before * change).sum(axis=1)
    whole = float(squares.sum())
    if whole == 0.0:
        return BlockScatter(1.0, 0.0, 0.0)
    middles = np.cumsum(squares) - squares / 2
    block = np.minimum((middles * (count / whole)).astype(np.int64), count - 1)
    shares, scores = (np.bincount(block, weights=own, minlength=count) for own in (squares, products))
    slope = float(products.sum()) / whole
    freedom = float(whole**2 / (shares**2).sum()) - 1
    dispersion = float(((scores - slope * shares) ** 2).sum()) / whole * (freedom + 1) / max(freedom, 1e-12)
    return BlockScatter(dispersion, slope**2 * whole / max(dispersion, 1e-300), freedom)


def stands_out(scatter: BlockScatter, parameters: int, candidates: int, t: Thresholds) -> float:
    """t² over the least that a part has to have; inf where the residuals scatter no more than their noise.

    Args:
        scatter: along what the part changes.
        parameters: of the part.
        candidates: among which it was the best (Bonferroni).
        t: the thresholds.
    """
    if not scatter.more_than_noise(t.scattered):
        return float("inf")
    return scatter.statistic / scatter.needed(t.significance / max(candidates, 1), parameters)
