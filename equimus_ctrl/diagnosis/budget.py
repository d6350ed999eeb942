"""How long a diagnosis may go on: until its time is up, or until its best so far is asked for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from equimus_ctrl.errors import ConfigError

Asked = Callable[[], bool]
"""Whether the best so far is asked for."""


def never() -> bool:
    """Nobody asks for the best so far."""
    return False


class BudgetSpent(Exception):
    """The time is up, or the best so far was asked for."""


@dataclass(frozen=True)
class Budget:
    """When to end.

    Attributes:
        seconds: after so many the time is up.
        asked: see ``Asked``.
        begun: when it began, by ``time.perf_counter`` [s].
    """

    seconds: float = math.inf
    asked: Asked = never
    begun: float = 0.0

    @classmethod
    def beginning_now(cls, seconds: float | None, asked: Asked = never) -> Budget:
        """From now on, without end by default.

        Raises:
            ConfigError: for a time that is none.
        """
        if seconds is not None and not 0 < seconds < math.inf:
            raise ConfigError(f"the budget is {seconds:g} s, expected a time above 0")
        return cls(math.inf if seconds is None else seconds, asked, time.perf_counter())

    @property
    def over(self) -> bool:
        """Whether it is time to end."""
        return self.asked() or time.perf_counter() - self.begun > self.seconds

    def check(self) -> None:
        """Raise BudgetSpent where it is time to end."""
        if self.over:
            raise BudgetSpent

    def share(self, part: float) -> Budget:
        """It until a part of what is left by now is over, of work that other work has to follow."""
        gone = time.perf_counter() - self.begun
        return replace(self, seconds=gone + part * max(self.seconds - gone, 0.0))

    @contextmanager
    def with_nothing_yet(self) -> Iterator[None]:
        """Within it there is no best so far that could be given.

        Raises:
            KeyboardInterrupt: where it was asked for.
            ConfigError: where the time is up.
        """
        try:
            yield
        except BudgetSpent:
            if self.asked():
                raise KeyboardInterrupt from None
            raise ConfigError(
                f"the budget of {self.seconds:g} s ended before the model was refitted once; expected more time"
            ) from None
