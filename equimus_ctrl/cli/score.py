"""``equimus-ctrl score``: a model against recordings, open loop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import (
    Json,
    PluginFiles,
    people,
    print_engine,
    print_json,
)
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import share_bar
from equimus_ctrl.options import ScoreOptions


@with_options
def score(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: files or folders.")],
    chosen: ModelChoice,
    *,
    options: ScoreOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Predict recordings with a model, each trial whole and from a start of its own, and print the error.

    A robot that rests begins where its first rows show it. One that may move begins as predicts the trial best, as in
    diagnose, for velocities of noisy positions would decide; --start measured takes these.

    \b
    [bold]Examples[/bold]
    equimus-ctrl score ../shared/recordings/concealed/open_1
    equimus-ctrl score my_recordings --model corrected.toml --json
    equimus-ctrl score step_release.csv --window 5 9 --engine mujoco
    equimus-ctrl score runs --model robot.xml --start measured
    """  # noqa: D301
    from rich.table import Table

    from equimus_ctrl import workflow

    console = people()
    workflow.load_plugins(plugins or ())
    with share_bar(console, "score") as show:
        found = workflow.score(
            recordings,
            chosen.read(recordings),
            options,
            progress=show,
        )
    joints = found.model.robot.joint_names
    print_engine(console, found.engine)
    heading = f"{found.model.name} against {len(found.trials)} trial(s) from {found.start} starts, RMSE in rad or m:"
    console.print(heading, markup=False, soft_wrap=True)
    table = Table()
    table.add_column("trial")
    for joint in joints:
        table.add_column(joint, justify="right")
    for trial in found.trials:
        table.add_row(trial.recording.name, *(f"{value:.5f}" for value in trial.rmse))
    table.add_section()
    table.add_row("all", *(f"{value:.5f}" for value in found.rmse), style="bold")
    console.print(table)
    if as_json:
        print_json(found.to_dict())
