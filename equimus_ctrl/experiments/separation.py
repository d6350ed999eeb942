"""What rivals predict of trials that nobody has made yet, and how far they are apart there.

A trial is simulated with one rival as the truth, and cut as a diagnosis cuts recordings. On what comes of it all rivals
are simulated, with their derivatives by all that is free. With d = W(yᵢ − yⱼ) the whitened difference of two
predictions and U = W ∂y/∂z their derivatives by what is free in units of what is not known of it, θ = θ̂ + scale·L z
with LLᵀ the covariance by the recordings so far (``Rival.spread``), the trial would favour rival i by

    Gᵢⱼ = min over z of ‖d − Uⱼz‖² + ‖z‖² = dᵀ(I + UⱼUⱼᵀ)⁻¹d

in −2Δln L where i is true and all free numbers of j are refitted (T-optimality: Atkinson & Fedorov 1975, Biometrika 62,
57). What i predicts is not sure itself; designs are compared by the distance over the uncertainty of both predictions
(Buzzi-Ferraris & Forzatti 1983, Chem. Eng. Sci. 38, 225), which is never larger:

    Ḡᵢⱼ = dᵀ(I + UᵢUᵢᵀ + UⱼUⱼᵀ)⁻¹d

Both come from the Gram matrix of [d, U] by Woodbury's identity: no matrix has as many rows and columns as there are
samples. The free numbers of starts are eliminated before, with the prior that they have in fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.diagnosis.rivals import Rival, Rivals
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.experiments.predicted import Commands, predicted_trials
from equimus_ctrl.identification.information import start_precision
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.residuals import difference
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

UNSEEN = 0.1
"""What is free counts along directions that change predictions by more than this, in χ² at one standard deviation."""
SETTLED = 4.0
"""Of a Ḡ in the Jensen–Rényi divergence: two normal densities that far apart overlap by exp(−Ḡ/4)."""
BEYOND = 1e-3
"""What distances beyond those that settle all pairs count: enough that a search still finds upwards."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Free numbers of the segments' starts, eliminated to first order with the prior that they have in fits.

    Of whitened values v, with N the whitened derivatives by a start and P its prior precision's root, it leaves
    [v − N s, P s] at the s at which the sum of their squares is least.

    Attributes:
        noise: by which values are whitened.
        segments: whose starts.
        slopes: for each (m, nc, s) derivatives by a start.
        by_start: for each (N, s) N.
        answers: for each (s, N) s of v.
    """

    noise: Noise
    segments: tuple[Segment, ...]
    slopes: tuple[Array, ...]
    by_start: tuple[Array, ...]
    answers: tuple[Array, ...]

    @classmethod
    def of(cls, noise: Noise, segments: Sequence[Segment], slopes: Sequence[Array]) -> Starts:
        """Of derivatives (m, nc, s) by the free numbers of each segment's start."""
        columns, answers = list[Array](), list[Array]()
        for segment, slope in zip(segments, slopes, strict=True):
            own = whiten(noise, segment.trial.sample_times, slope).reshape(-1, slope.shape[2])
            columns.append(own)
            held = own.T @ own + np.diag(start_precision(segment, noise) ** 2)
            answers.append(np.asarray(np.linalg.solve(held, own.T), dtype=np.float64))
        return cls(noise, tuple(segments), tuple(slopes), tuple(columns), tuple(answers))

    def reduced(self, place: int, values: Array) -> Array:
        """(N + s, k) of values (m, nc, k) of a segment [rad, m or a channel's own unit]."""
        segment, by_start = self.segments[place], self.by_start[place]
        whole = whiten(self.noise, segment.trial.sample_times, values).reshape(-1, values.shape[2])
        own = self.answers[place] @ whole
        return np.concatenate([whole - by_start @ own, start_precision(segment, self.noise)[:, None] * own])

    def left(self, place: int, values: Array) -> Array:
        """(m, nc) of values (m, nc) of a segment, what no start takes, not whitened."""
        whole = whiten(self.noise, self.segments[place].trial.sample_times, values[..., None])
        return np.asarray(values - self.slopes[place] @ (self.answers[place] @ whole.ravel()))


@dataclass(frozen=True, eq=False)
class Separation:
    """How far rivals are apart in one trial, to first order.

    Attributes:
        along: the rival that is simulated as the truth.
        gram: (R + Σq, R + Σq) of [y − y of ``along``, U]: all predictions, then each rival's derivatives, whitened.
        places: for each rival those of its derivatives, the same for rivals that are as free as each other.
        sound: (R,) which rivals' simulations went through; what did not is at no distance from anything.
        n: how many numbers the trial measures.
    """

    along: int
    gram: Array
    places: tuple[slice, ...]
    sound: NDArray[np.bool_]
    n: int

    def gap(self, first: int, second: int, repeats: float = 1.0) -> float:
        """Gᵢⱼ, by so many repeats of the trial."""
        return self._distance(first, second, (second,), repeats)

    def distance(self, first: int, second: int, repeats: float = 1.0) -> float:
        """Ḡᵢⱼ, by so many repeats of the trial."""
        return self._distance(first, second, (first, second), repeats)

    @property
    def gaps(self) -> Array:
        """(R, R) Gᵢⱼ."""
        return self._table(self.gap)

    @property
    def distances(self) -> Array:
        """(R, R) Ḡᵢⱼ."""
        return self._table(self.distance)

    def undone(self, first: int, second: int) -> Array:
        """(q,) z with which rival j comes nearest to what rival i predicts."""
        place = self.places[second]
        own = self.gram[place, place]
        towards = self.gram[place, first] - self.gram[place, second]
        return np.asarray(np.linalg.solve(own + np.eye(len(own)), towards))

    def _table(self, of: Callable[[int, int], float]) -> Array:
        count = len(self.places)
        return np.array([[of(i, j) if i != j else 0.0 for j in range(count)] for i in range(count)])

    def _distance(self, first: int, second: int, unsure: Sequence[int], repeats: float) -> float:
        """dᵀ(I + Σ UUᵀ)⁻¹d over rivals whose predictions are not sure, r times the Gram matrix of one trial."""
        if not (self.sound[first] and self.sound[second] and self.sound[self.along]):
            return 0.0
        gram, ends = self.gram, (first, second)
        rows = np.concatenate([np.arange(len(gram))[self.places[k]] for k in dict.fromkeys(unsure)])
        square = gram[first, first] - 2 * gram[first, second] + gram[second, second]
        towards = gram[rows, ends[0]] - gram[rows, ends[1]]
        held = np.linalg.solve(np.eye(len(rows)) / repeats + gram[np.ix_(rows, rows)], towards)
        return float(max(repeats * (square - towards @ held), 0.0))


Bases = Sequence[Array]
"""For each rival (p, q) directions B in units of its parameters' standard deviations, θ = θ̂ + scale·L B z."""


def separations(
    rivals: Rivals,
    commands: Sequence[Commands],
    *,
    along: int = 0,
    bases: Bases | None = None,
    simulator: Simulator | None = None,
) -> list[Separation]:
    """How far rivals are apart in each of some trials; all trials, rivals and derivatives are one batch of simulations.

    Args:
        rivals: that predict.
        commands: of each trial.
        along: the rival that is taken for the truth.
        bases: directions along which rivals' free numbers count; all of them by default, see ``leading``.
        simulator: that of the rivals by default.

    Raises:
        ConfigError: where the robot does not come to rest under the first command.
        SimulationDiverged: where the rival that is taken for the truth does.
    """
    simulator = simulator or rivals.simulator()
    trials = predicted_trials(rivals, rivals.rivals[along].model, commands, simulator)
    return apart_in(rivals, trials, along, bases, simulator)


def apart_in(
    rivals: Rivals, trials: Sequence[Sequence[Segment]], along: int, bases: Bases | None, simulator: Simulator
) -> list[Separation]:
    """The same of trials that are predicted and cut, see ``predicted.predicted_trials``."""
    segments = [segment for trial in trials for segment in trial]
    own = _Neighbours.of(rivals, along, segments, bases, simulator)
    starts = Starts.of(rivals.noise, segments, own.by_start)
    found, first = [], 0
    for trial in trials:
        places = range(first, first + len(trial))
        found.append(own.separation(along, starts, places))
        first += len(trial)
    return found


def with_channel(
    rivals: Rivals, apart: Separation, values: Callable[[Model], Array], simulator: Simulator
) -> Separation:
    """The same where one channel more is measured that no start changes.

    Args:
        rivals: that were compared, along all directions of what is free.
        apart: in a trial.
        values: (m,) of a model there, in units of the channel's noise, which is white.
        simulator: of the others.
    """
    by = difference(rivals.model, simulator)
    count = len(rivals.rivals)
    predicted = np.array([values(rival.model) for rival in rivals.rivals])
    rows = np.zeros((predicted.shape[1], len(apart.gram)))
    rows[:, :count] = (predicted - predicted[apart.along]).T
    for place, rival in zip(apart.places, rivals.rivals, strict=True):
        points, turn = _neighbours(rival, None, by)
        found = np.array([values(rival.model_at(theta)) for theta in points])
        rows[:, place] = (found[1:] - found[0]).T @ turn
    return replace(apart, gram=apart.gram + rows.T @ rows, n=apart.n + len(rows))


@dataclass(frozen=True, eq=False)
class _Neighbours:
    """Rivals simulated on some segments, each with its neighbours in parameters, and one with those of its start.

    Attributes:
        predicted: for each segment (m, nc, R) of the rivals.
        slopes: for each segment (m, nc, Σq) derivatives by z.
        by_start: for each segment (m, nc, s) of the one along which it is.
        places: for each rival those of its derivatives.
        sound: for each segment (R,).
    """

    predicted: list[Array]
    slopes: list[Array]
    by_start: list[Array]
    places: tuple[slice, ...]
    sound: list[NDArray[np.bool_]]

    @classmethod
    def of(
        cls, rivals: Rivals, along: int, segments: Sequence[Segment], bases: Bases | None, simulator: Simulator
    ) -> _Neighbours:
        """Simulate them, one batch."""
        by = difference(rivals.model, simulator)
        models, turns, first = [rival.model for rival in rivals.rivals], list[Array](), list[int]()
        known, places = dict[int, slice](), list[slice]()
        for k, rival in enumerate(rivals.rivals):
            # What would just not have been seen changes no derivatives that the recordings would show.
            twin = next(j for j, other in enumerate(rivals.rivals) if rival.as_free_as(other))
            if twin == k:
                points, turn = _neighbours(rival, None if bases is None else bases[k], by)
                first.append(len(models))
                models += [rival.model_at(theta) for theta in points]
                turns.append(turn)
                begin = sum(own.shape[1] for own in turns[:-1])
                known[k] = slice(begin, begin + turn.shape[1])
            places.append(known[twin])
        most = max(len(segment.free_at) for segment in segments)
        own = len(models)
        models += [rivals.rivals[along].model] * most
        starts = []
        for segment in segments:
            rows, free = np.tile(segment.start, (len(models), 1)), segment.free_at
            rows[own + np.arange(len(free)), free] += by
            starts.append(rows)
        whole = cls([], [], [], tuple(places), [])
        for segment, found in zip(segments, simulator(models, segments, starts), strict=True):
            whole._add(segment, found, first, turns, own, along, by)
        return whole

    def _add(
        self,
        segment: Segment,
        found: Predicted,
        first: Sequence[int],
        turns: Sequence[Array],
        own: int,
        truth: int,
        by: float,
    ) -> None:
        """What was found for one segment."""
        position = np.where(found.sound[:, None, None], found.position, 0.0)
        slopes = []
        for at, turn in zip(first, turns, strict=True):
            steps = slice(at + 1, at + 1 + len(turn))
            # A neighbour that diverges gives no slope.
            sound = found.sound[steps] & found.sound[at]
            change = np.where(sound[:, None, None], position[steps] - position[at], 0.0)
            slopes.append(np.moveaxis(change, 0, -1) @ turn)
        moved = np.where(found.sound[own:, None, None], position[own:] - position[truth], 0.0) / by
        self.predicted.append(np.moveaxis(position[: len(self.places)], 0, -1))
        self.slopes.append(np.concatenate(slopes, axis=2))
        self.by_start.append(np.moveaxis(moved, 0, -1)[..., : len(segment.free_at)])
        self.sound.append(found.sound[: len(self.places)])

    def separation(self, along: int, starts: Starts, places: Sequence[int]) -> Separation:
        """Of the trial that some of the segments make up."""
        count = len(self.places)
        size = count + max(own.stop for own in self.places)
        gram, n = np.zeros((size, size)), 0
        for k in places:
            apart = self.predicted[k] - self.predicted[k][..., along : along + 1]
            rows = starts.reduced(k, np.concatenate([apart, self.slopes[k]], axis=2))
            gram += rows.T @ rows
            n += apart.shape[0] * apart.shape[1]
        behind = tuple(slice(count + own.start, count + own.stop) for own in self.places)
        return Separation(along, gram, behind, np.all([self.sound[k] for k in places], axis=0), n)


def _neighbours(rival: Rival, basis: Array | None, by: float) -> tuple[list[Array], Array]:
    """[(p,)] a point and its neighbours within the bounds, and (k, q) how their changes add up to derivatives by z.

    Without a basis each parameter goes by itself, in units of its scale, from the estimates. Else all go along each
    direction of the basis, by as much of the parameter that goes farthest, from where that is within the bounds.
    """
    free = rival.parameters
    if basis is None:
        away = by * free.scale * np.where(rival.theta + by * free.scale <= free.high, 1.0, -1.0)
        return [rival.theta, *(rival.theta + np.diag(away))], rival.spread / (away / free.scale)[:, None]
    whole = rival.spread @ basis
    size = by / np.maximum(np.abs(whole).max(axis=0, initial=0.0), 1e-300)
    inside = np.clip(rival.theta, free.low + by * free.scale, free.high - by * free.scale)
    return [inside, *(inside + free.scale * (whole * size).T)], np.diag(1.0 / size)


def leading(rivals: Rivals, examples: Sequence[Separation], least: float = UNSEEN) -> list[Array]:
    """Directions of what is free that count, by some trials for which all of them were simulated.

    Of UᵀU, the mean over the examples, each rival's eigenvectors with eigenvalues of ``least`` or more: a change by one
    standard deviation along any other changes predictions by less, in χ². For engines that take long.

    Args:
        rivals: that were compared.
        examples: trials of the kind that is to be compared, along all directions.
        least: see above.
    """
    found = []
    for k in range(len(rivals.rivals)):
        own = sum(e.gram[e.places[k], e.places[k]] for e in examples) / len(examples)
        strength, directions = np.linalg.eigh(own)
        found.append(directions[:, strength >= least][:, ::-1])
    return found


def divergence(separation: Separation, weights: Array | None = None) -> float:
    """What a design is chosen by: the Jensen–Rényi divergence of order 2 of the rivals' predictions.

    −ln Σ wᵢwⱼ exp(−Ḡᵢⱼ/4), which is Rényi's entropy of the mixture of normal densities less theirs (Hoffmann 2017;
    Olofsson et al. 2019, Comput. Chem. Eng. 125): pairs that are settled do not pull, nor do those that nothing tells
    apart. A small term in the mean of ln(1 + Ḡ) keeps a slope where all are settled.

    Args:
        separation: of the design.
        weights: (R,) of the rivals; all alike by default.
    """
    count = len(separation.places)
    own = np.full(count, 1.0 / count) if weights is None else weights / weights.sum()
    distances = separation.distances
    mixed = float(own @ np.exp(-distances / SETTLED) @ own)
    return -float(np.log(mixed)) + BEYOND * float(own @ np.log1p(distances) @ own)
