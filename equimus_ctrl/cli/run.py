"""``equimus-ctrl run``: a scenario, driven, scored and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equimus_ctrl.cli.common import (
    Figures,
    Force,
    Json,
    PluginFiles,
    Recordings,
    key_values,
    people,
    print_files,
    print_json,
)
from equimus_ctrl.cli.emulate import Domain, HardwareFile
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import share_bar, stage_bar

if TYPE_CHECKING:
    from rich.console import Console

    from equimus_ctrl.errors import SimulationDiverged
    from equimus_ctrl.outputs import Results


@with_options
def run(
    scenario: Annotated[str, typer.Argument(help="Scenario by name (see: list scenarios) or path to a script.")],
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            "-c",
            help="Controller by name, path/to/file.py:Name or policy.zip, .onnx; the scenario's by default.",
        ),
    ] = None,
    plant: Annotated[str, typer.Option(help="Plant by name (see: list plants).")] = "mujoco",
    *,
    chosen: ModelChoice,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="NAME:PLACE:KEY=VALUE", help="Attach an effect to the simulated robot."),
    ] = None,
    nominal: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Model file that the controller computes with; by default the model's."),
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the scenario.")
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="The controller's settings file (TOML).")] = None,
    noise: Annotated[float, typer.Option(help="White noise on the measured angles, standard deviation in rad.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    plugins: PluginFiles = None,
    recordings: Recordings = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for figures and table; results/run/… by default.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="DIR", help="Also write the run as a recording into this folder.")
    ] = None,
    hardware: HardwareFile = None,
    domain: Domain = None,
    arm: Annotated[
        bool, typer.Option("--arm", help="Send commands to the real robot; without, only what would be sent is shown.")
    ] = False,
    video: Annotated[Path | None, typer.Option(help="Also write a video (.mp4 or .gif).")] = None,
    view: Annotated[
        bool,
        typer.Option(
            "--view",
            help="Then play the run in MuJoCo's viewer beside a ghost: the recording, else the reference.",
        ),
    ] = False,
    view_web: Annotated[
        bool,
        typer.Option(
            "--view-web", help="The same in a browser. Who is on this computer reaches the page, without a password."
        ),
    ] = False,
    view_web_host: Annotated[
        str | None,
        typer.Option(
            "--view-web-host",
            metavar="ADDRESS",
            help="Interface that serves the page; 0.0.0.0 for all: then it is open to the network, without a password.",
        ),
    ] = None,
    force: Force = False,
    figures: Figures = True,
    as_json: Json = False,
) -> None:
    """Run a scenario and score it.

    \b
    [bold]Examples[/bold]
    equimus-ctrl run triangle
    equimus-ctrl run triangle --controller pid --json
    equimus-ctrl run hold --set hip=80 --set knee=20 --controller pid --noise 0.001
    equimus-ctrl run hold --controller controllers/example_custom.py:Spring
    equimus-ctrl run step --model robot.xml --set joint=elbow --set size=20
    equimus-ctrl run chirp --effect transport_delay:baa:delay=0.1 --record my_recordings
    equimus-ctrl run chirp --plant hardware --arm --record my_recordings
    equimus-ctrl run triangle --controller pid --view
    equimus-ctrl run chirp --plugin docs/examples/drag.py --effect quadratic_drag:knee:coefficient=0.02
    """  # noqa: D301
    from equimus_ctrl import outputs, presets, workflow
    from equimus_ctrl.effects import parse
    from equimus_ctrl.errors import ConfigError, EquimusError, SimulationDiverged
    from equimus_ctrl.plants.registry import PLANTS
    from equimus_ctrl.report.tables import run_table

    console = people()
    workflow.load_plugins(plugins or ())
    if video is not None:
        from equimus_ctrl.report.video import check_video

        if said := check_video(video, force):
            console.print(said, markup=False, soft_wrap=True)
    how, host = None, ""
    if view or view_web:
        from equimus_ctrl.report.viewing import HOST, check_host, check_viewer

        how, host = check_viewer(view_web), check_host(view_web_host or HOST)
    elif view_web_host is not None:
        raise ConfigError("--view-web-host is for --view-web alone, or --view where there is no screen")
    results = outputs.Results(output, force, presets.workspace() / "results" / "run")
    if record is not None:
        presets.check_folder(record)
    robot = chosen.read()
    if given := robot.robot.prescribed_names:
        raise ConfigError(
            f"{robot.name}: the motion of {', '.join(given)} is an input from recordings, which a run does not have; "
            "expected a base that is fixed"
        )
    real = PLANTS.entry(plant).real
    if not real and (arm or hardware is not None or domain is not None):
        known = " or ".join(name for name, entry in PLANTS.items() if entry.real)
        raise ConfigError(f"--arm, --hardware and --domain are for --plant {known} alone")
    if record is None and real and arm:
        record = presets.workspace() / "results" / "hardware"
    trial = new_file(record, scenario) if record is not None and (arm or not real) else None
    try:
        with share_bar(console, scenario) as show:
            done = workflow.run_scenario(
                scenario,
                controller,
                model=robot,
                effects=[parse(text) for text in effect or []],
                plant=plant,
                options=key_values(option, "--set"),
                recordings=recordings,
                settings=settings,
                noise=noise,
                seed=seed,
                nominal=workflow.load_model(nominal) if nominal is not None else None,
                progress=show,
                hardware=workflow.load_hardware(hardware, robot, domain) if real else None,
                armed=arm,
                record=trial,
            )
    except SimulationDiverged as stop:
        if stop.run is not None:
            kept = {"plant": plant, "model": robot.name, "seed": seed}
            result, files = keep_diverged(stop, results, figures, kept)
            print_files(console, files)
            if as_json:
                print_json(result)
        raise
    except (EquimusError, KeyboardInterrupt) as stop:
        if real and trial is not None:
            from equimus_ctrl.plants.hardware.interface import stopped_word

            print_stopped(console, stop, trial, stopped_word(robot.robot.command_units))
        raise
    label = f"{done.scenario.name}, {done.controller}"
    folder = results.opened(own_folder(done.scenario.name, done.controller))
    files = []
    if figures:
        from equimus_ctrl.report.run_figures import save_run_figures
        from equimus_ctrl.report.series import save_series

        files += save_run_figures(done.run, done.scenario, done.score, done.kinematics, folder, label)
        files.append(save_series(done.run, folder / "series.csv"))
    ours = list(files)  # of this folder; recordings are not, wherever they are
    if done.recording is not None:
        files.append(done.recording)
    result = done.to_dict()
    note = None
    if video is not None:
        from equimus_ctrl.report.video import save_video

        with stage_bar(console, "video", stopped="stopped: no video was written") as show_stage:
            shown = save_video(done.run, done.model, video, progress=lambda share: show_stage(share=share))
        files.append(shown.path)
        note = shown.note
    result |= {"seed": seed, "failure": None, "files": [str(f) for f in files]}
    outputs.write_record(folder, "score.json", result, ours)
    console.print(run_table(done.score, done.run, done.scenario, done.controller))
    if done.loop is not None:
        result["loop"] = done.loop.to_dict()
        console.print(_loop_sentence(result["loop"], arm), markup=False, soft_wrap=True)
    if done.run.note:
        console.print(done.run.note, markup=False, soft_wrap=True)
    if note:
        console.print(note, markup=False, soft_wrap=True)
    print_files(console, files)
    if as_json:
        print_json(result)
    if how is not None:
        from equimus_ctrl.report.viewing import shown_of
        from equimus_ctrl.report.viewing import view as look

        shown_run = shown_of(done.run, done.model, done.scenario.recorded)
        console.print(f"the viewer shows this run; the ghost is {shown_run.ghost}", markup=False, soft_wrap=True)
        look(shown_run, how, host)


def own_folder(scenario: str, controller: str) -> Path:
    """Where results of a run go by default, before it is numbered."""
    from equimus_ctrl import presets

    return presets.workspace() / "results" / "run" / f"{_file_name(scenario)}-{_file_name(controller)}"


def keep_diverged(
    stop: SimulationDiverged, results: Results, figures: bool, names: dict[str, Any]
) -> tuple[dict[str, Any], list[Path]]:
    """Write what a run came to until its simulation diverged, with the reason: the JSON, and the files.

    Args:
        stop: what has the run.
        results: folder for it.
        figures: whether a table over time was asked for, beside which figures stand.
        names: what else stands in the JSON.
    """
    from equimus_ctrl import outputs
    from equimus_ctrl.report.series import save_series

    folder, files = results.opened(own_folder(stop.scenario, stop.controller)), []
    if figures:
        files.append(save_series(stop.run, folder / "series.csv"))
    ours = list(files)
    if stop.recording is not None:
        files.append(stop.recording)
    result = {
        "scenario": stop.scenario,
        "controller": stop.controller,
        "note": stop.run.note,
        **names,
        "failure": str(stop),
        "ended_s": float(stop.run.time[-1]),
        "files": [str(file) for file in files],
    }
    outputs.write_record(folder, "score.json", result, ours)
    return result, files


def new_file(folder: Path, scenario: str) -> Path:
    """A name that no recording in the folder has: the scenario's, or that with the next free number."""
    from equimus_ctrl import outputs

    return outputs.free_name(folder / f"{_file_name(Path(scenario).stem)}.csv")


def print_stopped(console: Console, stop: BaseException, streamed: Path, word: str) -> None:
    """What people have to know of a robot that was driven until something stopped it: vented, or stopped."""
    if isinstance(stop, KeyboardInterrupt):
        console.print(f"stopped by Ctrl-C; the robot is {word}", markup=False)
    if streamed.exists():
        print_files(console, [streamed])


def _loop_sentence(loop: dict[str, Any], armed: bool) -> str:
    text = (
        f"{loop['instants']} control instants, {loop['deadlines_missed']} deadlines missed, {loop['samples']} "
        f"measurements, {loop['samples_ignored']} of them ignored; from a measurement to its command "
        f"{1e3 * loop['latency_p50_s']:.2f} ms (99 %: {1e3 * loop['latency_p99_s']:.2f} ms)"
    )
    return text if armed else text + "; a dry run: nothing was sent, --arm sends it"


def _file_name(controller: str) -> str:
    return "".join(ch if ch.isalnum() or ch in "-_" else "_" for ch in controller.rpartition(":")[2] or controller)
