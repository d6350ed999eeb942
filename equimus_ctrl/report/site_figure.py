"""The path of a point of a robot: in the plane in which it lies, and how far off it is over time, in mm."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from equimus_ctrl.report import style
from equimus_ctrl.scenarios.scoring import Score
from equimus_ctrl.scenarios.site_path import SitePath
from equimus_ctrl.types import Array, Run

MM = 1e3
ALONG = 1e-3
"""A direction is that of an axis of the room where it is so near to it."""


def site_figure(run: Run, path: SitePath, score: Score, label: str) -> Figure:
    """The plane of the path seen from across it, and the distance from where the point should be over time.

    Args:
        run: what happened.
        path: what was to be done.
        score: of the run.
        label: what the figure is headed with.
    """
    assert score.site is not None
    low, high = score.window
    inside = (run.time >= low - 1e-9) & (run.time <= high + 1e-9)
    went, wanted = path.places(run.position), path.wanted_at(run.time)
    corner, axes_of, names = _plane(wanted[inside])
    figure = style.new_figure(10.0, 5.0, f"{label}: path of {path.name}")
    plane, strip = figure.subplots(1, 2)
    for places, colour, width, dashes, order in (
        (wanted[inside], style.REFERENCE, style.REFERENCE_WIDTH, style.DASHES, 3.5),
        (went[inside], style.FOOT, style.RUN_WIDTH, "-", 3.0),
        (went[run.time <= low], style.FAINT, style.THIN_WIDTH, "-", 2.0),
    ):
        flat = MM * (places - corner) @ axes_of
        plane.plot(*flat.T, color=colour, linewidth=width, linestyle=dashes, zorder=order)
    start, end = MM * (went[inside][[0, -1]] - corner) @ axes_of
    plane.plot(*start, marker="o", markersize=8, markerfacecolor="white", markeredgecolor=style.INK, zorder=5)
    plane.plot(*end, marker="s", markersize=6, color=style.INK, zorder=5)
    plane.set_aspect("equal", adjustable="datalim")
    style.dress(plane, title="seen from across its plane", x=names[0], y=names[1])
    if path.points.y_down and names[1] == "y [mm]":
        plane.invert_yaxis()
        plane.set_ylabel("y, downwards [mm]")
    off = MM * np.linalg.norm(went - wanted, axis=1)[inside]
    strip.plot(run.time[inside], off, color=style.FOOT, linewidth=style.RUN_WIDTH)
    strip.set_ylim(0.0, max(1.1 * float(off.max()), 0.1))
    strip.set_xlim(low, high)
    rmse, largest = MM * score.site.rmse[0], MM * score.site.largest[0]
    style.dress(strip, title=f"RMSE {rmse:.2f} mm, largest {largest:.2f} mm", x="time [s]", y="distance from where it "
                "should be [mm]")  # fmt: skip
    handles = [
        Line2D([], [], color=style.FOOT, linewidth=style.RUN_WIDTH + 0.6, label="this run, by measured joints"),
        Line2D([], [], color=style.REFERENCE, linewidth=style.REFERENCE_WIDTH, linestyle=style.DASHES, label="wanted"),
        Line2D([], [], color=style.FAINT, linewidth=style.THIN_WIDTH, label="on the way there, not scored"),
        Line2D([], [], marker="o", color=style.INK, markerfacecolor="white", linestyle="", label="start"),
        Line2D([], [], marker="s", color=style.INK, linestyle="", label="end"),
    ]
    style.legend_below(figure, handles)
    return figure


def _plane(places: Array) -> tuple[Array, Array, tuple[str, str]]:
    """Where drawing begins (3,) [m], two axes (3, 2) in the plane of places (n, 3), and what they are called.

    Where the plane is that of two axes of the room, these; else the directions in which the places lie farthest apart,
    from their mean.
    """
    mean = places.mean(axis=0)
    across = np.linalg.eigh((places - mean).T @ (places - mean))[1].T[::-1]
    normal = across[2]
    k = int(np.abs(normal).argmax())
    if abs(normal[k]) > 1 - ALONG or np.ptp(places, axis=0).min() < 1e-9:
        k = k if abs(normal[k]) > 1 - ALONG else int(np.ptp(places, axis=0).argmin())
        kept = [axis for axis in range(3) if axis != k]
        first, second = (f"{'xyz'[axis]} [mm]" for axis in kept)
        return np.zeros(3), np.eye(3)[:, kept], (first, second)
    axes = across[:2].T * np.sign(across[:2].T[np.abs(across[:2].T).argmax(axis=0), [0, 1]])
    first, second = (f"along ({', '.join(f'{part:.2f}' for part in axis)}) [mm]" for axis in axes.T)
    return mean, axes, (first, second)
