"""Figures of a sensitivity analysis: errors against changes of every parameter, and the local effect of each."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from equimus_ctrl.identification.sensitivity import Sensitivity
from equimus_ctrl.report import style

MOST_LINES = 8
LINES = (*style.JOINT_COLOURS, *style.ACTUATOR_COLOURS[:2], style.ACTUATOR_COLOURS[3], style.ACTUATOR_COLOURS[5])
SMALLEST = 1e-5
"""Of the largest sensitivity; what is less is not drawn."""
ROW = 0.21
"""Height of a parameter's row [inch]."""
TITLE_CHARACTERS = 8.2
"""Of a figure's title that fit in an inch of its width."""


def sensitivity_figures(found: Sensitivity) -> dict[str, Figure]:
    """Name → figure: the map of all parameters, the curves of those that matter most, and the local effects."""
    return style.drawn(sensitivity_drawings(found))


def sensitivity_drawings(found: Sensitivity) -> style.Drawings:
    """See ``sensitivity_figures``."""
    return {
        "map": lambda: map_figure(found),
        "curves": lambda: curves_figure(found),
        "local": lambda: local_figure(found),
    }


def map_figure(found: Sensitivity) -> Figure:
    """RMSE for every parameter and change, a map for each joint, all on one logarithmic scale."""
    joints = found.model.robot.joint_names
    felt = np.array([k for k in range(len(found.names)) if not np.all(found.local[k] == 0)], dtype=int)
    n, idle = len(felt), len(found.names) - len(felt)
    title = "RMSE with one parameter changed at a time"
    width = 2.6 + len(joints) * (0.9 + 0.55 * len(found.shares)) + 0.8
    if idle:
        title = textwrap.fill(f"{title} ({idle} without any effect not shown)", int(TITLE_CHARACTERS * width))
    figure = style.new_figure(width, 1.5 + ROW * max(n, 1), title)
    grid = figure.subplots(1, len(joints), squeeze=False, sharey=True)[0]
    values, diverged, names = 1e3 * found.rmse[felt], found.diverged[felt], [found.names[k] for k in felt]
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (1.0, 10.0)
    scale = LogNorm(max(low, 1e-3), max(high, 1.001 * low, 1e-2))
    drawn = None
    for j, (axes, joint) in enumerate(zip(grid, joints, strict=True)):
        drawn = axes.imshow(values[:, :, j], norm=scale, cmap="cividis", aspect="auto", interpolation="nearest")
        style.dress(axes, title=f"{joint}: {1e3 * found.base[j]:.1f} mrad unchanged", x="change")
        axes.grid(False)
        axes.set_facecolor(style.SHADE)
        for i in range(n):
            for k in range(len(found.shares)):
                value = values[i, k, j]
                if diverged[i, k]:
                    text, colour = "diverges", style.ALERT
                elif np.isnan(value):
                    text, colour = "–", style.INK
                else:
                    text = f"{value:.3g}" if value < 1000 else f"{value:.0f}"
                    colour = style.INK if scale(value) > 0.55 else "white"
                size = 5.5 if diverged[i, k] else 7
                axes.text(k, i, text, ha="center", va="center", fontsize=size, color=colour)
        axes.set_xticks(np.arange(len(found.shares)), [f"{100 * s:+g} %" for s in found.shares], rotation=45)
        axes.set_yticks(np.arange(n), names)
        axes.tick_params(length=0, labelleft=j == 0)
        axes.spines[["left", "bottom"]].set_visible(False)
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=list(grid), pad=0.02, shrink=min(1.0, 6.0 / (ROW * n + 0.1)), aspect=25)
        bar.set_label("RMSE [mrad]", fontsize=style.TEXT_SIZE, color=style.INK)
        bar.ax.tick_params(labelsize=style.SMALL_SIZE, which="both")
        bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        bar.ax.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    return figure


def curves_figure(found: Sensitivity) -> Figure:
    """RMSE against the change of those parameters that matter most, all others faint."""
    joints = found.model.robot.joint_names
    figure = style.new_figure(5.4 * len(joints) + 0.6, 5.0, "RMSE against the change of each parameter")
    grid = figure.subplots(1, len(joints), squeeze=False)[0]
    shares = np.concatenate([100 * found.shares, [0.0]])
    order = np.argsort(shares)
    for j, (axes, joint) in enumerate(zip(grid, joints, strict=True)):
        for i in reversed(range(len(found.names))):
            values = 1e3 * np.append(found.rmse[i, :, j], found.base[j])
            strong = i < MOST_LINES
            colour = LINES[i] if strong else style.FAINT
            axes.plot(
                shares[order],
                values[order],
                color=colour,
                linewidth=1.7 if strong else 0.7,
                marker="o" if strong else "",
                markersize=4,
                zorder=3 if strong else 2,
            )
            lost = np.flatnonzero(found.diverged[i])
            if len(lost):
                axes.plot(
                    shares[lost], np.full(len(lost), 0.98), "x", color=colour, transform=axes.get_xaxis_transform()
                )
        style.dress(axes, title=joint, x="change of the parameter [%]", y="RMSE [mrad]" if j == 0 else "")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
        axes.tick_params(which="minor", labelsize=style.SMALL_SIZE, color=style.FAINT)
    handles: list[Artist] = [
        Line2D([], [], color=LINES[i], marker="o", markersize=4, label=name)
        for i, name in enumerate(found.names[:MOST_LINES])
    ]
    if len(found.names) > MOST_LINES:
        others = len(found.names) - MOST_LINES
        handles.append(Line2D([], [], color=style.FAINT, linewidth=0.7, label=f"{others} others"))
    if found.diverged.any():
        handles.append(Line2D([], [], marker="x", linestyle="", color=style.INK, label="diverges (upper edge)"))
    style.legend_below(figure, handles)
    return figure


def local_figure(found: Sensitivity) -> Figure:
    """How far one per cent of each parameter moves the predictions, to first order: dots, for the scale has no zero."""
    joints, n = found.model.robot.joint_names, len(found.names)
    figure = style.new_figure(9.5, 1.7 + ROW * n, "How far one per cent of each parameter moves the predictions")
    axes = figure.add_subplot()
    values = 1e3 * found.local
    positive = values[np.isfinite(values) & (values > 0)]
    low, high = (float(positive.min()), float(positive.max())) if len(positive) else (1e-3, 1.0)
    low = max(low, SMALLEST * high)
    places = np.arange(n)
    for j in range(len(joints)):
        drawn = np.nan_to_num(values[:, j]) >= low
        axes.plot(
            values[drawn, j], places[drawn], "o", color=style.joint_colour(j), markersize=6.5, alpha=0.85, zorder=3
        )
    axes.set_xscale("log")
    axes.set_xlim(low / 1.5, 1.5 * high)
    for i in np.flatnonzero(np.all(~(values >= low), axis=1)):
        text = "none" if np.all(values[i] == 0) else "not known" if np.isnan(values[i]).all() else f"below {low:.1g}"
        axes.text(low / 1.4, float(i), text, va="center", fontsize=7.5, color=style.FAINT)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_yticks(places, found.names)
    axes.set_ylim(n - 0.4, -0.6)
    style.dress(axes, x="RMS change of the predicted angle [mrad]")
    handles: list[Artist] = [
        Line2D([], [], color=style.joint_colour(j), linestyle="", marker="o", label=joint)
        for j, joint in enumerate(joints)
    ]
    style.legend_below(figure, handles)
    return figure
