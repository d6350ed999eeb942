"""``equimus-ctrl check``: what recordings are like and what they could show, before anything else."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import Force, Json, PluginFiles, people, print_engine, print_files, print_json
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import stage_bar
from equimus_ctrl.options import CheckOptions


@with_options
def check(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: files or folders.")],
    chosen: ModelChoice,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE.png", help="Draw what they could show there.")
    ] = None,
    force: Force = False,
    *,
    options: CheckOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Say what recordings are like and what they could show, before anything is fitted.

    Clock and jitter, dead times, steps and noise of the sensors, clipping, saturation, rests, repeats, differences
    between runs; which parameters of the model they determine, and which effects they could show at which size. Exit
    code 2 where a diagnosis of them would mean nothing.

    \b
    [bold]Examples[/bold]
    equimus-ctrl check my_recordings
    equimus-ctrl check docs/examples/pendulum --model docs/examples/pendulum.xml --figure shows.png
    equimus-ctrl check my_recordings --quick --json
    equimus-ctrl check runs --model robot.xml --free '*.mass' --budget 120
    """  # noqa: D301
    from equimus_ctrl import outputs, presets

    if figure is not None:
        presets.check_png(figure)
        outputs.check_new(figure, force)
    console = people()
    with stage_bar(console, "reading") as show:
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())
        found = workflow.check(
            recordings, chosen.read(recordings), options, progress=lambda stage, done: show(stage, done)
        )
        files = []
        if figure is not None:
            from equimus_ctrl.report import style

            show("figure")
            files.append(style.save(found.figure(), figure))
    from equimus_ctrl.report.check_text import print_check

    print_check(console, found)
    if found.information is not None:
        print_engine(console, found.information.engine)
    print_files(console, files)
    if as_json:
        print_json({**found.as_json(), "files": [str(file) for file in files]})
    if found.stops:
        raise typer.Exit(2)
