"""Effects between a joint's angle and what is measured of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from equimus_ctrl.effects.base import Effect, parameter, register
from equimus_ctrl.effects.description import Description
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.effects.sizes import Share, Size
from equimus_ctrl.types import Array

OFFSET, SCALE, SENSOR_DELAY, PLAY = 0, 1, 2, 3
"""A joint's sensor (4,): offset [rad], scale, delay [s] and play [rad]; of a slide with m in the place of rad."""
STOOD, WENT_ON, SPED_UP = 0, 1, 2
"""How a joint moved before a start: not at all, as fast as there, or as it goes on from there."""


@dataclass(frozen=True)
class SensorEffect(Effect):
    """An effect that is a setting of a joint's sensor."""

    side = "measurement"
    simulated = True
    sits_at = ("joint",)
    robots = ("elastic", "mjcf")

    def apply(self, sensor: Array) -> None:
        """Write this effect into its joint's row (4,), see ``OFFSET``."""
        raise NotImplementedError


@register
@dataclass(frozen=True)
class SensorOffset(SensorEffect):
    """y = q + offset."""

    name = "sensor_offset"
    summary = "the measured angle is off by a constant"
    mjcf_lacks = "MuJoCo's sensors have no offset"
    exclusive = "sensor_offset"
    leg_sizes = (
        Size(
            "offset", 0.01, 0.25, "a marker that sits 0.6° to 14° off; rest lengths take up most of it", "either sign"
        ),
    )
    mjcf_sizes = (Share("offset", 0.002, 0.1, "either sign"),)
    offset: float = parameter("rad", -3.2, 3.2, "added to the angle")

    def apply(self, sensor: Array) -> None:
        sensor[OFFSET] = self.offset

    @classmethod
    def sentence(cls, t: Description) -> str:
        too = "much" if t.value("offset") > 0 else "little"
        size = t.scaled("offset", t.unit("offset"), math.copysign(1.0, t.value("offset")))
        return f"The measured {t.noun} of {t.the} is {size} too {too}: a sensor's offset."


@register
@dataclass(frozen=True)
class SensorScale(SensorEffect):
    """y = scale·q, before any offset."""

    name = "sensor_scale"
    summary = "the measured angle is off by a factor"
    mjcf_form = "a `tendonpos` sensor of a fixed `tendon` over the joint, its coefficient the factor"
    nothing = 1.0
    exclusive = "sensor_scale"
    leg_sizes = (Size("scale", 0.008, 0.15, "a wrong gear or encoder resolution", "about one"),)
    leg_alike = True
    mjcf_sizes = (Share("scale", 0.003, 0.2, "about one"),)
    scale: float = parameter("1", 0.1, 10.0, "factor on the angle")

    @classmethod
    def guesses(cls, excitation: Excitation) -> list[dict[str, float]]:
        return [{"scale": scale} for scale in (0.98, 1.02, 0.9, 1.1)]

    def apply(self, sensor: Array) -> None:
        sensor[SCALE] = self.scale

    def write_mjcf(self, draft: Draft) -> str:
        return ""  # as the coefficient of a tendon that a sensor shows

    @classmethod
    def sentence(cls, t: Description) -> str:
        too = "much" if t.value("scale") > 1 else "little"
        size = t.scaled("scale", "%", math.copysign(100.0, t.value("scale") - 1), 1.0)
        return f"The measured {t.noun} of {t.the} is {size} too {too}: a sensor's scale."


@register
@dataclass(frozen=True)
class SensorDelay(SensorEffect):
    """y(t) = q(t − delay)."""

    name = "sensor_delay"
    summary = "the measurement is older than its time stamp"
    mjcf_form = "`delay` of a `jointpos` sensor, from one step on"
    delays = True
    exclusive = "sensor_delay"
    leg_sizes = (Size("delay", 0.004, 0.1, "half a sample to a slow camera pipeline"),)
    leg_alike = True
    mjcf_sizes = (Share("delay", 0.005, 0.2),)
    delay: float = parameter("s", 0.0, 2.0, "age of what is measured")

    def apply(self, sensor: Array) -> None:
        sensor[SENSOR_DELAY] = self.delay

    def write_mjcf(self, draft: Draft) -> str:
        return ""  # as the delay of a sensor of its joint

    @classmethod
    def sentence(cls, t: Description) -> str:
        return f"The measured {t.noun} of {t.the} is {t['delay']} older than its time stamp: a sensor's delay."


@register
@dataclass(frozen=True)
class Backlash(SensorEffect):
    """Play between joint and sensor: y follows q only where it would lag by more than half of ``play``."""

    name = "backlash"
    summary = "play between joint and sensor"
    mjcf_lacks = "MuJoCo's sensors have no play"
    in_torques = False
    exclusive = "backlash"
    leg_sizes = (Size("play", 2e-3, 0.06, "the noise to thirty times as much"),)
    leg_alike = True
    mjcf_sizes = (Share("play", 0.001, 0.05),)
    play: float = parameter("rad", 0.0, 1.0, "angle the joint can turn without the sensor")

    def apply(self, sensor: Array) -> None:
        sensor[PLAY] = self.play

    @classmethod
    def sentence(cls, t: Description) -> str:
        sensor = t.one_or("its sensor", "their sensors")
        return f"Between {t.the} and {sensor} there is a play of {t['play']}."


def sensor_settings(effects: Sequence[Effect], joints: Sequence[str]) -> Array:
    """(nj, 4) of each joint's sensor, see ``OFFSET``."""
    sensor = np.zeros((len(joints), 4))
    sensor[:, SCALE] = 1.0
    for effect in effects:
        if isinstance(effect, SensorEffect):
            effect.apply(sensor[list(joints).index(effect.location)])
    return sensor


def _reading(offset: Any, scale: Any, angle: Any) -> Any:
    return offset + scale * angle


_compiled_reading = njit(cache=True, nogil=True, error_model="numpy")(_reading)


@njit(cache=True, nogil=True, error_model="numpy")
def read(sensor: Array, angle: float) -> float:
    """What a joint's sensor (4,) shows of its angle once it has caught up [rad]."""
    value: float = _compiled_reading(sensor[OFFSET], sensor[SCALE], angle)
    return value


def shown(sensor: Array, angles: Array) -> Array:
    """(…, nj) what sensors (nj, 4) show of angles (…, nj) once they have caught up [rad]."""
    return np.asarray(_reading(sensor[:, OFFSET], sensor[:, SCALE], angles))


def ahead(sensor: Array, direction: Array) -> Array:
    """(…) how far joints that move in a direction (…) of ±1 are ahead of what sensors (…, 4) show, by play alone [rad].

    A joint that moves is at the end of the play.
    """
    return np.asarray(0.5 * sensor[..., PLAY] * direction)


def behind(sensor: Array, measured: Array) -> Array:
    """(…, nj) the angles of which sensors (…, nj, 4) show what is measured (…, nj), at rest [rad]."""
    return np.asarray((measured - sensor[..., OFFSET]) / sensor[..., SCALE])


@njit(cache=True, nogil=True, error_model="numpy")
def hermite(x0: float, v0: float, x1: float, v1: float, dt: float, share: float) -> float:
    """Cubic through both ends and their slopes, at a share of the step."""
    s2 = share * share
    s3 = s2 * share
    return (
        (2.0 * s3 - 3.0 * s2 + 1.0) * x0
        + (s3 - 2.0 * s2 + share) * dt * v0
        + (3.0 * s2 - 2.0 * s3) * x1
        + (s3 - s2) * dt * v1
    )


@njit(cache=True, nogil=True, error_model="numpy")
def earlier(x: float, v: float, faster: float, time: float) -> float:
    """Where a joint was a time < 0 before it was at x with the rate v, which grew by ``faster`` [1/s²]."""
    return x + time * (v + 0.5 * faster * time)


@njit(cache=True, nogil=True, error_model="numpy")
def hermite_rate(x0: float, v0: float, x1: float, v1: float, dt: float, share: float) -> float:
    """The slope of ``hermite`` there."""
    s2 = share * share
    return 6.0 * (s2 - share) * (x0 - x1) / dt + (3.0 * s2 - 4.0 * share + 1.0) * v0 + (3.0 * s2 - 2.0 * share) * v1


@njit(cache=True, nogil=True, error_model="numpy")
def inner(q: Array, v: Array, start: float, dt: float, times: Array, position: Array, rate: Array) -> None:
    """Where a joint is and how fast it moves at given times of a motion on a grid, whatever its sensor shows.

    Args:
        q: (n,) positions on the grid [rad or m].
        v: (n,) their rates [rad/s or m/s].
        start: of the grid [s].
        dt: of the grid [s].
        times: (m,) none before the grid, none beyond [s].
        position: (m,) written [rad or m].
        rate: (m,) written [rad/s or m/s].
    """
    for k in range(len(times)):
        place = max((times[k] - start) / dt, 0.0)
        step = min(int(place), len(q) - 2)
        share = place - step
        position[k] = hermite(q[step], v[step], q[step + 1], v[step + 1], dt, share)
        rate[k] = hermite_rate(q[step], v[step], q[step + 1], v[step + 1], dt, share)


@njit(cache=True, nogil=True, error_model="numpy")
def follow(held: float, angle: float, play: float) -> float:
    """Where a part driven with play is when the driver, having held it at ``held``, is at ``angle`` [rad]."""
    return min(max(held, angle - 0.5 * play), angle + 0.5 * play)


@njit(cache=True, nogil=True, error_model="numpy")
def recall(past: Array, newest: int, age: float, dt: float) -> float:
    """Where a joint was a while ago.

    Args:
        past: (n, 2) its angle [rad] and rate [rad/s] at the last n steps, that of step s at s modulo n.
        newest: the last of them; the first step of all is 0, and before it the joint stood still.
        age: how long ago, in steps.
        dt: of a step [s].
    """
    n = len(past)
    first = max(newest + 1 - n, 0)
    place = newest - age - first
    if place <= 0.0:
        oldest: float = past[first % n, 0]
        return oldest
    step = min(int(place), newest - first - 1)
    before, after = past[(first + step) % n], past[(first + step + 1) % n]
    angle: float = hermite(before[0], before[1], after[0], after[1], dt, place - step)
    return angle


@njit(cache=True, nogil=True, error_model="numpy")
def sample(
    q: Array,
    v: Array,
    start: float,
    dt: float,
    sensor: Array,
    times: Array,
    out: Array,
    before: float = 0.0,
    shown: float = np.nan,
    faster: float = 0.0,
) -> None:
    """What a joint's sensor says at given times of a motion on a grid.

    Args:
        q: (n,) angles on the grid [rad].
        v: (n,) their rates [rad/s].
        start: of the grid [s].
        dt: of the grid [s].
        sensor: (4,), see ``OFFSET``.
        times: (m,) ascending, none beyond the grid [s].
        out: (m,) written [rad].
        before: rate of the joint before the grid [rad/s]; by default it stood still.
        shown: what the sensor showed where the grid begins, as far as play lets it [rad]; nan where nobody knows: then
            the joint is in the middle of the play.
        faster: by how much that rate grew before the grid [rad/s²].
    """
    n, play = len(q), sensor[PLAY]
    held, reached = q[0], 0
    if play > 0.0 and not math.isnan(shown):
        held = (shown - sensor[OFFSET]) / sensor[SCALE]
    for k in range(len(times)):
        place = (times[k] - sensor[SENSOR_DELAY] - start) / dt
        if place <= 0.0:
            angle = earlier(q[0], before, faster, place * dt)
        else:
            step = min(int(place), n - 2)
            angle = hermite(q[step], v[step], q[step + 1], v[step + 1], dt, place - step)
            if play > 0.0:
                while reached < step:
                    reached += 1
                    held = follow(held, q[reached], play)
        if play > 0.0:
            held = follow(held, angle, play)
            angle = held
        out[k] = read(sensor, angle)
