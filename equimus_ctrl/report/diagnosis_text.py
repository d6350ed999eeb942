"""A diagnosis as text: its sentences, and the whole report for a terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.display_units import Reading
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise, Unexplained
from equimus_ctrl.diagnosis.results import (
    CONFIRMATION,
    SETS,
    STATES,
    Detectable,
    Diagnosis,
    Estimate,
    Finding,
    Named,
    Set,
)
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.models.model import Model
from equimus_ctrl.report import diagnosis_splits
from equimus_ctrl.report.diagnosis_next import deciding
from equimus_ctrl.report.diagnosis_sentences import sentence, sentences
from equimus_ctrl.report.diagnosis_units import departures, differing, unit_answer
from equimus_ctrl.report.diagnosis_words import (
    MANY,
    coordinates_text,
    estimate_text,
    listed,
    number,
    percent,
    power_of_ten,
    quantity,
    short,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

__all__ = ["print_diagnosis", "sentence"]

NOWHERE = "nowhere in particular"
MOST_DETECTABLE = 24
"""Smallest detectable sizes that a terminal shows."""
MOST_NAMES = 4
"""Names of held-out trials that are listed; more are counted."""
PARTS: dict[Set, str] = {"train": "fitted", "validation": "validation", "test": "test"}
"""What the sets of trials are called."""
COUNTS = ("no", "one", "two", "three", "four", "five")


@dataclass(frozen=True, eq=False)
class Law:
    """What was found of one law: one finding, or those of all places where it has its own size.

    Attributes:
        findings: in the diagnosis' order; their evidence is the same.
        first: place of the first of them among all findings.
    """

    findings: tuple[Finding, ...]
    first: int

    @property
    def named(self) -> Named:
        """The effect and all its places."""
        named = self.findings[0].named
        places = tuple(place for finding in self.findings for place in finding.named.locations)
        return named if len(self.findings) == 1 else Named(named.effect, places, each=True)


def grouped(findings: Sequence[Finding]) -> list[Law]:
    """The laws that were found, a law with its own size at several places as one."""
    found = []
    for k, finding in enumerate(findings):
        same = [other for other in findings if finding.law is not None and other.law is finding.law] or [finding]
        if same[0] is finding:
            found.append(Law(tuple(same), k))
    return found


def laws(findings: Sequence[Finding]) -> list[Named]:
    """Their names."""
    return [law.named for law in grouped(findings)]


def candidate_of(law: Law) -> Named:
    """The candidate of the search that it was, with the places that are not named."""
    whole = law.findings[0].law
    if whole is None:
        return law.named
    places = whole.candidate.locations
    return Named(whole.candidate.effect.name, places, each=len(places) > 1)


def law_sentence(law: Law, model: Model) -> str:
    """What was found as a sentence; of a law with several sizes the ends of the first, see ``by_place`` for all."""
    if len(law.findings) == 1:
        return sentence(law.findings[0], model)
    key = next(iter(law.findings[0].parameters))
    least, *_, most = sorted(law.findings, key=lambda f: f.parameters[key].value)
    ends = (
        f"{quantity(f.parameters[key].value, f.parameters[key].unit)} at {listed(f.named.locations)}"
        for f in (least, most)
    )
    effect = law.findings[0].part.candidate.effect
    return f"{upper(short(law.named, model))} ({effect.summary}): {key} {' to '.join(ends)}."


def law_sentences(law: Law, model: Model) -> list[str]:
    """The same as a list, one for each group of trials where these differ."""
    return sentences(law.findings[0], model) if len(law.findings) == 1 else [law_sentence(law, model)]


def by_place(law: Law) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """A table of a law with its own size at several places: its heads, and for each place its parameters."""
    effect = law.findings[0].part.candidate.effect
    keys = list(law.findings[0].parameters)
    rows = [(listed(f.named.locations), *(estimate_text(f.parameters[key]) for key in keys)) for f in law.findings]
    return (effect.sits_at[0], *keys), rows


def verdict(diagnosis: Diagnosis) -> str:
    """What was found, in one sentence."""
    named = laws(diagnosis.findings)
    n, model = len(named), diagnosis.model
    if diagnosis.verdict == "consistent":
        return "Consistent: refitted, the model explains the recordings down to the noise; no missing physics is seen."
    if diagnosis.verdict == "unexplained" and diagnosis.undetermined and not diagnosis.unexplained:
        return "Unexplained: physics is missing from the model; what fits is not identifiable from these recordings."
    if diagnosis.verdict == "unexplained":
        return "Unexplained: physics is missing from the model, and it is none of the known effects."
    what = listed([short(each, model) for each in named])
    count = COUNTS[n] if n < len(COUNTS) else n
    effects = f"{count} {'effect' if n == 1 else 'effects'} missing from the model: {what}"
    if diagnosis.verdict == "unfinished":
        so_far = f"{effects}; {_judged(diagnosis, 'it' if n == 1 else 'them')}" if n else "no missing effect was found"
        ended = f"Unfinished, ended in the stage {diagnosis.not_done[0]}"
        left = "; some residuals are unexplained" if diagnosis.unexplained else ""
        return f"{ended}: so far {so_far}{left}. The notes say what was not looked at."
    if diagnosis.verdict == "explained":
        return f"Explained: {effects}."
    if not diagnosis.unexplained:
        return f"Partly explained: {effects}; what fits beside is not identifiable from these recordings."
    return f"Partly explained: {effects}; further residuals are none of the known effects."


def _judged(diagnosis: Diagnosis, what: str) -> str:
    """What held-out trials say of the findings of a diagnosis that was ended."""
    if not diagnosis.validation:
        return f"nothing was held out to confirm {what}"
    fitted = " as fitted by then" if CONFIRMATION in diagnosis.not_done else ""
    return f"validation trials confirm {what}{fitted}"


def states(diagnosis: Diagnosis) -> tuple[str, ...]:
    """The states of the model that differ: without a finding there is no augmented model."""
    return STATES if diagnosis.findings else STATES[:2]


def against_noise(diagnosis: Diagnosis) -> list[str]:
    """The size of the residuals: normalised RMSE of all joints together, and each joint's RMSE."""
    sizes = {state: math.sqrt(1.0 + max(diagnosis.excess_variance[state], 0.0)) for state in diagnosis.excess_variance}
    text = f"Normalised RMSE on the fitted trials (1 is the noise): nominal {number(sizes['nominal'])}"
    text += f", refitted {number(sizes['refitted'])}"
    if diagnosis.findings:
        text += f", augmented {number(sizes['corrected'])}"
    lines = [f"{text}."]
    for j, (joint, sigma) in enumerate(zip(diagnosis.joints, diagnosis.sigma, strict=True)):
        unit = display_units.error(diagnosis.model, joint)
        said = []
        for part in SETS:
            if getattr(diagnosis, part):
                shown = (number(diagnosis.rmse(state, part)[j] * unit.factor) for state in states(diagnosis)[-2:])
                said.append(f"{PARTS[part]} {' → '.join(shown)}")
        said.append(f"noise {number(float(sigma) * unit.factor)}")
        lines.append(f"{joint}: RMSE in {unit.unit}: {', '.join(said)}")
    return [*lines, *of_channels(diagnosis)]


def of_channels(diagnosis: Diagnosis) -> list[str]:
    """What was compared beside the joints' positions: errors of the refitted and the augmented model."""
    return [
        f"{own.name}: RMSE {number(own.before)} → {number(own.rmse)} {own.unit}, noise {number(own.noise)} {own.unit}"
        for own in diagnosis.channels
    ]


def held_out(diagnosis: Diagnosis) -> str:
    """Which trials were held out, and how all were cut, in one sentence."""
    parts = {part: _which(diagnosis, part) for part in SETS[1:]}
    text = "Nothing was held out"
    if any(parts.values()):
        text = f"Held out: {parts['validation'] or 'nothing'} for validation, {parts['test'] or 'nothing'} for the test"
    if diagnosis.interval is None:
        free = diagnosis.train[0].free_start > 0
        begins = "an initial state of its own" if free else "what was measured first"
        return f"{text}; each trial was simulated as a whole, from {begins}."
    fitted, rest = len(diagnosis.train), len(diagnosis.validation) + len(diagnosis.test)
    length = quantity(diagnosis.interval, "s", 2)
    return (
        f"{text}; trials were cut into shooting intervals of {length}, {fitted} fitted and {rest} held out, each "
        "simulated from an initial state of its own."
    )


def _which(diagnosis: Diagnosis, part: Set) -> str:
    """The trials of a set by name, or how many where they are many; from when on, where their beginning was fitted."""
    segments = getattr(diagnosis, part)
    fitted = {s.recording for s in diagnosis.train}
    begins: dict[int, float] = {}
    for s in segments:
        begins[s.recording] = min(begins.get(s.recording, math.inf), float(s.trial.sample_times[0]))
    names = {s.recording: s.recording_name for s in segments}
    if len(names) > MOST_NAMES:
        return f"{len(names)} trials"
    own = {r: f" from {quantity(begins[r], 's')} on" if r in fitted else "" for r in names}
    return listed([f"{name}{own[r]}" for r, name in names.items()])


def together(diagnosis: Diagnosis) -> str:
    """What all effects together explain; "" where there is one or none, whose evidence says so."""
    if len(grouped(diagnosis.findings)) < 2:
        return ""
    text = f"All together explain {percent(diagnosis.explained('train'))} of the excess residual variance"
    held = [f"{percent(diagnosis.explained(part))} in {PARTS[part]}" for part in SETS[1:] if getattr(diagnosis, part)]
    return f"{text} ({', '.join(held)})." if held else f"{text}."


def where(diagnosis: Diagnosis) -> list[str]:
    """Where the refitted model's residuals are."""
    lines = []
    for place in diagnosis.where:
        when = [text for text in (place.when, place.region) if text != NOWHERE] or [NOWHERE]
        lines.append(f"{place.location}: {percent(place.share)} of the excess residual variance; {'; '.join(when)}")
    return lines


def headline(diagnosis: Diagnosis) -> str:
    """The error on the test trials, or on those of validation where there are none, and what the findings do to it."""
    part: Literal["test", "validation"] = "test" if diagnosis.test else "validation"
    segments = getattr(diagnosis, part)
    if not segments:
        return ""
    before, after = (diagnosis.rmse(state, part) for state in ("refitted", "corrected"))
    shown = [display_units.error(diagnosis.model, joint) for joint in diagnosis.joints]
    if diagnosis.findings:
        parts = [_fall(j, b, a, u) for j, b, a, u in zip(diagnosis.joints, before, after, shown, strict=True)]
        size = after / np.maximum(before, 1e-300)
    else:
        of = zip(diagnosis.joints, before, shown, strict=True)
        parts = [f"{number(size * unit.factor)} {unit.unit} at the {joint}" for joint, size, unit in of]
        size = before / diagnosis.sigma
    what = listed(parts)
    if len(parts) >= MANY:  # the table has all of them
        what = f"{parts[int(np.argmin(size))]} to {parts[int(np.argmax(size))]}"
    text = f"the error {'changes by' if diagnosis.findings else 'is'} {what}"
    n = len({s.recording for s in segments})
    who = f"On the {part} trial" if n == 1 else f"On the {n} {part} trials"
    seen = "no fit has seen and no choice was judged by" if part == "test" else "no fit has seen, though choices have"
    return f"{who}, which {seen}, {text}."


def _fall(joint: str, before: float, after: float, unit: Reading) -> str:
    change = (after - before) / before if before > 0 else 0.0
    sign = "+" if change > 0 else "−" if change < 0 else ""
    sizes = f"{number(before * unit.factor)} → {number(after * unit.factor)}"
    return f"{sign}{number(100 * abs(change), 0)} % at the {joint} ({sizes} {unit.unit})"


def evidence(diagnosis: Diagnosis, k: int) -> str:
    """The evidence for a finding."""
    e = diagnosis.findings[k].evidence
    law = diagnosis.findings[k].law
    n = 1 if law is None else len(law.candidate.locations)
    together = f"the law at {n} places, each with its own size: " if n > 1 else ""
    text = f"{together}−2 log likelihood falls by {number(e.gain)} (threshold {number(e.threshold)}), p-value "
    text += power_of_ten(e.log10_p_value)
    if math.isfinite(e.validation_gain):
        text += f"; on validation trials by {number(e.validation_gain)}"
    text += f"; explains {percent(e.share)} of the excess residual variance"
    if math.isfinite(e.validation_share):
        text += f" ({percent(e.validation_share)} in validation)"
    if len(grouped(diagnosis.findings)) > 1:
        text += " beside the others"
        text += f", {share_alone(e.share_alone)} alone" if math.isfinite(e.share_alone) else ""
    return text


def share_alone(share: float) -> str:
    """What an effect explains alone; without the others a fit can also leave more where the noise is small."""
    return "none" if share <= 0 else percent(share)


def remains(diagnosis: Diagnosis) -> list[str]:
    """What none of the findings explains, and what fits and is not identifiable."""
    lines = [_unexplained(residual, diagnosis.model) for residual in diagnosis.unexplained]
    lines += [f"{upper(short(f.named, diagnosis.model))} fits, but {f.undetermined}." for f in diagnosis.undetermined]
    return lines


def rejected(diagnosis: Diagnosis) -> list[str]:
    """Effects that were part of a hypothesis and were rejected, with the reason and the stage."""
    return [f"{upper(short(own.named, diagnosis.model))}: {own.reason} ({own.stage})." for own in diagnosis.rejected]


def _unexplained(residual: Unexplained, model: Model) -> str:
    if isinstance(residual, ResidualAboveNoise):
        text = f"At the {residual.location}: normalised RMSE {number(math.sqrt(1 + residual.excess))}"
        if not residual.only_on:
            return f"{text}, which depends on none of the coordinates tried"
        whatever = ", whatever the parameters" if residual.only_on == "validation" else ""
        return f"{text} on {residual.only_on} trials{whatever}"
    at = f" at {listed(residual.places)}" if set(residual.places) != {residual.location} else ""
    size = ""
    if residual.axis and len(residual.force):
        k = int(np.argmax(np.abs(residual.force)))
        largest, half = float(abs(residual.force[k])), float(residual.band[k])
        size = f", up to {estimate_text(Estimate(largest, largest - half, largest + half, residual.unit))}"
    return (
        f"At the {residual.location}: a residual force{at} that depends on "
        f"{coordinates_text(residual.coordinates, model)}{size}; {percent(residual.share)} of the remaining "
        "excess residual variance; "
        f"χ² falls by {number(residual.gain)} (threshold {number(residual.threshold)})"
    )


def not_distinguishable(diagnosis: Diagnosis) -> list[str]:
    """Findings that these recordings do not distinguish from others."""
    ambiguous = [law for law in grouped(diagnosis.findings) if law.findings[0].equivalent]
    model = diagnosis.model
    return [
        f"{upper(short(law.named, model))} or "
        f"{listed([short(other, model) for other in law.findings[0].equivalent], 'or')}."
        for law in ambiguous
    ]


def upper(text: str) -> str:
    """With a capital letter first."""
    return text[:1].upper() + text[1:]


def smallest(detectable: Detectable) -> str:
    """The smallest detectable size of an effect."""
    if not math.isfinite(detectable.size):
        return "no size that was tried"
    cls = REGISTRY.get(detectable.named.effect)
    nothing = cls.grows_from() if cls is not None else 0.0
    away = "such as " if nothing is None else f"{nothing:g} ± " if nothing else ""
    return f"{away}{quantity(detectable.size, detectable.unit, 2)}"


def detectables(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """(effect and its parameter, sizes by place) of effects at one place each."""
    by_effect: dict[str, list[str]] = {}
    for d in diagnosis.detectable:
        if len(d.named.locations) == 1:
            who = f"{d.named.effect} ({d.parameter})".replace("_", " ")
            by_effect.setdefault(who, []).append(f"{smallest(d)} at {d.named.locations[0]}")
    return [(who, ", ".join(sizes)) for who, sizes in sorted(by_effect.items())]


def trials(diagnosis: Diagnosis) -> str:
    """How many there were, and what it took."""
    parts = (diagnosis.train, diagnosis.validation, diagnosis.test)
    fitted, judging, unseen = (len({s.recording for s in part}) for part in parts)
    samples = sum(len(s.measured) for s in diagnosis.train)
    return (
        f"{diagnosis.model.name}: {fitted} trial{'s' * (fitted != 1)} fitted ({samples} samples), {judging} for "
        f"validation, {unseen} for the test, "
        f"{len(diagnosis.ranking)} candidates, {diagnosis.seconds:.0f} s"
    )


def print_diagnosis(console: Console, diagnosis: Diagnosis, command_line: str = "") -> None:
    """A diagnosis for a terminal.

    Args:
        console: where people read.
        diagnosis: what was found.
        command_line: with which it was made, "" where there was none.
    """
    from rich.padding import Padding
    from rich.text import Text

    def say(text: str, indent: int = 0, style: str = "") -> None:
        console.print(Padding(Text(text, style=style), (0, 0, 0, indent)))

    def listing(head: str, lines: Sequence[str]) -> None:
        if lines and head:
            say(head, style="bold")
        for line in lines:
            say(line, 2)

    say(trials(diagnosis), style="dim")
    say(held_out(diagnosis), style="dim")
    if diagnosis.engine.reason:
        say(diagnosis.engine.sentence, style="dim")
    say(verdict(diagnosis), style="bold")
    if text := diagnosis_splits.undecided(diagnosis):
        say(text, style="bold")
    if text := headline(diagnosis):
        say(text)
    first, *joints = against_noise(diagnosis)
    say(first)
    for line in joints:
        say(line, 2)
    listing(
        "Where the residuals of the refitted model are", where(diagnosis) if diagnosis.verdict != "consistent" else []
    )
    if diagnosis.findings:
        say("Missing physics", style="bold")
    for k, law in enumerate(grouped(diagnosis.findings)):
        first_line, *more_lines = law_sentences(law, diagnosis.model)
        say(f"{k + 1}. {first_line}", 2)
        for line in more_lines:
            say(line, 5)
        if len(law.findings) > 1:
            head, rows = by_place(law)
            for place, *sizes in rows:
                named = (f"{key} {size}" for key, size in zip(head[1:], sizes, strict=True))
                say(f"{place}: {', '.join(named)}", 5)
        say(evidence(diagnosis, law.first), 5, "dim")
    if text := together(diagnosis):
        say(text, 2)
    if diagnosis.splits is not None:
        listing(diagnosis_splits.head(diagnosis.splits), diagnosis_splits.lines(diagnosis))
    listing(f"Differences between {listed(diagnosis.groups)}", differing(diagnosis))
    if text := unit_answer(diagnosis):
        say(text, style="bold")
    listing("", departures(diagnosis))
    listing("Unexplained residuals", remains(diagnosis))
    listing("Rejected effects, with the reason (and the stage)", rejected(diagnosis))
    listing("Not distinguishable from these recordings", not_distinguishable(diagnosis))
    # Beside what was found they are for the page and the record: there are many.
    sizes = [] if diagnosis.findings else [f"{who}: {values}" for who, values in detectables(diagnosis)]
    more = [f"and {len(sizes) - MOST_DETECTABLE} more"] if len(sizes) > MOST_DETECTABLE else []
    listing("Smallest detectable sizes", [*sizes[:MOST_DETECTABLE], *more])
    if experiment := deciding(diagnosis, command_line):
        say(experiment[0])
        console.print(f"  {experiment[1]}", markup=False, soft_wrap=True, highlight=False)
    for note in diagnosis.notes:
        say(note, style="yellow")
