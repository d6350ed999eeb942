"""What carries measurements in and commands out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Sample:
    """One measurement as received.

    Attributes:
        stamp: by the device's clock [s].
        received: by this computer's monotonic clock [s].
        names: of joints.
        position: a number for each.
        source: who sent it; other for another publisher.
    """

    stamp: float
    received: float
    names: tuple[str, ...]
    position: tuple[float, ...]
    source: int = 0


class Transport(Protocol):
    """The controller's end."""

    def take(self) -> list[Sample]:
        """All measurements that came since the last call, in the order in which they came."""
        ...

    def prepare(self) -> None:
        """Be ready to send; until then nobody is to take this end for one that commands."""
        ...

    def send(self, values: Sequence[float]) -> None:
        """Send a command."""
        ...

    def listeners(self) -> int:
        """How many hear what is sent."""
        ...

    def trouble(self) -> str:
        """What is wrong with who else is on the wire, in words; empty where nothing is."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Device(Protocol):
    """The robot's end, which an emulator plays."""

    def publish(self, stamp: float, names: Sequence[str], position: Sequence[float]) -> None:
        """Send a measurement."""
        ...

    def take(self) -> list[tuple[float, ...]]:
        """All commands that came since the last call."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...
