"""Figures of an identification: fits, residuals, parameters, what trades off, and poses at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.parameters import FreeParameter
from equimus_ctrl.identification.results import Identification, Identified, IdentifiedPoses
from equimus_ctrl.identification.statics import LOST, StaticFit
from equimus_ctrl.report import style
from equimus_ctrl.report.error_panel import error_limits
from equimus_ctrl.types import Array

LEAST_ERROR = 0.1
"""The least limit of an axis of residuals [mrad or mm]."""
MOST_TRIALS = 6
BEFORE = "#B0A08A"
"""Of the initial model: differs from measured curves in hue and in lightness."""
HELDOUT = "#117733"
LEFT_AXES = 0.3
"""Share of a row of parameters at either end, beyond their bounds."""


@dataclass(frozen=True, eq=False)
class Shown:
    """One trial as it is drawn; nan between shooting intervals.

    Attributes:
        name: of the trial.
        time: (m,) [s].
        measured: (m, nj) [rad].
        before: (m, nj) measured − predicted by the initial model [rad].
        after: (m, nj) the same by the model identified [rad].
        heldout: whether it took no part in the fit.
    """

    name: str
    time: Array
    measured: Array
    before: Array
    after: Array
    heldout: bool

    def rmse(self, which: str) -> Array:
        """(nj,) ``before`` or ``after`` [rad]."""
        return np.asarray(np.sqrt(np.nanmean(getattr(self, which) ** 2, axis=0)))


def identification_figures(found: Identification) -> dict[str, Figure]:
    """Name → figure of everything that was found."""
    return style.drawn(identification_drawings(found))


def identification_drawings(found: Identification) -> style.Drawings:
    """See ``identification_figures``."""
    drawings: dict[str, Callable[[], Figure]] = {}
    if (poses := found.poses) is not None:
        names = ("parameters", "correlation") if found.trials is None else ("poses_parameters", "poses_correlation")
        drawings |= poses_drawings(poses, *names)
    if (trials := found.trials) is not None:
        drawings |= trials_drawings(trials)
    return drawings


def poses_drawings(
    found: IdentifiedPoses, parameters: str = "parameters", correlation: str = "correlation"
) -> dict[str, Callable[[], Figure]]:
    """Of what was found from poses at rest.

    Args:
        found: it.
        parameters: what that figure is called.
        correlation: what that one is called.
    """
    return {
        "poses": lambda: poses_figure(found),
        parameters: lambda: parameters_figure(found.fit),
        correlation: lambda: correlation_figure(found.fit),
    }


def trials_drawings(found: Identified) -> dict[str, Callable[[], Figure]]:
    """Of what was found from trials."""
    return {
        "fits": lambda: fits_figure(found, shown_trials(found)),
        "residuals": lambda: residuals_figure(found, shown_trials(found)),
        "parameters": lambda: parameters_figure(found.fit),
        "correlation": lambda: correlation_figure(found.fit),
    }


def shown_trials(found: Identified) -> list[Shown]:
    """All trials, those fitted first."""
    nj = len(found.fit.model.robot.joint_names)
    gap = np.full((1, nj), np.nan)
    trials = []
    for index, recording in enumerate(found.recordings):
        own = [k for k, segment in enumerate(found.segments) if segment.recording == index]
        pieces: list[tuple[Array, ...]] = []
        for k in own:
            segment = found.segments[k]
            errors = (values[k][:, :nj] for values in (found.fit.before, found.fit.residuals))
            rows = (segment.trial.sample_times, segment.measured, *errors)
            if pieces:
                pieces.append((rows[0][:1], gap, gap, gap))
            pieces.append(rows)
        time, measured, before, after = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
        trials.append(Shown(recording.name, time, measured, before, after, False))
    for judged in found.heldout:
        if judged.segment is not None:
            segment = judged.segment
            time = segment.trial.sample_times
            trials.append(Shown(judged.name, time, segment.measured, judged.before, judged.after, True))
    return trials


def _shown_trials(trials: list[Shown]) -> list[tuple[Shown, str]]:
    """At most six trials and why: best, median and worst of those fitted, and all held out or the same of these."""
    chosen: list[tuple[Shown, str]] = []
    for heldout in (False, True):
        own = sorted((t for t in trials if t.heldout == heldout), key=lambda t: float((t.rmse("after") ** 2).sum()))
        label = "held out" if heldout else "fitted"
        if len(own) <= MOST_TRIALS // 2:
            chosen += [(trial, label) for trial in own]
        else:
            places = {"best": 0, "median": (len(own) - 1) // 2, "worst": len(own) - 1}
            chosen += [(own[k], f"{label}, {which}") for which, k in places.items()]
    return chosen


def fits_figure(found: Identified, trials: list[Shown]) -> Figure:
    """Measured and predicted angles of a few trials, and residuals below each; a column for each joint."""
    model = found.fit.model
    joints = model.robot.joint_names
    chosen = _shown_trials(trials)
    width = min(5.2 * len(joints) + 0.6, 15.0)
    figure = style.new_figure(width, 1.1 + 2.7 * len(chosen), "Measured and predicted, residuals below")
    grid = figure.subplots(2 * len(chosen), len(joints), squeeze=False, height_ratios=[1.7, 1.0] * len(chosen))
    for row, (trial, label) in enumerate(chosen):
        for j, joint in enumerate(joints):
            axes, strip = grid[2 * row : 2 * row + 2, j]
            strip.sharex(axes)
            place, error = display_units.position(model, joint), display_units.error(model, joint)
            colour = style.joint_colour(j)
            measured = trial.measured[:, j] * place.factor
            axes.plot(trial.time, measured - trial.before[:, j] * place.factor, color=BEFORE, linewidth=1.4)
            axes.plot(trial.time, measured, color=style.RECORDED, linewidth=1.1)
            axes.plot(trial.time, measured - trial.after[:, j] * place.factor, color=colour, linewidth=1.7)
            residuals = [error.factor * values[:, j] for values in (trial.before, trial.after)]
            for values, shade in zip(residuals, (BEFORE, colour), strict=True):
                strip.plot(trial.time, values, color=shade, linewidth=1.0)
            error_limits(strip, residuals, error.unit, LEAST_ERROR)
            before, after = (error.factor * trial.rmse(which)[j] for which in ("before", "after"))
            title = f"{joint}: RMSE {before:.1f} → {after:.1f} {error.unit}"
            if j == 0:
                title = f"{trial.name} ({label})\n{title}"
            last = row == len(chosen) - 1
            label_y = f"{display_units.noun(model, joint)} {place.bracket}" if j == 0 else ""
            style.dress(axes, title=title, y=label_y)
            style.dress(strip, y=error.bracket if j == 0 else "", x="time [s]" if last else "")
            axes.tick_params(labelbottom=False)
    figure.align_ylabels()
    handles: list[Artist] = [
        Line2D([], [], color=style.RECORDED, linewidth=1.1, label="measured"),
        Line2D([], [], color=BEFORE, linewidth=1.4, label="before"),
    ]
    for j, joint in enumerate(joints):
        handles.append(Line2D([], [], color=style.joint_colour(j), linewidth=1.7, label=f"identified, {joint}"))
    style.legend_below(figure, handles)
    return figure


def residuals_figure(found: Identified, trials: list[Shown]) -> Figure:
    """For each joint: the RMSE of every trial before and after, and when in each trial the residual arises."""
    model = found.fit.model
    joints = model.robot.joint_names
    count = len(trials)
    height = 1.6 + 2 * 0.4 + len(joints) * max(0.19 * count, 0.9)
    figure = style.new_figure(12.0, height, "Residuals, trial by trial")
    grid = figure.subplots(len(joints), 2, squeeze=False, width_ratios=[1.0, 1.45], sharey=True)
    shown = [display_units.position(model, joint) for joint in joints]
    factors = np.array([u.factor for u in shown])
    after_all = np.concatenate([np.abs(t.after * factors)[np.isfinite(t.after)] for t in trials])
    span = max(float(np.quantile(after_all, 0.98)), 1e-6 * float(factors.max()))
    places = np.arange(count)
    drawn = None
    for j, joint in enumerate(joints):
        left, right = grid[j]
        error = display_units.error(model, joint)
        before, after = (error.factor * np.array([t.rmse(which)[j] for t in trials]) for which in ("before", "after"))
        left.hlines(places, before, after, color=style.GRID, linewidth=3, zorder=1)
        left.scatter(before, places, s=24, color=BEFORE, linewidths=0, zorder=3)
        left.scatter(after, places, s=28, color=style.joint_colour(j), linewidths=0, zorder=3)
        left.set_xlim(left=0)
        style.dress(left, title=joint, x=f"RMSE {error.bracket}" if j == len(joints) - 1 else "")
        for row, trial in enumerate(trials):
            edges = _edges(trial.time)
            values = trial.after[:, j][None, :] * factors[j]
            drawn = right.pcolormesh(
                edges, [row - 0.45, row + 0.45], values, cmap="RdBu_r", vmin=-span, vmax=span, rasterized=True
            )
        last = j == len(joints) - 1
        style.dress(right, title=f"{joint}: measured − identified", x="time [s]" if last else "")
        right.grid(False)
        for axes in (left, right):
            axes.set_yticks(places, [t.name for t in trials])
            axes.set_ylim(count - 0.4, -0.6)
            first = next((k for k, t in enumerate(trials) if t.heldout), None)
            if first is not None:
                axes.axhline(first - 0.5, color=style.INK, linewidth=0.9, linestyle=":")
        right.tick_params(labelleft=False)
        for label, trial in zip(left.get_yticklabels(), trials, strict=True):
            label.set_color(HELDOUT if trial.heldout else style.INK)
            label.set_fontsize(7.5 if count > 20 else style.SMALL_SIZE)
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=list(grid[:, 1]), pad=0.02, extend="both", shrink=0.8)
        unit = ", ".join(dict.fromkeys(u.unit for u in shown))
        bar.set_label(f"residual [{unit}]", fontsize=style.TEXT_SIZE, color=style.INK)
        bar.ax.tick_params(labelsize=style.SMALL_SIZE)
    handles: list[Artist] = [Line2D([], [], marker="o", linestyle="", color=BEFORE, label="before")]
    for j, joint in enumerate(joints):
        handles.append(
            Line2D([], [], marker="o", linestyle="", color=style.joint_colour(j), label=f"identified, {joint}")
        )
    if any(t.heldout for t in trials):
        handles.append(Patch(facecolor=HELDOUT, label="below the dotted line, names in green: held out"))
    style.legend_below(figure, handles)
    return figure


def _edges(time: Array) -> Array:
    """(m + 1,) borders of cells about sample times."""
    time = np.maximum.accumulate(time)
    if len(time) == 1:
        return np.array([time[0] - 0.01, time[0] + 0.01])
    middle = (time[1:] + time[:-1]) / 2
    return np.concatenate([[2 * time[0] - middle[0]], middle, [2 * time[-1] - middle[-1]]])


def parameters_figure(found: Fit | StaticFit) -> Figure:
    """Every parameter between its bounds, scaled to one width: initial value, identified value, interval."""
    free, known = found.parameters.free, found.uncertainty
    n = len(free)
    figure = style.new_figure(10.5, 1.6 + 0.42 * n, "Parameters between their bounds, with 95 % intervals")
    axes = figure.add_subplot()
    for row, parameter in enumerate(free):
        value, width = float(found.theta[row]), float(known.half_width[row])
        axes.hlines(row, 0, 1, color=style.SHADE, linewidth=11, zorder=1)
        at = _place(parameter, value)
        low, high = (_place(parameter, v) for v in (value - width, value + width))
        held = bool(found.at_bound[row])
        colour = style.ALERT if held else style.JOINT_COLOURS[0] if np.isfinite(width) else style.FAINT
        if np.isfinite(width):
            axes.hlines(row, max(low, -LEFT_AXES), min(high, 1 + LEFT_AXES), color=colour, linewidth=2.2, zorder=3)
            for end, beyond, marker in ((low, low < -LEFT_AXES, "<"), (high, high > 1 + LEFT_AXES, ">")):
                side = min(max(end, -LEFT_AXES), 1 + LEFT_AXES)
                axes.plot(side, row, marker=marker if beyond else "|", color=colour, markersize=8, zorder=3)
        else:
            axes.hlines(row, -LEFT_AXES, 1 + LEFT_AXES, color=style.FAINT, linewidth=1.2, linestyle=":", zorder=3)
        start = _place(parameter, parameter.start)
        axes.plot(start, row, marker="D", markersize=6, color="white", markeredgecolor=style.INK, zorder=4)
        axes.plot(at, row, marker="o", markersize=8, color=colour, zorder=5)
        for x, bound in ((0, parameter.low), (1, parameter.high)):
            axes.annotate(
                f"{bound:.3g}",
                (x, row),
                xytext=(0, 7),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7,
                color=style.FAINT,
            )
        unseen = "" if np.isfinite(width) else ", not identifiable"
        axes.annotate(
            f"{parameter.start:.4g} → {value:.4g} {parameter.unit}{unseen}",
            (1 + LEFT_AXES + 0.04, row),
            va="center",
            fontsize=style.SMALL_SIZE,
            color=colour if held or unseen else style.INK,
            annotation_clip=False,
        )
    axes.set_yticks(np.arange(n), [p.name for p in free])
    axes.set_xticks([0, 1], ["lowest allowed", "highest allowed"])
    axes.set_ylim(n - 0.4, -0.6)
    axes.set_xlim(-LEFT_AXES - 0.04, 1 + LEFT_AXES + 0.75)
    style.dress(axes)
    axes.grid(False)
    axes.spines[["left", "bottom"]].set_visible(False)
    handles: list[Artist] = [
        Line2D([], [], marker="D", linestyle="", color="white", markeredgecolor=style.INK, label="before"),
        Line2D([], [], marker="o", color=style.JOINT_COLOURS[0], linewidth=2.2, label="identified, interval"),
        Line2D([], [], marker="o", color=style.ALERT, linewidth=2.2, label="held by a bound"),
        Line2D([], [], marker=">", linestyle="", color=style.INK, label="the interval goes on"),
    ]
    if not np.all(np.isfinite(known.half_width)):
        handles.append(Line2D([], [], color=style.FAINT, linewidth=1.2, linestyle=":", label="not identifiable"))
    style.legend_below(figure, handles)
    return figure


def _place(parameter: FreeParameter, value: float) -> float:
    """0 at the low bound, 1 at the high one; by ratio where both are positive and a factor of two or more apart."""
    low, high = parameter.low, parameter.high
    if low > 0 and high > 2 * low:
        return float(np.log(max(value, 1e-9 * low) / low) / np.log(high / low))
    return (value - low) / (high - low)


def correlation_figure(found: Fit | StaticFit) -> Figure:
    """How the errors of the parameters go together."""
    matrix, names = found.uncertainty.correlation, found.parameters.names
    n = len(names)
    size = max(0.46 * n, 2.2)
    figure = style.new_figure(size + 3.2, size + 1.9, "Which parameters trade off")
    axes = figure.add_subplot()
    drawn = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_facecolor(style.SHADE)
    for i in range(n):
        for j in range(n):
            value = matrix[i, j]
            shown = not np.isfinite(value) or (i != j and abs(value) >= 0.5 and n <= 24)
            text = "–" if not np.isfinite(value) else _two_digits(float(value))
            if shown:
                dark = np.isfinite(value) and abs(value) > 0.7
                axes.text(j, i, text, ha="center", va="center", fontsize=7, color="white" if dark else style.INK)
    style.dress(axes)
    axes.set_facecolor(style.SHADE)
    axes.grid(False)
    axes.set_xticks(np.arange(n), names, rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(np.arange(n), names)
    axes.spines[["left", "bottom"]].set_visible(False)
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.03)
    bar.set_label("correlation of errors (– : not identifiable)", fontsize=style.SMALL_SIZE, color=style.INK)
    bar.ax.tick_params(labelsize=style.SMALL_SIZE)
    return figure


def _two_digits(value: float) -> str:
    """Such as .97, and .99 for what is less than 1 but would round to it."""
    text = f"{min(abs(value), 0.99):.2f}"[1:] if abs(value) < 1 else "1"
    return f"−{text}" if value < 0 else text


def poses_figure(found: IdentifiedPoses) -> Figure:
    """Measured poses at rest, each joined to where the model rests, before and after; the first two joints' plane."""
    fit, m = found.fit, found.fit.model.morphology
    measured = found.poses.position
    plane = len(m.joints) > 1
    labels = [f"{m.joint_names[0]} [°]", f"{m.joint_names[1]} [°]"] if plane else ["", f"{m.joint_names[0]} [°]"]
    if not plane:
        labels[0] = f"{m.actuator_names[0]} [kPa]"

    def spots(angles: Array) -> Array:
        x = angles[:, 0] if plane else np.radians(found.poses.pressure[:, 0] / 1e3)
        return np.asarray(np.degrees(np.column_stack([x, angles[:, 1 if plane else 0]])))

    figure = style.new_figure(11.0, 5.8, f"Poses at rest: {found.poses.name}")
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    lost_any = False
    for axes, residual, title, colour in (
        (grid[0], fit.before, "before", BEFORE),
        (grid[1], fit.residuals, "identified", style.JOINT_COLOURS[0]),
    ):
        kept = np.all(np.abs(residual) < LOST, axis=1)
        lost_any |= not kept.all()
        seen, rest = spots(measured), spots(measured - residual)
        for a, b in zip(seen[kept], rest[kept], strict=True):
            axes.plot([a[0], b[0]], [a[1], b[1]], color=colour, linewidth=1.3, zorder=2)
        axes.scatter(*rest[kept].T, s=30, color=colour, linewidths=0, zorder=3)
        axes.scatter(*seen[kept].T, s=20, facecolor="white", edgecolor=style.RECORDED, linewidth=1.2, zorder=4)
        axes.scatter(*seen[~kept].T, s=34, color=style.ALERT, marker="x", zorder=4)
        rmse = np.sqrt((residual**2).mean(axis=0))
        shown = ", ".join(f"{joint} {np.degrees(v):.2f}°" for joint, v in zip(m.joint_names, rmse, strict=True))
        style.dress(axes, title=f"{title}: RMSE {shown}", x=labels[0], y=labels[1] if axes is grid[0] else "")
    corners = spots(measured)
    for k, (low, high) in enumerate(np.degrees(np.transpose(m.joint_range))[:2] if plane else ()):
        for edge in (low, high):
            if corners[:, k].min() - 3 < edge < corners[:, k].max() + 3:
                for axes in grid:
                    (axes.axvline if k == 0 else axes.axhline)(edge, color=style.INK, linewidth=0.9, linestyle=":")
    handles: list[Artist] = [
        Line2D([], [], marker="o", linestyle="", color="white", markeredgecolor=style.RECORDED, label="measured"),
        Line2D([], [], marker="o", color=BEFORE, label="where the model rests before"),
        Line2D([], [], marker="o", color=style.JOINT_COLOURS[0], label="where the identified one rests"),
        Line2D([], [], color=style.INK, linewidth=0.9, linestyle=":", label="where a stop begins"),
    ]
    if lost_any:
        handles.append(Line2D([], [], marker="x", linestyle="", color=style.ALERT, label="it rests nowhere near"))
    style.legend_below(figure, handles)
    return figure
