"""By how much a trial would favour one rival over another, all free numbers of the other refitted.

What is to first order in ``separation`` is solved as it is:

    c(θ) = ‖W(y − yⱼ(θ))‖² + (θ − θ̂)ᵀA(θ − θ̂),    low ≤ θ ≤ high,

y being what the true rival predicts without noise, θ̂ and A what the recordings so far say of the other. Free numbers of
starts are eliminated to first order. It is a bounded least-squares problem for a trust region (Branch, Coleman & Li
1999), begun at the better of θ̂ and where the first order leads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from equimus_ctrl.diagnosis.rivals import Rival, Rivals
from equimus_ctrl.experiments.separation import Starts
from equimus_ctrl.identification.noise import drawn_noise, estimate_noise, log_likelihood
from equimus_ctrl.identification.residuals import DIVERGED, difference
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

EVALUATIONS = 20
"""Most steps of a refit."""
TOLERANCE = 1e-3
"""Of its cost, relative: a gap is wanted to a few per cent."""


@dataclass(frozen=True, eq=False, repr=False)
class Refit(Short):
    """A rival refitted to what another predicts of a trial.

    Attributes:
        cost: c at its minimum, −2Δln L in favour of the other, which fits perfectly.
        theta: (p,) there [unit of each].
        converged: whether the search ended by itself.
        left: for each segment (m, nc) what it leaves unexplained there, without noise [rad, m or a channel's own unit].
    """

    cost: float
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

    def residuals(self, models: Sequence[Model]) -> Array:
        """(N, k) whitened, the starts eliminated; large where a simulation diverges, and finite."""
        starts = [np.tile(s.start, (len(models), 1)) for s in self.segments]
        rows = []
        for k, own in enumerate(self.simulator(models, self.segments, starts)):
            lost = np.arange(own.position.shape[1]) >= own.reached[:, None]
            away = np.where(lost[..., None], DIVERGED, np.clip(self.values[k] - own.position, -DIVERGED, DIVERGED))
            rows.append(self.starts.reduced(k, np.moveaxis(away, 0, -1)))
        return np.concatenate(rows)

    def left(self, model: Model) -> tuple[Array, ...]:
        """For each segment (m, nc) what a model leaves of the values, the best starts to first order."""
        found = self.simulator([model], self.segments, [s.start[None] for s in self.segments])
        return tuple(self.starts.left(k, self.values[k] - own.position[0]) for k, own in enumerate(found))


def refitted(rival: Rival, target: Target, begins: Sequence[Array] = ()) -> Refit:
    """A rival refitted to what another shows, from the better of its estimates and other values (p,)."""
    free = rival.parameters
    root = np.linalg.cholesky(rival.precision).T
    low, high = free.low / free.scale, free.high / free.scale
    own = rival.theta / free.scale

    def whole(points: Sequence[Array]) -> Array:
        """(N + p, k) at points (p,) in units of the scale."""
        rows = target.residuals([rival.model_at(point * free.scale) for point in points])
        return np.vstack([rows, np.column_stack([root @ (point - own) for point in points])])

    def slopes(point: Array) -> Array:
        steps = target.by * np.where(point + target.by <= high, 1.0, -1.0)
        found = whole([point, *(point + np.diag(steps))])
        return np.asarray((found[:, 1:] - found[:, :1]) / steps)

    inside = [np.clip(theta / free.scale, low, high) for theta in (rival.theta, *begins)]
    first = inside[int(np.argmin((whole(inside) ** 2).sum(axis=0)))]
    # The method asks for a beginning within the bounds, not on them.
    first = np.clip(first, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    found = least_squares(
        lambda point: whole([point])[:, 0], first, jac=slopes, bounds=(low, high), ftol=TOLERANCE, xtol=TOLERANCE,
        gtol=None, max_nfev=EVALUATIONS,
    )  # fmt: skip
    theta = np.asarray(found.x * free.scale)
    return Refit(2.0 * float(found.cost), theta, bool(found.status > 0), target.left(rival.model_at(theta)))


def as_estimated(
    rivals: Rivals, first: int, second: int, times: Sequence[Array], left: Sequence[Array], rng: np.random.Generator
) -> float:
    """−2Δln L of a refit where the noise is estimated along with it, as diagnoses do.

    What a rival leaves unexplained is then taken for noise, more and correlated, as far as that is more likely. So
    ln L falls by far less than under the noise that there is, where much is left. Residuals of what has been measured
    so far are drawn for either rival by the noise that they have, and noise for the trial; with it, and with what is
    left, the noise is estimated anew.

    Args:
        rivals: of which one is true.
        first: that one.
        second: the one that was refitted.
        times: for each segment of the trial (m,) [s].
        left: for each (m, nc) by the second, see ``Refit.left``.
        rng: by which noise is drawn.
    """
    earlier = np.arange(max(round(rivals.n / len(rivals.noise)), 2)) / rivals.rate
    normal = rng.standard_normal((2, len(earlier), len(rivals.noise)))
    new = [drawn_noise(rivals.noise, time, rng.standard_normal((2, len(time), len(rivals.noise)))) for time in times]

    def more(rival: Rival, trial: Sequence[Array]) -> float:
        """By how much −2 ln L grows with the trial."""
        before = drawn_noise(rival.noise, earlier, normal)
        whole = _deviance([earlier, *times], [before, *trial])
        return whole - _deviance([earlier], [before])

    with_left = [own + beside for own, beside in zip(new, left, strict=True)]
    return more(rivals.rivals[second], with_left) - more(rivals.rivals[first], new)


def _deviance(times: Sequence[Array], residuals: Sequence[Array]) -> float:
    """−2 log likelihood under the noise that is most likely."""
    return -2.0 * log_likelihood(estimate_noise(times, residuals), times, residuals)
