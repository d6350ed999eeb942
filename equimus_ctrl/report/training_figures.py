"""Figures of a training: what policies reached, over steps of the environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from equimus_ctrl.report import style


def training_figure(curve: Sequence[Mapping[str, Any]], task: str, goal: Mapping[str, float] | None = None) -> Figure:
    """The learning curve.

    Args:
        curve: rows with ``steps``, ``return``, ``least``, ``explored`` and ``success``.
        task: its name.
        goal: returns to compare with, by name.
    """
    shared = any(row["success"] is not None for row in curve)
    figure = style.new_figure(7.0, 4.8 if shared else 3.6, f"Training to {task}")
    axes = figure.subplots(2 if shared else 1, 1, sharex=True, squeeze=False, height_ratios=(3, 1) if shared else None)
    steps, top = [row["steps"] / 1e3 for row in curve], axes[0, 0]
    lines = [
        top.plot(steps, [row[key] for row in curve], color=colour, lw=width, ls=dashes, label=label)[0]
        for key, colour, width, dashes, label in (
            ("return", style.joint_colour(0), 1.6, "-", "unseen robots, mean"),
            ("least", style.joint_colour(0), 1.0, ":", "unseen robots, least"),
            ("explored", style.FAINT, 1.0, "-", "in training, with exploration"),
        )
    ]
    for name, value in (goal or {}).items():
        top.axhline(value, color=style.INK, lw=0.8, ls="--")
        top.annotate(name, (steps[-1], value), ha="right", va="bottom", fontsize=style.SMALL_SIZE, color=style.INK)
    style.dress(top, y="return")
    if shared:
        axes[1, 0].plot(steps, [100 * row["success"] for row in curve], color=style.joint_colour(0))
        axes[1, 0].set_ylim(-5, 105)
        style.dress(axes[1, 0], y="success [%]")
    style.dress(axes[-1, 0], x="steps of the environments, in thousands")
    style.legend_below(figure, lines)
    return figure
