"""The plant protocol on a real robot: a fixed rate, one clock, limits enforced last, a stop where anything fails."""

from __future__ import annotations

import math
import signal
import threading
import time as clock
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.errors import ConfigError, HardwareFault, NotAvailable, RecordingError
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.guard import Guard, Measurements
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.hardware.transport import Transport
from equimus_ctrl.plants.hardware.transports import transport_entry
from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.recordings.stream import RecordingStream
from equimus_ctrl.robots.reading import command_words, shown
from equimus_ctrl.types import Array, Observation, PlantSpec, Start, frozen_array

LOOKS = 0.25
"""How often it is looked who else is on the wire [s]."""
STOPS = 3
"""So many times what stops the robot is sent, a period apart, where a run ends: one may be lost."""
PAUSED, MOST_PAUSES = 0.5, 20
"""Before a run, who does not send for this share of the time after which measurements are stale stood still; and how
often that may be."""
EARLY = 1e-6
"""Share of a period that rounding may take."""
FRESH = 2e-3
"""A run's instants are so long after the quickest measurement would have come [s]."""
NEAR = 2e-3
"""Before a deadline a sleep ends by so much, and the rest is waited for in short ones [s]."""


@dataclass
class LoopCounts:
    """What the loop saw of itself and of the wire.

    Attributes:
        instants: control instants.
        misses: deadlines missed: the controller had not answered by the next instant.
        lateness: (instants,) by how much later than it was due each instant began [s].
        latency: (instants,) from the latest measurement, by its stamp, to the command made of it [s].
        samples: measurements that counted.
        ignored: measurements that had come before, or too late for their order.
        fault: why the robot was stopped; empty where nothing was wrong.
    """

    instants: int = 0
    misses: int = 0
    lateness: list[float] | None = None
    latency: list[float] | None = None
    samples: int = 0
    ignored: int = 0
    fault: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; medians and 99th percentiles in seconds."""
        found: dict[str, Any] = {
            "instants": self.instants, "deadlines_missed": self.misses, "samples": self.samples,
            "samples_ignored": self.ignored, "fault": self.fault,
        }  # fmt: skip
        for name, values in (("lateness", self.lateness), ("latency", self.latency)):
            p50, p99 = np.quantile(values, [0.5, 0.99]) if values else (math.nan, math.nan)
            found[f"{name}_p50_s"], found[f"{name}_p99_s"] = float(p50), float(p99)
        return found


class HardwarePlant:
    """A robot behind a transport.

    Commands go out as soon as they are asked for; then the next instant is waited for. Every run is recorded as it
    goes: at each control instant the command in force from then on, and the positions between the two measurements
    around it. The robot is stopped within one period where a measurement is late, no number, out of range or has
    jumped, where the controller misses too many deadlines, where the process is asked to end, and at the end of a run:
    by 0 Pa (it is vented), by no force, by rates of 0; what its last goal holds stays there, see ``Interface.stop``.

    Args:
        model: of the robot: names, ranges, and what controllers may compute with.
        settings: how it is reached and what is enforced.
        armed: whether commands are sent at all; without, all is as with but for that.
        nominal: what controllers may compute with; the model by default.
        record: new file for the recording, or None.
        transport: in place of the settings' own.
        notes: of the recording.

    Raises:
        ConfigError: for settings that do not fit the robot.
        NotAvailable: where the transport cannot be had.
    """

    def __init__(
        self,
        model: Model,
        settings: HardwareSettings | None = None,
        *,
        armed: bool = False,
        nominal: Model | None = None,
        record: Path | None = None,
        transport: Transport | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        self.settings = s = settings or HardwareSettings()
        self.armed, self._record_to, self.robot = armed, record, model.robot
        self._notes = {"plant": "hardware", "robot": s.wire.states, **(notes or {})}
        self.interface = own = interface_of(s, model.robot)
        spec = make_spec(model.robot, 1 / s.rate, nominal or model, model.phase)
        self._spec = replace(spec, command_low=own.command_low, command_high=own.command_high)
        self.guard = Guard(self._spec, s.safety, own)
        self._wire = transport or transport_entry(s.wire.transport).host(own.wire)
        self.counts = LoopCounts()
        self._seen: Measurements | None = None
        self._stream: RecordingStream | None = None
        self._pending: deque[tuple[float, Array]] = deque()
        self._last: tuple[float, Array] | None = None
        self._command: Array = own.stopping(np.zeros(len(self._spec.actuators)))
        self._clipped = np.zeros(len(self._spec.actuators), dtype=bool)
        self._origin, self._k, self._due, self._begun = math.nan, 0, math.inf, False
        self._target, self._held_since, self._beat = self._command, math.inf, -math.inf
        self._approach = own.slew
        self._halted = self._closing = self._closed = self._resync = False
        self._sent_at, self._pauses = -math.inf, 0
        self._tripped, self._in_a_row = "", 0
        self._lock, self._stop = threading.RLock(), threading.Event()
        self._watch: threading.Thread | None = None
        self._previous_signals: dict[int, Any] = {}

    @property
    def spec(self) -> PlantSpec:
        """What a controller may know."""
        return self._spec

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        """Wait for the robot, bring it to the start's command and let it settle; time 0 is at the first step.

        Pressures that springs answer, and goals, are gone to, goals as slowly as ``settle`` takes. Forces that nothing
        holds against would carry the robot away: it stays stopped. Goals of which nobody tells stay where it is.

        Args:
            start: its command is gone to; where the joints are is where they are, whatever it says.
            seed: takes no part.

        Raises:
            NotAvailable: where no measurement comes, or someone else is on the wire.
            HardwareFault: where the robot is not as it must be.
            ConfigError: for a start of the wrong size or outside the limits, or a second run.
        """
        self._require_open()
        if self._watch is not None:
            raise ConfigError("a hardware plant runs once; make another one")
        given = None if start is None else start.command
        own, low, high = self.interface, self.guard.command_low, self.guard.command_high
        if given is not None and given.shape != self._command.shape:
            raise ConfigError(f"start command has shape {given.shape}, expected {self._command.shape}")
        if given is not None and not np.all((given >= low) & (given <= high)):
            units = own.command_units
            raise ConfigError(
                f"start command {shown(given, units)} lies outside the limits of {shown(low, units, False)} to "
                f"{shown(high, units)}"
            )
        self._first_sample()
        assert self._seen is not None
        self._command = own.stopping(np.clip(self.robot.goals_at(self._seen.position), low, high))
        target = np.clip(self._command, low, high)
        if given is not None:
            target = np.where(own.holds | self.robot.traits.held_in_place, given, target)
        if self.settings.settle > 0:
            slowly = np.abs(target - self._command) / self.settings.settle
            self._approach = np.where(own.holds, np.minimum(own.slew, slowly), own.slew)
        self._heed_signals()
        self._target, self._held_since = np.array(target), clock.monotonic()
        self._watch = threading.Thread(target=self._watched, daemon=True)
        self._watch.start()
        self._settled()
        self.counts = LoopCounts(lateness=[], latency=[])
        return self._observation()

    def step(self, command: ArrayLike) -> Observation:
        """Send ``command`` within all limits and wait for the next control instant.

        Raises:
            ConfigError: for a command of the wrong size or not finite.
            HardwareFault: where the robot had to be stopped.
        """
        self._require_open()
        assert self._watch is not None, "the plant was stepped before it was reset"
        asked = np.asarray(command, dtype=np.float64)
        if asked.shape != self._command.shape or not np.all(np.isfinite(asked)):
            words = command_words(self.interface.command_units)[0]
            self._halt("a command was not one finite number for each actuator")
            raise ConfigError(f"command is {asked}, expected {len(self._command)} finite {words}")
        if self._tripped:
            self._fault(self._tripped)
        if not self._begun:
            self._begin()
        now, dt = clock.monotonic(), self._spec.control_dt
        behind = max(math.floor((now - self._origin) / dt - self._k + EARLY), 0)
        self._in_a_row = self._in_a_row + behind if behind else 0
        self.counts.misses += behind
        if self._in_a_row > self.settings.safety.misses:
            self._fault(
                f"the controller missed {self._in_a_row} deadlines of {dt * 1e3:.3g} ms in a row, expected at most "
                f"{self.settings.safety.misses}"
            )
        self._judge(now)
        applied = self.guard.limited(asked, self._command, min(now - self._sent_at, dt))
        self._clipped, self._command = applied != asked, applied
        self._send(applied)
        if self.counts.latency is not None and self._seen is not None:
            self.counts.latency.append(now - self._seen.stamp)
        self._k += 1 + behind
        self._due = self._origin + self._k * dt
        self._wait(self._due)
        woken = clock.monotonic()
        if self.counts.lateness is not None:
            self.counts.lateness.append(woken - self._due)
        self._due += dt
        self._judge(woken)
        return self._observation()

    def silence(self) -> str:
        """That no measurement came, in words."""
        wire = self.interface.wire
        return (
            f"no measurement came on {wire.states}, domain {wire.domain}, within {self.settings.patience:g} s; is the "
            "robot, or equimus-ctrl emulate, running?"
        )

    def close(self) -> None:
        """Stop the robot, and let go of it."""
        if self._closed:
            return
        self._closing = True
        if self._watch is not None:  # a robot that was never taken over is another's
            self._halt("")
        self._closed = True
        self._stop.set()
        try:
            if self._watch is not None:
                self._watch.join()
                if self.armed:
                    for _ in range(STOPS - 1):
                        clock.sleep(self._spec.control_dt)
                        self._transmit(self.interface.stopping(self._command))
            # The last row, of stopping, lies before a measurement that is still to come.
            until = clock.monotonic() + self.settings.safety.stale
            while self._stream is not None and not self._taken() and self._pending and clock.monotonic() < until:
                clock.sleep(1e-3)
        finally:
            if self._stream is not None:
                self._stream.close()
            self._wire.close()
            for number, handler in self._previous_signals.items():
                signal.signal(number, handler)

    def _require_open(self) -> None:
        if self._closed:
            raise HardwareFault(self._tripped or "the robot has been let go of")

    def _first_sample(self) -> None:
        s = self.settings
        until, wrong = clock.monotonic() + s.patience, ""
        while self._seen is None:
            for sample in self._wire.take():
                found = self.guard.first(sample) if self._seen is None else self.guard.next(self._seen, sample)
                if isinstance(found, Measurements):
                    self._seen = found
                else:
                    wrong = found
            if self._seen is None and clock.monotonic() > until:
                if wrong:
                    raise HardwareFault(f"the robot was not armed: {wrong}")
                raise NotAvailable(self._wire.trouble() or self.silence())
            clock.sleep(1e-3)
        if trouble := self._wire.trouble():
            raise NotAvailable(f"the robot was not armed: {trouble}")
        if self.armed:
            self._wire.prepare()
            while not self._wire.listeners():
                if clock.monotonic() > until:
                    raise NotAvailable(f"the robot was not armed: {self._deaf()}")
                clock.sleep(1e-3)

    def _deaf(self) -> str:
        wire = self.interface.wire
        return f"nobody listens to {wire.commands}, domain {wire.domain}"

    def _begin(self) -> None:
        """The first instant is now, if the robot has been held for long enough without a break.

        What a controller makes first may take its time, and keep this process from sending: then the device has stopped
        by itself, and the robot has to be brought to the start again.
        """
        self._settled()
        if self._record_to is not None and self.armed:
            self._stream = RecordingStream(
                self._record_to, self._spec.joints, self._spec.actuators, self._command, self._notes
            )
        with self._lock:
            self._begun = True
            # A period after the last command, or what may change within a period would depend on when it was sent.
            dt = self._spec.control_dt
            origin = max(clock.monotonic(), self._sent_at + dt)
            assert self._seen is not None
            # Soon after a measurement is due, where they come as often: else it would be luck how old they are.
            self._origin, self._k = origin + (self._seen.stamp + FRESH - origin) % dt, 0
            self._due = self._origin + dt
            self._last = (self._seen.stamp - self._origin, self._seen.position)
        self._wait(self._origin)

    def _settled(self) -> None:
        """Waits until the start's command has been held for as long as it has to."""
        asked = clock.monotonic()
        while not self._tripped and (
            self._beat <= asked or clock.monotonic() < self._held_since + self.settings.settle
        ):
            clock.sleep(self._spec.control_dt)
        if self._tripped:
            self._fault(self._tripped)

    def _judge(self, now: float) -> None:
        """A fault where something has tripped, or measurements are wrong or missing."""
        assert self._seen is not None
        if wrong := self._tripped or self._taken() or self.guard.stale(self._seen, now):
            self._fault(wrong)

    def _taken(self) -> str:
        """Takes what has been measured meanwhile; the fault that it shows, empty where it shows none."""
        assert self._seen is not None
        for sample in self._wire.take():
            found = self.guard.first(sample) if self._resync else self.guard.next(self._seen, sample)
            if isinstance(found, str):
                return found
            if found.samples > self._seen.samples:
                try:
                    self._write(found)
                except RecordingError as error:
                    return str(error)
            self._seen, self._resync = found, False
        return ""

    def _write(self, seen: Measurements) -> None:
        """Rows of the instants that lie between the measurement before and this one."""
        if not self._begun or self._last is None:
            return
        at, (before, angles) = seen.stamp - self._origin, self._last
        while self._stream is not None and self._pending and self._pending[0][0] <= at:
            instant, command = self._pending.popleft()
            share = (instant - before) / (at - before) if at > before else 1.0
            self._stream.add(instant, command, angles + max(share, 0.0) * (seen.position - angles))
        self._last = (at, seen.position)

    def _observation(self) -> Observation:
        assert self._seen is not None
        instant = self._k * self._spec.control_dt
        self.counts.instants += 1
        self.counts.samples, self.counts.ignored = self._seen.samples, self._seen.ignored
        clipped = self._clipped.copy()
        clipped.flags.writeable = False
        return Observation(
            time=instant,
            position=frozen_array(self._seen.position),
            stamp=min(self._seen.stamp - self._origin, instant) if self._begun else 0.0,
            command=frozen_array(self._command),
            clipped=clipped,
        )

    def _send(self, command: Array) -> None:
        with self._lock:
            if self.armed and not self._halted:
                self._transmit(command)
                self._sent_at = clock.monotonic()
                self._keep(command)

    def _keep(self, command: Array) -> None:
        """A row of the recording, which waits for the next measurement: the command holds from now on."""
        if self._begun and self._stream is not None:
            self._pending.append((clock.monotonic() - self._origin, command))

    def _transmit(self, command: Array) -> None:
        self._wire.send(self.interface.numbers(command))

    def _halt(self, why: str) -> None:
        """Stop the robot, now and for good; no slew limit applies."""
        with self._lock:
            if why and not self._tripped:
                since = clock.monotonic() - self._origin
                at = f" at {since:.3f} s" if math.isfinite(since) else " before the run began"
                word = self.interface.stopped if self.armed else f"would have been {self.interface.stopped}"
                self._tripped = f"{word}{at}: {why}"
                self.counts.fault = self._tripped
            last = self.interface.stopping(self._command)
            if self.armed and not self._halted:
                try:
                    self._transmit(last)
                except Exception as error:  # whatever fails in the transport is reported
                    said = shown(last, self.interface.command_units)
                    self._tripped += f"; {said} could not be sent ({type(error).__name__}: {error})"
                self._keep(last)
            self._halted, self._command = True, last

    def _fault(self, why: str) -> NoReturn:
        if not self._tripped:
            self._halt(why)
        raise HardwareFault(self._tripped)

    def _wait(self, until: float) -> None:
        while (left := until - clock.monotonic()) > 0:
            clock.sleep(left - NEAR if left > 2 * NEAR else min(left, NEAR / 4))

    def _watched(self) -> None:
        """Holds the start's command until the run begins; then stops it where the controller does not come back.

        Either way it looks who else is on the wire.
        """
        try:
            self._watch_over()
        except Exception as error:  # nobody would watch any more
            self._halt(f"the watch over the robot failed ({type(error).__name__}: {error})")

    def _watch_over(self) -> None:
        dt, looked = self._spec.control_dt, clock.monotonic()
        self._beat = fresh = looked
        allowed = (self.settings.safety.misses + 0.5) * dt
        paused = max(PAUSED * self.settings.safety.stale, 2.5 * dt)
        while not self._stop.wait(dt / 2 if self._begun and not self._halted else dt):
            if self._halted:
                # Who hangs never closes; one message may be lost.
                if self.armed:
                    self._transmit(self.interface.stopping(self._command))
                continue
            wrong = ""
            with self._lock:
                now = clock.monotonic()
                if not self._begun:
                    assert self._seen is not None
                    if now - self._beat > paused:
                        # This process stood still, the device may have stopped, and what waits came long ago.
                        self._command = self.interface.stopping(self._command)
                        self._wire.take()
                        self._resync, fresh = True, now + self.settings.safety.stale
                        self._pauses += 1
                    self._beat = now
                    if not np.array_equal(self._command, self._target):
                        self._held_since = now
                    self._command = self.guard.limited(self._target, self._command, dt, self._approach)
                    self._send(self._command)
                    wrong = self._taken() or (self.guard.stale(self._seen, now) if now > fresh else "")
                    if self._pauses > MOST_PAUSES:
                        wrong = f"this process stood still {self._pauses} times before the run began"
                elif now > self._due + allowed:
                    wrong = (
                        f"the controller has not answered for {now - self._due + dt:.3g} s, expected a command every "
                        f"{dt * 1e3:.3g} ms"
                    )
            if not wrong and now > looked + LOOKS:
                looked, wrong = now, self._wire.trouble()
                if self.armed and not wrong and not self._wire.listeners():
                    wrong = self._deaf()
            if wrong:
                self._halt(wrong)

    def _heed_signals(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return

        def interrupted(number: int, frame: FrameType | None) -> None:
            if self._closing:  # on its way out already
                return
            self._fault(f"the process was asked to end ({signal.Signals(number).name})")

        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                number = getattr(signal, name)
                self._previous_signals[number] = signal.signal(number, interrupted)
