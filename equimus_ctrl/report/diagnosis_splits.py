"""What other splits of the trials say, in sentences, as a table and as a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from equimus_ctrl.diagnosis.results import Diagnosis, Estimate, Named
from equimus_ctrl.diagnosis.split_comparison import Law, SplitComparison
from equimus_ctrl.report import style
from equimus_ctrl.report.diagnosis_drawing import WIDTH
from equimus_ctrl.report.diagnosis_words import interval_digits, listed, number, reading, short

Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Its heads and its rows."""
MOST_PANELS, COLUMNS = 12, 3
"""Of the figure: what most splits name."""
PANEL_HEIGHT = 1.9
BESIDE = 0.35
"""Of the horizontal axis before the first split and behind the last, in splits."""


def head(splits: SplitComparison) -> str:
    """What was compared."""
    n = len(splits.answers) - 1
    return f"Over {n + 1} splits: the default one and {n} random {'half' if n == 1 else 'halves'} of the trials"


def lines(diagnosis: Diagnosis) -> list[str]:
    """What all splits name and what hangs on the split, and what ``beside`` says."""
    splits = diagnosis.splits
    if splits is None:
        return []
    return [*([_law(law, splits) for law in splits.laws] or ["No split names an effect."]), *beside(splits)]


def beside(splits: SplitComparison) -> list[str]:
    """Whether the augmented model is anywhere worse than the refitted one, and why splits are missing."""
    said = []
    if (worst := splits.worst) is not None:
        where = f"{worst.joint}, {worst.kind}" if worst.kind else worst.joint
        text = f"On held-out trials the augmented model's error is at most {number(worst.ratio)} of the refitted one's"
        said.append(f"{text} ({where}){': it is worse there' if worst.ratio > 1 else ''}.")
    if missing := splits.asked - len(splits.answers) + 1:
        why = f": {'; '.join(splits.fewer)}" if splits.fewer else ""
        said.append(f"{missing} of the {splits.asked} random halves asked for are missing{why}.")
    return said


def undecided(diagnosis: Diagnosis) -> str:
    """Which of the findings not all splits name, as a sentence; "" where all do."""
    splits = diagnosis.splits
    if splits is None:
        return ""
    own = [law for law in splits.undecided if 0 in law.named]
    if not own:
        return ""
    n = len(splits.answers)
    told = listed([f"{_named(law)} ({len(law.named)} of {n})" for law in own])
    return f"Undecided, as not all splits name {'it' if len(own) == 1 else 'them'}: {told}."


def of_laws(splits: SplitComparison) -> Table:
    """A table of effects at their places."""
    body: list[tuple[str, ...]] = []
    for law in splits.laws:
        in_all = f"{len(law.named)} of {len(splits.answers)}"
        body.append((_named(law), _sizes(law), in_all, str(len(law.as_well) or "")))
    return ("effect", "sizes, over the splits that name it", "named in", "not distinguishable in"), body


def of_splits(splits: SplitComparison) -> Table:
    """A table of the splits: the verdict of each, how the error on held-out trials changes, and the time taken."""
    kinds = dict.fromkeys((e.joint, e.kind) for answer in splits.answers for e in answer.errors)
    body: list[tuple[str, ...]] = []
    for k, answer in enumerate(splits.answers):
        ratios = {(e.joint, e.kind): number(e.ratio) for e in answer.errors}
        times = number(answer.seconds), str(len(answer.fitted))
        body.append((_which(k), answer.verdict.replace("_", " "), *(ratios.get(kind, "") for kind in kinds), *times))
    heads = (f"{joint}, {kind}" if kind else joint for joint, kind in kinds)
    return ("split", "verdict", *heads, "time [s]", "trials fitted"), body


def figure(splits: SplitComparison) -> Figure | None:
    """The first parameter of what most splits name, with its interval in each; None where none names anything."""
    if not splits.laws:
        return None
    shown = splits.laws[:MOST_PANELS]
    height = -(-len(shown) // COLUMNS)
    drawn = style.new_figure(WIDTH, 0.5 + PANEL_HEIGHT * height)
    grid = drawn.subplots(height, COLUMNS, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    n = len(splits.answers)
    for law, axes in zip(shown, grid.flat, strict=False):
        key, estimates = next(iter(law.estimates.items()))
        scale = reading(estimates[0].unit, estimates[0].value)
        for k, own in zip(law.named, estimates, strict=True):
            value, low, high = (v * scale.factor for v in (own.value, own.low, own.high))
            ends = [[value - low if math.isfinite(low) else 0.0], [high - value if math.isfinite(high) else 0.0]]
            colour = style.JOINT_COLOURS[0] if k == 0 else style.FAINT
            axes.errorbar([k], [value], yerr=ends, fmt="o", markersize=4, color=colour, capsize=2, linewidth=1.2)
        for k in sorted(set(range(n)) - set(law.named)):
            axes.axvspan(k - 0.4, k + 0.4, color=style.SHADE, linewidth=0)
        axes.set_xlim(-BESIDE - 0.1, n - 1 + BESIDE + 0.1)
        axes.set_xticks(range(n), [_which(k) for k in range(n)])
        label = key.replace("_", " ")
        y = f"{label} [{scale.unit}]" if scale.unit else label
        style.dress(axes, title=f"{_named(law)}: {len(law.named)} of {n}", y=y)
    return drawn


def _which(k: int) -> str:
    return str(k) if k else "default"


def _named(law: Law) -> str:
    return short(Named(law.effect, (law.place,)))


def _law(law: Law, splits: SplitComparison) -> str:
    n = len(splits.answers)
    if len(law.named) == n:
        return f"{_named(law)}: named in all {n}; {_sizes(law)}"
    also = f", and not distinguishable in {len(law.as_well)} more" if law.as_well else ""
    return f"{_named(law)}: undecided, named in {len(law.named)} of {n}{also}; {_sizes(law)}"


def _sizes(law: Law) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {_range(own)}" for key, own in law.estimates.items())


def _range(estimates: Sequence[Estimate]) -> str:
    least, most = (pick(e.value for e in estimates) for pick in (min, max))
    shown = reading(estimates[0].unit, max(abs(least), abs(most)))
    least, most = least * shown.factor, most * shown.factor
    digits = interval_digits((least + most) / 2, least, most)
    low, high = number(least, digits), number(most, digits)
    return shown(low if low == high else f"{low} to {high}")
