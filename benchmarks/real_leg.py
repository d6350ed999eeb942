"""What does the diagnosis find in the recordings of the real leg, and how well does it do on the part held out?

Fitted are every other group of the step release and the first 20 s of the triangle; the other groups and the rest of
the triangle judge. The group that begins away from rest, from no pressure to none, is left out. Nothing is random,
unless a seed asks for another split: then half of the groups, drawn at random, and what comes before a time between
15 and 25 s are fitted.

    python benchmarks/real_leg.py [--output FOLDER] [--most COUNT] [--seed SEED] [--budget SECONDS]

The recordings, `step_release.csv` and `triangle.csv`, are those of `--recordings FOLDER`, found like the command's
(`EQUIMUS_RECORDINGS`) by default; record, page, corrected model and `summary.json` are written to `--output`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl import presets, workflow
from equimus_ctrl.diagnosis.results import STATES, Diagnosis
from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings import read_set
from equimus_ctrl.recordings.locate import leg_file, missing_hint
from equimus_ctrl.report.diagnosis_page import page

STEPS, TRIANGLE = "step_release", "triangle"
AWAY_FROM_REST = "step_release_p0_0"
UNTIL = 20.0
"""Of the triangle, what is fitted [s]."""
BETWEEN = 15.0, 25.0
"""The same of a random split."""
MOST = 4
"""Effects looked for together."""
GOAL = {TRIANGLE: (0.020, 0.045)}
"""Greatest RMSE, hip and knee [rad]."""
LEAST_GAIN = 0.65
"""Greatest RMSE after steps, as a share of the refitted model's."""


def diagnosed(folder: Path | None, most: int = MOST, seed: int | None = None, budget: float | None = None) -> Diagnosis:
    """The recordings diagnosed with the nominal leg.

    Args:
        folder: of the recordings.
        most: effects looked for together.
        seed: of a random split.
        budget: of time [s].

    Raises:
        RecordingError: where they are not found.
    """
    triangle, releases = leg_file("triangle", folder), leg_file("step_release", folder)
    if triangle is None or releases is None:
        raise RecordingError(missing_hint())
    steps = [t for t in read_set(releases) if t.name != AWAY_FROM_REST]
    held, until = steps[::2], UNTIL
    if seed is not None:
        rng = np.random.default_rng(seed)
        held = [steps[k] for k in sorted(rng.permutation(len(steps))[: len(held)])]
        until = float(np.round(rng.uniform(*BETWEEN), 1))
    return workflow.diagnose(
        [*read_set(triangle), *steps],
        validation=[trial.name for trial in held],
        until=until,
        most=most,
        budget=budget,
        progress=lambda stage, share, best: print(f"  {share:4.0%} {stage}: {best}", flush=True),
    )


def held_out(found: Diagnosis) -> dict[str, dict[str, list[float]]]:
    """Kind of the recording → state of the model → RMSE of its trials held out, hip and knee [rad]."""
    rows: dict[str, dict[str, list[float]]] = {}
    for kind in (TRIANGLE, STEPS):
        own = [k for k, segment in enumerate(found.validation) if segment.trial.name.startswith(kind)]
        rows[kind] = {
            state: np.sqrt(
                np.mean(np.concatenate([found.residuals[state].validation[k] for k in own]) ** 2, axis=0)
            ).tolist()
            for state in STATES
        }
    return rows


def tell(found: Diagnosis, rows: dict[str, dict[str, list[float]]]) -> None:
    """The outcome for people."""
    print(f"\n{found.verdict}, {found.seconds:.0f} s")
    for finding in found.findings:
        e = finding.evidence
        print(f"  {finding.named}: −2 log likelihood falls by {e.gain:.0f}, in validation by {e.validation_gain:.0f}")
        for key, number in finding.parameters.items():
            print(f"    {key} {number.value:.4g} ({number.low:.4g} to {number.high:.4g}) {number.unit}")
        if finding.equivalent:
            print("    or", ", ".join(map(str, finding.equivalent)))
    for left in found.unexplained:
        print(f"  unexplained at {left.location}: goes with {left.depends_on or 'nothing that was looked for'}")
    for own in found.rejected:
        print(f"  rejected: {own.named}: {own.reason} ({own.stage})")
    for kind, states in rows.items():
        for joint, name in enumerate(found.joints):
            told = " → ".join(f"{states[state][joint]:.4f}" for state in STATES)
            goal = GOAL[kind][joint] if kind in GOAL else LEAST_GAIN * states["refitted"][joint]
            print(f"  {kind}, {name}: {told} rad (nominal, refitted, corrected), goal {goal:.4f}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the recordings of the real leg."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--recordings", type=Path, help="folder of step_release.csv and triangle.csv")
    parser.add_argument("--output", type=Path, default=Path("real_leg"))
    parser.add_argument("--most", type=int, default=MOST, help="effects looked for together")
    parser.add_argument("--seed", type=int, help="of a random split")
    parser.add_argument("--budget", type=float, help="seconds after which the best so far is given")
    given = parser.parse_args(arguments)
    try:
        found = diagnosed(given.recordings, given.most, given.seed, given.budget)
    except RecordingError as error:
        raise SystemExit(str(error)) from None
    rows = held_out(found)
    tell(found, rows)
    given.output.mkdir(parents=True, exist_ok=True)
    record: dict[str, Any] = found.to_dict()
    presets.write_text(given.output / "record.json", presets.json_text(record))
    presets.write_text(given.output / "report.html", page(found, "The real leg"))
    workflow.save_model(given.output / "corrected.toml", workflow.renamed(found.corrected, "corrected"))
    (given.output / "summary.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
