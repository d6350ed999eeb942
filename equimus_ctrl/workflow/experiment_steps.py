"""Steps of experiments in a loop, as the files in their folder have them, and the log of all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.experiments.loop import Belief, End, Predicted, Realised, unforeseen
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short, counted
from equimus_ctrl.types import Recording

SCHEMA = "equimus-ctrl/experiments/1"


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Short):
    """A trial that is to be made.

    Attributes:
        trial: its name.
        file: its commands.
        duration: [s].
        notes: of what is known to be different in it.
        why: it was chosen, as a clause.
        predicted: what it is expected to distinguish.
        record: all that is known of the design.
    """

    trial: str
    file: Path
    duration: float
    notes: Mapping[str, str]
    why: str
    predicted: tuple[Predicted, ...]
    record: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "trial": self.trial,
            "duration_s": self.duration,
            "notes": dict(self.notes),
            "why": self.why,
            "predicted": [own.to_dict() for own in self.predicted],
            "design": dict(self.record),
        }

    @classmethod
    def read(cls, folder: Path) -> Plan | None:
        """Of a step's folder; None where it was not planned."""
        if (data := read_json(folder / "design.json")) is None:
            return None
        pairs = tuple(Predicted.from_dict(own) for own in data["predicted"])
        own = folder / "design.csv"
        return cls(data["trial"], own, data["duration_s"], data["notes"], data["why"], pairs, data["design"])


@dataclass(frozen=True, eq=False, repr=False)
class Step(Short):
    """A trial, where one was made, and the explanations after it.

    Attributes:
        number: 0 for what there was before.
        plan: of the trial; None of step 0 where there were recordings.
        belief: after it.
        realised: what became of its predictions.
        rivals: that are left.
        verdict: of the diagnosis.
        findings: of it, as JSON data.
        seconds: that the diagnosis took.
    """

    number: int
    plan: Plan | None
    belief: Belief
    realised: tuple[Realised, ...]
    rivals: Rivals
    verdict: str
    findings: tuple[Mapping[str, Any], ...]
    seconds: float

    @property
    def doubt(self) -> str:
        """Why what is named is hardly what is there, as a clause; "" where nothing speaks against it."""
        if not (against := unforeseen(self.realised)):
            return ""
        worst = max(against, key=lambda own: own.predicted.gap - own.gap)
        own, trial = worst.predicted, self.plan.trial if self.plan else "the trial"
        return (
            f"{trial} went as it hardly does with {own.true} as the whole truth (a gap of {own.gap:.3g}, "
            f"{own.low:.3g} to {own.high:.3g}, was expected against {own.other}, and {worst.gap:.3g} is seen): "
            "something that has no name may be there"
        )

    @classmethod
    def read(cls, folder: Path, number: int, plan: Plan | None, model: Model) -> Step | None:
        """Of a step's folder; None where it was not done to its end."""
        record, said = read_json(folder / "diagnosis.json"), read_json(folder / "belief.json")
        if record is None or said is None:
            return None
        return cls(
            number,
            plan,
            Belief.from_dict(said["belief"]),
            tuple(Realised.from_dict(own) for own in said["realised"]),
            Rivals.from_dict(record["rivals"], model),
            record["verdict"],
            tuple(record["findings"]),
            record["seconds"],
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON data, a line of the log."""
        return {
            "step": self.number,
            **({"chosen": self.plan.to_dict()} if self.plan else {}),
            "belief": self.belief.to_dict(),
            "findings": [dict(own) for own in self.findings],
            "realised": [own.to_dict() for own in self.realised],
            **({"doubt": self.doubt} if self.doubt else {}),
            "diagnosis_seconds": self.seconds,
        }


@dataclass(frozen=True, eq=False, repr=False)
class ExperimentRun(Short):
    """Experiments that were made, and the explanations in the end.

    Attributes:
        model: the nominal one.
        folder: with all of it.
        steps: in order.
        end: why there was no further trial.
        said: the same as a sentence.
        trials: recordings of those that were made.
        files: log of it.
    """

    model: Model
    folder: Path
    steps: tuple[Step, ...]
    end: End
    said: str
    trials: tuple[Recording, ...]
    files: tuple[Path, ...]

    def told(self) -> str:
        """How many trials were made, and the explanations."""
        return f" with {self.model.name}: {counted(len(self.trials), 'trial')}, {self.said}; {self.steps[-1].belief}"

    def to_dict(self) -> dict[str, Any]:
        """What ``experiment run --json`` prints."""
        return {
            "schema": SCHEMA,
            "robot": self.model.name,
            "end": self.end,
            "said": self.said,
            "trials": [trial.name for trial in self.trials],
            "steps": [own.to_dict() for own in self.steps],
        }


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None where there is none.

    Raises:
        ConfigError: where the file holds something else.
    """
    if not path.exists():
        return None
    try:
        found = json.loads(presets.read_bytes(path))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: is no file of experiments; remove it, and it is made again")
    return found


def write_log(folder: Path, model: Model, steps: Sequence[Step], said: str | None) -> tuple[Path, Path]:
    """Write the log anew: the explanations at each step and why its trial was chosen."""
    rows = [presets.plain(own.to_dict()) for own in steps] + ([{"end": said}] if said else [])
    lines, parts = folder / "log.jsonl", [f"# Experiments with {model.name}\n"]
    presets.write_text(lines, "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows))
    for own in steps:
        head = "what there was" if own.plan is None else f"{own.plan.trial}, {own.plan.duration:g} s"
        parts.append(f"## Step {own.number}: {head}\n")
        if own.plan is not None:
            family, condition = (own.plan.record.get(key) for key in ("family", "condition"))
            under = f" under {condition}" if condition else ""
            parts.append(f"Chosen: {family}{under}; {own.plan.why}.\n")
        parts.append(f"Explanations: {own.belief}.\n")
        parts += [
            f"Predicted for {r.predicted.true} against {r.predicted.other}: {r.predicted.gap:.3g} "
            f"({r.predicted.low:.3g} to {r.predicted.high:.3g}); realised: {r.gap:.3g}"
            f"{', settled' if r.settled else ''}.\n"
            for r in own.realised
        ]
        parts += [f"{own.doubt[0].upper()}{own.doubt[1:]}.\n"] if own.doubt else []
    if said:
        parts.append(f"## End\n\n{said[0].upper()}{said[1:]}.\n")
    text = folder / "log.md"
    presets.write_text(text, "\n".join(parts))
    return lines, text
