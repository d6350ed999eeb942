"""The transports known by name; another one is a file with both its ends and a line in ``TRANSPORTS``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError, NotAvailable, unknown_name
from equimus_ctrl.plants.hardware.settings import Wire
from equimus_ctrl.plants.hardware.transport import Device, Transport


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
