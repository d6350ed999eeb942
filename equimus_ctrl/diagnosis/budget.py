"""How long a diagnosis may go on: until its time is up, or until its best so far is asked for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

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
        until: the time is up, by ``time.perf_counter`` [s].
        asked: see ``Asked``.
    """

    until: float = math.inf
    asked: Asked = never

    def check(self) -> None:
        """Raise BudgetSpent where it is time to end."""
        if self.asked() or time.perf_counter() > self.until:
            raise BudgetSpent
