"""``equimus-ctrl export``: a model as a file of another program."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import Json, PluginFiles, people, print_files, print_json
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.options import ExportOptions


@with_options
def export(
    source: Annotated[
        Path | None, typer.Argument(metavar="MODEL", help="The same as --model; the nominal leg by default.")
    ] = None,
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.xml", help="File to write; the model's name and .xml by default."),
    ] = None,
    file_format: Annotated[str, typer.Option("--format", help="mjcf: the XML of MuJoCo 4.")] = "mjcf",
    chosen: ModelChoice,
    options: ExportOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Write a model with its parameters, joint stops and effects as one file of plain MuJoCo.

    What MuJoCo has a law for is written as that. An effect that it has none for is refused by name, and --leave-out
    writes the rest, with a comment in the file that says what is not in it.

    \b
    [bold]Examples[/bold]
    equimus-ctrl export --output leg.xml
    equimus-ctrl export corrected.toml --format mjcf --output whole.xml
    equimus-ctrl export corrected.toml --leave-out backlash@knee -o whole.xml --json
    """  # noqa: D301
    from equimus_ctrl import workflow
    from equimus_ctrl.errors import ConfigError

    console = people()
    if source is not None and chosen.model is not None:
        raise ConfigError(f"the model is {source} and also --model {chosen.model}, expected one of both")
    chosen = replace(chosen, model=source or chosen.model)
    workflow.load_plugins(plugins or ())
    model = chosen.read()
    done = workflow.export_model(
        output or Path(f"{model.name}.xml"), model, options, format=file_format, near=chosen.model
    )
    for effect in done.model.effects:
        console.print(f"{effect.name} at {effect.location}: {effect.mjcf_form}", markup=False, soft_wrap=True)
    for effect in done.left_out:
        console.print(f"left out: {effect.name} at {effect.location}", style="yellow", markup=False, soft_wrap=True)
    for name in done.ignored:
        console.print(f"left out: {name}, which is ignored", style="yellow", markup=False, soft_wrap=True)
    print_files(console, [done.path])
    if as_json:
        print_json(done.to_dict())
