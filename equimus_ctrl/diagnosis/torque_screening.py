"""Screening in the torque domain: which laws explain the generalised forces that a model lacks along measured motions.

Inverse dynamics along the smoothed measurements give what each joint needs beside what the model has (``engines.
mjcf_inverse``). That is linear in the inertial parameters and in the size of most laws, and takes milliseconds where a
simulation of every candidate takes minutes: the inverse dynamic identification model, IDIM (Gautier, 1997; Janot,
Vandanjon & Gautier, "A generic instrumental variable approach for industrial robot identification", 2014). Measured
angles stand in the regressors, so estimates are biased by their noise, the more the smaller a motion is (errors in
variables). It therefore decides nothing: it says where fits begin, and what is so far behind that it is not simulated.

With r the missing forces, J what the parameters to estimate add to them, C_k what candidate k adds, all divided by the
standard deviation of each joint's remaining forces,

    min ‖r − J δ − Σ C_k c_k‖² + ‖(θ + δ − θ₀)/s‖²

s is half the way between a parameter's bounds: it is known to be within these. All sums of squares are of one Gram
matrix, so that any set of candidates costs a few small factorisations. What unknown zeros of the sensors can do to the
forces is projected out of r, J and C before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, model_of
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.mjcf_inverse import (
    InverseDynamics,
    MeasuredMotion,
    applies,
    inverse_dynamics,
    law_slopes,
    motions_of,
)
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.identification.noise import noise_of_differences
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array

WIDTHS = (2, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Widths of the test functions that are tried, in samples."""
FLAT = 0.1
"""Wider ones are not tried once ln σ has risen by so much a joint."""
CROSSES = 0.3
"""Longest width, as a share of the time in which the fastest joint crosses its range."""
CORRELATED = 1.5
"""So many test functions a width apart are worth one independent sample: cubic B-splines overlap."""
STEP = 1e-3
"""Of differences, as a share of a parameter's scale."""
WEAK = 1e-10
"""Directions of columns below this share of the strongest count as none."""
ROUGH = ("viscous_friction", "coulomb_friction", "constant_force", "asymmetric_friction", "parallel_spring")
"""Laws that together leave about the noise of joints' forces, whatever is missing."""


@dataclass(frozen=True, eq=False)
class Columns:
    """What a candidate adds to the forces at one choice of the parameters that it is not linear in.

    Attributes:
        candidate: which.
        base: values of all its parameters there.
        scaled: names of those that the columns are of, one each; none where the values are fixed.
        place: of each column in the Gram matrix.
    """

    candidate: Candidate
    base: Mapping[str, float]
    scaled: tuple[str, ...]
    place: tuple[int, ...] = ()

    @property
    def fixed(self) -> bool:
        """Whether the values stay as they are, for no value of the effect is nothing."""
        return not self.scaled

    def _key(self, name: str) -> str:
        return next(own.key for own in self.candidate.parameters if own.name == name)

    def nothing(self, name: str) -> float:
        """The value of a parameter at which the effect does nothing."""
        effect = self.candidate.effect
        if issubclass(effect, ForceEffect):
            return float(effect.neutral[self._key(name)])
        return self.candidate.grows_from()[name]

    def bounds(self, name: str) -> tuple[float, float]:
        """Between what a parameter can be."""
        key = self._key(name)
        info = self.candidate.effect.parameter_info()[key]
        return float(info["low"]), min(float(info["high"]), self.candidate.most.get(key, math.inf))

    def unit(self, name: str) -> float:
        """What a coefficient of 1 changes a parameter by: a law's column is its slope, else the guess's own way."""
        return 1.0 if issubclass(self.candidate.effect, ForceEffect) else self.base[name] - self.nothing(name)

    def values(self, sizes: Sequence[float]) -> dict[str, float]:
        """All parameters, with those that scale the effect at some sizes."""
        return {**self.base, **(dict(zip(self.scaled, sizes, strict=True)) if not self.fixed else {})}


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """What a candidate explains of the missing forces.

    Attributes:
        gain: fall of χ².
        values: of its parameters, by least squares within bounds.
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
        left = [(c, i) for c, own in enumerate(chosen) for i in range(len(own.place))]
        fixed = [own.place[0] for own in chosen if own.fixed]
        left = [(c, i) for c, i in left if not chosen[c].fixed]
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

    def errors(self, chosen: Sequence[Columns]) -> list[Array]:
        """For each of some candidates (k,) standard errors of its sizes."""
        taken = [k for own in chosen for k in own.place]
        spread = np.sqrt(np.maximum(np.diag(_inverse_of(self.beyond[np.ix_(taken, taken)])), 0) * CORRELATED)
        units = np.array([abs(own.unit(name)) for own in chosen for name in own.scaled])
        return np.split(spread * units, np.cumsum([len(own.place) for own in chosen])[:-1])

    def moved(self, chosen: Sequence[Columns]) -> Array:
        """(p,) the parameters that go with some candidates, within bounds."""
        taken = [k for own in chosen for k in own.place]
        _, coefficients = self._least(taken, ())
        p = len(self.theta)
        aim = self.gram[:p, -1] - self.gram[:p, [p + k for k in taken]] @ coefficients
        return np.clip(self.theta + self._inverse @ aim, self.free.low, self.free.high)


def _inverse_of(normal: Array) -> Array:
    """The inverse of a symmetric matrix, 0 along directions in which it is none."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
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
        guesses: further ones of candidates, by their labels, see ``torque_guesses``.
    """

    motions: tuple[MeasuredMotion, ...]
    width: int
    guesses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def interval(self) -> float:
        """Time between samples [s]."""
        return max(motion.interval for motion in self.motions)


@dataclass(frozen=True, eq=False)
class Along:
    """A model's inverse dynamics along measured motions, weighted.

    Attributes:
        motions: what was measured.
        width: of the test functions, in samples.
        at: of each motion.
        counts: (m, nj) what counts.
    """

    motions: Sequence[MeasuredMotion]
    width: int
    at: Sequence[InverseDynamics]
    counts: NDArray[np.bool_]

    @classmethod
    def of(cls, model: Model, motions: Sequence[MeasuredMotion], width: int) -> Along:
        """Those of a model."""
        at = inverse_dynamics(model, motions, width)
        return cls(motions, width, at, np.concatenate([one.counts for one in at]))

    def rows_of(self, values: Sequence[Array]) -> Array:
        """(m, nj) forces at the instants (n, nj) of each motion, weighted; 0 where dry friction may exert anything."""
        whole = np.concatenate([one.weighted(value) for one, value in zip(self.at, values, strict=True)])
        return np.asarray(np.where(self.counts, whole, 0.0))

    def changed(self, other: Model) -> Array:
        """(m, nj) what of the missing forces another model adds."""
        after = inverse_dynamics(other, self.motions, self.width)
        return self.rows_of([one.missing - two.missing for one, two in zip(self.at, after, strict=True)])


def torque_domain(data: Data, pool: Sequence[Candidate]) -> TorqueDomain | None:
    """The torque domain of some recordings; None where a robot has none, or they are too short."""
    if not applies(data.free.model.robot):
        return None
    noise = np.array([own.sigma for own in noise_of_differences([s.measured for s in data.segments])])
    trials, measured, zeros = zip(*((s.trial, s.measured, s.zeros) for s in data.segments), strict=True)
    motions = motions_of(trials, measured, noise, zeros)
    longest = max(len(m.time) for m in motions)
    motions = [m for m in motions if len(m.time) > max(longest / 2, 10 * WIDTHS[0])]
    if not motions:
        return None
    rough = [c for c in pool if c.effect.name in ROUGH and len(c.locations) == 1]
    return TorqueDomain(tuple(motions), _width(data.free, data.free.start, motions, rough))


def torque_screen(data: Data, domain: TorqueDomain, fitted: Fitted | None, pool: Sequence[Candidate]) -> TorqueScreen:
    """What candidates explain of the missing forces of the nominal model, or of a fitted hypothesis.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        fitted: the hypothesis; the nominal model by default.
        pool: the candidates.
    """
    free = data.free if fitted is None else fitted.fit.parameters
    theta = free.start if fitted is None else fitted.fit.theta
    return _screen(free, theta, data.free, domain, pool, data.budget.check)


def _width(free: FreeParameters, theta: Array, motions: Sequence[MeasuredMotion], rough: Sequence[Candidate]) -> int:
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
        sigma = columns_of(free, theta, motions, width, rough, lambda: None)[3]
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
    found, columns, counts, sigma = columns_of(free, theta, domain.motions, domain.width, pool, check, domain.guesses)
    p = len(theta)
    scaled = (columns / sigma[:, None]).reshape(-1, columns.shape[2])
    gram = scaled.T @ scaled
    known = np.arange(p) < len(own_free.free)
    prior = np.where(known, 4.0 / (free.high - free.low) ** 2, 0.0)
    away = np.append(own_free.start, theta[len(own_free.free) :]) - theta
    gram[range(p), range(p)] += prior
    gram[:p, -1] += prior * away
    gram[-1, :p] += prior * away
    gram[-1, -1] += float(prior @ away**2)
    return TorqueScreen(free, theta, tuple(found), gram, float(counts.sum()) / CORRELATED, free.model.robot, sigma)


def columns_of(
    free: FreeParameters, theta: Array, motions: Sequence[MeasuredMotion], width: int, pool: Sequence[Candidate],
    check: Callable[[], None], guesses: Mapping[str, Mapping[str, float]] | None = None,
) -> tuple[list[Columns], Array, NDArray[np.bool_], Array]:  # fmt: skip
    """Candidates, (m, nj, p + k + 1) [J, C, r], (m, nj) what counts, (nj,) standard deviations of what remains."""
    model = free.model_at(theta)
    along = Along.of(model, motions, width)
    at, counts, rows_of, changed = along.at, along.counts, along.rows_of, along.changed
    slopes = []
    for i, own in enumerate(free.free):
        check()
        step = STEP * own.scale * (1.0 if theta[i] + STEP * own.scale <= own.high else -1.0)
        slopes.append(changed(free.model_at(theta + step * np.eye(len(theta))[i])) / step)
    singles = _Singles(model, at, rows_of, changed)
    found: list[Columns] = []
    forces: list[Array] = []
    present = {(type(effect), effect.location) for effect in model.effects}
    for candidate in pool:
        check()
        if any((candidate.effect, place) in present for place in candidate.locations):
            continue
        further = [guesses[candidate.label]] if guesses and candidate.label in guesses else []
        for seen, columns in singles.of(candidate, further):
            found.append(replace(seen, place=tuple(range(len(forces), len(forces) + len(columns)))))
            forces += columns
    missing = rows_of([one.missing for one in at])
    whole = np.stack([*slopes, *forces, missing], axis=-1)
    if zeros := [rows_of(change) for change in _by_zeros(model, motions, at, width)]:
        beside = Nuisance.of(np.stack(zeros, axis=-1).reshape(-1, len(zeros)))
        whole = beside.project_out(whole.reshape(-1, whole.shape[2])).reshape(whole.shape)
    return found, whole, counts, _remaining(whole, len(slopes), found, counts)


def _by_zeros(
    model: Model, motions: Sequence[MeasuredMotion], at: Sequence[InverseDynamics], width: int
) -> Iterator[list[Array]]:
    """For each unknown zero the change of the missing forces (n, nj) of each motion by it."""
    for k, motion in enumerate(motions):
        for j in motion.zeros:
            step = STEP * float(np.ptp(motion.position[:, j]))
            moved = replace(motion, position=motion.position - step * np.eye(len(motion.noise))[j])
            (after,) = inverse_dynamics(model, [moved], width)
            change = [np.zeros_like(one.missing) for one in at]
            change[k] = (after.missing - at[k].missing) / step
            yield change


def _only(j: int, values: Array, count: int) -> Array:
    whole = np.zeros((len(values), count))
    whole[:, j] = values
    return whole


def _is_linear(effect: type[ForceEffect]) -> bool:
    """Whether a law has no states and is linear in the parameters that switch it off."""
    if effect.n_states:
        return False
    x, rate, load = ca.SX.sym("x"), ca.SX.sym("rate"), ca.SX.sym("load")
    p = {key: ca.SX.sym(key) for key in effect.parameter_info()}
    chosen = ca.vertcat(*(p[key] for key in effect.neutral))
    slope = ca.jacobian(effect.sliding_force(x, rate, [], load, p), chosen)
    return not ca.depends_on(slope, chosen)


class _Singles:
    """What effects at single places add to the forces; at several places it is the sum of these, to first order.

    Args:
        model: that lacks them.
        at: its inverse dynamics.
        rows_of: weighs forces (n, nj) of each motion.
        changed: what of the missing forces another model adds.
    """

    def __init__(
        self,
        model: Model,
        at: Sequence[InverseDynamics],
        rows_of: Callable[[Sequence[Array]], Array],
        changed: Callable[[Model], Array],
    ) -> None:
        self.model, self.at, self.rows_of, self.changed = model, at, rows_of, changed
        self._known: dict[tuple[type[Effect], str, tuple[float, ...]], Mapping[str, Array] | None] = {}

    def of(
        self, candidate: Candidate, further: Sequence[Mapping[str, float]] = ()
    ) -> Iterator[tuple[Columns, list[Array]]]:
        """A candidate's columns at each choice of the parameters that it is not linear in; none that is not seen.

        Args:
            candidate: which.
            further: guesses beside its own.
        """
        effect = candidate.effect
        if not effect.in_torques or (issubclass(effect, ForceEffect) and not _is_linear(effect)):
            return
        scaled = (
            effect.neutral if issubclass(effect, ForceEffect) else candidate.alone(candidate.locations[0]).grows_from()
        )
        seen = set()
        for guess in (*_tried(candidate), *further):
            others = tuple(guess[own.name] for own in candidate.parameters if own.key not in scaled)
            if scaled and not effect.delays and others in seen:  # linear in its size
                continue
            seen.add(others)
            by_place = {place: self._single(effect, place, candidate.at(guess, place)) for place in candidate.locations}
            if any(own is None for own in by_place.values()):
                continue
            if not scaled:
                yield Columns(candidate, guess, ()), [_sum(one[""] for one in by_place.values() if one)]
                continue
            names = [own for own in candidate.parameters if own.key in scaled]
            columns = [_sum(one[own.key] for place in own.places if (one := by_place[place])) for own in names]
            base = guess
            if issubclass(effect, ForceEffect):
                base = {own.name: effect.neutral.get(own.key, guess[own.name]) for own in candidate.parameters}
            yield Columns(candidate, base, tuple(own.name for own in names)), columns

    def _single(self, effect: type[Effect], place: str, values: Mapping[str, float]) -> Mapping[str, Array] | None:
        """For each parameter that scales an effect (m, nj) its column; None where the robot cannot have it."""
        key = (effect, place, tuple(values.values()))
        if key not in self._known:
            self._known[key] = (
                self._law(effect, place, values)
                if issubclass(effect, ForceEffect)
                else (self._change(effect, place, values))
            )
        return self._known[key]

    def _law(self, effect: type[ForceEffect], place: str, values: Mapping[str, float]) -> Mapping[str, Array]:
        joints, keys = self.model.robot.joint_names, list(effect.parameter_info())
        j = joints.index(place)
        of = [law_slopes(effect, values, o.position[:, j], o.rate[:, j], o.drives[:, j]) for o in self.at]
        return {
            key: self.rows_of([_only(j, slope[:, keys.index(key)], len(joints)) for slope in of])
            for key in keys
            if key in effect.neutral
        }

    def _change(self, effect: type[Effect], place: str, values: Mapping[str, float]) -> Mapping[str, Array] | None:
        single = Candidate(effect, (place,), (values,))
        try:
            change = self.changed(model_of(self.model, (Part(single, values),)))
        except (ConfigError, ModelError):
            return None
        return dict.fromkeys(single.grows_from() or {"": 0.0}, change)


def _sum(columns: Iterable[Array]) -> Array:
    return np.asarray(sum(columns))


def _tried(candidate: Candidate) -> Sequence[Mapping[str, float]]:
    """The guesses that are evaluated: of delays, in which forces bend, two."""
    guesses = candidate.guesses
    return guesses[:: max(len(guesses) // 2, 1)][:2] if candidate.effect.delays else guesses


def _remaining(columns: Array, p: int, found: Sequence[Columns], counts: NDArray[np.bool_]) -> Array:
    """(nj,) standard deviation of each joint's forces that the parameters and the usual laws leave."""
    rough = [k for own in found if own.candidate.effect.name in ROUGH for k in own.place]
    sigma = np.sqrt(np.maximum((columns[:, :, -1] ** 2).sum(axis=0) / np.maximum(counts.sum(axis=0), 1), 1e-300))
    for _ in range(2):
        whole = columns[:, :, [*range(p), *(p + k for k in dict.fromkeys(rough))]] / sigma[:, None]
        whole = whole.reshape(-1, whole.shape[2])
        size = np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
        target = (columns[:, :, -1] / sigma).ravel()
        fitted = whole @ (np.linalg.lstsq(whole / size, target, rcond=1e-6)[0] / size)
        left = (target - fitted).reshape(counts.shape) * sigma
        own = np.sqrt((left**2).sum(axis=0) / np.maximum(counts.sum(axis=0), 1))
        sigma = np.maximum(own, 1e-3 * sigma)
    return np.asarray(sigma)
