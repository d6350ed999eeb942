"""Stamps of a device's clock on this computer's: the quickest samples show the offset between the clocks."""

from __future__ import annotations

from dataclasses import dataclass, replace

WINDOW = 10.0
"""Of samples the quickest of this long, and of the time before, counts [s]: clocks drift apart."""


@dataclass(frozen=True)
class ClockMap:
    """The offset between two clocks.

    Attributes:
        offset: this computer's time less the device's, by the quickest recent sample [s].
        quickest: the same of the window that is not over [s].
        until: when that one is over, by this computer's clock [s].
    """

    offset: float
    quickest: float
    until: float

    @classmethod
    def of(cls, stamp: float, received: float) -> ClockMap:
        """From a first sample: by the device's clock and by this computer's [s]."""
        offset = received - stamp
        return cls(offset, offset, received + WINDOW)

    def seen(self, stamp: float, received: float) -> ClockMap:
        """With one more sample."""
        offset = received - stamp
        if received > self.until:
            return ClockMap(min(self.quickest, offset), offset, received + WINDOW)
        return replace(self, offset=min(self.offset, offset), quickest=min(self.quickest, offset))

    def local(self, stamp: float) -> float:
        """A stamp by this computer's clock, as if its sample had come as quickly as the quickest [s]."""
        return stamp + self.offset

    def lateness(self, stamp: float, received: float) -> float:
        """By how much later than that it came; far below 0 where the device's clock has jumped ahead [s]."""
        return received - stamp - self.offset
