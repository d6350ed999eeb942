"""A simulated robot behind a transport, in real time: valves, sensor, a network that loses and delays, a watchdog.

The simulation takes ticks of 1/480 s, or near it where the robot's physics steps ask for another. What was commanded
acts from the tick after it arrived. Where the computer falls behind real time for a moment, missed ticks are made up
for; where by more than ``MOST_BEHIND``, they are skipped.
"""

from __future__ import annotations

import heapq
import math
import os
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.emulation.faults import Fault
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError, ModelError, NotAvailable
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.hardware.transport import Device
from equimus_ctrl.plants.hardware.transports import transport_entry
from equimus_ctrl.plants.mujoco_plant import USUAL_CONTROL, MujocoPlant, PlantRates, rates_of, whole_ratio
from equimus_ctrl.types import Array, Start

TICK = 480.0
"""Rate of the simulation [Hz], or near it where the robot's physics steps ask for another."""
MOST_BEHIND = 0.5
"""Of real time [s]."""
ANGLE_OFFSET = 1.0
"""By so much positions are off during the fault ``jump`` [rad or m]."""
AHEAD = 2.0
"""By so much stamps are off where the clock has jumped [s]."""


@dataclass(frozen=True)
class EmulatorSettings:
    """What the robot and the network are like.

    Attributes:
        rate: of measurements [Hz]; that of the robot's plant in simulation by default.
        noise: standard deviation of white noise on each position [rad or m].
        loss: share of messages lost, each way.
        latency: of messages, each way [s].
        jitter: standard deviation of what comes on top of it, its absolute value [s].
        watchdog: without a command for longer the device stops by itself [s].
        seed: of noise, losses and jitter.
        faults: to order.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    rate: float | None = None
    noise: float = 0.0
    loss: float = 0.0
    latency: float = 0.0
    jitter: float = 0.0
    watchdog: float = 0.1
    seed: int = 0
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ConfigError(f"rate is {self.rate:g} Hz, expected more than 0")
        for key in ("noise", "latency", "jitter"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected at least 0")
        if not 0 <= self.loss < 1:
            raise ConfigError(f"loss is {self.loss:g}, expected at least 0 and less than 1")
        if not self.watchdog > 0:
            raise ConfigError(f"watchdog is {self.watchdog:g} s, expected more than 0")
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed}, expected at least 0")


@dataclass
class Emulated:
    """What the device saw.

    Attributes:
        time: how long it has run [s].
        commands: received.
        refused: of them not one finite number for each actuator, which changed nothing.
        highest: (na,) highest command received [Pa, or what else its commands are].
        lowest: (na,) lowest.
        steepest: the largest change from one command received to the next, stopping excluded.
        watchdog: how often it stopped by itself, there being a command that moves it.
        vented: when the command in force last became one that stops it [s]; NaN where it does not now.
        measurements: sent.
        skipped: ticks that were skipped because the computer was too slow.
    """

    time: float
    commands: int
    refused: int
    highest: list[float]
    lowest: list[float]
    steepest: float
    watchdog: int
    vented: float
    measurements: int
    skipped: int


class Emulator:
    """A robot that can be driven over a transport.

    Args:
        model: what is simulated, with its effects.
        hardware: how it is reached, and what its numbers mean.
        settings: what it and the network are like.
        device: in place of the settings' own transport.

    Attributes:
        rate: of measurements [Hz].
        interface: what its numbers mean.
        seen: what it saw so far.
    """

    def __init__(
        self,
        model: Model,
        hardware: HardwareSettings | None = None,
        settings: EmulatorSettings | None = None,
        device: Device | None = None,
    ) -> None:
        self.hardware, self.settings = hardware or HardwareSettings(), settings or EmulatorSettings()
        s, usual = self.settings, rates_of(model.robot)
        self._tick = usual.physics / max(round(usual.physics / TICK), 1)
        self.rate = rate = s.rate or self._tick / max(round(self._tick / USUAL_CONTROL), 1)
        self._every = whole_ratio(self._tick, rate, "ticks of the emulator over its sensor's rate")
        self._plant = MujocoPlant(model, rates=PlantRates(self._tick, rate, usual.physics), noise=s.noise)
        spec = self._plant.spec
        self.interface = own = interface_of(self.hardware, model.robot, limited=False)
        self._joints, self._channels = own.calibrations, own.channels
        self._low, self._high = spec.command_low, spec.command_high
        self._device = device or transport_entry(own.wire.transport).device(own.wire)
        nothing = np.clip(np.zeros(len(spec.actuators)), self._low, self._high)
        home = self._plant.reset(self._at_rest(nothing)).position
        self._first: Array = np.clip(own.stopping(model.robot.goals_at(home)), self._low, self._high)
        self._second_publisher: Device | None = None
        self._rng = np.random.default_rng(s.seed)
        first = self._first.tolist()
        self.seen = Emulated(0.0, 0, 0, list(first), list(first), 0.0, 0, 0.0, 0, 0)
        self._received: Array = self._first
        self._heard = math.inf
        self._coming: list[tuple[float, int, tuple[float, ...]]] = []
        self._going: list[tuple[float, int, float, tuple[float, ...]]] = []
        self._count = self._samples = 0

    def _at_rest(self, command: Array) -> Start:
        """At rest under a command (na,); of a robot that rests nowhere under it, in the pose of its description."""
        try:
            position = rest_pose(self._plant.model, command)
        except (ModelError, NotAvailable):
            position = self._plant.reset().position
        return Start(command=command, position=position)

    def run(
        self,
        duration: float = math.inf,
        notify: Callable[[Emulated], None] = lambda seen: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Emulated:
        """Go on in real time.

        Args:
            duration: for so long [s].
            notify: called every second.
            stopped: asked at each tick whether to end.

        Raises:
            SimulationDiverged: where the robot's motion did.
        """
        every, ticks, in_force = self._every, self._tick, self._first
        start = self._at_rest(in_force)
        self._plant.reset(start, seed=self.settings.seed)
        self._plant.step(in_force)  # what is made at the first step is made before time begins
        observation = self._plant.reset(start, seed=self.settings.seed)
        origin, tick = clock.monotonic(), 0
        try:
            while tick / ticks < duration and not stopped():
                now = tick / ticks
                in_force = self._commanded(now, in_force)
                observation = self._plant.step(in_force)
                tick += 1
                self.seen.time = tick / ticks
                left = origin + tick / ticks - clock.monotonic()
                if left > 0:
                    clock.sleep(left)
                elif left < -MOST_BEHIND:
                    self.seen.skipped += round(-left * ticks)
                    origin -= left
                if tick % every == 0:
                    # When the angles were these, whatever this process's delay: as a sensor's own clock has it.
                    self._measured(tick / ticks, origin + tick / ticks, observation.position)
                self._deliver(tick / ticks)
                if tick % round(ticks) == 0:
                    notify(self.seen)
        finally:
            self._device.close()
            if self._second_publisher is not None:
                self._second_publisher.close()
        return self.seen

    def _acting(self, kind: str, time: float) -> bool:
        return any(fault.kind == kind and fault.acts(time) for fault in self.settings.faults)

    def _delay(self) -> float:
        s = self.settings
        return s.latency + (abs(float(self._rng.normal(0.0, s.jitter))) if s.jitter else 0.0)

    def _lost(self) -> bool:
        return bool(self.settings.loss) and bool(self._rng.random() < self.settings.loss)

    def _commanded(self, now: float, in_force: Array) -> Array:
        """(na,) the command in force from now on."""
        if self._acting("crash", now):
            os._exit(70)
        for values in self._device.take():
            if not (self._lost() or self._acting("deaf", now)):
                self._count += 1
                heapq.heappush(self._coming, (now + self._delay(), self._count, values))
        while self._coming and self._coming[0][0] <= now:
            values = heapq.heappop(self._coming)[2]
            found = self._read(values)
            if found is not None:
                in_force, self._heard = found, now
        if now - self._heard > self.settings.watchdog:
            self.seen.watchdog += bool(self._driven(in_force).any() or self.interface.holds.any())
            self._heard = math.inf
            in_force = self.interface.stopping(in_force)
        if self._driven(in_force).any():
            self.seen.vented = math.nan
        elif math.isnan(self.seen.vented):
            self.seen.vented = now
        return in_force

    def _driven(self, command: Array) -> NDArray[np.bool_]:
        """(na,) where a command is none that stops it."""
        return np.asarray(~self.interface.holds & (command != self.interface.stop))

    def _read(self, values: Sequence[float]) -> Array | None:
        """(na,) a command received, within what the drives can do; None where it is none."""
        self.seen.commands += 1
        if len(values) != len(self._channels) or not np.all(np.isfinite(values)):
            self.seen.refused += 1
            return None
        command = self.interface.command(values)
        if (counted := self._driven(command) | self.interface.holds).any():
            self.seen.steepest = max(self.seen.steepest, float(np.abs(command - self._received)[counted].max()))
        self._received = command
        for i, value in enumerate(command.tolist()):
            self.seen.highest[i] = max(self.seen.highest[i], value)
            self.seen.lowest[i] = min(self.seen.lowest[i], value)
        return np.asarray(np.clip(command, self._low, self._high))

    def _measured(self, now: float, stamp: float, position: Array) -> None:
        """One measurement goes on its way."""
        angles = position + ANGLE_OFFSET * self._acting("jump", now)
        numbers = [q / own.scale + own.zero for q, own in zip(angles.tolist(), self._joints, strict=True)]
        if self._acting("nan", now):
            numbers = [math.nan] * len(numbers)
        stamp += AHEAD * (self._acting("clock", now) - self._acting("back", now))
        leaves = now + self._delay()
        for fault in self.settings.faults:
            if fault.kind == "stall" and fault.acts(now):
                leaves = max(leaves, fault.time + fault.duration)
        self._samples += 1
        if self._acting("reorder", now) and self._samples % 2:
            leaves += 1.5 / self.rate
        if self._lost() or self._acting("silent", now):
            return
        for _ in range(1 + self._acting("repeat", now)):
            self._count += 1
            heapq.heappush(self._going, (leaves, self._count, stamp, tuple(numbers)))

    def _deliver(self, now: float) -> None:
        names = [own.name for own in self._joints]
        second_publisher = self._acting("second_publisher", now)
        if second_publisher and self._second_publisher is None:
            self._second_publisher = transport_entry(self.interface.wire.transport).device(self.interface.wire)
        while self._going and self._going[0][0] <= now:
            _, _, stamp, numbers = heapq.heappop(self._going)
            self._device.publish(stamp, names, numbers)
            if second_publisher and self._second_publisher is not None:
                self._second_publisher.publish(stamp, names, numbers)
            self.seen.measurements += 1
