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
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.hardware.transport import Sample, Transport
from equimus_ctrl.plants.hardware.transports import transport_entry
from equimus_ctrl.recordings import write
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.identify import identify_recordings

DEFAULT = "equimus_leg.toml"
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
REACTION = 1.0
"""How long an actuator is given pressure, and how long it rests before [s]."""
LEAST_MOVED = 2e-3
"""What moves by less does not react [rad]."""
FIRST_DELAY, FIRST_LAG = 0.02, 0.03
"""Where the search for a valve's delay and lag begins [s]."""


def load_hardware(path: Path | None, model: Model, domain: int | None = None) -> HardwareSettings:
    """How a robot is reached.

    Args:
        path: of the file; ``hardware/equimus_leg.toml`` by default.
        model: of the robot that it has to fit.
        domain: of DDS, in place of the file's; ``ROS_DOMAIN_ID`` where neither it nor a file is given.

    Raises:
        ConfigError: where the file cannot be read, or does not fit the robot.
    """
    chosen = path or presets.find("hardware", DEFAULT)
    if chosen is None:
        raise ConfigError(f"hardware/{DEFAULT} is not there; give a file with --hardware FILE")
    settings = HardwareSettings.from_dict(presets.read_toml(chosen), str(chosen))
    if domain is None and path is None and (given := os.environ.get(DOMAIN_VARIABLE)):
        if not given.isdecimal():
            raise ConfigError(f"{DOMAIN_VARIABLE} is {given!r}, expected a whole number")
        domain = int(given)
    if domain is not None:
        settings = replace(settings, wire=replace(settings.wire, domain=domain))
    m = model.morphology
    settings.for_robot(m.joint_names, m.actuator_names, str(chosen))
    return settings


def check_hardware(
    model: Model,
    settings: HardwareSettings,
    *,
    armed: bool = False,
    seconds: float = 3.0,
    pressure: float = 5e3,
    notify: Callable[[str, float], None] = lambda stage, share: None,
) -> dict[str, Any]:
    """Are both topics alive, at which rates, delays and jitter, and do the joints react to a little pressure?

    Args:
        model: of the robot.
        settings: how it is reached.
        armed: whether it is given pressure; without, it is only listened to.
        seconds: how long is listened [s].
        pressure: given to each actuator in turn for a second [Pa].
        notify: called with what is done now and the share done.

    Returns:
        What was found; ``problems`` holds a sentence for each thing that is not as it must be.

    Raises:
        NotAvailable, HardwareFault: where the robot does not answer, or had to be vented.
    """
    if not 0 < seconds < math.inf:
        raise ConfigError(f"seconds is {seconds:g}, expected more than 0")
    highest = min(model.morphology.command_high, settings.safety.pressure)
    if not 0 < pressure <= highest:
        raise ConfigError(f"pressure is {pressure / 1e3:g} kPa, expected more than 0 and at most {highest / 1e3:g}")
    host = transport_entry(settings.wire.transport).host(settings.wire)
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
            problems.append(f"nobody listens to {settings.wire.commands}")
        if found["rate_hz"] < 0.5 * settings.rate:
            problems.append(
                f"{settings.wire.states} comes at {found['rate_hz']:.1f} Hz, expected at least half of the "
                f"{settings.rate:g} Hz at which is commanded"
            )
        if armed and not problems:
            found["reactions"] = _reactions(plant, pressure, notify)
            for name, moved in found["reactions"].items():
                if not moved["reacts"]:
                    problems.append(
                        f"no joint reacted to {pressure / 1e3:g} kPa in {name}: the most was "
                        f"{moved['moved_rad'] * 1e3:.2g} mrad, and {moved['still_rad'] * 1e3:.2g} mrad without"
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


def _reactions(plant: HardwarePlant, pressure: float, notify: Callable[[str, float], None]) -> dict[str, Any]:
    """By how much joints move under a little pressure in each actuator, and by how much without."""
    rate, names = plant.settings.rate, plant.spec.actuators
    plant.reset()
    found = {}
    for i, name in enumerate(names):
        notify(f"{pressure / 1e3:g} kPa in {name}", 0.3 + 0.6 * i / len(names))
        command = np.zeros(len(names))
        seen = []
        for k in range(round(4 * REACTION * rate)):
            command[i] = pressure if REACTION * rate <= k < 2 * REACTION * rate else 0.0
            seen.append(plant.step(command).position)
        angles, n = np.array(seen), round(REACTION * rate)
        still, pressurised = angles[n // 2 : n], angles[round(1.5 * n) : 2 * n]
        noise = float(still.std(axis=0).max())
        moved = float(np.abs(pressurised.mean(axis=0) - still.mean(axis=0)).max())
        found[name] = {"moved_rad": moved, "still_rad": noise, "reacts": bool(moved > max(5 * noise, LEAST_MOVED))}
    return found


def with_valve_delays(model: Model) -> Model:
    """The model with a delay and a lag on every actuator that has none, to be identified."""
    effects = list(model.effects)
    for name in model.morphology.actuator_names:
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
