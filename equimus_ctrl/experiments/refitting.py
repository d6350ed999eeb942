"""By how much a trial would favour one rival over another, all free numbers of the other refitted.

What is to first order in ``separation`` is solved as it is:

    c(θ) = ‖W(y − yⱼ(θ))‖² + (θ − θ̂)ᵀA(θ − θ̂),    low ≤ θ ≤ high,

y being what the true rival predicts without noise, θ̂ and A what the recordings so far say of the other. Free numbers of
starts are eliminated to first order. It is a bounded least-squares problem for a trust region (Branch, Coleman & Li
1999), begun at the best of θ̂ and where the first order leads. Many refits are made side by side, see ``together``: what
they ask for at once is one batch of simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares

from equimus_ctrl.diagnosis.rivals import Rival, Rivals
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.experiments.starts import Starts
from equimus_ctrl.experiments.together import together
from equimus_ctrl.identification.noise import Noise, drawn_noise, estimate_noise, log_likelihood, whiten
from equimus_ctrl.identification.residuals import DIVERGED, difference
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

EVALUATIONS = 20
"""Most steps of a refit."""
TOLERANCE = 1e-3
"""Of its cost and ``BESIDE``, relative: a gap is wanted to a few per cent."""
NOTHING_LEFT = 0.5
"""A cost below leaves nothing that could be taken for noise."""
BESIDE = 10.0
"""A gap counts beside what a diagnosis asks for, 10 or more: a cost far below need not be known to a part of itself."""
EXACT = TOLERANCE * BESIDE
"""To this a gap is known that is nothing."""
LEVEL = 1e-9
"""Of a cost's slope: where it is 0 the method's step is 0/0."""


@dataclass(frozen=True, eq=False, repr=False)
class Refit(Short):
    """A rival refitted to what another predicts of a trial.

    Attributes:
        cost: c at its minimum, −2Δln L in favour of the other, which fits perfectly.
        earlier: what of it is by the recordings so far, (θ − θ̂)ᵀA(θ − θ̂).
        theta: (p,) there [unit of each].
        converged: whether the search ended by itself.
        left: for each segment (m, nc) what it leaves unexplained there, without noise [rad, m or a channel's own unit].
    """

    cost: float
    earlier: float
    theta: Array
    converged: bool
    left: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Target:
    """What a true robot would show in a trial, without noise.

    Attributes:
        segments: as a diagnosis would cut its recording.
        values: for each (m, nc) [rad, m or a channel's own unit].
        starts: free numbers of starts, to be eliminated.
        simulator: that simulates.
        by: step of differences.
    """

    segments: tuple[Segment, ...]
    values: tuple[Array, ...]
    starts: Starts
    simulator: Simulator
    by: float

    @classmethod
    def of(cls, rivals: Rivals, truth: Model, segments: Sequence[Segment], simulator: Simulator) -> Target:
        """What ``truth`` shows from the segments' starts, and how that changes with these."""
        by, most = difference(truth, simulator), max(len(s.free_at) for s in segments)
        starts = []
        for segment in segments:
            rows, free = np.tile(segment.start, (1 + most, 1)), segment.free_at
            rows[1 + np.arange(len(free)), free] += by
            starts.append(rows)
        found = simulator([truth] * (1 + most), segments, starts)
        slopes = [
            np.moveaxis((own.position[1:] - own.position[0]) / by, 0, -1)[..., : len(s.free_at)]
            for s, own in zip(segments, found, strict=True)
        ]
        values = tuple(own.position[0] for own in found)
        return cls(tuple(segments), values, Starts.of(rivals.noise, segments, slopes), simulator, by)

    @property
    def times(self) -> list[Array]:
        """For each segment (m,) [s]."""
        return [segment.trial.sample_times for segment in self.segments]

    @property
    def alone(self) -> bool:
        """Whether what is simulated depends on what was recorded, so that no other target's refits share its batch."""
        return any(segment.trial.recorded is not None for segment in self.segments)

    def residuals(self, models: Sequence[Model]) -> Array:
        """(N, k) whitened, the starts eliminated; large where a simulation diverges, and finite."""
        (found,) = residuals_of([(self, models)])
        return found

    def away(self, found: Sequence[Predicted]) -> Array:
        """The same of models' simulations."""
        rows = []
        for k, own in enumerate(found):
            lost = np.arange(own.position.shape[1]) >= own.reached[:, None]
            away = np.where(lost[..., None], DIVERGED, np.clip(self.values[k] - own.position, -DIVERGED, DIVERGED))
            rows.append(self.starts.reduced(k, np.moveaxis(away, 0, -1)))
        return np.concatenate(rows)

    def left(self, found: Sequence[Predicted]) -> tuple[Array, ...]:
        """For each segment (m, nc) what a model's simulations leave of the values, the best starts to first order."""
        return tuple(self.starts.left(k, self.values[k] - own.position[0]) for k, own in enumerate(found))


Wanted = Sequence[tuple[Target, Sequence[Model]]]
"""Targets of one trial, whatever is the truth there, and models to be simulated in each."""


def residuals_of(wanted: Wanted) -> list[Array]:
    """For each target and models (N, k), see ``Target.residuals``; as few batches as there can be."""
    found = _simulated(wanted)
    return [target.away(own) for (target, _), own in zip(wanted, found, strict=True)]


def _simulated(wanted: Wanted) -> list[list[Predicted]]:
    """For each target and models their simulations on its segments."""
    found: list[list[Predicted]] = [[]] * len(wanted)
    batches = dict[int, list[int]]()
    for place, (target, _) in enumerate(wanted):
        batches.setdefault(id(target) if target.alone else 0, []).append(place)
    for places in batches.values():
        first = wanted[places[0]][0]
        models = [model for place in places for model in wanted[place][1]]
        starts = [
            np.concatenate([np.tile(wanted[p][0].segments[k].start, (len(wanted[p][1]), 1)) for p in places])
            for k in range(len(first.segments))
        ]
        predicted = first.simulator(models, first.segments, starts)
        begin = 0
        for place in places:
            rows = slice(begin, begin + len(wanted[place][1]))
            found[place] = [Predicted(one.position[rows], one.reached[rows]) for one in predicted]
            begin = rows.stop
    return found


@dataclass(frozen=True, eq=False)
class Task:
    """A refit to be made.

    Attributes:
        rival: that is refitted.
        target: to what.
        begins: (p,) other values than its estimates at which it may begin; the best counts.
    """

    rival: Rival
    target: Target
    begins: Sequence[Array] = field(default_factory=tuple)


def refitted(rival: Rival, target: Target, begins: Sequence[Array] = ()) -> Refit:
    """A rival refitted to what another shows, from the better of its estimates and other values (p,)."""
    return refitted_all([Task(rival, target, begins)])[0]


def refitted_all(tasks: Sequence[Task]) -> list[Refit]:
    """Rivals refitted side by side to what others show in one trial."""

    def answered(asked: Sequence[tuple[int, Sequence[Model]]]) -> list[Array]:
        return residuals_of([(tasks[place].target, models) for place, models in asked])

    found = together([_refit_of(task) for task in tasks], answered)
    ends = _simulated([(task.target, [task.rival.model_at(own[2])]) for task, own in zip(tasks, found, strict=True)])
    return [Refit(*own, task.target.left(end)) for task, own, end in zip(tasks, found, ends, strict=True)]


Residuals = Callable[[Sequence[Model]], Array]


def _refit_of(task: Task) -> Callable[[Residuals], tuple[float, float, Array, bool]]:
    """(cost, that so far, (p,) values, whether it converged) by a function that is given the target's residuals."""
    rival, by = task.rival, task.target.by
    free = rival.parameters
    root = np.linalg.cholesky(rival.precision).T
    low, high = free.low / free.scale, free.high / free.scale
    own = rival.theta / free.scale

    def refit(residuals: Residuals) -> tuple[float, float, Array, bool]:
        def whole(points: Sequence[Array]) -> Array:
            """(N + p + 1, k) at points (p,) in units of the scale."""
            rows = residuals([rival.model_at(free.at(point)) for point in points])
            beside = np.full((1, len(points)), np.sqrt(BESIDE))
            return np.vstack([rows, np.column_stack([root @ (point - own) for point in points]), beside])

        def slopes(point: Array) -> Array:
            steps = by * np.where(point + by <= high, 1.0, -1.0)
            found = whole([point, *(point + np.diag(steps))])
            return np.asarray((found[:, 1:] - found[:, :1]) / steps)

        inside = [np.clip(theta / free.scale, low, high) for theta in (rival.theta, *task.begins)]
        first = inside[int(np.argmin((whole(inside) ** 2).sum(axis=0)))]
        # The method asks for a beginning within the bounds, not on them.
        first = np.clip(first, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
        found = least_squares(
            lambda point: whole([point])[:, 0], first, jac=slopes, bounds=(low, high), ftol=TOLERANCE, xtol=TOLERANCE,
            gtol=LEVEL, max_nfev=EVALUATIONS,
        )  # fmt: skip
        cost, earlier = max(2.0 * float(found.cost) - BESIDE, 0.0), float(((root @ (found.x - own)) ** 2).sum())
        return cost, min(earlier, cost), free.at(found.x), bool(found.status > 0)

    return refit


class NoiseScale:
    """By how much −2 ln L falls where the noise is estimated along with a refit, as diagnoses do.

    What a rival leaves unexplained is then taken for noise, more and correlated, as far as that is more likely. So
    ln L falls by far less than under the noise that there is, where much is left. Residuals of what has been measured
    so far are drawn for either rival by the noise that they have, and noise for the trial; with it, and with what is
    left, the noise is estimated anew. Recordings are not kept: what they lose by a refit is taken to look like what is
    left in the trial, so that noise takes it up alike. Of what is left the mean over both its signs counts: what it has
    in common with the noise by chance, 2√G ξ, is no part of G.

    Args:
        rivals: of which one is true.
    """

    def __init__(self, rivals: Rivals) -> None:
        self.rivals = rivals
        count = max(round(rivals.n / len(rivals.noise)), 2)
        self._earlier = np.arange(count) / rivals.rate
        self._before: dict[tuple[Noise, int], tuple[Array, float]] = {}
        self._true: dict[tuple[int, int], float] = {}

    def seen(self, first: int, second: int, number: int, times: Sequence[Array], refit: Refit) -> float:
        """−2Δln L of the refit of a rival; no more than under the noise that there is.

        Args:
            first: the true one.
            second: the one that was refitted.
            number: by which noise is drawn, the same for the same.
            times: for each segment of the trial (m,) [s].
            refit: of the second.
        """
        if refit.cost < NOTHING_LEFT:
            return refit.cost
        return min(self.estimated(first, second, number, times, refit.left, refit.earlier), refit.cost)

    def estimated(
        self, first: int, second: int, number: int, times: Sequence[Array], left: Sequence[Array], earlier: float = 0.0
    ) -> float:
        """The same of what the second leaves, for each segment (m, nc), and loses so far, whatever its cost."""
        rng, nc = np.random.default_rng(number), len(self.rivals.noise)
        normal = rng.standard_normal((2, len(self._earlier), nc))
        new = [drawn_noise(self.rivals.noise, time, rng.standard_normal((2, len(time), nc))) for time in times]
        if (first, number) not in self._true:
            self._true[first, number] = self._more(self.rivals.rivals[first], number, normal, times, new, 0.0)
        other, before = self.rivals.rivals[second], self._like(left, earlier)
        either = [
            self._more(
                other, number, normal, times, [n + sign * e for n, e in zip(new, left, strict=True)], sign * before
            )
            for sign in (1.0, -1.0)
        ]
        return float(np.mean(either)) - self._true[first, number]

    def _like(self, left: Sequence[Array], earlier: float) -> Array:
        """(m, nc) what is left in a trial, repeated over the recordings so far, as large as costs so much there."""
        whole = np.resize(np.concatenate(left), (len(self._earlier), len(self.rivals.noise)))
        cost = float((whiten(self.rivals.noise, self._earlier, whole[..., None]) ** 2).sum())
        return np.asarray(whole * np.sqrt(earlier / cost) if cost else whole)

    def _more(
        self,
        rival: Rival,
        number: int,
        normal: Array,
        times: Sequence[Array],
        trial: Sequence[Array],
        earlier: Array | float,
    ) -> float:
        """By how much −2 ln L grows with the trial, and what is left more of the recordings so far."""
        key = rival.noise, number
        if key not in self._before:
            before = drawn_noise(rival.noise, self._earlier, normal)
            self._before[key] = before, _deviance([self._earlier], [before])
        before, so_far = self._before[key]
        return _deviance([self._earlier, *times], [before + earlier, *trial]) - so_far


def _deviance(times: Sequence[Array], residuals: Sequence[Array]) -> float:
    """−2 log likelihood under the noise that is most likely."""
    return -2.0 * log_likelihood(estimate_noise(times, residuals), times, residuals)
