"""Closed loops on the reduced engine: the PID on robots with any effects, many of them side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.inverse import Inverse
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect, force_laws
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, sensor_settings, shown
from equimus_ctrl.effects.valves import shaped_commands, shaping_laws
from equimus_ctrl.engines import compiled, lane_equations
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, structure
from equimus_ctrl.scenarios.references import SampledReference
from equimus_ctrl.tuning import loop_kernel
from equimus_ctrl.tuning.ensemble import Member
from equimus_ctrl.types import Array


class Course(Protocol):
    """What robots are to follow, and how they are seen doing it."""

    @property
    def reference(self) -> Array:
        """(n, nj) at each control instant [rad]."""
        ...

    @property
    def noise(self) -> Array:
        """(n, nj) of the measurements [rad]."""
        ...

    @property
    def command_before(self) -> Array:
        """(na,) in force before the start [Pa]."""
        ...

    @property
    def control_dt(self) -> float:
        """Control period [s]."""
        ...


@dataclass(frozen=True, eq=False)
class Plan:
    """What a controller that knows the inverse of a model does along a course, whatever its gains.

    Attributes:
        shown: (n, nj) its reference, as sensors show it [rad].
        late: (n, nj) the same of a robot whose commands act as late as may be [rad].
        command: (n, na) what it feeds forward [Pa].
        surplus: (na,) see ``pid_kernel.pid_start`` [Pa].
        low: (na,) lowest command of any use [Pa].
        high: (na,) highest [Pa].
    """

    shown: Array
    late: Array
    command: Array
    surplus: Array
    low: Array
    high: Array


def make_plan(
    model: Model, course: Course, robot: Member, position: Array, start_time: float, late_start: float
) -> Plan:
    """The plan for a robot that begins somewhere.

    Args:
        model: what the controller knows.
        course: what is to be followed.
        robot: what is driven.
        position: (nj,) its pose at the start [rad].
        start_time: see ``PidSettings`` [s].
        late_start: likewise [s].
    """
    inverse = Inverse(model, course.control_dt, start_time)
    sensor = sensor_settings(robot.effects, model.morphology.joint_names)
    begun = inverse.start(0.0, shown(sensor, position) + course.noise[0])
    times = np.asarray(np.arange(len(course.reference)) * course.control_dt, dtype=np.float64)
    reference = SampledReference(times, course.reference)
    seen, command, _ = inverse.follow(reference, times, times, begun)
    late, _ = inverse.later(reference, times, begun, late_start)
    return Plan(seen, late, command, inverse.surplus(begun, course.command_before), inverse.low, inverse.high)


@dataclass(frozen=True, eq=False)
class Loop:
    """One closed loop.

    Attributes:
        settings: of the PID.
        robot: the leg.
        position: (nj,) its pose at the start [rad].
        plan: of a controller that knows an inverse.
    """

    settings: PidSettings
    robot: Member
    position: Array
    plan: Plan | None = None

    def kind(self) -> tuple[object, ...]:
        """What loops that run side by side have in common."""
        s = self.settings
        return s.space, s.feedforward, s.start_time, s.late_start, self.plan is not None, self.robot.effects


@dataclass(frozen=True, eq=False)
class Tracked:
    """What became of a loop.

    Attributes:
        position: (n, nj) true angles at each control instant [rad].
        command: (n, na) from each control instant on [Pa].
        sound: n where all is well, else the control step in which the simulation diverged.
    """

    position: Array
    command: Array
    sound: int


def laws_of(effects: Sequence[Effect]) -> Laws:
    """Force laws that the equations have: none without force effects, else all of them, so that few are generated."""
    return force_laws() if any(isinstance(effect, ForceEffect) for effect in effects) else ()


def kernel_of(nominal: Morphology, phase: Phase) -> ModuleType:
    """The compiled closed loop, see ``tuning.loop_kernel``."""
    return compiled.load(nominal, phase, loop_kernel)


def lanes_of(nominal: Morphology, phase: Phase, effects: Sequence[Effect]) -> lane_equations.Lanes:
    """The compiled equations of motion of robots with these effects."""
    return lane_equations.load_lanes(structure(nominal), phase, laws_of(effects))


def compile_motion(nominal: Morphology, phase: Phase, effects: Sequence[Effect]) -> None:
    """Compile what moves robots with these effects, or load it from the cache."""
    lanes, drive = lanes_of(nominal, phase, effects), np.zeros((2, len(nominal.actuators) * LANES))
    kernel_of(nominal, phase).step_lanes(lanes.robot, lanes.work(), drive, 1e-3, np.empty(0, dtype=np.int64))


@lru_cache(maxsize=16)
def _effect_parameters(
    nominal: Morphology, phase: Phase, laws: Laws, effects: tuple[Effect, ...]
) -> tuple[Array, NDArray[np.int64]]:
    """What follows the robot's own parameters in its parameter vector, and the rows of dry friction in use."""
    m = augmented_model(structure(nominal), phase, laws)
    names = {"joint": nominal.joint_names, "actuator": nominal.actuator_names}
    own = np.array(law_parameters(m.slots, effects, *names.values()), dtype=np.float64)
    rubbed = {e.location for e in effects if e.dry}
    rows = [r for r, (kind, i) in enumerate(m.rubbing) if names[kind][i] in rubbed]
    return own, np.array(rows, dtype=np.int64)


def track(nominal: Morphology, phase: Phase, course: Course, loops: Sequence[Loop], steps: int) -> list[Tracked]:
    """Every loop along a course.

    Args:
        nominal: the robot that the controllers compute with.
        phase: base fixed or foot pinned.
        course: what is to be followed.
        loops: any number; what one does depends on no other.
        steps: physics steps in each control period.
    """
    found = []
    for _, alike in groupby(loops, key=Loop.kind):
        own = list(alike)
        for first in range(0, len(own), LANES):
            found += _track_block(nominal, phase, course, own[first : first + LANES], steps)
    return found


def _track_block(nominal: Morphology, phase: Phase, course: Course, loops: Sequence[Loop], steps: int) -> list[Tracked]:
    settings, effects = loops[0].settings, loops[0].robot.effects
    actuators, (n, nj), k = nominal.actuator_names, course.reference.shape, len(loops)
    na = len(actuators)
    kernel, robot = kernel_of(nominal, phase), lanes_of(nominal, phase, effects).robot
    effect_parameters, rubbing = _effect_parameters(nominal, phase, laws_of(effects), effects)
    position = np.array([loop.position for loop in loops])
    sensor = np.tile(sensor_settings(effects, nominal.joint_names), (k, 1, 1))
    dt = course.control_dt / steps
    remembers = bool(np.any(sensor[:, :, [SENSOR_DELAY, PLAY]] > 0))
    past = np.zeros((k, nj, int(np.ceil(sensor[:, :, SENSOR_DELAY].max() / dt)) + 3 if remembers else 1, 2))
    past[:, :, 0, 0] = position
    before = np.array(course.command_before)
    reached_before = shaped_commands(effects, actuators, before[None])[0]
    shaping = shaping_laws(effects, actuators)
    plans = [loop.plan for loop in loops if loop.plan is not None]
    low, high = np.full(na, nominal.command_low), np.full(na, nominal.command_high)
    for plan in plans[:1]:
        low, high = np.maximum(low, plan.low), np.minimum(high, plan.high)
    q, command, reaches = np.zeros((k, n, nj)), np.zeros((k, n, na)), np.zeros((k, na, n))
    sound = np.full(k, n)
    parameters = np.array([np.append(loop.robot.parameters, effect_parameters) for loop in loops])
    gains = np.array([loop.settings.gain_matrix(loop.settings.channels(nominal)) for loop in loops])
    state = (
        kernel.start_lanes(robot, parameters, position, reached_before),
        compiled.prepared(nominal, phase),
        np.array([loop.robot.valve for loop in loops]),
        sensor,
        np.empty((0, 3)) if shaping is None else shaping,
        gains,
        settings.space == "length",
        settings.feedforward,
        float(settings.start_time),
        float(settings.late_start),
        np.arange(n) * course.control_dt,
        course.reference,
        np.array([plan.shown for plan in plans]).reshape(k, -1, nj),
        np.array([plan.late for plan in plans]).reshape(k, -1, nj),
        np.array([plan.command for plan in plans]).reshape(k, -1, na),
        np.array([plan.surplus for plan in plans]).reshape(-1, na),
        course.noise,
        before,
        reached_before,
        low,
        high,
        course.control_dt,
        steps,
        rubbing,
        np.tile(reached_before, (k, 1)),
        np.full((k, na), -1),
        np.empty((k, 3, gains.shape[2])),
        np.empty((k, nj)),
        past,
        position.copy(),
        q,
        command,
        reaches,
        sound,
    )
    if shaping is not None:
        kernel.run_loop(robot, 0, n + 1, *state)
    else:
        # A law that is Python alone cannot be called from within.
        for now in range(n + 1):
            kernel.run_loop(robot, now, now + 1, *state)
            if now < n:
                reaches[:, :, now] = shaped_commands(effects, actuators, command[:, now].copy())
    return [Tracked(*ended) for ended in zip(q, command, map(int, sound), strict=True)]
