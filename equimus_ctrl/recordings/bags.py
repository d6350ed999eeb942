"""rosbag2 bags (SQLite and MCAP), read by the rosbags library: any topics, of whatever messages.

Without a mapping, positions are those of the ``sensor_msgs/msg/JointState`` that has the robot's joints, and commands
those of the one topic that says it is commands: a ``trajectory_msgs/msg/JointTrajectory`` of single points, or, where
the topic's name has a word for it, a ``std_msgs/msg/Float64MultiArray`` or another ``JointState``. Where there is none
or several, a mapping chooses. The order of an array's numbers is in its layout's labels or in a mapping.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.errors import RecordingError, needs
from equimus_ctrl.recordings.assemble import elements
from equimus_ctrl.recordings.csvfile import columns
from equimus_ctrl.recordings.exported import Exported
from equimus_ctrl.recordings.logs import Loaded, Log, Table, Wanted, reading, stem
from equimus_ctrl.recordings.mapping import Mapping as ColumnMapping
from equimus_ctrl.recordings.mapping import Source
from equimus_ctrl.recordings.messages import NANO, columns_of, stamp_of

STATE = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
SCALAR = "std_msgs/msg/Float64"
COMMANDS = (ARRAY, STATE, TRAJECTORY, SCALAR)
SAY_COMMAND = ("command", "cmd", "goal", "target", "desired", "setpoint", "reference")
"""Words in the name of a topic of commands."""
WHAT = "bag"


def is_bag(path: Path) -> bool:
    """Whether a path is a folder of a bag, or a file of one."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix == ".db3"


def read_bag(path: Path) -> list[Log]:
    """The log of a bag.

    Raises:
        NotAvailable: where the rosbags library is not installed.
        RecordingError: where the bag cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise needs("rosbags", "hardware", "reading bags") from None
    with reading(path, WHAT), AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        kinds: dict[str, str] = {}
        for connection in reader.connections:
            if kinds.setdefault(connection.topic, connection.msgtype) != connection.msgtype:
                raise RecordingError(
                    f"{path}: {connection.topic} has messages of {kinds[connection.topic]} and of "
                    f"{connection.msgtype}, expected one type"
                )
    tables = tuple(Table(name, kind, partial(_load, path, name)) for name, kind in sorted(kinds.items()))
    return [Log(path, stem(path), tables, "a bag", found, {"source": path.name}, rows="message")]


def _load(path: Path, name: str) -> Loaded:
    with reading(path, WHAT):
        return columns_of(_messages(path, name))


def _messages(path: Path, name: str) -> Iterator[tuple[float, int | None, Any]]:
    """(received by the bag's clock from its first message on [s], stamped [ns], message)."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        begun = reader.start_time
        chosen = [connection for connection in reader.connections if connection.topic == name]
        for connection, received, raw in reader.messages(connections=chosen):
            message: Any = reader.deserialize(raw, connection.msgtype)
            yield (received - begun) / NANO, stamp_of(message), message


def found(log: Log, wanted: Wanted, mapping: ColumnMapping) -> dict[str, Source]:
    """Columns of a recording by the kinds of topics and the robot's names.

    Raises:
        RecordingError: where there is no such topic, several could be meant, or one lacks a joint or actuator.
    """
    states = _states(log, wanted, mapping)
    sources: dict[str, Source] = {}
    if not any(target.startswith("pos.") for target in mapping.columns):
        sources = elements(log, states, "position", wanted.joints, "pos", mapping, {})
    if wanted.actuators and not any(target.startswith("cmd.") for target in mapping.columns):
        sources |= _commands(log, _command_topic(log, states, mapping), wanted, mapping)
    return sources


def _states(log: Log, wanted: Wanted, mapping: ColumnMapping) -> Table:
    if mapping.topics.states:
        return _of_kind(log, mapping.topics.states, (STATE,))
    own = [table for table in log.tables if table.kind == STATE]
    if not own:
        raise _no_topic(log, STATE, "states")
    full = [table for table in own if all(f"position.{joint}" in table.columns for joint in wanted.joints)]
    usual = [table for table in full if table.name.endswith("joint_states")]
    if len(full) == 1 or len(usual) == 1:
        return (usual or full)[0]
    if len(full) > 1:
        raise _several(log, full, "states")
    if len(own) > 1:
        raise RecordingError(
            f"{log.where}: none of {', '.join(table.name for table in own)} has the positions of "
            f"{', '.join(wanted.joints)}; expected one that has, or a mapping"
        )
    return own[0]  # what it lacks is told where its elements are looked for


def _command_topic(log: Log, states: Table, mapping: ColumnMapping) -> Table:
    if mapping.topics.commands:
        return _of_kind(log, mapping.topics.commands, COMMANDS)
    own = [table for table in log.tables if table.kind in COMMANDS and table is not states]
    if not own:
        raise _no_topic(log, " or ".join(COMMANDS), "commands")
    said = [
        table for table in own if table.kind == TRAJECTORY or any(word in table.name.lower() for word in SAY_COMMAND)
    ]
    if len(said) != 1:  # a filtered state is no command, however alike the two are
        raise _several(log, said or own, "commands")
    return said[0]


def _of_kind(log: Log, name: str, kinds: tuple[str, ...]) -> Table:
    table = log.topic(name)
    if table.kind not in kinds:
        raise RecordingError(f"{log.where}: {name} holds {table.kind}, expected {' or '.join(kinds)}")
    return table


def _no_topic(log: Log, kind: str, what: str) -> RecordingError:
    known = ", ".join(f"{table.name} ({table.kind})" for table in log.tables) or "none"
    return RecordingError(f"{log.where}: there is no topic of {kind} for {what} (known: {known})")


def _several(log: Log, tables: list[Table], what: str) -> RecordingError:
    return RecordingError(
        f"{log.where}: {', '.join(table.name for table in tables)} could be {what}; expected a mapping with "
        f"{what} under [topics]"
    )


def _commands(log: Log, table: Table, wanted: Wanted, mapping: ColumnMapping) -> dict[str, Source]:
    names = {name: wanted.command_names(name) for name in wanted.actuators}
    fields = {name: _field(unit, goal) for name, unit, goal in zip(
        wanted.actuators, wanted.command_units, wanted.goals, strict=True)}  # fmt: skip
    if table.kind in (ARRAY, SCALAR):
        labelled = {
            n: next((c for own in names[n] if (c := f"data.{own}") in table.columns), "") for n in wanted.actuators
        }
        if mapping.names.get("cmd") is None and all(labelled.values()):
            return {f"cmd.{n}": Source(column, table.name) for n, column in labelled.items()}
        _check_count(log, table, wanted, mapping)
        return elements(log, table, "data", wanted.actuators, "cmd", mapping, {})
    if table.kind == TRAJECTORY:
        return _points(log, table, wanted, fields, names)
    found: dict[str, Source] = {}
    for name in wanted.actuators:
        found |= elements(log, table, fields[name], (name,), "cmd", mapping, names)
    return found


def _check_count(log: Log, table: Table, wanted: Wanted, mapping: ColumnMapping) -> None:
    count = sum(column == "data" or column.startswith("data[") for column in table.columns)
    if mapping.names.get("cmd") is None and count != len(wanted.actuators):
        raise RecordingError(
            f"{log.where}: {table.name} has {count} numbers a message, expected {len(wanted.actuators)}, one for "
            f"each of {', '.join(wanted.actuators)}"
        )


def _field(unit: str, goal: bool) -> str:
    """Which of a joint's numbers a command is."""
    if unit.endswith("/s"):
        return "velocity"
    return "position" if goal else "effort"


def _points(
    log: Log, table: Table, wanted: Wanted, fields: Mapping[str, str], names: Mapping[str, tuple[str, ...]]
) -> dict[str, Source]:
    """Of trajectories of one point each, which is a goal from when it was sent on."""
    if any(column.startswith("points[1]") for column in table.columns):
        raise RecordingError(
            f"{log.where}: {table.name} has trajectories of several points, and what its controller made of them "
            "between these is not in it; expected the topic of what was sent to the drives, or a mapping"
        )
    plural = {"position": "positions", "velocity": "velocities", "effort": "effort"}
    found: dict[str, Source] = {}
    for name in wanted.actuators:
        base = f"points[0].{plural[fields[name]]}"
        column = next((f"{base}.{own}" for own in names[name] if f"{base}.{own}" in table.columns), None)
        if column is None:
            raise log.missing(f"{base}.{name}", table)
        found[f"cmd.{name}"] = Source(column, table.name)
    return found


def write_bag(path: Path, trial: Exported) -> None:
    """A trial as a bag of ROS 2 (MCAP): ``/joint_states``, ``/commands``, and of each model position and residual.

    Stamps are whole ns; notes, and what else is measured than joints, are not in it.

    Args:
        path: of the bag's folder, which is not there yet.
        trial: with predictions.

    Raises:
        NotAvailable: where the rosbags library is not installed.
        RecordingError: where the folder cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise needs("rosbags", "logs", "writing bags") from None
    store, recording = get_typestore(Stores.ROS2_HUMBLE), trial.recording
    kinds, none = store.types, np.empty(0)
    measured = dict(columns(recording))
    seen = [column.removeprefix("pos.") for column in measured if column.startswith("pos.")]
    silent = np.full(len(recording.time), np.nan)  # a message has the velocities of all joints or of none
    rates = [measured.get(f"vel.{name}", silent) for name in seen if any(c.startswith("vel.") for c in measured)]
    nothing = np.empty((len(recording.time), 0))
    states = {
        "/joint_states": (
            seen, np.column_stack([measured[f"pos.{name}"] for name in seen]), np.column_stack([nothing, *rates])
        )
    }  # fmt: skip
    for own in trial.predictions:
        for what, block in (("position", own.position), ("residual", recording.position - own.position)):
            states[f"/{own.model}/{what}"] = (list(recording.joints), block, nothing)
    count = len(recording.actuators)  # an array does not say what its numbers are, so its layout does
    labels = kinds["std_msgs/msg/MultiArrayDimension"](",".join(recording.actuators), count, count)
    layout = kinds["std_msgs/msg/MultiArrayLayout"](dim=[labels], data_offset=0)
    half = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(half, ignore_errors=True)
        half.parent.mkdir(parents=True, exist_ok=True)
        with Writer(half / path.name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = {name: writer.add_connection(name, STATE, typestore=store) for name in states}
            sent = writer.add_connection("/commands", ARRAY, typestore=store)
            for k, at in enumerate(np.round((recording.time - recording.time[0]) * NANO).astype(np.int64).tolist()):
                stamp = kinds["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
                header = kinds["std_msgs/msg/Header"](stamp, "")
                numbers = kinds[ARRAY](layout, np.array(recording.command[k]))
                writer.write(sent, at, bytes(store.serialize_cdr(numbers, ARRAY)))
                for name, (joints, block, speeds) in states.items():
                    message = kinds[STATE](header, joints, np.array(block[k]), np.array(speeds[k]), none)
                    writer.write(topics[name], at, bytes(store.serialize_cdr(message, STATE)))
        os.replace(half / path.name, path)
    except OSError as error:
        raise RecordingError(f"{path}: the bag cannot be written ({error.strerror or error})") from None
    finally:
        shutil.rmtree(half, ignore_errors=True)
