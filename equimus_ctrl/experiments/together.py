"""Computations that run one beside the other and whose requests are answered together, many in one batch.

A batch of simulations costs little more than one alone, but an optimiser asks for one after the other. Here many
optimisers run, each in a thread that waits most of the time: once all that have not ended have asked, all requests are
answered at once, in the order of the computations, so the answers do not depend on which thread was first.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Generic, TypeVar

Q = TypeVar("Q")
A = TypeVar("A")
R = TypeVar("R")


class Ended(Exception):
    """Raised in computations that ask when all of them have been given up."""


def together(
    computations: Sequence[Callable[[Callable[[Q], A]], R]], answered: Callable[[Sequence[tuple[int, Q]]], Sequence[A]]
) -> list[R]:
    """What each of some computations comes to.

    Args:
        computations: each is called with a function that asks, and may be called as often as it likes.
        answered: answers requests (which computation, what it asks), in their order; called in the calling thread.

    Raises:
        Exception: the first one that a computation or an answer ended in; all others are given up then.
    """
    desk = _Desk[Q, A, R](len(computations))
    threads = [
        threading.Thread(target=desk.run, args=(k, own), name=f"refit-{k}", daemon=True)
        for k, own in enumerate(computations)
    ]
    for thread in threads:
        thread.start()
    try:
        return desk.serve(answered)
    finally:
        desk.close()
        for thread in threads:
            thread.join()


class _Desk(Generic[Q, A, R]):
    """Where requests and results are handed in."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.inbox: SimpleQueue[tuple[int, str, object]] = SimpleQueue()
        self.outboxes: list[SimpleQueue[tuple[bool, object]]] = [SimpleQueue() for _ in range(count)]

    def run(self, k: int, computation: Callable[[Callable[[Q], A]], R]) -> None:
        """A computation, in its thread."""

        def ask(request: Q) -> A:
            self.inbox.put((k, "asks", request))
            open_, answer = self.outboxes[k].get()
            if not open_:
                raise Ended
            return answer  # type: ignore[return-value]

        try:
            result = computation(ask)
        except Ended:
            return
        except BaseException as error:
            self.inbox.put((k, "failed", error))
        else:
            self.inbox.put((k, "done", result))

    def serve(self, answered: Callable[[Sequence[tuple[int, Q]]], Sequence[A]]) -> list[R]:
        """Answer until all have ended."""
        left, asking, results = self.count, dict[int, Q](), dict[int, R]()
        while left:
            k, what, own = self.inbox.get()
            if what == "failed":
                assert isinstance(own, BaseException)
                raise own
            if what == "done":
                results[k] = own  # type: ignore[assignment]
                left -= 1
            else:
                asking[k] = own  # type: ignore[assignment]
            if left and len(asking) == left:
                order = sorted(asking)
                answers = answered([(place, asking[place]) for place in order])
                asking = {}
                for place, answer in zip(order, answers, strict=True):
                    self.outboxes[place].put((True, answer))
        return [results[k] for k in range(self.count)]

    def close(self) -> None:
        """Whoever still asks, or will, learns that nobody answers."""
        for outbox in self.outboxes:
            outbox.put((False, None))
