"""What was lost with its worker, perhaps for another's fault, is done once more by itself."""

from __future__ import annotations

from concurrent.futures import Future

import pytest

from equimus_ctrl.executors.calls import Ended, Lost
from equimus_ctrl.executors.second_chance import SecondChances


class Pieces:
    """Pieces by name that are under way, each try of them in turn."""

    def __init__(self) -> None:
        self.tries: list[tuple[str, Future[str]]] = []
        self.chances = SecondChances()

    def give(self, name: str) -> Future[str]:
        def begin() -> Future[str]:
            given: Future[str] = Future()
            self.tries.append((name, given))
            return given

        return self.chances.give(begin)

    def under_way(self) -> list[str]:
        return [name for name, given in self.tries if not given.done()]

    def end(self, name: str, what: str | Exception) -> None:
        (given,) = [given for own, given in self.tries if own == name and not given.done()]
        given.set_exception(what) if isinstance(what, Exception) else given.set_result(what)


@pytest.fixture
def pieces() -> Pieces:
    return Pieces()


def test_who_was_beside_a_deadly_piece_is_done_again_alone(pieces: Pieces) -> None:
    deadly, beside, other = (pieces.give(name) for name in ("deadly", "beside", "other"))
    pieces.end("deadly", Lost("took two"))
    pieces.end("beside", Lost("took two"))
    assert pieces.under_way() == ["other"]  # nothing is begun again beside it
    pieces.end("other", "well")
    assert pieces.under_way() == ["deadly"] and other.result() == "well"
    pieces.end("deadly", Lost("took two more"))
    with pytest.raises(Lost, match="took two more"):
        deadly.result()
    assert pieces.under_way() == ["beside"] and not beside.done()
    pieces.end("beside", "well too")
    assert beside.result() == "well too" and pieces.under_way() == []


def test_what_ended_by_itself_is_not_done_again(pieces: Pieces) -> None:
    ended = pieces.give("a")
    pieces.end("a", Ended("ended with code 9"))
    with pytest.raises(Ended, match="code 9"):
        ended.result()
    assert len(pieces.tries) == 1


def test_what_is_given_meanwhile_comes_before_what_waits(pieces: Pieces) -> None:
    first, second = pieces.give("a"), pieces.give("b")
    pieces.end("a", Lost("lost"))
    third = pieces.give("c")
    pieces.end("b", "b")
    assert pieces.under_way() == ["c"]
    pieces.end("c", "c")
    pieces.end("a", "a")
    assert [future.result() for future in (first, second, third)] == ["a", "b", "c"]


def test_what_is_not_wanted_any_more_is_not_begun_again(pieces: Pieces) -> None:
    first, second, third = (pieces.give(name) for name in "abc")
    pieces.end("a", Lost("lost"))
    pieces.end("b", Lost("lost"))
    first.cancel()
    pieces.end("c", "c")
    assert pieces.under_way() == ["b"] and third.result() == "c"
    second.cancel()
    assert pieces.tries[-1][1].cancelled() and pieces.under_way() == []


def test_a_piece_that_cannot_be_begun_holds_nobody_up(pieces: Pieces) -> None:
    def begin() -> Future[str]:
        raise OSError("no place left")

    with pytest.raises(OSError, match="no place"):
        pieces.chances.give(begin)
    lost = pieces.give("a")
    pieces.end("a", Lost("lost"))
    assert pieces.under_way() == ["a"]
    pieces.end("a", "a")
    assert lost.result() == "a"
