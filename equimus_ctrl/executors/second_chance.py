"""A second chance for pieces of work that went down with their workers."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from typing import Any

from equimus_ctrl.executors.calls import Lost

Begin = Callable[[], "Future[Any]"]
"""Begins a piece of work; each time anew."""


class SecondChances:
    """Pieces that were lost beside others are done once more, by themselves.

    Where a worker that does several pieces is lost, none of them tells which one ended it, and a piece that was beside
    a deadly one again and again would be taken for one itself. So a piece that raises ``Lost`` waits until everything
    else is done, then is done alone, one after the other: what is lost even so has ended its worker itself.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._beside, self._alone = 0, False
        self._waiting: deque[tuple[Begin, Future[Any]]] = deque()

    def give(self, begin: Begin) -> Future[Any]:
        """Begin a piece.

        Returns:
            What it comes to, at the first or at the second try; it can be cancelled.
        """
        with self._lock:
            self._beside += 1
        told: Future[Any] = Future()
        try:
            self._follow(begin, told, False)
        except BaseException:
            with self._lock:
                self._beside -= 1
            raise
        return told

    def _follow(self, begin: Begin, told: Future[Any], alone: bool) -> None:
        given = begin()
        told.add_done_callback(lambda future: given.cancel() if future.cancelled() else None)
        given.add_done_callback(lambda done: self._over(done, begin, told, alone))

    def _over(self, done: Future[Any], begin: Begin, told: Future[Any], alone: bool) -> None:
        again = not alone and not done.cancelled() and isinstance(done.exception(), Lost)
        with self._lock:
            if alone:
                self._alone = False
            else:
                self._beside -= 1
            if again:
                self._waiting.append((begin, told))
        if not again:
            _pass_on(done, told)
        self._go_on()

    def _go_on(self) -> None:
        """Begin the next of those that wait, if nothing else is done."""
        while True:
            with self._lock:
                if self._alone or self._beside or not self._waiting:
                    return
                begin, told = self._waiting.popleft()
                if told.cancelled():
                    continue
                self._alone = True
            try:
                self._follow(begin, told, True)
            except BaseException as error:
                with self._lock:
                    self._alone = False
                with suppress(InvalidStateError):  # cancelled meanwhile
                    told.set_exception(error)


def _pass_on(done: Future[Any], told: Future[Any]) -> None:
    with suppress(InvalidStateError):  # cancelled meanwhile
        if done.cancelled():
            told.cancel()
            told.set_running_or_notify_cancel()
        elif (error := done.exception()) is not None:
            told.set_exception(error)
        else:
            told.set_result(done.result())
