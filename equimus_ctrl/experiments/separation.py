"""What rivals predict of trials that nobody has made yet, and how far they are apart there.

A trial is simulated with one rival as the truth, and cut as a diagnosis cuts recordings. On what comes of it all rivals
are simulated, with their derivatives by all that is free. With d = W(yᵢ − yⱼ) the whitened difference of two
predictions and U = W ∂y/∂z their derivatives by what is free in units of what is not known of it, θ = θ̂ + scale·L z
with LLᵀ the covariance by the recordings so far (``Rival.spread``), the trial would favour rival i by

    Gᵢⱼ = min over z of ‖d − Uⱼz‖² + ‖z‖² = dᵀ(I + UⱼUⱼᵀ)⁻¹d

in −2Δln L where i is true and all free numbers of j are refitted (T-optimality: Atkinson & Fedorov 1975, Biometrika 62,
57). What i predicts is not sure itself; designs are compared by the distance over the uncertainty of both predictions
(Buzzi-Ferraris & Forzatti 1983, Chem. Eng. Sci. 38, 225), which is never larger:

    Ḡᵢⱼ = dᵀ(I + UᵢUᵢᵀ + UⱼUⱼᵀ)⁻¹d = min over zᵢ, zⱼ of ‖d + Uᵢzᵢ − Uⱼzⱼ‖² + ‖zᵢ‖² + ‖zⱼ‖²

Both come from the Gram matrix of [d, U] by Woodbury's identity: no matrix has as many rows and columns as there are
samples. The free numbers of starts are eliminated before, with the prior that they have in fits.

Derivatives are secants over what is not known: the slopes of the plane that fits best through predictions at
z = ±√3 along each direction (statistical linearisation: Lefebvre, Bruyninckx & De Schutter 2002, IEEE Trans. Automatic
Control 47; the span: Nørgaard, Poulsen & Ravn 2000, Automatica 36). Where a joint sticks or slides a tangent says what
holds next to the estimates alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.diagnosis.rivals import Rival, Rivals
from equimus_ctrl.experiments.predicted import Commands, predicted_trials
from equimus_ctrl.experiments.starts import Starts
from equimus_ctrl.identification.residuals import difference
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SPAN = 3.0**0.5
"""How many standard deviations from the estimates predictions are compared: the fourth moment of a normal
distribution is 3, so the third-order term of what is expected is right."""
CLOSE = 1e-9
"""Of the largest: directions along which bounds leave less than this share of a span have no slope, and what adds less
to one does not count for it."""
UNSEEN = 0.1
"""What is free counts along directions that change predictions by more than this, in χ² at one standard deviation."""
SETTLED = 4.0
"""Of a Ḡ in the Jensen–Rényi divergence: two normal densities that far apart overlap by exp(−Ḡ/4)."""
BEYOND = 1e-3
"""What distances beyond those that settle all pairs count: enough that a search still finds upwards."""


@dataclass(frozen=True, eq=False)
class Separation:
    """How far rivals are apart in one trial, to first order.

    Attributes:
        along: the rival that is simulated as the truth.
        gram: (R + Σq, R + Σq) of [y − y of ``along``, U]: all predictions, then each rival's derivatives, whitened.
        places: for each rival those of its derivatives.
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

    @cached_property
    def gaps(self) -> Array:
        """(R, R) Gᵢⱼ."""
        count = len(self.places)
        return np.array([[self.gap(i, j) if i != j else 0.0 for j in range(count)] for i in range(count)])

    @cached_property
    def distances(self) -> Array:
        """(R, R) Ḡᵢⱼ = Ḡⱼᵢ."""
        count = len(self.places)
        found = np.zeros((count, count))
        for i, j in combinations(range(count), 2):
            found[i, j] = found[j, i] = self.distance(i, j)
        return found

    def undone(self, first: int, second: int) -> Array:
        """(q,) z with which rival j comes nearest to what rival i predicts."""
        place = self.places[second]
        own = self.gram[place, place]
        towards = self.gram[place, first] - self.gram[place, second]
        return np.asarray(np.linalg.solve(own + np.eye(len(own)), towards))

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
    rivals: Rivals,
    trials: Sequence[Sequence[Segment]],
    along: int,
    bases: Bases | None,
    simulator: Simulator,
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
    count = len(rivals.rivals)
    predicted = np.array([values(rival.model) for rival in rivals.rivals])
    rows = np.zeros((predicted.shape[1], len(apart.gram)))
    rows[:, :count] = (predicted - predicted[apart.along]).T
    for place, rival in zip(apart.places, rivals.rivals, strict=True):
        points, turn = _neighbours(rival, None)
        rows[:, place] = np.array([values(rival.model_at(theta)) for theta in points]).T @ turn
    return replace(apart, gram=apart.gram + rows.T @ rows, n=apart.n + len(rows))


@dataclass(frozen=True, eq=False)
class _Neighbours:
    """Rivals simulated on some segments, each with its neighbours in parameters, and one with those of its start.

    Attributes:
        places: for each rival those of its derivatives.
        predicted: for each segment (m, nc, R) of the rivals.
        slopes: for each segment (m, nc, Σq) derivatives by z.
        by_start: for each segment (m, nc, s) of the one along which it is.
        sound: for each segment (R,).
    """

    places: tuple[slice, ...]
    predicted: list[Array] = field(default_factory=list)
    slopes: list[Array] = field(default_factory=list)
    by_start: list[Array] = field(default_factory=list)
    sound: list[NDArray[np.bool_]] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        rivals: Rivals,
        along: int,
        segments: Sequence[Segment],
        bases: Bases | None,
        simulator: Simulator,
    ) -> _Neighbours:
        """Simulate them, one batch."""
        by, several = difference(rivals.model, simulator), rivals.rivals
        models = [rival.model for rival in several]
        shown, turns, first = len(models), list[Array](), list[int]()
        places, begin = list[slice](), shown
        for k, rival in enumerate(several):
            points, turn = _neighbours(rival, None if bases is None else bases[k])
            first.append(len(models))
            models += [rival.model_at(theta) for theta in points]
            turns.append(turn)
            places.append(slice(begin, begin + turn.shape[1]))
            begin += turn.shape[1]
        most = max(len(segment.free_at) for segment in segments)
        begun = len(models)
        models += [several[along].model] * most
        starts = []
        for segment in segments:
            rows, free = np.tile(segment.start, (len(models), 1)), segment.free_at
            rows[begun + np.arange(len(free)), free] += by
            starts.append(rows)
        whole_of = cls(tuple(places))
        for segment, found in zip(segments, simulator(models, segments, starts), strict=True):
            position = np.where(found.sound[:, None, None], found.position, 0.0)
            slopes = []
            for at, turn in zip(first, turns, strict=True):
                near = slice(at, at + len(turn))
                # Where a neighbour diverges, there is no slope along any direction for which it counts.
                lost = np.any(np.abs(turn[~found.sound[near]]) > CLOSE, axis=0)
                slopes.append(np.moveaxis(position[near], 0, -1) @ np.where(lost, 0.0, turn))
            moved = np.where(found.sound[begun:, None, None], position[begun:] - position[along], 0.0) / by
            whole_of.predicted.append(np.moveaxis(position[:shown], 0, -1))
            whole_of.slopes.append(np.concatenate(slopes, axis=2))
            whole_of.by_start.append(np.moveaxis(moved, 0, -1)[..., : len(segment.free_at)])
            whole_of.sound.append(found.sound[:shown])
        return whole_of

    def separation(self, along: int, starts: Starts, places: Sequence[int]) -> Separation:
        """Of the trial that some of the segments make up."""
        size = max(own.stop for own in self.places)
        gram, n = np.zeros((size, size)), 0
        for k in places:
            apart = self.predicted[k] - self.predicted[k][..., along : along + 1]
            rows = starts.reduced(k, np.concatenate([apart, self.slopes[k]], axis=2))
            gram += rows.T @ rows
            n += apart.shape[0] * apart.shape[1]
        sound = np.all([self.sound[k] for k in places], axis=0)
        return Separation(along, gram, self.places, sound, n)


def _neighbours(rival: Rival, basis: Array | None) -> tuple[list[Array], Array]:
    """[(p,)] points about the estimates within the bounds, and (k, q) how predictions there add up to derivatives by z.

    They lie ±√3 standard deviations away along each direction, less where the bounds are nearer or a parameter would
    change by more than its scale. The derivatives are those of the plane that fits best.
    """
    free, spread = rival.parameters, rival.spread
    away = SPAN * (spread if basis is None else spread @ basis).T
    away = away / np.maximum(np.abs(away).max(axis=1, initial=0.0, keepdims=True), 1.0)
    points = np.clip(rival.theta + free.scale * np.concatenate([away, -away]), free.low, free.high)
    z = np.linalg.solve(spread, ((points - rival.theta) / free.scale).T).T
    z = z if basis is None else z @ basis
    plane = np.linalg.pinv(np.column_stack([np.ones(len(z)), z]), rcond=CLOSE)
    return list(points), np.asarray(plane[1:].T)


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
