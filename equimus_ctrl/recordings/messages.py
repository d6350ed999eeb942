"""Messages of a topic as columns: a path to each number, such as ``position.elbow`` or ``data[0]``.

Where a message has a list of names as long as a list of numbers, as ``sensor_msgs/msg/JointState`` has, numbers go by
these names. A message may lack what others have: it is masked there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.types import Array

NANO = 1e9
WINDOW = 10.0
"""Before and after a message the quickest counts [s]."""
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


def _are_names(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(name, str) for name in value)


def columns_of(messages: Iterable[tuple[float, float | None, Any]]) -> tuple[Array, dict[str, NDArray[Any]]]:
    """Times and columns of a topic.

    Stamps of a device's own clock are brought onto that of the log by the quickest of their messages; what comes twice
    or after a later one is left out then.

    Args:
        messages: (when it was received, when it was stamped or None, the message), in the order received [s].
    """
    received: list[float] = []
    stamps: list[float | None] = []
    rows: list[dict[str, float]] = []
    for at, stamp, message in messages:
        received.append(at)
        stamps.append(stamp)
        rows.append(dict(numbers_in(message)))
    kept, times = _on_log_clock(received, stamps)
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns: dict[str, NDArray[Any]] = {}
    for name in names:
        values = np.array([rows[k].get(name, 0.0) for k in kept], dtype=np.float64)
        absent = np.array([name not in rows[k] for k in kept], dtype=bool)
        columns[name] = np.ma.MaskedArray(values, absent) if absent.any() else values
    return times, columns


def _on_log_clock(received: list[float], stamps: list[float | None]) -> tuple[list[int], Array]:
    """Which messages count, and when they were."""
    if not received or not all(stamps):
        return list(range(len(received))), np.array(received, dtype=np.float64)
    stamped = [float(stamp or 0.0) for stamp in stamps]
    offsets = _least_within([at - stamp for at, stamp in zip(received, stamped, strict=True)], received)
    last = -np.inf
    kept: list[int] = []
    times: list[float] = []
    for k, (stamp, offset) in enumerate(zip(stamped, offsets, strict=True)):
        if stamp > last and (not times or stamp + offset > times[-1]):
            kept.append(k)
            times.append(stamp + offset)
            last = stamp
    return kept, np.array(times)


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
