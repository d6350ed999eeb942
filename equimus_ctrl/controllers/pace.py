"""Iterations that have to end before a deadline."""

from __future__ import annotations

from collections.abc import Callable

SLOWER = 1.2
"""By so much may an iteration take longer than at the instant before and still count as typical."""


class Pace:
    """Whether another iteration is likely to end before the deadline.

    Args:
        now: a clock [s].
        deadline: how long after that all is to be done [s]; 0 for no deadline, then no clock is read.
        expected: what an iteration is known to take [s]; 0 where nothing is known.
    """

    def __init__(self, now: Callable[[], float], deadline: float, expected: float) -> None:
        self._now, self._deadline, self._expected = now, deadline, expected
        self._begun = now() if deadline else 0.0
        self._iterating: float | None = None
        self._longest = 0.0

    def enough(self) -> bool:
        """Whether no further iteration is to begin."""
        if not self._deadline:
            return False
        now = self._ended()
        over = now + max(self._longest, self._expected) > self._begun + self._deadline
        self._iterating = None if over else now
        return over

    def end(self) -> float:
        """How long after the step began all iterations have ended [s]."""
        return self._ended() - self._begun if self._deadline else 0.0

    @property
    def expected(self) -> float:
        """What an iteration is to be known to take from now on [s]: one that was held up is not taken as the rule."""
        if self._longest == 0:
            return self._expected
        return min(self._longest, SLOWER * self._expected) if self._expected else self._longest

    def _ended(self) -> float:
        now = self._now()
        if self._iterating is not None:
            self._longest, self._iterating = max(self._longest, now - self._iterating), None
        return now
