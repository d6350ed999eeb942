"""Panels of errors under panels of curves, which coincide where a controller or a model is good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from equimus_ctrl.report import style
from equimus_ctrl.types import Array

MOST = 0.9
"""Share of the instants whose errors decide the limits of an error panel; what is shorter is a transient."""
BESIDE, TRANSIENT = 3.0, 6.0
"""How many times these errors there is room for where transients are larger than so many times them, and can be read
off the curves; else there is room for all."""
ROOM = 1.1


def error_limits(axes: Axes, errors: Sequence[Array], unit: str, least: float) -> None:
    """Even limits about zero in which errors can be read; what lies beyond them is told in numbers.

    Args:
        axes: changed in place.
        errors: in the unit in which people read them.
        unit: that unit.
        least: the limit where there is no error.
    """
    together = np.abs(np.concatenate([np.ravel(own) for own in errors])) if errors else np.zeros(0)
    together = together[np.isfinite(together)]
    largest, most = (float(np.quantile(together, share)) if len(together) else 0.0 for share in (1.0, MOST))
    span, said = max(ROOM * largest, least), ""
    if largest > TRANSIENT * max(most, least):
        span = ROOM * BESIDE * max(most, least)
        said = f"up to {largest:.3g}{'' if unit == '°' else ' '}{unit} beyond"
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
