"""How fast the predictive controller is, and do-mpc with its defaults on the same problem.

1. The whole controller in closed loop (observer, reference, program, fallbacks), with a C compiler and without one: the
   leg with valves that lag, 2 mrad of noise, the triangle.
2. Triangle with noise, lag and delay known: PID, LQR and NMPC.
3. The problem alone, from the true state: ours beside do-mpc (collocation and IPOPT, its defaults), the same model,
   intervals, weights, cost behind the horizon and limits. Both drive the same plant, and what the motion costs is told.

    python benchmarks/nmpc.py [--seconds 10] [--output FILE.json] [--without-do-mpc]

do-mpc is no dependency: pip install -e '.[peers]'.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import json
import statistics
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from equimus_ctrl.controllers.inverse import Inverse
from equimus_ctrl.controllers.lqr import LqrController, LqrSettings, Schedule
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.preview import Preview
from equimus_ctrl.effects import Effect, FirstOrderLag, TransportDelay
from equimus_ctrl.loop import run
from equimus_ctrl.models.augmented import augmented_model
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import prediction
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.predictive.costs import Wanted, Weights
from equimus_ctrl.predictive.problem import Problem
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import pack, structure
from equimus_ctrl.types import Array, Controller, Reference
from equimus_ctrl.workflow import load_controller, load_scenario

LEG, DT, NODES = nominal_leg(), 1 / 120, 25
STEP = 2 * DT
"""Of the problem alone [s]."""
LAG: tuple[Effect, ...] = tuple(FirstOrderLag(name, time_constant=0.1) for name in ("maa", "baa"))
LATE: tuple[Effect, ...] = (*LAG, *(TransportDelay(name, delay=0.1) for name in ("maa", "baa")))
WEIGHTS = Weights(0.03, 1.0, 1e3, 0.003)
SKIPPED = 1.0
"""The start, which brings the leg to the path, does not count [s]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--without-do-mpc", action="store_true")
    given = parser.parse_args()
    if not given.without_do_mpc and importlib.util.find_spec("do_mpc") is None:
        raise SystemExit("do-mpc is not installed; get it with: pip install -e '.[peers]', or give --without-do-mpc")
    reference = load_scenario("triangle", LEG, search=False).reference
    record: dict[str, Any] = {"seconds": given.seconds}
    record["closed_loop"] = closed_loop(reference, given.seconds)
    record["triangle"] = triangle(reference, given.seconds)
    if not given.without_do_mpc:
        record["problem"] = problem_alone(reference, min(given.seconds, 6.0))
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


def closed_loop(reference: Reference, seconds: float) -> dict[str, Any]:
    """Times of a whole step, in turns, so that what else the machine does weighs on all alike."""
    kinds = {
        "compiled": NmpcSettings(),
        "compiled, one iteration": NmpcSettings(iterations=1),
        "interpreted": NmpcSettings(compiled=False),
        "interpreted, one iteration": NmpcSettings(compiled=False, iterations=1),
    }
    found: dict[str, list[float]] = {name: [] for name in kinds}
    statuses: dict[str, Counter[str]] = {name: Counter() for name in kinds}
    for turn in range(3):
        for name, settings in kinds.items():
            plant = MujocoPlant(Model(LEG, LAG), noise=2e-3)
            done = run(plant, NmpcController(settings), reference, seconds / 2, seed=turn)
            found[name] += done.solve_time[60:].tolist()
            statuses[name].update(done.status)
    record = {}
    print(f"whole step, {NODES} intervals, 6 states, observer included: median, p99, rate")
    for name, times in found.items():
        p50, p99 = float(np.median(times)), float(np.quantile(times, 0.99))
        record[name] = {"p50_s": p50, "p99_s": p99, "statuses": dict(statuses[name])}
        print(f"  {name:28s} {1e3 * p50:6.2f} ms {1e3 * p99:6.2f} ms {1 / p50:7.0f} Hz   {dict(statuses[name])}")
    return record


def triangle(reference: Reference, seconds: float) -> dict[str, Any]:
    """RMSE of true angles with noise, and valves whose lag and delay are known."""
    scenario = load_scenario("triangle", LEG, search=False)
    controllers: dict[str, Controller] = {
        "pid": load_controller("pid", scenario), "lqr": LqrController(), "nmpc": NmpcController(),
    }  # fmt: skip
    record: dict[str, Any] = {}
    print("triangle, 2 mrad of noise, 0.1 s of lag and 0.1 s of delay known: RMSE of the true angles")
    for name, controller in controllers.items():
        errors = []
        for seed in range(3):
            plant = MujocoPlant(Model(LEG, LATE), noise=2e-3)
            done = run(plant, controller, reference, max(seconds, 20.0), seed=seed)
            assert done.truth is not None
            errors.append(((done.truth - done.reference)[done.time > SKIPPED] ** 2).mean(axis=0))
        rmse = np.sqrt(np.mean(errors, axis=0))
        record[name] = rmse.tolist()
        print(f"  {name:5s} {1e3 * rmse[0]:6.2f} {1e3 * rmse[1]:6.2f} mrad")
    ratio = np.array(record["nmpc"]) / np.array(record["pid"])
    print(f"  nmpc over pid: {ratio[0]:.2f} {ratio[1]:.2f}")
    return record


class Ahead:
    """What is wanted from a time on, on a uniform grid."""

    def __init__(self, model: Model, reference: Reference, start: Array) -> None:
        inverse = Inverse(model, DT, 0.3)
        self._state = inverse.start(0.0, start)
        self._preview = Preview(inverse, np.full(NODES, 2), DT, 0.0)
        self._schedule = Schedule(model, LqrSettings(WEIGHTS.angle, WEIGHTS.rate, WEIGHTS.pressure), DT)
        self._schedule.prepare()
        self._reference, self._sight = reference, None

    def __call__(self, at: float) -> Wanted:
        path, self._sight = self._preview.look(self._reference, at, self._state, self._sight)  # type: ignore[assignment]
        last = np.linalg.cholesky(self._schedule.cost(path.position[-1])).T
        return Wanted(np.hstack([path.position, path.velocity, path.pressure]), path.feed, last)


def problem_alone(reference: Reference, seconds: float) -> dict[str, Any]:
    """Ours and do-mpc's, from the true state."""
    model = Model(LEG, LAG)
    plant = prediction(model, stops=False)
    rest = MujocoPlant(model)
    first = plant.at_rest(rest.reset().position, np.zeros(2))
    ours = Problem(plant, np.full(NODES, STEP), WEIGHTS, np.array(LEG.joint_range), np.array([[0.0, 0], [5e4, 5e4]]))
    wanted = Ahead(model, reference, first[:2])

    def solve_ours(x: Array, at: float, plan: Any) -> tuple[Array, Any]:
        want = wanted(at)
        guess = ours.shifted(plan, at, want) if plan is not None else ours.first_guess(at, x, np.zeros(2), want)
        begun = time.perf_counter()
        answer = ours.solve(x, np.zeros(2), want, guess, iterations=20, tolerance=1e-3)
        spent.append(time.perf_counter() - begun)
        return answer.plan.inputs[0], answer.plan

    other = Ahead(model, reference, first[:2])
    theirs = do_mpc_controller(model, other(0.0))

    def solve_theirs(x: Array, at: float, memory: Any) -> tuple[Array, Any]:
        theirs.wanted = other(at)
        with contextlib.redirect_stdout(io.StringIO()):
            if memory is None:
                theirs.mpc.x0 = x.reshape(-1, 1)
                theirs.mpc.set_initial_guess()
            begun = time.perf_counter()
            u = theirs.mpc.make_step(x.reshape(-1, 1))
            spent.append(time.perf_counter() - begun)
        return np.array(u).ravel(), True

    record: dict[str, Any] = {}
    for name, solve in (("ours", solve_ours), ("do-mpc", solve_theirs)):
        spent: list[float] = []
        x, memory, cost = first.copy(), None, 0.0
        score = Ahead(model, reference, first[:2])
        for k in range(round(seconds / STEP)):
            want = score(k * STEP)
            u, memory = solve(x, k * STEP, memory)
            if k * STEP > SKIPPED:
                cost += (
                    STEP
                    / 2
                    * float(
                        (((x[:2] - want.states[0, :2]) / WEIGHTS.angle) ** 2).sum()
                        + (((x[2:4] - want.states[0, 2:4]) / WEIGHTS.rate) ** 2).sum()
                        + (((u - want.feed[0]) / WEIGHTS.pressure) ** 2).sum()
                    )
                )
            for _ in range(8):  # the plant takes eight steps where the predictions take one
                x = np.array(plant.step(x, u, np.zeros(2), STEP / 8)).ravel()
        times = spent[20:]
        record[name] = {"p50_s": statistics.median(times), "p99_s": float(np.quantile(times, 0.99)), "cost": cost}
    print(f"the problem alone, {NODES} intervals of {1e3 * STEP:.1f} ms, true state: median, p99, cost of the motion")
    for name, values in record.items():
        print(f"  {name:7s} {1e3 * values['p50_s']:8.3f} ms {1e3 * values['p99_s']:8.3f} ms   {values['cost']:.6f}")
    record["ratio"] = record["do-mpc"]["p50_s"] / record["ours"]["p50_s"]
    print(f"  {record['ratio']:.0f} times as fast")
    return record


class do_mpc_controller:  # noqa: N801
    """do-mpc with its defaults: orthogonal collocation, IPOPT."""

    def __init__(self, model: Model, wanted: Wanted) -> None:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            import do_mpc
        m = augmented_model(structure(LEG), "swing", ())
        rates = ca.Function("rates", [m.q, m.v, m.pressure, m.p], [ca.substitute(m.acceleration, m.phi, 0 * m.phi)])
        numbers = ca.DM(pack(LEG.without_stops()))
        robot = do_mpc.model.Model("continuous", "SX")
        q, v = robot.set_variable("_x", "q", (2, 1)), robot.set_variable("_x", "v", (2, 1))
        pressure, u = robot.set_variable("_x", "pressure", (2, 1)), robot.set_variable("_u", "u", (2, 1))
        states = robot.set_variable("_tvp", "states", (6, 1))
        feed, last = robot.set_variable("_tvp", "feed", (2, 1)), robot.set_variable("_tvp", "last", (36, 1))
        robot.set_rhs("q", v)
        robot.set_rhs("v", rates(q, v, pressure, numbers))
        robot.set_rhs("pressure", (u - pressure) / 0.1)
        robot.setup()
        self.wanted = wanted
        mpc = do_mpc.controller.MPC(robot)
        mpc.set_param(n_horizon=NODES, t_step=STEP, store_full_solution=False)
        mpc.settings.supress_ipopt_output()
        x = ca.vertcat(q, v, pressure)
        off = x - states
        stage = STEP / 2 * (
            ca.sumsqr(off[:2] / WEIGHTS.angle) + ca.sumsqr(off[2:4] / WEIGHTS.rate)
            + ca.sumsqr((u - feed) / WEIGHTS.pressure)
        )  # fmt: skip
        mpc.set_objective(mterm=ca.sumsqr(ca.reshape(last, 6, 6) @ off) / 2, lterm=stage)
        mpc.set_rterm(u=0.0)
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = np.zeros(2), np.full(2, 5e4)
        mpc.scaling["_u", "u"] = 1e3
        mpc.scaling["_x", "pressure"] = 1e3
        template = mpc.get_tvp_template()

        def ahead(_: float) -> Any:
            for k in range(NODES + 1):
                template["_tvp", k, "states"] = self.wanted.states[k]
                template["_tvp", k, "feed"] = self.wanted.feed[min(k, NODES - 1)]
                template["_tvp", k, "last"] = self.wanted.last.T.ravel()
            return template

        mpc.set_tvp_fun(ahead)
        with contextlib.redirect_stdout(io.StringIO()):
            mpc.setup()
        self.mpc = mpc


if __name__ == "__main__":
    main()
