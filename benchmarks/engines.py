"""How fast and how accurate both engines simulate the leg, beside a Python loop over mj_step.

Random swing step responses (rest in one pose of the workspace, then the pressures that hold another) that touch no
stop, of the leg without its stops (a run near one would be simulated again with shorter steps), against scipy's DOP853
on the exact Lagrangian. What stands in one row ran on the same work with the same step; rows are timed alternately, and
the best of all rounds is printed. The reduced engine runs each step response for many parameter sets at once, which is
what fits and diagnoses do.

    python benchmarks/engines.py [--rates 80 120 240] [--runs 40] [--phase stance] [--rounds 7]

With ``--mjcf`` in place of the leg: chains of 1 to 7 hinges, or the robots of MJCF files, in the reduced engine and in
MuJoCo on one thread each. CPU time is the measure; compilation is timed in processes of its own with a new cache.

    python benchmarks/engines.py --mjcf [FILE.xml ...] [--rounds 7]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from _mjcf_chains import (
    HELD,
    InMujoco,
    Work,
    compile_times,
    drive_torques,
    fastest,
    fresh_cache,
    robot_files,
    with_friction,
)
from scipy.integrate import solve_ivp

from equimus_ctrl import workflow
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import place
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

DURATION = 3.0
STEP = 1e-3
"""Of what is compared with the same integrator [s]."""
REFERENCE = 1e-4
"""Step of the reduced engine that errors are measured against [s]."""
STEPS = (8e-3, 6e-3, 4e-3, 3e-3, 2e-3, 1e-3)
"""Steps of the reduced engine among which the longest is sought that is no worse than MuJoCo [s]."""
USUAL = (("Euler", 2e-3), ("Euler", 1e-3), ("implicitfast", 2e-3), ("implicitfast", 1e-3))
"""MuJoCo's integrators and steps that people use [s]."""
SMOOTH = ("RK4", 5e-3)
"""What suits MuJoCo best where motion is smooth: few people use it [s]."""
FRICTION = 0.05
"""Dry friction, as a share of the drives' torque."""
TOP = """\
Same integrator and step (RK4, 1 ms), 32 runs of 1 s, every step recorded: million steps/s on one thread.
Kernel: CPU time of compilation in a new process, for the first time and again from the cache.
Dry friction: 5 % of the drives' torque in all joints, 16 runs; none elsewhere.
                       kernel [s]               rollout        Batch  Python loop  max|Δq|     with dry friction, RMS Δq
robot          joints first again  reduced        ratio        ratio        ratio   in 1 s    reduced  rollout ratio"""
MIDDLE = """
Equal error, 16 runs of 3 s: RMS of q, sampled at 100 Hz, against the reduced engine at 0.1 ms, whose own error is
the difference from 0.05 ms (reference). MuJoCo by rollout; the reduced engine with the longest of 8, 6, 4, 3, 2, 1 ms
that is no worse. CPU time in µs for each simulated second of one run.
robot          MuJoCo            RMS [rad]   time  reduced RMS [rad]   time  ratio  reference"""


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
    parser.add_argument(
        "--mjcf", type=Path, nargs="*", metavar="FILE.xml", help="MJCF robots; chains of hinges if none"
    )
    args = parser.parse_args()
    if args.mjcf is not None:
        compare_mjcf(args.mjcf, args.rounds, args.seed)
        return
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


def compare_mjcf(files: list[Path], rounds: int, seed: int) -> None:
    """The tables of MJCF robots."""
    print(TOP)
    later: list[str] = []
    with fresh_cache() as folder:
        for xml in robot_files(files, Path(folder)):
            first, again = compile_times(xml, Path(folder) / "cache")
            robot = workflow.load_mjcf(xml)
            smooth = with_friction(robot, np.zeros(len(robot.joint_names)))
            print(f"{robot.name[:14]:14} {len(robot.joint_names):6} {first:5.1f} {again:5.2f}", end=" ", flush=True)
            print(same_step(Work.of(smooth, 4, 1.0, seed), rounds), end="   ", flush=True)
            print(rubbing(robot, Work.of(smooth, 2, 1.0, seed), rounds), flush=True)
            later += equal_error(Work.of(smooth, 2, DURATION, seed), rounds)
    print(MIDDLE)
    print("\n".join(later), flush=True)


def same_step(work: Work, rounds: int) -> str:
    """Columns: both engines with the same integrator and step."""
    mine = InMujoco(work, "RK4", STEP)
    found, theirs = work.reduced(STEP, STEP), mine.rollout()
    apart = max(np.abs(other - found[: len(other)]).max() for other in (theirs, mine.batched(), mine.loop()))
    took = fastest(
        {
            "reduced": lambda: work.reduced(STEP, STEP),
            "rollout": mine.rollout,
            "batch": mine.batched,
            "loop": mine.loop,
        },
        rounds,
    )
    took["loop"] *= work.runs / len(mine.loop())
    speed = {name: work.runs * mine.steps / seconds / 1e6 for name, seconds in took.items()}
    columns = [f"{speed[name]:6.3f} {speed['reduced'] / speed[name]:4.0f}×" for name in ("rollout", "batch", "loop")]
    return f"{speed['reduced']:8.2f} {' '.join(columns)} {apart:8.0e}"


def rubbing(robot: MjcfRobot, smooth: Work, rounds: int) -> str:
    """Columns: both with dry friction in all joints; MuJoCo's is a soft constraint, so that motions differ."""
    limits = np.zeros(len(robot.joint_names))
    model = robot.mujoco_model()
    for drive in robot.actuators:
        if drive.servo and model.actuator_forcelimited[drive.index]:
            limits[robot.joint_names.index(drive.joint)] = model.actuator_forcerange[drive.index, 1]
    work = smooth.on(with_friction(robot, FRICTION * np.where(limits > 0, limits, drive_torques(robot))))
    mine = InMujoco(work, "RK4", STEP)
    apart = np.sqrt(np.mean((work.reduced(STEP, STEP) - mine.rollout()) ** 2))
    took = fastest({"reduced": lambda: work.reduced(STEP, STEP), "rollout": mine.rollout}, rounds)
    speed = {name: work.runs * mine.steps / seconds / 1e6 for name, seconds in took.items()}
    ratio = speed["reduced"] / speed["rollout"]
    return f"{speed['reduced']:8.2f} {speed['rollout']:8.3f} {ratio:4.0f}× {apart:8.0e}"


def equal_error(work: Work, rounds: int) -> list[str]:
    """Rows: what MuJoCo takes for its error, and what the reduced engine takes for no more."""
    exact = work.reduced(REFERENCE, HELD)
    half = work.part(1).reduced(REFERENCE / 2, HELD)
    own = rms(exact[: len(half)] - half)
    low, high = work.robot.joint_range
    note = "" if np.all((exact > low) & (exact < high)) else "  (joints reach their ends)"
    errors = {dt: rms(work.reduced(dt, HELD) - exact) for dt in STEPS}
    theirs = {(name, dt): InMujoco(work, name, dt) for name, dt in (*USUAL, SMOOTH)}
    jobs: dict[str, Callable[[], object]] = {f"{name} {dt}": made.rollout for (name, dt), made in theirs.items()}
    jobs |= {f"{dt}": lambda dt=dt: work.reduced(dt, HELD) for dt in STEPS}  # type: ignore[misc]
    took = {name: seconds / (work.runs * work.duration) * 1e6 for name, seconds in fastest(jobs, rounds).items()}
    rows = []
    for (name, dt), made in theirs.items():
        error = rms(made.rollout()[:, :: round(HELD / dt)] - exact)
        slow = took[f"{name} {dt}"]
        row = f"{work.robot.name[:14]:14} {name:12} {dt * 1e3:g} ms {error:9.1e} {slow:6.0f}  "
        step = next((dt for dt in STEPS if errors[dt] <= error), None)
        if step is None:
            row += f"none of them: {errors[min(STEPS)]:.1e} at {min(STEPS) * 1e3:g} ms"
        else:
            row += f"{step * 1e3:4g} ms {errors[step]:9.1e} {took[f'{step}']:6.1f} {slow / took[f'{step}']:5.0f}×"
        rows.append(f"{row:79}  {own:9.0e}{note}")
    return rows


def rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


if __name__ == "__main__":
    main()
