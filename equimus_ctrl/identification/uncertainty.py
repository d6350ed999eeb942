"""How well a fit knows its parameters: intervals for coloured residuals, and unidentifiable directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

UNSEEN = 1e-6
"""A direction in scaled parameters with less than this share of the strongest one's effect counts as without any: the
derivatives are differences, and no better than that."""
INVOLVED = 1e-2
"""Share of an unseen direction's largest component from which on a parameter belongs to it; below, it is rounding."""
STRONG = 0.9
"""Correlation from which on two parameters are said to trade off."""
ZERO = 2.0
"""Standard deviations below which a correlation is none: n pairs of white noise have one of 1/√n."""
KERNEL = 4
"""Correlation times up to which scores are taken to be correlated."""


@dataclass(frozen=True)
class TradeOff:
    """A combination of parameters that is practically or exactly unidentifiable from these data.

    Attributes:
        weights: parameter name → share of its own value in a change that leaves the fit as it is, the largest being 1.
        correlation: the strongest between errors of two of them, or None where the change has no effect at all.
    """

    weights: dict[str, float]
    correlation: float | None

    def __str__(self) -> str:
        """For people."""
        if len(self.weights) == 1:
            return f"{next(iter(self.weights))} is not identifiable from these data"
        # The parameter that changes most comes first, with a positive sign.
        ordered = sorted(self.weights.items(), key=lambda item: -abs(item[1]))
        sign = np.sign(ordered[0][1])
        parts = [f"{name} by {10 * sign * weight:+.2g} %" for name, weight in ordered]
        change = f"{', '.join(parts[:-1])} and {parts[-1]}"
        if self.correlation is None:
            return f"changing {change} at once makes no difference at all"
        return f"changing {change} at once makes hardly any difference (correlation {self.correlation:+.3f})"


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Short):
    """What the residuals say of the parameters.

    Attributes:
        standard_error: (p,) inf where a parameter is not identifiable [unit of each parameter].
        half_width: (p,) of the interval of the confidence asked for [unit of each parameter].
        correlation: (p, p); nan where a parameter is not identifiable.
        trade_offs: strongest first.
        effective_samples: how many independent residuals the coloured ones are worth.
        covariance: (p, p) the sandwich of which ``standard_error`` is the diagonal's root; inf on the diagonal and nan
            beside it where a parameter is not identifiable [products of the parameters' units].
        factor: of the standard errors in the intervals, Student's t.
        step_error: (p,) what is added to the intervals for the error of the physics step [unit of each parameter];
            None where nothing is.
    """

    standard_error: Array
    half_width: Array
    correlation: Array
    trade_offs: tuple[TradeOff, ...]
    effective_samples: float
    covariance: Array
    factor: float
    step_error: Array | None = None

    def statistic(self, which: Sequence[int], away: Array) -> float:
        """Wald's δᵀC⁻¹δ of some parameters, χ² with as many degrees of freedom where they truly are that far off.

        Args:
            which: their places.
            away: (k,) δ, how far they are from the values in question.

        Returns:
            It; nan where one of them is not identifiable.
        """
        rows = list(which)
        if not np.all(np.isfinite(self.standard_error[rows])):
            return float("nan")
        scaled = away / np.maximum(self.standard_error[rows], 1e-300)
        return float(scaled @ np.linalg.lstsq(self.correlation[np.ix_(rows, rows)], scaled, rcond=None)[0])


def correlation_time(residuals: Sequence[Array]) -> float:
    """Integrated autocorrelation time in samples of residual series (m, nj + ne), at least 1 (white).

    1 + 2·Σ ρ(lag) up to the first lag whose correlation lies within the noise of its own estimate.
    """
    longest = max(len(r) for r in residuals)
    total = sum(r.size for r in residuals)
    variance = sum(float((r**2).sum()) for r in residuals) / total
    if variance == 0:
        return 1.0
    time = 1.0
    for lag in range(1, max(longest // 2, 1)):
        pairs = [r[lag:] * r[:-lag] for r in residuals if len(r) > lag]
        count = sum(p.size for p in pairs)
        rho = sum(float(p.sum()) for p in pairs) / count / variance
        if rho < ZERO / np.sqrt(count):
            break
        time += 2.0 * rho
    return time


@dataclass(frozen=True, eq=False)
class Identifiable:
    """What a Jacobian says of parameters, whatever the residuals.

    Attributes:
        inverse: (p, p) (JᵀJ)⁻¹ in scaled parameters, of the directions that are seen.
        hidden: (p,) whether a parameter belongs to a direction without any effect.
        correlation: (p, p); nan where a parameter is not identifiable.
        trade_offs: strongest first.
    """

    inverse: Array
    hidden: NDArray[np.bool_]
    correlation: Array
    trade_offs: tuple[TradeOff, ...]


def identifiable(jacobian: Array, names: Sequence[str], scale: Array, values: Array) -> Identifiable:
    """Which parameters, and which combinations of them, change predictions.

    Args:
        jacobian: (N, p) of the predictions by scaled parameters, the starts of the segments projected out.
        names: of the parameters.
        scale: (p,) sizes of changes that count [unit of each parameter].
        values: (p,) at which the derivatives are [unit of each parameter].
    """
    _, strength, directions = np.linalg.svd(jacobian, full_matrices=False)
    strongest = strength[0] if len(strength) else 0.0
    seen = strength > UNSEEN * strongest if strongest > 0 else np.zeros(len(strength), dtype=bool)
    blind = _sparse(directions[~seen])
    inverse = (directions[seen].T / strength[seen] ** 2) @ directions[seen]
    # Parameters that some unseen direction touches.
    hidden = np.any(np.abs(blind) > INVOLVED, axis=0) if len(blind) else np.zeros(len(names), dtype=bool)
    bread = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    correlation = np.where(hidden[:, None] | hidden[None, :], np.nan, inverse / np.outer(bread, bread))
    trade_offs = tuple(_trade_offs(names, scale, values, blind, inverse, correlation))
    return Identifiable(inverse, hidden, correlation, trade_offs)


def uncertainty(
    jacobians: Sequence[Array],
    residuals: Sequence[Array],
    nuisances: Sequence[Array],
    names: Sequence[str],
    scale: Array,
    values: Array,
    confidence: float = 0.95,
) -> Uncertainty:
    """Intervals from a least-squares fit whose residuals are coloured within each segment.

    The sandwich (JᵀJ)⁻¹ S (JᵀJ)⁻¹ with S the sum over lags of the scores' autocovariances, weighted as by Newey and
    West (1987) up to ``KERNEL`` correlation times, the starts of the segments projected out; then Student's t with the
    effective number of samples. A direction without effect makes the interval of every parameter it touches infinite.
    All residuals are in one unit, or divided by their noise.

    Args:
        jacobians: for each segment (m, nj + ne, p), derivative of the prediction by the parameters.
        residuals: for each segment (m, nj + ne).
        nuisances: for each segment (m, nj + ne, s), derivative by the free numbers of its start; s may be 0.
        names: of the parameters.
        scale: (p,) sizes of changes that count [unit of each parameter].
        values: (p,) where the fit ended [unit of each parameter].
        confidence: of the intervals.
    """
    p = len(names)
    projected = [_without(j * scale, n) for j, n in zip(jacobians, nuisances, strict=True)]
    known = identifiable(np.concatenate([j.reshape(-1, p) for j in projected]), names, scale, values)
    inverse = known.inverse
    time = correlation_time(residuals)
    samples = sum(r.size for r in residuals)
    effective = samples / time
    lags = int(np.ceil(KERNEL * time)) if time > 1 else 0
    meat = np.zeros((p, p))
    for j, r in zip(projected, residuals, strict=True):
        scores = np.einsum("mjp,mj->mp", j, r)
        meat += scores.T @ scores
        for lag in range(1, min(lags, len(scores) - 1) + 1):
            cross = scores[lag:].T @ scores[:-lag]
            meat += (1 - lag / (lags + 1)) * (cross + cross.T)
    started = sum(n.shape[2] for n in nuisances)
    freedom = effective - p - started / time
    if freedom < 1:
        covariance = np.full((p, p), np.nan)
        error = np.full(p, np.inf)
        t = np.inf
    else:
        scaled = inverse @ meat @ inverse * (effective / freedom)
        error = np.where(known.hidden, np.inf, np.sqrt(np.maximum(np.diag(scaled), 0.0)) * scale)
        covariance = np.where(known.hidden[:, None] | known.hidden, np.nan, scaled * np.outer(scale, scale))
        t = float(stdtrit(freedom, 0.5 + confidence / 2))
    np.fill_diagonal(covariance, error**2)
    return Uncertainty(
        error,
        np.where(np.isinf(error), np.inf, t * error),
        known.correlation,
        known.trade_offs,
        effective,
        covariance,
        t,
    )


def _without(jacobian: Array, nuisance: Array) -> Array:
    """A segment's Jacobian, its component along the Jacobian of the free initial state projected out."""
    if nuisance.shape[2] == 0:
        return jacobian
    m, nj, p = jacobian.shape
    beside = Nuisance.of(nuisance.reshape(m * nj, -1))
    return np.asarray(beside.project_out(jacobian.reshape(m * nj, p)).reshape(m, nj, p))


def _sparse(directions: Array) -> Array:
    """Another basis of the same span with as many zeros as elimination with pivoting finds, each row's largest 1.

    Parameters that are unseen each by itself so come out one by one.
    """
    rows = np.array(directions)
    for i in range(len(rows)):
        largest, column = divmod(int(np.abs(rows[i:]).argmax()), rows.shape[1])
        rows[[i, i + largest]] = rows[[i + largest, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return rows / np.abs(rows).max(axis=1, keepdims=True) if len(rows) else rows


def _trade_offs(
    names: Sequence[str], scale: Array, values: Array, blind: Array, inverse: Array, correlation: Array
) -> list[TradeOff]:
    """The blind directions, then for each group of strongly correlated parameters the direction least known.

    ``inverse`` is (JᵀJ)⁻¹ in scaled parameters.
    """
    found = []
    for direction in blind:
        share = direction * scale / np.where(values == 0, scale, np.abs(values))
        share = share / share[np.abs(share).argmax()]
        found.append(TradeOff(_weights(names, share, direction), None))
    for group in _groups(correlation):
        block = inverse[np.ix_(group, group)]
        _, vectors = np.linalg.eigh(block)
        weakest = vectors[:, -1]
        share = (weakest * scale[group]) / np.where(values[group] == 0, scale[group], np.abs(values[group]))
        share = share / share[np.abs(share).argmax()]
        pairs = np.triu(correlation[np.ix_(group, group)], 1)
        strongest = float(pairs.flat[np.abs(pairs).argmax()])
        found.append(TradeOff(_weights([names[i] for i in group], share, weakest), strongest))
    return sorted(found, key=lambda t: -1.0 if t.correlation is None else 1 - abs(t.correlation))


def _weights(names: Sequence[str], share: Array, direction: Array) -> dict[str, float]:
    rows = zip(names, share, direction, strict=True)
    return {name: float(s) for name, s, d in rows if abs(d) > INVOLVED * np.abs(direction).max()}


def _groups(correlation: Array) -> list[list[int]]:
    """Parameters linked to one another by strong correlations, one group each."""
    left = set(range(len(correlation)))
    groups = []
    while left:
        group, open_ends = [], [min(left)]
        while open_ends:
            i = open_ends.pop()
            if i in left:
                left.remove(i)
                group.append(i)
                open_ends += [j for j in left if abs(correlation[i, j]) > STRONG]
        if len(group) > 1:
            groups.append(sorted(group))
    return groups
