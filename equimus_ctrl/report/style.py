"""One look for every figure: colours that colour-blind readers can distinguish, sizes, and how a figure is saved.

Figures are built with matplotlib's objects and drawn by Agg; nothing global is read or changed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from equimus_ctrl.presets import write_bytes

Drawings = Mapping[str, Callable[[], Figure | None]]
"""Name → what draws that figure; None where there is nothing to draw after all."""

JOINT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#AA4499")
ACTUATOR_COLOURS = ("#E69F00", "#56B4E9", "#117733", "#882255", "#999933", "#332288")
FOOT = "#6A3D9A"
RECORDED = "#3A3A3A"
REFERENCE = "#000000"
ALERT = "#B2182B"
INK = "#222222"
FAINT = "#8A8A8A"
SHADE = "#EDEDED"
GRID = "#E3E3E3"

RUN_WIDTH = 1.6
RECORDED_WIDTH = 1.1
REFERENCE_WIDTH = 1.2
THIN_WIDTH = 0.8
DASHES = (0, (5, 3))

TITLE_SIZE = 14
PANEL_SIZE = 11
TEXT_SIZE = 10
SMALL_SIZE = 9
DPI = 120


def joint_colour(index: int) -> str:
    """The colour of the joint at that place in the angle vector."""
    return JOINT_COLOURS[index % len(JOINT_COLOURS)]


def actuator_colour(index: int) -> str:
    """The colour of the actuator at that place in the command vector."""
    return ACTUATOR_COLOURS[index % len(ACTUATOR_COLOURS)]


def new_figure(width: float, height: float, title: str = "") -> Figure:
    """An empty white figure.

    Args:
        width: [inch].
        height: [inch].
        title: written over everything, to the left.
    """
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.08)  # type: ignore[union-attr, call-arg]
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=TITLE_SIZE, fontweight="bold", color=INK)
    return figure


def dress(axes: Axes, *, title: str = "", x: str = "", y: str = "") -> None:
    """Give axes the common look: light grid, two spines, readable text.

    Args:
        axes: changed in place.
        title: to the left, over the axes.
        x: label with its unit.
        y: label with its unit.
    """
    axes.set_facecolor("white")
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(labelsize=SMALL_SIZE, colors=INK, color=FAINT)
    if title:
        axes.set_title(title, loc="left", fontsize=PANEL_SIZE, color=INK)
    if x:
        axes.set_xlabel(x, fontsize=TEXT_SIZE, color=INK)
    if y:
        axes.set_ylabel(y, fontsize=TEXT_SIZE, color=INK)


def legend_below(figure: Figure, handles: Sequence[Artist]) -> Legend | None:
    """One legend under all panels, where it cannot cover data; None where there is nothing to explain."""
    if not handles:
        return None
    return figure.legend(
        handles=list(handles),
        loc="outside lower center",
        ncols=_columns([len(str(handle.get_label())) + 9 for handle in handles], 12.5 * figure.get_figwidth()),
        frameon=False,
        fontsize=SMALL_SIZE,
        labelcolor=INK,
        handlelength=2.6,
    )


def _columns(widths: Sequence[int], room: float) -> int:
    """Columns of a legend that is filled column by column, as few rows as its width has room for.

    Args:
        widths: of the entries, in characters.
        room: the same for a whole row.
    """
    for rows in range(1, len(widths)):
        columns = -(-len(widths) // rows)
        parts = np.array_split(np.asarray(widths), columns)
        if sum(int(part.max()) for part in parts) <= room:
            return columns
    return 1


def drawn(drawings: Drawings) -> dict[str, Figure]:
    """Name → figure of all that there is to draw."""
    figures = {name: draw() for name, draw in drawings.items()}
    return {name: figure for name, figure in figures.items() if figure is not None}


def save_all(drawings: Drawings, folder: Path) -> list[Path]:
    """Write each as PNG of its name."""
    return [save(figure, folder / f"{name}.png") for name, figure in drawn(drawings).items()]


def png(figure: Figure) -> bytes:
    """A figure as PNG; the same figure gives the same bytes."""
    canvas = FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    canvas.print_png(buffer, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return buffer.getvalue()


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, whole or not at all."""
    write_bytes(path, png(figure))
    return path
