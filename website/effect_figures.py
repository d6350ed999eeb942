"""A small figure of each effect's law, for the page of effects: on no background, in colours for light and dark."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping
from functools import cache

import effect_laws
import matplotlib
import numpy as np
from effect_law import Law, thinned
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.report.diagnosis_words import reading

FOLDER = "effects"
"""Of the figures, beside the page."""
WIDTH, HEIGHT, PIXELS = 4.0, 2.3, 400
"""Of a figure [inch], and the width that it is shown with."""
INK, LINE, GRID = "#7d8590", "#2f8fd0", "#7d859040"
"""Text and what there is without the effect, what there is with it, the grid: to be read on white and on black."""
PLACE = (0.2, 0.31, 0.78, 0.57)
"""Of the axes in the figure: left, bottom, width, height, as shares."""
TEXT, LETTERS = 8.5, 25
"""Size of text [pt], and letters of a line beside a figure."""


@cache
def laws() -> Mapping[str, Law]:
    """Name of each effect → its law."""
    return {name: effect_laws.law(cls) for name, cls in sorted(REGISTRY.items())}


def figures() -> dict[str, str]:
    """Path beside the page → a figure as SVG."""
    return {f"{FOLDER}/{name}.svg": svg(figure(law)) for name, law in laws().items()}


def figure(law: Law) -> Figure:
    """The law with the effect as a line, without it dashed."""
    drawn = Figure(figsize=(WIDTH, HEIGHT))
    drawn.patch.set_alpha(0.0)
    axes = drawn.add_axes(PLACE)
    axes.patch.set_alpha(0.0)
    found = thinned(law)
    across = reading(found.x_unit, float(np.abs(found.x).max()))
    up = reading(found.y_unit, float(np.abs([found.values, found.without]).max()))
    x = found.x * across.factor
    axes.plot(x, found.without * up.factor, color=INK, linewidth=1.1, linestyle=(0, (4, 3)), label="without")
    axes.plot(x, found.values * up.factor, color=LINE, linewidth=1.8, label="with the effect")
    axes.set_xlabel(f"{found.x_axis} {across.bracket}".strip(), fontsize=TEXT, color=INK)
    beside = "\n".join(textwrap.wrap(f"{found.y_axis} {up.bracket}".strip(), LETTERS))
    axes.set_ylabel(beside, fontsize=TEXT, color=INK)
    axes.tick_params(labelsize=TEXT, colors=INK, width=0.6)
    axes.locator_params(nbins=5)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0.02, y=0.08)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(INK)
    if found.shown:
        axes.set_title(found.shown, loc="left", fontsize=TEXT, color=INK)
    handles, labels = axes.get_legend_handles_labels()
    drawn.legend(
        handles, labels, loc="lower center", ncols=2, frameon=False, fontsize=TEXT, labelcolor=INK,
        handlelength=2.2, borderpad=0.1,
    )  # fmt: skip
    return drawn


def svg(drawn: Figure) -> str:
    """The figure as SVG, the same bytes for the same figure; its text stays text."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "effects", "font.family": "sans-serif"}):
        FigureCanvasSVG(drawn).print_svg(buffer, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def markdown(name: str) -> str:
    """The figure in the page, with what it shows in words and the parameters that it is drawn with."""
    law = laws()[name]
    shown = f", {law.shown}" if law.shown else ""
    alt = f"{law.effect.summary}: {law.y_axis} over {law.x_axis}{shown}, with the effect and without"
    info = law.effect.parameter_info()
    drawn = ", ".join(_size(key, value, str(info[key]["unit"])) for key, value in law.effect.parameters().items())
    return f"![{alt}]({FOLDER}/{name}.svg){{ .law width={PIXELS} }}\n\n*Drawn with {drawn}.*"


def _size(key: str, value: float, unit: str) -> str:
    """A parameter and its value."""
    unit = unit_there(unit)
    read = reading(unit, value)
    named = "" if unit == "1" else f" {read.unit}"
    return f"{key.replace('_', ' ')} {float(f'{value * read.factor:.3g}'):g}{named}".replace("-", "−")


def unit_there(unit: str) -> str:
    """A parameter's unit of a hinge that a motor drives, where it depends on the place."""
    return unit.partition(" | ")[0].replace("1/command", "1/(N·m)").replace("command", "N·m")
