"""Options and printing that several verbs share."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equimus_ctrl.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, and nothing else there.")]
ModelFile = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Model file (TOML); the nominal leg by default.")
]
Recordings = Annotated[
    Path | None,
    typer.Option("--recordings", metavar="DIR", help="Folder with recordings; $EQUIMUS_RECORDINGS by default."),
]

EffectFiles = Annotated[
    list[Path] | None,
    typer.Option("--effects", metavar="FILE.py", help="Python file that registers effects of your own; repeatable."),
]


def people() -> Console:
    """Where people read: standard error, so that standard output stays clean for machines."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def print_json(value: Any) -> None:
    """JSON on standard output."""
    from equimus_ctrl.presets import json_text

    sys.stdout.write(json_text(value))


def key_values(items: list[str] | None, option: str) -> dict[str, str]:
    """``key=value`` texts as a table.

    Raises:
        ConfigError: where a text is not of that form.
    """
    table: dict[str, str] = {}
    for item in items or []:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise ConfigError(f"{option} {item!r}: expected key=value, such as duration=10")
        table[key.strip()] = value.strip()
    return table


def shown_path(path: Path) -> str:
    """A path as a person would write it from here."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
