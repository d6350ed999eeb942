"""Closed-loop evaluations a second: the tuner's compiled loop beside a plain Python loop over mj_step.

One evaluation is 20 s of the PID on the leg with delayed, lagging valves and a noisy 120 Hz sensor. Both do the same
work on the same leg and are timed alternately in one process; medians and the ratio are printed. The compiled loop
takes evaluations side by side, as the tuner does, and one alone.

    python benchmarks/closed_loop.py [--rounds 7] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import mujoco
import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.controllers.pid_kernel import TRACKING
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.models.mjcf import close_elements, compile_model
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.objective import Problem, Task
from equimus_ctrl.tuning.study import EnsembleSettings, Limits, Weights

DURATION, RATE, STEPS = 20.0, 120.0, 4
GAINS = {"maa": eq.PidGains(600.0, 300.0, 15.0), "baa": eq.PidGains(130.0, 100.0, 8.0)}


def make_problem() -> Problem:
    """The nominal leg with middling valves, asked for a slow figure in joint space."""
    model = eq.nominal_model()
    n = round(DURATION * RATE)
    time_ = np.arange(n) / RATE
    reference = np.stack([1.5 + 0.15 * np.sin(1.3 * time_), 0.5 + 0.3 * np.sin(0.9 * time_)], axis=1)
    noise = np.random.default_rng(0).normal(0, 1e-3, (n, 2))
    task = Task("figure", 1.0, reference, np.zeros(2), None, False, noise, 1 / RATE)
    members = make_ensemble(model, EnsembleSettings(), 1, seed=1)
    problem = Problem(model, members, [task], Weights(), Limits(), STEPS)
    problem.warm_up()
    return problem


def plain_loop(problem: Problem, settings: eq.PidSettings) -> np.ndarray:
    """The same 20 s as anyone would write it: mj_step in a for loop, the PID in Python."""
    leg, task = problem.members[0], problem.tasks[0]
    dt = 1 / RATE / STEPS
    model = compile_model(leg.morphology, "swing", eq.SolverSettings(timestep=dt, integrator="RK4"))
    data = mujoco.MjData(model)
    qpos = [model.joint(name).qposadr[0] for name in leg.morphology.joint_names]
    data.qpos[qpos] = leg.rest(task.command_before, "swing")
    close_elements(model, data)
    kinematics = eq.Kinematics(problem.model.morphology)
    area = np.array([a.area for a in problem.model.morphology.actuators])
    kp, ki, kd = (np.array([getattr(g, key) for g in settings.gains.values()]) for key in ("kp", "ki", "kd"))
    tracking = settings.gain_matrix(tuple(settings.gains))[TRACKING]
    integral = derivative = previous = None
    pressure = task.command_before.copy()
    delay, lag = leg.valve[:, 0], leg.valve[:, 1]
    history: list[np.ndarray] = []
    out = np.empty_like(task.reference)
    offset = None
    for k, wanted in enumerate(task.reference):
        out[k] = data.qpos[qpos]
        y = out[k] + task.noise[k]
        if offset is None:
            offset = y - wanted
            integral = -area * kinematics.static_pressure(y)
            derivative = previous = np.zeros(2)
        s = min(k / RATE / settings.start_time, 1.0)
        r = wanted + offset * (1 - s**3 * (10 - 15 * s + 6 * s * s))
        error = kinematics.lengths(r) - kinematics.lengths(y)
        share = 1 / RATE / (settings.derivative_time + 1 / RATE)
        derivative = derivative + share * ((error - previous) * RATE - derivative)
        previous = error
        asked = kinematics.static_pressure(r) + (kp * error + integral + kd * derivative) / area
        command = np.clip(asked, 0, 50e3)
        integral = integral + ki * error / RATE + (command - asked) * area / RATE / tracking
        history.append(command)
        for step in range(STEPS):
            for i in range(2):
                late = (k * STEPS + step) * dt - delay[i]
                at = int(np.floor(late * RATE + 1e-9))
                u = history[at][i] if at >= 0 else task.command_before[i]
                decay = np.exp(-dt / lag[i])
                data.ctrl[i] = u + (pressure[i] - u) * (1 - decay) * lag[i] / dt
                pressure[i] = u + (pressure[i] - u) * decay
            mujoco.mj_step(model, data)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    problem, settings = make_problem(), eq.PidSettings(GAINS)
    q, _, _ = problem.simulate(settings, 0, 0)
    difference = float(np.abs(plain_loop(problem, settings) - q).max())
    finer = replace(problem, steps=8 * STEPS)
    accuracy = float(np.abs(finer.simulate(settings, 0, 0)[0] - q).max())
    cores = os.cpu_count() or 1
    plain, alone, one, all_cores = [], [], [], []
    block = [(settings, 0)] * LANES
    with ThreadPoolExecutor(cores) as pool:
        for _ in range(options.rounds):
            begun = time.perf_counter()
            plain_loop(problem, settings)
            plain.append(1 / (time.perf_counter() - begun))
            begun = time.perf_counter()
            for _ in range(20):
                problem.outcome(settings, 0, 0)
            alone.append(20 / (time.perf_counter() - begun))
            begun = time.perf_counter()
            for _ in range(6):
                problem.outcomes(block, 0)
            one.append(6 * LANES / (time.perf_counter() - begun))
            begun = time.perf_counter()
            list(pool.map(lambda _: problem.outcomes(block, 0), range(6 * cores)))
            all_cores.append(6 * cores * LANES / (time.perf_counter() - begun))
    result = {
        "evaluation": "20 s closed loop, 120 Hz control, 480 Hz physics, RK4",
        "plain_python_per_s": statistics.median(plain),
        "compiled_alone_per_s": statistics.median(alone),
        "compiled_one_thread_per_s": statistics.median(one),
        "compiled_all_cores_per_s": statistics.median(all_cores),
        "cores": cores,
        "ratio_one_thread": statistics.median(b / a for a, b in zip(plain, one, strict=True)),
        "ratio_all_cores": statistics.median(b / a for a, b in zip(plain, all_cores, strict=True)),
        "largest_difference_to_plain_rad": difference,
        "difference_to_eight_times_finer_step_rad": accuracy,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if options.json:
        print(json.dumps(result, indent=1))
    else:
        for key, value in result.items():
            print(f"{key:42s} {value:.4g}" if isinstance(value, float) else f"{key:42s} {value}")


if __name__ == "__main__":
    main()
