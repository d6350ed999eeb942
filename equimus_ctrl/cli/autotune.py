"""``equimus-ctrl autotune``: settings of a controller that work on a whole ensemble of robots."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equimus_ctrl.cli.common import (
    Figures,
    Json,
    ModelFile,
    PluginFiles,
    people,
    print_files,
    print_json,
    shown_path,
)
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import bars, time_left
from equimus_ctrl.options import AutotuneOptions

if TYPE_CHECKING:
    from rich.console import Console

    from equimus_ctrl.workflow import TunedFiles

StudyFile = Annotated[
    Path | None, typer.Option(help="Study file (TOML); the controller's, leg.toml or any.toml in tuning/ by default.")
]


@with_options
def autotune(
    controller: Annotated[str, typer.Argument(help="pid, lqr, nmpc, sampling, or one of a plugin.")],
    study: StudyFile = None,
    model: ModelFile = None,
    plugins: PluginFiles = None,
    *,
    options: AutotuneOptions,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Tune a controller in simulation, over an ensemble of perturbed robots whose valves or drives are late.

    Ctrl-C keeps the best so far. The same command goes on where it was stopped, even after a crash.

    \b
    [bold]Examples[/bold]
    equimus-ctrl autotune lqr
    equimus-ctrl autotune nmpc --budget 120 --json
    equimus-ctrl autotune pid --model corrected.toml
    equimus-ctrl autotune lqr --model robot.xml --candidates 20
    equimus-ctrl autotune nmpc --scheduler tcp://head:8786
    equimus-ctrl autotune leaning --plugin docs/examples/plugin.py --scenario hold
    """  # noqa: D301
    _tune(controller, study, model, plugins, options, figures, as_json)


@with_options
def autotune_pid(
    study: StudyFile = None,
    model: ModelFile = None,
    plugins: PluginFiles = None,
    *,
    options: AutotuneOptions,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Tune the PID: the same as autotune pid.

    Ctrl-C keeps the best so far. The same command goes on where it was stopped, even after a crash.

    \b
    [bold]Examples[/bold]
    equimus-ctrl autotune-pid
    equimus-ctrl autotune-pid --candidates 2000 --seed 7
    equimus-ctrl autotune-pid --scenario hold --scenario chirp --output my_pid.toml
    equimus-ctrl autotune-pid --model corrected.toml --json
    equimus-ctrl autotune-pid --model robot.xml --candidates 100
    """  # noqa: D301
    _tune("pid", study, model, plugins, options, figures, as_json)


def _tune(
    controller: str,
    study: Path | None,
    model: Path | None,
    plugins: list[Path] | None,
    options: AutotuneOptions,
    figures: bool,
    as_json: bool,
) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    console = people()
    so_far = TextColumn("best {task.fields[best]}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), so_far, *time_left())
    with bars(console, *columns) as progress:
        task = progress.add_task("getting ready", total=None, best="–")
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())
        lowest = float("inf")

        def begin(total: int) -> None:
            progress.update(task, description="compiling the loop", total=total)

        def notify(trial: Any) -> None:
            nonlocal lowest
            if trial.evaluation.feasible:
                lowest = min(lowest, trial.evaluation.cost)
            best = "none yet" if lowest == float("inf") else f"{lowest:.4f}"
            progress.update(task, description=trial.stage, completed=trial.index + 1, best=best)

        def stage(name: str) -> None:
            progress.update(task, description=name)

        tuned = workflow.tune_into(
            controller,
            study,
            workflow.load_model(model),
            options,
            begin=begin,
            notify=notify,
            stage=stage,
        )
        files = [tuned.settings, tuned.record]
        if figures:
            from equimus_ctrl.report.tuning_figures import save_tuning_figures

            stage("figures")
            files += save_tuning_figures(tuned.result, tuned.folder)
    _print(console, tuned)
    print_files(console, files)
    if tuned.left is not None:
        console.print(
            f"{shown_path(tuned.left)} was there already and stays as it is; --force replaces it, and run takes the "
            f"new settings with --settings {shown_path(tuned.settings)}",
            markup=False,
            soft_wrap=True,
        )  # fmt: skip
    if as_json:
        record = tuned.result.record()
        del record["evaluations"]
        print_json({**record, "reused": tuned.reused, "files": [str(f) for f in files]})
    if tuned.result.interrupted:
        raise typer.Exit(130)


def _print(console: Console, tuned: TunedFiles) -> None:
    result = tuned.result
    if result.interrupted or result.timed_out:
        how = "stopped" if result.interrupted else "the time was up"
        console.print(
            f"{how} after {len(result.history)} of {result.study.candidates} {result.noun}: the best so far was "
            "kept; the same command goes on from here"
        )
    if tuned.reused:
        console.print(f"{tuned.reused} evaluations were taken over from an earlier run")
    console.print(_numbers(result))
    console.print(_before_and_after(result))
    if not result.margins:
        return
    console.print(_margins(result))
    for check in result.checks:
        rmse = ", ".join(f"{value:.4f}" for value in check.rmse)
        console.print(
            f"{check.scenario} on the MuJoCo plant: RMSE {rmse} rad; the two engines differ by at most "
            f"{check.difference:.1e} rad"
        )


def _numbers(result: Any) -> Any:
    """What was found: the rows that the result says, under their heads."""
    from rich.table import Table

    title, heads, rows = result.found()
    table = Table(title=title, title_justify="left")
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k else "left")
    for name, *values in rows:
        table.add_row(name, *(f"{value:.4g}" for value in values))
    return table


def _before_and_after(result: Any) -> Any:
    from rich.table import Table

    best, start = result.best.evaluation, result.start_evaluation
    table = Table(title="Before and after, over the ensemble", title_justify="left")
    for name in ("", "first", "tuned"):
        table.add_column(name, justify="right" if name else "left")
    table.add_row("cost", start.told, best.told)
    for key, value in best.terms.items():
        table.add_row(f"  {key}", f"{start.terms[key]:.4f}", f"{value:.4f}")
    table.add_row("largest overshoot", f"{100 * start.overshoot:.1f} %", f"{100 * best.overshoot:.1f} %")
    table.add_row("largest share in saturation", f"{100 * start.saturation:.1f} %", f"{100 * best.saturation:.1f} %")
    unseen = len(result.unseen)
    if unseen:
        from equimus_ctrl.tuning.result import summed

        before, after = (sum(e.stable for e in legs) for legs in (result.start_unseen, result.unseen))
        table.add_row(f"stable on {unseen} unseen robots", str(before), str(after))
        first, tuned = summed(result.start_unseen), summed(result.unseen)
        for key in ("median", "worst"):
            table.add_row(
                f"  {key} cost on these",
                *(f"{own[key]:.4f}" if isfinite(own[key]) else "unstable" for own in (first, tuned)),
            )
    return table


def _margins(result: Any) -> Any:
    from rich.table import Table

    margins = Table(
        title="Margins of the linearised loop: on the model, and the least over all legs", title_justify="left"
    )
    for name in ("loop", "gain", "phase", "delay", "least gain", "least phase", "least delay"):
        margins.add_column(name, justify="left" if name == "loop" else "right")
    for own, least in zip(result.margins, result.least_margins, strict=True):
        row = [own.actuator]
        for m in (own, least):
            row += [f"×{m.gain:.2f}", f"{m.phase * 57.29578:.0f}°", f"{m.delay * 1e3:.0f} ms"]
        margins.add_row(*row)
    return margins
