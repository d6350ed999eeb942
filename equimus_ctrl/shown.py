"""How values show themselves: in a line, whatever arrays they hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

LONGEST = 240
"""Characters of a line."""
MOST_LISTED = 5
"""Names or numbers that are listed; of more their count stands."""


class Short:
    """A dataclass whose ``repr`` is one line: what it says of itself, else its fields, arrays by their shapes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return cut(f"<{type(self).__name__}{self.told()}>")

    def told(self) -> str:
        """What stands behind the name of the class."""
        shown = (f"{f.name}={brief(getattr(self, f.name))}" for f in fields(self) if f.repr)  # type: ignore[arg-type]
        return ": " + ", ".join(shown)


def cut(line: str) -> str:
    """A line that is not too long."""
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 2]}…{line[-1]}"


def brief(value: Any) -> str:
    """A value in a few characters."""
    if isinstance(value, np.ndarray):
        small = value.ndim == 1 and value.size <= MOST_LISTED
        return f"[{', '.join(f'{own:.4g}' for own in value)}]" if small else f"{value.shape} array"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str | PurePath):
        value = str(value)
        return repr(value if len(value) <= 60 else f"{value[:59]}…")
    if isinstance(value, list | tuple) and len(value) <= MOST_LISTED and all(isinstance(own, str) for own in value):
        return f"({', '.join(value)})"
    if isinstance(value, list | tuple | set | frozenset | Mapping):
        return counted(len(value), "item")
    if isinstance(value, bool | int | None):
        return repr(value)
    name = getattr(value, "name", None)
    kind = value.__name__ if isinstance(value, type) else type(value).__name__
    return f"{kind} {name}" if isinstance(name, str) and is_dataclass(value) else kind


def counted(count: int, noun: str) -> str:
    """Such as ``1 trial`` or ``3 trials``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def listed(names: Iterable[str], noun: str) -> str:
    """Such as ``2 joints (hip, knee)``; without names where there are too many of them."""
    own = list(names)
    return counted(len(own), noun) + (f" ({', '.join(own)})" if 0 < len(own) <= MOST_LISTED else "")


def by_name(names: Iterable[str], values: NDArray[np.float64], unit: str = "", scale: float = 1.0) -> str:
    """Such as ``hip 12.1, knee 8.4 mrad``; lowest and highest where there are too many names."""
    own = list(names)
    if len(own) > MOST_LISTED:
        return f"{scale * np.min(values):.3g} to {scale * np.max(values):.3g} {unit}".rstrip()
    return f"{', '.join(f'{n} {scale * v:.3g}' for n, v in zip(own, values, strict=True))} {unit}".rstrip()
