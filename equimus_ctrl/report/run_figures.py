"""Figures of one run: joints over time, the foot's path, commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.report import style
from equimus_ctrl.report.drawing import MM, first_pass, label_parts, skeleton, sketch, well_spaced
from equimus_ctrl.report.site_figure import site_figure
from equimus_ctrl.robots.reading import Reading, reading
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import Score, on_grid
from equimus_ctrl.types import Array, Run

MAX_REST_POSES = 400
SAME_POSE = 0.01  # [rad]
WIDTH = 10.0
TARGET: dict[str, Any] = {
    "linestyle": "",
    "marker": "+",
    "markersize": 13,
    "markeredgewidth": 1.6,
    "color": style.REFERENCE,
}


@dataclass(frozen=True, eq=False)
class Wanted:
    """The dashed line that a run is drawn beside.

    Attributes:
        position: (n, nj) at the run's instants [rad].
        followed: whether anything tried to get there; where commands are only played it is the pose at which the
            leg would rest under the command in force.
    """

    position: Array
    followed: bool

    @property
    def label(self) -> str:
        """For legends."""
        return "reference" if self.followed else "where slow commands would lead (pose at rest)"


@dataclass(frozen=True, eq=False)
class Beside:
    """What the real robot did, cut to the run's time.

    Attributes:
        time: (m,) [s].
        position: (m, nj) [rad].
        name: of the recording.
    """

    time: Array
    position: Array
    name: str


def save_run_figures(
    run: Run, scenario: Scenario, score: Score, kinematics: Kinematics | None, folder: Path, label: str
) -> list[Path]:
    """Write ``joints.png``, ``pressures.png`` or ``commands.png``, and paths of a foot or of a site that has one.

    Args:
        run: what happened.
        scenario: what was to be done, and the recording to show beside.
        score: of the run.
        kinematics: of the robot, for the foot and for poses at rest, where it has such.
        folder: made where it does not exist.
        label: what the figures are headed with.

    Raises:
        ConfigError: where the run and the kinematics are not of the same robot.
    """
    return style.save_all(run_drawings(run, scenario, score, kinematics, label), folder)


def run_drawings(
    run: Run, scenario: Scenario, score: Score, kinematics: Kinematics | None, label: str
) -> style.Drawings:
    """See ``save_run_figures``.

    Raises:
        ConfigError: where the run and the kinematics are not of the same robot.
    """
    if kinematics is not None:
        m = kinematics.morphology
        if (run.spec.joints, run.spec.actuators) != (m.joint_names, m.actuator_names):
            raise ConfigError(
                f"the run has joints {', '.join(run.spec.joints)} and actuators {', '.join(run.spec.actuators)}, but "
                f"{m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
            )
    wanted = Wanted(run.reference, True) if kinematics is None else wanted_of(run, scenario, kinematics)
    beside, site = beside_of(run, scenario), scenario.site
    drawings: dict[str, Callable[[], Figure]] = {"joints": lambda: joints_figure(run, score, wanted, beside, label)}
    if kinematics is not None:
        drawings["foot_path"] = lambda: foot_path_figure(run, kinematics, wanted, beside, label)
    commands = "pressures" if set(run.spec.command_units) == {"Pa"} else "commands"
    drawings[commands] = lambda: commands_figure(run, score, label)
    if site is not None:
        drawings["site_path"] = lambda: site_figure(run, site, score, label)
    return drawings


def wanted_of(run: Run, scenario: Scenario, kinematics: Kinematics) -> Wanted:
    """The run's reference, or the poses of the commands where these were only played from the scenario's profile."""
    if scenario.commands is None:
        return Wanted(run.reference, True)
    low, high = run.spec.command_low, run.spec.command_high
    profile = np.array([scenario.commands.at(float(t)) for t in run.time])
    if not np.allclose(np.clip(profile, low, high), run.command, atol=1e-6):
        return Wanted(run.reference, True)
    try:
        return Wanted(_slow_outcome(run, kinematics), False)
    except ModelError:
        return Wanted(run.reference, True)


def _slow_outcome(run: Run, kinematics: Kinematics) -> Array:
    """(n, nj) the pose at rest under the command in force at each instant [rad]."""
    n = len(run.time)
    some = _spread(n, 40)
    distance = np.abs(kinematics.equilibria(run.command[some]) - run.reference[some]).max(axis=1)
    if np.median(distance) < SAME_POSE:
        return run.reference
    changes = np.flatnonzero(np.any(np.diff(run.command, axis=0) != 0, axis=1)) + 1
    if len(changes) < MAX_REST_POSES:
        return np.repeat(kinematics.equilibria(run.command[[0, *changes]]), np.diff([0, *changes, n]), axis=0)
    rows = _spread(n, MAX_REST_POSES)
    return on_grid(run.time[rows], kinematics.equilibria(run.command[rows]), run.time)


def _spread(n: int, most: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.intp))


def beside_of(run: Run, scenario: Scenario) -> Beside | None:
    """The part of the scenario's recording that lies within the run, or None."""
    recorded = scenario.recorded
    if recorded is None:
        return None
    inside = (recorded.time >= run.time[0]) & (recorded.time <= run.time[-1])
    if inside.sum() < 2:
        return None
    return Beside(recorded.time[inside], recorded.position[inside], recorded.name)


MOST_ROWS = 4
"""Joints or actuators beside which there is no second column."""


def joints_figure(run: Run, score: Score, wanted: Wanted, beside: Beside | None, label: str) -> Figure:
    """A panel and a residual strip for each joint, in degrees or mm."""
    nj = len(run.spec.joints)
    rows, columns = _grid(nj)
    what = "joint angles" if set(run.spec.joint_units) == {"rad"} else "joint positions"
    figure = style.new_figure(WIDTH * (1 + 0.4 * (columns - 1)), 1.1 + 2.9 * rows, f"{label}: {what}")
    panels = figure.subplots(2 * rows, columns, sharex=True, squeeze=False, height_ratios=[2.6, 1.0] * rows)
    partly = score.window[0] > run.time[0] + 0.05 or score.window[1] < run.time[-1] - 0.05
    for j, joint in enumerate(run.spec.joints):
        row, column = divmod(j, columns)
        axes, strip, last = panels[2 * row, column], panels[2 * row + 1, column], j + columns >= nj
        colour, own = style.joint_colour(j), reading(run.spec.joint_units[j])
        style.dress(axes, title=_joint_title(run, score, wanted, beside, j), y=f"{joint} [{own.unit}]")
        style.dress(strip, y=f"error [{own.unit}]", x="time [s]" if last else "")
        strip.tick_params(labelbottom=last)
        _plot_wanted(axes, run.time, wanted, own.factor * wanted.position[:, j])
        if beside is not None:
            axes.plot(
                beside.time, own.factor * beside.position[:, j], color=style.RECORDED, linewidth=style.RECORDED_WIDTH
            )
        axes.plot(run.time, own.factor * run.position[:, j], color=colour, linewidth=style.RUN_WIDTH)
        _widen(axes, own)
        time, residual = _residual(run, wanted, beside, j)
        strip.axhline(0.0, color=style.FAINT, linewidth=style.THIN_WIDTH)
        strip.plot(time, residual, color=colour, linewidth=1.0)
        strip.fill_between(time, residual, 0.0, color=colour, alpha=0.15, linewidth=0)
        _even_limits(strip, residual)
        axes.set_xlim(run.time[0], run.time[-1] + run.spec.control_dt)
        if partly:
            for panel in (axes, strip):
                panel.axvspan(run.time[0], score.window[0], color=style.SHADE, linewidth=0, zorder=0)
                panel.axvspan(score.window[1], run.time[-1], color=style.SHADE, linewidth=0, zorder=0)
    _drop(panels[-2:], rows * columns - nj)
    figure.align_ylabels()
    compared = "recorded" if beside is not None else "reference" if wanted.followed else "resting pose"
    handles = [_many_coloured("this run", nj), *_line_handles(wanted, beside)]
    handles.append(Patch(facecolor=style.FAINT, alpha=0.3, label=f"error: run − {compared}"))
    if partly:
        low, high = score.window
        handles.append(Patch(facecolor=style.SHADE, label=f"not scored (scored: {low:g} to {high:g} s)"))
    style.legend_below(figure, handles)
    return figure


def _grid(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels, filled row by row."""
    columns = 1 if count <= MOST_ROWS else 2
    return -(-count // columns), columns


def _drop(last: Any, count: int) -> None:
    """Take away so many panels at the end of the last rows, which nothing is drawn in."""
    for row in last:
        for axes in row[len(row) - count :]:
            axes.remove()


LEAST_SPAN = 1.0
"""Of an axis of positions, so that a joint that stands still is drawn so [° or mm]."""


def _widen(axes: Axes, own: Reading) -> None:
    low, high = axes.get_ylim()
    if own.factor != 1.0 and high - low < LEAST_SPAN:
        middle = (low + high) / 2
        axes.set_ylim(middle - LEAST_SPAN / 2, middle + LEAST_SPAN / 2)


def _joint_title(run: Run, score: Score, wanted: Wanted, beside: Beside | None, j: int) -> str:
    parts, unit = [], run.spec.joint_units[j]
    if beside is not None and score.recorded is not None:
        parts.append(f"{_text(score.recorded.rmse[j], unit)} from the recording")
    if wanted.followed:
        parts.append(f"{_text(score.tracking.rmse[j], unit)} from the reference")
    elif not parts:
        parts.append(f"{_text(_rest_rmse(run, score, wanted, j), unit)} from the resting pose")
    return f"{run.spec.joints[j]}   RMSE " + ", ".join(parts)


def _rest_rmse(run: Run, score: Score, wanted: Wanted, j: int) -> float:
    if wanted.position is run.reference:
        return float(score.tracking.rmse[j])
    inside = (run.time >= score.window[0]) & (run.time <= score.window[1])
    return float(np.sqrt(((run.position - wanted.position)[inside, j] ** 2).mean()))


def _text(value: float, unit: str) -> str:
    return f"{reading(unit).text(value, '.2f')} ({value:.4f} {unit})"


def _residual(run: Run, wanted: Wanted, beside: Beside | None, j: int) -> tuple[Array, Array]:
    factor = reading(run.spec.joint_units[j]).factor
    if beside is None:
        return run.time, factor * (run.position[:, j] - wanted.position[:, j])
    inside = (run.time >= beside.time[0]) & (run.time <= beside.time[-1])
    time = run.time[inside]
    return time, factor * (run.position[inside, j] - np.interp(time, beside.time, beside.position[:, j]))


def _even_limits(axes: Axes, values: Array) -> None:
    span = max(1.1 * float(np.abs(values).max()), 0.1)
    axes.set_ylim(-span, span)


def _plot_wanted(axes: Axes, x: Array, wanted: Wanted, y: Array, order: float = 2.5) -> None:
    width = style.REFERENCE_WIDTH if wanted.followed else style.THIN_WIDTH
    axes.plot(x, y, color=style.REFERENCE, linewidth=width, linestyle=style.DASHES, zorder=order)


def _line_handles(wanted: Wanted, beside: Beside | None) -> list[Artist]:
    width = style.REFERENCE_WIDTH if wanted.followed else style.THIN_WIDTH
    handles: list[Artist] = [
        Line2D([], [], color=style.REFERENCE, linewidth=width, linestyle=style.DASHES, label=wanted.label)
    ]
    if beside is not None:
        handles.append(
            Line2D(
                [],
                [],
                color=style.RECORDED,
                linewidth=style.RECORDED_WIDTH,
                label=f"recorded ({beside.name})",
            )
        )
    return handles


def _many_coloured(label: str, nj: int) -> Line2D:
    colour = style.joint_colour(0) if nj == 1 else style.INK
    return Line2D([], [], color=colour, linewidth=style.RUN_WIDTH + 0.6, label=label)


def foot_path_figure(run: Run, kinematics: Kinematics, wanted: Wanted, beside: Beside | None, label: str) -> Figure:
    """The robot at a few poses of the run, and beside it the path alone and larger, in mm with y downwards."""
    m, phase = kinematics.morphology, kinematics.phase
    what = "foot" if phase == "swing" else "base"
    figure = style.new_figure(WIDTH, 5.5, f"{label}: path of the {what}")
    side_view, path = figure.subplots(1, 2, width_ratios=[1.0, 1.0])

    def trace(angles: Array) -> Array:
        bones = skeleton(m, angles, phase)
        return np.asarray((bones.foot if phase == "swing" else bones.base) * MM)

    walked, target = trace(run.position), first_pass(trace(wanted.position))
    shown = [walked, target[np.isfinite(target[:, 0])]]
    still = bool(np.ptp(shown[1], axis=0).max() < 1.0)
    for axes in (side_view, path):
        axes.plot(*walked.T, color=style.FOOT, linewidth=style.RUN_WIDTH, zorder=3)
        if still:
            axes.plot(*target[0], **TARGET, zorder=6)
        else:
            _plot_wanted(axes, target[:, 0], wanted, target[:, 1], order=3.5)
    if beside is not None:
        shown.append(trace(beside.position))
        for axes in (side_view, path):
            axes.plot(*shown[-1].T, color=style.RECORDED, linewidth=style.RECORDED_WIDTH, alpha=0.7, zorder=2.6)
    chosen = well_spaced(walked, 4)
    for strength, k in zip((1.0, 0.25, 0.25, 0.25), chosen, strict=False):
        sketch(side_view, m, run.position[k], phase, strength=strength)
    label_parts(side_view, m, run.position[0], phase)
    style.dress(side_view, title="the robot at the start, later poses faded", x="x [mm]", y="y, downwards [mm]")
    style.dress(path, title=f"the {what} alone", x="x [mm]", y="y, downwards [mm]")
    start, end = walked[[0, -1]]
    path.plot(*start, marker="o", markersize=8, markerfacecolor="white", markeredgecolor=style.INK, zorder=5)
    path.plot(*end, marker="s", markersize=6, color=style.INK, zorder=5)
    _equal(side_view, np.concatenate([skeleton(m, run.position[chosen], phase).points * MM, *shown]))
    _equal(path, np.concatenate(shown))
    handles: list[Artist] = [Line2D([], [], color=style.FOOT, linewidth=style.RUN_WIDTH + 0.6, label="this run")]
    handles += _line_handles(wanted, beside)
    if still:
        handles[1] = Line2D([], [], **TARGET, label=wanted.label)
    handles.append(Line2D([], [], marker="o", color=style.INK, markerfacecolor="white", linestyle="", label="start"))
    handles.append(Line2D([], [], marker="s", color=style.INK, linestyle="", label="end"))
    style.legend_below(figure, handles)
    return figure


def _equal(axes: Axes, points: Array) -> None:
    """Limits in which ``points`` (n, 2) fill a square with a margin, a millimetre being as long both ways."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.56 * float((high - low).max()), 5.0)
    (x, y) = (low + high) / 2
    axes.set_xlim(x - half, x + half)
    axes.set_ylim(y + half, y - half)
    axes.set_aspect("equal", adjustable="box")


def commands_figure(run: Run, score: Score, label: str) -> Figure:
    """A panel of each actuator's command, with its limits where they are near and where they cut a command off."""
    spec, na = run.spec, len(run.spec.actuators)
    rows, columns = _grid(na)
    pressures = set(spec.command_units) == {"Pa"}
    title = f"{label}: commanded pressures" if pressures else f"{label}: commands"
    figure = style.new_figure(WIDTH * (1 + 0.4 * (columns - 1)), 1.1 + 1.9 * rows, title)
    panels, limited = figure.subplots(rows, columns, sharex=True, squeeze=False), False
    for i, name in enumerate(spec.actuators):
        axes, own = panels[divmod(i, columns)], reading(spec.command_units[i])
        low, high = spec.command_low[i] * own.factor, spec.command_high[i] * own.factor
        command, asked, clipped = run.command[:, i] * own.factor, run.asked[:, i] * own.factor, run.clipped[:, i]
        title = f"{name}   {own.text(score.effort[i], '.1f' if pressures else '.3g')} RMS"
        if clipped.any():
            title += f", {100 * clipped.mean():.1f} % of commands clipped"
        last = i + columns >= na
        style.dress(axes, title=title, y=f"{name} [{own.unit}]" if own.unit else name, x="time [s]" if last else "")
        axes.tick_params(labelbottom=last)
        axes.set_xlim(run.time[0], run.time[-1] + spec.control_dt)
        bottom, top = _command_limits(axes, command, low, high, own)
        for edge, beyond in ((low, bottom), (high, top)):
            if np.isfinite(edge):
                axes.axhspan(edge, beyond, color=style.SHADE, linewidth=0, zorder=0)
                axes.axhline(edge, color=style.FAINT, linewidth=style.THIN_WIDTH)
        view = axes.get_ylim()
        axes.set_ylim(*view)
        limited = limited or view[0] < low or high < view[1]
        axes.step(run.time, command, where="post", color=style.actuator_colour(i), linewidth=style.RUN_WIDTH)
        for edge, beyond, cut in ((low, bottom, asked < low), (high, top, asked > high)):
            bars = _bars(run, clipped & cut)
            if bars:
                axes.broken_barh(bars, (min(edge, beyond), abs(beyond - edge)), facecolor=style.ALERT, linewidth=0)
    _drop(panels[-1:], rows * columns - na)
    figure.align_ylabels()
    handles: list[Artist] = []
    if limited:
        handles.append(Patch(facecolor=style.SHADE, edgecolor=style.FAINT, label="beyond the limits"))
    if run.clipped.any():
        handles.append(Patch(facecolor=style.ALERT, label="clipped: more was asked for than the limit allows"))
    if handles:
        style.legend_below(figure, handles)
    return figure


def _bars(run: Run, where: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """(from, width) [s] of the stretches where ``where`` holds, none too narrow to be seen."""
    edges = np.diff(np.concatenate([[0], where.astype(int), [0]]))
    dt, least = run.spec.control_dt, 0.002 * float(run.time[-1] - run.time[0])
    begins, ends = run.time[np.flatnonzero(edges == 1)], run.time[np.flatnonzero(edges == -1) - 1] + dt
    return [(float(a), max(float(b - a), least)) for a, b in zip(begins, ends, strict=True)]


def _command_limits(axes: Axes, command: Array, low: float, high: float, own: Reading) -> tuple[float, float]:
    """Show the whole range where the commands use half of it, else what they use, and say where the limits are."""
    least, most = float(command.min()), float(command.max())
    span = high - low
    if np.isfinite(low) and most < low + 0.5 * span and least >= low and low >= 0:
        reach = max(most - low, 0.02 * span if np.isfinite(span) else 1e-3)
        bottom, top = low - 0.08 * reach, low + 1.25 * reach
        if np.isfinite(high):
            _say_limit(axes, f"limit {high:g} {own.unit} ↑")
        axes.set_ylim(bottom, top)
        return bottom, max(top, high)
    if np.isfinite(span) and (most - least >= 0.5 * span or low >= 0):
        axes.set_ylim(low - 0.06 * span, high + 0.06 * span)
        return low - 0.06 * span, high + 0.06 * span
    reach = max(most - least, 1e-3 * max(abs(most), abs(least)), 1e-6)
    bottom, top = least - 0.2 * reach, most + 0.2 * reach
    if bottom > low > -np.inf or top < high < np.inf:
        _say_limit(axes, f"limits {low:g} to {high:g} {own.unit}".rstrip())
    axes.set_ylim(bottom, top)
    return min(bottom, low), max(top, high)


def _say_limit(axes: Axes, text: str) -> None:
    axes.annotate(
        text, (1.0, 1.0), xycoords="axes fraction", xytext=(0, 4), textcoords="offset points", ha="right",
        fontsize=style.SMALL_SIZE, color=style.FAINT,
    )  # fmt: skip
