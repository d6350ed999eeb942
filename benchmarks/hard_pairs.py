"""Pairs of explanations that are hard to tell apart: what do designed trials make of either, hidden in a simulation?

    python benchmarks/hard_pairs.py [--pair NAME …] [--trials 3] [--seed 0] [--threads 2]

Of each pair both sides are hidden, one after the other. Each is begun with two short and poor trials, as proofs are
(``proof.poor``), and goes on with ``equimus-ctrl experiment run``. Told is what is named after each number of trials,
with how many explanations there are, and how the loop ends. What is in the folder already is not done again.
"""

from __future__ import annotations

import argparse
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects import parse
from equimus_ctrl.experiments.loop import label_of
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import RunExperimentsOptions
from equimus_ctrl.proof.poor import poor_recordings
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import load_model
from equimus_ctrl.workflow.experiment_runs import run_experiments
from equimus_ctrl.workflow.experiments import limits_for

LEG, ARM, GEARED = "leg", "benchmarks/two_joint_arm.xml", "benchmarks/geared_joint.xml"
NOISE = 1e-3
"""Standard deviation of measured angles [rad]."""
POOR = 2
"""Trials that each begins with."""
SECONDS = 6.0
"""That each trial lasts."""


@dataclass(frozen=True)
class Pair:
    """Two explanations of what is much the same in many recordings.

    Attributes:
        name: of the pair.
        sides: what is hidden of either.
        robot: that hides it.
        can: known conditions that designed trials may take.
    """

    name: str
    sides: tuple[tuple[str, ...], tuple[str, ...]]
    robot: str = LEG
    can: tuple[str, ...] = ()


PAIRS = (
    Pair("late sensors or valves", (
        ("sensor_delay:hip:delay=0.05", "sensor_delay:knee:delay=0.05"),
        ("transport_delay:maa:delay=0.05", "transport_delay:baa:delay=0.05"),
    )),
    Pair("friction at MAA or hip", (("coulomb_friction:maa:friction=0.6",), ("coulomb_friction:hip:friction=0.015",))),
    Pair("Stribeck or Coulomb", (
        ("stribeck_friction:shoulder:friction=0.05,breakaway=0.1,velocity=0.1",),
        ("coulomb_friction:shoulder:friction=0.05",),
    ), ARM),
    Pair("payload or tilt", (("payload_mass:thigh:mass=0.05",), ("gravity_tilt:base:angle=0.05",))),
    Pair("play before or behind the drive", (
        ("drive_play:joint:play=0.03",), ("backlash:joint:play=0.03",),
    ), GEARED),
    Pair("load friction or Coulomb", (
        ("load_friction:shoulder:share=0.08",), ("coulomb_friction:shoulder:friction=0.15",),
    ), ARM, can=("payload:forearm=0.3",)),
)  # fmt: skip


@dataclass(frozen=True)
class Told:
    """What became of a side.

    Attributes:
        hidden: the effects.
        steps: what is named after each number of trials, and the explanations beside it.
        end: how the loop ends.
    """

    hidden: tuple[str, ...]
    steps: tuple[str, ...]
    end: str


def first_recordings(hidden: Model, options: RunExperimentsOptions, seed: int) -> tuple[Recording, ...]:
    """Small chirps of a robot that hides something, with noise."""
    rng = np.random.default_rng(seed)
    limits = replace(limits_for(options, hidden.robot), duration=SECONDS)
    return tuple(
        replace(own, position=own.position + NOISE * rng.standard_normal(own.position.shape))
        for own in poor_recordings(hidden, limits, POOR, seed)
    )


def what_is_left(rivals: Rivals) -> str:
    """What is named, and how many explanations there are beside it."""
    first, *others = (label_of(own) for own in rivals.named)
    beside = len(rivals.rivals) - 1 - len(others)
    return first + (f" or {', '.join(others)}" if others else "") + (f" (+ {beside} that may hide)" if beside else "")


def told(pair: Pair, side: int, options: RunExperimentsOptions, folder: Path) -> Told:
    """Run the loop with one side of a pair hidden."""
    model = nominal_model() if pair.robot == LEG else load_model(Path(pair.robot))
    effects = tuple(parse(text) for text in pair.sides[side])
    options = replace(options, can=pair.can, duration=SECONDS)
    seed = options.seed + zlib.crc32(f"{pair.name} {side}".encode()) % 1000
    recordings = first_recordings(replace(model, effects=(*model.effects, *effects)), options, seed)
    found = run_experiments(folder, recordings, model, replace(options, seed=seed), effects=effects, noise=NOISE)
    return Told(pair.sides[side], tuple(what_is_left(own.rivals) for own in found.steps), found.said)


def main() -> None:
    """Run the loops and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", action="append", choices=[pair.name for pair in PAIRS], help="all by default")
    parser.add_argument("--trials", type=int, default=3, help="designed ones, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--output", type=Path, default=Path("build") / "hard_pairs")
    given = parser.parse_args()
    options = RunExperimentsOptions(trials=given.trials, seed=given.seed, threads=given.threads)
    rows = list[Told]()
    for k, pair in enumerate(PAIRS):
        if given.pair and pair.name not in given.pair:
            continue
        for side in range(2):
            own = told(pair, side, options, given.output / f"pair_{k}_{'ab'[side]}")
            rows.append(own)
            print(f"{pair.name}: hidden {' and '.join(own.hidden)}")
            for number, left in enumerate(own.steps):
                print(f"  after {number}: {left}")
            print(f"  {own.end}", flush=True)
    text = presets.json_text([vars(row) for row in rows])
    presets.write_text(given.output / "pairs.json", text)


if __name__ == "__main__":
    main()
