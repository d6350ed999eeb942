"""``equimus-ctrl emulate``: the simulated leg behind a real robot's topics."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from equimus_ctrl.cli.common import ElasticFile, Json, PluginFiles, people, print_json

HardwareFile = Annotated[
    Path | None,
    typer.Option("--hardware", metavar="FILE", help="How the robot is reached (TOML); hardware/equimus_leg.toml."),
]
Domain = Annotated[int | None, typer.Option(help="DDS domain, ROS_DOMAIN_ID, in place of that of the --hardware file.")]


def emulate(
    model: ElasticFile = None,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="NAME:PLACE:KEY=VALUE", help="Attach an effect to the emulated robot."),
    ] = None,
    hardware: HardwareFile = None,
    domain: Domain = None,
    duration: Annotated[
        float | None, typer.Option(help="End after so long, in s; by default with Ctrl-C or SIGTERM.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Of measurements, in Hz.")] = 120.0,
    noise: Annotated[float, typer.Option(help="White noise on the angles, standard deviation in rad.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Share of messages lost, each way.")] = 0.0,
    latency: Annotated[float, typer.Option(help="Of messages, each way, in s.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="On top of it, standard deviation in s.")] = 0.0,
    watchdog: Annotated[float, typer.Option(help="Without a command for longer it vents by itself, in s.")] = 0.1,
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
    """Play the robot's end of the wire: the MuJoCo leg in real time behind the same topics.

    A watchdog on the device vents it when commands stop. Faults to rehearse: stall, silent, nan, jump, clock, back,
    repeat, reorder, second_publisher, deaf and crash.

    \b
    [bold]Examples[/bold]
    equimus-ctrl emulate
    equimus-ctrl emulate --effect dead_zone:baa:threshold=4000 --noise 0.002
    equimus-ctrl emulate --loss 0.05 --latency 0.01 --jitter 0.002 --seed 1
    equimus-ctrl emulate --fault stall:10:0.2 --duration 20 --json
    """  # noqa: D301
    import signal

    from equimus_ctrl import presets, workflow
    from equimus_ctrl.effects import parse
    from equimus_ctrl.emulation.emulator import Emulated, Emulator, EmulatorSettings
    from equimus_ctrl.emulation.faults import Fault
    from equimus_ctrl.errors import ConfigError
    from equimus_ctrl.models.model import Model

    console = people()
    workflow.load_plugins(plugins or ())
    robot = workflow.load_elastic(model)
    if effect:
        robot = Model(robot.morphology, (*robot.effects, *(parse(text) for text in effect)), robot.phase)
    if duration is not None and not duration > 0:
        raise ConfigError(f"--duration is {duration:g} s, expected more than 0")
    settings = EmulatorSettings(
        rate, noise, loss, latency, jitter, watchdog, seed, tuple(Fault.parse(text) for text in fault or ())
    )
    wired = workflow.load_hardware(hardware, robot, domain)
    if log is not None:
        presets.check_folder(log.parent)

    def notify(seen: Emulated) -> None:
        if log is not None:
            presets.write_text(log, presets.json_text(asdict(seen)))

    emulator = Emulator(robot, wired, settings)
    ended: list[int] = []
    before = {number: signal.signal(number, lambda n, frame: ended.append(n)) for number in (15, 2)}
    wire = wired.wire
    console.print(
        f"{robot.name} on {wire.states}, {rate:g} Hz, domain {wire.domain}; obeys {wire.commands}; Ctrl-C ends it",
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
        f"{seen.time:.1f} s, {seen.commands} commands up to "
        f"{', '.join(f'{value / 1e3:.4g}' for value in seen.highest)} kPa, {seen.measurements} measurements, vented by "
        f"its watchdog {seen.watchdog} times",
        markup=False,
        soft_wrap=True,
    )
    if as_json:
        print_json(asdict(seen))
