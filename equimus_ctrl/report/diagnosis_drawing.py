"""Panels drawn, for a finding, for an unstructured residual force, for splits; and the ranking of all candidates."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.results import Diagnosis, Named, Ranked
from equimus_ctrl.diagnosis.split_comparison import SplitComparison
from equimus_ctrl.report import style
from equimus_ctrl.report.diagnosis_curves import panels, unexplained_panel
from equimus_ctrl.report.diagnosis_panels import Band, Panel, Scene
from equimus_ctrl.report.diagnosis_splits import named, which
from equimus_ctrl.report.diagnosis_text import Law, candidate_of, grouped, upper
from equimus_ctrl.report.diagnosis_words import coordinates_text, listed, reading, short
from equimus_ctrl.types import Array

WIDTH = 11.0
CHARACTERS, TITLE_CHARACTERS = 10.5, 8.2
"""Of a panel's title and of a figure's that fit in an inch of its width, the label of the other axis apart."""
LABEL_CHARACTERS = 46
"""Of a candidate in the ranking before its name is wrapped."""
WITH, WITHOUT = "#0072B2", "#6B6B6B"
EQUIVALENT, OTHER = "#86BBD8", "#C4C4C4"
MOST_CANDIDATES = 20
BY_CHANCE = 1.0
"""What an effect of one parameter gains on average where it is not there (χ² of one degree of freedom); with less it is
not drawn."""
DATA_HEIGHT = 0.1
"""Share of the axes' height that is left to show where the recordings lie."""
DATA_BINS = 48
MOST_BAND = 1.0
"""A band is drawn up to so many times the curves' height beyond them."""
A_ROW, MOST_PANELS = 3, 6
"""Panels side by side, and in a figure."""
MOST_EFFECTS, COLUMNS = 12, 3
"""Of what splits say: what most of them name."""
PANEL_HEIGHT = 1.9
BESIDE = 0.35
"""Of the horizontal axis before the first split and behind the last, in splits."""


def finding_figure(scene: Scene, law: Law) -> Figure:
    """The curves of a finding; of a law with its own size at several places the first curve of each place."""
    named, first = law.named, law.findings[0]
    title = upper(short(named, scene.model))
    if len(law.findings) > 1:
        of_places = [replace(panels(scene, f)[0], title=listed(f.named.locations)) for f in law.findings]
        return _figure(title, of_places, "interval")
    alike = f", drawn at {named.locations[0]}" if len(named.locations) > 1 else ""
    return _figure(f"{title}{alike}", panels(scene, first)[:MOST_PANELS], "interval")


def unexplained_figure(scene: Scene, residual: Unexplained) -> Figure | None:
    """The curve of an unstructured residual force; None where it has none."""
    panel = unexplained_panel(scene, residual)
    if panel is None or not isinstance(residual, ResidualForce):
        return None
    on = coordinates_text(residual.coordinates, scene.model)
    title = f"Unexplained at {residual.location}: a force that depends on {on}"
    return _figure(title, [panel], "95 % interval")


def _figure(title: str, shown: Sequence[Panel], interval: str) -> Figure:
    columns = min(len(shown), A_ROW) if len(shown) != 4 else 2
    rows = -(-len(shown) // columns)
    width = WIDTH if columns > 1 else 7.0
    title = textwrap.fill(title, int(TITLE_CHARACTERS * width))
    figure = style.new_figure(width, 1.1 + 2.9 * rows, title)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, panel in zip(grid.flat, shown, strict=False):
        draw(axes, panel, int(CHARACTERS * width / columns))
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    style.legend_below(figure, handles_of(shown, interval))
    return figure


def draw(axes: Axes, panel: Panel, characters: int) -> None:
    """Draw a panel on axes whose title and label have room for so many characters."""
    if panel.rows:
        _draw_table(axes, panel)
        return
    for line in panel.lines:
        if line.without:
            axes.plot(line.x, line.y, color=WITHOUT, linewidth=1.5, linestyle=style.DASHES, zorder=2)
        else:
            axes.plot(line.x, line.y, color=WITH, linewidth=2.0, zorder=3)
    if panel.band is not None:
        for x, low, high in _one_way(panel.band):
            axes.fill_between(x, low, high, color=WITH, alpha=0.22, linewidth=0, zorder=1)
        axes.set_ylim(*_limits(panel))
    left, right = min(line.x.min() for line in panel.lines), max(line.x.max() for line in panel.lines)
    axes.set_xlim(left, right)
    if panel.data is not None:
        _draw_data(axes, panel.data, left, right)
    style.dress(axes, title=textwrap.fill(panel.title, characters), x=textwrap.fill(panel.x, characters), y=panel.y)


def _one_way(band: Band) -> list[Band]:
    """A band to and fro along x as pieces in each of which x goes one way."""
    way = np.sign(np.diff(band[0]))
    turns = np.flatnonzero(way[1:] * way[:-1] < 0) + 1
    edges = [0, *turns.tolist(), len(band[0]) - 1]
    return [(band[0][a : b + 1], band[1][a : b + 1], band[2][a : b + 1]) for a, b in pairwise(edges)]


def _limits(panel: Panel) -> tuple[float, float]:
    """Such that the curves can be read, however wide the band is."""
    curves = np.concatenate([line.y[np.isfinite(line.y)] for line in panel.lines])
    low, high = float(curves.min()), float(curves.max())
    room = MOST_BAND * max(high - low, 1e-12)
    if panel.band is not None:
        low, high = max(float(panel.band[1].min()), low - room), min(float(panel.band[2].max()), high + room)
    low, high = min(low, float(curves.min())), max(high, float(curves.max()))
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _draw_data(axes: Axes, data: Array, low: float, high: float) -> None:
    """Bars at the foot of the axes: where the recordings lie, the highest bar as high as the room that is made."""
    count, edges = np.histogram(data, bins=DATA_BINS, range=(low, high))
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom - 1.6 * DATA_HEIGHT * (top - bottom), top)
    height = DATA_HEIGHT * count / max(int(count.max()), 1)
    transform = axes.get_xaxis_transform()
    axes.bar(
        edges[:-1], height, np.diff(edges), align="edge", color=style.FAINT, alpha=0.55, linewidth=0,
        transform=transform, zorder=1,
    )  # fmt: skip


def _draw_table(axes: Axes, panel: Panel) -> None:
    axes.set_axis_off()
    axes.set_title(panel.title, loc="left", fontsize=style.PANEL_SIZE, color=style.INK)
    rows = [("", "modelled → now"), *panel.rows]
    for k, row in enumerate(rows):
        for x, text, side in zip((0.0, 1.0), row, ("left", "right"), strict=True):
            axes.text(
                x, 0.94 - 0.11 * k, text, ha=side, va="center", fontsize=style.SMALL_SIZE, color=style.INK,
                fontweight="normal" if k else "bold", transform=axes.transAxes,
            )  # fmt: skip


def handles_of(shown: Sequence[Panel], interval: str) -> list[Artist]:
    """What a legend says of panels."""
    handles: list[Artist] = []
    for line in {line.label: line for panel in shown for line in panel.lines}.values():
        dashes = {"linestyle": style.DASHES, "linewidth": 1.5, "color": WITHOUT}
        handles.append(Line2D([], [], label=line.label, **(dashes if line.without else {"color": WITH, "lw": 2.0})))  # type: ignore[arg-type]
    if any(panel.band is not None for panel in shown):
        handles.append(Patch(facecolor=WITH, alpha=0.22, label=interval))
    if any(panel.data is not None for panel in shown):
        handles.append(Patch(facecolor=style.FAINT, alpha=0.55, label="where the recordings lie"))
    return handles


def ranking_figure(diagnosis: Diagnosis) -> Figure:
    """What every candidate would gain alone, the best of them and all that was found."""
    found = grouped(diagnosis.findings)
    findings = [candidate_of(law) for law in found]
    equivalent = [other for f in diagnosis.findings for other in f.equivalent]
    told = (*findings, *equivalent)
    gaining = [r for r in diagnosis.ranking if max(r.screened, r.fitted or 0.0) >= BY_CHANCE or r.named in told]
    shown = gaining[:MOST_CANDIDATES] + [r for r in gaining[MOST_CANDIDATES:] if r.named in told]
    shown = shown or list(diagnosis.ranking[:1])
    names = [textwrap.fill(short(r.named, diagnosis.model), LABEL_CHARACTERS) for r in shown]
    lines = sum(name.count("\n") + 1 for name in names)
    figure = style.new_figure(
        WIDTH,
        1.6 + 0.17 * lines + 0.1 * len(shown),
        f"What each effect would gain alone ({len(shown)} of {len(diagnosis.ranking)} candidates)",
    )
    axes = figure.add_subplot()
    threshold = min(r.threshold for r in diagnosis.ranking)
    beside = {candidate_of(law): law.findings[0].evidence.gain for law in found}
    gains = [max(r.screened, r.fitted or 0.0) for r in shown]
    largest = max([10.0, threshold, *beside.values(), *gains])
    least = max(BY_CHANCE, 1e-5 * largest)
    colours = {r.named: WITH if r.named in findings else EQUIVALENT if r.named in equivalent else OTHER for r in shown}
    _draw_gains(axes, shown, colours, least)
    for row, ranked in enumerate(shown):
        if ranked.named in beside:
            at = max(beside[ranked.named], least)
            axes.plot(at, row, marker="D", markersize=8, color=WITH, markeredgecolor="white", zorder=5)
    axes.axvline(threshold, color=style.ALERT, linewidth=1.3, linestyle=style.DASHES)
    axes.set_xscale("log")
    axes.set_xlim(least, 2 * largest)
    axes.set_yticks(np.arange(len(shown)), names)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    style.dress(axes, x="fall of −2 log likelihood")
    for label, ranked in zip(axes.get_yticklabels(), shown, strict=True):
        if ranked.named in findings:
            label.set_fontweight("bold")
    fitted = {colours[r.named] for r in shown if r.fitted is not None}
    style.legend_below(figure, _ranking_handles(len(findings), fitted))
    return figure


def _draw_gains(axes: Axes, shown: Sequence[Ranked], colours: Mapping[Named, str], least: float) -> None:
    """A dot for the gain when fitted, a circle for that expected to first order, row by row; no bars without a zero."""
    for row, ranked in enumerate(shown):
        if ranked.fitted is not None:
            gain = max(ranked.fitted, least)
            axes.plot(gain, row, marker="o", markersize=8, color=colours[ranked.named], clip_on=False, zorder=3)
        axes.plot(
            max(ranked.screened, least), row, marker="o", markersize=5.5, markerfacecolor="none",
            markeredgecolor=style.INK, clip_on=False, zorder=4,
        )  # fmt: skip


def _dot(colour: str, label: str) -> Line2D:
    return Line2D([], [], marker="o", markersize=8, linestyle="", color=colour, label=label)


def _ranking_handles(findings: int, fitted: set[str]) -> list[Artist]:
    """The legend of a ranking, by what it has: how many findings, and the colours of candidates that were fitted."""
    handles: list[Artist] = []
    if findings:
        label = "found, beside the others" if findings > 1 else "found"
        handles.append(Line2D([], [], marker="D", markersize=8, linestyle="", color=WITH, label=label))
    dots = {WITH: "found, alone", EQUIVALENT: "not distinguishable from it", OTHER: "other, fitted"}
    handles += [_dot(colour, label) for colour, label in dots.items() if colour in fitted]
    expected = {"markerfacecolor": "none", "markeredgecolor": style.INK, "label": "expected to first order"}
    handles.append(Line2D([], [], marker="o", linestyle="", **expected))  # type: ignore[arg-type]
    handles.append(Line2D([], [], color=style.ALERT, linestyle=style.DASHES, label="acceptance threshold"))
    return handles


def splits_figure(splits: SplitComparison) -> Figure:
    """The first parameter of what most splits name, with its interval in each of them."""
    shown = splits.effects[:MOST_EFFECTS]
    height = -(-len(shown) // COLUMNS)
    drawn = style.new_figure(WIDTH, 1.1 + PANEL_HEIGHT * height, "First size of each effect over the splits")
    grid = drawn.subplots(height, COLUMNS, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    place = {answer.number: k for k, answer in enumerate(splits.answers)}
    for effect, axes in zip(shown, grid.flat, strict=False):
        key, estimates = next(iter(effect.estimates.items()))
        scale = reading(estimates[0].unit, estimates[0].value)
        endless: list[tuple[int, float, bool, str]] = []
        for number, own in zip(effect.named, estimates, strict=True):
            k, colour = place[number], style.FAINT if number else style.JOINT_COLOURS[0]
            value, low, high = (v * scale.factor for v in (own.value, own.low, own.high))
            ends = [[value - low if math.isfinite(low) else 0.0], [high - value if math.isfinite(high) else 0.0]]
            endless += [(k, value, end > value, colour) for end in (low, high) if not math.isfinite(end)]
            axes.errorbar([k], [value], yerr=ends, fmt="o", markersize=4, color=colour, capsize=2, linewidth=1.2)
        edges = axes.get_ylim()
        for k, value, up, colour in endless:
            axes.vlines(k, value, edges[up], color=colour, linewidth=1.2, linestyles=":")
        axes.set_ylim(edges)
        for number in sorted(place.keys() - effect.named):
            axes.axvspan(place[number] - 0.4, place[number] + 0.4, color=style.SHADE, linewidth=0)
        axes.set_xlim(-BESIDE - 0.1, len(place) - 1 + BESIDE + 0.1)
        axes.set_xticks(range(len(place)), [which(number)[:3] for number in place])
        label = key.replace("_", " ")
        y = f"{label} [{scale.unit}]" if scale.unit else label
        style.dress(axes, title=f"{named(effect)}: {len(effect.named)} of {len(place)}", y=y)
    looks = ((style.JOINT_COLOURS[0], "default split (def), 95 % interval"), (style.FAINT, "random splits, by number"))
    handles: list[Artist] = [Line2D([], [], color=colour, marker="o", label=label) for colour, label in looks]
    style.legend_below(drawn, [*handles, Patch(color=style.SHADE, label="not named in this split")])
    return drawn
