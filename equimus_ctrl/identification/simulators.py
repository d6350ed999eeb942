"""The engines as fits call them: many models, segments and starts at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.engines.batch import Predicted, simulate
from equimus_ctrl.engines.machine import simulate_machines
from equimus_ctrl.engines.predict import behind_sensors
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.machine import Machine
from equimus_ctrl.models.model import Model, machine_of
from equimus_ctrl.types import Array

STEP = 3e-3
"""Physics step of the reduced engine in fits [s], where the robot allows it: an error of 1e-5 rad, or 3e-5 rad with
static friction, a hundredth of what sensors' noise is."""

STEPS_FINER = 4
"""So many of a machine's physics steps take the place of one where its error is looked at."""

Simulator = Callable[[Sequence[Model], Sequence[Segment], Sequence[Array]], list[Predicted]]
"""(models, segments, starts (k, 2 nj) for each segment as the sensors show them) → predictions."""


def reduced_simulator(dt: float | None = None, threads: int | None = None, longest: float = STEP) -> Simulator:
    """The reduced engine.

    Args:
        dt: physics step [s]; by default ``longest``, divided until it follows the first model that is simulated. It
            then stays, so that a search always sees the same discretisation.
        threads: as many as there are cores by default.
        longest: [s].
    """
    chosen: list[float] = []

    def run(models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        if not chosen:
            m = changed_bodies(models[0].effects, models[0].morphology)
            poses = [s.trial.position for s in segments]
            chosen.append(dt or longest / step_divisor(m, models[0].phase, poses, longest, stops=False))
        trials = [s.trial for s in segments]
        true = [behind_sensors(models, rows) for rows in starts]
        return simulate(models, trials, starts=true, dt=chosen[0], threads=threads, check=dt is not None)

    return run


def machine_simulator(dt: float | None = None, threads: int | None = None) -> Simulator:
    """MuJoCo, for machines.

    Args:
        dt: physics step [s]; the MuJoCo model's by default.
        threads: as many as there are cores by default.
    """

    def run(models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        true = [behind_sensors(models, rows) for rows in starts]
        return simulate_machines(models, [s.trial for s in segments], starts=true, dt=dt, threads=threads)

    return run


def stepless_simulator(machine: Machine, threads: int | None = None) -> Simulator:
    """MuJoCo without the error of a machine's physics step, as far as the step and a part of it tell.

    The error of first order goes (Richardson, 1911); that of Runge and Kutta's method is small at a part of the step.

    Args:
        machine: with the step and the integrator of all that is simulated.
        threads: as many as there are cores by default.
    """
    fine = machine_simulator(machine.timestep / STEPS_FINER, threads)
    if machine.mujoco_model().opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return fine
    coarse = machine_simulator(threads=threads)

    def run(models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        pairs = zip(*(engine(models, segments, starts) for engine in (fine, coarse)), strict=True)
        with np.errstate(all="ignore"):  # numbers after a divergence mean nothing
            return [
                Predicted(a.position + (a.position - b.position) / (STEPS_FINER - 1), np.minimum(a.reached, b.reached))
                for a, b in pairs
            ]

    return run


def simulator_for(model: Model, threads: int | None = None) -> Simulator:
    """The engine that a model is fitted with: MuJoCo for machines, else the reduced one."""
    return reduced_simulator(threads=threads) if machine_of(model) is None else machine_simulator(threads=threads)
