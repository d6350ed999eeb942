"""Sparse regression on accelerations, in the manner of SINDy (Brunton, Proctor and Kutz, 2016).

What torque the nominal model lacks along the measured motions is regressed on a library: for each candidate the torque
that it would explain, beside the same for the robot's own parameters. Orthogonal matching pursuit adds columns; how
many is decided by cross-validation, the fewest within one standard error of the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.torques import Smooth, has_play, missing_torque
from equimus_ctrl.types import Array

MOST_COLUMNS = 3
DIFFERENCE = 1e-3
"""Step of the derivatives by the robot's own parameters, in units of their scale."""


@dataclass(frozen=True, eq=False)
class Column:
    """One candidate with one set of values.

    Attributes:
        candidate: what.
        values: of its parameters.
        low: least factor on the column that the first parameter's bounds allow.
        high: greatest.
    """

    candidate: Candidate
    values: dict[str, float]
    low: float
    high: float

    def finding(self, factor: float) -> dict[str, Any]:
        """As in a diagnosis report, the first parameter grown by a factor where it can be."""
        values = dict(self.values)
        first, nothing = next(iter(values)), self.candidate.effect.grows_from()
        if nothing is not None:
            values[first] = nothing + factor * (values[first] - nothing)
        return {
            "effect": self.candidate.effect.name,
            "locations": list(self.candidate.locations),
            "parameters": {key: {"value": value} for key, value in values.items()},
        }


@dataclass(frozen=True, eq=False)
class Library:
    """The regression of every trial, turned so that it has no more rows than columns; sums of squares stay.

    Attributes:
        own: for each trial (r, p) columns of the robot's own parameters.
        columns: for each (r, k) those of the candidates.
        target: for each (r,).
        meaning: of the candidates' columns.
        rows: how many there were in each trial.
    """

    own: list[Array]
    columns: list[Array]
    target: list[Array]
    meaning: list[Column]
    rows: list[int]


def sparse_regression(
    free: FreeParameters, segments: Sequence[Segment], pool: Sequence[Candidate]
) -> list[dict[str, Any]]:
    """Findings as in a diagnosis report.

    Args:
        free: the nominal model and its own free parameters.
        segments: what was measured.
        pool: the candidates; those behind a sensor's play are dropped, for no torque identifies them.
    """
    library = build_library(free, segments, pool)
    everything = list(range(len(segments)))
    count = _best_count(library, everything) if len(segments) > 1 else 0
    chosen, factors = pursue(library, everything, count)
    return [library.meaning[k].finding(factor) for k, factor in zip(chosen, factors, strict=True)]


def build_library(free: FreeParameters, segments: Sequence[Segment], pool: Sequence[Candidate]) -> Library:
    """All columns."""
    trials = [Smooth.of(segment) for segment in segments]
    instants = [trial.used(free.model) for trial in trials]
    nominal = missing_torque(free.model, trials, instants)

    def taken(model: Model) -> list[Array]:
        """For each trial (n,) what another model lacks less than the nominal one."""
        pairs = zip(nominal, missing_torque(model, trials, instants), strict=True)
        return [(before - after).ravel() for before, after in pairs]

    own = []
    for k in range(len(free.free)):
        theta = np.array(free.start)
        theta[k] += DIFFERENCE * free.scale[k]
        own.append(taken(free.model_at(theta)))
    meaning, columns = [], []
    for candidate in pool:
        for values in _shapes(candidate):
            model = replace(free.model, effects=(*free.model.effects, *candidate.attached(values)))
            if has_play(model):
                continue
            column = taken(model)
            whole = np.concatenate(column)
            if np.isfinite(whole).all() and np.abs(whole).max(initial=0.0) > 0:
                columns.append(column)
                meaning.append(_column(candidate, values))
    everything = [np.column_stack([*(c[t] for c in (*own, *columns)), r.ravel()]) for t, r in enumerate(nominal)]
    weights = _weights(everything, len(own), nominal[0].shape[1])
    turned = [
        np.asarray(np.linalg.qr(block * w[:, None], mode="r")) for block, w in zip(everything, weights, strict=True)
    ]
    p = len(own)
    return Library(
        [block[:, :p] for block in turned],
        [block[:, p:-1] for block in turned],
        [block[:, -1] for block in turned],
        meaning,
        [len(block) for block in everything],
    )


def _weights(blocks: Sequence[Array], own: int, joints: int) -> list[Array]:
    """For each trial (n,) one over what the own parameters leave of each joint's torque; rows take joints in turn."""
    whole = np.concatenate(blocks)
    left = whole[:, -1] - whole[:, :own] @ np.linalg.lstsq(whole[:, :own], whole[:, -1], rcond=None)[0]
    sizes = left.reshape(-1, joints).std(axis=0)
    return [np.tile(1.0 / sizes, len(block) // joints) for block in blocks]


def _shapes(candidate: Candidate) -> list[dict[str, float]]:
    """Guesses that differ in more than the size of a column."""
    first, nothing = next(iter(candidate.effect.parameter_info())), candidate.effect.grows_from()
    if nothing is None:
        return [dict(guess) for guess in candidate.guesses]
    groups: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for guess in candidate.guesses:
        groups.setdefault(tuple(v for key, v in guess.items() if key != first), []).append(dict(guess))
    # Of sizes the median: the smallest drown in rounding, the largest are no longer a matter of proportion.
    return [sorted(own, key=lambda g: abs(g[first] - nothing))[len(own) // 2] for own in groups.values()]


def _column(candidate: Candidate, values: dict[str, float]) -> Column:
    first, nothing = next(iter(values)), candidate.effect.grows_from()
    if nothing is None:
        return Column(candidate, values, 0.0, np.inf)
    info = candidate.effect.parameter_info()[first]
    ends = sorted((float(info[end]) - nothing) / (values[first] - nothing) for end in ("low", "high"))
    return Column(candidate, values, *ends)


def pursue(library: Library, trials: Sequence[int], count: int) -> tuple[list[int], list[float]]:
    """Columns chosen one after the other, each where it explains most of the residual, and their factors."""
    target = np.concatenate([library.target[t] for t in trials])
    own = np.concatenate([library.own[t] for t in trials])
    columns = np.concatenate([library.columns[t] for t in trials])
    chosen: list[int] = []
    factors: list[float] = []
    for _ in range(count):
        basis = np.linalg.qr(np.column_stack([own, columns[:, chosen]]))[0]
        left = target - basis @ (basis.T @ target)
        free = columns - basis @ (basis.T @ columns)
        norms = np.sqrt((free**2).sum(axis=0))
        seen = norms > 1e-6 * np.sqrt((columns**2).sum(axis=0))
        gains = np.where(seen, (left @ free) / np.where(seen, norms, 1.0), 0.0)
        for k in np.argsort(-np.abs(gains)):
            if gains[k] == 0.0:
                return chosen, factors
            labels = {library.meaning[c].candidate.label for c in chosen}
            column = library.meaning[k]
            if column.candidate.label in labels:
                continue
            found = _factors(target, own, columns[:, [*chosen, int(k)]])
            meanings = [library.meaning[c] for c in (*chosen, int(k))]
            if all(m.low <= f <= m.high for m, f in zip(meanings, found, strict=True)):
                chosen, factors = [*chosen, int(k)], found
                break
        else:
            break
    return chosen, factors


def _factors(target: Array, own: Array, columns: Array) -> list[float]:
    whole = np.column_stack([own, columns])
    return [float(f) for f in np.linalg.lstsq(whole, target, rcond=None)[0][own.shape[1] :]]


def _best_count(library: Library, trials: Sequence[int]) -> int:
    """The fewest columns whose error on held-out trials is within one standard error of the least."""
    errors = np.empty((len(trials), MOST_COLUMNS + 1))
    for row, out in enumerate(trials):
        kept = [t for t in trials if t != out]
        target = np.concatenate([library.target[t] for t in kept])
        own = np.concatenate([library.own[t] for t in kept])
        for count in range(MOST_COLUMNS + 1):
            chosen, _ = pursue(library, kept, count)
            whole = np.column_stack([own, np.concatenate([library.columns[t][:, chosen] for t in kept])])
            theta = np.linalg.lstsq(whole, target, rcond=None)[0]
            unseen = np.column_stack([library.own[out], library.columns[out][:, chosen]])
            errors[row, count] = ((library.target[out] - unseen @ theta) ** 2).sum() / library.rows[out]
    mean = errors.mean(axis=0)
    best = int(mean.argmin())
    margin = errors[:, best].std(ddof=1) / np.sqrt(len(trials))
    return int(np.flatnonzero(mean <= mean[best] + margin)[0])
