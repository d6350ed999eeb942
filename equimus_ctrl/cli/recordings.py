"""``equimus-ctrl recordings``: import, check and fetch recordings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import Force, Json, ModelFile, people, print_engine, print_files, print_json
from equimus_ctrl.cli.emulate import HardwareFile
from equimus_ctrl.cli.flags import Command, Group
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equimus_ctrl.diagnosis.display_units import Reading
    from equimus_ctrl.models.model import Model
    from equimus_ctrl.recordings import Limits, Summary
    from equimus_ctrl.report.paged import PagedTable

app = typer.Typer(
    cls=Group, help="Import, check, export and fetch recordings.", no_args_is_help=True, rich_markup_mode="rich"
)

High = Annotated[float | None, typer.Option("--command-high", help="Highest command allowed, in Pa (default: 50000).")]
Low = Annotated[float | None, typer.Option("--command-low", help="Lowest command allowed, in Pa (default: 0).")]
Rotating = Annotated[
    list[str] | None,
    typer.Option("--rotating", metavar="JOINT", help="A joint that turns without end: its angles are not judged."),
]


MapFile = Annotated[
    Path | None,
    typer.Option("--map", metavar="FILE", help="File (TOML) that says what the columns of files of other formats are."),
]


@app.command("import", cls=Command)
@with_options
def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Files or folders: CSV, npz, parquet, MCAP, rosbag2, LeRobot, PACE, BAM, the leg's own."),
    ],
    chosen: ModelChoice,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into, one CSV file a trial.")],
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    mapping: MapFile = None,
    command_low: Low = None,
    command_high: High = None,
    as_json: Json = False,
) -> None:
    """Convert recordings to one CSV file a trial: all of them, or none.

    Columns go by the names of the model's joints and actuators; what a file calls otherwise, or in which unit, sign and
    clock it has it, --map says.

    \b
    [bold]Examples[/bold]
    equimus-ctrl recordings import step_release.csv --output trials
    equimus-ctrl recordings import ../shared/recordings/equimus_leg -o trials --force
    equimus-ctrl recordings import triangle.csv -o trials --json
    equimus-ctrl recordings import my_bag run.mcap --model robot.xml -o trials
    equimus-ctrl recordings import my_dataset --model so101.xml --map degrees.toml -o trials
    """  # noqa: D301 (the backspace keeps the lines of the examples apart)
    from equimus_ctrl import presets, recordings, workflow

    presets.check_folder(output)
    limits = _limits(command_low, command_high)
    if chosen.model is None and mapping is None:
        files = recordings.convert(sources, output, force=force, limits=limits)
    else:
        model = chosen.read()
        _refuse_limits_of_others(model, command_low, command_high)
        trials = workflow.read_recorded(sources, model.robot, mapping, limits)
        files = recordings.write_set(trials, output, force=force)
    people().print(f"{len(files)} trials written to {output}", markup=False, soft_wrap=True)
    if as_json:
        print_json({"files": [str(file) for file in files]})


def _limits(low: float | None, high: float | None, rotating: Sequence[str] = ()) -> Limits:
    """Of pressures, the leg's where none are given."""
    from equimus_ctrl.recordings import LEG, Limits

    return Limits(
        LEG.command_low if low is None else low,
        LEG.command_high if high is None else high,
        rotating=tuple(rotating),
    )


def _refuse_limits_of_others(model: Model, low: float | None, high: float | None) -> None:
    from equimus_ctrl.errors import ConfigError

    if (low is not None or high is not None) and not model.robot.traits.commands_are_pressures:
        raise ConfigError(
            f"--command-low and --command-high bound pressures in Pa, and commands of {model.name} are none; expected "
            "neither of them"
        )


@app.command("import-bag", cls=Command)
def import_bag(
    bags: Annotated[list[Path], typer.Argument(help="rosbag2 bags, SQLite or MCAP.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into, one CSV file a bag.")],
    hardware: HardwareFile = None,
    model: ModelFile = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    as_json: Json = False,
) -> None:
    """Convert rosbag2 bags with the robot's two topics to one CSV file a bag.

    \b
    [bold]Examples[/bold]
    equimus-ctrl recordings import-bag my_bag --output trials
    equimus-ctrl recordings import-bag run_1.mcap run_2.mcap -o trials --hardware my_robot.toml
    """  # noqa: D301
    from equimus_ctrl import presets, workflow

    presets.check_folder(output)
    robot = workflow.load_model(model)
    wired = workflow.load_hardware(hardware, robot, driven=False)
    files = [workflow.import_bag(bag, output, robot, wired, force) for bag in bags]
    people().print(f"{len(files)} trials written to {output}", markup=False, soft_wrap=True)
    if as_json:
        print_json({"files": [str(file) for file in files]})


@app.command(cls=Command)
@with_options
def check(
    paths: Annotated[list[Path], typer.Argument(help="Files or folders to read.")],
    chosen: ModelChoice,
    command_low: Low = None,
    command_high: High = None,
    rotating: Rotating = None,
    mapping: MapFile = None,
    as_json: Json = False,
) -> None:
    """Read recordings and say what they hold; the first thing that is wrong ends it, with exit code 2.

    Those of an MJCF robot need --model: its names are the columns, its commands may be anything.

    \b
    [bold]Examples[/bold]
    equimus-ctrl recordings check trials
    equimus-ctrl recordings check trials/trial_00.csv trials/trial_01.csv
    equimus-ctrl recordings check other_robot --command-high 200000 --rotating wheel
    equimus-ctrl recordings check docs/examples/pendulum --model docs/examples/pendulum.xml
    equimus-ctrl recordings check runs --model robot.xml --rotating wheel
    equimus-ctrl recordings check trials --json
    """  # noqa: D301 (the backspace keeps the lines of the examples apart)
    import warnings

    from equimus_ctrl import recordings, workflow
    from equimus_ctrl.diagnosis.plausibility import other_joints
    from equimus_ctrl.engines.choice import engine_for
    from equimus_ctrl.errors import ConfigError, unknown_name

    known = chosen.read(paths)
    _refuse_limits_of_others(known, command_low, command_high)
    limits = _limits(command_low, command_high, rotating or ())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", recordings.RecordingWarning)
        if known.robot.traits.commands_are_pressures:
            trials = recordings.read_set(paths, limits=limits, mapping=workflow.mapping_of(mapping))
            there = list(dict.fromkeys(joint for trial in trials for joint in trial.joints))
            for joint in rotating or ():
                if joint not in there:
                    raise ConfigError(unknown_name("joint", joint, there, "--rotating"))
        else:
            trials = tuple(workflow.gather(paths, known, mapping, rotating or ()))
    plausibility_warnings = list(dict.fromkeys(str(warning.message) for warning in caught))
    summaries = [recordings.summarise(trial) for trial in trials]
    console = people()
    console.print(_table(summaries, known))
    print_engine(console, engine_for(known, positions=[trial.poses for trial in trials]))
    for text in other_joints(known.robot, trials):
        console.print(text, markup=False, soft_wrap=True)
    for text in plausibility_warnings:
        console.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)
    if as_json:
        print_json({"trials": [summary.as_json() for summary in summaries], "warnings": plausibility_warnings})


def _table(summaries: Sequence[Summary], robot: Model) -> PagedTable:
    """One line a trial, in the units people think in."""
    from equimus_ctrl.diagnosis import display_units
    from equimus_ctrl.report.paged import PagedTable

    commands = {name: display_units.command(robot, name) for name in summaries[0].command_pa}
    joints = {name: display_units.position(robot, name) for name in summaries[0].position_rad}
    named = [f"{name}\n{own.unit}" for columns in (commands, joints) for name, own in columns.items()]

    def reading_text(ends: tuple[float, float], own: Reading) -> str:
        low, high = (own.factor * end for end in ends)
        figures = max(1 - math.floor(math.log10(high - low)), 0) if high > low else 0
        return f"{low:.{figures}f}..{high:.{figures}f}"

    rows = [
        (
            s.name,
            f"{s.duration_s:.1f}",
            f"{s.rate_hz:.1f}",
            f"{s.jitter_s * 1e3:.2f}",
            *(reading_text(ends, commands[name]) for name, ends in s.command_pa.items()),
            *(reading_text(ends, joints[name]) for name, ends in s.position_rad.items()),
        )
        for s in summaries
    ]
    return PagedTable(f"{len(summaries)} trials", ("trial", "time\ns", "rate\nHz", "jitter\nms", *named), rows)


@app.command(cls=Command)
@with_options
def export(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: files or folders, of any format that is read.")],
    chosen: ModelChoice,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="File to write: .mcap, or .rrd for rerun.")
    ],
    diagnosis: Annotated[
        Path | None,
        typer.Option(
            "--diagnosis", metavar="DIR", help="Report of a diagnosis: its refitted and augmented model predict too."
        ),
    ] = None,
    refitted: Annotated[
        Path | None, typer.Option("--refitted", metavar="FILE", help="Model file of the refitted model.")
    ] = None,
    augmented: Annotated[
        Path | None, typer.Option("--augmented", metavar="FILE", help="Model file of the augmented model.")
    ] = None,
    mapping: MapFile = None,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Write a new folder of rosbag2 bags, one a trial, in the place of a file.")
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write recordings, what models predict of them and the residuals, for Foxglove, PlotJuggler or rerun.

    An MCAP file has its schemas in it and needs no ROS; a layout for Foxglove and one for PlotJuggler are written
    beside it. Each trial is predicted from its own measured start.

    \b
    [bold]Examples[/bold]
    equimus-ctrl recordings export trials -o trials.mcap
    equimus-ctrl recordings export trials --model robot.xml --diagnosis report -o trials.mcap
    equimus-ctrl recordings export trials --augmented corrected.toml -o trials.rrd
    equimus-ctrl recordings export trials --ros2 -o bags
    """  # noqa: D301
    from equimus_ctrl import presets, workflow
    from equimus_ctrl.errors import ConfigError

    presets.check_folder(output.parent)
    if diagnosis is not None and (refitted is not None or augmented is not None):
        raise ConfigError("--diagnosis has a refitted and an augmented model; expected it or --refitted, --augmented")
    model = chosen.read(recordings)
    models = {} if diagnosis is None else workflow.recorded_models(diagnosis, model, chosen.model)
    for name, file in (("refitted", refitted), ("augmented", augmented)):
        if file is not None:
            models[name] = workflow.load_model(file, recordings=recordings)
    with people().status("predicting"):
        files = workflow.export_recordings(recordings, output, model, mapping=mapping, ros2=ros2, force=force, **models)
    print_files(people(), files)
    if as_json:
        print_json({"files": [str(file) for file in files]})


@app.command(cls=Command)
def fetch(
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder to store the files in (default: the user's data folder)."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Get the full recordings of the real leg from the public repository fly-pigTH/EquiMus.

    Needs internet. Every file is checked against a known hash; files already there are left as they are.

    \b
    [bold]Examples[/bold]
    equimus-ctrl recordings fetch
    equimus-ctrl recordings fetch --output ~/leg
    """  # noqa: D301 (the backspace keeps the lines of the examples apart)
    from equimus_ctrl import presets, recordings

    if output is not None:
        presets.check_folder(output)
    console = people()
    with console.status("fetching the recordings of the leg"):
        files = recordings.fetch(output)
    for file in files:
        state = "downloaded" if file.downloaded else "already there"
        console.print(f"{file.path} ({state})", markup=False, soft_wrap=True)
    if as_json:
        print_json({"files": [{"path": str(f.path), "downloaded": f.downloaded} for f in files]})
