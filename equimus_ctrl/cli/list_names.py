"""``equimus-ctrl list``: what can be named on the command line."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import (
    Force,
    Json,
    ModelFile,
    PluginFiles,
    check_model_file,
    people,
    print_engine,
    print_files,
    print_json,
)
from equimus_ctrl.errors import ConfigError

if TYPE_CHECKING:
    from equimus_ctrl.workflow import Listing


class Kind(StrEnum):
    """What can be listed."""

    scenarios = "scenarios"
    controllers = "controllers"
    plants = "plants"
    effects = "effects"
    models = "models"
    parameters = "parameters"
    thresholds = "thresholds"


def list_names(
    kind: Annotated[Kind, typer.Argument(help="What to list.")],
    plugins: PluginFiles = None,
    model: ModelFile = None,
    write: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the parameters of a model to be edited, for --parameters."),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """List scenarios, controllers, plants, effects, models, parameters of a model, or thresholds of diagnose and check.

    \b
    [bold]Examples[/bold]
    equimus-ctrl list scenarios
    equimus-ctrl list effects --json
    equimus-ctrl list effects --plugin docs/examples/drag.py
    equimus-ctrl list parameters --model robot.xml --write free.toml
    """  # noqa: D301
    from equimus_ctrl import workflow

    workflow.load_plugins(plugins or ())
    for option, given in (("--model", model), ("--write", write)):
        if given is not None and kind is not Kind.parameters:
            raise ConfigError(f"{option} is for list parameters, not for list {kind.value}")
    robot = workflow.load_model(model) if kind is Kind.parameters else None
    found = workflow.list_names(kind.value, robot)
    if write is not None and robot is not None:
        check_model_file(write, force)
        workflow.offer(write, robot)
        print_files(people(), [write])
    if as_json:
        print_json(found.to_dict())
        return
    _print(found)
    if robot is not None:
        from equimus_ctrl.engines.choice import engine_for

        print_engine(people(), engine_for(robot))


def _print(found: Listing) -> None:
    """A row for each, those of a group under its heading."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    groups = list(dict.fromkeys(row.get("group") for row in found.rows))
    for k, group in enumerate(groups):
        table = Table(box=None, pad_edge=False, show_header=False)
        for row in found.rows:
            if row.get("group") != group:
                continue
            extra = row.get("options") or row.get("parameters") or {}
            if "options" in row:
                said = [f"{key} = {own}" if own != "" else key for key, own in extra.items()]
            else:
                said = list(extra.values())
            detail = ", ".join(said)
            summary = escape(str(row["summary"])) + (f"\n[dim]{escape(detail)}[/dim]" if detail else "")
            table.add_row(f"[bold]{row['name']}[/bold]", summary)
        if group is not None:
            console.print(("\n" if k else "") + f"[bold underline]{escape(group)}[/bold underline]")
        console.print(table)
