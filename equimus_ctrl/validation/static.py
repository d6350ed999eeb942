"""Poses at rest: forces from the Euler–Lagrange statics, resting angles from MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import place
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array
from equimus_ctrl.validation.engines import BLOCK, NativeBatch, Progress, mujoco_equilibrium, silent
from equimus_ctrl.validation.experiment import Experiment, any_force
from equimus_ctrl.validation.plan import Errors
from equimus_ctrl.validation.poses import holding_pressure, slowest_rate, workspace
from equimus_ctrl.validation.reference import integrate

DISPLACED = (0.01, 0.03)
"""How far from the pose each joint starts, towards the middle of the workspace [rad]."""

RESTING = 3e-6
"""A run is at rest when what it still has to go, by its speed and the slowest rate, is less [rad]."""

SLOWEST = 0.1
"""Poses that are returned to more slowly than this [1/s] count as unstable."""

LONGEST = 120.0
"""No run is waited for longer [s]."""

FAR = 0.01
"""An error above this [rad] makes the exact model say whether the run left the pose's basin."""


@dataclass(frozen=True, eq=False)
class StaticResult:
    """Resting angles against the poses that were asked for.

    Attributes:
        poses: (n, nj) those that forces can hold [rad].
        pressure: (n, na) that hold them, of any sign and size [Pa].
        resting: (n, nj) MuJoCo's resting angles [rad]; NaN where it has none.
        simulated: (n,) found by simulating until at rest; the others by Newton's method on MuJoCo's accelerations,
            for a simulation leaves an unstable pose.
        scored: (n,) False where the exact model, started at the same place, rests elsewhere too.
        drawn: how many poses were drawn.
        moving: the most any simulated run still had to go when it was read [rad].
        simulated_time: of all runs together [s].
    """

    poses: Array
    pressure: Array
    resting: Array
    simulated: NDArray[np.bool_]
    scored: NDArray[np.bool_]
    drawn: int
    moving: float
    simulated_time: float

    @property
    def error(self) -> Array:
        """(n, nj) resting angle less pose [rad]."""
        return self.resting - self.poses

    @property
    def errors(self) -> Errors:
        """Over all scored poses."""
        return Errors.of(self.error[self.scored][:, None, :])

    @property
    def counts(self) -> dict[str, int]:
        """What became of the poses drawn."""
        return {
            "drawn": self.drawn,
            "scored": int(self.scored.sum()),
            "not_held_by_any_forces": self.drawn - len(self.poses),
            "unstable_by_newton": int((~self.simulated & self.scored).sum()),
            "left_the_basin": int((~self.scored).sum()),
        }

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        return {
            **self.errors.to_dict(),
            "counts": self.counts,
            "still_moving_rad": self.moving,
            "pressure_range_pa": [float(self.pressure.min()), float(self.pressure.max())],
            "simulated_s": self.simulated_time,
        }


def static_case(
    morphology: Morphology,
    count: int,
    rng: np.random.Generator,
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> StaticResult:
    """Random poses held by forces, and where MuJoCo comes to rest under the same forces.

    A pose that is stable is approached from a little beside it, so that an engine that does not move cannot pass.

    Args:
        morphology: the robot; its command range is ignored, for the published verification drives forces.
        count: how many poses.
        rng: where poses come from.
        threads: at most.
        progress: called with the share done.

    Raises:
        ConfigError: where the actuators can hold none of the poses.
    """
    low, high = workspace(morphology)
    nj = len(low)
    drawn = rng.uniform(low, high, (count, nj))
    away = rng.uniform(*DISPLACED, (count, nj)) * np.where(drawn < (low + high) / 2, 1.0, -1.0)
    pressure, left = holding_pressure(morphology, drawn)
    held = left < 1e-9
    if not held.any():
        raise ConfigError(
            f"{morphology.name}: none of {count} random poses can be held by its {len(morphology.actuators)} actuators "
            f"on {nj} joints, so there is nothing to validate; an actuator for each joint would do"
        )
    poses, away, pressure = drawn[held], away[held], pressure[held]
    area = np.array([a.area for a in morphology.actuators])
    rate = -slowest_rate(morphology, poses, area * pressure)
    stable = rate > SLOWEST
    robot = any_force(morphology)
    batch = MujocoBatch(robot, "swing", FAST_SETTINGS, threads)
    resting = np.full_like(poses, np.nan)
    moving, spent = 0.0, 0.0
    order = np.flatnonzero(stable)[np.argsort(-rate[stable], kind="stable")]
    for first in range(0, len(order), BLOCK):
        rows = order[first : first + BLOCK]
        resting[rows], still, time = _settle(batch, (poses + away)[rows], pressure[rows], rate[rows])
        moving, spent = max(moving, still), spent + time
        settled = order[: first + len(rows)]
        error = Errors.of((resting - poses)[settled][:, None, :])
        progress(len(settled) / len(poses), float(error.rmse.max()))
    kinematics = Kinematics(robot)
    for i in np.flatnonzero(~stable):
        data = mujoco.MjData(batch.mujoco_model)
        place(batch.mujoco_model, data, kinematics, poses[i])
        if mujoco_equilibrium(batch, data, pressure[i]) < math.inf:
            resting[i] = [data.joint(name).qpos[0] for name in robot.joint_names]
    scored = np.ones(len(poses), dtype=bool)
    for i in np.flatnonzero(stable & ~(np.abs(resting - poses).max(axis=1) < FAR)):
        scored[i] = not _rests_elsewhere(robot, poses[i], (poses + away)[i], pressure[i], rate[i])
    progress(1.0)
    return StaticResult(poses, pressure, resting, stable, scored, count, moving, spent)


def _settle(batch: MujocoBatch, start: Array, pressure: Array, rate: Array) -> tuple[Array, float, float]:
    """Resting angles (n, nj), what the last had to go [rad], and the time simulated [s]."""
    dt = batch.settings.timestep
    wait = min(math.log(DISPLACED[1] / RESTING) / float(rate.min()), LONGEST)
    q, v = start, np.zeros_like(start)
    waited = 0.0
    while True:
        steps = round(wait / dt)
        angles, speeds = batch.run(q, v, np.repeat(pressure[:, None], steps, axis=1))
        waited += steps * dt
        q, v = angles[:, -1], speeds[:, -1]
        to_go = float(np.nanmax(np.abs(v).max(axis=1) / rate)) if np.isfinite(v).any() else 0.0
        if to_go < RESTING or waited >= LONGEST or not np.isfinite(q).all():
            return q, to_go, waited * len(start)
        wait = min(wait, LONGEST - waited) / 2


def _rests_elsewhere(robot: Morphology, pose: Array, start: Array, pressure: Array, rate: float) -> bool:
    """Whether the exact model, let go at ``start``, does not come to rest at ``pose``."""
    duration = math.ceil(min(math.log(10 / FAR) / rate, LONGEST))
    run = Experiment((robot,), "swing", start[None], np.zeros(1), pressure[None, None], float(duration))
    q, _ = integrate(run, rtol=1e-8, atol=1e-10)
    return not np.abs(q[0, -1] - pose).max() < FAR


def native_static(
    result: StaticResult, morphology: Morphology, count: int, threads: int | None = None, duration: float = 4.0
) -> Errors:
    """The baseline's errors on the first ``count`` scored poses, ``duration`` [s] after it was let go at them."""
    rows = np.flatnonzero(result.scored)[:count]
    poses = result.poses[rows]
    batch = NativeBatch(any_force(morphology), "swing", FAST_SETTINGS, threads)
    steps = round(duration / FAST_SETTINGS.timestep)
    q, _ = batch.run(poses, np.zeros_like(poses), np.repeat(result.pressure[rows][:, None], steps, axis=1))
    return Errors.of((q[:, -1] - poses)[:, None, :])
