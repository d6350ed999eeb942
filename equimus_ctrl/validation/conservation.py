"""What motion must keep: energy, angular momentum, and the balance of work.

Energy where nothing is lost, angular momentum where nothing acts from outside, and what drives give against what is
stored and lost elsewhere; all evaluated on the engines' motion with the exact model's energies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.engines.batch import STEP, simulate
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array
from equimus_ctrl.validation.engines import Progress, finer, silent
from equimus_ctrl.validation.experiment import undamped
from equimus_ctrl.validation.generator import FLOATING, hanging, random_robot
from equimus_ctrl.validation.plan import Plan
from equimus_ctrl.validation.poses import holding_pressure, workspace
from equimus_ctrl.validation.reference import evaluate
from equimus_ctrl.validation.robots import robot_factor

SWING_OUT = 0.3
"""How far from rest the undamped robot is let go [rad]."""

DIFFERENCES = np.array([672.0, -168.0, 32.0, -3.0]) / 840.0
"""Central differences of order eight."""


@dataclass(frozen=True, eq=False)
class Drift:
    """How something that should stay the same does not, in one engine.

    Attributes:
        time: (n,) [s].
        drift: (n,) departure from the first value as a share of ``scale``.
        step: of the engine [s].
        scale: what departures are compared with, SI units.
    """

    time: Array
    drift: Array
    step: float
    scale: float

    @property
    def largest(self) -> float:
        """The largest departure."""
        return float(np.abs(self.drift).max())

    def to_dict(self) -> dict[str, float]:
        """Plain JSON types."""
        return {"largest_relative": self.largest, "step_s": self.step, "scale": self.scale}


@dataclass(frozen=True, eq=False)
class ConservationResult:
    """Quantity → engine → drift.

    Attributes:
        energy: kinetic, potential and that of the constant drive forces, without damping; per largest kinetic energy.
        momentum: about the first pivot, of a robot that nothing else touches and nothing pulls down; per its own size.
        work: stored less what the drives gave plus what damping took; per the work exchanged.
    """

    energy: dict[str, Drift]
    momentum: dict[str, Drift]
    work: dict[str, Drift]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        parts = {"energy": self.energy, "momentum": self.momentum, "work": self.work}
        return {key: {name: drift.to_dict() for name, drift in value.items()} for key, value in parts.items()}


@dataclass(frozen=True, eq=False)
class _Motion:
    time: Array  # (n,)
    q: Array  # (n, nj)
    v: Array  # (n, nj)
    step: float


def conservation_case(
    morphology: Morphology,
    plan: Plan,
    rng: np.random.Generator,
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> ConservationResult:
    """The three balances in both engines.

    The reduced engine runs at its default step and gives angles alone; its velocities are differences of order eight.

    Args:
        morphology: whose energy and work are balanced.
        plan: how long.
        rng: where the robot of the angular momentum comes from.
        threads: at most.
        progress: called with the share done.
    """
    low, high = workspace(morphology)
    middle = (low + high) / 2
    pressure = np.clip(
        holding_pressure(morphology, middle[None])[0][0], morphology.command_low, morphology.command_high
    )
    still = np.zeros_like(middle)

    lossless = undamped(morphology)
    energy = {}
    for name, motion in _motions(lossless, middle + SWING_OUT, still, pressure, plan.conserving, threads):
        total, kinetic = _energy(lossless, motion, pressure)
        energy[name] = _drift(motion, total, float(kinetic.max()))
    progress(0.5)

    floating = replace(random_robot(FLOATING, rng, "floating"), gravity=0.0)
    root = replace(floating.joints[0], damping=0.0)
    floating = replace(floating, joints=(root, *floating.joints[1:]))
    turning = np.zeros(len(floating.joints))
    turning[0] = 2.0
    drive = 0.3 * np.full(len(floating.actuators), floating.command_high)
    momentum = {}
    duration = plan.conserving / 4
    slower = robot_factor(floating, FAST_SETTINGS.timestep)
    start = hanging(floating) + 0.2
    for name, motion in _motions(floating, start, turning, drive, duration, threads, slower, plan.more_kernels):
        about = evaluate("momentum", floating, motion.q, motion.v)[0][:, 0]
        momentum[name] = _drift(motion, about, float(abs(about[0])))
    progress(0.75)

    free = morphology.without_stops()
    work = {}
    for name, motion in _motions(free, middle + SWING_OUT, still, pressure / 2, duration, threads):
        stored, _ = _energy(free, motion, pressure / 2)
        lost = _lost(free, motion, pressure / 2)
        work[name] = _drift(motion, stored + lost, float(lost[-1]))
    progress(1.0)
    return ConservationResult(energy, momentum, work)


def _motions(
    morphology: Morphology,
    start: Array,
    speed: Array,
    pressure: Array,
    duration: float,
    threads: int | None,
    factor: int = 1,
    reduced: bool = True,
) -> list[tuple[str, _Motion]]:
    """(engine, motion) under constant pressures, on each engine's own steps."""
    settings = finer(factor)
    dt = settings.timestep
    steps = round(duration / dt)
    held = np.broadcast_to(pressure, (1, steps, len(pressure)))
    q, v = MujocoBatch(morphology, "swing", settings, threads).run(start[None], speed[None], held)
    found = [("mujoco", _Motion(np.arange(steps + 1, dtype=np.float64) * dt, q[0], v[0], dt))]
    if not reduced:
        return found
    times = np.arange(round(duration / STEP) + 1, dtype=np.float64) * STEP
    trial = Trial("conserving", np.zeros(1), pressure[None], pressure, 0.0, start, times, speed)
    angles = simulate([Model(morphology)], [trial], dt=STEP, threads=threads)[0].position[0]
    rates = sum(c * (angles[4 + k : len(angles) - 4 + k] - angles[4 - k : len(angles) - 4 - k]) for k, c in _weights())
    inner = slice(4, len(angles) - 4)
    return [*found, ("reduced", _Motion(times[inner], angles[inner], np.asarray(rates) / STEP, STEP))]


def _weights() -> list[tuple[int, float]]:
    return [(k + 1, float(c)) for k, c in enumerate(DIFFERENCES)]


def _energy(morphology: Morphology, motion: _Motion, pressure: Array) -> tuple[Array, Array]:
    """(n,) all energy with that of the constant drive forces, −f·l, and (n,) the kinetic part [J]."""
    kinetic, potential = evaluate("energy", morphology, motion.q, motion.v)
    lengths = evaluate("lengths", morphology, motion.q)[0]
    area = np.array([a.area for a in morphology.actuators])
    return kinetic[:, 0] + potential[:, 0] - lengths @ (area * pressure), kinetic[:, 0]


def _lost(morphology: Morphology, motion: _Motion, pressure: Array) -> Array:
    """(n,) energy that damping took up to each instant [J], by the trapezium rule corrected for the slopes."""
    area = np.array([a.area for a in morphology.actuators])
    force = np.tile(area * pressure, (len(motion.q), 1))
    power, slope = (x[:, 0] for x in evaluate("loss", morphology, motion.q, motion.v, force))
    h = np.diff(motion.time)
    parts = h / 2 * (power[1:] + power[:-1]) + h**2 / 12 * (slope[:-1] - slope[1:])
    return np.concatenate([[0.0], np.cumsum(parts)])


def _drift(motion: _Motion, values: Array, scale: float) -> Drift:
    return Drift(motion.time, (values - values[0]) / scale, motion.step, scale)
