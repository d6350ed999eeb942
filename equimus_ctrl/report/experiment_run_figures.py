"""Figures of experiments in a loop: explanations after each trial, and what was commanded in all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from equimus_ctrl.experiments.loop import Belief
from equimus_ctrl.report import style
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Recording

WIDTH = 10.0
HEIGHT, LINE = 4.6, 0.24
"""Of the explanations' figure without its legend, and of a line of that [in]."""
LINEAR = 10.0
"""Differences of ln L up to which the scale is linear, logarithmic beyond."""
MARKERS = "osD^vP*hX<>"
COLOURS = (*style.JOINT_COLOURS, *style.ACTUATOR_COLOURS)


class Believed(Protocol):
    """What a figure takes of a step."""

    @property
    def number(self) -> int: ...
    @property
    def belief(self) -> Belief: ...


def belief_figure(steps: Sequence[Believed], names: Sequence[str], margins: Sequence[float], label: str) -> Figure:
    """How far each explanation is behind the one that is named first, after each trial.

    Args:
        steps: in order.
        names: of the trial of each step.
        margins: up to which each diagnosis does not distinguish explanations.
        label: of the robot.
    """
    labels = list(dict.fromkeys(e.label for own in steps for e in own.belief.explanations))
    figure = style.new_figure(WIDTH, HEIGHT + LINE * len(labels), f"{label}: explanations after each trial")
    axes = figure.subplots()
    found = [e.behind for own in steps for e in own.belief.explanations if math.isfinite(e.behind)]
    top, bottom = 2.0 * max([LINEAR, *found, *margins]), min([0.0, *found])
    places = np.arange(len(steps))
    for place, margin in zip(places, margins, strict=True):
        axes.fill_between([place - 0.4, place + 0.4], 0.0, margin, color=style.SHADE, linewidth=0, zorder=0)
    handles: list[Artist] = []
    for k, name in enumerate(labels):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        seen = [(place, e) for place, own in zip(places, steps, strict=True) for e in own.belief.explanations
                if e.label == name]  # fmt: skip
        values = [min(e.behind, top) for _, e in seen]
        axes.plot([place for place, _ in seen], values, color=colour, linewidth=style.RUN_WIDTH)
        for (place, e), value in zip(seen, values, strict=True):
            face = colour if e.left else "white"
            axes.plot(place, value, marker, color=colour, markerfacecolor=face, markersize=7)
        handles.append(Line2D([], [], color=colour, marker=marker, markersize=6, label=name))
    handles.append(Line2D([], [], color=style.INK, marker="o", markerfacecolor="white", linestyle="",
                          label="no longer left"))  # fmt: skip
    handles.append(Patch(facecolor=style.SHADE, edgecolor=style.FAINT, label="not distinguished"))
    style.dress(axes, y="behind what is named first: −2Δln L\nand Schwarz's cost of parameters")
    axes.set_yscale("symlog", linthresh=LINEAR)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylim(min(1.2 * bottom, -0.1 * LINEAR), 1.3 * top)
    axes.set_xlim(-0.5, len(steps) - 0.5)
    axes.set_xticks(places, list(names))
    style.legend_below(figure, handles)
    return figure


def trials_figure(robot: Robot, trials: Sequence[Recording], label: str) -> Figure:
    """What was commanded in all trials, one after the other, a panel for each actuator."""
    na = len(robot.actuator_names)
    figure = style.new_figure(WIDTH, 1.2 + 1.7 * na, f"{label}: commands of all trials")
    panels = figure.subplots(na, 1, sharex=True, squeeze=False)[:, 0]
    ends = np.cumsum([0.0, *(float(trial.time[-1] - trial.time[0]) for trial in trials)])
    for i, (axes, name) in enumerate(zip(panels, robot.actuator_names, strict=True)):
        own = reading(robot.command_units[i])
        for trial, begin in zip(trials, ends, strict=False):
            time = begin + trial.time - trial.time[0]
            axes.step(time, trial.command[:, i] * own.factor, where="post", color=style.actuator_colour(i),
                      linewidth=style.RUN_WIDTH)  # fmt: skip
        for end in ends[1:-1]:
            axes.axvline(end, color=style.FAINT, linewidth=style.THIN_WIDTH)
        style.dress(axes, y=f"{name} [{own.unit}]" if own.unit else name, x="time [s]" if i == na - 1 else "")
        axes.set_xlim(0.0, ends[-1])
    for trial, begin, end in zip(trials, ends[:-1], ends[1:], strict=True):
        panels[0].annotate(
            trial.name, ((begin + end) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 4),
            textcoords="offset points", ha="center", fontsize=style.SMALL_SIZE, color=style.INK,
        )  # fmt: skip
    figure.align_ylabels()
    return figure
