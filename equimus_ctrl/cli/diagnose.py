"""``equimus-ctrl diagnose``: missing (unmodelled) physics from recordings."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import (
    Force,
    Json,
    PluginFiles,
    check_model_file,
    people,
    print_files,
    print_json,
)
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import best_so_far, stage_bar
from equimus_ctrl.options import DiagnoseOptions


@with_options
def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Trials: files, or folders of them.")],
    chosen: ModelChoice,
    write_model: Annotated[
        Path | None,
        typer.Option(
            "--write-model",
            metavar="FILE",
            help="Write the corrected model, for --model; with --by, one for each folder where they differ.",
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write report.html, record.json and figures there.")
    ] = None,
    force: Force = False,
    *,
    options: DiagnoseOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Find the physics that a model lacks, from recordings: where, which effect, how large, and how certain.

    The model parameters are re-identified first, so that a parameter error is not taken for missing physics. Then every
    known effect is tried at every place, alone and in combination. An effect is accepted only where held-out trials
    confirm it. What no effect explains is reported as an unstructured residual force, over what it depends on.

    Ctrl-C gives the best so far (exit code 130), and pressed again ends at once.

    \b
    [bold]Examples[/bold]
    equimus-ctrl diagnose recordings --report report --write-model corrected.toml
    equimus-ctrl diagnose triangle.csv --until 20 --json
    equimus-ctrl diagnose recordings --exclude creep --exclude hysteresis
    equimus-ctrl diagnose recordings --budget 60
    equimus-ctrl diagnose recordings --splits 8
    equimus-ctrl diagnose unit_a unit_b --by folder --model robot.xml
    equimus-ctrl diagnose runs --model robot.xml --parameters free.toml --write-model corrected.toml
    """  # noqa: D301
    from equimus_ctrl import outputs

    if report is not None:
        outputs.Results(report, force, report)  # refused before the work where it would be after
    check_model_file(write_model, force)
    console = people()
    files: list[Path] = []
    typed = shlex.join(["equimus-ctrl", *sys.argv[1:]])
    with stage_bar(console, "getting ready", width=34, bar_width=24) as show, best_so_far(console) as asked:
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())
        found = workflow.diagnose(
            recordings,
            chosen.read(recordings),
            options,
            progress=show,
            asked=asked,
        )
        record = found.to_dict()
        if report is not None:
            show("report")
            title = f"Diagnosis of {', '.join(path.name for path in recordings)}"
            files += workflow.write_report(found, report, title, command_line=typed, force=force)
    from equimus_ctrl.report.diagnosis_text import print_diagnosis

    print_diagnosis(console, found, typed)
    if write_model is not None:
        for path, corrected in workflow.by_group(write_model, found.corrected, found.groups):
            # Of groups the names are known now only.
            path = path if force or path == write_model else outputs.free_name(path)
            files += workflow.save_model(path, workflow.renamed(corrected, path.stem), chosen.model)
    print_files(console, files)
    if as_json:
        print_json(record)
    if asked():
        raise typer.Exit(130)
