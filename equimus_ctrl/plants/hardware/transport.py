"""What carries measurements in and commands out; another one is a file with a class and a line in ``TRANSPORTS``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from equimus_ctrl.errors import ConfigError, NotAvailable, unknown_name
from equimus_ctrl.plants.hardware.settings import Wire


@dataclass(frozen=True)
class Sample:
    """One measurement as it came.

    Attributes:
        stamp: by the device's clock [s].
        received: by this machine's monotonic clock [s].
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

    def send(self, values: Sequence[float]) -> None:
        """Send a command."""
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


@dataclass(frozen=True)
class TransportEntry:
    """A transport known by name.

    Attributes:
        summary: one line for lists.
        host: wire → the controller's end.
        device: wire → the robot's end.
    """

    summary: str
    host: Callable[[Wire], Transport]
    device: Callable[[Wire], Device]


def _dds_host(wire: Wire) -> Transport:
    _require_dds()
    from equimus_ctrl.plants.hardware.dds import DdsHost

    return DdsHost(wire)


def _dds_device(wire: Wire) -> Device:
    _require_dds()
    from equimus_ctrl.plants.hardware.dds import DdsDevice

    return DdsDevice(wire)


def _require_dds() -> None:
    try:
        import cyclonedds.core  # noqa: F401
    except ImportError:
        raise NotAvailable(
            "the transport dds needs Cyclone DDS, which is not installed; get it with: pip install "
            "'equimus-ctrl[hardware]'"
        ) from None


TRANSPORTS: dict[str, TransportEntry] = {
    "dds": TransportEntry("ROS 2 topics by Cyclone DDS, no ROS installation needed", _dds_host, _dds_device),
}


def transport_entry(name: str) -> TransportEntry:
    """A transport by name.

    Raises:
        ConfigError: for an unknown name.
    """
    if name not in TRANSPORTS:
        raise ConfigError(unknown_name("transport", name, TRANSPORTS))
    return TRANSPORTS[name]
