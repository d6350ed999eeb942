"""Logs: what a file of any format holds before it is known which of it are commands and which positions.

A log has one or more tables, each with a clock of its own: a topic of a bag is one, a CSV file is one alone. Readers
make logs; ``mapping`` says what their columns are; ``assemble`` makes recordings of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import EquimusError, RecordingError, nearest, one_line
from equimus_ctrl.recordings.messages import Stamps

MOST_NAMED = 12
"""Columns that a message names."""


@dataclass(frozen=True)
class Wanted:
    """The names and units of a robot, which columns are looked for by.

    Attributes:
        joints: names of the joints whose positions are measured.
        actuators: names of the actuators.
        joint_units: rad or m, of each joint.
        command_units: SI unit of each actuator's command.
        goals: of each actuator whether its command is a goal for where something is.
        driven: of each actuator the joint that it drives; empty where that is no single one.
    """

    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    joint_units: tuple[str, ...]
    command_units: tuple[str, ...]
    goals: tuple[bool, ...]
    driven: tuple[str, ...]

    def command_names(self, actuator: str) -> tuple[str, ...]:
        """What a message may call an actuator: by its name, or by that of the joint that it alone drives."""
        joint = self.driven[self.actuators.index(actuator)]
        return (actuator, joint) if joint and self.driven.count(joint) == 1 else (actuator,)


LEG = Wanted(("hip", "knee"), ("maa", "baa"), ("rad", "rad"), ("Pa", "Pa"), (False, False), ("", ""))
"""Of the EquiMus leg."""


Loaded = tuple[Stamps | None, Mapping[str, NDArray[Any]]]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns that share a clock, read when they are asked for.

    Attributes:
        name: of the topic; empty of a file that has one table.
        kind: type of the messages.
        load: gives when messages were, and name → (n,) values; None for the first where the clock is a column.
    """

    name: str
    kind: str
    load: Callable[[], Loaded]

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]]) -> Table:
        """Of what is there already."""
        return cls("", "", lambda: (None, columns))

    @cached_property
    def _loaded(self) -> Loaded:
        return self.load()

    @property
    def stamps(self) -> Stamps | None:
        """When messages were, where the clock is no column."""
        return self._loaded[0]

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Name → (n,) values."""
        return self._loaded[1]


@dataclass(frozen=True, eq=False)
class Log:
    """What one trial's file holds.

    Attributes:
        path: of the file.
        name: of the trial.
        tables: by clock.
        form: what its format is called.
        found: makes column of a recording → ``mapping.Source`` of what this format says by itself, see ``finding``.
        notes: provenance, and what the file says of itself.
        clock: name of the column that is the clock; empty where tables have one of their own.
        rows: what a row is called in messages.
        units: column → unit of its numbers by the format itself; empty where the format leaves it open. Of columns that
            are not here it is SI.
    """

    path: Path
    name: str
    tables: tuple[Table, ...]
    form: str
    found: Callable[..., Mapping[str, Any]] | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    clock: str = ""
    rows: str = "sample"
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """For messages."""
        return str(self.path) if self.name == stem(self.path) else f"{self.path} ({self.name})"

    def topic(self, name: str) -> Table:
        """The table of a topic.

        Raises:
            RecordingError: where there is none.
        """
        for own in self.tables:
            if own.name == name:
                return own
        names = sorted(own.name for own in self.tables)
        raise RecordingError(
            f"{self.where}: there is no topic {name}{nearest(name, names)} (known: {', '.join(names) or 'none'})"
        )

    def table(self, topic: str, column: str) -> Table:
        """The table of a topic, or the one that has a column.

        Raises:
            RecordingError: where there is none, or several have it.
        """
        if topic:
            return self.topic(topic)
        having, unread = [], None
        for own in self.tables:
            try:
                having += [own] if column in own.columns else []
            except RecordingError as error:  # a topic of whatever else may be of a type that nobody knows
                unread = unread or error
        if not having and unread is not None:
            raise unread
        if len(having) == 1:
            return having[0]
        if having:
            raise RecordingError(
                f"{self.where}: column {column!r} is in {', '.join(own.name for own in having)}; expected a topic in "
                "the mapping"
            )
        raise self.missing(column)

    def missing(self, column: str, table: Table | None = None) -> RecordingError:
        """There is no such column."""
        known = [name for own in ([table] if table else self.tables) for name in own.columns]
        shown = ", ".join(known[:MOST_NAMED]) + (f", and {len(known) - MOST_NAMED} more" * (len(known) > MOST_NAMED))
        topic = f" in {table.name}" if table is not None and table.name else ""
        return RecordingError(
            f"{self.where}: there is no column {column!r}{topic}{nearest(column, known)} (known: {shown or 'none'})"
        )

    def column(self, table: Table, name: str) -> NDArray[Any]:
        """(n,) numbers of a column.

        Raises:
            RecordingError: where there is none, or it holds no numbers.
        """
        if name not in table.columns:
            raise self.missing(name, table)
        values = table.columns[name]
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            what = "text" if values.dtype.kind in "USO" else f"{values.dtype} of {values.ndim} dimensions"
            raise RecordingError(f"{self.where}: column {name!r} holds {what}, expected one number a row")
        return values


def stem(path: Path) -> str:
    """A trial's name by that of its file, or of its folder, whose name has no suffix: ``run_2024.01.05``."""
    return path.name if path.is_dir() else path.stem


def notes_in(path: Path, text: str | bytes) -> dict[str, str]:
    """Notes of a recording, as JSON.

    Raises:
        RecordingError: where they are none.
    """
    try:
        notes = json.loads(text)
    except ValueError:
        notes = None
    if not isinstance(notes, dict) or not all(isinstance(value, str) for value in notes.values()):
        raise RecordingError(f'{path}: notes is no JSON object of texts, expected one such as {{"source": "…"}}')
    return notes


def flat(columns: Mapping[str, Any], names: Mapping[str, Sequence[str]] | None = None) -> dict[str, NDArray[Any]]:
    """Arrays as columns: of one with two dimensions each column, ``q[0]``, ``q[1]`` … or by the names of its elements.

    Args:
        columns: name → (n,) or (n, k).
        names: of the elements of some.
    """
    found: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        array = np.asarray(values)
        if array.ndim != 2:
            found[name] = array
            continue
        own = (names or {}).get(name)
        for k in range(array.shape[1]):
            found[f"{name}.{own[k]}" if own and len(own) == array.shape[1] else f"{name}[{k}]"] = array[:, k]
    return found


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Whatever somebody else's reader stumbles over in a file, told as a sentence.

    Raises:
        RecordingError: in the place of any exception that is none of ours.
    """
    try:
        yield
    except EquimusError:
        raise
    except FileNotFoundError:
        raise RecordingError(f"{path}: there is no such file") from None
    except MemoryError:
        raise RecordingError(f"{path}: is no {what} that can be read (a length in it is larger than memory)") from None
    except Exception as error:
        why = one_line(str(error))[:200] or type(error).__name__
        raise RecordingError(f"{path}: is no {what} that can be read ({why})") from None
