"""Do designed experiments resolve what recordings did not with fewer trials than others that somebody could make?

    python benchmarks/experiments.py --cases 60 [--robot leg] [--arms designed chirps multisines d_optimal]
    python benchmarks/experiments.py --cases 30 --robot docs/examples/pendulum.xml --limit motor.low=-2 …
    python benchmarks/experiments.py --cases 10 --robot benchmarks/two_joint_arm.xml

The first arm is ``equimus-ctrl prove --experiments``: blinded ground truths, two short and poor trials of each, then
designed trials one by one. Three arms more get the same cases, the same first diagnoses and as many trials: chirps as
poor as the first; random multisines that use the whole range; and of random designs the one that makes the parameters
of what is named most precise (D-optimal). All keep the limits. What is in the folder already is not done again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl import presets
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError, NothingFeasible, SimulationDiverged
from equimus_ctrl.executors.where import Where
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import FAMILIES, Multisine
from equimus_ctrl.experiments.ground import Ground
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import ProveOptions
from equimus_ctrl.proof import blind, chirps
from equimus_ctrl.proof.answers import Case, Places
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.further import further, trial_design
from equimus_ctrl.proof.legs import Legs
from equimus_ctrl.proof.poor import crowd_of, kept, poor_recordings
from equimus_ctrl.proof.resolved import RIGHT, Outcome, outcome
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.store import Request, open_truth, recorded, redrawn
from equimus_ctrl.report import style
from equimus_ctrl.report.proof_experiments import gaps_scatter, shares_over_trials
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import load_model
from equimus_ctrl.workflow.proof_experiments import further_limits
from equimus_ctrl.workflow.proofs import Proof, prove

DESIGNED, OTHERS = "designed", ("chirps", "multisines", "d_optimal")
DRAWS, DESIGNS, LOOKED_AT = 99, 64, 4
"""Of parameters through which trials are taken; random designs among which D-optimal ones are; and of these draws."""


@dataclass(frozen=True, eq=False)
class Arm:
    """Trials that nobody designs to distinguish explanations.

    Attributes:
        name: of ``OTHERS``.
        request: that the cases were made from.
        limits: that trials keep.
        count: of trials.
    """

    name: str
    request: Request
    limits: Limits
    count: int

    def outcomes(
        self, case: int, truth: Mapping[str, Any], first: Mapping[str, Any], trials: Sequence[Recording]
    ) -> list[Outcome]:
        """Of the diagnoses with 1, 2, … trials more.

        Args:
            case: its number.
            truth: of it, for the robot and for the score.
            first: the report without any.
            trials: that it is of.
        """
        model, source = self.request.model, self.request.source
        robot, found = redrawn(self.request, truth), list[Outcome]()
        places, report, made = Places.of(model.robot), first, list(trials)
        last = outcome(Case(truth, first, {}, places))
        for k in range(1, self.count + 1):
            left = report.get("rivals") or first["rivals"]
            rivals = Rivals.from_dict(left, model)
            try:
                design = self.design(k, case, rivals)
                if isinstance(design, Commands):
                    design = trial_design(source, robot, design, k, rivals.rate, rivals.notes)
                made.append(further(source, robot, replace(design, name=f"added_{k:02d}"), k).recording)
            except (ConfigError, NothingFeasible, SimulationDiverged):  # it keeps its answer
                break
            report = json.loads(blind.answer_with(made, model, len(trials), left, (), {}))
            last = outcome(Case(truth, report, {}, places))
            found.append(last)
        return [*found, *[last] * (self.count - len(found))]

    def design(self, k: int, case: int, rivals: Rivals) -> TrialDesign | Commands:
        """The k-th trial."""
        if self.name == "chirps":
            return self.chirps(case)[k - 1]
        with threadpool_limits(limits=1, user_api="blas"):
            rng = np.random.default_rng([self.request.seed, case, k])
            return random_trial(rivals, self.limits, rng, self.name == "d_optimal")

    def chirps(self, case: int) -> Sequence[TrialDesign]:
        """Like the first trials, which are those before them."""
        most, own = chirps.TRIALS + self.count, self.request
        if own.experiment is None:
            return Legs(most, own.duration, own.rate, "poor").draw(own.seed, case).trials[chirps.TRIALS :]
        several = poor_recordings(own.model, replace(self.limits, duration=chirps.DURATION), most, own.seed)
        return [
            TrialDesign(r.name, "chirp", r.time, r.command, np.array(r.position[0]), dict(r.notes))
            for r in several[chirps.TRIALS :]
        ]


def random_trial(rivals: Rivals, limits: Limits, rng: np.random.Generator, most_precise: bool) -> Commands:
    """A multisine of the whole range, or of random designs the one that is most precise, shrunk into the limits."""
    ground = Ground.of(rivals, limits, KnownCondition(), rivals.simulator(1))
    if ground.law is not None:
        raise ConfigError(f"{rivals.model.robot.name} rests under no constant command; proofs make no tracked trials")
    na, crowd = len(ground.rest), crowd_of(ground, rng, DRAWS)
    if most_precise:
        few, names = crowd.part(range(1 + LOOKED_AT)), list(FAMILIES)
        several = [FAMILIES[names[k % len(names)]] for k in range(DESIGNS)]
        tried = [ground.commands(own, rng.random(own.dimension(na)), rng.uniform(0.2, 1.0)) for own in several]
        inside = [o for o, m in zip(tried, few.motions(tried), strict=True) if limits.excess(m).worst <= 0]
        if inside:
            apart = separations(rivals, inside, simulator=rivals.simulator(1))
            precise = [np.linalg.slogdet(np.eye(s.stop - s.start) + own.gram[s, s])[1]
                       for own in apart for s in own.places[:1]]  # fmt: skip
            return kept(crowd, inside[int(np.argmax(precise))].commands)
    z = np.concatenate([rng.random(Multisine.shared), rng.random(Multisine.each * na)])
    return kept(crowd, ground.commands(Multisine(), z, 1.0).commands)


def others(found: Proof, options: ProveOptions, arms: Sequence[str], folder: Path) -> dict[str, list[list[Outcome]]]:
    """Outcomes of all cases in other arms, what is there read back."""
    request, limits = found.request, further_limits(options, found.request.model)
    assert limits is not None
    paths = {(arm, case): folder / "arms" / arm / f"case_{case:04d}.json"
             for arm in arms for case in range(options.cases)}  # fmt: skip
    missing = [key for key, path in paths.items() if not path.exists()]
    tasks = (
        (Arm(arm, request, limits, options.experiments), case, open_truth(request, case),
         json.loads(request.report(case).read_text()), recorded(request.recordings(case), request.model))
        for arm, case in missing
    )  # fmt: skip
    with Where(options.workers).opened(len(missing) or None) as executor:
        for index, outcomes in executor.each(Arm.outcomes, tasks):
            presets.write_text(paths[missing[index]], presets.json_text(outcomes))
            print(*missing[index], outcomes, flush=True)
    return {arm: [json.loads(paths[arm, case].read_text()) for case in range(options.cases)] for arm in arms}


def summary(found: Proof, several: Mapping[str, list[list[Outcome]]]) -> dict[str, Any]:
    """Shares that are right after each number of trials, arm by arm; all arms begin with the same answers."""
    designed = found.experiments
    assert designed is not None
    begun = designed.shares()[0]
    shares = {DESIGNED: list(designed.shares())} | {
        arm: [begun, *(Share.among(o in RIGHT for o in column) for column in zip(*rows, strict=True))]
        for arm, rows in several.items()
    }
    for arm, own in shares.items():
        print(f"{arm:12s} right after {', '.join(f'{k}: {share}' for k, share in enumerate(own))}")
    drawing = style.new_figure(11.0, 5.0, "Diagnoses with further trials")
    left, right = drawing.subplots(1, 2)
    shares_over_trials(left, {arm.replace("_", "-"): own for arm, own in shares.items()}, "further trials")
    gaps_scatter(right, designed.gaps)
    style.save(drawing, found.request.root / "arms.png")
    return {"right": {arm: [share.to_dict() for share in own] for arm, own in shares.items()}}


def main() -> None:
    """Draw, diagnose, add trials and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="leg", help="leg, or a model file")
    parser.add_argument("--kind", help="of all ground truths; drawn by default")
    parser.add_argument("--arms", nargs="+", default=[DESIGNED, *OTHERS], choices=(DESIGNED, *OTHERS))
    parser.add_argument("--trials", type=int, default=3, help="added at most")
    parser.add_argument("--limit", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--evaluations", type=int)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--output", type=Path, default=Path("build") / "experiments")
    given = parser.parse_args()
    if given.trials < 1:
        parser.error(f"trials is {given.trials}, expected at least 1")
    options = ProveOptions(
        cases=given.cases, seed=given.seed, kind=given.kind, experiments=given.trials, evaluations=given.evaluations,
        limit=dict(item.split("=", 1) for item in given.limit), workers=given.workers, baselines=False,
    )  # fmt: skip
    model: Model | None = None if given.robot == "leg" else load_model(Path(given.robot))
    found = prove(given.output, options, model=model, say=print)
    presets.write_text(given.output / "score.json", presets.json_text(found.to_dict()))
    whole = summary(found, others(found, options, [arm for arm in given.arms if arm != DESIGNED], given.output))
    presets.write_text(given.output / "summary.json", presets.json_text(whole))


if __name__ == "__main__":
    main()
