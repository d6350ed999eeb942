"""Stamps of a device's clock on this machine's: the samples that came quickest tell how far the clocks are apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

WINDOW = 10.0
"""Of samples the quickest of this long, and of the time before, counts [s]: clocks drift apart."""


@dataclass(frozen=True)
class ClockMap:
    """How far two clocks are apart.

    Attributes:
        offset: this machine's time less the device's, as of the quickest sample of late [s].
        quickest: the same of the window that is not over [s].
        until: when that one is over, by this machine's clock [s].
    """

    offset: float
    quickest: float
    until: float

    @classmethod
    def of(cls, stamp: float, received: float) -> ClockMap:
        """From a first sample: by the device's clock and by this machine's [s]."""
        apart = received - stamp
        return cls(apart, apart, received + WINDOW)

    def seen(self, stamp: float, received: float) -> ClockMap:
        """With one more sample."""
        apart = received - stamp
        if received > self.until:
            return ClockMap(min(self.quickest, apart), apart, received + WINDOW)
        return replace(self, offset=min(self.offset, apart), quickest=min(self.quickest, apart))

    def local(self, stamp: float) -> float:
        """A stamp by this machine's clock, as if its sample had come as quickly as the quickest [s]."""
        return stamp + self.offset

    def late(self, stamp: float, received: float) -> float:
        """By how much later than that it came; far below 0 where the device's clock has jumped ahead [s]."""
        return received - stamp - self.offset
