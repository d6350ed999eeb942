"""Real robots and their emulator by file and name."""

from __future__ import annotations

import math
import os
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.errors import ConfigError, NotAvailable, RecordingError
from equimus_ctrl.identification.results import Identified
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.guard import Measurements
from equimus_ctrl.plants.hardware.interface import interface_of, settings_for
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.hardware.transport import Sample, Transport
from equimus_ctrl.plants.hardware.transports import transport_entry
from equimus_ctrl.plants.mujoco_plant import rates_of
from equimus_ctrl.recordings import write
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow.identifications import identify_recordings

DEFAULT = "equimus_leg.toml"
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
REACTION = 1.0
"""How long an actuator is commanded at most, and how long it rests before [s]."""
SHARE = 0.1
"""Of what it can be commanded beside what stops it."""
MOST_ASKED = {"rad": 0.1, "m": 0.02}
"""SI unit of a goal → by how much it is moved at most."""
LEAST_MOVED = {"rad": 2e-3, "m": 1e-3}
"""SI unit of a joint → what moves by less does not react."""
SIGMAS = 5.0
"""Of its noise what moves by less does not either."""
FIRST_DELAY, FIRST_LAG = 0.02, 0.03
"""Where the search for a valve's delay and lag begins [s]."""


def load_hardware(path: Path | None, model: Model, domain: int | None = None, driven: bool = True) -> HardwareSettings:
    """How a robot is reached.

    Args:
        path: of the file; by default ``hardware/<robot>.toml``, or ``hardware/equimus_leg.toml`` where that has the
            robot's joints and actuators. Without either names, units and limits are the robot's own.
        model: of the robot that it has to fit.
        domain: of DDS, in place of the file's; ``ROS_DOMAIN_ID`` where neither it nor a file is given.
        driven: whether it is to be driven, so that its commands have to be limited.

    Raises:
        ConfigError: where the file cannot be read, or does not fit the robot.
    """
    robot = model.robot
    where: Path | str
    chosen = path or presets.find("hardware", f"{presets.plain_name(robot.name)}.toml")
    if chosen is not None:
        where, settings = chosen, HardwareSettings.from_dict(presets.read_toml(chosen), presets.shown(chosen))
    else:
        where, settings = _usual(robot)
    if domain is None and path is None and (given := os.environ.get(DOMAIN_VARIABLE)):
        if not given.isdecimal():
            raise ConfigError(f"{DOMAIN_VARIABLE} is {given!r}, expected a whole number")
        domain = int(given)
    if domain is not None:
        settings = replace(settings, wire=replace(settings.wire, domain=domain))
    interface_of(settings, robot, presets.shown(where) if isinstance(where, Path) else where, driven)
    return settings


def _usual(robot: Robot) -> tuple[Path | str, HardwareSettings]:
    """Where settings of a robot that has none of its own are from, and these."""
    found = presets.find("hardware", DEFAULT)
    if found is not None:
        settings = HardwareSettings.from_dict(presets.read_toml(found), presets.shown(found))
        if (set(settings.joints), set(settings.actuators)) == (set(robot.joint_names), set(robot.actuator_names)):
            return found, settings
    return "hardware settings", settings_for(robot, rates_of(robot).control)


def check_hardware(
    model: Model,
    settings: HardwareSettings,
    *,
    armed: bool = False,
    seconds: float = 3.0,
    share: float = SHARE,
    pressure: float | None = None,
    notify: Callable[[str, float], None] = lambda stage, share: None,
) -> dict[str, Any]:
    """Are both topics alive, at which rates, delays and jitter, and do the joints react to a little of each command?

    Args:
        model: of the robot.
        settings: how it is reached.
        armed: whether it is commanded; without, it is only listened to.
        seconds: how long is listened [s].
        share: of its range that each actuator in turn is commanded for a second; less of a goal, see ``MOST_ASKED``.
        pressure: given in place of a share, of a robot that is driven by pressures [Pa].
        notify: called with what is done now and the share done.

    Returns:
        What was found; ``problems`` holds a sentence for each thing that is not as it must be.

    Raises:
        NotAvailable, HardwareFault: where the robot does not answer, or had to be stopped.
    """
    if not 0 < seconds < math.inf:
        raise ConfigError(f"seconds is {seconds:g}, expected more than 0")
    own = interface_of(settings, model.robot)
    if not 0 < share <= 1:
        raise ConfigError(f"the share of a range is {100 * share:g} %, expected more than 0 and at most 100 %")
    if pressure is not None:
        if set(own.command_units) != {"Pa"}:
            raise ConfigError(f"{model.robot.name}: its commands are no pressures, expected a share of their range")
        highest = float(own.command_high.min())
        if not 0 < pressure <= highest:
            raise ConfigError(f"pressure is {pressure / 1e3:g} kPa, expected more than 0 and at most {highest / 1e3:g}")
    host = transport_entry(settings.wire.transport).host(own.wire)
    plant = HardwarePlant(model, settings, armed=armed, transport=host)
    try:
        notify("listening", 0.0)
        samples = _listened(host, settings.patience, seconds)
        if not samples:
            raise NotAvailable(host.trouble() or plant.silence())
        found = _heard(samples, host)
        problems: list[str] = found["problems"]
        if wrong := _judged(samples, plant):
            problems.append(wrong)
        if trouble := host.trouble():
            problems.append(trouble)
        if not found["listeners"]:
            problems.append(f"nobody listens to {own.wire.commands}")
        if found["rate_hz"] < 0.5 * settings.rate:
            problems.append(
                f"{own.wire.states} comes at {found['rate_hz']:.1f} Hz, expected at least half of the "
                f"{settings.rate:g} Hz at which is commanded"
            )
        if armed and not problems:
            found["reactions"] = _reactions(plant, share, pressure, notify)
            for name, moved in found["reactions"].items():
                if not moved["reacts"]:
                    unit = moved["unit"]
                    problems.append(
                        f"no joint reacted to {moved['asked']} in {name}: the most was "
                        f"{moved['moved_' + unit] * 1e3:.2g} m{unit}, and {moved['still_' + unit] * 1e3:.2g} m{unit} "
                        "without"
                    )
            found["loop"] = plant.counts.to_dict()
    finally:
        plant.close()
    notify("done", 1.0)
    return found


def _listened(host: Transport, patience: float, seconds: float) -> list[Sample]:
    found: list[Sample] = []
    until = clock.monotonic() + patience
    while not found and clock.monotonic() < until:
        clock.sleep(0.01)
        found += host.take()
    until = clock.monotonic() + seconds
    while found and clock.monotonic() < until:
        clock.sleep(0.01)
        found += host.take()
    return found


def _judged(samples: list[Sample], plant: HardwarePlant) -> str:
    """What a run would refuse of measurements."""
    seen: Measurements | str = plant.guard.first(samples[0])
    for sample in samples[1:]:
        if isinstance(seen, str):
            break
        seen = plant.guard.next(seen, sample)
    if isinstance(seen, str):
        return seen
    return "" if seen.samples > 1 else "the stamps of measurements do not advance, expected each later than the last"


def _heard(samples: list[Sample], host: Transport) -> dict[str, Any]:
    stamps = np.array([s.stamp for s in samples])
    arrivals = np.array([s.received for s in samples])
    lateness = arrivals - stamps
    lateness -= lateness.min()
    steps = np.diff(stamps)
    fresh = steps[steps > 0]
    p50, p99 = np.quantile(lateness, [0.5, 0.99])
    return {
        "joints": list(samples[-1].names),
        "samples": len(samples),
        "rate_hz": float(1 / np.median(fresh)) if len(fresh) else 0.0,
        "interval_jitter_s": float(fresh.std()) if len(fresh) else math.nan,
        "longest_gap_s": float(np.diff(arrivals).max()) if len(samples) > 1 else math.nan,
        "lateness_p50_s": float(p50),
        "lateness_p99_s": float(p99),
        "twice_or_out_of_order": int((steps <= 0).sum()),
        "listeners": host.listeners(),
        "problems": [],
    }


def _reactions(
    plant: HardwarePlant, share: float, pressure: float | None, notify: Callable[[str, float], None]
) -> dict[str, Any]:
    """By how much joints move under a little command of each actuator, and by how much without.

    Where springs bring a robot back, the command holds for a second; else only until a joint has moved.
    """
    own, robot, names = plant.interface, plant.robot, plant.spec.actuators
    first = plant.reset().command
    steps = round(REACTION * plant.settings.rate)
    least = np.array([LEAST_MOVED[unit] for unit in own.joint_units])
    found = {}
    for i, name in enumerate(names):
        rest, unit = float(first[i]), own.command_units[i]
        asked = pressure if pressure is not None else share * float(own.command_high[i] - rest)
        if own.holds[i]:
            asked = min(share * float(own.command_high[i] - own.command_low[i]), MOST_ASKED.get(unit, np.inf))
            asked = asked if rest + asked <= own.command_high[i] else -asked
        said = reading(unit).text(asked)
        notify(f"{said} in {name}", 0.3 + 0.6 * i / len(names))
        still = np.array([plant.step(first).position for _ in range(steps)])[steps // 2 :]
        middle, noise, command = still.mean(axis=0), still.std(axis=0), np.array(first)
        command[i] += asked
        counts = np.maximum(SIGMAS * noise, least)
        seen: list[Array] = []
        while len(seen) < steps:
            seen.append(plant.step(command).position)
            if not robot.traits.held_in_place and np.any(np.abs(seen[-1] - middle) > 2 * counts):
                break
        moved = np.abs(np.mean(seen[len(seen) // 2 :], axis=0) - middle)
        if not robot.traits.held_in_place:
            moved = np.abs(np.array(seen) - middle).max(axis=0)
        for _ in range(2 * steps):
            plant.step(first)
        j = int(np.argmax(moved / counts))
        kind = own.joint_units[j]
        found[name] = {
            f"moved_{kind}": float(moved[j]), f"still_{kind}": float(noise[j]), "unit": kind, "asked": said,
            "joint": plant.spec.joints[j], "reacts": bool(moved[j] > counts[j]),
        }  # fmt: skip
    return found


def with_valve_delays(model: Model) -> Model:
    """The model with a delay and a lag on every actuator that has none, to be identified."""
    effects = list(model.effects)
    for name in model.robot.actuator_names:
        for kind, values in ((TransportDelay, {"delay": FIRST_DELAY}), (FirstOrderLag, {"time_constant": FIRST_LAG})):
            if not any(isinstance(effect, kind) and effect.location == name for effect in effects):
                effects.append(kind(name, **values))
    return replace(model, effects=tuple(effects))


def measure_delay(recordings: Sequence[Recording], model: Model) -> Identified:
    """Delay and lag of every actuator from what a robot did, its other parameters identified along.

    The delay is from end to end: from when a command is sent to when what it does is seen, the quickest way of a
    measurement counted as none. Controllers that are given the model (``--nominal``) predict over it.

    Args:
        recordings: trials in which commands change often.
        model: of the robot.

    Raises:
        EquimusError: where the recordings cannot be used.
    """
    return identify_recordings(recordings, with_valve_delays(model), folds=0)


def import_bag(path: Path, output: Path, model: Model, settings: HardwareSettings, force: bool = False) -> Path:
    """A rosbag2 bag with a robot's two topics as a file in the recording format.

    Args:
        path: the bag.
        output: folder to write into.
        model: of the robot.
        settings: topics, names, units and signs.
        force: whether a file that is there is replaced.

    Raises:
        NotAvailable: where the rosbags library is not installed.
        RecordingError: where the bag cannot be read, or the file is there already.
    """
    from equimus_ctrl.plants.hardware.bag import read_bag

    recording = read_bag(path, model, settings)
    presets.make_folder(output)
    target = output / f"{recording.name}.csv"
    if target.exists() and not force:
        raise RecordingError(f"{target}: is there already; --force replaces it")
    write(target, recording)
    return target
