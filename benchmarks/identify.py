"""How fast parameters are identified: against scipy's differential evolution, and how the time grows with the work.

The comparison is on the real leg where its recordings are at hand (13 groups of the step release, 5 to 9 s, ten
parameters), else on a simulated one. Both searches call the same simulator with as many parameter sets at once as they
like. Differential evolution first gets the time that the least squares took, then --patience times it, in which it is
watched for coming within 1 % of the best cost. Compare sets, too, which say more than a busy machine's seconds.

    python benchmarks/identify.py [--rounds 3] [--patience 8] [--skip-growth]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import differential_evolution

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ModelError
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.parameters import FreeParameters, free_parameters
from equimus_ctrl.identification.problem import Problem
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.identification.statics import rest_poses
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.recordings import leg_file, read_set, read_static_poses
from equimus_ctrl.robots.elastic.morphology import BASE
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.validation.generator import hanging, random_robot

NOISE = 1e-3
WITHIN = 1.01
ORDER = (
    "stiffness", "rest_length", "area", "damping", "mass", "insertion.radius", "origin.radius", "insertion.angle",
)  # fmt: skip
"""Of an actuator's numbers, as they are freed one after another."""


@dataclass
class Trace:
    """How a search came down: sets of parameters simulated, seconds, and the least cost so far [rad²]."""

    evaluations: list[int]
    seconds: list[float]
    cost: list[float]

    def until(self, cost: float) -> tuple[int, float] | None:
        """When it first was at or below a cost."""
        for n, t, c in zip(self.evaluations, self.seconds, self.cost, strict=True):
            if c <= cost:
                return n, t
        return None


def leg_segments() -> tuple[str, FreeParameters, list[Segment]]:
    model = nominal_model()
    steps, poses = leg_file("step_release"), leg_file("static_poses_13")
    if steps is not None and poses is not None:
        chosen = {f"step_release_p{a:.0f}_{b:.0f}" for a, b in read_static_poses(poses).pressure / 1e3}
        trials = [trial for trial in read_set(steps) if trial.name in chosen]
        return "the real leg", free_parameters(model), cut(model, trials, window=(5, 9))
    true = perturbed(model, free_parameters(model).names)
    return "a simulated leg", free_parameters(model), cut(model, simulated(true, 13, 9.0), window=(5, 9))


def perturbed(model: Model, names: Sequence[str], seed: int = 1) -> Model:
    rng = np.random.default_rng(seed)
    values = model.parameters()
    return model.with_parameters({n: values[n] * (1 + 0.1 * rng.uniform(-1, 1)) + 1e-9 for n in names})


def simulated(model: Model, count: int, duration: float, seed: int = 0) -> list[Recording]:
    """Steps between random pressures from rest, 60 samples a second, with noise."""
    rng = np.random.default_rng(seed)
    m = model.morphology
    time_ = np.arange(round(60 * duration)) / 60
    made: list[Recording] = []
    while len(made) < count:
        levels = rng.uniform(0, 25e3, (3, len(m.actuators)))
        rest = rest_poses(model, levels[:1], hanging(m)[None])
        if not rest.found[0]:
            continue
        command = levels[np.minimum((3 * time_ / duration).astype(int), 2)]
        trial = Trial("bench", time_, command, levels[0], 0.0, rest.angles[0], time_)
        (found,) = simulate([model], [trial])
        if found.sound[0]:
            angles = found.position[0] + rng.normal(0, NOISE, found.position[0].shape)
            made.append(Recording(f"trial_{len(made)}", time_, command, angles, m.actuator_names, m.joint_names))
    return made


def least_squares(parameters: FreeParameters, segments: list[Segment]) -> Trace:
    samples = sum(s.measured.size for s in segments)
    trace, begun = Trace([], [], []), time.perf_counter()

    def notify(evaluations: int, rmse: float) -> None:
        trace.evaluations.append(evaluations)
        trace.seconds.append(time.perf_counter() - begun)
        trace.cost.append(rmse**2 * samples)

    fit(parameters, segments, simulator=reduced_simulator(), settings=FitSettings(), notify=notify)
    trace.seconds[-1] = time.perf_counter() - begun
    return trace


def evolution(parameters: FreeParameters, segments: list[Segment], budget: float, seed: int) -> Trace:
    problem = Problem(parameters, segments, reduced_simulator())
    starts = [s.start for s in segments]
    trace, begun, best = Trace([], [], []), time.perf_counter(), np.inf

    def costs(population: Array) -> Array:
        nonlocal best
        points = problem.points(list(population.T), [[starts]] * population.shape[1])
        found = np.array([point.cost for point in points])
        best = min(best, float(found.min()))
        trace.evaluations.append(problem.evaluations)
        trace.seconds.append(time.perf_counter() - begun)
        trace.cost.append(best)
        return found

    differential_evolution(
        costs,
        list(zip(parameters.low, parameters.high, strict=True)),
        x0=parameters.start,
        seed=seed,
        popsize=8,
        maxiter=10**6,
        tol=0,
        polish=False,
        vectorized=True,
        updating="deferred",
        callback=lambda intermediate_result: time.perf_counter() - begun > budget,
    )
    return trace


def compare(rounds: int, patience: float) -> None:
    where, parameters, segments = leg_segments()
    samples = sum(s.measured.size for s in segments)
    fit(parameters, segments[:1], settings=FitSettings(steps=1))  # compiled
    ours = [least_squares(parameters, segments) for _ in range(rounds)]
    best = min(trace.cost[-1] for trace in ours)
    budget = statistics.median(trace.seconds[-1] for trace in ours)
    theirs = [evolution(parameters, segments, patience * budget, seed) for seed in range(rounds)]
    best = min(best, *(trace.cost[-1] for trace in theirs))

    def rmse(cost: float) -> float:
        return float(np.sqrt(cost / samples))

    print(f"{where}: {len(segments)} trials, {len(parameters.free)} parameters, {samples} angles; {rounds} rounds")
    print(f"best RMSE known: {rmse(best):.5f} rad; within 1 % of its cost: {rmse(WITHIN * best):.5f} rad")
    print(f"\n{'':24} {'seconds':>14} {'sets':>7} {'RMSE then':>10} {'within 1 %: sets':>17} {'seconds':>8}")
    print(f"{'':24} {'least / median':>14}")
    for name, traces in (("least squares", ours), ("differential evolution", theirs)):
        ends = [trace.seconds[-1] for trace in traces]
        then = [min(c for c, t in zip(tr.cost, tr.seconds, strict=True) if t <= budget or t == tr.seconds[0])
                for tr in traces]  # fmt: skip
        reached = [trace.until(WITHIN * best) for trace in traces]
        met = [r for r in reached if r is not None]
        sets = statistics.median(n for n, _ in met) if met else None
        seconds = statistics.median(t for _, t in met) if met else None
        shown = f"{sets:17.0f} {seconds:8.2f}" if met else f"{'never':>17} {'':>8}"
        if met and len(met) < len(traces):
            shown += f"  (in {len(met)} of {len(traces)})"
        sets_all = statistics.median(trace.evaluations[-1] for trace in traces)
        spent = f"{min(ends):.2f} / {statistics.median(ends):.2f}"
        print(f"{name:24} {spent:>14} {sets_all:7.0f} {rmse(statistics.median(then)):10.5f} {shown}")
    ends_cost = statistics.median(trace.cost[-1] for trace in theirs)
    spent = statistics.median(trace.seconds[-1] for trace in theirs)
    print(f"(RMSE then: after {budget:.2f} s. After {spent:.1f} s evolution is at {rmse(ends_cost):.5f} rad.)")


def timed(job: Callable[[], int], rounds: int) -> tuple[float, float, int]:
    """(least, median) seconds and what the job returned."""
    taken, result = [], 0
    for _ in range(rounds):
        begun = time.perf_counter()
        result = job()
        taken.append(time.perf_counter() - begun)
    return min(taken), statistics.median(taken), result


def row(label: str, parameters: FreeParameters, segments: list[Segment], rounds: int) -> None:
    fit(parameters, segments[:1], settings=FitSettings(steps=1))
    least, median, sets = timed(lambda: fit(parameters, segments).evaluations, rounds)
    found = fit(parameters, segments)
    print(f"{label:>14} {least:8.3f} {median:8.3f} {sets:6d} {1e3 * median / sets:9.2f} {1e3 * found.rmse.max():9.3f}")


def growth(rounds: int) -> None:
    model = nominal_model()
    header = f"{'':>14} {'least s':>8} {'median s':>8} {'sets':>6} {'ms a set':>9} {'RMSE mrad':>9}"
    names = list(free_parameters(model).names)
    true = perturbed(model, names)
    trials = simulated(true, 27, 4.0)
    print(f"\ngrowing with trials of 4 s (10 parameters, noise {1e3 * NOISE:g} mrad)\n{header}")
    for count in (1, 4, 13, 27):
        row(f"{count} trials", free_parameters(model), cut(model, trials[:count]), rounds)
    print(f"\ngrowing with parameters (13 trials of 4 s)\n{header}")
    m = model.morphology
    order = [*names, *(f"{a.name}.{key}" for key in ORDER[4:] for a in m.actuators), "calf.mass", "calf.com"]
    for count in (2, 5, 10, 20):
        own = order[:count]
        made = simulated(perturbed(model, own), 13, 4.0)
        row(f"{count} parameters", free_parameters(model, own), cut(model, made), rounds)
    print(f"\ngrowing with joints (random chains, 8 trials of 3 s, stiffness and damping of every actuator)\n{header}")
    for joints in (1, 2, 3, 4):
        chain(joints, rounds)


def chain(joints: int, rounds: int) -> None:
    spans = tuple((k - 1, k) for k in range(joints))
    for seed in range(20):
        try:
            robot = Model(random_robot((joints, spans), np.random.default_rng(seed), f"chain_{joints}"))
        except ModelError:
            continue
        robot = replace(robot, robot=replace(robot.morphology, joints=tuple(
            replace(joint, damping=max(joint.damping, 0.1)) for joint in robot.morphology.joints)))  # fmt: skip
        names = [f"{a.name}.{key}" for key in ("stiffness", "damping") for a in robot.morphology.actuators]
        made = simulated(perturbed(robot, names), 8, 3.0)
        row(f"{joints} joint{'s' * (joints > 1)}", free_parameters(robot, names), cut(robot, made), rounds)
        return
    print(f"{joints} joints: no random chain on {BASE} rests anywhere")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--patience", type=float, default=8.0, help="times the least squares' seconds, for evolution")
    parser.add_argument("--skip-growth", action="store_true")
    options = parser.parse_args()
    compare(options.rounds, options.patience)
    if not options.skip_growth:
        growth(options.rounds)


if __name__ == "__main__":
    main()
