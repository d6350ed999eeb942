"""``equimus-ctrl diagnose``: what a model leaves out of recordings."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import (
    Bounds,
    EffectFiles,
    EngineName,
    FreeFile,
    Json,
    ModelFile,
    Patterns,
    Window,
    check_model_file,
    check_threads,
    parse_bounds,
    people,
    print_json,
    tell_files,
)
from equimus_ctrl.cli.progress import best_so_far, stage_bar


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Trials: files, or folders of them.")],
    model: ModelFile = None,
    write_model: Annotated[
        Path | None, typer.Option("--write-model", metavar="FILE", help="Write the corrected model, for --model.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write report.html, record.json and figures there.")
    ] = None,
    validation: Annotated[
        list[str] | None,
        typer.Option(
            "--validation",
            metavar="PATTERN",
            help="Trials by which effects are confirmed or rejected, by name; every fourth by default, the end of a "
            "single one.",
        ),
    ] = None,
    test: Annotated[
        list[str] | None,
        typer.Option(
            "--test",
            metavar="PATTERN",
            help="Trials that no fit and no choice sees, by name; by default half of every fourth, from 8 trials on.",
        ),
    ] = None,
    until: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Fit each trial up to this time only, and judge by the rest."),
    ] = None,
    select: Patterns = None,
    window: Window = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            metavar="NAME",
            help="Numbers of the model that may be wrong, such as '*.mass', or base_parameters; by default "
            "what is known least, see list parameters.",
        ),
    ] = None,
    fix: Annotated[
        list[str] | None, typer.Option("--fix", metavar="NAME", help="Numbers that are right all the same.")
    ] = None,
    bound: Bounds = None,
    parameters: FreeFile = None,
    shoot: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Of an MJCF robot: cut trials into windows of this length, each from its own free start; "
            "by default as long as the model as it came stays near.",
        ),
    ] = None,
    most: Annotated[int, typer.Option(help="Largest number of effects that are looked for together.")] = 3,
    exclude: Annotated[
        list[str] | None,
        typer.Option("--exclude", metavar="EFFECT", help="Do not look for this effect, see list effects."),
    ] = None,
    engine: EngineName = None,
    threads: Annotated[int | None, typer.Option(help="Of the simulations; all cores by default.")] = None,
    budget: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Give the best so far after this time, with what was not looked at."),
    ] = None,
    effects: EffectFiles = None,
    as_json: Json = False,
) -> None:
    """Find what a model leaves out of recordings: where it is off, which physics is missing, how much, how sure.

    The model's numbers are refitted first, so that a wrong number is not taken for missing physics. Then every known
    effect is tried at every place, alone and together, and believed only if trials that were left out agree. What no
    effect explains is said to be unexplained, and drawn over what it depends on.

    Ctrl-C gives the best so far (exit code 130), and pressed again ends at once.

    \b
    [bold]Examples[/bold]
    equimus-ctrl diagnose concealed --report report --write-model corrected.toml
    equimus-ctrl diagnose triangle.csv --until 20 --json
    equimus-ctrl diagnose concealed --exclude creep --exclude hysteresis
    equimus-ctrl diagnose concealed --budget 60
    equimus-ctrl diagnose runs --model robot.xml --parameters free.toml --write-model corrected.toml
    """  # noqa: D301
    from equimus_ctrl import presets

    if report is not None:
        presets.check_folder(report)
    check_model_file(write_model)
    check_threads(threads)
    limits = parse_bounds(bound)
    console = people()
    files: list[Path] = []
    with stage_bar(console, "getting ready", width=34, bar_width=24) as show, best_so_far(console) as asked:
        from equimus_ctrl import workflow

        workflow.load_effects(effects or ())
        found = workflow.diagnose_recordings(
            recordings,
            workflow.load_model(model),
            free=free,
            fix=fix or (),
            bounds=limits,
            select=select,
            validation=validation or (),
            test=test or (),
            until=until,
            window=window,
            shoot=shoot,
            parameters=parameters,
            most=most,
            exclude=exclude or (),
            engine=engine,  # type: ignore[arg-type]
            threads=threads,
            budget=budget,
            progress=show,
            asked=asked,
        )
        record = found.to_dict()
        if report is not None:
            from equimus_ctrl.report.diagnosis_page import page

            show("report")
            title = f"Diagnosis of {', '.join(path.name for path in recordings)}"
            text = page(found, title, command_line=shlex.join(["equimus-ctrl", *sys.argv[1:]]))
            presets.make_folder(report)
            files.append(report / "report.html")
            presets.write_text(files[-1], text)
            files.append(report / "record.json")
            presets.write_text(files[-1], presets.json_text(record))
    from equimus_ctrl.report.diagnosis_text import tell

    tell(console, found)
    if write_model is not None:
        files += workflow.save_model(write_model, workflow.renamed(found.corrected, write_model.stem), model)
    tell_files(console, files)
    if as_json:
        print_json(record)
    if asked():
        raise typer.Exit(130)
