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
    figure = Figure(figsize=(7.0, 4.6 if shared else 3.4), layout="constrained")
    axes = figure.subplots(2 if shared else 1, 1, sharex=True, squeeze=False, height_ratios=(3, 1) if shared else None)
    steps = [row["steps"] / 1e3 for row in curve]
    top = axes[0, 0]
    top.plot(steps, [row["return"] for row in curve], color=style.INK, label="unseen robots, mean")
    top.plot(steps, [row["least"] for row in curve], color=style.INK, lw=0.8, ls=":", label="unseen robots, least")
    top.plot(steps, [row["explored"] for row in curve], color=style.INK, lw=0.8, ls="--", label="in training, explored")
    for name, value in (goal or {}).items():
        top.axhline(value, color=style.INK, lw=0.8, ls="--")
        top.annotate(name, (steps[-1], value), ha="right", va="bottom", fontsize=8)
    top.set_ylabel("return")
    top.set_title(f"Training to {task}", loc="left")
    top.legend(loc="lower right", fontsize=8)
    if shared:
        axes[1, 0].plot(steps, [100 * row["success"] for row in curve], color=style.INK)
        axes[1, 0].set_ylabel("success [%]")
        axes[1, 0].set_ylim(-5, 105)
    axes[-1, 0].set_xlabel("steps of the environments, in thousands")
    return figure
