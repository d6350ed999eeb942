"""Work done in processes of its own, one for each piece, so many at a time."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any


def each_apart(work: Callable[..., None], tasks: Sequence[tuple[Any, ...]], workers: int) -> Iterator[tuple[int, int]]:
    """Call a function with each task's arguments in a fresh process, which can hand over files only.

    Args:
        work: a function of a module.
        tasks: arguments that can be pickled.
        workers: processes at a time.

    Yields:
        (index of the task, exit code of its process), as they end; what still runs when nobody wants more is ended.
    """
    # A fork would copy locks that threads of the numerical libraries may hold, and what this process knows.
    context = multiprocessing.get_context("spawn")
    waiting = list(enumerate(tasks))[::-1]
    running: dict[int, tuple[int, BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                index, arguments = waiting.pop()
                process: BaseProcess = context.Process(target=work, args=arguments)
                with _deaf():
                    process.start()
                running[process.sentinel] = (index, process)
            for sentinel in wait(list(running)):
                index, ended = running.pop(sentinel)  # type: ignore[arg-type]
                ended.join()
                yield index, int(ended.exitcode or 0)
    finally:
        for _, left in running.values():
            left.terminate()
        for _, left in running.values():
            left.join()


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes started in here do not hear Ctrl-C: who started them ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
