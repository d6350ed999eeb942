"""Messages of a topic as columns: a path to each number, such as ``position.elbow`` or ``data[0]``.

Where a message has a list of names as long as a list of numbers, as ``sensor_msgs/msg/JointState`` has, numbers go by
these names. A message may lack what others have: it is masked there.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.types import Array

NANO = 1e9
WINDOW = 10.0
"""Before and after a message the quickest counts [s]."""
SECONDS, NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanoseconds")
"""What a stamp's two numbers are called, in ROS 1 and 2 and in JSON."""
UNSTAMPED = np.iinfo(np.int64).min
NAMES = ("name", "names", "joint_names", "joints")
"""Fields that may name the elements of others."""
MOST_ELEMENTS = 256
"""Of an array; longer ones are images and the like."""
NUMBERS = bool | int | float | np.integer | np.floating | np.bool_


def numbers_in(value: Any, path: str = "", named: Sequence[str] = ()) -> Iterator[tuple[str, float]]:
    """(path, number) of every number in a message: a dictionary, an object with fields, or lists of them.

    Args:
        value: the message, or a part of it.
        path: to the part.
        named: what elements of a list of numbers are called that is as long.
    """
    if isinstance(value, NUMBERS):
        yield path, float(value)
    elif isinstance(value, list | tuple | np.ndarray):
        if len(value) > MOST_ELEMENTS:
            return
        by_name = named and len(value) == len(named) and all(isinstance(own, NUMBERS) for own in value)
        for k, own in enumerate(value):
            yield from numbers_in(own, f"{path}.{named[k]}" if by_name else f"{path}[{k}]", named)
    else:
        if isinstance(value, Mapping):
            parts: Mapping[str, Any] = value
        elif hasattr(value, "__dataclass_fields__"):
            parts = {key: getattr(value, key) for key in value.__dataclass_fields__ if not key.startswith("__")}
        else:
            return
        own_names = next((list(parts[key]) for key in NAMES if _are_names(parts.get(key))), named)
        for key, own in parts.items():
            yield from numbers_in(own, f"{path}.{key}" if path else str(key), own_names)
        if (labels := _labels(parts)) is not None:
            before = f"{path}.data" if path else "data"
            yield from ((f"{before}.{k}", float(v)) for k, v in zip(labels, parts["data"], strict=True))


def _field(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)


def _labels(parts: Mapping[str, Any]) -> list[str] | None:
    """Names of the elements of a ``std_msgs`` array, where its layout has one for each: ``"m1,m2"``, or a row each."""
    rows, data = _field(parts.get("layout"), "dim"), parts.get("data")
    if not isinstance(rows, list | tuple) or not isinstance(data, list | tuple | np.ndarray) or not rows:
        return None
    labels = [_field(row, "label") for row in rows]
    if not all(isinstance(label, str) for label in labels):
        return None
    names = [own.strip() for own in labels[0].split(",")] if len(labels) == 1 else labels
    whole = len(names) == len(data) == len(set(names)) and all(names)
    return names if whole and all(isinstance(own, NUMBERS) for own in data) else None


def stamp_of(message: Any) -> int | None:
    """When a message was stamped, by its header [ns]; None where it has no stamp."""
    stamp = _field(_field(message, "header"), "stamp")
    parts = [next((own for key in keys if (own := _field(stamp, key)) is not None), None)
             for keys in (SECONDS, NANOSECONDS)]  # fmt: skip
    if not all(isinstance(own, int | np.integer) and not isinstance(own, bool) for own in parts):
        return None
    return int(parts[0]) * 10**9 + int(parts[1])  # type: ignore[arg-type]


def _are_names(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(name, str) for name in value)


@dataclass(frozen=True, eq=False)
class Stamps:
    """When the messages of a topic were, by the log's clock and by those of the devices that sent them.

    Attributes:
        received: (n,) by the log's, from its first message on [s].
        stamped: (n,) by the devices' [ns]; ``UNSTAMPED`` where a message does not say.
    """

    received: Array
    stamped: NDArray[np.int64]


def columns_of(messages: Iterable[tuple[float, int | None, Any]]) -> tuple[Stamps, dict[str, NDArray[Any]]]:
    """Stamps and columns of a topic's messages, all of them.

    Args:
        messages: (when it was received [s], when it was stamped [ns] or None, the message), in the order received.
    """
    received, stamps = array("d"), array("q")
    values: dict[str, array[float]] = {}
    gaps: dict[str, list[tuple[int, int]]] = {}
    for k, (at, stamp, message) in enumerate(messages):
        received.append(at)
        stamps.append(UNSTAMPED if stamp is None else stamp)
        for name, value in numbers_in(message):
            column = values.get(name)
            if column is None:
                column = values[name] = array("d")
            if (missing := k - len(column)) > 0:
                gaps.setdefault(name, []).append((len(column), k))
                column.extend([0.0] * missing)
            if len(column) > k:
                column[k] = value
            else:
                column.append(value)
    columns: dict[str, NDArray[Any]] = {}
    for name, column in values.items():
        if (missing := len(received) - len(column)) > 0:
            gaps.setdefault(name, []).append((len(column), len(received)))
            column.extend([0.0] * missing)
        columns[name] = np.array(column)
        if name in gaps:
            absent = np.zeros(len(received), dtype=bool)
            for first, last in gaps[name]:
                absent[first:last] = True
            columns[name] = np.ma.MaskedArray(columns[name], absent)
    return Stamps(np.array(received), np.array(stamps, dtype=np.int64)), columns


def on_log_clock(stamps: Stamps) -> tuple[NDArray[np.intp], Array, list[str]]:
    """Which messages of one sender count, when they were by the log's clock, and what is to be said of it.

    Stamps of a device's clock are brought onto the log's by the quickest of their messages. What comes twice or after a
    later one is left out. Where stamps go back for longer than a message may be late, the clock begins anew: the sender
    was started again. Where no message has a stamp, or all stamps are 0, messages count from when they were received.

    Args:
        stamps: of the messages that are the robot's, so of one sender.

    Returns:
        Indices, ascending times [s], and the ends of sentences that begin with how many messages there are.
    """
    received, count = stamps.received, len(stamps.received)
    there = stamps.stamped != UNSTAMPED
    if not there.all() or not stamps.stamped.any():
        without = int(count - there.sum())
        said = [f"{without} have no stamp, so all count from when they were received"] if 0 < without < count else []
        return np.arange(count), received, said
    own = (stamps.stamped - stamps.stamped[0]).astype(np.float64) / NANO
    begins = _restarts(own, received)
    offsets: list[float] = []
    for first, last in zip(begins, [*begins[1:], count], strict=True):
        offsets += _least_within((received[first:last] - own[first:last]).tolist(), received[first:last].tolist())
    newest = -np.inf
    kept: list[int] = []
    times: list[float] = []
    anew = set(begins)
    for k, (stamp, offset) in enumerate(zip(own.tolist(), offsets, strict=True)):
        if k in anew:
            newest = -np.inf
        if stamp > newest and (not times or stamp + offset > times[-1]):
            kept.append(k)
            times.append(stamp + offset)
            newest = stamp
    said = []
    if (lost := count - len(kept)) > 0:
        said.append(f"{lost} came twice or after a later one, by their stamps, and are left out")
    if len(begins) > 1:
        back = ", ".join(f"{received[k]:.6g} s" for k in begins[1:4]) + ", …" * (len(begins) > 4)
        said.append(f"stamps went back at {back}, as where a sender is started again; they count anew from there")
    return np.array(kept, dtype=np.intp), np.array(times), said


def _restarts(stamps: Array, received: Array) -> list[int]:
    """The first message of each stretch of one clock.

    A late message is followed at once by later stamps. Where a clock began anew, it takes as long as it went back for.
    """
    begins = [0]
    ahead = np.maximum.accumulate(stamps[::-1])[::-1]  # the latest from each on
    newest = stamps[0]
    for k in range(1, len(stamps)):
        if stamps[k] >= newest:
            newest = stamps[k]
            continue
        missing = newest - stamps[k]
        if ahead[k] <= newest:
            again = len(stamps) > k + 1
        else:
            later = k + int(np.argmax(stamps[k:] > newest))
            again = later > k + 1 and received[later] - received[k] >= 0.5 * missing
        if again:
            begins.append(k)
            newest = stamps[k]
    return begins


def _least_within(values: Sequence[float], times: Sequence[float]) -> list[float]:
    """The least of the values within ``WINDOW`` of each: clocks drift apart, so the whole log does not count."""
    found, ahead = [], 0
    falling: deque[int] = deque()  # of the window, those that nothing later undercuts
    for at in times:
        while ahead < len(times) and times[ahead] <= at + WINDOW:
            while falling and values[falling[-1]] >= values[ahead]:
                falling.pop()
            falling.append(ahead)
            ahead += 1
        while times[falling[0]] < at - WINDOW:
            falling.popleft()
        found.append(values[falling[0]])
    return found
