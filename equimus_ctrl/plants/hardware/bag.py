"""Recordings of the two topics in a rosbag2 bag that hardware settings name; the bag ``recordings.bags`` reads."""

from __future__ import annotations

from pathlib import Path

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.interface import Interface, interface_of
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.recordings import Limits
from equimus_ctrl.recordings.assemble import recording_of
from equimus_ctrl.recordings.bags import ARRAY, STATE
from equimus_ctrl.recordings.bags import read_bag as read_log
from equimus_ctrl.recordings.mapping import Clock, Mapping, Source
from equimus_ctrl.types import Recording


def read_bag(path: Path, model: Model, settings: HardwareSettings | None = None) -> Recording:
    """A bag's two topics as one trial, rows where angles were measured or a command came.

    Times are those of the bag's own clock from its first message on; stamps of angles are brought onto it by the
    quickest of their messages, as ``HardwarePlant`` does. Where a row has no measurement of its own, angles lie
    between those around it; rows begin with the first measurement after the first command, and end with the last. The
    order of the numbers of a command is that of the settings, not of the bag.

    Args:
        path: the bag's folder or file.
        model: of the robot.
        settings: topics, names, units and signs.

    Raises:
        NotAvailable: where the rosbags library is not installed.
        RecordingError: where the bag cannot be read, or lacks a topic, a joint or enough messages.
    """
    robot = model.robot
    own = interface_of(settings or HardwareSettings(), robot, limited=False)
    (log,) = read_log(path)
    for topic, kind in ((own.wire.states, STATE), (own.wire.commands, ARRAY)):
        if (there := log.topic(topic).kind) != kind:
            raise RecordingError(f"{path}: {topic} holds {there}, expected {kind}")
    count = sum(column.startswith("data[") for column in log.topic(own.wire.commands).columns)
    if count != len(own.channels):
        raise RecordingError(f"{path}: {own.wire.commands} has {count} numbers, expected {len(own.channels)}")
    limits = Limits.of_mjcf(robot.joint_names, robot.actuator_names)
    return recording_of(log, limits, mapping=mapping_of(own, robot.joint_names, robot.actuator_names))


def mapping_of(own: Interface, joints: tuple[str, ...], actuators: tuple[str, ...]) -> Mapping:
    """What hardware settings say of a bag's columns: position = scale · (number − zero), command = unit · number."""
    columns = {
        f"pos.{joint}": Source(
            f"position.{c.name}", own.wire.states, scale=abs(c.scale), sign=1 if c.scale > 0 else -1, offset=c.zero
        )
        for joint, c in zip(joints, own.calibrations, strict=True)
    }
    columns |= {
        f"cmd.{name}": Source(f"data[{c.index}]", own.wire.commands, scale=abs(c.unit), sign=1 if c.unit > 0 else -1)
        for name, c in zip(actuators, own.channels, strict=True)
    }
    return Mapping(columns, Clock(rows="all"), where="hardware settings")
