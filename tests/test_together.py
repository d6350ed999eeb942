"""Computations beside each other: all that they ask for is answered at once, in their order."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pytest

from equimus_ctrl.experiments.together import together

Ask = Callable[[int], int]


def counting(begin: int, often: int) -> Callable[[Ask], int]:
    """Asks for the double of one number after the other, and adds up what it is told."""
    return lambda ask: sum(ask(begin + k) for k in range(often))


def test_all_requests_are_answered_at_once_and_in_order() -> None:
    batches = list[list[tuple[int, int]]]()

    def answered(asked: Sequence[tuple[int, int]]) -> list[int]:
        batches.append(list(asked))
        return [2 * number for _, number in asked]

    found = together([counting(0, 3), counting(10, 1), counting(20, 2)], answered)
    assert found == [2 * (0 + 1 + 2), 2 * 10, 2 * (20 + 21)]
    assert batches == [[(0, 0), (1, 10), (2, 20)], [(0, 1), (2, 21)], [(0, 2)]]


def test_nothing_to_do_is_done() -> None:
    assert together([], lambda asked: []) == []
    assert together([lambda ask: 7], lambda asked: [0]) == [7]


def test_who_fails_ends_all() -> None:
    def fails(ask: Ask) -> int:
        ask(1)
        raise ZeroDivisionError("nothing goes into it")

    with pytest.raises(ZeroDivisionError, match="nothing goes"):
        together([counting(0, 9), fails, counting(5, 9)], lambda asked: [1 for _ in asked])
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("refit-")]


def test_an_answer_that_fails_ends_all() -> None:
    def answered(asked: Sequence[tuple[int, int]]) -> list[int]:
        raise KeyError("no answer")

    with pytest.raises(KeyError, match="no answer"):
        together([counting(0, 2), counting(1, 2)], answered)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("refit-")]
