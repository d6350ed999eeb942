"""Counts out of counts, and how sure they are."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

SURE = 1.959964
"""Quantile of the normal distribution for 95 %."""


@dataclass(frozen=True)
class Share:
    """So many out of so many.

    Attributes:
        count: that did.
        of: that could.
    """

    count: int
    of: int

    @classmethod
    def among(cls, outcomes: Iterable[bool]) -> Share:
        """How many of the outcomes are true."""
        counted = list(outcomes)
        return cls(sum(counted), len(counted))

    @property
    def value(self) -> float:
        """Between 0 and 1; nan of nothing."""
        return self.count / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """That holds the true share in 95 % of all samples (Wilson, 1927); all there is where nothing was counted."""
        if not self.of:
            return 0.0, 1.0
        n, p, z2 = self.of, self.value, SURE**2
        centre = (p + z2 / (2 * n)) / (1 + z2 / n)
        width = SURE / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
        # At the ends the formula gives them to rounding.
        low = 0.0 if self.count == 0 else centre - width
        return low, 1.0 if self.count == n else centre + width

    def can_show(self, low: float, high: float) -> bool:
        """Whether some outcome of so many has its interval between two shares."""
        outcomes = (Share(count, self.of) for count in range(math.ceil(low * self.of), math.floor(high * self.of) + 1))
        return self.of > 0 and any(low <= ends[0] and ends[1] <= high for ends in (own.interval for own in outcomes))

    def __str__(self) -> str:
        """For people, such as ``97.5 % (39/40)``."""
        return f"{100 * self.value:.1f} % ({self.count}/{self.of})" if self.of else "–"

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null where there was nothing to count."""
        low, high = self.interval
        return {"count": self.count, "of": self.of, "share": self.value if self.of else None, "low": low, "high": high}
