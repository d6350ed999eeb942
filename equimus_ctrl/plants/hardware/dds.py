"""ROS 2 topics spoken with Cyclone DDS, with ROS 2's own names of types and topics.

A topic /name is rt/name on the wire, a type pkg/msg/Type is pkg::msg::dds_::Type_. Measurements are read with the
quality of sensor data (best effort, the last five), which sensor data and default publishers both match; commands are
sent with the default one (reliable, the last ten).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.plants.hardware.messages import NANO, Float64MultiArray, JointState, joint_state, multi_array
from equimus_ctrl.plants.hardware.settings import Wire
from equimus_ctrl.plants.hardware.transport import Sample

SENSOR_DATA = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5), Policy.Durability.Volatile)
DEFAULT = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(10), Policy.Durability.Volatile
)
KEPT = 4096
"""Samples that wait to be taken, at most."""


def topic_of(name: str) -> str:
    """A topic of ROS 2 as DDS calls it."""
    return "rt" + name


class _Arriving(Listener):
    """Takes what arrives when it does, in a thread of the transport."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting: deque[tuple[float, int, Any]] = deque(maxlen=KEPT)
        self.heard = self.malformed = 0

    def on_data_available(self, reader: DataReader) -> None:
        """Called by DDS."""
        now = time.monotonic()
        for _ in range(KEPT):
            try:
                found = reader.take(N=1)
            except DDSException:
                return
            except Exception:  # bytes that are no such message, whatever they make of its decoder: that one is lost
                self.malformed += 1
                continue
            if not found:
                return
            info = found[0].sample_info
            if info.valid_data:
                self.heard += 1
                self.waiting.append((now, int(info.publication_handle), found[0]))

    def take(self) -> list[tuple[float, int, Any]]:
        """All that has arrived."""
        found = []
        with contextlib.suppress(IndexError):
            while True:
                found.append(self.waiting.popleft())
        return found


class _End:
    """One end of the wire: a topic read and a topic written."""

    def __init__(self, wire: Wire, read: tuple[str, type, Qos], write: tuple[str, type, Qos]) -> None:
        if not (read[0] and write[0]):
            raise ConfigError("a topic of the wire has no name, expected one such as /joint_states")
        self._arriving = _Arriving()
        self._writer: Any = None
        self._written = topic_of(write[0])
        try:
            self.participant = DomainParticipant(wire.domain)
            topics = [Topic(self.participant, topic_of(name), kind) for name, kind, _ in (read, write)]
            self._reader = DataReader(self.participant, topics[0], qos=read[2], listener=self._arriving)
            self._others = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
            self._readers = BuiltinDataReader(self.participant, BuiltinTopicDcpsSubscription)
            self._make_writer: Any = lambda: DataWriter(self.participant, topics[1], qos=write[2])
        except DDSException as error:
            raise NotAvailable(
                f"DDS domain {wire.domain} cannot be joined ({error.msg.strip()}); expected a network interface that "
                "Cyclone DDS can use, see CYCLONEDDS_URI"
            ) from None

    def prepare(self) -> None:
        """Be ready to write."""
        if self._writer is None:
            self._writer = self._make_writer()

    def publishers(self) -> list[tuple[str, str, bool]]:
        """(topic, type, whether it is this end's own) of all that publish in the domain."""
        own = self.participant.guid
        found = []
        for sample in self._others.read(N=1000, condition=None):
            if sample.sample_info.valid_data and sample.sample_info.instance_state == InstanceState.Alive:
                found.append((sample.topic_name, sample.type_name, sample.participant_key == own))
        return found

    def listeners(self) -> int:
        """Who reads what is written."""
        if self._writer is not None:
            return len(self._writer.get_matched_subscriptions())
        alive = {
            sample.key
            for sample in self._readers.read(N=1000, condition=None)
            if sample.sample_info.valid_data and sample.sample_info.instance_state == InstanceState.Alive
            and sample.topic_name == self._written
        }  # fmt: skip
        return len(alive)

    def write(self, message: Any) -> None:
        """Send to all of them."""
        self.prepare()
        with contextlib.suppress(DDSException):  # a reader that is gone is noticed by the others
            self._writer.write(message)

    def close(self) -> None:
        """Leave the domain."""
        self._reader.set_listener(None)
        del self._reader, self._writer, self._make_writer, self._others, self._readers, self.participant


class DdsHost:
    """The controller's end."""

    def __init__(self, wire: Wire) -> None:
        self._wire, self._lock = wire, threading.RLock()  # a signal may come while it is held
        self._end = _End(wire, (wire.states, JointState, SENSOR_DATA), (wire.commands, Float64MultiArray, DEFAULT))

    def take(self) -> list[Sample]:
        """See ``Transport``."""
        return [
            Sample(
                message.header.stamp.sec + message.header.stamp.nanosec / NANO,
                received,
                tuple(message.name),
                tuple(message.position),
                source,
            )
            for received, source, message in self._end._arriving.take()
        ]

    def prepare(self) -> None:
        """See ``Transport``."""
        self._end.prepare()

    def send(self, values: Sequence[float]) -> None:
        """See ``Transport``."""
        with self._lock:
            self._end.write(multi_array(values))

    def listeners(self) -> int:
        """See ``Transport``."""
        return self._end.listeners()

    def trouble(self) -> str:
        """See ``Transport``."""
        wire, states, publishers = self._wire, 0, 0
        for topic, kind, own in self._end.publishers():
            if topic == topic_of(wire.states):
                states += 1
                if kind != JointState.__idl__.idl_transformed_typename:
                    return (
                        f"{wire.states} is published as {kind}, expected {JointState.__idl__.idl_transformed_typename}"
                    )
            publishers += topic == topic_of(wire.commands) and not own
        if states > 1:
            return f"{wire.states} has {states} publishers, expected one"
        arriving = self._end._arriving
        if arriving.malformed and not arriving.heard:
            return f"{wire.states} carries {arriving.malformed} messages that cannot be decoded as a JointState"
        if publishers:
            return f"{wire.commands} has another publisher, expected this one alone"
        return ""

    def close(self) -> None:
        """See ``Transport``."""
        self._end.close()


class DdsDevice:
    """The robot's end."""

    def __init__(self, wire: Wire) -> None:
        self._end = _End(wire, (wire.commands, Float64MultiArray, DEFAULT), (wire.states, JointState, DEFAULT))
        self._end.prepare()

    def publish(self, stamp: float, names: Sequence[str], position: Sequence[float]) -> None:
        """See ``Device``."""
        self._end.write(joint_state(stamp, names, position))

    def take(self) -> list[tuple[float, ...]]:
        """See ``Device``."""
        return [tuple(message.data) for _, _, message in self._end._arriving.take()]

    def close(self) -> None:
        """See ``Device``."""
        self._end.close()
