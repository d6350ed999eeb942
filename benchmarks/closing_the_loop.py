"""Does a controller tuned on the corrected model track better on a blinded ground truth?

Legs with one or two effects that the model lacks are drawn and recorded as `equimus-ctrl prove` does. Those whose
effects leave too little in the recordings are passed over, the others diagnosed. The PID is tuned with one study on the
nominal, the refitted and the corrected model, computes with the model it was tuned on, and drives the leg: round the
triangle that the study tunes for, and along a sweep of pressures that it has not seen. Both references are poses at
which the leg rests under pressures, so that it can follow them. Scored are true joint angles against the reference
after the first second, which brings the leg to the path; what a sensor conceals counts.

    python benchmarks/closing_the_loop.py [--cases 12] [--seed 31] [--budget 320] [--output FOLDER] [--static]

What is in the folder already is not done again. `--static` tunes and drives with static feed-forward alone.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from equimus_ctrl import presets
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.results import STATES
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import EquimusError, SimulationDiverged
from equimus_ctrl.loop import run
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.proof.drawing import GroundTruth, findings
from equimus_ctrl.proof.legs import draw
from equimus_ctrl.proof.store import Request, make_case, open_truth
from equimus_ctrl.recordings.sets import read_set
from equimus_ctrl.report import style
from equimus_ctrl.scenarios.references import SampledReference, foot_path
from equimus_ctrl.types import Array, Observation, Reference, Start
from equimus_ctrl.workflow import load_model, save_model, tune_into

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("single", "pair")
"""Of the ground truths, in turn."""
LEAST_EXCESS = 0.3
"""Of what is left in the recordings when the ten default parameters have been fitted, over the noise's variance."""
DURATION, SCORED_FROM = 14.0, 1.0
"""Of a drive, and from when on it counts [s]."""
SWEEP = {"mean": (14e3, 10e3), "amplitude": 5e3, "low": 0.1, "high": 0.8, "rate": 30.0}
"""The reference that no tuning has seen: pressures [Pa] between two frequencies [Hz], poses so many times a second."""
GOAL = 0.7
"""Corrected over refitted that the median is to reach."""
FOUND = ("explained", "partly_explained")
STREAM = 77
"""Of the noise while driving, apart from the streams that drew the ground truth."""


class Watched:
    """A ground truth as a plant: its own noise on what is measured; its true angles are kept."""

    def __init__(self, ground_truth: GroundTruth, known: Model, which: int) -> None:
        self._plant = MujocoPlant(ground_truth.model, nominal=known)
        self.spec, self.close = self._plant.spec, self._plant.close
        self._ground_truth, self._which = ground_truth, which
        self.position: list[Array] = []

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        self.position.clear()
        self._rng = np.random.default_rng([self._ground_truth.seed, self._ground_truth.case, STREAM, self._which])
        self._noise = self._rng.standard_normal(len(self.spec.joints))
        return self._seen(self._plant.reset(start, seed))

    def step(self, command: Any) -> Observation:
        late, dt = self._ground_truth.correlation, self.spec.control_dt
        kept = math.exp(-dt / late) if late > 0 else 0.0
        fresh = self._rng.standard_normal(len(self.spec.joints))
        self._noise = kept * self._noise + math.sqrt(1 - kept**2) * fresh
        return self._seen(self._plant.step(command))

    def _seen(self, observation: Observation) -> Observation:
        self.position.append(self._plant.position)
        return replace(observation, position=observation.position + self._noise * np.array(self._ground_truth.noise))


def references(model: Model) -> dict[str, Reference]:
    """What a ground truth is to follow, by name: true angles."""
    corners = 1e3 * np.array(presets.load_script(ROOT / "scenarios" / "triangle.py").CORNERS_KPA)
    times = np.arange(0.0, DURATION, 1 / SWEEP["rate"])
    rate = math.log(SWEEP["high"] / SWEEP["low"]) / DURATION
    phase = 2 * np.pi * SWEEP["low"] * (np.exp(rate * times) - 1) / rate
    swept = [mean + SWEEP["amplitude"] * np.sin(phase * (1 + 0.37 * i)) for i, mean in enumerate(SWEEP["mean"])]
    kinematics = Kinematics(model.morphology, model.phase)
    return {
        "triangle": foot_path(kinematics, [rest_pose(model, p) for p in corners], 2.0, DURATION),
        "sweep": SampledReference(times, np.array([rest_pose(model, p) for p in np.transpose(swept)])),
    }


def driven(
    ground_truth: GroundTruth, known: Model, settings: PidSettings, wanted: Mapping[str, Reference]
) -> dict[str, Any]:
    """For each reference the root mean square error of all joints [rad] and the share of commands at a limit."""
    found = {}
    for k, (name, reference) in enumerate(wanted.items()):
        plant = Watched(ground_truth, known, k)
        try:
            done = run(plant, PidController(settings), reference, DURATION)
        except SimulationDiverged:
            found[name] = {"rmse": None, "limited": None}
            continue
        own = done.time >= SCORED_FROM
        error = np.array(plant.position[: len(done.time)])[own] - done.reference[own]
        limits = (done.command <= plant.spec.command_low) | (done.command >= plant.spec.command_high)
        found[name] = {"rmse": float(np.sqrt((error**2).mean())), "limited": float(limits[own].mean())}
    return found


def tuned(model: Model, folder: Path, name: str, options: argparse.Namespace) -> PidSettings:
    """Gains from the command's own study, as the command finds them; searched once."""
    path = folder / f"{name}_pid.toml"
    if not path.exists():
        tune_into(
            "pid",
            options.output / "study.toml",
            model=model,
            candidates=options.budget,
            output=path,
            folder=folder / f"{name}_tuning",
            workers=options.workers,
        )
    return PidSettings.from_dict(presets.read_toml(path), str(path))


def diagnosed(recordings: Path, folder: Path) -> dict[str, Any]:
    """What the diagnosis says of recordings; its models are beside it. Made once."""
    path = folder / "diagnosis.json"
    if not path.exists():
        free = default_free_parameters(nominal_model())
        found = diagnose(free, split(free.model, read_set(recordings)), settings=DiagnosisSettings(threads=1))
        for state in STATES[1:]:
            save_model(folder / f"{state}.toml", getattr(found, state))
        presets.write_text(path, presets.json_text(found.to_dict()))
    said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return said


def concealed(ground_truth: GroundTruth) -> str:
    """What a ground truth leaves out of the nominal leg, for people."""
    return " + ".join(f"{name.replace('_', ' ')} ({', '.join(at)})" for name, at, _ in findings(ground_truth.effects))


def one(case: int, request: Request, options: argparse.Namespace) -> dict[str, Any]:
    """The result of one case, from its file where that is there."""
    folder = options.output / f"case_{case:04d}"
    path = folder / "result.json"
    if path.exists():
        known: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return known
    ground_truth = draw(request.seed, case, kind=request.kind)
    said = diagnosed(request.recordings(case), folder)
    named = [f"{f['effect'].replace('_', ' ')} ({', '.join(f['locations'])})" for f in said["findings"]]
    result = {
        "case": case,
        "kind": request.kind,
        "concealed": concealed(ground_truth),
        "excess": open_truth(request, case)["excess"],
        "verdict": said["verdict"],
        "named": " + ".join(named),
        "tracking": {},
        "failed": {},
    }
    if said["verdict"] in FOUND:
        wanted = references(ground_truth.model)
        for state in STATES:
            model = nominal_model() if state == "nominal" else load_model(folder / f"{state}.toml")
            try:
                settings = tuned(model, options.output if state == "nominal" else folder, state, options)
                result["tracking"][state] = driven(ground_truth, model, settings, wanted)
            except EquimusError as error:
                result["failed"][state] = str(error)
    presets.write_text(path, presets.json_text(result))
    return result


def cases(options: argparse.Namespace) -> Iterator[tuple[int, Request]]:
    """The first cases that leave enough in their recordings."""
    case, found = 0, 0
    while found < options.cases:
        kind = KINDS[case % len(KINDS)]
        request = Request(options.output / kind, options.seed, kind)
        make_case(request, case)
        if open_truth(request, case)["excess"] >= LEAST_EXCESS:
            found += 1
            yield case, request
        case += 1


def rmse(result: Mapping[str, Any], state: str, name: str) -> float:
    """[rad]; infinite where the drive or the tuning failed."""
    value = result["tracking"].get(state, {}).get(name, {}).get("rmse")
    return math.inf if value is None else float(value)


def ratio(result: Mapping[str, Any], other: str, name: str) -> float:
    """Error with the corrected model over that with another; 1 where both failed."""
    above, below = rmse(result, "corrected", name), rmse(result, other, name)
    return 1.0 if math.isinf(above) and math.isinf(below) else above / below


def summary(results: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """Medians of the ratios over the cases in which something was found, and over all."""
    scored = [r for r in results if r["verdict"] in FOUND]
    found: dict[str, Any] = {"cases": len(results), "found": len(scored), "goal": GOAL, "median_ratio": {}}
    for name in names:
        for other in ("refitted", "nominal"):
            own = [ratio(r, other, name) for r in scored]
            both = [*own, *[1.0] * (len(results) - len(scored) if other == "refitted" else 0)]
            found["median_ratio"][f"{name}, corrected over {other}"] = {
                "found": statistics.median(own) if own else None,
                "all": statistics.median(both) if both and other == "refitted" else None,
                "better": sum(value < 1 for value in own),
                "reach_goal": sum(value <= GOAL for value in own),
            }
    return found


def table(results: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """Case by case: errors [mrad] with each model, and the corrected one's over the refitted one's."""
    head = f"{'case':>4}  {'concealed':58} {'excess':>7}  "
    head += "  ".join(f"{f'{name}: nominal':>17} {'refitted':>8} {'corrected':>9} {'ratio':>6}" for name in names)
    lines = [head]
    for r in results:
        line = f"{r['case']:4d}  {r['concealed'][:58]:58} {r['excess']:7.3g}  "
        if r["verdict"] not in FOUND:
            lines.append(f"{line}{r['verdict']}: not scored")
            continue
        for name in names:
            nominal, refitted, corrected = (1e3 * rmse(r, state, name) for state in STATES)
            line += f"{nominal:17.2f} {refitted:8.2f} {corrected:9.2f} {ratio(r, 'refitted', name):6.2f}  "
        right = sorted(r["named"].split(" + ")) == sorted(r["concealed"].split(" + "))
        lines.append(line + ("" if right else f"named {r['named']}"))
        lines += [f"{'':6}{state}: {why}" for state, why in r["failed"].items()]
    return "\n".join(lines)


def figure(results: Sequence[Mapping[str, Any]], names: Sequence[str], path: Path) -> None:
    """Ratios by case, sorted by the first reference's, labelled by what was concealed."""
    scored = sorted((r for r in results if r["verdict"] in FOUND), key=lambda r: ratio(r, "refitted", names[0]))
    title = "Tracking error on concealed legs: tuned on the corrected model over tuned on the refitted one"
    drawn = style.new_figure(11.0, 1.6 + 0.3 * max(len(scored), 3), title)
    axes = drawn.add_subplot()
    for k, (name, marker) in enumerate(zip(names, "os", strict=True)):
        values = [ratio(r, "refitted", name) for r in scored]
        label = f"{name}: median {statistics.median(values):.2f}" if values else name
        axes.plot(values, range(len(values)), marker, color=style.joint_colour(k), label=label, markersize=6)
    for place, text in ((1.0, "as good"), (GOAL, "30 % lower")):
        axes.axvline(place, color=style.FAINT, linewidth=style.THIN_WIDTH, linestyle=style.DASHES)
        axes.annotate(
            text, (place, 1.0), xytext=(-3 if place < 1 else 3, -2), textcoords="offset points",
            xycoords=("data", "axes fraction"), fontsize=style.SMALL_SIZE, color=style.FAINT, va="top",
            ha="right" if place < 1 else "left",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(len(scored) - 0.3, -1.2)
    axes.set_yticks(range(len(scored)), [r["concealed"] for r in scored])
    style.dress(axes, x="RMS error of the true joint angles, corrected / refitted")
    style.legend_below(drawn, axes.get_legend_handles_labels()[0])
    style.save(drawn, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12, help="ground truths that leave enough in their recordings")
    parser.add_argument("--seed", type=int, default=31, help="of the ground truths")
    parser.add_argument("--budget", type=int, default=320, help="sets of gains tried on each model")
    parser.add_argument("--output", type=Path, default=Path("results/closing_the_loop"))
    parser.add_argument("--workers", type=int, help="threads of the tuning; all cores by default")
    parser.add_argument("--static", action="store_true", help="static feed-forward in place of the inverse")
    options = parser.parse_args()
    study = presets.read_toml(ROOT / "tuning" / "pid.toml")
    asked = {"seed": options.seed, "budget": options.budget, "static": options.static}
    claim = options.output / "asked.json"
    if claim.exists() and json.loads(claim.read_text(encoding="utf-8")) != asked:
        raise SystemExit(f"{options.output}: holds results of other settings; choose another folder")
    presets.write_text(claim, presets.json_text(asked))
    presets.write_text(options.output / "study.toml", presets.toml_text({**study, "inverse": not options.static}))
    results = []
    for case, request in cases(options):
        results.append(one(case, request, options))
        print(table(results[-1:], ("triangle", "sweep")).splitlines()[1], flush=True)
    names = ("triangle", "sweep")
    found = summary(results, names)
    print("\n" + table(results, names) + "\n")
    print(f"{found['found']} of {found['cases']} diagnoses found something")
    for label, row in found["median_ratio"].items():
        shown = "" if row["all"] is None else f" (with those not found as 1: {row['all']:.3f})"
        print(
            f"{label}: median {row['found']:.3f}{shown}; better in {row['better']}, at most {GOAL:g} in "
            f"{row['reach_goal']} of {found['found']}"
        )
    presets.write_text(
        options.output / "closing_the_loop.json", presets.json_text({**asked, **found, "results": results})
    )
    figure(results, names, options.output / "closing_the_loop.png")


if __name__ == "__main__":
    main()
