"""``equimus-ctrl sensitivity``: which parameters of a model matter to its predictions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import (
    Figures,
    Force,
    Json,
    PluginFiles,
    people,
    print_engine,
    print_files,
    print_json,
    write_results,
)
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import stage_bar
from equimus_ctrl.options import SensitivityOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

    from equimus_ctrl.identification.sensitivity import Sensitivity

SHOWN = 15


@with_options
def sensitivity(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: files or folders.")],
    chosen: ModelChoice,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="For figures and record.json; identification/results/…"),
    ] = None,
    force: Force = False,
    figures: Figures = True,
    *,
    options: SensitivityOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Change every parameter of a model in turn and show how its errors on recordings change.

    \b
    [bold]Examples[/bold]
    equimus-ctrl sensitivity my_recordings
    equimus-ctrl sensitivity step_release.csv --window 5 9 --parameter 'baa.*' --parameter '*.damping'
    equimus-ctrl sensitivity my_recordings --model identified.toml --share -20 --share 20 --json
    """  # noqa: D301
    from equimus_ctrl import outputs, presets

    name = f"{recordings[0].resolve().stem}_sensitivity"
    default = presets.workspace() / "identification" / "results" / name
    results = outputs.Results(output, force, default)
    console = people()
    with stage_bar(console, "simulating") as show:
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())
        found = workflow.sensitivity(
            recordings,
            chosen.read(recordings),
            options,
            progress=lambda done: show(share=done),
        )
        record = found.to_dict()

        def draw() -> dict[str, Figure]:
            from equimus_ctrl.report.sensitivity_figures import sensitivity_figures

            show("figures")
            return sensitivity_figures(found) if figures else {}

        files = write_results(results, default, draw, record)
    _print(console, found)
    print_files(console, files)
    if as_json:
        print_json({**record, "files": [str(file) for file in files]})


def _print(console: Console, found: Sensitivity) -> None:
    import numpy as np

    from equimus_ctrl.identification.results import together
    from equimus_ctrl.report.diagnosis_words import number
    from equimus_ctrl.report.paged import PagedTable

    base = together(found.base)
    joints = found.model.robot.joint_names
    shown = len(found.names) if len(found.names) <= SHOWN + 3 else SHOWN
    rows, moved = [], []
    for i in range(shown):
        cells = []
        for k in range(len(found.shares)):
            value = together(found.rmse[i, k])
            cells.append("diverges" if found.diverged[i, k] else "–" if np.isnan(value) else f"{1e3 * value:.1f}")
        rows.append((found.names[i], *cells))
        moved.append((found.names[i], *("–" if np.isnan(v) else number(1e3 * float(v)) for v in found.local[i])))
    more = f"{len(found.names) - shown} more matter less" if shown < len(found.names) else ""
    title = f"{found.model.name}: RMSE over all joints in mrad, {1e3 * base:.1f} of the nominal model"
    console.print(PagedTable(title, ("parameter", *(f"{100 * share:+g} %" for share in found.shares)), rows, (), more))
    title = "How far one per cent of each moves the predictions, to first order, RMS in mrad"
    console.print(PagedTable(title, ("parameter", *joints), moved, (), more))
    print_engine(console, found.engine)
    idle = [name for name, local in zip(found.names, found.local, strict=True) if np.all(local == 0)]
    if idle:
        console.print(f"No effect on these trials at all: {', '.join(idle)}.", markup=False)
    if found.diverged.any():
        lost = [name for name, own in zip(found.names, found.diverged, strict=True) if own.any()]
        console.print(f"Diverging when changed: {', '.join(lost)}.", style="yellow", markup=False)
