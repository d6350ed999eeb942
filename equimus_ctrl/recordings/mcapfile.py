"""MCAP files with JSON messages: reading any, and writing recordings with predictions and residuals beside them.

What is written has a JSON schema for each kind of message and needs no ROS. Foxglove reads JSON (docs.foxglove.dev,
*Custom schema encodings*), and so does PlotJuggler: its loader takes the parser of a channel's message encoding
(docs.ros.org, ``dataload_mcap.cpp``), and that for ``json`` is its own, where that for CDR is a plug-in of ROS. Numbers
are written with as many digits as they need, so that they come back bit for bit. What ROS 2 has recorded (CDR) the
rosbags library reads.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.errors import RecordingError, needs
from equimus_ctrl.presets import check_regular, write_bytes
from equimus_ctrl.recordings import bags
from equimus_ctrl.recordings.exported import LIBRARY, Exported
from equimus_ctrl.recordings.logs import Loaded, Log, Table, notes_in, reading
from equimus_ctrl.recordings.messages import NANO, columns_of, stamp_of
from equimus_ctrl.types import Array

MAGIC = b"\x89MCAP0\r\n"
NOTES = "equimus-ctrl/recording"
TRIAL, COLUMNS, TEXTS = "trial", "columns", "notes"
WHAT = "MCAP file"


def read_mcap(path: Path) -> list[Log]:
    """The logs of a file: one a trial where we wrote it, else one of all topics.

    Raises:
        NotAvailable: where the library that reads it is not installed.
        RecordingError: where it cannot be read.
    """
    if _profile(path) == "ros2":
        return bags.read_bag(path)
    make_reader = mcap_library().reader.make_reader
    with reading(path, WHAT), path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or not summary.channels:
            raise RecordingError(
                f"{path}: has no topics, or was cut off before its summary; `mcap recover` may mend it"
            )
        channels = sorted(summary.channels.values(), key=lambda own: own.topic)
        kinds = {own.topic: getattr(summary.schemas.get(own.schema_id), "name", "") for own in channels}
        notes = {
            own.metadata[TRIAL]: notes_in(path, own.metadata[TEXTS])
            for own in reader.iter_metadata()
            if own.name == NOTES
        }
    readable = [own for own in channels if own.message_encoding == "json"]
    if not readable and any(own.message_encoding == "cdr" for own in channels):
        return bags.read_bag(path)
    if not readable:
        encodings = ", ".join(sorted({own.message_encoding for own in channels}))
        raise RecordingError(f"{path}: its messages are encoded as {encodings}; expected json, or cdr of ROS 2")
    ours: dict[str, list[Any]] = {}
    for own in readable:
        if COLUMNS in own.metadata and own.metadata.get(TRIAL) in notes:
            ours.setdefault(own.metadata[TRIAL], []).append(own)
    if ours:
        return [_trial(path, name, own, notes[name]) for name, own in ours.items()]
    tables = tuple(Table(own.topic, _ros_name(kinds[own.topic]), partial(_load, path, own.topic)) for own in readable)
    return [Log(path, path.stem, tables, "an MCAP file", bags.found, {"source": path.name}, rows="message")]


def _ros_name(kind: str) -> str:
    """The name of a ROS message with the ``msg`` that ROS 1 leaves out."""
    package, slash, name = kind.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else kind


def _profile(path: Path) -> str:
    """What the header says who may read it."""
    with reading(path, WHAT):
        check_regular(path)
        with path.open("rb") as file:
            head = file.read(len(MAGIC) + 1 + 8 + 4 + 64)
    if not head.startswith(MAGIC):
        raise RecordingError(f"{path}: is no MCAP file; expected one that begins with {MAGIC[1:6].decode()}")
    at = len(MAGIC) + 1 + 8
    size = int.from_bytes(head[at : at + 4], "little")
    return head[at + 4 : at + 4 + size].decode("utf-8", "replace") if size <= 64 else ""


def _load(path: Path, topic: str) -> Loaded:
    with reading(path, WHAT):
        return columns_of((at, stamp_of(message), message) for at, message in _messages(path, topic))


def _messages(path: Path, topic: str) -> Iterator[tuple[float, Any]]:
    """(log time from the first message of the file on [s], message) of a topic, in the order logged."""
    with path.open("rb") as file:
        reader = mcap_library().reader.make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        begun = summary.statistics.message_start_time if summary and summary.statistics else 0
        for _, _, own in reader.iter_messages(topics=[topic]):
            try:
                message = json.loads(own.data)
            except ValueError as error:
                raise RecordingError(f"{path}: a message of {topic} is no JSON ({error})") from None
            yield (own.log_time - begun) / NANO, message


def _trial(path: Path, name: str, channels: Sequence[Any], notes: Mapping[str, str]) -> Log:
    """A trial that we wrote: columns of several channels with the same rows."""

    def load() -> Loaded:
        columns: dict[str, Any] = {}
        for channel in channels:
            with reading(path, WHAT):
                names = dict(json.loads(channel.metadata[COLUMNS]))
            _, found = _load(path, channel.topic)
            for key, column in {"time": "time", **names}.items():
                values = found.get(key)
                if values is None or np.ma.is_masked(values):
                    raise RecordingError(f"{path}: messages of {channel.topic} lack {key!r}, which its schema has")
                if len(values) != len(columns.get("time", values)):
                    raise RecordingError(
                        f"{path}: {channel.topic} has {len(values)} messages, expected {len(columns['time'])} as "
                        f"{channels[0].topic} has"
                    )
                columns.setdefault(column, values)
        return None, columns

    return Log(path, name, (Table("", "", load),), "an MCAP file", None, notes, "time", "message")


def write_mcap(path: Path, trials: Sequence[Exported], notes: Sequence[Mapping[str, str]]) -> None:
    """Write trials, whole or not at all.

    A message has the time as a number too: the log's time is in whole ns, from the first row of each trial on.

    Args:
        path: of the file.
        trials: with names of their own.
        notes: of each, as its CSV file has them.

    Raises:
        NotAvailable: where mcap is not installed.
        ConfigError: where it cannot be written.
    """
    mcap = mcap_library()
    buffer = io.BytesIO()
    writer = mcap.writer.Writer(buffer)
    writer.start(profile="", library=LIBRARY)
    schemas: dict[bytes, int] = {}
    rows: list[tuple[int, int, int, bytes]] = []
    for trial, own_notes in zip(trials, notes, strict=True):
        name, times = trial.recording.name, trial.recording.time
        stamps = np.round((times - times[0]) * NANO).astype(np.int64).tolist()
        for topic, columns, known in trial.series():
            schema = _schema(topic.removeprefix(f"{trial.folder}/"), columns, known, trial.units)
            data = json.dumps(schema, ensure_ascii=False).encode()
            if data not in schemas:
                schemas[data] = writer.register_schema(f"{schema['title']}", "jsonschema", data)
            about = {TRIAL: name} | ({COLUMNS: json.dumps(known, ensure_ascii=False)} if known else {})
            channel = writer.register_channel(topic, "json", schemas[data], about)
            keys = ["time", *columns]
            values = np.column_stack([times, *columns.values()]).tolist()
            for k, (stamp, row) in enumerate(zip(stamps, values, strict=True)):
                text = json.dumps(dict(zip(keys, row, strict=True)), ensure_ascii=False, allow_nan=False)
                rows.append((stamp, channel, k, text.encode()))
        writer.add_metadata(NOTES, {TRIAL: name, TEXTS: json.dumps(dict(own_notes), ensure_ascii=False)})
    for stamp, channel, k, message in sorted(rows, key=lambda own: own[:2]):
        writer.add_message(channel, stamp, message, stamp, k)
    writer.finish()
    write_bytes(path, buffer.getvalue())


def _schema(
    what: str, columns: Mapping[str, Array], known: Mapping[str, str], units: Mapping[str, str]
) -> dict[str, Any]:
    """JSON schema of a channel's messages: a number for each field, with its unit."""
    fields: dict[str, Any] = {"time": {"type": "number", "description": "[s]"}}
    for name in columns:
        unit = units.get(known.get(name, f"pos.{name}"), "")
        fields[name] = {"type": "number"} | ({"description": f"[{unit}]"} if unit else {})
    title = "equimus_ctrl." + "".join(word.capitalize() for word in what.replace("/", "_").split("_"))
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def mcap_library() -> Any:
    """The library.

    Raises:
        NotAvailable: where it is not installed.
    """
    try:
        import mcap
        import mcap.reader
        import mcap.writer
    except ImportError:
        raise needs("mcap", "logs", "reading and writing MCAP files") from None
    return mcap
