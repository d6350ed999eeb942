"""Figures of a designed experiment: its commands, what each explanation predicts of it, and its power."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from equimus_ctrl.experiments.forecast import Forecast, forecast
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.report import style
from equimus_ctrl.report.commands_figure import WIDTH, drop, grid_of
from equimus_ctrl.report.diagnosis_words import percent
from equimus_ctrl.report.experiment_text import named
from equimus_ctrl.robots.reading import reading

MOST_DRAWN = 4
"""Explanations that are drawn beside each other; of more the first ones."""
LONGEST_LABEL = 60
"""Characters of an explanation in a legend."""
LEAST_SPAN = 6.0
"""Standard deviations of the noise that an axis shows at least: less than the noise is not seen."""
LEAST_GAP = 1e-2
"""Gaps are drawn from there on."""


def design_drawings(found: Designed) -> style.Drawings:
    """Name → what draws that figure."""
    known: list[Forecast] = []

    def once(draw: Callable[[Designed, Forecast], Figure]) -> Callable[[], Figure]:
        def made() -> Figure:
            if not known:
                known.append(forecast(found))
            return draw(found, known[0])

        return made

    return {
        "commands": lambda: commands_figure(found),
        "predictions": once(predictions_figure),
        "power": lambda: power_figure(found),
    }


def commands_figure(found: Designed) -> Figure:
    """A panel of each actuator's command, or of each joint's reference, with its limits."""
    robot, own, limits = found.rivals.model.robot, found.commands, found.limits
    names, units, ends = robot.actuator_names, robot.command_units, (limits.command_low, limits.command_high)
    what, limit, linear = "commands", "limit of the command", found.rivals.linear
    if tracked := own.reference is not None:
        names, units, linear = robot.joint_names, robot.joint_units, True
        ends = limits.joint_low + limits.joint_margin, limits.joint_high - limits.joint_margin
        what, limit = "references that joints track", "limit of the joint, less its margin"
    na = len(names)
    rows, columns = grid_of(na)
    under = f" under {found.condition.text}" if found.condition.text else ""
    figure = style.new_figure(
        WIDTH * (1 + 0.4 * (columns - 1)), 1.1 + 1.9 * rows, f"Designed {what}: {found.family}{under}"
    )
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for i, name in enumerate(names):
        axes, shown = panels[divmod(i, columns)], reading(units[i])
        style.dress(
            axes, y=f"{name} [{shown.unit}]" if shown.unit else name,
            x="time [s]" if i + columns >= na else "",
        )  # fmt: skip
        draw = axes.plot if linear else axes.step
        more = {} if linear else {"where": "post"}
        colour = style.joint_colour(i) if tracked else style.actuator_colour(i)
        draw(own.times, own.course[:, i] * shown.factor, color=colour, lw=style.RUN_WIDTH, **more)
        low, high = axes.get_ylim()
        for edge in (ends[0][i] * shown.factor, ends[1][i] * shown.factor):
            if low - (high - low) < edge < high + (high - low):
                axes.axhline(edge, color=style.FAINT, linewidth=style.REFERENCE_WIDTH, linestyle=style.DASHES)
        axes.set_xlim(0, own.duration)
    drop(panels[-1:], rows * columns - na)
    figure.align_ylabels()
    style.legend_below(figure, [Line2D([], [], color=style.FAINT, linestyle=style.DASHES, label=limit)])
    return figure


def predictions_figure(found: Designed, own: Forecast) -> Figure:
    """Of each joint what explanations predict, and what each leaves of the first one's prediction, refitted to it."""
    robot, rivals = found.rivals.model.robot, found.rivals.rivals
    nj, drawn = len(robot.joint_names), min(len(rivals), MOST_DRAWN)
    figure = style.new_figure(2 * WIDTH * 0.7, 1.4 + 2.0 * nj, "What the explanations left predict of the trial")
    panels = figure.subplots(nj, 2, sharex=True, squeeze=False)
    for j, name in enumerate(robot.joint_names):
        shown = reading(robot.joint_units[j])
        left, right = panels[j]
        for k in range(drawn):
            colour = style.joint_colour(k)
            band = own.low[k, :, j] * shown.factor, own.high[k, :, j] * shown.factor
            left.fill_between(own.times, *band, color=colour, alpha=0.18, linewidth=0)
            left.plot(own.times, own.middle[k, :, j] * shown.factor, color=colour, linewidth=style.RECORDED_WIDTH)
            if k:
                right.plot(own.apart_times, own.apart[k][:, j], color=colour, linewidth=style.RECORDED_WIDTH)
        right.axhspan(-1, 1, color=style.SHADE, linewidth=0, zorder=0)
        last = "time [s]" if j == nj - 1 else ""
        style.dress(left, title=f"{name}: prediction, 90 % of parameters", y=f"{name} [{shown.unit}]", x=last)
        style.dress(right, title=f"{name}: left after refitting", y="over the noise", x=last)
        left.set_xlim(0, found.commands.duration)
        _at_least(left, LEAST_SPAN * own.sigma[j] * shown.factor)
        _at_least(right, LEAST_SPAN)
    figure.align_ylabels()
    handles: list[Artist] = [
        Line2D([], [], color=style.joint_colour(k), label=_label(named(rivals[k]))) for k in range(drawn)
    ]
    handles.append(Patch(facecolor=style.SHADE, label="one standard deviation of the noise"))
    style.legend_below(figure, handles)
    return figure


def power_figure(found: Designed) -> Figure:
    """Of each pair of explanations the gap that is expected, whichever is true, and what is needed."""
    pairs = found.pairs
    rivals = found.rivals.rivals
    rows = [(power, pair) for pair in pairs for power in pair.powers]
    figure = style.new_figure(WIDTH * 1.1, 1.7 + 0.42 * len(rows), "Expected gap of one trial, whichever is true")
    axes: Axes = figure.subplots()
    style.dress(axes, x="gap −2Δln L in favour of the true explanation")
    labels = []
    for y, (power, _) in enumerate(rows):
        low, high = (max(value, LEAST_GAP) for value in power.interval)
        gap, needed = max(power.gap, LEAST_GAP), power.needed - power.ahead
        colour = style.joint_colour(y % 2)
        axes.plot([low, high], [y, y], color=colour, linewidth=3, alpha=0.45, solid_capstyle="butt")
        axes.plot([gap], [y], "o", color=colour, markersize=6)
        if needed > 0:
            axes.plot([needed], [y], "|", color=style.ALERT, markersize=14, markeredgewidth=2)
        repeats = (
            "1 trial" if power.repeats == 1 else f"{power.repeats:.0f} trials" if np.isfinite(power.repeats) else "–"
        )
        axes.annotate(
            f"{percent(power.chance)}, {repeats}", (1.0, y), xycoords=("axes fraction", "data"), xytext=(6, 0),
            textcoords="offset points", va="center", fontsize=style.SMALL_SIZE, color=style.INK,
        )  # fmt: skip
        labels.append(f"{_label(named(rivals[power.first]))}\nnot {_label(named(rivals[power.second]))}")
    axes.set_yticks(range(len(rows)), labels)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    handles: list[Artist] = [
        Line2D([], [], marker="o", color=style.INK, label="median, and 90 % with noise and unknown parameters"),
        Line2D([], [], marker="|", color=style.ALERT, linestyle="", markersize=12, markeredgewidth=2,
               label="needed to settle it"),
        Line2D([], [], color="none", label="at the right: chance of one trial, trials for 95 %"),
    ]  # fmt: skip
    style.legend_below(figure, handles)
    return figure


def _at_least(axes: Axes, span: float) -> None:
    """Have the vertical axis span so much."""
    low, high = axes.get_ylim()
    if high - low < span:
        middle = (low + high) / 2
        axes.set_ylim(middle - span / 2, middle + span / 2)


def _label(text: str) -> str:
    return text if len(text) <= LONGEST_LABEL else f"{text[: LONGEST_LABEL - 1]}…"
