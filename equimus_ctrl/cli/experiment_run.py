"""``equimus-ctrl experiment run``: experiments in a loop, designed, made and diagnosed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import Figures, Json, PluginFiles, people, print_files, print_json
from equimus_ctrl.cli.emulate import Domain, HardwareFile
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import stage_bar
from equimus_ctrl.options import RunExperimentsOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from equimus_ctrl.cli.progress import ShowStage
    from equimus_ctrl.workflow.experiment_steps import ExperimentRun


@with_options
def run(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(help="Trials from before: files, or folders of them; none by default.", show_default=False),
    ] = None,
    plant: Annotated[str, typer.Option(help="Plant by name (see: list plants).")] = "mujoco",
    *,
    chosen: ModelChoice,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            metavar="NAME:PLACE:KEY=VALUE",
            help="Attach an effect to the simulated robot; designs and diagnoses do not know of it.",
        ),
    ] = None,
    options: RunExperimentsOptions,
    noise: Annotated[
        float, typer.Option(help="White noise on positions of a simulation, standard deviation in rad or m.")
    ] = 1e-3,
    plugins: PluginFiles = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="For everything that is made; results/experiments/… by default."
        ),
    ] = None,
    hardware: HardwareFile = None,
    domain: Domain = None,
    arm: Annotated[bool, typer.Option("--arm", help="Send commands to the real robot.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Of a simulation: known conditions are set without asking.")
    ] = False,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Make experiments until one explanation is left, nothing more can be distinguished, or enough were made.

    All trials so far are diagnosed; what that leaves decides which trial is made next, within the limits; and again.
    Without recordings the first trial moves everything. What a trial needs that you have to set, such as a payload, is
    asked for before it. Stopped at any moment, the same command goes on; with more --trials too.

    \b
    [bold]Examples[/bold]
    equimus-ctrl experiment run --effect coulomb_friction:knee:friction=0.05 --output friction
    equimus-ctrl experiment run recordings --can payload:foot=0.2 --yes
    equimus-ctrl experiment run recordings --plant hardware --arm --limits limits.toml
    equimus-ctrl experiment run arm_runs --model arm.xml --trials 2 --duration 4 --json
    """  # noqa: D301
    from equimus_ctrl import presets, workflow
    from equimus_ctrl.effects import parse
    from equimus_ctrl.errors import ConfigError
    from equimus_ctrl.plants.registry import PLANTS

    console = people()
    workflow.load_plugins(plugins or ())
    robot = chosen.read(recordings or ())
    real = PLANTS.entry(plant).real
    if not real and (arm or hardware is not None or domain is not None):
        known = " or ".join(name for name, entry in PLANTS.items() if entry.real)
        raise ConfigError(f"--arm, --hardware and --domain are for --plant {known} alone")
    if real and yes:
        raise ConfigError("--yes is for simulations: only you know what was set on a real robot")
    folder = output or presets.workspace() / "results" / "experiments" / f"{presets.plain_name(robot.name)}-{plant}"
    stopped = "stopped: the same command goes on from here"
    with stage_bar(console, "getting ready", width=34, bar_width=24, stopped=stopped) as show:
        found = workflow.run_experiments(
            folder,
            recordings or (),
            robot,
            options,
            plant=plant,
            effects=[parse(text) for text in effect or []],
            noise=0.0 if real else noise,
            hardware=workflow.load_hardware(hardware, robot, domain) if real else None,
            armed=arm,
            source=chosen.model,
            ask=_asking(console, show) if sys.stdin is not None and sys.stdin.isatty() and not yes else None,
            progress=show,
            say=lambda sentence: console.print(sentence, markup=False, soft_wrap=True),
        )
    files = list(found.files)
    if figures:
        files += _drawn(found)
    console.print(f"{found.said[0].upper()}{found.said[1:]}.", markup=False, soft_wrap=True)
    print_files(console, files)
    if as_json:
        print_json({**found.to_dict(), "files": [str(file) for file in files]})


def _asking(console: Console, show: ShowStage) -> Callable[[str], None]:
    """Ask somebody at the terminal to set something, the bar being away meanwhile."""
    from equimus_ctrl.errors import ConfigError

    def ask(said: str) -> None:
        with show.paused():
            console.print(said, markup=False, soft_wrap=True)
            done = typer.confirm("Is that so?", default=False, err=True)
        if not done:
            raise ConfigError(f"{said}; it is not so, and the same command goes on once it is")

    return ask


def _drawn(found: ExperimentRun) -> list[Path]:
    """Figures in the folder of the experiments."""
    from equimus_ctrl.experiments.power import margin
    from equimus_ctrl.report import style
    from equimus_ctrl.report.experiment_run_figures import belief_figure, trials_figure

    names = ["before" if own.plan is None else own.plan.trial for own in found.steps]
    margins = [margin(own.rivals) for own in found.steps]
    belief = belief_figure(found.steps, names, margins, found.model.name)
    files = [style.save(belief, found.folder / "belief.png")]
    if found.trials:
        commands = trials_figure(found.model.robot, found.trials, found.model.name)
        files.append(style.save(commands, found.folder / "trials.png"))
    return files
