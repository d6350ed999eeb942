"""Do random designs keep the limits on robots drawn from what a diagnosis leaves open as often as they promise?

    equimus-ctrl prove FOLDER --experiments 1 --cases 8
    python benchmarks/design_limits.py FOLDER/reports/*.json [--model FILE] [--limit KEY=VALUE …] [--designs 1000]

Each design is one of a random family, with random numbers, at its full amplitude. It is shrunk about rest, as designs
are, until under every explanation that a record leaves, with its estimates and with draws of its parameters, no limit
is left. Then a true robot is drawn: one of the explanations, its parameters from the same distribution. By conformal
prediction the chance that it leaves a limit is at most 1/(draws + 1).
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.stats import binom
from threadpoolctl import threadpool_limits

from equimus_ctrl import presets
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.design import LIMIT_DRAWS
from equimus_ctrl.experiments.families import FAMILIES
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.limits import Limits, Motions
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import load_model
from equimus_ctrl.workflow.experiments import rivals_in

SIGNIFICANCE = 0.05
"""So rarely may as many robots or more leave the limits where each does with the chance that is stated."""


class Case:
    """The explanations of one record, with draws of each, and draws that take the robot's place."""

    def __init__(self, rivals: Rivals, limits: Limits, draws: int, truths: int, rng: np.random.Generator) -> None:
        self.ground = Ground.of(rivals, limits, KnownCondition(), rivals.simulator(1))
        own = rivals.rivals
        models = [rival.model for rival in own]
        models += [rival.model_at(theta) for rival in own for theta in rival.draws(rng, draws)]
        self.crowd = self.ground.crowd(models)
        chosen = rng.integers(len(own), size=truths)
        self.truths: Crowd = self.ground.crowd([own[k].model_at(own[k].draws(rng, 1)[0]) for k in chosen])

    def design(self, rng: np.random.Generator) -> tuple[str, float, Array]:
        """Family, the share of its amplitude that is left, and which true robots leave a limit (k,)."""
        family = FAMILIES[sorted(FAMILIES)[rng.integers(len(FAMILIES))]]
        rest = self.ground.rest
        course = self.ground.commands(family, rng.random(family.dimension(len(rest))), 1.0).course
        share, _ = self.crowd.within(course)
        (motions,) = self.truths.motions([self.ground.trial(rest + share * (course - rest))])
        several = range(len(self.truths.models))
        return family.name, share, np.array([self.ground.limits.excess(_one(motions, k)).left for k in several])


def _one(motions: Motions, k: int) -> Motions:
    command = None if motions.command is None else motions.command[[k]]
    return Motions(motions.times, motions.position[[k]], motions.rate[[k]], motions.rest[[k]], command)


def limits_of(model: Model, given: list[str]) -> Limits:
    """The robot's, and those that are given."""
    return Limits.read(model.robot, None, dict(item.split("=", 1) for item in given))


def main() -> None:
    """Design, drive and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="+")
    parser.add_argument("--model", type=Path, help="a model file; the nominal leg by default")
    parser.add_argument("--limit", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--designs", type=int, default=1000)
    parser.add_argument("--truths", type=int, default=1, help="true robots of each design")
    parser.add_argument("--draws", type=int, default=LIMIT_DRAWS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("build") / "design_limits.json")
    given = parser.parse_args()
    model = load_model(given.model)
    limits, rows, begun = limits_of(model, given.limit), [], time.process_time()
    with threadpool_limits(limits=1, user_api="blas"):
        for k, path in enumerate(given.records):
            count = given.designs // len(given.records) + (k < given.designs % len(given.records))
            rng = np.random.default_rng([given.seed, k])
            try:
                rivals = rivals_in(path, model)
                wanted = len(rows) + count
                while len(rows) < wanted:  # draws and truths of its own for each, or designs would not be independent
                    with suppress(ModelError):  # a truth that rests nowhere is none that was recorded
                        family, share, left = Case(rivals, limits, given.draws, given.truths, rng).design(rng)
                        rows.append({"record": str(path), "family": family, "share": share, "left": left.tolist()})
            except ConfigError as error:
                print(f"{path}: {error}")
            print(f"{path}: {len(rows)} designs, {time.process_time() - begun:.0f} s of CPU", flush=True)
    moved = [row for row in rows if row["share"] > 0]
    first = Share.among(row["left"][0] for row in moved)
    alone = Share.among(one for row in moved for one in row["left"])
    margin = 1 / (given.draws + 1)
    chance = float(binom.sf(first.count - 1, first.of, margin))
    print(f"{len(rows)} designs, {len(moved)} of them move; a true robot leaves the limits in {first} (of all {alone})")
    print(f"stated at most {100 * margin:.2g} %: as many or more with a chance of {chance:.2g}, "
          f"{'kept' if chance > SIGNIFICANCE else 'NOT kept'}")  # fmt: skip
    presets.write_text(given.output, presets.json_text({"margin": margin, "designs": rows}))


if __name__ == "__main__":
    main()
