"""What the parameters, and each candidate, add to the forces that a model lacks along measured motions.

To first order in the parameters and in the sizes of laws. At several places a candidate adds the sum of what it adds at
each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, model_of
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.mjcf_inverse import InverseDynamics, MeasuredMotion, inverse_dynamics, law_slopes
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

STEP = 1e-3
"""Of differences, as a share of a parameter's scale, or of what a joint covers."""
DRIVE_GAINS = ("kp", "gain")
"""Parameters by which all that a drive exerts grows, the part of the positions' noise in it too. They are held: least
squares would shrink them, and all other forces along, for nothing leaves less than no force at all."""
USUAL_LAWS = ("viscous_friction", "coulomb_friction", "constant_force", "asymmetric_friction", "parallel_spring")
"""Laws that real joints have most: beside them what is left of joints' forces is taken for noise."""


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
        """Whether it has no size to scale: it is taken at its guess or not at all."""
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
        low, high = float(info["low"]), float(info["high"])
        return max(low, self.candidate.least.get(key, low)), min(high, self.candidate.most.get(key, high))

    def unit(self, name: str) -> float:
        """What a coefficient of 1 changes a parameter by: a law's column is its slope, else the guess's own way."""
        return 1.0 if issubclass(self.candidate.effect, ForceEffect) else self.base[name] - self.nothing(name)

    def values(self, sizes: Sequence[float]) -> dict[str, float]:
        """All parameters, with those that scale the effect at some sizes."""
        return {**self.base, **dict(zip(self.scaled, sizes, strict=True))}


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


def usual_laws(pool: Sequence[Candidate]) -> list[Candidate]:
    """The usual laws among candidates, each at one joint alone and in all trials."""
    return [c for c in pool if c.effect.name in USUAL_LAWS and len(c.locations) == 1 and not c.absent]


def columns_of(
    free: FreeParameters, theta: Array, motions: Sequence[MeasuredMotion], width: int, pool: Sequence[Candidate],
    check: Callable[[], None], guesses: Mapping[str, Mapping[str, float]] | None = None, groups: Sequence[str] = (),
) -> tuple[list[Columns], Array, NDArray[np.bool_], Array]:  # fmt: skip
    """What the parameters and candidates add to the missing forces.

    Args:
        free: the parameters.
        theta: (p,) where they are.
        motions: what was measured.
        width: of the test functions, in samples.
        pool: the candidates.
        check: called between them, to end where a budget is spent.
        guesses: further ones, by candidates' labels.
        groups: the group of trials of each motion, where candidates may be absent in some.

    Returns:
        The candidates that can be seen; (m, nj, p + k + 1) [J, C, r] at m test functions; (m, nj) what of them counts;
        (nj,) standard deviations of what the parameters and the usual laws leave.
    """
    model = free.model_at(theta)
    along = Along.of(model, motions, width)
    at, counts, rows_of, changed = along.at, along.counts, along.rows_of, along.changed
    slopes = []
    for i, own in enumerate(free.free):
        check()
        if own.name.rpartition(".")[2] in DRIVE_GAINS:
            slopes.append(np.zeros(counts.shape))
            continue
        step = STEP * own.scale * (1.0 if theta[i] + STEP * own.scale <= own.high else -1.0)
        slopes.append(changed(free.model_at(theta + step * np.eye(len(theta))[i])) / step)
    single = _singles(model, along)
    found: list[Columns] = []
    forces: list[Array] = []
    present = {(type(effect), effect.location) for effect in model.effects}
    for candidate in pool:
        check()
        if any((candidate.effect, place) in present for place in candidate.locations):
            continue
        further = [guesses[candidate.label]] if guesses and candidate.label in guesses else []
        for seen, columns in _columns(candidate, single, further):
            if candidate.absent:
                here = np.repeat([group not in candidate.absent for group in groups], [len(one.counts) for one in at])
                columns = [np.where(here[:, None], column, 0.0) for column in columns]
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
            step = max(STEP * float(np.ptp(motion.position[:, j])), float(motion.noise[j]))
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
    """Whether a law is linear in the parameters that switch it off, and its states do not depend on them."""
    x, rate, load, time = (ca.SX.sym(name) for name in ("x", "rate", "load", "time"))
    p = {key: ca.SX.sym(key) for key in effect.parameter_info()}
    z = [ca.SX.sym(f"z{k}") for k in range(effect.n_states)]
    chosen = ca.vertcat(*(p[key] for key in effect.neutral))
    states = ca.vertcat(*effect.state_rate(x, rate, z, p), *effect.start_state(x, rate, time, p), ca.SX(0, 1))
    slope = ca.jacobian(effect.sliding_force(x, rate, z, load, p), chosen)
    return not ca.depends_on(ca.vertcat(ca.vec(slope), states), chosen)


Single = Callable[..., "Mapping[str, Array] | None"]
"""What an effect at a single place adds to the forces, by its class, the place and pairs of a parameter and its value;
None where the robot cannot have it."""


def _singles(model: Model, along: Along) -> Single:
    """What effects at single places add to a model's forces, each worked out once."""

    @cache
    def single(effect: type[Effect], place: str, values: tuple[tuple[str, float], ...]) -> Mapping[str, Array] | None:
        if issubclass(effect, ForceEffect):
            return _law(model, along, effect, place, dict(values))
        return _change(model, along, effect, place, dict(values))

    return single


def _law(
    model: Model, along: Along, effect: type[ForceEffect], place: str, values: Mapping[str, float]
) -> Mapping[str, Array]:
    """For each parameter that switches a law off (m, nj) the slope of the forces by it."""
    joints, keys = model.robot.joint_names, list(effect.parameter_info())
    j = joints.index(place)
    of = [law_slopes(effect, values, o.position[:, j], o.rate[:, j], o.drives[:, j], o.time) for o in along.at]
    return {
        key: along.rows_of([_only(j, slope[:, keys.index(key)], len(joints)) for slope in of])
        for key in keys
        if key in effect.neutral
    }


def _change(
    model: Model, along: Along, effect: type[Effect], place: str, values: Mapping[str, float]
) -> Mapping[str, Array] | None:
    """For the parameter that scales an effect (m, nj) the change of the forces by these values."""
    single = Candidate(effect, (place,), (values,))
    try:
        change = along.changed(model_of(model, (Part(single, values),)))
    except (ConfigError, ModelError):
        return None
    return dict.fromkeys(single.grows_from() or {"": 0.0}, change)


def _columns(
    candidate: Candidate, single: Single, further: Sequence[Mapping[str, float]] = ()
) -> Iterator[tuple[Columns, list[Array]]]:
    """A candidate's columns at each choice of the parameters that it is not linear in; none that is not seen.

    At several places it adds the sum of what it adds at each, to first order.

    Args:
        candidate: which.
        single: what effects at single places add.
        further: guesses beside its own.
    """
    effect = candidate.effect
    if not effect.in_torques or (issubclass(effect, ForceEffect) and not _is_linear(effect)):
        return
    scaled = effect.neutral if issubclass(effect, ForceEffect) else candidate.alone(candidate.locations[0]).grows_from()
    seen = set()
    for guess in (*_tried(candidate), *further):
        others = tuple(guess[own.name] for own in candidate.parameters if own.key not in scaled)
        if scaled and not effect.delays and others in seen:  # linear in its size
            continue
        seen.add(others)
        by_place = {
            place: single(effect, place, tuple(candidate.at(guess, place).items())) for place in candidate.locations
        }
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


def _sum(columns: Iterable[Array]) -> Array:
    return np.asarray(sum(columns))


def _tried(candidate: Candidate) -> Sequence[Mapping[str, float]]:
    """The guesses that are evaluated: of delays, in which forces bend, two."""
    guesses = candidate.guesses
    return guesses[:: max(len(guesses) // 2, 1)][:2] if candidate.effect.delays else guesses


def _remaining(columns: Array, p: int, found: Sequence[Columns], counts: NDArray[np.bool_]) -> Array:
    """(nj,) standard deviation of each joint's forces that the parameters and the usual laws leave."""
    usual = [k for own in found if own.candidate.effect.name in USUAL_LAWS for k in own.place]
    sigma = np.sqrt(np.maximum((columns[:, :, -1] ** 2).sum(axis=0) / np.maximum(counts.sum(axis=0), 1), 1e-300))
    for _ in range(2):
        whole = columns[:, :, [*range(p), *(p + k for k in dict.fromkeys(usual))]] / sigma[:, None]
        whole = whole.reshape(-1, whole.shape[2])
        size = np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
        target = (columns[:, :, -1] / sigma).ravel()
        fitted = whole @ (np.linalg.lstsq(whole / size, target, rcond=1e-6)[0] / size)
        left = (target - fitted).reshape(counts.shape) * sigma
        own = np.sqrt((left**2).sum(axis=0) / np.maximum(counts.sum(axis=0), 1))
        sigma = np.maximum(own, 1e-3 * sigma)
    return np.asarray(sigma)
