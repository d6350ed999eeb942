"""How fast and how accurate both engines simulate the leg, beside a Python loop over mj_step.

Random swing step responses (rest in one pose of the workspace, then the pressures that hold another) that touch no
stop, of the leg without its stops (a run near one would be simulated again with shorter steps), against scipy's DOP853
on the exact Lagrangian. What stands in one row ran on the same work with the same step; rows are timed alternately, and
the best of all rounds is printed. The reduced engine runs each step response for many parameter sets at once, which is
what fits and diagnoses do.

    python benchmarks/engines.py [--rates 80 120 240] [--runs 40] [--phase stance] [--rounds 7]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
from scipy.integrate import solve_ivp

from equimus_ctrl.engines.batch import Trial, encode, simulate
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import place
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array

DURATION = 3.0


def exact(kinematics: Kinematics, q0: Array, pressure: Array, times: Array, rtol: float = 1e-10) -> Array:
    """(n, nj) angles at ``times`` from rest."""
    nj = len(q0)
    found = solve_ivp(
        lambda t, x: np.concatenate([x[nj:], kinematics.acceleration(x[:nj], x[nj:], pressure)]),
        (0.0, times[-1]),
        np.concatenate([q0, np.zeros(nj)]),
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=rtol / 100,
    )
    return np.array(found.y[:nj].T)


def step_responses(m: Morphology, phase: Phase, n: int, seed: int) -> tuple[Array, Array]:
    """Starts (n, 2) and pressures (n, 2) of steps whose motion stays clear of the stops.

    In stance few poses are stable, so the steps there are small and only those that stay up are kept.
    """
    kinematics, rng = Kinematics(m, phase), np.random.default_rng(seed)
    low, high = m.joint_range
    starts: list[Array] = []
    pressures: list[Array] = []
    while len(starts) < n:
        q0 = rng.uniform([np.pi / 6, 0], [2 * np.pi / 3, np.pi / 2])
        end = (
            rng.uniform([np.pi / 6, 0], [2 * np.pi / 3, np.pi / 2]) if phase == "swing" else q0 + rng.normal(0, 0.1, 2)
        )
        p = kinematics.static_pressure(end)
        if np.any(p < m.command_low) or np.any(p > m.command_high) or np.any(q0 < low) or np.any(q0 > high):
            continue
        steps = round(DURATION * 240)
        look = MujocoBatch(m, phase, replace(FAST_SETTINGS, timestep=1 / 240), threads=1)
        q, _ = look.run(q0[None], np.zeros((1, 2)), np.tile(p, (1, steps, 1)))
        if np.all((q > low + 1e-3) & (q < high - 1e-3)):
            starts.append(q0)
            pressures.append(p)
    return np.array(starts), np.array(pressures)


def python_loop(batch: MujocoBatch, q0: Array, pressure: Array) -> Array:
    """What anyone would write: the same model, one step after another."""
    model, m = batch.mujoco_model, batch.morphologies[0]
    data = mujoco.MjData(model)
    kinematics = Kinematics(m, batch.phase)
    qpos = [model.joint(name).qposadr[0] for name in m.joint_names]
    out = np.empty((len(q0), pressure.shape[1] + 1, len(qpos)))
    for i in range(len(q0)):
        mujoco.mj_resetData(model, data)
        place(model, data, kinematics, q0[i])
        out[i, 0] = q0[i]
        for k, p in enumerate(pressure[i]):
            data.ctrl[:] = p
            mujoco.mj_step(model, data)
            out[i, k + 1] = data.qpos[qpos]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[80, 100, 120, 240, 480], help="steps a second")
    parser.add_argument("--runs", type=int, default=40, help="timed at once; the first --exact are compared")
    parser.add_argument("--exact", type=int, default=8, help="runs compared with DOP853")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--phase", choices=("swing", "stance"), default="swing")
    parser.add_argument("--leg", choices=tuple(MORPHOLOGIES), default="nominal_leg")
    parser.add_argument("--reduced-rates", type=float, nargs="+", default=[250, 500, 1000], help="steps a second")
    parser.add_argument("--sets", type=int, default=32, help="parameter sets that the reduced engine runs side by side")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    leg = MORPHOLOGIES[args.leg]()
    q0, pressure = step_responses(leg, args.phase, args.runs, args.seed)
    m = leg.without_stops()
    kinematics = Kinematics(m, args.phase)
    v0 = np.zeros_like(q0)
    print(f"{args.leg}, {args.phase}, {args.runs} runs of {DURATION:g} s")
    print(f"{'steps/s':>8} {'loop':>7} {'1 thread':>9} {'2 threads':>10}  x real time   {'RMSE':>9} {'max':>9}  rad")
    for rate in args.rates:
        steps = round(DURATION * rate)
        settings = replace(FAST_SETTINGS, timestep=1 / rate)
        one, two = (MujocoBatch(m, args.phase, settings, threads=n) for n in (1, 2))
        held = np.repeat(pressure[:, None], steps, axis=1)

        def run_loop(model: MujocoBatch = one, held: Array = held) -> None:
            python_loop(model, q0[:4], held[:4])

        def run_batch(model: MujocoBatch, held: Array = held) -> None:
            model.run(q0, v0, held)

        best = [np.inf] * 3
        work: list[tuple[Callable[[], None], int]] = [
            (run_loop, min(4, args.runs)),
            (lambda one=one: run_batch(one), args.runs),  # type: ignore[misc]
            (lambda two=two: run_batch(two), args.runs),  # type: ignore[misc]
        ]
        for _ in range(args.rounds):
            for i, (job, runs) in enumerate(work):
                began = time.perf_counter()
                job()
                best[i] = min(best[i], (time.perf_counter() - began) / (runs * DURATION))
        times = np.arange(steps + 1) / rate
        q, _ = one.run(q0, v0, held)
        error = np.array(
            [q[i] - exact(kinematics, q0[i], pressure[i], times) for i in range(min(args.exact, args.runs))]
        )
        speed = [1 / seconds for seconds in best]
        print(
            f"{rate:8g} {speed[0]:7.0f} {speed[1]:9.0f} {speed[2]:10.0f} {'':13} "
            f"{np.sqrt(np.mean(error**2)):9.1e} {np.abs(error).max():9.1e}",
            flush=True,
        )
    reduced(m, args.phase, q0, pressure, args)


def reduced(m: Morphology, phase: Phase, q0: Array, pressure: Array, args: argparse.Namespace) -> None:
    """The reduced engine's table: one parameter set at a time, and ``--sets`` of them side by side."""
    kinematics = Kinematics(m, phase)
    times = np.arange(round(DURATION * 120) + 1) / 120
    trials = [
        Trial(f"{i}", np.array([0.0, DURATION]), np.tile(p, (2, 1)), p, 0.0, q, times)
        for i, (q, p) in enumerate(zip(q0, pressure, strict=True))
    ]
    single, many = encode([Model(m, phase=phase)]), encode([Model(m, phase=phase)] * args.sets)
    print(f"\nreduced engine, {args.sets} parameter sets side by side")
    print(
        f"{'steps/s':>8} {'1 set':>9} {'1 thread':>9} {'2 threads':>10}  x real time  {'1 thread':>9} Msteps/s        ",
        end="",
    )
    print(f"{'RMSE':>9} {'max':>9}  rad")
    for rate in args.reduced_rates:
        best = [np.inf] * 3
        jobs = [(single, 1, 1), (many, args.sets, 1), (many, args.sets, 2)]
        for _ in range(args.rounds):
            for i, (models, sets, threads) in enumerate(jobs):
                began = time.perf_counter()
                simulate(models, trials, dt=1 / rate, threads=threads)
                best[i] = min(best[i], (time.perf_counter() - began) / (sets * len(trials) * DURATION))
        found = simulate(single, trials[: args.exact], dt=1 / rate)
        error = np.array([f.position[0] - exact(kinematics, q0[i], pressure[i], times) for i, f in enumerate(found)])
        speed = [1 / seconds for seconds in best]
        print(
            f"{rate:8g} {speed[0]:9.0f} {speed[1]:9.0f} {speed[2]:10.0f} {'':13} {speed[1] * rate / 1e6:10.1f} {'':17} "
            f"{np.sqrt(np.mean(error**2)):9.1e} {np.abs(error).max():9.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
