"""How fast the sampling controller is, beside plain Python around mj_step, and how well each method drives the leg.

1. The whole controller in closed loop (observer, reference, rollouts, costs): 32 plans of 40 steps, in MuJoCo and in
   the exact equations; the leg with valves that lag, 2 mrad of noise, the triangle.
2. Rollouts and costs alone, as plain Python does them: for each plan a loop around mj_step, on the same MuJoCo model
   with the same step, from the same state, with the same inputs, and the same costs to 1e-9. Once as hydrax and judo
   have it, a running cost at each step; once with all costs worked out at the end.
3. Triangle, RMSE of the true angles, by method and engine.

    python benchmarks/sampling.py [--seconds 10] [--output FILE.json]
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.controllers.sampling import SamplingController
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.effects import Effect, FirstOrderLag
from equimus_ctrl.loop import run
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import compile_model, place
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.predictive.costs import Wanted, Weights, costs
from equimus_ctrl.predictive.rollouts import MUJOCO_SETTINGS, make_rollouts
from equimus_ctrl.predictive.sampling import METHODS
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Reference
from equimus_ctrl.workflow import load_scenario

LEG, DT = nominal_leg(), 1 / 120
SAMPLES, STEPS = 32, 40
TAU = 0.1
"""Of the valves [s]."""
LAG: tuple[Effect, ...] = tuple(FirstOrderLag(name, time_constant=TAU) for name in ("maa", "baa"))
SKIPPED = 1.0
"""The start, which brings the leg to the path, does not count [s]."""
WEIGHTS = Weights(0.03, 1.0, 1e3, 0.003)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    reference = load_scenario("triangle", LEG, search=False).reference
    record: dict[str, Any] = {"seconds": given.seconds}
    record["closed_loop"] = closed_loop(reference, given.seconds)
    record["plans"] = plans_alone()
    record["triangle"] = triangle(reference, given.seconds)
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


def closed_loop(reference: Reference, seconds: float) -> dict[str, Any]:
    """Times of a whole step, in turns, so that what else the machine does weighs on all alike."""
    found: dict[str, list[float]] = {"mujoco": [], "exact": []}
    statuses: dict[str, Counter[str]] = {name: Counter() for name in found}
    for turn in range(3):
        for engine in found:
            plant = MujocoPlant(Model(LEG, LAG), noise=2e-3)
            own = SamplingController(SamplingSettings(samples=SAMPLES, horizon=STEPS * DT, engine=engine))
            done = run(plant, own, reference, seconds / 2, seed=turn)
            found[engine] += done.solve_time[60:].tolist()
            statuses[engine].update(done.status)
    record = {}
    print(f"whole step, {SAMPLES} plans of {STEPS} steps, observer included: median, p99, rate")
    for name, times in found.items():
        p50, p99 = float(np.median(times)), float(np.quantile(times, 0.99))
        record[name] = {"p50_s": p50, "p99_s": p99, "statuses": dict(statuses[name])}
        print(f"  {name:10s} {1e3 * p50:6.2f} ms {1e3 * p99:6.2f} ms {1 / p50:7.0f} Hz   {dict(statuses[name])}")
    return record


class Plain:
    """Plain Python around mj_step."""

    def __init__(self) -> None:
        robot = LEG.without_stops()
        self.model = compile_model(robot, "swing", MUJOCO_SETTINGS)
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(name).qposadr[0] for name in robot.joint_names]
        self.dofs = [self.model.joint(name).dofadr[0] for name in robot.joint_names]
        self.kinematics = Kinematics(robot, "swing")
        self.angles = np.array(LEG.joint_range)

    def __call__(self, start: Array, disturbance: Array, inputs: Array, wanted: Wanted, each_step: bool) -> Array:
        """(n,) what plans cost."""
        model, data = self.model, self.data
        place(model, data, self.kinematics, start[:2], start[2:4])
        first = np.concatenate([data.qpos, data.qvel])
        total, states = np.zeros(len(inputs)), np.empty((len(inputs), STEPS + 1, 6))
        decay = np.exp(-DT / TAU)
        mean = TAU / DT * (1 - decay)
        for i, plan in enumerate(inputs):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = first[: model.nq], first[model.nq :]
            data.qfrc_applied[self.dofs] = disturbance
            pressure = start[4:]
            states[i, 0] = start
            for k, u in enumerate(plan):
                data.ctrl[:] = u + (pressure - u) * mean
                pressure = u + (pressure - u) * decay
                mujoco.mj_step(model, data)
                if each_step:
                    total[i] += self.running(k, data.qpos[self.joints], data.qvel[self.dofs], pressure, u, wanted)
                else:
                    states[i, k + 1] = np.concatenate([data.qpos[self.joints], data.qvel[self.dofs], pressure])
        if each_step:
            return total
        return costs(WEIGHTS, np.full(STEPS, DT), self.angles, wanted, states, inputs)

    def running(self, k: int, q: Array, v: Array, pressure: Array, u: Array, wanted: Wanted) -> float:
        """What one step costs."""
        cost = (((u - wanted.feed[k]) / WEIGHTS.pressure) ** 2).sum()
        cost += (((q - np.clip(q, *self.angles)) / WEIGHTS.limit) ** 2).sum()
        target = wanted.states[k + 1]
        if k + 1 < STEPS:
            cost += (((q - target[:2]) / WEIGHTS.angle) ** 2).sum() + (((v - target[2:4]) / WEIGHTS.rate) ** 2).sum()
            return float(0.5 * DT * cost)
        off = wanted.last @ (np.concatenate([q, v, pressure]) - target)
        return float(0.5 * DT * cost + 0.5 * off @ off)


def plans_alone() -> dict[str, Any]:
    """Rollouts and costs of the same plans."""
    rng = np.random.default_rng(0)
    start, disturbance = np.array([1.45, 0.6, 0.1, -0.2, 1e4, 8e3]), np.array([0.02, -0.01])
    inputs = np.repeat(rng.uniform(5e3, 2e4, (SAMPLES, STEPS // 8, 2)), 8, axis=1)
    wanted = Wanted(np.tile(start, (STEPS + 1, 1)), np.full((STEPS, 2), 1e4), np.diag([9.0, 9, 1, 1, 1e-4, 1e-4]))
    plain, model, span = Plain(), Model(LEG, LAG), np.full(STEPS, DT)
    engines = {name: make_rollouts([model], SAMPLES, STEPS, DT, name) for name in ("mujoco", "exact")}
    ways: dict[str, Any] = {
        name: (
            lambda roll=roll: costs(WEIGHTS, span, plain.angles, wanted, roll(start, disturbance, inputs)[0], inputs)
        )
        for name, roll in engines.items()
    }
    ways["plain Python, costs at each step"] = lambda: plain(start, disturbance, inputs, wanted, True)
    ways["plain Python, costs at the end"] = lambda: plain(start, disturbance, inputs, wanted, False)
    spent: dict[str, list[float]] = {name: [] for name in ways}
    found = {name: way() for name, way in ways.items()}
    for name in list(ways)[2:]:
        np.testing.assert_allclose(found[name], found["mujoco"], rtol=1e-9)
    for _ in range(10):
        for name, way in ways.items():
            for _ in range(10):  # in a row, as in closed loop: threads that have long been idle wake slowly
                begun = time.perf_counter()
                way()
                spent[name].append(time.perf_counter() - begun)
    record: dict[str, Any] = {}
    print(f"rollouts and costs of {SAMPLES} plans of {STEPS} steps: median, and by how much plain Python is slower")
    for name, times in spent.items():
        p50 = float(np.median(times))
        ratios = {engine: p50 / float(np.median(spent[engine])) for engine in engines}
        record[name] = {"p50_s": p50, **{f"over_{engine}": ratio for engine, ratio in ratios.items()}}
        print(f"  {name:34s} {1e3 * p50:7.2f} ms   {ratios['mujoco']:5.1f} x mujoco  {ratios['exact']:5.1f} x exact")
    return record


def triangle(reference: Reference, seconds: float) -> dict[str, Any]:
    """RMSE of the true angles, by method and engine."""
    record: dict[str, Any] = {}
    print("triangle, lag known, 2 mrad of noise: RMSE of the true angles")
    for method in METHODS:
        for engine in ("mujoco", "exact"):
            plant = MujocoPlant(Model(LEG, LAG), noise=2e-3)
            own = SamplingController(SamplingSettings(method=method, engine=engine))
            done = run(plant, own, reference, max(seconds, 10.0), seed=0)
            assert done.truth is not None
            error = (done.truth - done.reference)[done.time > SKIPPED]
            rmse = np.sqrt((error**2).mean(axis=0))
            record[f"{method}, {engine}"] = rmse.tolist()
            print(f"  {method:20s} {engine:8s} {1e3 * rmse[0]:6.2f} {1e3 * rmse[1]:6.2f} mrad")
    return record


if __name__ == "__main__":
    main()
