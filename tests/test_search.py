"""The search on functions whose lowest point is known: its budget, its seeds, and going on after an interruption."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.journal import RowJournal
from equimus_ctrl.tuning.search import Journal, Search, Trial

LOW, HIGH, START = np.array([1.0, 0.1, 10.0]), np.array([100.0, 20.0, 4000.0]), np.array([30.0, 0.2, 2000.0])
BEST = np.array([7.0, 5.0, 90.0])


def evaluation(cost: float) -> Evaluation:
    return Evaluation(cost, {"error": cost}, (cost,), 0.0, 0.0, 0.9, 0.95, True, True)


def bowl(values: np.ndarray) -> float:
    return float(
        1 + np.sum(np.log(values / BEST) ** 2) + 0.3 * np.log(values[0] / BEST[0]) * np.log(values[1] / BEST[1])
    )


class Rows:
    """A store in memory that keeps rows as a file would."""

    def __init__(self, rows: list[dict[str, Any]] | None = None) -> None:
        self.rows = list(rows or [])

    def append(self, row: Mapping[str, Any]) -> None:
        self.rows.append(json.loads(json.dumps(row)))

    def truncate(self, count: int) -> None:
        del self.rows[count:]


class Counter:
    """An evaluator that keeps what it was asked for."""

    def __init__(self, cost: Callable[[np.ndarray], float] = bowl) -> None:
        self.asked: list[tuple[float, ...]] = []
        self.cost = cost

    def __call__(self, batch: list[np.ndarray]) -> Iterator[Evaluation]:
        for values in batch:
            self.asked.append(tuple(values.tolist()))
            yield evaluation(self.cost(values))


def make(
    budget: int,
    evaluate: Callable[[list[np.ndarray]], Iterator[Evaluation]] | None = None,
    journal: Journal | None = None,
    notify: Callable[[Trial], None] = lambda trial: None,
    polish: float = 0.25,
    seed: int = 1,
) -> Search:
    return Search(
        LOW, HIGH, START, budget, polish, seed, evaluate or Counter(), journal or RowJournal(Rows()), notify, []
    )


def bits(search: Search) -> list[str]:
    return [json.dumps(trial.to_dict()) for trial in search.history]


@pytest.mark.parametrize("budget", [1, 2, 7, 30, 100])
@pytest.mark.parametrize("polish", [0.0, 0.3, 0.9])
def test_the_budget_is_kept(budget: int, polish: float) -> None:
    counter = Counter()
    search = make(budget, counter, polish=polish)
    search.run()
    assert len(search.history) == len(counter.asked) == budget
    assert [trial.index for trial in search.history] == list(range(budget))
    assert [trial.values for trial in search.history] == counter.asked


def test_a_converged_search_may_stop_early_but_never_late() -> None:
    search = make(3000)
    search.run()
    assert len(search.history) <= 3000
    np.testing.assert_allclose(search.best().values, BEST, rtol=1e-4)


def test_the_start_comes_first_and_stages_in_order() -> None:
    search = make(200)
    search.run()
    np.testing.assert_allclose(search.history[0].values, START, rtol=1e-12)
    stages = [key for key, _ in itertools.groupby(trial.stage for trial in search.history)]
    assert stages == ["start", "spread", "cma-es", "nelder-mead"]
    polish = sum(trial.stage == "nelder-mead" for trial in search.history)
    assert polish <= 50


def test_candidates_stay_within_their_ranges() -> None:
    """Also where the best lies in a corner."""
    for sign in (1, -1):
        search = make(250, Counter(lambda values, s=sign: float(s * np.log(values).sum())))
        search.run()
        tried = np.array([trial.values for trial in search.history])
        assert np.all((tried >= LOW * (1 - 1e-12)) & (tried <= HIGH * (1 + 1e-12)))
        np.testing.assert_allclose(search.best().values, LOW if sign > 0 else HIGH, rtol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_it_finds_the_bottom(seed: int) -> None:
    search = make(400, seed=seed)
    search.run()
    np.testing.assert_allclose(search.best().values, BEST, rtol=0.01)
    assert search.best().evaluation.cost == min(trial.evaluation.cost for trial in search.history)


def test_it_finds_the_lower_of_two_bottoms() -> None:
    """The start lies in the shallow one."""

    def two(values: np.ndarray) -> float:
        shallow = 1.0 + np.sum((np.log(values / START) / 0.5) ** 2)
        deep = np.sum((np.log(values / BEST) / 0.8) ** 2)
        return float(min(shallow, deep))

    search = make(600, Counter(two))
    search.run()
    assert search.best().evaluation.cost < 0.01


def test_the_first_tries_cover_the_ranges() -> None:
    search = make(300)
    search.run()
    spread = np.array([trial.values for trial in search.history if trial.stage == "spread"])
    share = np.log(spread / LOW) / np.log(HIGH / LOW)
    assert len(spread) == 24
    assert np.all(share.min(axis=0) < 0.2) and np.all(share.max(axis=0) > 0.8)


def test_the_same_seed_gives_the_same_bits() -> None:
    one, two, other = (make(150, seed=seed) for seed in (4, 4, 5))
    for search in (one, two, other):
        search.run()
    assert bits(one) == bits(two) != bits(other)


def test_everything_is_told_and_kept_in_order() -> None:
    rows, told = Rows(), []
    search = make(60, journal=RowJournal(rows), notify=told.append)
    search.run()
    assert told == search.history and not any(trial.reused for trial in told)
    assert [row["index"] for row in rows.rows] == list(range(60))
    assert [tuple(row["values"]) for row in rows.rows] == [trial.values for trial in told]
    assert [row["stage"] for row in rows.rows] == [trial.stage for trial in told]


@pytest.fixture(scope="module")
def whole() -> tuple[list[str], list[dict[str, Any]]]:
    rows = Rows()
    search = make(90, journal=RowJournal(rows))
    search.run()
    return bits(search), rows.rows


@settings(max_examples=25)
@given(st.integers(0, 90))
def test_it_goes_on_from_any_point_with_the_same_bits(kept: int) -> None:
    rows = Rows()
    full = make(90, journal=RowJournal(rows))
    full.run()
    counter, later = Counter(), Rows(rows.rows[:kept])
    again = make(90, counter, RowJournal(later))
    again.run()
    assert bits(again) == bits(full) and len(counter.asked) == 90 - kept
    assert [trial.reused for trial in again.history] == [k < kept for k in range(90)]
    assert later.rows == rows.rows


@pytest.mark.parametrize("stop", [0, 1, 5, 23, 24, 40, 70, 89])
@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_loses_nothing_that_was_known(
    stop: int, kind: type[BaseException], whole: tuple[list[str], list[dict[str, Any]]]
) -> None:
    def notify(trial: Trial) -> None:
        if trial.index == stop:
            raise kind

    rows, first = Rows(), Counter()
    search = make(90, first, RowJournal(rows), notify)
    with pytest.raises(kind):
        search.run()
    assert bits(search) == whole[0][: stop + 1] and rows.rows == whole[1][: stop + 1]
    second = Counter()
    again = make(90, second, RowJournal(rows))
    again.run()
    assert bits(again) == whole[0]
    assert len(first.asked) + len(second.asked) == 90


def test_a_row_that_does_not_fit_ends_what_is_reused(whole: tuple[list[str], list[dict[str, Any]]]) -> None:
    for spoil in ({"index": 7}, {"values": [1.0]}, {"evaluation": {}}, {"evaluation": None}, {"values": None}):
        rows = Rows([dict(row) for row in whole[1]])
        rows.rows[30] |= spoil
        counter = Counter()
        again = make(90, counter, RowJournal(rows))
        again.run()
        assert bits(again) == whole[0] and len(counter.asked) == 60
        assert rows.rows == whole[1]


def test_rows_of_another_search_are_of_no_use(whole: tuple[list[str], list[dict[str, Any]]]) -> None:
    counter = Counter()
    other = make(90, counter, RowJournal(Rows(whole[1])), seed=9)
    other.run()
    fresh = make(90, seed=9)
    fresh.run()
    assert bits(other) == bits(fresh)
    assert len(counter.asked) == 89  # the start is the same, and was taken over


def test_an_evaluation_survives_a_journal() -> None:
    nan = float("nan")
    first = Evaluation(1e9, {"error": nan}, (nan, 0.1), float("inf"), 1.0, nan, nan, False, False)
    again = Evaluation.from_dict(json.loads(json.dumps(first.to_dict())))
    assert json.dumps(again.to_dict()) == json.dumps(first.to_dict()) and isinstance(again.member_costs, tuple)


def test_no_candidate_is_tried_twice() -> None:
    """A large budget restarts CMA-ES; a restart with the same seed from the same mean asks what was asked before."""
    search = make(4000)
    search.run()
    tried = [trial.values for trial in search.history if trial.stage == "cma-es"]
    assert len(set(tried)) > 0.99 * len(tried)


# Small budgets.


def narrow(values: np.ndarray) -> float:
    """An ill-conditioned minimum in four numbers, beyond limits where the first is large."""
    z = np.log(values / np.array([3.0, 0.5, 2.0, 8.0]))
    cost = 1 + float(z @ z) + 0.8 * float(z[0] * z[1] - z[2] * z[3])
    return cost if values[0] < 12 else 1e3 * values[0]


class Limited(Counter):
    """An evaluator of ``narrow``, whose penalties are none of the cost's."""

    def __call__(self, batch: list[np.ndarray]) -> Iterator[Evaluation]:
        for values in batch:
            self.asked.append(tuple(values.tolist()))
            cost = narrow(values)
            yield replace(evaluation(cost), feasible=bool(cost < 1e3))


def few(seed: int, journal: Journal | None = None) -> Search:
    low, high, start = np.full(4, 0.05), np.full(4, 50.0), np.full(4, 1.5)
    return Search(low, high, start, 20, 0.0, seed, Limited(), journal or RowJournal(Rows()), lambda trial: None, [])


def test_a_small_budget_goes_to_a_surrogate_that_comes_near_the_bottom() -> None:
    left = []
    for seed in range(6):
        search = few(seed)
        search.run()
        stages = [key for key, _ in itertools.groupby(trial.stage for trial in search.history)]
        assert stages == ["start", "spread", "surrogate"] and len(search.history) == 20
        tried = np.array([trial.values for trial in search.history])
        assert np.all((tried >= 0.05 * (1 - 1e-12)) & (tried <= 50.0 * (1 + 1e-12)))
        left.append((search.best().evaluation.cost - 1) / (search.history[0].evaluation.cost - 1))
    assert np.median(left) < 0.15 and max(left) < 0.6


def test_a_surrogate_goes_on_with_the_same_bits() -> None:
    rows = Rows()
    whole = few(3, RowJournal(rows))
    whole.run()
    for kept in (1, 4, 9, 14):
        again = few(3, RowJournal(Rows(rows.rows[:kept])))
        again.run()
        assert bits(again) == bits(whole) and sum(trial.reused for trial in again.history) == kept
