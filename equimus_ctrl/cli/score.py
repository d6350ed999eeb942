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
    from equimus_ctrl import workflow
    from equimus_ctrl.report.paged import PagedTable

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
    trials = f"{len(found.trials)} trial{'s' * (len(found.trials) != 1)}"
    units = found.model.robot.joint_units
    alike = len(set(units)) == 1
    table = PagedTable(
        f"{found.model.name} against {trials} from {found.start} starts, RMSE{f' in {units[0]}' if alike else ''}",
        ("trial", *(name if alike else f"{name}\n{unit}" for name, unit in zip(joints, units, strict=True))),
        [(own.recording.name, *(f"{value:.5f}" for value in own.rmse)) for own in found.trials]
        + [("all", *(f"{value:.5f}" for value in found.rmse))],
        sections=(len(found.trials) - 1,),
    )
    console.print(table)
    if as_json:
        print_json(found.to_dict())
