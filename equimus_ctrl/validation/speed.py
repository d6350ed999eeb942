"""How fast the engines are at the very settings whose accuracy is stated, and how the two trade off over the step."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.computer import worker_count
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.mjcf import SolverSettings
from equimus_ctrl.models.model import Model
from equimus_ctrl.validation.engines import Progress, finer, mujoco_runs, reduced_runs, silent
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.plan import Errors, Plan
from equimus_ctrl.validation.responses import Responses

PARALLEL = 64
"""Runs that the reduced engine takes side by side under one input."""

INPUTS = 4
"""Inputs of one measurement of the reduced engine."""

REDUCED_STEPS = (8e-3, 4e-3, 2e-3, 1e-3, 5e-4)
FACTORS = (1, 2, 4, 8)


@dataclass(frozen=True)
class FrontPoint:
    """Accuracy and speed at one step.

    Attributes:
        engine: which.
        step: [s].
        rmse: the larger of the joints' [rad].
        x_realtime: simulated time over time taken, on one thread.
    """

    engine: str
    step: float
    rmse: float
    x_realtime: float


@dataclass(frozen=True, eq=False)
class SpeedResult:
    """Speeds: medians over repeats; they vary from run to run.

    Attributes:
        mujoco_one: MuJoCo on one thread [× real time].
        mujoco_all: on all threads.
        stops_one: MuJoCo on one thread, runs that touch a stop; None where none does.
        stops_all: the same on all threads.
        threads: how many those are.
        reduced_one: the reduced engine on one thread [× real time].
        reduced_step: its step [s].
        front: accuracy against speed.
    """

    mujoco_one: float
    mujoco_all: float
    stops_one: float | None
    stops_all: float | None
    threads: int
    reduced_one: float
    reduced_step: float
    front: tuple[FrontPoint, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units; ``mujoco…_x_realtime`` is the faster of one thread and all.

        On cores that others use too, a thread that waits for the slowest can lose more than it gains.
        """
        on_stops = [speed for speed in (self.stops_one, self.stops_all) if speed is not None]
        return {
            "mujoco_x_realtime": max(self.mujoco_one, self.mujoco_all),
            "mujoco_all_threads_x_realtime": self.mujoco_all,
            "mujoco_one_thread_x_realtime": self.mujoco_one,
            "mujoco_on_stops_x_realtime": max(on_stops, default=None),
            "mujoco_on_stops_one_thread_x_realtime": self.stops_one,
            "mujoco_threads": self.threads,
            "mujoco_step_s": FAST_SETTINGS.timestep,
            "reduced_x_realtime": self.reduced_one,
            "reduced_steps_per_s": self.reduced_one / self.reduced_step,
            "reduced_step_s": self.reduced_step,
            "front": [vars(point) for point in self.front],
        }


def speed_case(
    swing: Responses,
    stance: Responses,
    plan: Plan,
    dt: float,
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> SpeedResult:
    """Speeds on the scored swing runs that touch no stop, at the settings of their errors, and of MuJoCo on stops.

    Args:
        swing: where runs and their exact motion are taken from.
        stance: where runs that touch a stop are taken from.
        plan: how many runs and repeats.
        dt: step of the reduced engine [s].
        threads: what "all threads" means; all usable processors by default.
        progress: called with the share done.
    """
    all_threads = worker_count(threads, name="threads")
    clear = np.flatnonzero(swing.clear)
    runs = swing.experiment.part(clear[np.arange(plan.timed) % len(clear)])
    one = mujoco_speed(runs, FAST_SETTINGS, 1, plan.repeats)
    progress(0.3)
    everything = mujoco_speed(runs, FAST_SETTINGS, all_threads, plan.repeats)
    stops_one, stops_all = None, None
    if len(touching := np.flatnonzero(stance.scored & stance.touching)):
        falls = stance.experiment.part(touching[: plan.timed_on_stops])
        stops_one, stops_all = (mujoco_speed(falls, FAST_SETTINGS, n, plan.repeats) for n in (1, all_threads))
    progress(0.5)
    reduced = reduced_speed(runs, dt, plan.repeats)
    progress(0.6)
    front: list[FrontPoint] = []
    if plan.front:
        rows = clear[: plan.front]
        some, exact = swing.experiment.part(rows), swing.exact[rows]
        series = [
            ("mujoco", FAST_SETTINGS),
            ("mujoco, implicitfast", replace(FAST_SETTINGS, integrator="implicitfast")),
        ]
        for name, settings in series:
            for factor in FACTORS:
                own = finer(factor, settings)
                worst = _worst(mujoco_runs(some, own, threads), exact)
                front.append(FrontPoint(name, own.timestep, worst, mujoco_speed(some, own, 1, 1)))
        progress(0.9)
        for step in REDUCED_STEPS:
            worst = _worst(reduced_runs(some, step, threads), exact)
            front.append(FrontPoint("reduced", step, worst, reduced_speed(some, step, 3)))
    progress(1.0)
    return SpeedResult(one, everything, stops_one, stops_all, all_threads, reduced, dt, tuple(front))


def mujoco_speed(runs: Experiment, settings: SolverSettings, threads: int, repeats: int) -> float:
    """× real time of MuJoCo with 3-2-1 elements on runs of one robot, what it records included."""
    batch = MujocoBatch(runs.morphologies[0], runs.phase, settings, threads)
    still, held = np.zeros_like(runs.start), runs.held(settings.timestep)
    batch.run(runs.start[:1], still[:1], held[:1, :1])
    seconds = _median(lambda: batch.run(runs.start, still, held), repeats)
    return runs.size * runs.duration / seconds


def reduced_speed(runs: Experiment, dt: float, repeats: int) -> float:
    """× real time of the reduced engine on one thread, angles sampled at the rate they are compared at."""
    models = encode([Model(runs.morphologies[0], (), runs.phase)] * PARALLEL)
    trials = [
        Trial(f"run {i}", runs.switch, runs.pressure[i], runs.pressure[i, 0], 0.0, runs.start[i], runs.times)
        for i in range(min(INPUTS, runs.size))
    ]
    starts = [runs.start[(np.arange(PARALLEL) + k) % runs.size] for k in range(len(trials))]
    simulate(models, trials[:1], starts=starts[:1], dt=dt, threads=1)
    seconds = _median(lambda: simulate(models, trials, starts=starts, dt=dt, threads=1), repeats)
    return PARALLEL * len(trials) * runs.duration / seconds


def _worst(q: np.ndarray, exact: np.ndarray) -> float:
    return float(Errors.of(q[:, 1:] - exact[:, 1:]).rmse.max())


def _median(call: Callable[[], object], repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)
