"""Work in processes and threads of this computer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from equimus_ctrl import computer
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.calls import Call, perform
from equimus_ctrl.executors.child import Child

T = TypeVar("T")


class OnThisComputer(Executor):
    """Processes of this computer. One worker alone is this process, but for pieces that are done apart."""

    def __init__(self, pool: computer.Workers, prepare: Prepare | None = None) -> None:
        super().__init__(prepare)
        self._pool = pool
        self._threads = ThreadPoolExecutor(pool.count, "apart")
        self._children: set[Child] = set()
        self._over = False

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
        return self._threads.submit(self._apart, call)

    def _apart(self, call: Call) -> bytes:
        child = Child()
        self._children.add(child)
        try:
            if self._over:  # closed while it was started
                child.end()
            return child.do(call)
        finally:
            self._children.discard(child)
            child.end()

    def _done(self, *given: Any) -> Iterator[tuple[int, Future[Any]]]:
        try:
            yield from super()._done(*given)
        finally:  # what still runs is not wanted
            for child in list(self._children):
                child.end()

    def close(self) -> None:
        """End all that is still being done apart."""
        self._over = True
        for child in list(self._children):
            child.end()
        self._threads.shutdown(cancel_futures=True)


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
