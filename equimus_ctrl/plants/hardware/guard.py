"""What is never done to a robot, and when to stop: limits on commands, and faults of measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.plants.hardware.clock import ClockMap
from equimus_ctrl.plants.hardware.interface import Interface
from equimus_ctrl.plants.hardware.settings import Safety
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.types import Array, PlantSpec


@dataclass(frozen=True, eq=False)
class Measurements:
    """What the measurements say so far.

    Attributes:
        clock: of the device.
        position: (nj,) latest positions [rad or m].
        stamp: when they were measured, by this computer's clock [s].
        device_stamp: the same by the device's own [s].
        source: who sent it.
        samples: that counted.
        ignored: that had come before, or came too late for their order.
    """

    clock: ClockMap
    position: Array
    stamp: float
    device_stamp: float
    source: int
    samples: int = 1
    ignored: int = 0


class Guard:
    """Judges samples and limits commands of one robot.

    Args:
        spec: of the robot.
        safety: what is enforced.
        interface: what that comes to for this robot.
    """

    def __init__(self, spec: PlantSpec, safety: Safety, interface: Interface) -> None:
        self.safety, self.interface, self._joints = safety, interface, spec.joints
        self._calibrations = interface.calibrations
        self._low, self._high = spec.joint_low - interface.margin, spec.joint_high + interface.margin
        self.command_low, self.command_high = interface.command_low, interface.command_high

    def angles(self, sample: Sample) -> Array | str:
        """(nj,) positions of a sample [rad or m], or why there are none."""
        found = []
        for own in self._calibrations:
            if own.name not in sample.names:
                names = ", ".join(sample.names) or "no joint"
                return f"a sample names {names}, expected {', '.join(c.name for c in self._calibrations)}"
            place = sample.names.index(own.name)
            if place >= len(sample.position):
                return f"a sample names {len(sample.names)} joints, but has {len(sample.position)} positions"
            found.append(own.scale * (sample.position[place] - own.zero))
        return np.array(found)

    def first(self, sample: Sample) -> Measurements | str:
        """What a first sample says, or what is wrong with it."""
        angles = self.angles(sample)
        if isinstance(angles, str):
            return angles
        clock = ClockMap.of(sample.stamp, sample.received)
        seen = Measurements(clock, angles, clock.local(sample.stamp), sample.stamp, sample.source)
        return self._wrong(angles) or seen

    def next(self, seen: Measurements, sample: Sample) -> Measurements | str:
        """What is known with one more sample, or the fault that it shows."""
        if sample.source != seen.source:
            return "measurements come from another publisher than before, expected one alone"
        if sample.stamp <= seen.device_stamp:
            return replace(seen, ignored=seen.ignored + 1)
        lateness = seen.clock.lateness(sample.stamp, sample.received)
        if abs(lateness) > self.safety.clock:
            side = "behind" if lateness > 0 else "ahead of"
            return (
                f"a sample's stamp is {abs(lateness):.3g} s {side} its arrival, expected at most "
                f"{self.safety.clock:g} s: the device's clock has jumped, or the network was held up"
            )
        angles = self.angles(sample)
        if isinstance(angles, str):
            return angles
        if wrong := self._wrong(angles):
            return wrong
        span = sample.stamp - seen.device_stamp
        own = self.interface
        for j in np.flatnonzero(np.abs(angles - seen.position) > own.noise + own.speed * span):
            unit = own.joint_units[j]
            return (
                f"{self._joints[j]} jumped from {seen.position[j]:.3f} to {angles[j]:.3f} {unit} in {span * 1e3:.3g} "
                f"ms, expected at most {own.speed[j]:g} {unit}/s"
            )
        clock = seen.clock.seen(sample.stamp, sample.received)
        return Measurements(
            clock, angles, clock.local(sample.stamp), sample.stamp, sample.source, seen.samples + 1, seen.ignored
        )  # fmt: skip

    def stale(self, seen: Measurements, now: float) -> str:
        """That nothing was measured for too long, in words; empty where it was."""
        age = now - seen.stamp
        if age <= self.safety.stale:
            return ""
        return f"the latest measurement is {age:.3g} s old, expected one at least every {self.safety.stale:g} s"

    def limited(self, asked: Array, before: Array, span: float, slew: Array | None = None) -> Array:
        """(na,) the command nearest to what is asked for within all limits, so long [s] after the one before.

        Args:
            asked: (na,) for.
            before: (na,) the one before.
            span: since then [s].
            slew: (na,) in place of the robot's own, where that is less [unit of the commands over s].
        """
        reach = (self.interface.slew if slew is None else slew) * span
        return np.clip(np.clip(asked, before - reach, before + reach), self.command_low, self.command_high)

    def _wrong(self, angles: Array) -> str:
        ends = zip(self._joints, angles, self._low, self._high, self.interface.joint_units, strict=True)
        for name, angle, low, high, unit in ends:
            if not np.isfinite(angle):
                return f"{name} was measured as {angle}, expected a number"
            if not low <= angle <= high:
                return f"{name} is at {angle:.3f} {unit}, expected {low:.3f} to {high:.3f} {unit}"
        return ""
