"""What the columns of a file are: a mapping from any log's columns to a recording's, written in TOML.

.. code:: toml

    format = "equimus-ctrl/mapping/1"

    [clock]
    column = "t"
    unit = "ms"

    [columns]
    "pos.elbow" = { column = "elbow_deg", unit = "deg", sign = -1, offset = 90 }
    "cmd.motor" = { topic = "/motor/command", column = "data", unit = "mNm" }

A value is sign · unit · (number − offset), in SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as Table
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError, nearest, unknown_name
from equimus_ctrl.recordings.logs import Wanted
from equimus_ctrl.recordings.units import RATES, TIMES, factor
from equimus_ctrl.settings import settings_from

FORMAT = "equimus-ctrl/mapping/1"
PREFIXES = ("pos", "vel", "cmd", "meas")
Rows = Literal["measured", "all"]


@dataclass(frozen=True)
class Source:
    """Where a column of a recording comes from: value = sign · unit · (number − offset).

    Attributes:
        column: of the file; of a message the path to its field, such as ``position.elbow`` or ``data[0]``.
        topic: that has it; of a file with one table none.
        unit: of the numbers, see ``units.UNITS``; SI by default.
        scale: SI units per number, in the place of a unit: rad per tick of an encoder.
        sign: −1 where it counts the other way.
        offset: the number at which the value is 0, in the file's own unit.
    """

    column: str = ""
    topic: str = ""
    unit: str | None = None
    scale: float | None = None
    sign: int = 1
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not self.column:
            raise ConfigError("column is missing, expected the name of a column of the file")
        if self.sign not in (1, -1):
            raise ConfigError(f"sign is {self.sign}, expected 1 or -1")
        if not math.isfinite(self.offset):
            raise ConfigError(f"offset is {self.offset:g}, expected a finite number")
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0):
            raise ConfigError(f"scale is {self.scale:g}, expected a number above 0; sign = -1 turns it round")
        if self.scale is not None and self.unit is not None:
            raise ConfigError(f"unit is {self.unit!r} and scale is {self.scale:g}, expected one of the two")


@dataclass(frozen=True)
class Clock:
    """When rows are.

    Attributes:
        column: that holds it; by default what the format says.
        unit: of it.
        rows: ``"measured"``: rows are where something was measured, and a command that was sent between two of them
            counts from the nearer one on. ``"all"``: rows are also where commands change, and positions lie there on a
            line between those measured around. Of a log whose commands and measurements have one clock both are alike.
    """

    column: str = ""
    unit: str = "s"
    rows: Rows = "measured"

    def __post_init__(self) -> None:
        if self.unit not in TIMES:
            raise ConfigError(unknown_name("unit of time", self.unit, TIMES))
        if self.rows not in get_args(Rows):
            raise ConfigError(unknown_name("choice of rows", self.rows, get_args(Rows)))


@dataclass(frozen=True)
class Topics:
    """Topics by which columns are found, where a log has several of a kind.

    Attributes:
        states: of measurements.
        commands: of commands.
    """

    states: str = ""
    commands: str = ""


@dataclass(frozen=True)
class Mapping:
    """What the columns of a log are.

    Attributes:
        columns: column of a recording → where it comes from.
        clock: when rows are.
        units: prefix (``pos``, ``cmd``, …) → unit of all its columns that have none of their own.
        names: prefix → names of joints or actuators in the order of an array whose elements have no names.
        topics: by which columns are found.
        where: for messages.
    """

    columns: Table[str, Source] = field(default_factory=dict)
    clock: Clock = Clock()
    units: Table[str, str] = field(default_factory=dict)
    names: Table[str, tuple[str, ...]] = field(default_factory=dict)
    topics: Topics = Topics()
    where: str = "mapping"

    def unit_of(self, target: str, source: Source) -> str | None:
        """The unit that is given for a column of a recording."""
        return source.unit if source.unit is not None else self.units.get(target.partition(".")[0])

    @classmethod
    def from_dict(cls, data: Table[str, Any], where: str = "mapping") -> Mapping:
        """From what a TOML file holds.

        Raises:
            ConfigError: for a key that there is not, or a value that does not fit.
        """
        known = ["format", *(f.name for f in fields(cls) if f.name != "where")]
        for key in data:
            if key not in known:
                raise ConfigError(unknown_name("key", key, known, where))
        if data.get("format", FORMAT) != FORMAT:
            raise ConfigError(f"{where}: format is {data['format']!r}, expected {FORMAT!r}")
        tables = {}
        for key in ("columns", "clock", "units", "names", "topics"):
            tables[key] = data.get(key, {})
            if not isinstance(tables[key], Table):
                raise ConfigError(f"{where}: {key} is {tables[key]!r}, expected a table")
        return cls(
            {target: _source(target, value, where) for target, value in _leaves(tables["columns"]).items()},
            settings_from(Clock, tables["clock"], f"{where}: clock"),
            {key: _unit(key, value, where) for key, value in tables["units"].items()},
            {key: _names(key, value, where) for key, value in tables["names"].items()},
            settings_from(Topics, tables["topics"], f"{where}: topics"),
            where,
        )


def read_mapping(path: Path | str) -> Mapping:
    """The mapping in a TOML file.

    Raises:
        ConfigError: where it cannot be read, has a key that there is not, or a value that does not fit.
    """
    return Mapping.from_dict(presets.read_toml(Path(path)), str(path))


def _leaves(table: Table[str, Any], before: str = "") -> dict[str, Any]:
    """Dotted names, whether they stand in quotes or as tables in tables: ``pos.elbow = "…"`` means the same."""
    found: dict[str, Any] = {}
    known = {f.name for f in fields(Source)}
    for key, value in table.items():
        nested = isinstance(value, Table) and not before and key in (*PREFIXES, "site") and not known & set(value)
        site = isinstance(value, Table) and before.startswith("site.") and not known & set(value)
        found.update(_leaves(value, f"{before}{key}.") if nested or site else {before + key: value})
    return found


def _source(target: str, value: Any, where: str) -> Source:
    prefix, dot, name = target.partition(".")
    if prefix not in (*PREFIXES, "site") or not dot or not name:
        near = nearest(target, [f"{known}.{name or prefix}" for known in (*PREFIXES, "site")])
        raise ConfigError(
            f"{where}: columns: {target!r} is no column of a recording{near} (known: pos.<joint>, vel.<joint>, "
            "cmd.<actuator>, meas.<actuator>, site.<site>.x)"
        )
    if isinstance(value, str):
        value = {"column": value}
    if not isinstance(value, Table):
        raise ConfigError(f"{where}: {target} is {value!r}, expected the name of a column or a table")
    return settings_from(Source, value, f"{where}: {target}")


def _prefix(key: str, where: str, what: str) -> None:
    if key not in PREFIXES:
        raise ConfigError(unknown_name("prefix", key, PREFIXES, f"{where}: {what}"))


def _unit(key: str, value: Any, where: str) -> str:
    _prefix(key, where, "units")
    if not isinstance(value, str):
        raise ConfigError(f"{where}: units: {key} is {value!r}, expected a unit such as 'deg'")
    factor(value, None, f"{where}: units: {key}")
    return value


def _names(key: str, value: Any, where: str) -> tuple[str, ...]:
    _prefix(key, where, "names")
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise ConfigError(f"{where}: names: {key} is {value!r}, expected a list of names")
    if len(set(value)) < len(value):
        raise ConfigError(f"{where}: names: {key} is {list(value)}, expected each name once")
    return tuple(value)


def si_unit(target: str, wanted: Wanted | None) -> str | None:
    """The SI unit of a column of a recording; None where the robot is not known, or has no such joint or actuator."""
    prefix, _, name = target.partition(".")
    if prefix == "site":
        return "m"
    if wanted is None:
        return None
    if prefix in ("pos", "vel"):
        if name not in wanted.joints:
            return None
        own = wanted.joint_units[wanted.joints.index(name)]
        return (own or None) if prefix == "pos" else RATES.get(own)
    if name not in wanted.actuators or prefix == "meas":
        return "Pa" if prefix == "meas" and set(wanted.command_units) == {"Pa"} else None
    return wanted.command_units[wanted.actuators.index(name)]
