"""What designed trials came to in a proof: tables, and a figure of shares over trials and of gaps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from equimus_ctrl.proof.resolved import FACTOR, LEAST_RIGHT, OUTCOMES, Gap, Resolved
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.report import style
from equimus_ctrl.report.proof_tables import NOTHING, Sheet, ends_of, goal_interval, goal_value, goal_wanted
from equimus_ctrl.shown import counted

NAMES = {
    "exact": "exactly right",
    "told": "not distinguished, the truth among what is left",
    "unseen": "right but for what is smaller than it says to see",
    "silent": "nothing found, though something is missing",
    "wrong": "wrong",
    "failed": "failed",
}
ENDS = {
    "resolved": "one explanation was left",
    "inseparable": "nothing more could be distinguished within the limits",
    "none": "no trial could be designed",
    "failed": "something failed",
    "trials": "all trials were made",
}
GAPS = (-10.0, 10.0)
"""Gaps between which the scale is linear, logarithmic beyond: noise alone moves these by as much."""


def experiment_sheets(found: Resolved) -> list[Sheet]:
    """All tables, the goals first."""
    return [goals_sheet(found), outcomes_sheet(found), predictions_sheet(found), each_sheet(found)]


def goals_sheet(found: Resolved) -> Sheet:
    """Every figure against its goal."""
    rows = [(g.title, goal_value(g), goal_interval(g), goal_wanted(g), g.state) for g in found.goals]
    return Sheet(
        f"{counted(len(found.followed), 'case')} with designed trials: reached and wanted",
        ("", "reached", "95 % interval", "goal", ""),
        tuple(rows),
        "Open: undecided. Too few: so few cases could not show it, however they came out.",
    )


def outcomes_sheet(found: Resolved) -> Sheet:
    """What answers are after each number of trials."""
    heads = ["at first", *(f"after {k}" for k in range(1, found.most + 1))]
    rows = [(NAMES[name], *map(str, found.shares((name,)))) for name in OUTCOMES]
    right = found.shares()
    rows = [
        ("right, not distinguishable or unseen", *map(str, right)),
        ("95 % interval", *(ends_of(share) if share.of else NOTHING for share in right)),
        *(row for row, name in zip(rows, OUTCOMES, strict=True) if any(s.count for s in found.shares((name,)))),
    ]
    titles = {"seen": "right, of those that show in the first recordings"}
    rows += [(titles.get(kind, f"right, of kind {kind}"), *map(str, own)) for kind, own in found.by_kind().items()]
    seconds = [found.seconds(k) for k in range(found.most + 1)]
    rows.append(("median design, s", *(_seconds(design) for design, _ in seconds)))
    rows.append(("median diagnosis, s", *(_seconds(diagnosis) for _, diagnosis in seconds)))
    ends = [f"{ENDS[name]} {share.of} ({share.count} right)" for name, share in found.ends.items() if share.of]
    return Sheet("Answers after designed trials", ("", *heads), tuple(rows), f"Ends: {'; '.join(ends)}.")


def _seconds(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.0f}"


def predictions_sheet(found: Resolved) -> Sheet:
    """Predicted against realised gaps, and limits."""
    shares = (
        ("realised gap within a factor of 2 of the predicted one", Share.among(g.near(False) for g in found.gaps)),
        ("… noise aside (one standard deviation, 2√G)", found.near),
        ("… where the truth is named then", Share.among(g.near() for g in found.gaps if g.true)),
        ("90 % interval of the prediction holds", Share.among(g.within for g in found.gaps)),
        ("pair settled", Share.among(g.realised.settled for g in found.gaps)),
        ("limits kept by the true robot", found.kept),
        ("… where the truth was among what it was designed for", found.kept_promises),
    )
    rows = tuple((name, str(share), ends_of(share) if share.of else NOTHING) for name, share in shares)
    return Sheet(
        f"Predictions of {counted(len(found.made), 'designed trial')}", ("", "share", "95 % interval"), rows,
        f"A design may leave the limits with a chance of {100 * found.margin:.2g} % at most.",
    )  # fmt: skip


def each_sheet(found: Resolved) -> Sheet:
    """Every case that was not exactly right at first."""
    rows = []
    for own in found.followed:
        line = own.to_dict(found.most)
        if set(line["outcomes"]) == {"exact"}:
            continue
        truth = ", ".join(f"{t['effect']}:{'+'.join(t['locations'])}" for t in line["truth"]) or "nothing"
        named = " → ".join(", ".join(several) or "nothing" for several in line["named"])
        steps = " → ".join(line["outcomes"])
        rows.append((str(line["case"]), f"{line['strength']:.3g}", truth, named, steps, line["end"] or NOTHING))
    exact = len(found.followed) - len(rows)
    columns = ("case", "excess", "truth", "named", "answers", "end")
    note = f"{counted(exact, 'case')} exactly right throughout: not listed." if exact else ""
    return Sheet("Cases that were not exactly right throughout", columns, tuple(rows), note)


def experiment_drawings(found: Resolved) -> style.Drawings:
    """Shares over trials beside gaps."""
    return {"experiments": lambda: experiments_figure(found)}


def experiments_figure(found: Resolved) -> Figure:
    """Shares over designed trials, and realised against predicted gaps."""
    figure = style.new_figure(11.0, 5.0, "Diagnoses with designed trials")
    left, right = figure.subplots(1, 2)
    lines = {
        "right, not distinguishable or unseen": found.shares(),
        "exactly right": found.shares(("exact",)),
        "nothing found": found.shares(("silent",)),
        "wrong": found.shares(("wrong", "failed")),
    }
    shares_over_trials(left, lines)
    gaps_scatter(right, found.gaps)
    return figure


def shares_over_trials(axes: Axes, lines: Mapping[str, Sequence[Share]], x: str = "designed trials") -> None:
    """Shares of cases after each number of trials, with 95 % intervals; the goal is dashed.

    Args:
        axes: to draw on.
        lines: name → shares after 0, 1, … trials.
        x: what is counted along the axis.
    """
    for k, (name, shares) in enumerate(lines.items()):
        known = [(place, share) for place, share in enumerate(shares) if share.of]
        if not known:
            continue
        values = np.array([100 * share.value for _, share in known])
        ends = 100 * np.array([share.interval for _, share in known])
        places = np.array([place for place, _ in known]) + 0.05 * (k - (len(lines) - 1) / 2)
        axes.errorbar(
            places, values, np.maximum(np.abs(ends.T - values), 0.0), color=style.joint_colour(k), marker="o",
            linewidth=style.RUN_WIDTH, elinewidth=style.THIN_WIDTH, capsize=3, label=name, zorder=3,
        )  # fmt: skip
    axes.axhline(100 * LEAST_RIGHT, color=style.ALERT, linestyle=style.DASHES, linewidth=style.RECORDED_WIDTH)
    axes.set_ylim(-3, 103)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.dress(axes, title="goal: 95 %, dashed", x=x, y="share of the cases [%]")
    _legend(axes)


def gaps_scatter(axes: Axes, gaps: Sequence[Gap]) -> None:
    """Realised against predicted gaps with 90 % intervals; within a factor of two is shaded."""
    top = 3.0 * max([GAPS[1], *(abs(v) for g in gaps for v in (g.realised.gap, g.realised.predicted.high)
                                if math.isfinite(v))])  # fmt: skip
    line = np.geomspace(0.1, top, 200)
    axes.fill_between(line, line / FACTOR, line * FACTOR, color=style.SHADE, linewidth=0, zorder=0)
    axes.plot(line, line, color=style.FAINT, linewidth=style.THIN_WIDTH, zorder=1)
    for true, colour in ((True, style.JOINT_COLOURS[0]), (False, style.JOINT_COLOURS[1])):
        own = [g for g in gaps if g.true == true]
        if not own:
            continue
        predicted = np.array([g.realised.predicted.gap for g in own])
        ends = np.array([(g.realised.predicted.low, g.realised.predicted.high) for g in own]).T
        became = np.array([min(g.realised.gap, top) for g in own])
        bars = np.maximum(np.abs(ends - predicted), 0.0)
        axes.errorbar(
            predicted, became, xerr=bars, color=colour, marker="o", linestyle="", markersize=5,
            elinewidth=style.THIN_WIDTH, alpha=0.8, zorder=3,
            label=f"{'the truth is named' if true else 'something else is named'} ({len(own)})",
        )  # fmt: skip
    for axis in (axes.set_xscale, axes.set_yscale):
        axis("symlog", linthresh=GAPS[1])
    axes.set_xlim(0.0, top)
    axes.set_ylim(min([GAPS[0], *(2 * g.realised.gap for g in gaps if math.isfinite(g.realised.gap))]), top)
    style.dress(axes, title="shaded: within a factor of 2", x="predicted gap, −2Δln L", y="realised gap")
    if gaps:
        _legend(axes)


def _legend(axes: Axes) -> None:
    """Under an axis, off the curves."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, frameon=False, fontsize=style.SMALL_SIZE)
