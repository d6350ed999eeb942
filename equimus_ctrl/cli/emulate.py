"""``equimus-ctrl emulate``: a simulated robot behind a real one's topics."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import Json, PluginFiles, people, print_json
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options

HardwareFile = Annotated[
    Path | None,
    typer.Option(
        "--hardware",
        metavar="FILE",
        help="How the robot is reached (TOML); hardware/<robot>.toml or hardware/equimus_leg.toml where that suits it.",
    ),
]
Domain = Annotated[int | None, typer.Option(help="DDS domain, ROS_DOMAIN_ID, in place of that of the --hardware file.")]


@with_options
def emulate(
    chosen: ModelChoice,
    *,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="NAME:PLACE:KEY=VALUE", help="Attach an effect to the emulated robot."),
    ] = None,
    hardware: HardwareFile = None,
    domain: Domain = None,
    duration: Annotated[
        float | None, typer.Option(help="End after so long, in s; by default with Ctrl-C or SIGTERM.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Of measurements, in Hz; about 120 by default, as its physics steps have it.")
    ] = None,
    noise: Annotated[float, typer.Option(help="White noise on the positions, standard deviation in rad or m.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Share of messages lost, each way.")] = 0.0,
    latency: Annotated[float, typer.Option(help="Of messages, each way, in s.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="On top of it, standard deviation in s.")] = 0.0,
    watchdog: Annotated[float, typer.Option(help="Without a command for longer it stops by itself, in s.")] = 0.1,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="KIND:TIME[:DURATION]", help="Something that goes wrong; repeatable."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of noise, losses and jitter.")] = 0,
    plugins: PluginFiles = None,
    log: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Rewrite this JSON file every second with what was received.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Play the robot's end of the wire: a robot in MuJoCo, in real time, behind the topics of a real one.

    A watchdog on the device stops it when commands end: pressures and forces are 0, servos stay. Faults to rehearse:
    stall, silent, nan, jump, clock, back, repeat, reorder, second_publisher, deaf and crash.

    \b
    [bold]Examples[/bold]
    equimus-ctrl emulate
    equimus-ctrl emulate --effect dead_zone:baa:threshold=4000 --noise 0.002
    equimus-ctrl emulate --loss 0.05 --latency 0.01 --jitter 0.002 --seed 1
    equimus-ctrl emulate --fault stall:10:0.2 --duration 20 --json
    equimus-ctrl emulate --model robot.xml --hardware my_robot.toml
    """  # noqa: D301
    import signal

    from equimus_ctrl import presets, workflow
    from equimus_ctrl.effects import parse
    from equimus_ctrl.emulation.emulator import Emulated, Emulator, EmulatorSettings
    from equimus_ctrl.emulation.faults import Fault
    from equimus_ctrl.errors import ConfigError
    from equimus_ctrl.models.model import Model
    from equimus_ctrl.robots.reading import shown

    console = people()
    workflow.load_plugins(plugins or ())
    robot = chosen.read()
    if effect:
        robot = Model(robot.robot, (*robot.effects, *(parse(text) for text in effect)), robot.phase)
    if duration is not None and not duration > 0:
        raise ConfigError(f"--duration is {duration:g} s, expected more than 0")
    settings = EmulatorSettings(
        rate, noise, loss, latency, jitter, watchdog, seed, tuple(Fault.parse(text) for text in fault or ())
    )
    wired = workflow.load_hardware(hardware, robot, domain, driven=False)
    if log is not None:
        presets.check_place(log)

    def notify(seen: Emulated) -> None:
        if log is not None:
            presets.write_text(log, presets.json_text(asdict(seen)))

    emulator = Emulator(robot, wired, settings)
    ended: list[int] = []
    before = {number: signal.signal(number, lambda n, frame: ended.append(n)) for number in (15, 2)}
    wire = emulator.interface.wire
    console.print(
        f"{robot.name} on {wire.states}, {emulator.rate:g} Hz, domain {wire.domain}; obeys {wire.commands}; "
        "Ctrl-C ends it",
        markup=False,
        soft_wrap=True,
    )
    try:
        seen = emulator.run(duration if duration is not None else float("inf"), notify, lambda: bool(ended))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    notify(seen)
    console.print(
        f"{seen.time:.1f} s, {seen.commands} commands up to {shown(seen.highest, robot.robot.command_units)}, "
        f"{seen.measurements} measurements, {emulator.interface.stopped} by its watchdog {seen.watchdog} times",
        markup=False,
        soft_wrap=True,
    )
    if as_json:
        print_json(asdict(seen))
