"""``equimus-ctrl list``: what can be named on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

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
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if plugins:
        from equimus_ctrl.workflow import load_plugins

        load_plugins(plugins)
    for option, given in (("--model", model), ("--write", write)):
        if given is not None and kind is not Kind.parameters:
            raise ConfigError(f"{option} is for list parameters, not for list {kind.value}")
    rows = _parameters(model, write, force) if kind is Kind.parameters else _rows(kind)
    if as_json:
        print_json({kind.value: rows})
        return
    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, show_header=False)
    for row in rows:
        extra = row.get("options") or row.get("parameters") or {}
        detail = ", ".join(f"{key} = {value}" if kind is Kind.scenarios else value for key, value in extra.items())
        summary = escape(str(row["summary"])) + (f"\n[dim]{escape(detail)}[/dim]" if detail else "")
        table.add_row(f"[bold]{row['name']}[/bold]", summary)
    console.print(table)
    if kind is Kind.parameters:
        from equimus_ctrl.engines.choice import engine_for
        from equimus_ctrl.workflow import load_model

        print_engine(console, engine_for(load_model(model)))


def _parameters(model: Path | None, write: Path | None, force: bool) -> list[dict[str, Any]]:
    from equimus_ctrl import workflow

    robot = workflow.load_model(model)
    rows = workflow.parameter_rows(robot)
    if write is not None:
        check_model_file(write, force)
        workflow.offer(write, robot)
        print_files(people(), [write])
    for row in rows:
        free = f", free by default from {row['low']:g} to {row['high']:g}" if row["free"] else ""
        row["summary"] = f"{row['value']:g} {'' if row['unit'] == '1' else row['unit']}".rstrip() + free
    return rows


def _rows(kind: Kind) -> list[dict[str, Any]]:
    if kind is Kind.scenarios:
        from equimus_ctrl.workflow import listed_scenarios

        return listed_scenarios()
    if kind is Kind.controllers:
        from equimus_ctrl.controllers.registry import CONTROLLERS

        rows: list[dict[str, Any]] = [
            {"name": name, "summary": entry.summary, "settings": entry.settings, "compared": entry.compared}
            for name, entry in CONTROLLERS.items()
        ]
        own = {"summary": "your own, a class or a function", "settings": None, "compared": False}
        return [*rows, {"name": "path/to/file.py:Name", **own}]
    if kind is Kind.plants:
        from equimus_ctrl.plants.registry import PLANTS

        return [
            {"name": name, "summary": entry.summary, "real": entry.real, "effects": entry.effects}
            for name, entry in PLANTS.items()
        ]
    if kind is Kind.thresholds:
        return _thresholds()
    if kind is Kind.models:
        from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES

        return [{"name": name, "summary": (make.__doc__ or "").strip()} for name, make in MORPHOLOGIES.items()]
    from equimus_ctrl.effects import REGISTRY

    return [
        {
            "name": name,
            "summary": f"{cls.summary} (at {' or '.join(cls.sits_at)}, {cls.side} side{_whose(cls.robots)})",
            "robots": list(cls.robots),
            "sits_at": list(cls.sits_at),
            "side": cls.side,
            "parameters": {
                key: f"{key} [{info['unit']}] {info['low']:g} to {info['high']:g}: {info['doc']}"
                for key, info in cls.parameter_info().items()
            },
        }
        for name, cls in sorted(REGISTRY.items())
    ]


def _thresholds() -> list[dict[str, Any]]:
    from equimus_ctrl.diagnosis.policy import Thresholds
    from equimus_ctrl.preflight.limits import CheckLimits

    asked = [("diagnosis", t.name, t) for t in Thresholds.listed()]
    asked += [("preflight", f"check.{t.name}", t) for t in CheckLimits.listed()]
    return [
        {
            "name": name,
            "summary": f"{t.value:g} {t.unit}".rstrip() + f": {t.meaning}",
            "parameters": {"origin": f"{t.origin.basis}: {t.origin.why}", "asked by": _asked_by(folder, t.where)},
            "value": t.value,
            "unit": t.unit,
        }
        for folder, name, t in asked
    ]


def _asked_by(folder: str, modules: Sequence[str]) -> str:
    return "asked by " + ", ".join(f"{folder}/{module}.py" for module in modules)


def _whose(robots: tuple[str, ...]) -> str:
    if "mjcf" not in robots:
        return ""
    return ", also MuJoCo's XML" if "elastic" in robots else ", MuJoCo's XML alone"
