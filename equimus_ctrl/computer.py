"""What the computer at hand offers: processors, and processes to use them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor
from contextlib import contextmanager

from loky import ProcessPoolExecutor

from equimus_ctrl.errors import NotAvailable


def processors() -> int:
    """How many processors this process may use; fewer than the computer has where an affinity says so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def processes(count: int | None = None) -> Iterator[Executor | None]:
    """Processes for work that threads cannot share, such as calls into CasADi; what is left undone ends with them.

    They are fresh, not forked, for a fork copies locks that other threads may hold, and they do not hear Ctrl-C: who
    started them ends them. Scripts need no ``if __name__ == "__main__"`` for them.

    Args:
        count: how many; all usable processors by default.

    Yields:
        The processes, or None for one: then the caller does the work itself.

    Raises:
        NotAvailable: where one of them was ended from outside.
    """
    count = count or processors()
    if count == 1:
        yield None
        return
    pool = ProcessPoolExecutor(count, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN))
    try:
        yield pool
    except BrokenExecutor:
        raise NotAvailable(
            f"one of {count} processes that did a part of the work was ended from outside, perhaps for want of memory; "
            "one thread alone takes least"
        ) from None
    finally:
        pool.shutdown(kill_workers=True)
