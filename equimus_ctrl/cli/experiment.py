"""``equimus-ctrl experiment``: trials that tell the explanations of a diagnosis apart."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli import experiment_run
from equimus_ctrl.cli.common import Figures, Force, Json, PluginFiles, people, print_files, print_json, shown_path
from equimus_ctrl.cli.flags import Command, Group
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import best_so_far, stage_bar
from equimus_ctrl.options import DesignOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

app = typer.Typer(
    cls=Group,
    help="Trials that distinguish the explanations that a diagnosis leaves: designed, and made.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)
app.command("run", cls=Command)(experiment_run.run)


@app.command(cls=Command)
@with_options
def design(
    record: Annotated[Path, typer.Argument(help="Record of a diagnosis (record.json of --report), or its folder.")],
    chosen: ModelChoice,
    *,
    options: DesignOptions,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="For commands, record and figures; results/experiment/…"),
    ] = None,
    force: Force = False,
    figures: Figures = True,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Design a trial under which the explanations that a diagnosis leaves differ most, within limits.

    Says which of them it will distinguish, with which chance and how many repeats, and where nothing within the limits
    does, which sensor would. Writes the commands for run commands. Ctrl-C designs the best so far.

    Exit code 3 says that no design moves the robot within the limits.

    \b
    [bold]Examples[/bold]
    equimus-ctrl experiment design report/record.json
    equimus-ctrl experiment design report --model robot.xml --limits limits.toml --limit knee.margin=0.1
    equimus-ctrl experiment design report --can payload:foot=0.2 --can supply:all=0.8 --duration 8
    equimus-ctrl experiment design report --family steps --family triangle --seed 3 --output next_trial --json
    """  # noqa: D301
    from equimus_ctrl import outputs
    from equimus_ctrl.workflow import experiments

    console = people()
    outputs.Results(output, force, output or Path("results") / "experiment")  # refused before the work
    with stage_bar(console, "reading", width=8) as show, best_so_far(console) as asked:
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())
        found = workflow.design_experiment(record, chosen.read(), options, progress=show, asked=asked)
        show("figures")
        words = model_words(chosen, plugins or ())
        files = experiments.write_design(found, output, force=force, figures=figures, model_options=words)
    from equimus_ctrl.report.experiment_text import print_design

    run = experiments.run_command(Path(shown_path(files.commands)), words)
    again = shlex.join(["equimus-ctrl", "diagnose", "RECORDINGS", "designed", *words])
    print_design(console, found, run, again)
    print_files(console, files.all)
    if as_json:
        print_json({**found.to_dict(), "run": run, "files": [str(file) for file in files.all]})


def model_words(chosen: ModelChoice, plugins: Sequence[Path]) -> list[str]:
    """The options by which a model was chosen, as they are given on the command line."""
    words = ["--model", str(chosen.model)] if chosen.model is not None else []
    for flag in ("lock", "ignore", "prescribe", "unmeasured"):
        for value in getattr(chosen, flag):
            words += [f"--{flag}", str(value)]
    words += ["--motors"] if chosen.motors else []
    for path in plugins:
        words += ["--plugin", str(path)]
    return words
