"""How the answers of a proof move when each number that decides is halved and doubled: ``diagnosis/thresholds.py``.

python benchmarks/thresholds.py PROOF [--model robot.xml] [--first 0] [--cases 200] [--output FILE] [--budget SECONDS]
    [--numbers name ...] [--also name=value,... ...]

PROOF is a folder that ``equimus-ctrl prove`` made; its recordings are diagnosed again. While one is diagnosed, every
decision is asked once more with each number halved and doubled. Where all fall alike, the answer with that number is
known to be the same; only where one falls otherwise is the case diagnosed with it, fits and simulations that were done
for the case before taken over. A few numbers are read before anything is asked (``Threshold.read``): with these a case
is always diagnosed. What is done is kept in the output (a line of JSON a case), and the same command goes on
from there. At the end: a table in Markdown, the numbers that move most first. ``--numbers`` varies only these,
``--also`` tries other values, several at once too.

python benchmarks/thresholds.py --sum TABLE.json ... adds tables that ``--table FILE`` wrote, of proofs of other robots.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis import fitting, guessed_changes
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.holdout import Split, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.scoring import Score, score
from equimus_ctrl.proof.seal import opened
from equimus_ctrl.proof.store import recorded

FACTORS = (0.5, 2.0)
READ = tuple(t.name for t in Thresholds.listed() if t.read)
"""Numbers that make another number before anything is asked: with these a case is always diagnosed again."""
SHOWN = ("false_alarms", "single", "single_group", "pair", "outside")
"""Goals of a proof whose counts are told."""


def varied(also: Sequence[str], numbers: Sequence[str] = ()) -> dict[str, Thresholds]:
    """Each number, or each of those named, halved and doubled, and what else is asked for, as ``name=value,...``.

    Raises:
        ValueError: of a threshold that there is not, or no number.
    """
    own, known = Thresholds(), [t.name for t in Thresholds.listed()]
    if odd := sorted(set(numbers) - set(known)):
        raise ValueError(f"--numbers: there is no threshold {odd[0]}, expected of {', '.join(sorted(known))}")
    variants = {f"{name} {f:g}": own.scaled(name, f) for name in numbers or known for f in FACTORS}
    for text in also:
        values = dict(pair.split("=", 1) if "=" in pair else (pair, "") for pair in text.split(","))
        if odd := sorted(set(values) - set(known)):
            raise ValueError(f"--also {text}: there is no threshold {odd[0]}, expected of {', '.join(sorted(known))}")
        try:
            variants[text] = replace(own, **{name: float(value) for name, value in values.items()})
        except ValueError:
            raise ValueError(f"--also {text}: expected name=value, the value a number") from None
    return variants


class Flips:
    """Which other thresholds would have let a decision fall otherwise.

    Args:
        variants: the thresholds, by name.
    """

    def __init__(self, variants: Mapping[str, Thresholds]) -> None:
        self.found: set[str] = set()
        self._variants = variants

    def __call__(self, condition: Callable[[Thresholds], bool], holds: bool) -> None:
        """Take note of a decision."""
        for variant, thresholds in self._variants.items():
            if variant not in self.found and bool(condition(thresholds)) != holds:
                self.found.add(variant)


class Memory:
    """Fits and screenings of one case, by all that they depend on: the same is not worked out twice."""

    def __init__(self) -> None:
        self._known: dict[Hashable, Any] = {}

    @contextmanager
    def used(self) -> Iterator[None]:
        """Diagnoses meanwhile take over what is known."""
        fit, changed = fitting.fit, guessed_changes.changes_of

        def fitted(parameters: Any, segments: Any, **given: Any) -> Any:
            begin = tuple((theta.tobytes(), _bytes(starts)) for theta, starts in given["begin"])
            earlier, simulator, coarse = given.get("earlier"), given["simulator"], given["coarse"]
            key = (
                "fit", _free(parameters), _segments(segments), _engine(simulator), coarse and _engine(coarse),
                given["settings"], given["noise"], begin,
                earlier and (earlier.theta.tobytes(), _bytes(earlier.starts)),
            )  # fmt: skip
            return self._of(key, lambda: fit(parameters, segments, **given))

        def changes(data: Any, at: Any, reference: Any, guesses: Any, thetas: Any = None) -> list[Any]:
            own = (_free(at.fit.parameters), at.fit.theta.tobytes(), _bytes(at.fit.starts))
            own = (*own, _segments(data.segments), _engine(data.coarse or data.simulator))
            moved = thetas or [None] * len(guesses)
            keys = [
                ("change", own, _hypothesis(guess), None if theta is None else theta.tobytes())
                for guess, theta in zip(guesses, moved, strict=True)
            ]
            if new := [k for k, key in enumerate(keys) if key not in self._known]:
                found = changed(data, at, reference, [guesses[k] for k in new], thetas and [thetas[k] for k in new])
                for place, k in enumerate(new):
                    self._known[keys[k]] = [segment[:, :, place] for segment in found]
            known = [self._known[key] for key in keys]
            return [np.stack(of_segment, axis=2) for of_segment in zip(*known, strict=True)]

        with patch.object(fitting, "fit", fitted), patch.object(guessed_changes, "changes_of", changes):
            yield

    def _of(self, key: Hashable, work: Callable[[], Any]) -> Any:
        if key not in self._known:
            self._known[key] = work()
        return self._known[key]


def _engine(simulator: Any) -> Hashable:
    engine = simulator.engine
    return engine.name, engine.step if engine.costly else None  # the other's step follows from the model


def _free(parameters: Any) -> Hashable:
    return parameters.free, parameters.model.effects


def _hypothesis(parts: Any) -> Hashable:
    return tuple((part.candidate.label, tuple(part.values.items())) for part in parts)


def _bytes(arrays: Sequence[Any]) -> Hashable:
    return tuple(a.tobytes() for a in arrays)


def _segments(segments: Sequence[Any]) -> Hashable:
    return tuple((s.recording, s.trial.name, s.trial.start, len(s.measured), s.free_start) for s in segments)


def answered(model: Model, parts: Split, thresholds: Thresholds) -> dict[str, Any]:
    """What a proof would keep of a case's report."""
    free, begun, processor = default_free_parameters(model), time.perf_counter(), time.process_time()
    said: dict[str, Any] = {}
    failed = ""
    try:
        said = diagnose(free, parts, settings=DiagnosisSettings(threads=1, thresholds=thresholds)).to_dict()
    except EquimusError as error:
        failed = str(error)
    spent = {
        "failed": failed,
        "seconds": time.perf_counter() - begun,
        "cpu_seconds": time.process_time() - processor,
        "peak_memory_byte": None,
    }
    kept = ("verdict", "findings", "unexplained", "rejected", "parameters", "rmse_rad", "trials", "noise_rad")
    return {**{key: said[key] for key in kept if key in said}, "proof": spent}


def case_row(model: Model, root: Path, case: int, variants: Mapping[str, Thresholds]) -> dict[str, Any]:
    """A case's answer, and those that differ by other thresholds."""
    folder, flips = root / "recordings" / f"case_{case:04d}", Flips(variants)
    parts = split(model, recorded(folder, model))
    with Memory().used():
        base = answered(model, parts, Thresholds(watch=flips))
        read = {v for v, t in variants.items() if any(getattr(t, n) != getattr(Thresholds(), n) for n in READ)}
        others = {name: answered(model, parts, variants[name]) for name in sorted(flips.found | read)}
    return {"case": case, "asked": list(variants), "base": base, "varied": others}


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two answers say the same: verdict, names and places."""
    return said(one) == said(other)


def said(answer: Mapping[str, Any]) -> tuple[str, list[tuple[str, list[str]]]]:
    """Verdict, and effects with their places."""
    named = [(f["effect"], f["locations"]) for f in answer.get("findings", [])]
    return answer.get("verdict", "failed"), sorted(named)


def table(
    rows: list[dict[str, Any]], truths: list[Mapping[str, Any]], model: Model, variants: Sequence[str]
) -> list[dict[str, Any]]:
    """For the numbers as they are and for each varied: how many answers changed, and what the proof comes to."""

    def scored(answers: list[dict[str, Any]]) -> Score:
        return score(truths, answers, [{} for _ in answers], model.robot)

    base = [row["base"] for row in rows]
    lines = [{"name": "as they are", "factor": 1.0, "decided": 0, "changed": 0, **counts(scored(base))}]
    for key in variants:
        name, _, factor = key.partition(" ")
        answers = [row["varied"].get(key, row["base"]) for row in rows]
        changed = sum(not same(a, b) for a, b in zip(answers, base, strict=True))
        decided = sum(key in row["varied"] for row in rows)
        line = {"name": name, "factor": float(factor or 0), "decided": decided, "changed": changed}
        lines.append({**line, **(counts(scored(answers)) if changed else {k: lines[0][k] for k in SHOWN})})
    return lines


def counts(found: Score) -> dict[str, str]:
    """Goals met, of how many."""
    return {
        goal.name: f"{goal.share.count}/{goal.share.of}" for goal in found.goals if goal.name in SHOWN and goal.share
    }


def added(tables: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """One table of several proofs."""

    def share(texts: Sequence[str]) -> str:
        return "/".join(str(sum(int(text.split("/")[k]) for text in texts)) for k in (0, 1))

    lines = []
    for same in zip(*tables, strict=True):
        whole = {key: sum(line[key] for line in same) for key in ("decided", "changed")}
        lines.append({**same[0], **whole, **{key: share([line[key] for line in same]) for key in SHOWN}})
    return lines


def told(lines: list[dict[str, Any]]) -> str:
    """The lines as a table, the numbers that change most answers first."""
    moved = {line["name"]: 0 for line in lines}
    for line in lines:
        moved[line["name"]] = max(moved[line["name"]], line["changed"])
    ordered = sorted(
        lines, key=lambda line: (line["factor"] != 1.0, -moved[line["name"]], line["name"], line["factor"])
    )
    head = ("number", "times", "asked otherwise", "answers changed", *(name.replace("_", " ") for name in SHOWN))
    text = [f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |"]
    for line in ordered:
        cells = (
            line["name"],
            f"{line['factor']:g}" if line["factor"] else "",
            line["decided"],
            line["changed"],
            *(line[k] for k in SHOWN),
        )
        text.append(f"| {' | '.join(str(cell) for cell in cells)} |")
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("proof", type=Path, nargs="?")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="case to begin with, to share the work among processes")
    parser.add_argument("--output", type=Path, default=Path("thresholds.jsonl"))
    parser.add_argument("--budget", type=float, help="no case is begun after this time [s]")
    parser.add_argument("--numbers", nargs="+", default=[], metavar="NAME", help="vary only these")
    parser.add_argument("--also", nargs="*", default=[], metavar="NAME=VALUE,...", help="other values to try")
    parser.add_argument("--table", type=Path, help="write the table as JSON here, for --sum")
    parser.add_argument("--sum", type=Path, nargs="+", help="add these tables; nothing is diagnosed")
    given = parser.parse_args()
    if given.sum:
        if missing := [file for file in given.sum if not file.is_file()]:
            parser.error(f"{missing[0]}: there is no such file, expected one that --table wrote")
        tables = [json.loads(file.read_text(encoding="utf-8")) for file in given.sum]
        numbers = [[(line["name"], line["factor"]) for line in table] for table in tables]
        if odd := [file for file, own in zip(given.sum, numbers, strict=True) if own != numbers[0]]:
            parser.error(f"{odd[0]}: its numbers are not those of {given.sum[0]}, expected tables of one version")
        print(told(added(tables)))
        return
    if given.proof is None:
        parser.error("expected a proof's folder, or --sum")
    if not (given.proof / "recordings").is_dir():
        parser.error(f"{given.proof}: holds no recordings, expected a folder that `equimus-ctrl prove` made")
    try:
        variants = varied(given.also, given.numbers)
    except ValueError as error:
        parser.error(str(error))
    model = nominal_model() if given.model is None else workflow.load_model(given.model)
    known = {}
    if given.output.exists():
        rows = map(json.loads, given.output.read_text(encoding="utf-8").splitlines())
        # A case that was not asked with all of these is diagnosed again.
        known = {row["case"]: row for row in rows if set(variants) <= set(row.get("asked", ()))}
    begun = time.monotonic()
    with given.output.open("a", encoding="utf-8") as file:
        for case in range(given.first, given.cases):
            if case in known:
                continue
            if given.budget is not None and time.monotonic() - begun > given.budget:
                break
            known[case] = case_row(model, given.proof, case, variants)
            file.write(json.dumps(known[case]) + "\n")
            file.flush()
            asked = len(known[case]["varied"])
            print(
                f"case {case}: {said(known[case]['base'])}, {asked} variants, {time.monotonic() - begun:.0f} s",
                flush=True,
            )
    rows = [known[case] for case in sorted(known) if case < given.cases]
    truths = []
    for row in rows:
        name = f"case_{row['case']:04d}"
        line, seal = (given.proof / "truth" / f"{name}.json"), (given.proof / "seals" / f"{name}.txt")
        truths.append(opened(line.read_text().strip(), seal.read_text().strip(), str(line)))
    lines = table(rows, truths, model, list(variants))
    if given.table:
        given.table.write_text(json.dumps(lines), encoding="utf-8")
    print(told(lines))


if __name__ == "__main__":
    main()
