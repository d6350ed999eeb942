"""Figures of a proof: confusion matrix, detection rate over effect strength, and errors of the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.proof.answers import BINS, EDGES, OURS, STRONG
from equimus_ctrl.proof.estimates import ParameterEstimate
from equimus_ctrl.proof.outside import OUTSIDE
from equimus_ctrl.proof.scoring import COVERAGE, LEAST_HELD_OUT, MOST_FALSE_ALARMS, Score
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.sizes import drawn
from equimus_ctrl.proof.tally import CONSISTENT, FAILED, NOTHING, UNEXPLAINED, Table, confusion
from equimus_ctrl.report import style
from equimus_ctrl.report.proof_tables import METHODS

LOOK = {
    OURS: (style.JOINT_COLOURS[0], "o"),
    "bic": (style.ACTUATOR_COLOURS[0], "s"),
    "sparse": (style.JOINT_COLOURS[2], "^"),
    "validation": (style.JOINT_COLOURS[3], "D"),
}
SIDES = {"command": style.JOINT_COLOURS[0], "force": style.JOINT_COLOURS[1], "measurement": style.JOINT_COLOURS[2]}


def proof_drawings(score: Score) -> style.Drawings:
    """Confusion, power, false alarms, parameters, coverage, held-out error."""
    return {
        "confusion": lambda: confusion_figure(score),
        "power": lambda: power_figure(score),
        "false_alarms": lambda: false_alarms_figure(score),
        "parameters": lambda: parameters_figure(score),
        "coverage": lambda: coverage_figure(score),
        "heldout": lambda: heldout_figure(score),
    }


def confusion_figure(score: Score) -> Figure:
    """Truths against names, those that are strong alone; colours are shares of a row."""
    found = confusion(score.cases)
    named = {name for row in found.values() for name in row}
    # Effects that were neither drawn nor named would be empty rows and columns.
    effects = [own for own in drawn(score.robots) if found.get(own) or own in named]
    beyond = [own for own in drawn(score.robots, OUTSIDE) if found.get(own)]
    rows = [*effects, *beyond, NOTHING]
    # An effect of a user's may be found though it is not drawn.
    others = named - {*effects, UNEXPLAINED, CONSISTENT, FAILED}
    columns = [*effects, *sorted(others), UNEXPLAINED, CONSISTENT]
    if any(FAILED in row for row in found.values()):
        columns.append(FAILED)
    counts = np.array([[found.get(row, {}).get(column, 0.0) for column in columns] for row in rows])
    total = counts.sum(axis=1, keepdims=True)
    shares = np.divide(counts, total, out=np.zeros_like(counts), where=total > 0)
    size = 2.6 + 0.22 * len(rows)
    title = f"Confusion matrix, excess residual variance {STRONG:g} and more"
    figure = style.new_figure(max(1.1 * size, 8.5), max(size, 4.0), title)
    axes = figure.add_subplot()
    right = np.zeros_like(shares, dtype=bool)
    for i, row in enumerate(rows):
        column = row if row in effects else UNEXPLAINED if row in beyond else CONSISTENT
        right[i, columns.index(column)] = True
    for good, cmap in ((True, "Blues"), (False, "Reds")):
        shown = np.ma.masked_where((right != good) | (counts == 0), shares)
        axes.imshow(shown, cmap=cmap, vmin=-0.15, vmax=1.3, aspect="auto", zorder=2)
    for i, j in np.argwhere(right):
        axes.add_patch(_box(float(j), float(i)))
    for i, j in np.argwhere(counts > 0):
        colour = "white" if shares[i, j] > 0.55 else style.INK
        text = f"{counts[i, j]:.3g}"
        axes.text(j, i, text, ha="center", va="center", fontsize=style.SMALL_SIZE, color=colour, zorder=3)
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=50, ha="left")
    labels = [f"{row.replace('_', ' ')}  ({total[i, 0]:.3g})" for i, row in enumerate(rows)]
    axes.set_yticks(range(len(rows)), labels)
    axes.xaxis.tick_top()
    style.dress(axes, y="truth (how often)", x="what it was called: blue where that is right, red where it is wrong")
    axes.grid(False)
    for axis, place in ((axes.axhline, len(effects)), (axes.axhline, len(rows) - 1), (axes.axvline, len(effects))):
        axis(place - 0.5, color=style.INK, linewidth=1.0, zorder=4)
    return figure


def _box(x: float, y: float) -> Patch:
    return Rectangle((x - 0.5, y - 0.5), 1, 1, fill=False, edgecolor=style.FAINT, linewidth=0.8, zorder=4)


def power_figure(score: Score) -> Figure:
    """How often each method is right over how strong the missing physics is."""
    figure = style.new_figure(10.0, 6.6, "Right answers against excess residual variance")
    grid = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    panels: Sequence[tuple[str, str]] = (
        ("single", "one effect of the catalogue: exactly named"),
        ("pair", "two effects: both exactly named"),
        ("outside", "physics from outside: unexplained, at its place"),
        ("wrong", "physics from outside: given wrong names"),
    )
    for axes, (table, title) in zip(grid, panels, strict=True):
        for k, (method, own) in enumerate(score.tallies.items()):
            colour, marker = LOOK.get(method, (style.FAINT, "o"))
            _binned(axes, getattr(own, table), colour, marker, k - (len(score.tallies) - 1) / 2)
        axes.axvspan(STRONG, _centres()[-1] * 4, color=style.SHADE, alpha=0.5, zorder=0)
        axes.set_xscale("log")
        axes.set_xlim(_centres()[0] / 4, _centres()[-1] * 4)
        axes.set_ylim(-3, 103)
        style.dress(axes, title=title)
    for axes in grid[2:]:
        axes.set_xlabel("excess residual variance without the effect", fontsize=style.TEXT_SIZE)
    for axes in grid[::2]:
        axes.set_ylabel("share of the cases [%]", fontsize=style.TEXT_SIZE)
    counts = Patch(color=style.SHADE, label=f"{STRONG:g} and more: what the goals judge")
    style.legend_below(figure, [*_legend(score), counts])
    return figure


def _centres() -> list[float]:
    """Middles of the ranges of the excess; those without an end are as wide as the others."""
    step = (EDGES[-1] / EDGES[0]) ** (1 / (len(EDGES) - 1))
    return [EDGES[0] / step**0.5 * step**k for k in range(len(BINS))]


def _binned(axes: Axes, table: Table, colour: str, marker: str, shift: float) -> None:
    points = [(x * 1.13**shift, table[name]) for x, name in zip(_centres(), BINS, strict=True) if table[name].of]
    if not points:
        return
    x = [point[0] for point in points]
    _with_bars(axes, x, [share for _, share in points], colour, marker, "-")


def _with_bars(
    axes: Axes, x: Sequence[float], shares: Sequence[Share], colour: str, marker: str, line: str = ""
) -> None:
    y = np.array([100 * s.value for s in shares])
    ends = 100 * np.array([s.interval for s in shares])
    bars = np.maximum(np.abs(ends.T - y), 0.0)
    axes.errorbar(
        x, y, yerr=bars, color=colour, marker=marker, markersize=6, linestyle=line, linewidth=1.5, elinewidth=1.0,
        capsize=3, zorder=3,
    )  # fmt: skip


def _legend(score: Score) -> list[Line2D]:
    return [Line2D([], [], color=LOOK[m][0], marker=LOOK[m][1], label=METHODS[m]) for m in score.tallies if m in LOOK]


def false_alarms_figure(score: Score) -> Figure:
    """Alarms where nothing is missing, with 95 % intervals."""
    figure = style.new_figure(8.0, 4.4, "False alarms where nothing is missing")
    axes = figure.add_subplot()
    groups = ("all", "white", "coloured")
    count = len(score.tallies)
    for k, (method, own) in enumerate(score.tallies.items()):
        colour, marker = LOOK.get(method, (style.FAINT, "o"))
        x = [g + 0.8 * ((k + 0.5) / count - 0.5) for g in range(len(groups))]
        known = [(place, own.false_alarms[g]) for place, g in zip(x, groups, strict=True) if own.false_alarms[g].of]
        if known:
            _with_bars(axes, [p for p, _ in known], [s for _, s in known], colour, marker)
    axes.axhline(100 * MOST_FALSE_ALARMS, color=style.ALERT, linestyle=style.DASHES, linewidth=1.2, zorder=4)
    estimates = [score.ours.false_alarms[g].of for g in groups]
    names = ("all", "white noise", "coloured noise")
    axes.set_xticks(range(len(groups)), [f"{n}\n{c} cases" for n, c in zip(names, estimates, strict=True)])
    axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])  # a mark at 0 is seen whole
    axes.set_xlim(-0.5, len(groups) - 0.5)
    style.dress(axes, y="share of the cases [%], with its 95 % interval")
    axes.grid(False, axis="x")
    goal = Line2D(
        [], [], color=style.ALERT, linestyle=style.DASHES, label=f"goal: {100 * MOST_FALSE_ALARMS:g} % at most"
    )
    style.legend_below(figure, [*_legend(score), goal])
    return figure


def parameters_figure(score: Score) -> Figure:
    """Sizes estimated against true ones, normalised by each parameter's median true size, and the errors' spread."""
    estimates = [n for n in score.estimates[OURS] if n.zero is not None]
    figure = style.new_figure(10.0, 5.2, "Parameters of what was named right")
    left, right = figure.subplots(1, 2)
    medians = {
        key: _median([n for n in estimates if (n.of, n.name) == key]) for key in {(n.of, n.name) for n in estimates}
    }
    for n in estimates:
        median, zero = medians[n.of, n.name], n.zero or 0.0
        sizes = [(v - zero) * np.sign(n.true - zero) / median for v in (n.value, n.low, n.high)]
        low, high = sorted(sizes[1:])
        colour, y = SIDES[REGISTRY[n.of].side], max(sizes[0], 1e-3)
        bars = [[y - max(low, 1e-3)], [min(high, 1e3) - y]]
        left.errorbar(
            [n.scale / median], [y], yerr=np.maximum(bars, 0.0), color=colour, marker="o" if n.main else "x",
            markersize=5, elinewidth=0.9, capsize=2, alpha=0.8, zorder=3,
        )  # fmt: skip
    sizes = [n.scale / medians[n.of, n.name] for n in estimates] or [0.5, 2.0]
    ends = np.array([min(sizes) / 1.5, max(sizes) * 1.5])
    left.plot(ends, ends, color=style.INK, linestyle=style.DASHES, linewidth=1.0, zorder=2)
    left.set_xscale("log")
    left.set_yscale("log")
    left.set_xlim(*ends)
    left.set_ylim(*(ends * [0.6, 1.6]))
    style.dress(left, title="sizes, normalised by the median", x="true", y="estimated, 95 % interval")
    everything = score.estimates[OURS]
    for main, colour, title in ((True, style.INK, "main parameters"), (False, style.FAINT, "all others")):
        errors = np.sort([100 * max(n.error, 1e-5) for n in everything if n.main == main])
        if len(errors):
            share = 100 * np.arange(1, len(errors) + 1) / len(errors)
            right.step(errors, share, where="post", color=colour, linewidth=1.6, label=f"{title} ({len(errors)})")
    right.axvline(5.0, color=style.ALERT, linestyle=style.DASHES, linewidth=1.2)
    right.axhline(50.0, color=style.ALERT, linestyle=style.DASHES, linewidth=1.2)
    right.set_xscale("log")
    right.set_ylim(0, 103)
    style.dress(right, title="errors, all parameters", x="relative error [%]", y="share of the parameters [%]")
    if everything:
        right.legend(frameon=False, fontsize=style.SMALL_SIZE)
    sides = [Line2D([], [], color=c, marker="o", linestyle="", label=f"{side} side") for side, c in SIDES.items()]
    others = Line2D([], [], color=style.FAINT, marker="x", linestyle="", label="not the effect's first parameter")
    goal = Line2D([], [], color=style.ALERT, linestyle=style.DASHES, label="goal: half of them within 5 %")
    style.legend_below(figure, [*sides, others, goal])
    return figure


def _median(estimates: Sequence[ParameterEstimate]) -> float:
    return float(np.exp(np.mean([np.log(n.scale) for n in estimates])))


def coverage_figure(score: Score) -> Figure:
    """How many of the 95 % intervals hold the truth, group by group."""
    estimates = score.estimates[OURS]
    groups: dict[str, Sequence[ParameterEstimate]] = {"all of effects": estimates}
    groups["their main parameters"] = [n for n in estimates if n.main]
    for effect in sorted({n.of for n in estimates}):
        groups[effect.replace("_", " ")] = [n for n in estimates if n.of == effect]
    groups["all of the robot"] = score.own
    for name in sorted({n.name for n in score.own}):
        groups[name] = [n for n in score.own if n.name == name]
    shown = {name: Share.among(n.covered for n in own) for name, own in groups.items() if own}
    figure = style.new_figure(9.5, 1.6 + 0.26 * max(len(shown), 4), "95 % intervals that hold the truth")
    axes = figure.add_subplot()
    axes.axvspan(100 * COVERAGE[0], 100 * COVERAGE[1], color=style.SHADE, zorder=0)
    for k, (name, share) in enumerate(shown.items()):
        low, high = (100 * end for end in share.interval)
        colour = style.INK if name.startswith("all of") else style.JOINT_COLOURS[0]
        axes.plot([low, high], [k, k], color=colour, linewidth=2.0, zorder=3)
        axes.plot([100 * share.value], [k], "o", color=colour, markersize=6, zorder=4)
    axes.axvline(95.0, color=style.INK, linestyle=style.DASHES, linewidth=1.0)
    axes.set_yticks(range(len(shown)), [f"{name} ({share.of})" for name, share in shown.items()])
    axes.invert_yaxis()
    style.dress(axes, x="intervals that hold [%], with the 95 % interval of that; goal shaded")
    axes.grid(False, axis="y")
    return figure


def heldout_figure(score: Score) -> Figure:
    """Share of the excess residual variance on test trials that the augmented models explain."""
    figure = style.new_figure(8.0, 4.2, "Excess residual variance explained on held-out trials")
    axes = figure.add_subplot()
    shares = 100 * np.clip([h.share for h in score.heldout], -0.25, 1.0)
    bins = np.arange(-25.0, 102.5, 2.5)
    axes.hist(shares, bins=list(bins), color=style.JOINT_COLOURS[0], alpha=0.8, zorder=3)
    least = min([100 * LEAST_HELD_OUT, *shares])
    axes.set_xlim(bins[bins <= least][-1] - 5, 102.5)
    axes.axvline(100 * LEAST_HELD_OUT, color=style.ALERT, linestyle=style.DASHES, linewidth=1.2, zorder=4)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    style.dress(
        axes,
        title=f"Cases where exactly what is missing was found: {len(shares)}; the goal is dashed",
        x="share of the excess residual variance [%]",
        y="cases",
    )
    return figure
