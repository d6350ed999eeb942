"""``equimus-ctrl compare``: controllers beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import (
    Figures,
    Force,
    Json,
    ModelFile,
    PluginFiles,
    people,
    print_files,
    print_json,
)
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import stage_bar
from equimus_ctrl.options import CompareOptions


@with_options
def compare(
    scenarios: Annotated[list[str], typer.Argument(help="Scenarios by name (see: list scenarios) or path.")],
    model: ModelFile = None,
    corrected: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Augmented model from a diagnosis; compares on it too, known and not.",
        ),
    ] = None,
    *,
    options: CompareOptions,
    plugins: PluginFiles = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for figures and record; results/compare/… by default.")
    ] = None,
    force: Force = False,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Drive controllers through scenarios under the same conditions, and print their errors side by side.

    Errors are of the true angles. Runs are done beside each other, by processes of this computer or a cluster. Exit
    code 3 says that a run ended early, and the table says why.

    \b
    [bold]Examples[/bold]
    equimus-ctrl compare triangle
    equimus-ctrl compare triangle push --condition delayed --condition perturbed --draws 5
    equimus-ctrl compare hold -c pid -c controllers/example_custom.py:Spring --json
    equimus-ctrl compare triangle --corrected corrected.toml
    equimus-ctrl compare hold track --model robot.xml
    equimus-ctrl compare hold --condition perturbed --draws 500 --scheduler tcp://head:8786
    """  # noqa: D301
    from equimus_ctrl import outputs, presets, workflow
    from equimus_ctrl.cli.common import write_results
    from equimus_ctrl.report.comparison import comparison_figures, comparison_table

    console = people()
    workflow.load_plugins(plugins or ())
    named = "-".join(presets.plain_name(Path(name).stem) for name in scenarios)[:60]
    default = presets.workspace() / "results" / "compare" / named
    results = outputs.Results(output, force, default)
    with stage_bar(console, "compare", width=36, bar_width=24) as show:
        found = workflow.compare(
            scenarios,
            options=options,
            model=workflow.load_model(model),
            corrected=workflow.load_model(corrected) if corrected is not None else None,
            notify=lambda share, what: show(what, share),
        )
    record = found.to_dict()
    files = write_results(results, default, lambda: comparison_figures(found) if figures else {}, record)
    console.print(comparison_table(found))
    print_files(console, files)
    if as_json:
        print_json(record)
    if found.failures:
        raise typer.Exit(3)
