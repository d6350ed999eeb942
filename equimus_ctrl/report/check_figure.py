"""One figure of a check: how far joints go beside noise and steps, and what the recordings determine and could show."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from equimus_ctrl.preflight.information import EffectInformation, Information
from equimus_ctrl.preflight.result import CheckResult
from equimus_ctrl.report import style

ROW = 0.24
"""Height of a row [inch]."""
LABELS = 3.0
"""Height of a panel's title and labels [rows]."""
MARKERS = ("o", "s", "^", "D")
"""Of places, once there are more than colours."""
MOST_PARAMETERS = 24
"""Parameters drawn, the least certain ones."""


def check_figure(check: CheckResult) -> Figure:
    """Panels side by side: signals, parameters, effects; without linear response the first alone."""
    known = check.information
    joints = len(check.model.robot.joint_names)
    if known is None:
        figure = style.new_figure(7.0, 1.6 + 2 * ROW * joints, "Signals of the recordings")
        handles = _signals(figure.subplots(), check)
        style.legend_below(figure, handles)
        return figure
    effects = _by_effect(known)
    parameters = min(len(known.parameters), MOST_PARAMETERS)
    left = [joints + LABELS, parameters + LABELS]
    rows = max(len(effects) + 1.0, sum(left))
    figure = style.new_figure(12.0, 1.6 + ROW * rows, f"What {len(check.signals)} recordings could show")
    # What is left of the column stays empty: rows are as high on both sides.
    grid = figure.add_gridspec(3, 2, height_ratios=[*left, max(rows - sum(left), 1e-3)], width_ratios=[1, 1.1])
    handles = _signals(figure.add_subplot(grid[0, 0]), check)
    _parameters(figure.add_subplot(grid[1, 0]), known)
    places = _effects(figure.add_subplot(grid[:, 1]), effects)
    style.legend_below(figure, [*handles, *places])
    return figure


def _signals(axes: Axes, check: CheckResult) -> list[Artist]:
    """Travel, noise and step of each joint, largest over the recordings, on one logarithmic scale."""
    names = check.model.robot.joint_names
    kinds = (("travel", "o", style.INK), ("noise", "D", style.joint_colour(0)), ("sensor step", "|", style.ALERT))
    drawn = set()
    for j in range(len(names)):
        own = [signals.joints[j] for signals in check.signals]
        noise = math.sqrt(sum(joint.noise**2 for joint in own) / len(own))
        values = (max(joint.travel for joint in own), noise, max(joint.step for joint in own))
        low, high = noise, max(values[0], noise)
        axes.plot([1e3 * low, 1e3 * high], [j, j], color=style.GRID, linewidth=4, solid_capstyle="butt", zorder=1)
        for value, (kind, marker, colour) in zip(values, kinds, strict=True):
            if value > 0:
                drawn.add(kind)
                axes.plot(1e3 * value, j, marker, color=colour, markersize=9 if marker == "|" else 6, zorder=3)
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    slides = {check.model.robot.slides(name) for name in names}
    unit = "mm" if slides == {True} else "mrad" if slides == {False} else "mrad or mm"
    style.dress(axes, title="Motion beside noise and steps", x=f"[{unit}]")
    axes.grid(False, axis="y")
    return [
        Line2D([], [], linestyle="", marker=marker, color=colour, markersize=7, label=label)
        for label, marker, colour in kinds
        if label in drawn
    ]


def _parameters(axes: Axes, known: Information) -> None:
    """Least standard deviations as shares of the nominal values, and what they would be were all others known."""
    shares = []
    for own in known.parameters:
        size = abs(own.value) or own.range
        shares.append((own.deviation / size, own.alone / size, own.name))
    rows = sorted(shares, key=lambda row: -row[0])[:MOST_PARAMETERS]
    finite = [value for share, alone, _ in rows for value in (share, alone) if math.isfinite(value) and value > 0]
    low, high = (min(finite), max(finite)) if finite else (1e-4, 1.0)
    for k, (share, alone, _) in enumerate(rows):
        if not math.isfinite(share):
            axes.text(100 * low, k, "not identifiable", va="center", fontsize=style.SMALL_SIZE, color=style.ALERT)
            continue
        axes.plot([100 * alone, 100 * share], [k, k], color=style.GRID, linewidth=4, solid_capstyle="butt", zorder=1)
        axes.plot(100 * share, k, "o", color=style.INK, markersize=6, zorder=3)
        axes.plot(100 * alone, k, "|", color=style.FAINT, markersize=9, zorder=2)
    axes.set_xscale("log")
    axes.set_xlim(100 * low / 2, 100 * high * 2)
    axes.set_yticks(range(len(rows)), [name for *_, name in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    more = len(known.parameters) - len(rows)
    title = "Least standard deviation (grey: others known)"
    style.dress(
        axes, title=title + (f"; {more} more are known better" if more > 0 else ""), x="[% of the nominal value]"
    )
    axes.grid(False, axis="y")


def _by_effect(known: Information) -> dict[str, list[EffectInformation]]:
    """Effects with a size, by name, the ones that show best first, those that do not show last."""
    found: dict[str, list[EffectInformation]] = {}
    for own in known.effects:
        if own.sized:
            found.setdefault(own.smallest.named.effect, []).append(own)

    def best(rows: list[EffectInformation]) -> float:
        return min((own.share for own in rows if own.possible and own.share > 0), default=math.inf)

    return dict(sorted(found.items(), key=lambda item: best(item[1])))


def _effects(axes: Axes, effects: dict[str, list[EffectInformation]]) -> list[Artist]:
    """Smallest detectable sizes as shares of what they compare with, a row an effect, a colour a place."""
    drawn = [own for rows in effects.values() for own in rows if own.possible and own.share > 0]
    places = list(dict.fromkeys(own.smallest.named.locations[0] for own in drawn))
    colours = (*style.JOINT_COLOURS, *style.ACTUATOR_COLOURS)
    values = [own.share for own in drawn]
    low, high = (min(values), max(values)) if values else (1e-4, 1.0)
    for k, rows in enumerate(effects.values()):
        shown = [own for own in rows if own.possible and own.share > 0]
        if not shown:
            said = "acts like free parameters" if any(own.confounded for own in rows) else "does not show"
            axes.text(low, k, said, va="center", fontsize=style.SMALL_SIZE, color=style.FAINT)
        for own in shown:
            place = places.index(own.smallest.named.locations[0])
            colour, marker = colours[place % len(colours)], MARKERS[place // len(colours) % len(MARKERS)]
            axes.plot(own.share, k, marker, color=colour, markersize=6, alpha=0.9, zorder=3)
    axes.set_xscale("log")
    axes.set_xlim(low / 2, max(2 * high, 4 * low))
    axes.set_yticks(np.arange(len(effects)), [name.replace("_", " ") for name in effects])
    axes.set_ylim(len(effects) - 0.4, -0.6)
    style.dress(
        axes, title="Smallest detectable size of effects", x="share of the largest force, travel or time of the motion"
    )
    return [
        Line2D(
            [],
            [],
            linestyle="",
            marker=MARKERS[k // len(colours) % len(MARKERS)],
            color=colours[k % len(colours)],
            markersize=6,
            label=place,
        )
        for k, place in enumerate(places)
    ]
