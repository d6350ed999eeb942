"""Parquet tables, and LeRobot's datasets of them (layouts 2.0, 2.1 and 3.0).

A dataset's folder has ``meta/info.json`` with the names of the elements of ``observation.state`` and ``action``, and
parquet files under ``data/``: one an episode (2.x), or some with many episodes (3.0). Each episode is a trial; a row's
action is in force from then on. What the numbers measure (degrees, rad, −100 to 100 of a range) is not in a dataset
unless a feature says ``unit``, so a mapping says it under ``[units]``.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import RecordingError, needs
from equimus_ctrl.presets import check_regular, write_bytes
from equimus_ctrl.recordings.assemble import elements
from equimus_ctrl.recordings.logs import Log, Table, Wanted, flat, notes_in, reading
from equimus_ctrl.recordings.mapping import Mapping as ColumnMapping
from equimus_ctrl.recordings.mapping import Source

INFO = Path("meta") / "info.json"
STATE, ACTION, EPISODE, CLOCK = "observation.state", "action", "episode_index", "timestamp"
SUFFIXES = (".pos", ".position")
"""What LeRobot's robots put behind the name of a motor."""
CLOCKS = ("time", "timestamp", "t")
NOTES = b"equimus_ctrl.notes"


def is_lerobot(path: Path) -> bool:
    """Whether a path is a LeRobot dataset's folder."""
    return (path / INFO).is_file()


def read_lerobot(path: Path) -> list[Log]:
    """The logs of a dataset, one an episode.

    Raises:
        NotAvailable: where pyarrow is not installed.
        RecordingError: where something of it cannot be read, or is missing.
    """
    info = _info(path / INFO)
    names = {key: _names(path, key, info) for key in (STATE, ACTION)}
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise RecordingError(f"{path}: has no parquet files under data/, expected the episodes of a LeRobot dataset")
    units = {key: _unit(info, key) for key in (STATE, ACTION)}
    logs: dict[int, Log] = {}
    rows = 0
    for file in files:
        columns, _ = _columns(file, lambda key: key in (STATE, ACTION, EPISODE, CLOCK))
        for key in (STATE, ACTION, EPISODE, CLOCK):
            if key not in columns:
                raise RecordingError(f"{file}: there is no column {key!r}, expected those of a LeRobot dataset")
        episodes = columns[EPISODE]
        rows += len(episodes)
        for episode in np.unique(episodes).tolist():
            if episode in logs:
                raise RecordingError(f"{file}: episode {episode} is in another file too, expected each in one")
            own = episodes == episode
            kept = {key: columns[key][own] for key in (STATE, ACTION, CLOCK)}
            notes = {"source": path.resolve().name, "source_episode": str(episode)}
            notes |= {f"unit.{key}": unit for key, unit in units.items() if unit}
            flattened = flat(kept, names)
            logs[episode] = Log(
                path, f"episode_{episode:06d}", (Table.of(flattened),), "a LeRobot dataset", found_lerobot,
                notes, CLOCK, "frame", {key: _unit_of(key, units) for key in flattened if key != CLOCK},
            )  # fmt: skip
    told = info.get("total_frames")
    if isinstance(told, int) and told != rows:
        raise RecordingError(f"{path}: holds {rows} frames, but {INFO} says {told}; a file of it is missing or cut")
    return [logs[episode] for episode in sorted(logs)]


def _info(path: Path) -> dict[str, Any]:
    with reading(path, "JSON file"):
        info = json.loads(path.read_bytes())
    if not isinstance(info, dict):
        raise RecordingError(f"{path}: holds no JSON object, expected the description of a LeRobot dataset")
    version = str(info.get("codebase_version", ""))
    if version.lstrip("v").split(".")[0] not in ("2", "3"):
        raise RecordingError(f"{path}: codebase_version is {version or None!r}, expected v2.0, v2.1 or v3.0")
    return info


def _feature(info: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    features = info.get("features")
    own = features.get(key) if isinstance(features, Mapping) else None
    return own if isinstance(own, Mapping) else {}


def _names(path: Path, key: str, info: Mapping[str, Any]) -> list[str]:
    """Names of a feature's elements; none where it does not say them."""
    names = _feature(info, key).get("names")
    if names is None and isinstance(info.get("names"), Mapping):  # the first datasets of 2.0
        names = info["names"].get(key)
    if isinstance(names, Mapping):  # by kind, such as {"motors": […]}
        names = [name for group in names.values() if isinstance(group, list) for name in group]
    if names is None:
        return []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordingError(f"{path / INFO}: names of {key} are {names!r}, expected a list of texts")
    size = _feature(info, key).get("shape")
    if isinstance(size, list) and size != [len(names)]:
        return []  # such as ["dim"], which names an axis
    return names


def _unit(info: Mapping[str, Any], key: str) -> str:
    own = _feature(info, key)
    unit = own.get("unit", own.get("units"))
    if isinstance(unit, list) and len(set(map(str, unit))) == 1:
        unit = unit[0]
    return unit if isinstance(unit, str) else ""


def _unit_of(column: str, units: Mapping[str, str]) -> str:
    return next(unit for key, unit in units.items() if re.match(re.escape(key) + r"(?:[.\[]|$)", column))


def found_lerobot(log: Log, wanted: Wanted, mapping: ColumnMapping) -> dict[str, Source]:
    """States and actions by the names of the dataset.

    Raises:
        RecordingError: where a name is missing, or nobody says what numbers measure.
    """
    table = log.tables[0]
    sources: dict[str, Source] = {}
    for prefix, base, names in (("pos", STATE, wanted.joints), ("cmd", ACTION, wanted.actuators)):
        if not names or any(target.startswith(f"{prefix}.") for target in mapping.columns):
            continue
        unit = mapping.units.get(prefix) or log.notes.get(f"unit.{base}")
        if not unit:
            raise RecordingError(
                f"{log.where}: what {base} measures is not in the dataset (LeRobot's robots give degrees, rad or "
                f'-100 to 100 of a range); expected a mapping with [units] {prefix} = "deg" or such, or [columns] with '
                "a scale"
            )
        spellings = {name: _spellings(name, wanted, prefix) for name in names}
        own = elements(log, table, base, names, prefix, mapping, spellings)
        sources |= {target: Source(source.column, unit=unit) for target, source in own.items()}
    return sources


def _spellings(name: str, wanted: Wanted, prefix: str) -> list[str]:
    plain = wanted.command_names(name) if prefix == "cmd" else (name,)
    return [own + suffix for own in plain for suffix in ("", *SUFFIXES)]


def read_parquet(path: Path) -> list[Log]:
    """The log of a table.

    Raises:
        NotAvailable: where pyarrow is not installed.
        RecordingError: where it cannot be read.
    """
    columns, notes = _columns(path, lambda key: True)
    clock = next((key for key in CLOCKS if key in columns), "")
    return [Log(path, path.stem, (Table.of(flat(columns)),), "a table", None, notes, clock)]


def _columns(path: Path, chosen: Callable[[str], bool]) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Columns of a parquet file, those of lists as (n, k), and its notes."""
    pyarrow = _pyarrow()
    with reading(path, "parquet file"):
        check_regular(path)
        file = pyarrow.parquet.ParquetFile(path)
        names = [name for name in file.schema_arrow.names if chosen(name)]
        table = file.read(columns=names)
        told = (table.schema.metadata or {}).get(NOTES)
        notes = notes_in(path, told) if told else {"source": path.name}
        return {name: _array(path, name, table.column(name), pyarrow) for name in names}, notes


def _array(path: Path, name: str, column: Any, pyarrow: Any) -> NDArray[Any]:
    whole = column.combine_chunks()
    if isinstance(whole, pyarrow.ChunkedArray):
        whole = pyarrow.concat_arrays(whole.chunks) if whole.num_chunks else pyarrow.array([], column.type)
    if whole.null_count:
        row = whole.is_null().to_numpy(zero_copy_only=False).argmax() + 1
        raise RecordingError(f"{path}, row {row}, column {name}: there is no value, expected a number")
    if not pyarrow.types.is_nested(whole.type):
        return np.asarray(whole.to_numpy(zero_copy_only=False))
    if pyarrow.types.is_struct(whole.type) or pyarrow.types.is_nested(whole.type.value_type):
        return np.array([""] * len(whole))  # no numbers, which is told where it is asked for
    values = np.asarray(whole.flatten().to_numpy(zero_copy_only=False))
    lengths = np.asarray(whole.value_lengths().to_numpy(zero_copy_only=False)) if len(whole) else np.zeros(0)
    if len(lengths) and (lengths != lengths[0]).any():
        row = int(np.argmax(lengths != lengths[0])) + 1
        raise RecordingError(
            f"{path}, row {row}, column {name}: {lengths[row - 1]} elements, expected {lengths[0]} as in row 1"
        )
    return values.reshape(len(whole), -1) if len(whole) else np.zeros((0, 1))


def _pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise needs("pyarrow", "logs", "reading and writing parquet files") from None
    return pyarrow


def write_parquet(path: Path, columns: Mapping[str, NDArray[Any]], notes: Mapping[str, str]) -> None:
    """Columns of a recording by their names, every bit kept; notes in the schema's metadata."""
    pyarrow = _pyarrow()
    table = pyarrow.table(dict(columns)).replace_schema_metadata({NOTES: json.dumps(dict(notes), ensure_ascii=False)})
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    write_bytes(path, buffer.getvalue())
