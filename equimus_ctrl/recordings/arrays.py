"""Named arrays: NumPy's ``.npz``, and dictionaries of tensors that ``torch.save`` wrote, as PACE records (``.pt``).

PACE (Bjelonic et al., leggedrobotics/pace-sim2real, ``scripts/pace/data_collection.py``) saves ``time`` (n,) [s],
``dof_pos`` (n, nj) measured and ``des_dof_pos`` (n, nj) commanded positions [rad]; a row's target is in force from then
on. The joints' order is that of its configuration and not in the file, so a mapping says it.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.presets import check_regular, write_bytes
from equimus_ctrl.recordings.assemble import elements
from equimus_ctrl.recordings.logs import Log, Table, Wanted, flat, notes_in, reading
from equimus_ctrl.recordings.mapping import Mapping as ColumnMapping
from equimus_ctrl.recordings.mapping import Source

CLOCKS = ("time", "t", "timestamp", "times")
MEASURED = ("dof_pos", "position", "positions", "pos", "q", "qpos")
COMMANDED = ("des_dof_pos", "command", "commands", "cmd", "action", "actions", "ctrl", "u")
NOTES = "notes"
STORAGES = {
    "DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
    "ShortStorage": "<i2", "CharStorage": "<i1", "ByteStorage": "<u1", "BoolStorage": "?",
}  # fmt: skip
"""Of torch → of NumPy."""


def read_npz(path: Path) -> list[Log]:
    """The log of a file of named arrays.

    Raises:
        RecordingError: where it cannot be read.
    """
    with reading(path, ".npz file of arrays"):
        check_regular(path)
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    return [_log(path, arrays, "a file of arrays")]


def read_torch(path: Path) -> list[Log]:
    """The log of a dictionary of tensors; torch is not needed, and nothing of the file is run.

    Raises:
        RecordingError: where it cannot be read.
    """
    with reading(path, "dictionary of tensors as torch.save writes it"):
        check_regular(path)
        if not zipfile.is_zipfile(path):
            raise RecordingError(
                f"{path}: is none of the zip files that torch.save writes since torch 1.6; expected such a one, or the "
                "arrays in an .npz file: numpy.savez(file, **{key: tensor.numpy() for key, tensor in data.items()})"
            )
        with zipfile.ZipFile(path) as archive:
            inside = next((name for name in archive.namelist() if name.endswith("data.pkl")), None)
            if inside is None:
                raise RecordingError(f"{path}: has no data.pkl in it, expected what torch.save writes")
            data = _Tensors(archive, inside).load()
        if not isinstance(data, Mapping):
            raise RecordingError(f"{path}: holds a {type(data).__name__}, expected a dictionary of tensors")
        arrays = {str(key): value.array() for key, value in data.items() if isinstance(value, _Tensor)}
    if not arrays:
        raise RecordingError(f"{path}: holds no tensors, expected a dictionary of them")
    return [_log(path, arrays, "a file of tensors")]


def _log(path: Path, arrays: Mapping[str, NDArray[Any]], form: str) -> Log:
    notes = {"source": path.name}
    texts = {key: values for key, values in arrays.items() if values.dtype.kind in "US" and values.ndim == 0}
    if NOTES in texts:
        notes = notes_in(path, str(texts[NOTES]))
    columns = flat({key: values for key, values in arrays.items() if values.ndim in (1, 2) and key not in texts})
    clock = next((key for key in CLOCKS if key in columns), "")
    if clock:
        columns = {key: values for key, values in columns.items() if len(values) == len(columns[clock])} or columns
    return Log(path, path.stem, (Table.of(columns),), form, found, notes, clock)


def found(log: Log, wanted: Wanted, mapping: ColumnMapping) -> dict[str, Source]:
    """Arrays by their usual names; the order of joints in them is the mapping's to say.

    Raises:
        RecordingError: where there are none, or nobody says their order.
    """
    table = log.tables[0]
    sources: dict[str, Source] = {}
    for prefix, bases, names in (("pos", MEASURED, wanted.joints), ("cmd", COMMANDED, wanted.actuators)):
        if not names or any(target.startswith(f"{prefix}.") for target in mapping.columns):
            continue
        base = next((own for own in bases if own in table.columns or f"{own}[0]" in table.columns), None)
        if base is None:
            raise RecordingError(
                f"{log.where}: there is no array {' or '.join(bases)} for {prefix}. (known: "
                f"{', '.join(table.columns) or 'none'}); expected one, or a mapping with [columns]"
            )
        sources |= elements(log, table, base, names, prefix, mapping, {})
    return sources


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]], notes: Mapping[str, str]) -> None:
    """Columns of a recording as arrays of their names, every bit kept; notes as JSON under ``notes``."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {NOTES: np.array(json.dumps(dict(notes), ensure_ascii=False)), **columns}
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


@dataclass(frozen=True)
class _Storage:
    """Numbers of a tensor, in a file of the archive."""

    kind: str


@dataclass(frozen=True, eq=False)
class _Tensor:
    """A view of a storage."""

    numbers: NDArray[Any]
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    def array(self) -> NDArray[Any]:
        """As an array of its own.

        Raises:
            ValueError: where one of its numbers lies outside the storage, or it has more than that.
        """
        whole = len(self.numbers)
        last = self.offset + sum((n - 1) * s for n, s in zip(self.size, self.stride, strict=True))
        negative = min((self.offset, *self.size, *self.stride)) < 0
        if negative or self.offset > whole or math.prod(self.size) > whole or (0 not in self.size and last >= whole):
            raise ValueError(
                f"a tensor of {self.size} with strides {self.stride} from {self.offset} on lies outside its {whole} "
                "numbers"
            )
        steps = tuple(s * self.numbers.itemsize for s in self.stride)
        return np.array(np.lib.stride_tricks.as_strided(self.numbers[self.offset :], self.size, steps))


def _rebuild(storage: Any, offset: int, size: Any, stride: Any, *_: object) -> _Tensor:
    return _Tensor(storage, int(offset), tuple(map(int, size)), tuple(map(int, stride)))


class _Tensors(pickle.Unpickler):
    """Reads a pickle that may hold tensors, numbers, texts and containers of them, and calls nothing else."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        super().__init__(io.BytesIO(archive.read(name)))
        self._archive, self._folder = archive, name.removesuffix("data.pkl")

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in STORAGES:
            return _Storage(name)
        if (module, name) in (("torch._utils", "_rebuild_tensor_v2"), ("torch._utils", "_rebuild_tensor")):
            return lambda *given: _rebuild(*given)  # a pickle may set attributes of what it is handed
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        raise RecordingError(
            f"{self._archive.filename}: holds a {module}.{name}, expected tensors, numbers and texts alone; arrays in "
            "an .npz file do as well"
        )

    def persistent_load(self, pid: Any) -> Any:
        kind, storage, key, _, count = pid
        if kind != "storage" or not isinstance(storage, _Storage):
            raise ValueError(f"{kind!r} is no storage")
        data = self._archive.read(f"{self._folder}data/{key}")
        return np.frombuffer(data, STORAGES[storage.kind])[:count]
