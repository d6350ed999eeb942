"""Options, checks and printing that several verbs share."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equimus_ctrl.options import key_values as key_values

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from matplotlib.figure import Figure
    from rich.console import Console
    from rich.table import Table

    from equimus_ctrl.engines.base import Engine
    from equimus_ctrl.outputs import Results

Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, and nothing else there.")]
ElasticFile = Annotated[
    Path | None, typer.Option("--model", metavar="FILE", help="Model file (TOML); the nominal leg by default.")
]
ModelFile = Annotated[
    Path | None,
    typer.Option(
        "--model", metavar="FILE", help="Model file (TOML), MJCF file (XML) or URDF; the nominal leg by default."
    ),
]
Recordings = Annotated[
    Path | None,
    typer.Option("--recordings", metavar="DIR", help="Folder with recordings; $EQUIMUS_RECORDINGS by default."),
]
PluginFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin",
        "--effects",
        metavar="FILE.py",
        help="Python file that registers effects, controllers, plants or scenarios of your own; repeatable.",
    ),
]
Figures = Annotated[bool, typer.Option(help="Draw figures.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there already; else it is refused.")]


def people() -> Console:
    """Console on standard error, so that standard output holds JSON alone."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def print_json(value: Any) -> None:
    """JSON on standard output."""
    from equimus_ctrl.errors import ConfigError
    from equimus_ctrl.presets import json_text

    if sys.stdout is None:
        raise ConfigError("standard output is closed; JSON is printed there")
    sys.stdout.write(json_text(value))


def check_model_file(path: Path | None, force: bool = False) -> None:
    """Refuse a place where no model file can be written, before anything is computed.

    Raises:
        ConfigError: where it is a folder, its name does not end in .toml, its folder cannot be written to, or it is
            there already and is not to be replaced.
    """
    from equimus_ctrl import outputs, presets

    if path is not None:
        presets.check_toml(path)
        outputs.check_new(path, force)


def write_results(
    results: Results, default: Path, draw: Callable[[], dict[str, Figure]], record: dict[str, Any]
) -> list[Path]:
    """Figures and ``record.json`` into the folder of a run; nothing where drawing fails or is stopped."""
    import tempfile

    from equimus_ctrl import outputs, presets
    from equimus_ctrl.report import style

    with tempfile.TemporaryDirectory() as scratch:
        drawn = [style.save(figure, Path(scratch) / f"{name}.png") for name, figure in draw().items()]
        pictures = {file.name: file.read_bytes() for file in drawn}
    folder = results.opened(default)
    for name, data in pictures.items():
        presets.write_bytes(folder / name, data)
    files = [folder / name for name in pictures]
    return [*files, outputs.write_record(folder, "record.json", record, files)]


def shown_path(path: Path) -> str:
    """A path as a person would write it from here."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def print_files(console: Console, files: Iterable[Path]) -> None:
    """A line for each file that was written."""
    for file in files:
        console.print(f"wrote {shown_path(file)}", markup=False, soft_wrap=True)


def print_engine(console: Console, engine: Engine) -> None:
    """Which engine simulates and why, where there was something to choose."""
    if engine.reason:
        console.print(engine.sentence, style="dim", markup=False, soft_wrap=True)


def light_table(title: str, caption: str | None = None) -> Table:
    """A table with a line under its headings and no other."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(
        title=title,
        title_justify="left",
        caption=caption,
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
