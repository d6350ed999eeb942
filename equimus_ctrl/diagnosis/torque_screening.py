"""Screening in the torque domain: which laws explain the generalised forces that a model lacks along measured motions.

Inverse dynamics along the smoothed measurements give what each joint needs beside what the model has (``engines.
mjcf_inverse``). That is linear in the inertial parameters and in the size of most laws, and takes milliseconds where a
simulation of every candidate takes minutes: the inverse dynamic identification model, IDIM (Gautier, 1997; Janot,
Vandanjon & Gautier, "A generic instrumental variable approach for industrial robot identification", 2014). Measured
angles stand in the regressors, so estimates are biased by their noise, the more the smaller a motion is (errors in
variables). So no law is accepted by it: it says where fits begin, and what is so far behind that it is not simulated.
It can reject one that simulation has found, see ``torque_agreement``, and says which smooth forces are worth
simulating beside the laws that were named, see ``smooth_laws``.

With r the missing forces, J what the parameters to estimate add to them, C_k what candidate k adds, all divided by the
standard deviation of each joint's remaining forces,

    min ‖r − J δ − Σ C_k c_k‖² + ‖(θ + δ − θ₀)/s‖²

s is half the way between a parameter's bounds, see ``KNOWN_WITHIN``. Gains of drives are held, see
``torque_columns.DRIVE_GAINS``. All sums of squares are of one Gram matrix, so that any set of candidates costs a few
small factorisations. What unknown zeros of the sensors can do to the forces is projected out of r, J and C before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.torque_columns import Columns, columns_of, usual_laws
from equimus_ctrl.engines.mjcf_inverse import (
    MeasuredMotion,
    motions_of,
)
from equimus_ctrl.identification.noise import noise_of_differences
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array

WIDTHS = (2, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Widths of the test functions that are tried, in samples."""
FLAT = 0.1
"""Wider ones are not tried once ln σ has risen by so much a joint: blurring has begun, and it only grows."""
CROSSES = 0.3
"""Longest width, as a share of the time in which the fastest joint crosses its range: a spline four widths long then
spans about one crossing."""
CORRELATED = 1.5
"""So many test functions a width apart are worth one independent sample, for cubic B-splines overlap. χ² divided by it
is compared with the quantiles and thresholds of independent samples."""
WEAK = 1e-10
"""Directions of columns below this share of the strongest count as none."""
LEAST_SHARE, LEAST_WIDTHS = 0.5, 10
"""Recordings shorter than this share of the longest, or than so many widths of the narrowest test functions, are left
out: one width is chosen for all, and a short recording says little at it."""
KNOWN_WITHIN = 0.5
"""Standard deviation of what is known of a parameter before, as a share of the way between its bounds: it is known to
be within these."""


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """What a candidate explains of the missing forces.

    Attributes:
        gain: fall of χ², to be divided by ``CORRELATED``.
        values: of its parameters, by least squares within bounds [unit of each].
    """

    gain: float
    values: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class TorqueScreen:
    """The missing forces of a model and what all candidates would explain of them.

    Attributes:
        free: the parameters that are estimated beside.
        theta: (p,) where they are.
        columns: of the candidates.
        gram: (p + k + 1,) squared: of [J, C, r], each joint's rows over its standard deviation, the prior included.
        samples: how many independent ones there are.
        robot: whose exclusive slots count.
        sigma: (nj,) standard deviation of each joint's forces that the parameters and the usual laws leave.
    """

    free: FreeParameters
    theta: Array
    columns: tuple[Columns, ...]
    gram: Array
    samples: float
    robot: Robot
    sigma: Array

    @cached_property
    def _inverse(self) -> Array:
        """(p, p) of what the parameters alone add, squared."""
        p = len(self.theta)
        return _inverse_of(self.gram[:p, :p])

    @cached_property
    def beyond(self) -> Array:
        """(k + 1,) squared: of [C, r] without what the parameters can do."""
        p = len(self.theta)
        across = self.gram[:p, p:]
        return np.asarray(self.gram[p:, p:] - across.T @ self._inverse @ across)

    @property
    def missing(self) -> float:
        """χ² with the parameters alone."""
        return float(self.beyond[-1, -1])

    def alone(self) -> dict[Candidate, TorqueFit]:
        """What each candidate explains, at its best choice."""
        found: dict[Candidate, TorqueFit] = {}
        for own in self.columns:
            chi2, sizes = self.fitted([own])
            if own.candidate not in found or self.missing - chi2 > found[own.candidate].gain:
                found[own.candidate] = TorqueFit(self.missing - chi2, own.values(sizes[0]))
        return found

    def fitted(self, chosen: Sequence[Columns]) -> tuple[float, list[list[float]]]:
        """χ² and the sizes of some candidates together, each within its bounds, else without effect."""
        left = [(c, i) for c, own in enumerate(chosen) if not own.fixed for i in range(len(own.place))]
        fixed = [own.place[0] for own in chosen if own.fixed]
        while True:
            chi2, coefficients = self._least([chosen[c].place[i] for c, i in left], fixed)
            sizes = [[own.nothing(name) for name in own.scaled] for own in chosen]
            outside = []
            for (c, i), size in zip(left, coefficients, strict=True):
                own = chosen[c]
                sizes[c][i] = own.nothing(own.scaled[i]) + float(size) * own.unit(own.scaled[i])
                low, high = own.bounds(own.scaled[i])
                beyond = max(low - sizes[c][i], sizes[c][i] - high) / max(abs(own.unit(own.scaled[i])), 1e-300)
                if beyond > 0:
                    outside.append((beyond, (c, i)))
            if not outside:
                return chi2, sizes
            left.remove(max(outside)[1])

    def _least(self, taken: Sequence[int], fixed: Sequence[int]) -> tuple[float, Array]:
        """(χ², coefficients) of some columns, others counting once each."""
        gram, last = self.beyond, len(self.beyond) - 1
        aim, whole = gram[taken, last].copy(), float(gram[last, last])
        for k in fixed:
            aim -= gram[taken, k]
            whole += float(gram[k, k] - 2 * gram[k, last] + 2 * sum(gram[k, m] for m in fixed if m < k))
        if not taken:
            return whole, np.empty(0)
        coefficients = _inverse_of(gram[np.ix_(taken, taken)]) @ aim
        return whole - float(aim @ coefficients), coefficients

    def least_beside(self, chosen: Sequence[Columns]) -> Array:
        """(c,) χ² that each of ``columns`` leaves at least beside some candidates: that without any bounds."""
        taken = [k for own in chosen for k in own.place]
        left = self.beyond.copy()
        if taken:
            left -= self.beyond[:, taken] @ _inverse_of(self.beyond[np.ix_(taken, taken)]) @ self.beyond[taken]
        scale = _scale(self.beyond)
        scale[-1] = math.sqrt(max(self.missing, 1e-300))
        left /= np.outer(scale, scale)
        gain = np.zeros(len(self.columns))
        for count in {len(own.place) for own in self.columns}:
            alike = [c for c, own in enumerate(self.columns) if len(own.place) == count]
            places = np.array([self.columns[c].place for c in alike])  # (a, count)
            aim = left[places, -1]
            inverse = np.linalg.pinv(left[places[:, :, None], places[:, None, :]], rcond=WEAK, hermitian=True)
            gain[alike] = np.einsum("ai,aij,aj->a", aim, inverse, aim)
        return np.asarray((left[-1, -1] - gain) * scale[-1] ** 2)

    def errors(self, chosen: Sequence[Columns]) -> list[Array]:
        """For each of some candidates (k,) standard errors of its sizes."""
        taken = [k for own in chosen for k in own.place]
        spread = np.sqrt(np.maximum(np.diag(_inverse_of(self.beyond[np.ix_(taken, taken)])), 0) * CORRELATED)
        units = np.array([abs(own.unit(name)) for own in chosen for name in own.scaled])
        return np.split(spread * units, np.cumsum([len(own.place) for own in chosen])[:-1])

    def moved(self, chosen: Sequence[Columns], sizes: Sequence[Sequence[float]]) -> Array:
        """(p,) the parameters that go with some candidates at some sizes, within bounds; a fixed one counts once."""
        taken = [k for own in chosen for k in own.place]
        coefficients = list[float]()
        for own, values in zip(chosen, sizes, strict=True):
            scaled = zip(own.scaled, values, strict=True)
            coefficients += [1.0] if own.fixed else [(v - own.nothing(name)) / own.unit(name) for name, v in scaled]
        p = len(self.theta)
        aim = self.gram[:p, -1] - self.gram[:p, [p + k for k in taken]] @ np.array(coefficients)
        return np.asarray(np.clip(self.theta + self._inverse @ aim, self.free.low, self.free.high))


def _scale(normal: Array) -> Array:
    """(k,) by which a matrix of squares has ones on its diagonal; infinite where rounding has left no square."""
    squares = np.diag(normal)
    return np.sqrt(np.where(squares > 0, squares, np.inf))


def _inverse_of(normal: Array) -> Array:
    """The pseudo-inverse of a symmetric matrix; directions below ``WEAK`` are left out."""
    scale = _scale(normal)
    strength, turn = np.linalg.eigh(normal / np.outer(scale, scale))
    seen = strength > WEAK * max(float(strength[-1]), 1e-300)
    unit = (turn[:, seen] / strength[seen]) @ turn[:, seen].T
    return np.asarray(unit / np.outer(scale, scale))


@dataclass(frozen=True, eq=False)
class TorqueDomain:
    """Measured motions along which inverse dynamics are evaluated.

    Attributes:
        motions: what was measured, recording by recording.
        width: of the test functions, in samples.
        groups: the group of trials of each motion.
        guesses: further ones of candidates, by their labels, see ``torque_guesses``.
    """

    motions: tuple[MeasuredMotion, ...]
    width: int
    groups: tuple[str, ...]
    guesses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def interval(self) -> float:
        """The longest time between samples of all recordings [s]."""
        return max(motion.interval for motion in self.motions)


def torque_domain(data: Data, pool: Sequence[Candidate]) -> TorqueDomain | None:
    """The torque domain of some recordings; None where a robot has none, or they are too short.

    Left out are recordings shorter than ``LEAST_SHARE`` of the longest, or than ``LEAST_WIDTHS`` of the narrowest test
    functions.

    Args:
        data: what was measured.
        pool: candidates, of which the usual laws tell how wide test functions are to be.

    Raises:
        BudgetSpent: where the budget ends.
    """
    if not data.free.model.robot.has_torque_domain:
        return None
    noise = np.array([own.sigma for own in noise_of_differences([s.measured for s in data.segments])])
    trials, measured, zeros = zip(*((s.trial, s.measured, s.zeros) for s in data.segments), strict=True)
    motions = motions_of(trials, measured, noise, zeros)
    longest = max(len(m.time) for m in motions)
    motions = [m for m in motions if len(m.time) > max(longest * LEAST_SHARE, LEAST_WIDTHS * WIDTHS[0])]
    if not motions:
        return None
    usual = usual_laws(pool)
    groups = tuple(next(s.group for s in data.segments if s.trial is m.trial) for m in motions)
    return TorqueDomain(tuple(motions), _width(data.free, data.free.start, motions, usual), groups)


def torque_screen(data: Data, domain: TorqueDomain, fitted: Fitted | None, pool: Sequence[Candidate]) -> TorqueScreen:
    """What candidates explain of the missing forces of the nominal model, or of a fitted hypothesis.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        fitted: the hypothesis; the nominal model by default.
        pool: the candidates.

    Raises:
        BudgetSpent: where the budget ends.
    """
    free = data.free if fitted is None else fitted.fit.parameters
    theta = free.start if fitted is None else fitted.fit.theta
    return screened_at(free, theta, data, domain, pool)


def screened_at(
    free: FreeParameters, theta: Array, data: Data, domain: TorqueDomain, pool: Sequence[Candidate]
) -> TorqueScreen:
    """What candidates explain of the missing forces of a model with these parameters.

    Args:
        free: the parameters that are estimated beside, those of effects after the model's own.
        theta: (p,) where they are [unit of each].
        data: what was measured, with the model's own parameters.
        domain: the same in the torque domain.
        pool: the candidates.

    Raises:
        BudgetSpent: where the budget ends.
    """
    return _screen(free, theta, data.free, domain, pool, data.budget.check)


def _width(free: FreeParameters, theta: Array, motions: Sequence[MeasuredMotion], usual: Sequence[Candidate]) -> int:
    """The width of the test functions that leaves least: narrower ones leave noise, wider ones blur what happens.

    What is left is that of a least-squares fit of the parameters and the usual laws.
    """
    crossing = min(
        float(np.min(np.ptp(m.position, axis=0) / np.maximum(np.abs(np.diff(m.position, axis=0)).max(axis=0), 1e-12)))
        for m in motions
    )
    usable = [w for w in WIDTHS if w <= max(CROSSES * crossing, WIDTHS[0]) and 8 * w < len(motions[0].time)]
    best, least = WIDTHS[0], math.inf
    for width in usable:
        sigma = columns_of(free, theta, motions, width, usual, lambda: None)[3]
        left = float(np.log(np.maximum(sigma, 1e-300)).sum())
        if left > least + FLAT * len(sigma):
            break
        if left < least:
            best, least = width, left
    return best


def _screen(
    free: FreeParameters, theta: Array, own_free: FreeParameters, domain: TorqueDomain, pool: Sequence[Candidate],
    check: Callable[[], None],
) -> TorqueScreen:  # fmt: skip
    """The Gram matrix of all columns, with what is known of the model's parameters."""
    found, columns, counts, sigma = columns_of(
        free, theta, domain.motions, domain.width, pool, check, domain.guesses, domain.groups
    )
    p = len(theta)
    scaled = (columns / sigma[:, None]).reshape(-1, columns.shape[2])
    gram = scaled.T @ scaled
    known = np.arange(p) < len(own_free.free)
    prior = np.where(known, KNOWN_WITHIN**-2 / (free.high - free.low) ** 2, 0.0)
    away = np.append(own_free.start, theta[len(own_free.free) :]) - theta
    gram[range(p), range(p)] += prior
    gram[:p, -1] += prior * away
    gram[-1, :p] += prior * away
    gram[-1, -1] += float(prior @ away**2)
    return TorqueScreen(free, theta, tuple(found), gram, float(counts.sum()) / CORRELATED, free.model.robot, sigma)
