"""Logs as recordings: columns in SI units on one clock, checked like a file in the project's own format.

Where commands and measurements have clocks of their own (topics of a bag), rows are where something was measured. A
command that was sent between two of them counts from the nearer one on, so that no number is made up and the mean
error of its time is none; ``rows = "all"`` in a mapping gives commands rows of their own, and positions there are
interpolated. Nothing is known of commands before the first one, so no row lies before it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Table
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError, RecordingError, nearest, unknown_name
from equimus_ctrl.recordings import checks, csvfile
from equimus_ctrl.recordings.arraysheet import ArraySheet
from equimus_ctrl.recordings.checks import Limits
from equimus_ctrl.recordings.logs import Log, Wanted
from equimus_ctrl.recordings.logs import Table as LogTable
from equimus_ctrl.recordings.mapping import Mapping, Source, si_unit
from equimus_ctrl.recordings.messages import Stamps, on_log_clock
from equimus_ctrl.recordings.sheet import number
from equimus_ctrl.recordings.units import TIMES, factor
from equimus_ctrl.types import Array, Recording

NO_MAPPING = Mapping()


def recording_of(log: Log, limits: Limits, wanted: Wanted | None = None, mapping: Mapping | None = None) -> Recording:
    """One trial's log as a recording.

    Args:
        log: what a file holds.
        limits: what may stand in a recording.
        wanted: names of the robot, by which columns are found that a mapping does not name.
        mapping: what columns are.

    Raises:
        RecordingError: where the log lacks something, or holds what cannot be.
        ConfigError: where the mapping names something that the robot does not have, or units do not fit.
    """
    mapping = mapping or NO_MAPPING
    sources = _sources(log, wanted, mapping)
    columns, notes = _on_one_clock(log, sources, wanted, mapping)
    written = [(k, f"{key} = {value}") for k, (key, value) in enumerate({**log.notes, **notes}.items(), 1)]
    sheet = ArraySheet(log.path, log.name, log.rows, tuple(written), columns)
    return csvfile.from_sheet(sheet, limits)


def _sources(log: Log, wanted: Wanted | None, mapping: Mapping) -> dict[str, Source]:
    """Column of a recording → where it comes from: by the mapping, and what that does not name as it is found."""
    for target in mapping.columns:
        prefix, _, name = target.partition(".")
        if wanted is not None and prefix != "site":
            kind = "joint" if prefix in ("pos", "vel") else "actuator"
            known = wanted.joints if kind == "joint" else wanted.actuators
            if name not in known:
                raise ConfigError(unknown_name(kind, name, known, f"{mapping.where}: {target}"))
    prefixes = {target.partition(".")[0] for target in mapping.columns}
    needed = [prefix for prefix in ("pos", "cmd") if prefix not in prefixes]
    if wanted is not None and not wanted.actuators:
        needed = [prefix for prefix in needed if prefix != "cmd"]
    found: Table[str, Source] = native(log, bool(needed))
    if needed and not {target.partition(".")[0] for target in found}.issuperset(needed):
        if log.found is None:
            raise RecordingError(
                f"{log.where}: {log.form} does not say which column is {' and which '.join(_words(needed))}; expected "
                "a mapping (--map) with [columns]"
            )
        if wanted is None:
            raise RecordingError(
                f"{log.where}: of which robot this is nobody says; expected its model, by whose names columns are "
                "found, or a mapping with [columns]"
            )
        found = log.found(log, wanted, mapping)
    kept = {target: source for target, source in found.items() if target.partition(".")[0] not in prefixes}
    return {**kept, **mapping.columns}


def _words(prefixes: Sequence[str]) -> list[str]:
    return [{"pos": "the position of which joint", "cmd": "the command of which actuator"}[own] for own in prefixes]


def native(log: Log, needed: bool) -> dict[str, Source]:
    """Columns that have the names of a recording's.

    ROS has other names for its messages' fields. What of a topic nobody asks for is not read at all.

    Args:
        log: of what.
        needed: whether there is something that a mapping does not name.
    """
    found = {}
    for table in log.tables:
        if table.name and (not needed or "/msg/" in table.kind):
            continue
        for column in table.columns:
            prefix, dot, name = column.partition(".")
            if dot and name and (prefix in csvfile.PREFIXES or csvfile.is_site(column)):
                found[column] = Source(column, table.name)
    return found


def _value(log: Log, table: LogTable, target: str, source: Source, wanted: Wanted | None, mapping: Mapping) -> Array:
    """(n,) values of a column of a recording, in SI units."""
    numbers = log.column(table, source.column).astype(np.float64)
    bad = ~np.isfinite(np.ma.getdata(numbers)) & ~np.ma.getmaskarray(numbers)
    if bad.any():
        row = int(np.argmax(bad))
        raise RecordingError(
            f"{log.where}, {log.rows} {row + 1}{_of(table)}, column {source.column}: {numbers[row]} is not finite; a "
            "finite number belongs there"
        )
    unit = mapping.unit_of(target, source)
    if unit is None and source.scale is None and source.column in log.units:
        unit = log.units[source.column]
        if not unit:
            raise RecordingError(
                f"{log.where}: what {source.column} measures is not in the file; expected a unit or a scale of "
                f"{target} in {mapping.where}"
            )
    size = source.scale
    if size is None:
        size = 1.0 if unit is None else factor(unit, si_unit(target, wanted), f"{mapping.where}: {target}")
    # What needs no change keeps its bits.
    shifted = numbers if source.offset == 0.0 else numbers - source.offset
    scaled = shifted if size == 1.0 else size * shifted
    return scaled if source.sign == 1 else -scaled


def _of(table: LogTable) -> str:
    return f" of {table.name}" if table.name else ""


def _present(log: Log, table: LogTable, targets: Table[str, Source], values: Table[str, Array]) -> NDArray[np.bool_]:
    """(n,) messages that tell of what is wanted: a topic may be shared, and others tell of other joints.

    Raises:
        RecordingError: where a message tells of some of it alone.
    """
    absent = np.column_stack([np.ma.getmaskarray(values[target]) for target in targets])
    partly = absent.any(axis=1) & ~absent.all(axis=1)
    if partly.any():
        row = int(np.argmax(partly))
        lacks = [source.column for source, gone in zip(targets.values(), absent[row], strict=True) if gone]
        raise RecordingError(
            f"{log.where}, {log.rows} {row + 1}{_of(table)} has no {', '.join(lacks)}; expected all of "
            f"{', '.join(source.column for source in targets.values())} together"
        )
    return np.asarray(~absent.all(axis=1))


def _clocks(
    log: Log, kept: Table[str, NDArray[np.intp]], mapping: Mapping
) -> tuple[dict[str, tuple[NDArray[np.intp], Array]], bool]:
    """Of each table the rows that count and their times [s], and whether these have a beginning that is nobody's.

    All tables have one origin, so that what was sent and what was measured keep their distance.
    """
    tables = {table.name: table for table in log.tables if table.name in kept}
    clocks: dict[str, NDArray[Any]] = {}
    found: dict[str, tuple[NDArray[np.intp], Array]] = {}
    for name, table in tables.items():
        column = mapping.clock.column or ("" if table.stamps is not None else log.clock)
        if column:
            values = log.column(table, column)[kept[name]]
            if np.ma.is_masked(values):
                row = int(kept[name][np.argmax(np.ma.getmaskarray(values))])
                raise RecordingError(f"{log.where}, {log.rows} {row + 1}{_of(table)} has no {column}, the clock")
            counts = np.ma.getdata(values)
            clocks[name] = counts.astype(np.int64) if counts.dtype.kind in "ub" else counts
        elif table.stamps is not None:
            stamps = table.stamps
            rows, times, said = on_log_clock(Stamps(stamps.received[kept[name]], stamps.stamped[kept[name]]))
            found[name] = kept[name][rows], times
            checks.warn([f"{log.where}: of {len(kept[name])} messages{_of(table)} {text}" for text in said])
        else:
            raise RecordingError(
                f"{log.where}: {log.form} has no clock; expected a mapping with a column under [clock]"
            )
    unit = TIMES[mapping.clock.unit]
    begun = [own[0] for own in clocks.values() if len(own)]
    for name, own in clocks.items():
        # Whole numbers of an epoch in ns are more than a double holds.
        counted = own if unit == 1.0 or not begun else own - min(begun)
        found[name] = kept[name], counted.astype(np.float64) * unit
    return found, not clocks


def _on_one_clock(
    log: Log, sources: Table[str, Source], wanted: Wanted | None, mapping: Mapping
) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of a recording with ``time``, and notes on how they came about."""
    tables = {target: log.table(source.topic, source.column) for target, source in sources.items()}
    values = {
        target: _value(log, tables[target], target, source, wanted, mapping) for target, source in sources.items()
    }
    kept: dict[str, NDArray[np.intp]] = {}
    for own in {table.name: table for table in tables.values()}.values():
        inside = {target: sources[target] for target, table in tables.items() if table is own}
        there = np.ones(len(values[next(iter(inside))]), dtype=bool)
        for group in (
            {t: s for t, s in inside.items() if t.startswith("cmd.")},
            {t: s for t, s in inside.items() if not t.startswith("cmd.")},
        ):
            if group:
                there &= _present(log, own, group, values)
        kept[own.name] = np.flatnonzero(there)
    measured = {target: table for target, table in tables.items() if not target.startswith("cmd.")}
    if not measured:
        raise RecordingError(f"{log.where}: nothing that was measured is mapped; expected pos.<joint> of all joints")
    own = next(iter(measured.values()))
    for target, table in measured.items():
        if table is not own:
            raise RecordingError(
                f"{log.where}: {target} is from {table.name} and {next(iter(measured))} from {own.name}; expected all "
                "that was measured in one topic, since numbers between its messages would be made up"
            )
    # Only now is it known which messages are the robot's, and so which stamps are of one sender.
    clocks, foreign = _clocks(log, kept, mapping)
    values = {target: np.ma.getdata(column)[clocks[tables[target].name][0]] for target, column in values.items()}
    times = clocks[own.name][1]
    senders = list(dict.fromkeys(table.name for target, table in tables.items() if target.startswith("cmd.")))
    chosen = {"topic.states": own.name, "topic.commands": ", ".join(senders)}
    notes = {key: name for key, name in chosen.items() if name}
    if all(sender == own.name for sender in senders):
        if foreign and len(times):
            times = times - times[0]
        return {"time": times, **values}, notes
    commands = {target: clocks[table.name][1] for target, table in tables.items() if target.startswith("cmd.")}
    columns, more = _merged(log, mapping, times, commands, values)
    return columns, notes | more


def _merged(
    log: Log, mapping: Mapping, times: Array, sent: Table[str, Array], values: Table[str, Array]
) -> tuple[dict[str, Array], dict[str, str]]:
    """Rows of two clocks or more, see the module."""
    if len(times) < 2 or any(len(own) < 1 for own in sent.values()):
        fewest = min(len(own) for own in sent.values())
        raise RecordingError(
            f"{log.where}: holds {len(times)} measurements and {fewest} commands, expected at least 2 and 1"
        )
    for target, own in (("time of measurements", times), *sent.items()):
        if (back := np.flatnonzero(np.diff(own) < 0)).size:
            raise RecordingError(
                f"{log.where}: {target}: {number(own[back[0] + 1])} s comes after {number(own[back[0]])} s; times must "
                "ascend"
            )
    begin = max(own[0] for own in sent.values())
    every = mapping.clock.rows == "all"
    changed = {target: own[_changes(values[target])] for target, own in sent.items()}
    rows = times[times >= begin]
    if every:
        rows = np.unique(np.concatenate([times, *changed.values()]))
        rows = rows[(rows >= max(begin, times[0])) & (rows <= times[-1])]
    if len(rows) < 2:
        raise RecordingError(f"{log.where}: no two measurements lie after the first command, expected some")
    columns: dict[str, Array] = {"time": rows - rows[0]}
    notes: dict[str, str] = {}
    lost, moved = 0, 0.0
    for target, column in values.items():
        if target not in sent:
            columns[target] = np.interp(rows, times, column) if every else column[times >= begin]
            continue
        own = sent[target]
        if every:
            columns[target] = column[np.searchsorted(own, rows, side="right") - 1]
        else:
            own = own[own <= rows[-1]]  # of later ones no measurement tells
            at, shift = _nearest(rows, own)
            columns[target] = column[np.searchsorted(at, np.arange(len(rows)), side="right") - 1]
            inside = np.flatnonzero((own > rows[0]) & np.isin(own, changed[target]))
            moved = max(moved, float(np.abs(shift[inside]).max(initial=0.0)))
            lost = max(lost, len(inside) - len(np.unique(at[inside])))
        earlier = np.flatnonzero(own < rows[0])
        if earlier.size:
            notes[f"{csvfile.BEFORE}{target.removeprefix('cmd.')}"] = repr(float(column[earlier[-1]]))
    if sum(key.startswith(csvfile.BEFORE) for key in notes) < len(sent):
        notes = {}
    if moved:
        notes["commands"] = f"each counts from the measurement nearest to it, at most {number(moved)} s off"
    if lost:
        checks.warn(
            [
                f"{log.where}: {lost} commands were followed by another before the next measurement, and only the last "
                'one counts; rows = "all" under [clock] of a mapping keeps them, and interpolates positions there'
            ]
        )
    return columns, notes


def _changes(values: Array) -> NDArray[np.intp]:
    """Where a command is another than before."""
    return np.flatnonzero(np.r_[True, values[1:] != values[:-1]])


def _nearest(rows: Array, times: Array) -> tuple[NDArray[np.intp], Array]:
    """(n,) the row nearest to each time, and by how much that is later [s]."""
    after = np.clip(np.searchsorted(rows, times), 1, len(rows) - 1)
    chosen = np.where(times - rows[after - 1] <= rows[after] - times, after - 1, after)
    return chosen, rows[chosen] - times


def elements(
    log: Log,
    table: LogTable,
    base: str,
    names: Sequence[str],
    prefix: str,
    mapping: Mapping,
    spellings: Table[str, Sequence[str]],
) -> dict[str, Source]:
    """Columns ``base.<name>`` or ``base[k]`` of an array as columns of a recording.

    By names where the elements have some, else in the order that the mapping gives under ``[names]``.

    Args:
        log: of what.
        table: that has the array.
        base: its name.
        names: of the joints or actuators wanted.
        prefix: of the columns: pos, vel, cmd or meas.
        mapping: with names for elements that have none.
        spellings: name → what an element may be called for it.

    Raises:
        RecordingError: where one is missing, or elements have no names.
    """
    pattern = re.compile(re.escape(base) + r"(?:\[(\d+)\]|\.(.+))?$")
    own = [(column, match) for column in table.columns if (match := pattern.match(column))]
    indexed = [column for column, match in own if match[1] is not None]
    if not own:
        raise log.missing(base, table)
    if indexed or [column for column, _ in own] == [base]:
        columns = indexed or [base]
        order = mapping.names.get(prefix)
        if order is None and len(columns) == 1 and len(names) == 1:
            order = tuple(names)  # there is nothing to mix up
        if order is None:
            raise RecordingError(
                f"{log.where}: the {len(columns)} elements of {base!r} have no names; expected {prefix} under [names] "
                f"of a mapping: {prefix} = {list(names)}, in the file's order"
            )
        if len(order) != len(columns):
            raise RecordingError(
                f"{log.where}: {base!r} has {len(columns)} elements, but names.{prefix} of {mapping.where} has "
                f"{len(order)}"
            )
        there = dict(zip(order, columns, strict=True))
    else:
        there = {match[2]: column for column, match in own if match[2]}
    found: dict[str, Source] = {}
    for name in names:
        spelled = next((own for own in spellings.get(name, (name,)) if own in there), None)
        if spelled is None:
            raise RecordingError(
                f"{log.where}: {base!r} has no element {name!r}{nearest(name, there)} (known: {', '.join(there)})"
            )
        found[f"{prefix}.{name}"] = Source(there[spelled], table.name)
    return found
