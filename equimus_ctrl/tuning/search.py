"""The search itself: a spread of first tries, CMA-ES from the best of them, Nelder–Mead at the end; resumable.

A budget that is too small for CMA-ES to learn anything goes to a surrogate of the costs instead: cubic radial basis
functions through all that was tried, whose promising places about the best are tried next (Regis and Shoemaker, INFORMS
Journal on Computing 19, 2007).

Everything is driven by the study's seed, and every evaluation is handed to a journal as soon as it is known. A search
that is started again with the same journal asks for the same candidates in the same order and takes the answers it
already has, so it ends with the same bits as one that was never interrupted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import cmaes
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.optimize import minimize

from equimus_ctrl.controllers.search_space import Range
from equimus_ctrl.models.spread import latin_hypercube
from equimus_ctrl.shown import Short
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.study import AnyStudy
from equimus_ctrl.types import Array

GENERATIONS = 5
"""Of CMA-ES that a budget is to last for, where populations need not be smaller than usual for that; one that does not
last for so many of the usual size is the surrogate's."""
AT_ONCE = 2
"""Candidates that are tried before the surrogate is made anew."""
NEAR, NEARER = 0.2, 0.25
"""Standard deviation of the surrogate's candidates about the best, in ranges, and what a third of them have of it."""
DRAWN = 200
"""How many are drawn for each number that is searched."""
PROMISE = 0.95, 0.8
"""Weights of a low cost by the surrogate beside distance from what was tried, in turn."""
RIDGE = 1e-6
"""Smoothing of the surrogate: candidates may lie on one another."""


class Journal(Protocol):
    """Where evaluations are kept."""

    def known(self, index: int, values: Sequence[float]) -> Evaluation | None:
        """The evaluation number ``index`` if it is there and was of the same values."""
        ...

    def add(self, index: int, stage: str, values: Sequence[float], evaluation: Evaluation) -> None:
        """Keep one more."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Short):
    """One candidate that was tried.

    Attributes:
        index: in the order of the search.
        stage: ``"start"``, ``"spread"``, ``"cma-es"``, ``"surrogate"`` or ``"nelder-mead"``.
        values: the gains, see ``Study.ranges``.
        evaluation: what they are worth.
        reused: whether the answer came from the journal.
    """

    index: int
    stage: str
    values: tuple[float, ...]
    evaluation: Evaluation
    reused: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain types."""
        return {"index": self.index, "stage": self.stage, "values": list(self.values), **self.evaluation.to_dict()}


class _BudgetSpent(Exception):
    pass


@dataclass
class Search:
    """A search in progress.

    Attributes:
        low: (n,) least of each value.
        high: (n,) most.
        start: (n,) the first candidate.
        budget: candidates in all.
        polish: share of the budget for the local search.
        seed: of everything random.
        evaluate: values of several candidates → their evaluations, in order, as they are known.
        journal: where they are kept.
        notify: called after each candidate.
        history: what was tried.
        restarts: how often CMA-ES has begun.
        linear: (n,) which values lie on a linear scale, the others on logarithmic ones; none by default.
        over: whether the time is up.
    """

    low: Array
    high: Array
    start: Array
    budget: int
    polish: float
    seed: int
    evaluate: Callable[[list[Array]], Iterator[Evaluation]]
    journal: Journal
    notify: Callable[[Trial], None]
    history: list[Trial]
    restarts: int = 0
    linear: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    over: Callable[[], bool] = lambda: False
    timed_out: bool = False

    def __post_init__(self) -> None:
        if not len(self.linear):
            self.linear = np.zeros(len(self.low), dtype=bool)

    @classmethod
    def of(cls, ranges: Sequence[Range], study: AnyStudy, journal: Journal, notify: Callable[[Trial], None]) -> Search:
        """The search of a study, over the ranges of its values; ``evaluate`` is set before it runs."""
        low, high, start = (np.array([getattr(own, key) for own in ranges]) for key in ("low", "high", "start"))
        budget, polish, seed = study.candidates, study.polish, study.seed
        linear = np.array([own.scale == "linear" for own in ranges])
        return cls(
            low, high, start, budget, polish, seed, lambda batch: iter(()), journal, notify, [], linear=linear
        )  # fmt: skip

    def interrupted(self) -> bool:
        """Run, and say whether a KeyboardInterrupt ended that, which is raised where nothing is known yet."""
        try:
            self.run()
        except KeyboardInterrupt:
            if not self.history:
                raise
            return True
        return False

    def run(self) -> None:
        """Spend the budget; ``history`` grows as it goes."""
        try:
            self._spread()
            while len(self.history) < self.budget - self._polish_budget():
                if self._is_small:
                    self._surrogate()
                else:
                    self._cma()
            self._nelder_mead()
        except _BudgetSpent:
            pass

    def best(self) -> Trial:
        """The cheapest candidate so far."""
        return min(self.history, key=lambda trial: trial.evaluation.cost)

    @property
    def _is_small(self) -> bool:
        """Whether the budget is the surrogate's; one number needs none, see ``_cma``."""
        return len(self.low) > 1 and self.budget - self._polish_budget() < GENERATIONS * self._usual

    @property
    def _usual(self) -> int:
        """CMA-ES's population (Hansen, 2016)."""
        return 4 + int(3 * math.log(len(self.low)))

    def _polish_budget(self) -> int:
        return round(self.polish * self.budget)

    def _values(self, unit: Array) -> Array:
        """Values of a point of the unit cube, each on its scale."""
        share = np.clip(unit, 0.0, 1.0)
        low, high = self._scaled(self.low), self._scaled(self.high)
        found = low + share * (high - low)
        return np.where(self.linear, found, np.exp(np.where(self.linear, 0.0, found)))

    def _unit(self, values: Sequence[float]) -> Array:
        low, high = self._scaled(self.low), self._scaled(self.high)
        return np.asarray((self._scaled(np.array(values)) - low) / (high - low))

    def _scaled(self, values: Array) -> Array:
        return np.where(self.linear, values, np.log(np.where(self.linear, 1.0, values)))

    def _try(self, stage: str, units: Sequence[Array]) -> list[float]:
        """Costs of points of the unit cube, from the journal where it has them."""
        room = self.budget - len(self.history)
        batch = [self._values(unit) for unit in units][:room]
        first = len(self.history)
        answers = [self.journal.known(first + k, values.tolist()) for k, values in enumerate(batch)]
        fresh = self.evaluate([v for v, a in zip(batch, answers, strict=True) if a is None])
        for k, (values, answer) in enumerate(zip(batch, answers, strict=True)):
            evaluation = next(fresh) if answer is None else answer
            if answer is None:
                self.journal.add(first + k, stage, values.tolist(), evaluation)
            trial = Trial(first + k, stage, tuple(values.tolist()), evaluation, answer is not None)
            self.history.append(trial)
            self.notify(trial)
            if answer is None and self.over():
                self.timed_out = True
                raise _BudgetSpent
        if len(batch) < len(units):
            raise _BudgetSpent
        return [trial.evaluation.cost for trial in self.history[first:]]

    def _spread(self) -> None:
        n = len(self.low)
        self._try("start", [self._unit(self.start.tolist())])
        near = self._unit(self.start.tolist())
        rng = np.random.default_rng(self.seed)
        if self._is_small:
            # As many as a plane takes, about the start: a few cannot cover the cube.
            points = latin_hypercube(min(n + 1, self.budget // 2), n, rng)
            self._try("spread", [near + 3 * NEAR * (p - 0.5) for p in points])
            return
        count = min(8 * n, self.budget // 6)
        # The first tries cover the cube evenly, and half of them lie nearer to the start.
        points = latin_hypercube(count, n, rng)
        self._try("spread", [p if k % 2 else near + 0.4 * (p - 0.5) for k, p in enumerate(points)])

    def _cma(self) -> None:
        n = len(self.low)
        restarts = self.restarts
        self.restarts += 1
        if n == 1:  # one number has no covariances: its range is covered ever more densely
            count = 2 ** (2 + restarts)
            room = self.budget - self._polish_budget() - len(self.history)
            self._try("spread", [np.array([(k + 0.5) / count]) for k in range(count)][:room])
            return
        usual = self._usual  # twice as many go well side by side where there is time
        optimiser = cmaes.CMA(
            mean=self._unit(self.best().values),
            sigma=0.15 if restarts == 0 else 0.3,
            bounds=np.stack([np.zeros(n), np.ones(n)], axis=1),
            seed=self.seed + restarts,
            population_size=min(2 * usual, max(usual, self.budget // GENERATIONS)),
        )
        while not optimiser.should_stop():
            if len(self.history) >= self.budget - self._polish_budget():
                return
            points = [optimiser.ask() for _ in range(optimiser.population_size)]
            costs = self._try("cma-es", points)
            optimiser.tell(list(zip(points, costs, strict=True)))

    def _surrogate(self) -> None:
        n, near = len(self.low), NEAR
        while (room := self.budget - self._polish_budget() - len(self.history)) > 0:
            tried = np.array([np.clip(self._unit(trial.values), 0.0, 1.0) for trial in self.history])
            costs = np.array([trial.evaluation.cost for trial in self.history])
            # Candidates beyond limits count as the worst within: a penalty's size is none of the cost's.
            within = costs[[trial.evaluation.within for trial in self.history]]
            costs = np.minimum(costs, within.max()) if len(within) else np.argsort(np.argsort(costs)).astype(float)
            # A plane takes one more than there are numbers.
            kernel, degree = ("cubic", 1) if len(tried) > n else ("linear", 0)
            surrogate = RBFInterpolator(tried, costs, smoothing=RIDGE, kernel=kernel, degree=degree)
            rng = np.random.default_rng([self.seed, len(self.history)])
            best = self._unit(self.best().values)
            drawn = rng.standard_normal((DRAWN * n, n))
            drawn[::3] *= NEARER
            drawn = np.clip(best + near * drawn, 0.0, 1.0)
            promise = _unit_scaled(surrogate(drawn))
            points: list[Array] = []
            for weight in PROMISE[: min(AT_ONCE, room)]:
                known = np.vstack([tried, *points])
                apart = np.linalg.norm(drawn[:, None] - known[None], axis=2).min(axis=1)
                points.append(drawn[int(np.argmin(weight * promise - (1 - weight) * _unit_scaled(apart)))])
            before = self.best()
            self._try("surrogate", points)
            if self.best() is before:
                near /= 2

    def _nelder_mead(self) -> None:
        start = self._unit(self.best().values)
        size = 0.04
        while len(self.history) < self.budget and size > 1e-4:
            simplex = np.vstack([start, start + size * np.eye(len(start))])
            found = minimize(
                lambda unit: self._try("nelder-mead", [unit])[0],
                start,
                method="Nelder-Mead",
                options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-6, "adaptive": True, "maxfev": 10**6},
            )
            start, size = np.clip(found.x, 0.0, 1.0), size / 4


def _unit_scaled(values: Array) -> Array:
    """From 0, the least, to 1, the most."""
    span = float(np.ptp(values))
    return np.asarray((values - values.min()) / (span or 1.0))
