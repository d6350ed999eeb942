"""What tests of real robots share: a wire in memory, emulators as processes, and DDS on loopback alone."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.errors import HardwareFault
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import HardwareSettings, Safety, Wire
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>40</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers>'
    "<SPDPInterval>500ms</SPDPInterval></Discovery></Domain></CycloneDDS>"
)
"""No test may reach a robot on the network; who is there is told often, for a first word may be lost."""
SHARED = 20 + 2 * (os.getpid() % 100)
DOMAIN = SHARED + 1
"""Of one emulator that many tests use, and of those that have their own."""
REST = (1.305, 1.04)
HIGHEST = 50e3
MODEL, DT = nominal_model(), 1 / 120
LOW = np.array([5e3, 3e3])


class MemoryWire:
    """A robot that stands still at 120 Hz, or does what it is told to.

    Args:
        measure: (count, time) → samples to send at that tick; a still robot's by default.
    """

    def __init__(self, measure: Callable[[int, float], Sequence[Sample]] | None = None) -> None:
        self._measure = measure or (lambda k, now: [still(now)])
        self.sent: list[tuple[float, tuple[float, ...]]] = []
        self.wrong, self.ready, self.hearing = "", False, 1
        self.closed = False
        self._waiting: list[Sample] = []
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        k, begun = 0, time.monotonic()
        while not self._stop.wait(max(begun + k / 120 - time.monotonic(), 0.0)):
            with self._lock:
                self._waiting += self._measure(k, time.monotonic())
            k += 1

    def take(self) -> list[Sample]:
        with self._lock:
            found, self._waiting = self._waiting, []
        return found

    def send(self, values: Sequence[float]) -> None:
        self.sent.append((time.monotonic(), tuple(values)))

    def prepare(self) -> None:
        self.ready = True

    def listeners(self) -> int:
        return self.hearing

    def trouble(self) -> str:
        return self.wrong

    def close(self) -> None:
        self.closed = True
        self._stop.set()

    @property
    def pressures(self) -> np.ndarray:
        return np.array([values for _, values in self.sent])


def still(now: float, angles: Sequence[float] = REST, *, stamp: float | None = None, source: int = 0) -> Sample:
    return Sample(now if stamp is None else stamp, now, ("hip", "knee"), tuple(angles), source)


def quick(domain: int = DOMAIN, **safety: Any) -> HardwareSettings:
    """Settings that do not wait for long."""
    return HardwareSettings(patience=10.0, settle=0.3, wire=Wire(domain=domain), safety=Safety(**safety))


def patient(domain: int = DOMAIN) -> HardwareSettings:
    """Bears a machine that stands still for a moment, where what a robot does about that is not what is tested."""
    return quick(domain, stale=0.5, misses=60)


PATIENT = ("--watchdog", "0.5")
"""The same of an emulator."""


def plant_on(wire: MemoryWire, settings: HardwareSettings | None = None, **given: object) -> HardwarePlant:
    return HardwarePlant(MODEL, settings or quick(), **{"armed": True, "transport": wire, **given})  # type: ignore[arg-type]


def driven(wire: MemoryWire, command: Array, steps: int, settings: HardwareSettings | None = None) -> str:
    """Steps until it faults; why."""
    plant = plant_on(wire, settings)
    try:
        plant.reset()
        for _ in range(steps):
            plant.step(command)
    except HardwareFault as fault:
        return str(fault)
    finally:
        plant.close()
    return ""


def after(wire: MemoryWire, fault_at: float) -> Array:
    """Commands sent from a time on."""
    return np.array([values for at, values in wire.sent if at >= fault_at])


class Controller:
    """Holds, and once does something else."""

    def __init__(self, act: Callable[[int], object]) -> None:
        self._act = act

    def init(self, spec: PlantSpec, observation: Observation) -> int:
        return 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        found = self._act(state)
        return LOW if found is None else found, state + 1


@contextmanager
def emulator(log: Path, *options: str, domain: int = DOMAIN) -> Iterator[subprocess.Popen[bytes]]:
    """The emulator as a process of its own."""
    command = [sys.executable, "-c", "from equimus_ctrl.cli.main import entry; entry()", "emulate"]
    process = subprocess.Popen(
        [*command, "--domain", str(domain), "--log", str(log), *options],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env={**os.environ, "CYCLONEDDS_URI": LOOPBACK},
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            said = process.communicate(timeout=20)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            said = process.communicate()[1]
        if process.returncode not in (0, 70, -signal.SIGTERM):
            print(f"the emulator ended with {process.returncode}: {said.decode()}", file=sys.stderr)


def seen_by(log: Path) -> dict[str, Any]:
    """What an emulator that has ended says that it received."""
    return dict(json.loads(log.read_text(encoding="utf-8")))


def within_limits(seen: dict[str, Any], slew: float = math.inf) -> bool:
    return bool(max(seen["highest"]) <= HIGHEST and min(seen["lowest"]) >= 0 and seen["steepest"] <= slew * 1.000001)
