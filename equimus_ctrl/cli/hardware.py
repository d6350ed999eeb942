"""``equimus-ctrl hardware``: is the robot there, and what is its delay?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from equimus_ctrl.cli.common import Force, Json, check_model_file, key_values, people, print_files, print_json
from equimus_ctrl.cli.emulate import Domain, HardwareFile
from equimus_ctrl.cli.flags import Command, Group
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options

app = typer.Typer(
    cls=Group, help="Check a real robot, and measure its delay.", no_args_is_help=True, rich_markup_mode="rich"
)
Arm = Annotated[bool, typer.Option("--arm", help="Command the robot.")]


@app.command(cls=Command)
@with_options
def check(
    chosen: ModelChoice,
    *,
    hardware: HardwareFile = None,
    domain: Domain = None,
    arm: Arm = False,
    seconds: Annotated[float, typer.Option(help="How long to listen, in s.")] = 3.0,
    share: Annotated[
        float, typer.Option(help="Of the range of each actuator in turn that it is commanded, in %; goals move less.")
    ] = 10.0,
    pressure: Annotated[
        float | None, typer.Option(help="In its place for each actuator in turn, in kPa, of robots driven by it.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Are both topics alive, at which rates and delays, and with --arm: do joints react to a little of each command?

    Exit code 3 says that something is not as it must be, and the sentences say what.

    \b
    [bold]Examples[/bold]
    equimus-ctrl hardware check
    equimus-ctrl hardware check --arm --pressure 4
    equimus-ctrl hardware check --hardware my_robot.toml --json
    equimus-ctrl hardware check --model robot.xml --arm --share 5
    """  # noqa: D301
    from equimus_ctrl import workflow
    from equimus_ctrl.cli.progress import stage_bar
    from equimus_ctrl.plants.hardware.interface import interface_of, stopped_word

    console = people()
    robot = chosen.read()
    wired = workflow.load_hardware(hardware, robot, domain)
    wire, word = interface_of(wired, robot.robot).wire, stopped_word(robot.robot.command_units)
    given = f"a robot that was commanded is {word}" if arm else "the robot was only listened to"
    with stage_bar(console, "check", width=36, bar_width=24, stopped=f"stopped by Ctrl-C; {given}") as show:
        found = workflow.check_hardware(
            robot,
            wired,
            armed=arm,
            seconds=seconds,
            share=share / 100,
            pressure=None if pressure is None else 1e3 * pressure,
            notify=lambda what, share: show(what, share),
        )
    for line in _lines(found, wire.states, wire.commands):
        console.print(line, markup=False, soft_wrap=True)
    if as_json:
        print_json(found)
    if found["problems"]:
        raise typer.Exit(3)


def _lines(found: dict[str, Any], states: str, commands: str) -> list[str]:
    lines = [
        f"{states}: {', '.join(found['joints'])} at {found['rate_hz']:.1f} Hz, intervals even to "
        f"{1e3 * found['interval_jitter_s']:.2g} ms, longest gap {1e3 * found['longest_gap_s']:.3g} ms",
        f"  later than the quickest: {1e3 * found['lateness_p50_s']:.2g} ms (99 %: "
        f"{1e3 * found['lateness_p99_s']:.2g} ms); {found['twice_or_out_of_order']} came twice or out of order",
        f"{commands}: {found['listeners']} listening",
    ]
    for name, moved in found.get("reactions", {}).items():
        by, still = (moved[f"{what}_{moved['unit']}"] for what in ("moved", "still"))
        lines.append(f"{name}: {moved['asked']} moved {moved['joint']} by {by:.4f} {moved['unit']}, noise {still:.4f}")
    return lines + [f"problem: {text}" for text in found["problems"]]


@app.command(cls=Command)
@with_options
def delay(
    chosen: ModelChoice,
    *,
    hardware: HardwareFile = None,
    domain: Domain = None,
    arm: Arm = False,
    option: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the scenario chirp.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="DIR", help="Folder for the recording; results/hardware.")
    ] = None,
    write_model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Model file to write, for --nominal: with delays and lags.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Sweep the commands, and fit each actuator's dead time and lag from end to end.

    Controllers predict over it where they are given the model that is written: run … --nominal FILE.

    \b
    [bold]Examples[/bold]
    equimus-ctrl hardware delay --arm --write-model known.toml
    equimus-ctrl hardware delay --arm --set duration=30 --record trials --json
    """  # noqa: D301
    from equimus_ctrl import presets, workflow
    from equimus_ctrl.cli.progress import share_bar
    from equimus_ctrl.cli.run import new_file, print_stopped
    from equimus_ctrl.errors import ConfigError, EquimusError
    from equimus_ctrl.plants.hardware.interface import stopped_word
    from equimus_ctrl.workflow.mjcf import read_trials

    console = people()
    if not arm:
        raise ConfigError("a delay can only be measured on a robot that is commanded; give --arm")
    check_model_file(write_model, force)
    folder = record or presets.workspace() / "results" / "hardware"
    presets.check_folder(folder)
    robot = chosen.read()
    wired = workflow.load_hardware(hardware, robot, domain)
    path = new_file(folder, "delay")
    try:
        with share_bar(console, "sweep") as show:
            workflow.run_scenario(
                "chirp", "open_loop", model=robot, plant="hardware", options=key_values(option, "--set"),
                hardware=wired, armed=True, record=path, progress=show,
            )  # fmt: skip
    except (EquimusError, KeyboardInterrupt) as stop:
        print_stopped(console, stop, path, stopped_word(robot.robot.command_units))
        raise
    found = workflow.measure_delay(read_trials([path], robot.robot), robot)
    table: dict[str, Any] = {}
    values = dict(zip(found.fit.parameters.names, found.fit.theta.tolist(), strict=True))
    widths = dict(zip(found.fit.parameters.names, found.fit.uncertainty.half_width.tolist(), strict=True))
    for name in robot.robot.actuator_names:
        own = {}
        for key, label in (("transport_delay.delay", "delay_s"), ("first_order_lag.time_constant", "lag_s")):
            own[label] = {"value": values[f"{name}.{key}"], "half_width": widths[f"{name}.{key}"]}
        table[name] = own
        console.print(
            f"{name}: {1e3 * own['delay_s']['value']:.1f} ± {1e3 * own['delay_s']['half_width']:.1f} ms dead time, lag "
            f"{1e3 * own['lag_s']['value']:.1f} ± {1e3 * own['lag_s']['half_width']:.1f} ms",
            markup=False,
            soft_wrap=True,
        )
    files = [path]
    if write_model is not None:
        files += workflow.save_model(write_model, found.fit.model, chosen.model)
    print_files(console, files)
    if as_json:
        print_json({"actuators": table, "files": [str(file) for file in files]})
