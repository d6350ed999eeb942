"""Figure of commands: a panel for each actuator, with its limits and where they cut commands off."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from equimus_ctrl.report import style
from equimus_ctrl.robots.reading import Reading, reading
from equimus_ctrl.scenarios.scoring import Score
from equimus_ctrl.types import Array, Run

WIDTH = 10.0
MOST_ROWS = 4
"""Joints or actuators beside which there is no second column."""


def grid_of(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels, filled row by row."""
    columns = 1 if count <= MOST_ROWS else 2
    return -(-count // columns), columns


def drop(last: Any, count: int) -> None:
    """Take away so many panels at the end of the last rows, which nothing is drawn in."""
    for row in last:
        for axes in row[len(row) - count :]:
            axes.remove()


def commands_figure(run: Run, score: Score, label: str) -> Figure:
    """A panel of each actuator's command, with its limits where they are near and where they cut a command off."""
    spec, na = run.spec, len(run.spec.actuators)
    rows, columns = grid_of(na)
    pressures = set(spec.command_units) == {"Pa"}
    title = f"{label}: commanded pressures" if pressures else f"{label}: commands"
    figure = style.new_figure(WIDTH * (1 + 0.4 * (columns - 1)), 1.1 + 1.9 * rows, title)
    panels, limited = figure.subplots(rows, columns, sharex=True, squeeze=False), False
    for i, name in enumerate(spec.actuators):
        axes, own = panels[divmod(i, columns)], reading(spec.command_units[i])
        low, high = spec.command_low[i] * own.factor, spec.command_high[i] * own.factor
        command, asked, clipped = run.command[:, i] * own.factor, run.asked[:, i] * own.factor, run.clipped[:, i]
        title = f"{name}   {own.text(score.effort[i], '.1f' if pressures else '.3g')} RMS"
        if clipped.any():
            title += f", {100 * clipped.mean():.1f} % of commands clipped"
        last = i + columns >= na
        style.dress(axes, title=title, y=f"{name} [{own.unit}]" if own.unit else name, x="time [s]" if last else "")
        axes.tick_params(labelbottom=last)
        axes.set_xlim(run.time[0], run.time[-1] + spec.control_dt)
        bottom, top = _command_limits(axes, command, low, high, own)
        for edge, beyond in ((low, bottom), (high, top)):
            if np.isfinite(edge):
                axes.axhspan(edge, beyond, color=style.SHADE, linewidth=0, zorder=0)
                axes.axhline(edge, color=style.FAINT, linewidth=style.THIN_WIDTH)
        view = axes.get_ylim()
        axes.set_ylim(*view)
        limited = limited or view[0] < low or high < view[1]
        axes.step(run.time, command, where="post", color=style.actuator_colour(i), linewidth=style.RUN_WIDTH)
        for edge, beyond, cut in ((low, bottom, asked < low), (high, top, asked > high)):
            bars = _bars(run, clipped & cut)
            if bars:
                axes.broken_barh(bars, (min(edge, beyond), abs(beyond - edge)), facecolor=style.ALERT, linewidth=0)
    drop(panels[-1:], rows * columns - na)
    figure.align_ylabels()
    handles: list[Artist] = []
    if limited:
        handles.append(Patch(facecolor=style.SHADE, edgecolor=style.FAINT, label="beyond the limits"))
    if run.clipped.any():
        handles.append(Patch(facecolor=style.ALERT, label="clipped: more was asked for than the limit allows"))
    if handles:
        style.legend_below(figure, handles)
    return figure


def _bars(run: Run, where: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """(from, width) [s] of the stretches where ``where`` holds, none too narrow to be seen."""
    edges = np.diff(np.concatenate([[0], where.astype(int), [0]]))
    dt, least = run.spec.control_dt, 0.002 * float(run.time[-1] - run.time[0])
    begins, ends = run.time[np.flatnonzero(edges == 1)], run.time[np.flatnonzero(edges == -1) - 1] + dt
    return [(float(a), max(float(b - a), least)) for a, b in zip(begins, ends, strict=True)]


def _command_limits(axes: Axes, command: Array, low: float, high: float, own: Reading) -> tuple[float, float]:
    """Show the whole range where the commands use half of it, else what they use, and say where the limits are."""
    least, most = float(command.min()), float(command.max())
    span = high - low
    if np.isfinite(low) and most < low + 0.5 * span and least >= low and low >= 0:
        reach = max(most - low, 0.02 * span if np.isfinite(span) else 1e-3)
        bottom, top = low - 0.08 * reach, low + 1.25 * reach
        if np.isfinite(high):
            _say_limit(axes, f"limit {high:g} {own.unit} ↑")
        axes.set_ylim(bottom, top)
        return bottom, max(top, high)
    if np.isfinite(span) and (most - least >= 0.5 * span or low >= 0):
        axes.set_ylim(low - 0.06 * span, high + 0.06 * span)
        return low - 0.06 * span, high + 0.06 * span
    reach = max(most - least, 1e-3 * max(abs(most), abs(least)), 1e-6)
    bottom, top = least - 0.2 * reach, most + 0.2 * reach
    if bottom > low > -np.inf or top < high < np.inf:
        _say_limit(axes, f"limits {low:g} to {high:g} {own.unit}".rstrip())
    axes.set_ylim(bottom, top)
    return min(bottom, low), max(top, high)


def _say_limit(axes: Axes, text: str) -> None:
    axes.annotate(
        text, (1.0, 1.0), xycoords="axes fraction", xytext=(0, 4), textcoords="offset points", ha="right",
        fontsize=style.SMALL_SIZE, color=style.FAINT,
    )  # fmt: skip
