"""Panels of errors under panels of curves, which coincide where a controller or a model is good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from equimus_ctrl.report import style
from equimus_ctrl.robots.reading import Reading
from equimus_ctrl.types import Array

MOST = 0.9
"""Share of the instants whose errors an error panel has room for at least; what is shorter is a transient."""
BEYOND = 3.0
"""A transient that is so many times larger than these can be read off the curves; it does not squeeze all others."""
ROOM = 1.1


def error_limits(axes: Axes, errors: Sequence[Array], own: Reading, least: float) -> None:
    """Even limits about zero in which errors can be read; what lies beyond them is told in numbers.

    Args:
        axes: changed in place.
        errors: in the unit in which people read them.
        own: that unit.
        least: the limit where there is no error.
    """
    together = np.abs(np.concatenate([np.ravel(own) for own in errors])) if errors else np.zeros(0)
    together = together[np.isfinite(together)]
    largest, most = (float(np.quantile(together, share)) if len(together) else 0.0 for share in (1.0, MOST))
    span, said = max(ROOM * largest, least), ""
    if largest > BEYOND * max(most, least):
        span = ROOM * BEYOND * max(most, least)
        said = f"up to {largest:.3g}{own.space}{own.unit} beyond"
    axes.set_ylim(-span, span)
    axes.axhline(0.0, color=style.FAINT, linewidth=style.THIN_WIDTH, zorder=1)
    if said:
        axes.annotate(
            said, (1.0, 1.0), xycoords="axes fraction", xytext=(-3, -3), textcoords="offset points", ha="right",
            va="top", fontsize=style.SMALL_SIZE, color=style.INK,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
        )  # fmt: skip


def draw_distance(axes: Axes, time: Array, distance: Array, colour: str, least: float) -> None:
    """Distances (m,) over time on a logarithmic scale; ``least`` is as good as none."""
    shown = np.maximum(distance, least)
    axes.plot(time, shown, color=colour, linewidth=1.0)
    axes.set_yscale("log")
    bottom = max(0.5 * float(np.quantile(shown, 1.0 - MOST)), least)
    axes.set_ylim(bottom, max(2.0 * float(shown.max()), 10.0 * bottom))
    axes.yaxis.set_major_locator(LogLocator(numticks=5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
