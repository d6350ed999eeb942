"""``equimus-ctrl train``: a policy by reinforcement learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import Figures, Json, PluginFiles, people, print_files, print_json
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import best_so_far, stage_bar
from equimus_ctrl.options import TrainOptions

if TYPE_CHECKING:
    from rich.console import Console

    from equimus_ctrl.models.model import Model
    from equimus_ctrl.workflow.training import Trained


@with_options
def train(
    task: Annotated[str, typer.Argument(help="kick, or a scenario by name: its reference is followed.")],
    chosen: ModelChoice,
    *,
    options: TrainOptions,
    plugins: PluginFiles = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="For policy and figures; results/train/… by default."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Begin anew; else it goes on where it was stopped.")] = False,
    export: Annotated[
        bool, typer.Option("--export", help="Also write policy.onnx, for other programs; a controller as well.")
    ] = False,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Train a policy on a simulated robot, or on many that differ.

    The best policy is a controller: --controller policy.zip of run and compare. Ctrl-C keeps it, and the same command
    goes on; with more --steps too. Needs the extra rl: pip install 'equimus-ctrl\\[rl]'.

    \b
    [bold]Examples[/bold]
    equimus-ctrl train kick --control 60 --budget 600
    equimus-ctrl train kick --randomise 20 --seed 3 --output results/kick
    equimus-ctrl train kick --randomise diagnosis --diagnosis report
    equimus-ctrl train hold --set hip=80 --set knee=20 --algorithm sac --export
    """  # noqa: D301
    from equimus_ctrl import presets, workflow

    console = people()
    if export:
        workflow.check_onnx()
    workflow.load_plugins(plugins or ())
    model = chosen.read()
    name = f"{task}-{presets.plain_name(model.name)}-{options.algorithm}-{options.seed}"
    folder = output or presets.workspace() / "results" / "train" / name
    with stage_bar(console, "getting ready", stopped="stopped: the same command goes on from its last round") as show:
        with best_so_far(console) as stopped:
            found = workflow.train(folder, task, model, options, force=force, progress=show, stopped=stopped)
        files = [*found.files, *([workflow.write_onnx(found)] if export else ())]
        if figures:
            show("figures")
            files += _drawn(found, task, model, options)
    record = workflow.write_training(found, files)
    _print(console, found)
    print_files(console, [*files, record])
    if as_json:
        print_json({**found.to_dict(), "files": [str(file) for file in [*files, record]]})


def _drawn(found: Trained, task: str, model: Model, options: TrainOptions) -> list[Path]:
    """The learning curve, and a film of the best of what unseen robots do."""
    from equimus_ctrl import workflow
    from equimus_ctrl.report import style
    from equimus_ctrl.report.training_figures import training_figure
    from equimus_ctrl.report.video import save_frames

    files = [style.save(training_figure(found.curve, task), found.folder / "curve.png")]
    frames, fps = workflow.film_of_training(found, model, options)
    return [*files, save_frames(frames, found.folder / f"{task}.mp4", fps).path]


def _print(console: Console, found: Trained) -> None:
    best = found.best
    why = {"steps": "all steps are done", "budget": "the time is over", "stopped": "it was stopped"}[found.reason]
    success = "" if best["success"] is None else f", success on {100 * best['success']:.0f} %"
    more = "".join(
        f", {label} {best[key]:.3g} {unit}"
        for key, label, unit in (("ball_speed", "ball", "m/s"), ("miss_angle", "off by", "°"))
        if key in best
    )
    console.print(
        f"Best after {best['steps']:,} of {found.curve[-1]['steps']:,} steps: mean return {best['return']:.4g} on "
        f"unseen robots, {best['least']:.4g} on the worst{success}{more}; {why}.",
        markup=False,
        soft_wrap=True,
    )
