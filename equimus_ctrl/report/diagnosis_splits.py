"""What other splits of the trials say, in sentences and as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from equimus_ctrl.diagnosis.results import Diagnosis, Estimate, Named
from equimus_ctrl.diagnosis.split_comparison import OverSplits, SplitComparison
from equimus_ctrl.report.diagnosis_words import interval_digits, listed, number, reading, short

Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Its heads and its rows."""


def head(splits: SplitComparison) -> str:
    """What was compared."""
    n = len(splits.answers) - 1
    if not n:
        return "Other splits of the trials"
    return f"Over {n + 1} splits: the default one and {n} random {'half' if n == 1 else 'halves'} of the trials"


def lines(diagnosis: Diagnosis) -> list[str]:
    """What all splits name and what hangs on the split, and what ``beside`` says."""
    splits = diagnosis.splits
    if splits is None:
        return []
    effects = [_said(own, splits) for own in splits.effects] or ["No split names an effect."]
    return [*(effects if len(splits.answers) > 1 else ()), *beside(splits)]


def beside(splits: SplitComparison) -> list[str]:
    """The verdicts, whether the augmented model is anywhere worse than the refitted one, and why splits are missing."""
    said, compared = list[str](), len(splits.answers) > 1
    verdicts = Counter(answer.verdict.replace("_", " ") for answer in splits.answers)
    if compared:
        told = listed([f"{verdict} in {count}" for verdict, count in verdicts.most_common()])
        said.append(f"Verdicts: {told} of {len(splits.answers)}.")
    if compared and (worst := splits.worst) is not None:
        where = f"{worst.joint}, {worst.kind}" if worst.kind else worst.joint
        text = f"On held-out trials the augmented model's error is at most {number(worst.ratio)} of the refitted one's"
        said.append(f"{text} ({where}){': it is worse there' if worst.ratio > 1 else ''}.")
    if missing := splits.asked - len(splits.answers) + 1:
        why = f": {'; '.join(splits.fewer)}" if splits.fewer else ""
        is_missing = "is" if missing == 1 else "are"
        said.append(f"{missing} of the {splits.asked} random halves asked for {is_missing} missing{why}.")
    return said


def undecided(diagnosis: Diagnosis) -> str:
    """Which effects some splits name and others do not, as a sentence; "" where there are none.

    Of those that the default split does not name, the ones that most splits do.
    """
    splits = diagnosis.splits
    if splits is None:
        return ""
    n = len(splits.answers)
    hanging = [own for own in splits.undecided if 0 in own.named or 2 * len(own.named) > n]
    if not hanging:
        return ""
    told = listed([f"{named(own)} ({len(own.named)} of {n})" for own in hanging])
    return f"Undecided, as some splits name {'it' if len(hanging) == 1 else 'them'} and others do not: {told}."


def of_effects(splits: SplitComparison) -> Table:
    """A table of effects at their places."""
    body: list[tuple[str, ...]] = []
    for own in splits.effects:
        in_all = f"{len(own.named)} of {len(splits.answers)}"
        body.append((named(own), _sizes(own), in_all, str(len(own.as_well) or "")))
    return ("effect", "sizes, over the splits that name it", "named in", "not distinguishable in"), body


def of_splits(splits: SplitComparison) -> Table:
    """A table of the splits: the verdict of each, how the error on held-out trials changes, and the time taken."""
    kinds = dict.fromkeys((e.joint, e.kind) for answer in splits.answers for e in answer.errors)
    body: list[tuple[str, ...]] = []
    for answer in splits.answers:
        ratios = {(e.joint, e.kind): number(e.ratio) for e in answer.errors}
        verdict, times = answer.verdict.replace("_", " "), (number(answer.seconds), str(len(answer.fitted)))
        body.append((which(answer.number), verdict, *(ratios.get(kind, "") for kind in kinds), *times))
    heads = (f"{joint}, {kind}" if kind else joint for joint, kind in kinds)
    return ("split", "verdict", *heads, "time [s]", "trials fitted"), body


def which(k: int) -> str:
    """A split by its number."""
    return str(k) if k else "default"


def named(own: OverSplits) -> str:
    """An effect at one place."""
    return short(Named(own.effect, (own.place,)))


def _said(own: OverSplits, splits: SplitComparison) -> str:
    n = len(splits.answers)
    if len(own.named) == n:
        return f"{named(own)}: named in all {n}; {_sizes(own)}"
    also = f", and not distinguishable in {len(own.as_well)} more" if own.as_well else ""
    return f"{named(own)}: undecided, named in {len(own.named)} of {n}{also}; {_sizes(own)}"


def _sizes(own: OverSplits) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {_range(own)}" for key, own in own.estimates.items())


def _range(estimates: Sequence[Estimate]) -> str:
    least, most = (pick(e.value for e in estimates) for pick in (min, max))
    shown = reading(estimates[0].unit, max(abs(least), abs(most)))
    least, most = least * shown.factor, most * shown.factor
    digits = interval_digits((least + most) / 2, least, most)
    low, high = number(least, digits), number(most, digits)
    return shown(low if low == high else f"{low} to {high}")
