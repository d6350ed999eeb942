"""``equimus-ctrl prove``: the diagnosis on simulated robots, blinded, scored against their ground truths."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import Figures, Json, PluginFiles, people, print_engine, print_files, print_json
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import bars, times
from equimus_ctrl.options import ProveOptions

if TYPE_CHECKING:
    from rich.console import Console

    from equimus_ctrl.workflow.proofs import Proof

MOST_ROWS = 60
"""Of a table in a terminal; files have all."""


@with_options
def prove(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(help="With --model: recordings of that robot, whose commands are used.", show_default=False),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="An MJCF robot (.xml, or a model file) in the leg's place."),
    ] = None,
    figures: Figures = True,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="For everything that is made; proof/results/seed_… by default."
        ),
    ] = None,
    *,
    options: ProveOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Blind test of the diagnosis: synthetic robots with missing physics, answers scored against the ground truth.

    Robots are simulated in MuJoCo, with other parameters than the nominal model's and perhaps with physics that it
    lacks; their ground truths are sealed (SHA-256). Then processes that see the recordings alone diagnose them. Last
    the answers are scored against the ground truths. Stopped at any moment, the same command goes on. Exit code 3 says
    that a goal is missed; times are reported, not judged.

    The work is done by processes of this computer, by a Dask cluster (--scheduler), or by jobs of a Slurm cluster
    (--slurm), with the same answers. With --shard it is shared out by hand: parts in one folder need no more than the
    same command without it once all are done, parts in folders of their own --merge. A part is not judged.

    With --model the robots are like yours, driven by the commands of your recordings: the score says what a
    diagnosis of such an experiment can find. Recorded torques are mostly a controller's: --track gives each robot one.

    With --experiments trials are designed for each robot from what its diagnosis leaves, made with it, and all are
    diagnosed again: how often that resolves what recordings did not, and whether predictions come true. The first
    recordings are two small chirps of 6 s then; with --model your recordings, or such chirps where you give none.

    \b
    [bold]Examples[/bold]
    equimus-ctrl prove --cases 8
    equimus-ctrl prove --cases 40 --kind none --no-baselines
    equimus-ctrl prove --cases 1000 --seed 7 --output proof_7 --json
    equimus-ctrl prove docs/examples/pendulum --model docs/examples/pendulum.xml --cases 20
    equimus-ctrl prove arm_runs --model arm.xml --track 2
    equimus-ctrl prove --cases 60 --experiments 2
    equimus-ctrl prove --model docs/examples/pendulum.xml --experiments 2 --limit motor.low=-2 --limit motor.high=2
    equimus-ctrl prove --cases 10000 --scheduler tcp://head:8786
    equimus-ctrl prove --cases 10000 --slurm jobs.toml
    equimus-ctrl prove --cases 1000 --shard 2/5 --output shard_2
    equimus-ctrl prove --cases 1000 --merge shard_1 --merge shard_2 --merge shard_3 --merge shard_4 --merge shard_5
    """  # noqa: D301
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    from equimus_ctrl import presets
    from equimus_ctrl.workflow.models import load_model
    from equimus_ctrl.workflow.proofs import experiment_of

    experiment = experiment_of(recordings or (), None if model is None else load_model(model), options)
    kind = f"_{options.kind}" if options.kind else ""
    kind += f"_{options.excites}" if options.excites != "rich" else ""
    name = f"seed_{options.seed}{kind}" + (f"_{experiment.model.name}" if experiment else "")
    folder = output or presets.workspace() / "proof" / "results" / name
    presets.check_folder(folder)
    console = people()
    if experiment is not None:
        from equimus_ctrl.engines.choice import engine_for

        print_engine(console, engine_for(experiment.model, positions=[r.position for r in experiment.recordings]))
    columns = (TextColumn("{task.description:<17}"), BarColumn(bar_width=24), MofNCompleteColumn(), *times())
    try:
        with bars(console, *columns) as progress:
            from equimus_ctrl.workflow.proof_shards import shard_name
            from equimus_ctrl.workflow.proofs import STAGES, prove

            tasks = {stage: progress.add_task(stage, total=options.cases, start=False) for stage in STAGES[:-1]}

            def notify(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = progress.add_task(stage, total=total, start=False)
                if not progress.tasks[tasks[stage]].started:
                    progress.start_task(tasks[stage])
                progress.update(tasks[stage], completed=done, total=total)
                if not console.is_terminal:
                    console.print(f"{stage}: {done} of {total}")

            found = prove(
                folder,
                options,
                experiment=experiment,
                plugins=plugins or (),
                progress=notify,
                say=lambda sentence: console.print(sentence, markup=False, soft_wrap=True),
            )
    except KeyboardInterrupt:
        console.print("stopped: the same command goes on from here", markup=False)
        raise typer.Exit(130) from None
    name = shard_name("score", options.shard)
    record, files = found.to_dict(), [folder / f"{name}.json", folder / f"{name}.md"]
    presets.write_text(files[0], presets.json_text(record))
    from equimus_ctrl.report.proof_experiments import experiment_sheets
    from equimus_ctrl.report.proof_tables import markdown

    first = experiment_sheets(found.experiments) if found.experiments else ()
    presets.write_text(files[1], markdown(_head(found), found.score, first))
    if figures and options.shard is None:
        from equimus_ctrl.report import style
        from equimus_ctrl.workflow.figures import drawings

        files += style.save_all(drawings(found), folder)
    _print(console, found)
    print_files(console, files)
    if as_json:
        print_json({**record, "files": [str(file) for file in files]})
    if not found.accurate and options.shard is None:
        raise typer.Exit(3)


def _head(found: Proof) -> dict[str, str]:
    r = found.request
    return {
        **({"robot": r.model.name} if r.experiment else {}),
        "seed": str(r.seed),
        **({"shard": str(found.shard)} if found.shard else {}),
        "cases": f"{len(found.score.cases)}, {'drawn from all kinds' if r.kind is None else f'all of kind {r.kind}'}",
        "recordings": f"{r.trials} trials of {'up to ' if r.experiment else ''}{r.duration:g} s each",
        "SHA-256 of all seals": f"`{found.seal}`",
        **({"SHA-256 of all answers": f"`{found.experiments.answers}`"} if found.experiments else {}),
        **({"note": "; ".join(found.notes)} if found.notes else {}),
    }


def _print(console: Console, found: Proof) -> None:
    from equimus_ctrl.report.proof_experiments import experiment_sheets
    from equimus_ctrl.report.proof_tables import goals_sheet, strength_sheet, wrong_sheet

    own = (goals_sheet(found.score), strength_sheet(found.score), wrong_sheet(found.score))
    for sheet in experiment_sheets(found.experiments) if found.experiments else own:
        if sheet.rows or sheet.note:
            console.print(sheet.rich(MOST_ROWS))
    for note in found.notes:
        console.print(note, style="yellow", markup=False)
    goals = found.goals
    missed = [g for g in goals if g.state == "missed"]
    for goal in missed:
        judged = "" if goal.judged else " (not judged: it depends on the computer)"
        console.print(f"missed: {goal.title}{judged}", style="yellow", markup=False)
    few, undecided = (sum(g.state == state for g in goals) for state in ("too few", "open"))
    if not missed:
        told = [f"{few} have too few cases to be judged"] if few else []
        told += [f"{undecided} are undecided"] if undecided else []
        console.print("; ".join(["no goal is missed", *told]))
