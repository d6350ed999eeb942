"""rosbag2 bags (SQLite and MCAP) with a robot's two topics, read as a recording by the rosbags library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.errors import NotAvailable, RecordingError
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.clocks import ClockMap
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.messages import NANO
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.types import Array, Recording

TYPES = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray")


def read_bag(path: Path, model: Model, settings: HardwareSettings | None = None) -> Recording:
    """A bag's two topics as one trial, rows where angles were measured or a command came.

    Times are those of the bag's own clock from its first message on; stamps of angles are brought onto it by the
    quickest of their messages, as ``HardwarePlant`` does. Where a row has no measurement of its own, angles lie
    between those around it; rows begin with the first measurement after the first command, and end with the last.

    Args:
        path: the bag's folder or file.
        model: of the robot.
        settings: topics, names, units and signs.

    Raises:
        NotAvailable: where the rosbags library is not installed.
        RecordingError: where the bag cannot be read, or lacks a topic, a joint or enough messages.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.rosbag2 import ReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise NotAvailable(
            "reading bags needs the rosbags library, which is not installed; get it with: pip install "
            "'equimus-ctrl[hardware]'"
        ) from None
    settings = settings or HardwareSettings()
    own = interface_of(settings, model.robot, limited=False)
    joints, channels, wire = own.calibrations, own.channels, own.wire
    wanted = dict(zip((wire.states, wire.commands), TYPES, strict=True))
    found: dict[str, list[tuple[float, float, list[float]]]] = {topic: [] for topic in wanted}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = [connection for connection in reader.connections if connection.topic in wanted]
            for connection in chosen:
                if connection.msgtype != wanted[connection.topic]:
                    raise RecordingError(
                        f"{path}: {connection.topic} holds {connection.msgtype}, expected {wanted[connection.topic]}"
                    )
            for topic in wanted:
                if not any(connection.topic == topic for connection in chosen):
                    known = ", ".join(sorted(connection.topic for connection in reader.connections)) or "none"
                    raise RecordingError(f"{path}: there is no topic {topic} (known: {known})")
            begun = reader.start_time
            for connection, received, raw in reader.messages(connections=chosen):
                message: Any = reader.deserialize(raw, connection.msgtype)
                at = (received - begun) / NANO
                if connection.topic == wire.states:
                    names = list(message.name)
                    for joint in joints:
                        if joint.name not in names or names.index(joint.name) >= len(message.position):
                            raise RecordingError(
                                f"{path}: {connection.topic} at {at:.3f} s has joints {', '.join(names) or 'none'}, "
                                f"expected {', '.join(c.name for c in joints)} with a position each"
                            )
                    values = [j.scale * (message.position[names.index(j.name)] - j.zero) for j in joints]
                    stamp = message.header.stamp.sec + message.header.stamp.nanosec / NANO
                else:
                    if len(message.data) != len(channels):
                        raise RecordingError(
                            f"{path}: {connection.topic} at {at:.3f} s has {len(message.data)} numbers, expected "
                            f"{len(channels)}"
                        )
                    values, stamp = own.command(message.data).tolist(), at
                if not np.all(np.isfinite(values)):
                    raise RecordingError(f"{path}: {connection.topic} at {at:.3f} s is {values}, expected numbers")
                found[connection.topic].append((stamp, at, [float(value) for value in values]))
    except (AnyReaderError, ReaderError, OSError) as error:
        raise RecordingError(f"{path}: is no bag that can be read ({error})") from None
    measured, commanded = found[wire.states], found[wire.commands]
    if len(measured) < 2 or not commanded:
        raise RecordingError(
            f"{path}: holds {len(measured)} measurements and {len(commanded)} commands, expected at least 2 and 1"
        )
    times, angles = _on_one_clock(measured)
    return _together(path, model, times, angles, commanded)


def _on_one_clock(measured: list[tuple[float, float, list[float]]]) -> tuple[Array, Array]:
    """(n,) ascending times by the bag's clock [s] and (n, nj) angles; duplicates and stragglers are dropped."""
    clock = ClockMap.of(*measured[0][:2])
    last = -np.inf
    times: list[float] = []
    angles: list[list[float]] = []
    for stamp, at, values in measured:
        clock = clock.seen(stamp, at)
        if stamp > last and (not times or clock.local(stamp) > times[-1]):
            times.append(clock.local(stamp))
            angles.append(values)
            last = stamp
    return np.array(times), np.array(angles)


def _together(
    path: Path, model: Model, times: Array, angles: Array, commanded: list[tuple[float, float, list[float]]]
) -> Recording:
    robot = model.robot
    sent = np.array([at for _, at, _ in commanded])
    pressures = np.array([values for _, _, values in commanded])
    begin = max(times[0], sent[0])
    changes = np.flatnonzero(np.r_[True, np.any(np.diff(pressures, axis=0) != 0, axis=1)])
    rows = np.union1d(times, sent[changes])
    rows = rows[(rows >= begin) & (rows <= times[-1])]
    if len(rows) < 2:
        raise RecordingError(f"{path}: no two measurements lie after the first command, expected some")
    inside = np.searchsorted(sent, rows, side="right") - 1
    position = np.stack([np.interp(rows, times, column) for column in angles.T], axis=1)
    earlier = np.flatnonzero(sent < begin)
    before = pressures[earlier[-1]] if len(earlier) else pressures[0]
    return Recording(
        path.stem, rows - rows[0], pressures[inside], position, robot.actuator_names, robot.joint_names,
        before=before, notes={"source": path.name},
    )  # fmt: skip
