"""What does work: it is given pieces and hands out what they come to, wherever they are done."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, InvalidStateError, wait
from contextlib import suppress
from itertools import islice
from typing import Any, Protocol, TypeVar

from equimus_ctrl.errors import EquimusError, one_line
from equimus_ctrl.executors.calls import Call, Ended, Gone, Unfit, opened
from equimus_ctrl.executors.second_chance import SecondChances
from equimus_ctrl.executors.versions import versions

T = TypeVar("T")
Prepare = Callable[[], object]
"""What a process has to do before its first piece of work; it can be pickled."""

AHEAD = 2
"""Pieces for each worker that are handed over: one that it does and one that waits, so that it never does. What is
there to be done is made no sooner, so of ten thousand pieces few are in memory."""


class Submits(Protocol):
    """What begins pieces of work: executors, and pools of threads."""

    def submit(self, work: Callable[..., T], /, *args: Any) -> Future[T]:
        """Begin a piece."""
        ...


class Executor(ABC):
    """Where pieces of work are done.

    A piece is a function with arguments, all of which can be pickled, and comes to the same wherever and in whatever
    order it is done. A subclass says how many are done at a time and hands one over; the rest follows.

    Args:
        prepare: see ``Prepare``.
    """

    def __init__(self, prepare: Prepare | None = None) -> None:
        self._prepare = prepare
        self._chances = SecondChances()

    @property
    @abstractmethod
    def count(self) -> int:
        """How many pieces are done at a time, as it is now."""

    @abstractmethod
    def _give(self, call: Call) -> Future[bytes]:
        """Hand a piece over; it is given again where its worker is lost. Its future can be cancelled.

        The future raises ``Ended`` where the process that did it ended, ``Lost`` where it has lost too many workers,
        ``Unfit`` where none can do it, ``Gone`` where nothing is there any more to do it.
        """

    @property
    def _required(self) -> Mapping[str, str]:
        """Versions that whoever does a piece has to have."""
        return versions()

    def _call(self, work: Callable[..., Any], args: tuple[Any, ...], apart: bool) -> Call:
        return Call.of(work, args, self._prepare, apart, self._required)

    def submit(self, work: Callable[..., T], /, *args: Any) -> Future[T]:
        """Begin a piece of work; processes that do it may have done others before."""
        return self._begin(self._call(work, args, False))

    def _begin(self, call: Call) -> Future[Any]:
        return self._chances.give(lambda: _opened(self._give(call)))

    def each(self, work: Callable[..., T], tasks: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, T]]:
        """Call a function with each task's arguments.

        Yields:
            (index of the task, result), as they are done; what is left when nobody wants more, or when one has failed,
            is dropped.
        """
        for index, future in self._done(work, tasks, False):
            yield index, future.result()

    def each_apart(self, work: Callable[..., T], tasks: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, T | Ended]]:
        """The same, each in a process of its own, which knows nothing but its task and is gone after it.

        Yields:
            (index of the task, its result, or how its process ended or what ended its work), as they are done.

        Raises:
            Unfit: where no process can do such work.
            Gone: where nothing is there any more to do it.
        """
        for index, future in self._done(work, tasks, True):
            try:
                yield index, future.result()
            except (Unfit, Gone, CancelledError):
                raise
            except Ended as error:
                yield index, error
            except EquimusError as error:
                yield index, Ended(f"ended ({one_line(str(error))})")
            except Exception as error:
                yield index, Ended(f"ended ({one_line(f'{type(error).__name__}: {error}')})")

    def _done(
        self, work: Callable[..., T], tasks: Iterable[tuple[Any, ...]], apart: bool
    ) -> Iterator[tuple[int, Future[T]]]:
        waiting: dict[Future[T], int] = {}
        left = enumerate(tasks)
        try:
            while True:
                for index, task in islice(left, max(AHEAD * self.count - len(waiting), 0)):
                    waiting[self._begin(self._call(work, task, apart))] = index
                if not waiting:
                    return
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future
        finally:
            for future in waiting:
                future.cancel()


def _opened(given: Future[bytes]) -> Future[Any]:
    """What a piece comes to in place of its bytes."""
    told: Future[Any] = Future()

    def tell(done: Future[bytes]) -> None:
        with suppress(InvalidStateError):  # cancelled meanwhile
            try:
                told.set_result(opened(done.result()))
            except CancelledError:
                told.cancel()
                told.set_running_or_notify_cancel()
            except BaseException as error:
                told.set_exception(error)

    told.add_done_callback(lambda future: given.cancel() if future.cancelled() else None)
    given.add_done_callback(tell)
    return told
