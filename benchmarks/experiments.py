"""Do designed experiments resolve what recordings did not, with how many trials, and do predictions come true?

    python benchmarks/experiments.py --cases 60 [--robot leg] [--arms designed chirps multisines d_optimal]
    python benchmarks/experiments.py --cases 40 --robot docs/examples/pendulum.xml --limit motor.low=-2 …

Blinded ground truths are drawn as `equimus-ctrl prove` does. Each is recorded in two short, poor trials first, chirps
of small amplitude about a random level, and diagnosed. Then further trials are added one by one and all are diagnosed
again, in four arms: trials designed to distinguish what the diagnosis leaves; as many chirps more; random multisines
that use the whole range; and of random designs the one that makes the parameters of what is named most precise
(D-optimal). All keep the limits. What is in the folder already is not done again.

Right is what names exactly what is missing, or what is said to be not distinguishable from it; of physics outside the
catalogue, what is called unexplained.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl import presets
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import EquimusError, NothingFeasible, SimulationDiverged
from equimus_ctrl.executors.where import Where
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.design import designed
from equimus_ctrl.experiments.families import FAMILIES, CommandBounds, Multisine
from equimus_ctrl.experiments.first import unrecorded
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.loop import Predicted, held_out, no_longer_left, realised, worth_making
from equimus_ctrl.experiments.predicted import Commands, predicted_recordings
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.answers import OURS, Case, Places
from equimus_ctrl.proof.designs import TrialDesign, sample_times
from equimus_ctrl.proof.drawing import ATTEMPTS, DESIGN, REST, CaseSource, GroundTruth, draw_case, stream
from equimus_ctrl.proof.further import further
from equimus_ctrl.proof.legs import Legs, leg_draws
from equimus_ctrl.proof.mjcf import Experiment
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.store import truth_of
from equimus_ctrl.report import style
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import load_model

POOR, SECONDS = 2, 6.0
"""First trials, and how long all of them last [s]."""
LEVEL, SWING = np.array([[12e3, 5e3], [20e3, 9e3]]), (0.3, 0.5)
"""Between what levels of a leg's chirps are [Pa], and how far they swing in shares of these."""
SOMEWHERE, SMALL = (0.4, 0.6), (0.1, 0.2)
"""The same of machines, in shares of their ranges."""
LOWEST, HIGHEST = 0.1, (0.8, 2.5)
"""Frequency with which a chirp begins, and between which it ends [Hz]."""
ARMS = ("designed", "chirps", "multisines", "d_optimal")
DRAWS, DESIGNS, LOOKED_AT = 99, 64, 4
"""Of parameters through which trials are taken; random designs among which D-optimal ones are; and of these draws."""
SETTINGS = DiagnosisSettings(threads=1)


def chirp(rng: np.random.Generator, times: Array, level: Array, swing: Array, before: float) -> Array:
    """(n, na) about a level (na,) by a swing (na,), the second actuator slower than the first."""
    top, swept = rng.uniform(*HIGHEST), np.maximum(times - before, 0.0)
    phase = 2 * np.pi * (LOWEST * swept + (top - LOWEST) * swept**2 / (2 * (times[-1] - before)))
    return np.asarray(level + swing * np.sin(phase[:, None] * 0.7 ** np.arange(len(level))))


class PoorLegs(Legs):
    """Legs whose trials are small chirps."""

    def draw(self, seed: int, case: int, kind: Any = None, attempt: int = 0) -> GroundTruth:
        rng, found = stream(seed, case, DESIGN), []
        for name in self.trial_names:
            times, level = sample_times(rng, self.duration), rng.uniform(*LEVEL)
            rows = chirp(rng, times, level, rng.uniform(*SWING) * level, 0.5)
            found.append(TrialDesign(name, "chirp", times, np.round(rows)))
        bias = stream(seed, case, REST).uniform(-0.8, 0.8, (self.trials, len(self.nominal.robot.actuator_names) + 2))
        return draw_case(leg_draws(), found, bias, seed, case, kind, attempt)


@dataclass(frozen=True, eq=False)
class Setup:
    """What is done with each case.

    Attributes:
        robot: ``leg`` or a model file.
        seed: of all.
        kind: of ground truths; drawn by default.
        trials: that are added, at most.
        limit: of the robot, see ``--limit``.
        evaluations: of each design; as many as usual by default.
    """

    robot: str
    seed: int
    kind: str | None
    trials: int
    limit: dict[str, str]
    evaluations: int | None

    @cached_property
    def model(self) -> Model:
        return nominal_model() if self.robot == "leg" else load_model(Path(self.robot))

    @cached_property
    def limits(self) -> Limits:
        return replace(Limits.read(self.model.robot, None, self.limit), duration=SECONDS)

    @cached_property
    def source(self) -> CaseSource:
        """Of cases with the poor trials first, then the chirps that are added."""
        count = POOR + self.trials
        if self.robot == "leg":
            return PoorLegs(count, SECONDS)
        rivals = unrecorded(self.model)
        ground = Ground.of(rivals, self.limits, KnownCondition(), rivals.simulator(1))
        rng, bounds = np.random.default_rng(self.seed), ground.bounds
        crowd, made = crowd_of(ground, rng, DRAWS), list[Commands]()
        for _ in range(count):
            span = bounds.high - bounds.low
            level = bounds.low + rng.uniform(*SOMEWHERE) * span
            course = from_rest(chirp(rng, ground.times, level, rng.uniform(*SMALL) * span, bounds.before), bounds)
            made.append(ground.trial(ground.rest + crowd.within(course)[0] * (course - ground.rest)))
        seen = predicted_recordings(rivals, self.model, made, rivals.simulator(1))
        return Experiment(self.model, tuple(seen))


def from_rest(course: Array, bounds: CommandBounds) -> Array:
    """A course (n, na) that begins and ends at rest, faded in and out over a sixth of it."""
    share = np.linspace(0.0, 1.0, len(course))
    envelope = np.clip(6 * np.minimum(share, 1 - share), 0.0, 1.0)[:, None]
    return np.asarray(bounds.rest + envelope * (np.clip(course, bounds.low, bounds.high) - bounds.rest))


def crowd_of(ground: Ground, rng: np.random.Generator, draws: int) -> Crowd:
    """What is named first, with draws of its parameters."""
    first = ground.rivals.rivals[0]
    return ground.crowd([first.model, *(first.model_at(theta) for theta in first.draws(rng, draws))])


def drawn(setup: Setup, case: int, attempt: int) -> tuple[GroundTruth, list[Array]]:
    """A ground truth as it is driven, and what its sensors show without noise."""
    return setup.source.simulate(setup.source.draw(setup.seed, case, setup.kind, attempt))  # type: ignore[arg-type]


def diagnosed(setup: Setup, trials: Sequence[Recording]) -> Diagnosis:
    """What is found in the poor trials and those added."""
    free = default_free_parameters(setup.model)
    heldout = held_out([trial.name for trial in trials[:POOR]])
    return diagnose(free, split(free.model, trials, heldout=heldout), settings=SETTINGS)


def judged(setup: Setup, truth: dict[str, Any], found: Diagnosis) -> dict[str, Any]:
    """Whether a diagnosis is right."""
    case = Case(truth, {**found.to_dict(), "proof": {"failed": ""}}, {}, Places.of(setup.model.robot))
    beyond = case.kind == "outside"
    exact = case.unexplained(OURS) if beyond else case.exact(OURS)
    return {
        "exact": exact,
        "right": exact or (not beyond and case.in_group(OURS)),
        "verdict": found.verdict,
        "named": [f"{f.named.effect} {' '.join(f.named.locations)}" for f in found.findings],
        "left": len(found.rivals.rivals),
        "seconds": found.seconds,
    }


def random_trial(setup: Setup, rivals: Rivals, rng: np.random.Generator, most_precise: bool) -> Commands:
    """A multisine about the middle of the range, or of random designs the one that is most precise."""
    ground = Ground.of(rivals, setup.limits, KnownCondition(), rivals.simulator(1))
    na = len(ground.rest)
    if most_precise:
        few, names = crowd_of(ground, rng, LOOKED_AT), list(FAMILIES)
        drawn = [FAMILIES[names[k % len(names)]] for k in range(DESIGNS)]
        tried = [ground.commands(own, rng.random(own.dimension(na)), rng.uniform(0.2, 1.0)) for own in drawn]
        inside = [o for o, m in zip(tried, few.motions(tried), strict=True) if setup.limits.excess(m).worst <= 0]
        if inside:
            apart = separations(rivals, inside, simulator=rivals.simulator(1))
            precise = [np.linalg.slogdet(np.eye(s.stop - s.start) + own.gram[s, s])[1]
                       for own in apart for s in own.places[:1]]  # fmt: skip
            course = inside[int(np.argmax(precise))].commands
            return kept(ground, course, rng)
    z = np.concatenate([rng.random(Multisine.shared), rng.random(Multisine.each * na)])
    return kept(ground, ground.commands(Multisine(), z, 1.0).commands, rng)


def kept(ground: Ground, course: Array, rng: np.random.Generator) -> Commands:
    """A course, shrunk until it keeps the limits."""
    share = crowd_of(ground, rng, DRAWS).within(course)[0]
    return ground.trial(ground.rest + share * (course - ground.rest))


def made(setup: Setup, truth: GroundTruth, commands: Commands, k: int, rng: np.random.Generator) -> Recording:
    """A trial with the ground truth."""
    if setup.robot == "leg":
        times = sample_times(rng, commands.duration)
        rows = commands.commands[np.searchsorted(commands.times, times + 1e-9, side="right") - 1]
    else:
        times, rows = commands.times, commands.commands
    return further(setup.source, truth, TrialDesign(f"added_{k:02d}", "added", times, rows, commands.start), k)


def first(setup: Setup, case: int) -> dict[str, Any]:
    """The truth of a case, and what its poor trials say."""
    with threadpool_limits(limits=1, user_api="blas"):
        for attempt in range(ATTEMPTS):
            try:
                driven, clean = drawn(setup, case, attempt)
                truth = truth_of(setup.source, driven, clean)
                break
            except SimulationDiverged:
                continue
        else:
            raise EquimusError(f"case {case}: {ATTEMPTS} robots in turn diverged")
        found = diagnosed(setup, setup.source.recorded(driven, clean)[:POOR])
    return {
        "attempt": attempt, "truth": truth, "judged": judged(setup, truth, found), "rivals": found.rivals.to_dict(),
    }  # fmt: skip


def added(setup: Setup, case: int, arm: str, begun: dict[str, Any]) -> list[dict[str, Any]]:
    """What is said after each trial that an arm adds; what ends sooner keeps its answer."""
    with threadpool_limits(limits=1, user_api="blas"):
        truth, clean = drawn(setup, case, begun["attempt"])
        recorded = setup.source.recorded(truth, clean)
        trials, chirps = recorded[:POOR], recorded[POOR:]
        rivals, rows = Rivals.from_dict(begun["rivals"], setup.model), list[dict[str, Any]]()
        last = begun["judged"]
        for k in range(1, setup.trials + 1):
            rng, start, predicted = np.random.default_rng([setup.seed, case, k]), time.perf_counter(), None
            if arm == "chirps":
                trial = chirps[k - 1]
            else:
                try:
                    if arm == "designed":
                        if len(rivals.rivals) == 1:
                            break
                        own = designed(rivals, setup.limits, seed=k, evaluations=setup.evaluations, draws=DRAWS,
                                       simulator=rivals.simulator(1))  # fmt: skip
                        predicted, commands = Predicted.of(rivals, own.pairs), own.commands
                        if not worth_making(predicted, setup.trials - k + 1):
                            break
                    else:
                        commands = random_trial(setup, rivals, rng, arm == "d_optimal")
                except NothingFeasible:
                    break
                spent = time.perf_counter() - start
                trial = made(setup, truth, commands, k, rng)
            spent = time.perf_counter() - start if arm == "chirps" else spent
            trials = [*trials, trial]
            found = diagnosed(setup, trials)
            last = {**judged(setup, begun["truth"], found), "design_seconds": spent}
            if predicted is not None:
                gone = no_longer_left(rivals, found, found.rivals)
                last["realised"] = [r.to_dict() for r in realised(rivals, predicted, found.rivals, gone)]
                last["family"] = own.family
            rivals = found.rivals
            rows.append(last)
    same = {key: value for key, value in last.items() if key not in ("realised", "family", "design_seconds")}
    return [*rows, *({**same, "ended": True} for _ in range(setup.trials - len(rows)))]


def summary(folder: Path, arms: Sequence[str], cases: int, trials: int) -> dict[str, Any]:
    """Shares after each number of trials, and predictions against what became of them."""
    begun = [json.loads((folder / f"case_{case:04d}.json").read_text()) for case in range(cases)]
    found: dict[str, Any] = {"cases": cases, "arms": {}}
    gaps = list[tuple[float, float]]()
    for arm in arms:
        rows = [json.loads((folder / f"case_{case:04d}_{arm}.json").read_text()) for case in range(cases)]
        table = {}
        for key in ("exact", "right"):
            table[key] = [Share.among(own["judged"][key] for own in begun)]
            table[key] += [Share.among(own[k][key] for own in rows) for k in range(trials)]
        found["arms"][arm] = {key: [share.to_dict() for share in shares] for key, shares in table.items()}
        print(f"{arm:12s} right after {', '.join(f'{k}: {share}' for k, share in enumerate(table['right']))}")
        gaps += [(r["predicted"]["gap"], r["gap"]) for own in rows for row in own for r in row.get("realised", ())
                 if r["gap"] is not None]  # fmt: skip
    if gaps:
        # Noise moves a gap of G by 2√G; beyond that it is to be within a factor of 2.
        near = Share.among(p / 2 - 2 * p**0.5 <= r <= 2 * p + 2 * p**0.5 for p, r in gaps)
        found["gaps"], found["within_a_factor_of_2"] = gaps, near.to_dict()
        print(f"realised gap within a factor of 2 of what was predicted, and noise: {near}")
    return found


def figure(found: dict[str, Any], path: Path) -> None:
    """Shares that are right against the number of trials, and the scatter of gaps."""
    drawing = style.new_figure(10.0, 4.4, "Diagnoses with further trials")
    left, right = drawing.subplots(1, 2)
    for k, (arm, table) in enumerate(found["arms"].items()):
        shares = table["right"]
        ends = np.array([[own["share"] - own["low"], own["high"] - own["share"]] for own in shares]).T
        places = np.arange(len(shares)) + 0.06 * (k - 1.5)
        left.errorbar(places, [own["share"] for own in shares], np.maximum(ends, 0.0), label=arm.replace("_", "-"),
                      color=style.JOINT_COLOURS[k], marker="o", capsize=2)  # fmt: skip
    style.dress(left, x="trials added", y="share right or told inseparable")
    left.set_xticks(range(len(shares)))
    left.set_ylim(0.0, 1.02)
    left.legend(fontsize=style.SMALL_SIZE, frameon=False)
    if gaps := found.get("gaps"):
        predicted, became = np.maximum(np.array(gaps).T, 0.1)
        right.loglog(predicted, became, ".", color=style.JOINT_COLOURS[0])
        span = np.array([0.1, max(predicted.max(), became.max())])
        for factor in (0.5, 1.0, 2.0):
            right.loglog(span, factor * span, color=style.FAINT, linewidth=style.THIN_WIDTH)
    style.dress(right, x="predicted gap, −2Δln L", y="realised gap")
    style.save(drawing, path)


def main() -> None:
    """Draw, diagnose, add trials and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="leg", help="leg, or a model file")
    parser.add_argument("--kind", help="of all ground truths; drawn by default")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument("--trials", type=int, default=3, help="added at most")
    parser.add_argument("--limit", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--evaluations", type=int)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--output", type=Path, default=Path("build") / "experiments")
    given = parser.parse_args()
    limit = dict(item.split("=", 1) for item in given.limit)
    setup = Setup(given.robot, given.seed, given.kind, given.trials, limit, given.evaluations)
    request, known = {**vars(setup)}, given.output / "request.json"
    if known.exists() and json.loads(known.read_text()) != request:
        raise SystemExit(f"{given.output}: holds another benchmark; choose another folder")
    presets.write_text(known, presets.json_text(request))
    names = {case: given.output / f"case_{case:04d}.json" for case in range(given.cases)}
    with Where(given.workers).opened(given.cases) as executor:
        missing = [case for case, path in names.items() if not path.exists()]
        for index, found in executor.each(partial(first, setup), ((case,) for case in missing)):
            presets.write_text(names[missing[index]], presets.json_text(found))
            print(f"case {missing[index]}: {found['judged']['verdict']}, right {found['judged']['right']}", flush=True)
        left = [(case, arm) for case in names for arm in given.arms
                if not (given.output / f"case_{case:04d}_{arm}.json").exists()]  # fmt: skip
        tasks = ((case, arm, json.loads(names[case].read_text())) for case, arm in left)
        for index, rows in executor.each(partial(added, setup), tasks):
            case, arm = left[index]
            presets.write_text(given.output / f"case_{case:04d}_{arm}.json", presets.json_text(rows))
            print(f"case {case}, {arm}: right {[row['right'] for row in rows]}", flush=True)
    whole = summary(given.output, given.arms, given.cases, given.trials)
    presets.write_text(given.output / "summary.json", presets.json_text(whole))
    figure(whole, given.output / "experiments.png")


if __name__ == "__main__":
    main()
