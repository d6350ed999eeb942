"""What the computer at hand offers: processors, and processes and threads that share out work."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor, as_completed
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from functools import cache, lru_cache
from multiprocessing import resource_tracker
from typing import Any, ParamSpec, TypeVar

import loky
from threadpoolctl import threadpool_limits

from equimus_ctrl.errors import ConfigError, NotAvailable

P = ParamSpec("P")
T = TypeVar("T")
U = TypeVar("U")

ONE_THREAD = {f"{library}_THREADS": "1" for library in ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "VECLIB_MAXIMUM")}
"""Environment in which linear algebra has one thread: the processors are busy with other processes."""


LOSSES = 2
"""How many times in a row processes may be ended from outside before any more of their work is done."""

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8
"""Parameters of mallopt(3), by the numbers that glibc's malloc.h gives them."""


def keep_freed_memory() -> None:
    """Have this process reuse the memory that it frees, in place of giving it back and asking for it again.

    By default glibc returns each large array to the system when it is freed, and the next one is cleared page by page:
    a quarter of the processor time of a diagnosis. All threads then share one heap. It changes no result, and does
    nothing where the C library is another.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, -1)


@cache
def processors() -> int:
    """How many processors this process may use.

    Fewer than the computer has where an affinity, a quota of its control group or LOKY_MAX_CPU_COUNT says so.
    """
    return int(loky.cpu_count())


def worker_count(asked: int | None = None, tasks: int | None = None, name: str = "workers") -> int:
    """How many processes or threads share some work.

    Args:
        asked: by the user; as many as there are usable processors by default.
        tasks: how many pieces the work has; no more than one worker a piece.
        name: of the number, for the error.

    Raises:
        ConfigError: where less than one is asked for.
    """
    if asked is not None and asked < 1:
        raise ConfigError(f"{name} is {asked}, expected at least 1")
    count = asked or processors()
    return count if tasks is None else max(min(count, tasks), 1)


class Workers:
    """Processes for work that threads cannot share; of one, this process is the only worker.

    What a piece of work comes to does not depend on their number: linear algebra has one thread in all of them.

    Attributes:
        count: how many work.
    """

    def __init__(self, make: Callable[[], loky.ProcessPoolExecutor] | None = None, count: int = 1) -> None:
        self._make = make
        self._pool = None if make is None else make()
        self.count = count

    def start(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Callable[[], T]:
        """Begin a piece of work; what is returned waits for its result, or does it then where this is the only worker.

        The function and its arguments can be pickled.
        """
        if self._pool is None:
            return cache(lambda: _alone(work, *args, **kwargs))
        return self.submit(work, *args, **kwargs).result

    def submit(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """The same as a future, done already where this is the only worker."""
        if self._pool is not None:
            with _deaf():
                given: Future[T] = self._pool.submit(work, *args, **kwargs)
            return given
        future: Future[T] = Future()
        try:
            future.set_result(_alone(work, *args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future

    def each(self, work: Callable[..., T], tasks: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, T]]:
        """Call a function with each task's arguments; what a process had begun that was ended is given to another.

        Yields:
            (index of the task, result), as they are done; tasks that have not begun when nobody wants more, or when one
            has failed, are dropped.

        Raises:
            BrokenExecutor: where so many times in a row, see ``LOSSES``, processes were ended before any task was done.
        """
        left = dict(enumerate(tasks))
        if self._pool is None or len(left) < 2:
            yield from ((index, _alone(work, *task)) for index, task in left.items())
            return
        losses = 0
        while left:
            waiting: dict[Future[T], int] = {}
            try:
                for index, task in left.items():
                    waiting[self.submit(work, *task)] = index
                for done in as_completed(waiting):
                    result = done.result()
                    del left[waiting[done]]
                    losses = 0
                    yield waiting[done], result
            except BrokenExecutor:
                losses += 1
                if losses > LOSSES:
                    raise
                self.end()
                assert self._make is not None
                self._pool = self._make()
            finally:
                for future in waiting:
                    future.cancel()

    def end(self) -> None:
        """End all processes, whatever they do."""
        if self._pool is not None:
            self._pool.shutdown(kill_workers=True)


def _alone(work: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    with threadpool_limits(limits=1, user_api="blas"):
        return work(*args, **kwargs)


@contextmanager
def workers(
    asked: int | None = None, tasks: int | None = None, prepare: Callable[[], object] | None = None
) -> Iterator[Workers]:
    """Processes that share work; what is left undone at the end, or when Ctrl-C is pressed, ends with them at once.

    They are fresh, not forked, for a fork copies locks that other threads may hold, and they do not hear Ctrl-C: who
    started them ends them. Scripts need no ``if __name__ == "__main__"`` for them.

    Args:
        asked: by the user; as many as there are usable processors by default.
        tasks: how many pieces the work has, where it is known; no more than one worker a piece.
        prepare: called in each process that begins, such as to load what a user's files define.

    Raises:
        ConfigError: where less than one is asked for.
        NotAvailable: where processes were ended from outside.
    """
    count = worker_count(asked, tasks)
    if count == 1:
        yield Workers()
        return
    own = Workers(
        lambda: loky.ProcessPoolExecutor(count, initializer=_begin, initargs=(prepare,), env=ONE_THREAD), count
    )
    try:
        yield own
    except BrokenExecutor:
        raise NotAvailable(
            f"one of {count} processes that did a part of the work was ended from outside, perhaps for want of memory; "
            "one alone takes least"
        ) from None
    finally:
        own.end()


def _begin(prepare: Callable[[], object] | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if prepare is not None:
        prepare()


@lru_cache(maxsize=8)
def threads(count: int) -> ThreadPoolExecutor:
    """So many threads, which stay: a search simulates thousands of times. Work given to them gives them none itself."""
    return ThreadPoolExecutor(count, "simulate")


def in_threads(count: int, work: Callable[..., T], *given: Iterable[Any]) -> list[T]:
    """The results of work for each row of what is given, in order, by so many threads; with one, in the calling thread.

    Raises:
        ValueError: where there is more of some of it than of others.
    """
    rows = list(zip(*given, strict=True))
    if count <= 1:
        return [work(*row) for row in rows]
    return list(threads(count).map(lambda row: work(*row), rows))


@lru_cache(maxsize=8)
def _coordinators(count: int) -> ThreadPoolExecutor:
    """Threads for work that itself shares out pieces among those of ``threads``."""
    return ThreadPoolExecutor(count, "coordinate")


def _first_done(waiting: deque[tuple[T, Future[U]]]) -> tuple[T, U]:
    """The oldest piece under way and what it came to; still among those under way where that ends in an exception."""
    first, future = waiting[0]
    result = future.result()
    waiting.popleft()
    return first, result


def side_by_side(count: int, work: Callable[[T], U], given: Iterable[T]) -> Iterator[tuple[T, U]]:
    """Call work with each of what is given, so many at a time: while one simulates, another computes.

    The next is taken when the oldest under way is done, so a generator may leave out what earlier results made useless.
    More may be done then than with one thread, and who consumes has to leave it out again. Until the iterator is
    exhausted or closed, linear algebra has one thread in the whole process. Not to be called within ``work``: these
    threads would wait for each other.

    Yields:
        (what was given, what it came to), in the order given.
    """
    waiting = deque[tuple[T, Future[U]]]()
    with threadpool_limits(limits=1, user_api="blas"):
        if count <= 1:
            yield from ((one, work(one)) for one in given)
            return
        try:
            for one in given:
                waiting.append((one, _coordinators(count).submit(work, one)))
                if len(waiting) == count:
                    yield _first_done(waiting)
            while waiting:
                yield _first_done(waiting)
        finally:
            for _, future in waiting:
                future.cancel()
            wait_for([future for _, future in waiting])


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes started in here do not hear Ctrl-C: who started them ends them, and hears it when they have started."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    masks = hasattr(signal, "pthread_sigmask")
    if masks:
        resource_tracker.ensure_running()  # which would end the blocking of signals where it begins only below
    heard = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    # A blocked signal stays so in the new process; here another thread may still hear it.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
        if heard:
            signal.raise_signal(signal.SIGINT)
