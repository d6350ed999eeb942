"""Work in processes and threads of this computer."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from equimus_ctrl import computer
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.calls import Call, Ended, perform
from equimus_ctrl.executors.child import Child

T = TypeVar("T")


class OnThisComputer(Executor):
    """Processes of this computer. One worker alone is this process, but for pieces that are done apart."""

    def __init__(self, pool: computer.Workers, prepare: Prepare | None = None) -> None:
        super().__init__(prepare)
        self._pool = pool
        self._threads = ThreadPoolExecutor(pool.count, "apart")
        self._given: set[Future[bytes]] = set()

    @property
    def count(self) -> int:
        return self._pool.count

    @property
    def _required(self) -> Mapping[str, str]:
        """None: a file that is edited meanwhile is not to end hours of work; answers say what they were made by."""
        return {}

    def submit(self, work: Callable[..., T], /, *args: Any) -> Future[T]:
        return self._pool.submit(work, *args)

    def each(self, work: Callable[..., T], tasks: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, T]]:
        return self._pool.each(work, tasks)

    def _give(self, call: Call) -> Future[bytes]:
        told: Future[bytes] = Future()
        piece = _Apart(call)
        told.add_done_callback(lambda done: piece.end() if done.cancelled() else None)
        self._given.add(told)
        self._threads.submit(self._tell, piece, told)
        return told

    def _tell(self, piece: _Apart, told: Future[bytes]) -> None:
        with suppress(InvalidStateError):  # cancelled meanwhile
            try:
                told.set_result(piece.do())
            except BaseException as error:
                told.set_exception(error)
        self._given.discard(told)

    def close(self) -> None:
        """End all that is still being done apart."""
        for told in list(self._given):
            told.cancel()
        self._threads.shutdown(cancel_futures=True)


class _Apart:
    """A piece that a process of its own does, and that may not be wanted any more before or after that is there."""

    def __init__(self, call: Call) -> None:
        self._call = call
        self._lock = threading.Lock()
        self._child: Child | None = None
        self._over = False

    def do(self) -> bytes:
        with self._lock:
            if self._over:
                raise Ended("was not begun")
            self._child = child = Child()
        try:
            return child.do(self._call)
        finally:
            child.end()

    def end(self) -> None:
        with self._lock:
            self._over = True
            if self._child is not None:
                self._child.end()


class InThreads(Executor):
    """Threads of this process, for work that lets others do something meanwhile."""

    def __init__(self, pool: ThreadPoolExecutor, count: int) -> None:
        super().__init__()
        self._pool, self._count = pool, count

    @property
    def count(self) -> int:
        return self._count

    def submit(self, work: Callable[..., T], /, *args: Any) -> Future[T]:
        return self._pool.submit(work, *args)

    def _give(self, call: Call) -> Future[bytes]:
        return self._pool.submit(perform, call)


@contextmanager
def in_threads(asked: int | None = None) -> Iterator[InThreads]:
    """Threads of this process, as many as there are usable processors by default."""
    count = computer.worker_count(asked)
    with ThreadPoolExecutor(count) as pool:
        yield InThreads(pool, count)


@contextmanager
def on_this_computer(
    asked: int | None = None, tasks: int | None = None, prepare: Prepare | None = None
) -> Iterator[OnThisComputer]:
    """Processes of this computer, see ``computer.workers``."""
    with computer.workers(asked, tasks, prepare) as pool:
        executor = OnThisComputer(pool, prepare)
        try:
            yield executor
        finally:
            executor.close()
