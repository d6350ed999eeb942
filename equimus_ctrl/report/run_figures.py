"""Figures of one run: joints over time, the foot's path, commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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
from equimus_ctrl.report.commands_figure import WIDTH, commands_figure, drop, grid_of
from equimus_ctrl.report.drawing import MM, first_pass, label_parts, skeleton, sketch, well_spaced
from equimus_ctrl.report.error_panel import draw_distance, error_limits
from equimus_ctrl.report.site_figure import site_figure
from equimus_ctrl.robots.reading import Reading, reading
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import Score, on_grid
from equimus_ctrl.types import Array, Run

PATH_WIDTH = 2.8
"""Of the path of a run, wide enough to be seen under the dashes that it should follow."""
DISTANCES = {"reference": "reference", "recorded": "recording", "resting pose": "pose at rest"}
"""What a distance is from, by what a run is compared with."""
MAX_REST_POSES = 400
SAME_POSE = 0.01  # [rad]
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


@dataclass(frozen=True, eq=False)
class Compared:
    """What the error of a run is of: the reference where it was followed, else the recording, else poses at rest.

    Attributes:
        name: of what it is compared with.
        time: (m,) [s].
        run: (m, nj) [rad or m].
        other: (m, nj) the same of what it is compared with.
    """

    name: str
    time: Array
    run: Array
    other: Array

    @property
    def label(self) -> str:
        """For legends."""
        return f"error: run − {self.name}"


def compared(run: Run, wanted: Wanted, beside: Beside | None) -> Compared:
    """A controller is judged by its reference, commands that were played by what the real robot did."""
    if wanted.followed or beside is None:
        return Compared("reference" if wanted.followed else "resting pose", run.time, run.position, wanted.position)
    inside = (run.time >= beside.time[0]) & (run.time <= beside.time[-1])
    time = run.time[inside]
    return Compared("recorded", time, run.position[inside], on_grid(beside.time, beside.position, time))


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


def joints_figure(run: Run, score: Score, wanted: Wanted, beside: Beside | None, label: str) -> Figure:
    """A panel and a residual strip for each joint, in degrees or mm."""
    nj = len(run.spec.joints)
    rows, columns = grid_of(nj)
    what = "joint angles" if set(run.spec.joint_units) == {"rad"} else "joint positions"
    figure = style.new_figure(WIDTH * (1 + 0.4 * (columns - 1)), 1.1 + 2.9 * rows, f"{label}: {what}")
    panels = figure.subplots(2 * rows, columns, sharex=True, squeeze=False, height_ratios=[2.6, 1.0] * rows)
    against = compared(run, wanted, beside)
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
        error = own.factor * (against.run[:, j] - against.other[:, j])
        strip.plot(against.time, error, color=colour, linewidth=1.0)
        strip.fill_between(against.time, error, 0.0, color=colour, alpha=0.15, linewidth=0)
        error_limits(strip, [error], own.unit, LEAST_ERROR)
        axes.set_xlim(run.time[0], run.time[-1] + run.spec.control_dt)
        if partly:
            for panel in (axes, strip):
                panel.axvspan(run.time[0], score.window[0], color=style.SHADE, linewidth=0, zorder=0)
                panel.axvspan(score.window[1], run.time[-1], color=style.SHADE, linewidth=0, zorder=0)
    drop(panels[-2:], rows * columns - nj)
    figure.align_ylabels()
    handles = [_many_coloured("this run", nj), *_line_handles(wanted, beside)]
    handles.append(Patch(facecolor=style.FAINT, alpha=0.3, label=against.label))
    if partly:
        low, high = score.window
        handles.append(Patch(facecolor=style.SHADE, label=f"not scored (scored: {low:g} to {high:g} s)"))
    style.legend_below(figure, handles)
    return figure


LEAST_SPAN = 1.0
"""Of an axis of positions, so that a joint that stands still is drawn so [° or mm]."""
LEAST_ERROR = 0.1
"""The least limit of an axis of errors [° or mm]."""
LEAST_DISTANCE = 1e-3
"""Of a point from where it should be [mm]; what is nearer is there."""


def _widen(axes: Axes, own: Reading) -> None:
    low, high = axes.get_ylim()
    if own.factor != 1.0 and high - low < LEAST_SPAN:
        middle = (low + high) / 2
        axes.set_ylim(middle - LEAST_SPAN / 2, middle + LEAST_SPAN / 2)


def _joint_title(run: Run, score: Score, wanted: Wanted, beside: Beside | None, j: int) -> str:
    parts, unit = [], run.spec.joint_units[j]
    if wanted.followed:
        parts.append(f"{_text(score.tracking.rmse[j], unit)} from the reference")
    if beside is not None and score.recorded is not None:
        parts.append(f"{_text(score.recorded.rmse[j], unit)} from the recording")
    if not parts:
        parts.append(f"{_text(_rest_rmse(run, score, wanted, j), unit)} from the resting pose")
    return f"{run.spec.joints[j]}   RMSE " + ", ".join(parts)


def _rest_rmse(run: Run, score: Score, wanted: Wanted, j: int) -> float:
    if wanted.position is run.reference:
        return float(score.tracking.rmse[j])
    inside = (run.time >= score.window[0]) & (run.time <= score.window[1])
    return float(np.sqrt(((run.position - wanted.position)[inside, j] ** 2).mean()))


def _text(value: float, unit: str) -> str:
    return f"{reading(unit).text(value, '.2f')} ({value:.4f} {unit})"


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
    """The robot at a few poses of the run, the path alone and larger, and how far it is off, in mm, y downwards."""
    m, phase = kinematics.morphology, kinematics.phase
    what = "foot" if phase == "swing" else "base"
    figure = style.new_figure(WIDTH, 6.2, f"{label}: path of the {what}")
    spans = figure.add_gridspec(2, 2, height_ratios=[3.6, 1.0])
    side_view, path, strip = (figure.add_subplot(own) for own in (spans[:, 0], spans[0, 1], spans[1, 1]))

    def trace(angles: Array) -> Array:
        bones = skeleton(m, angles, phase)
        return np.asarray((bones.foot if phase == "swing" else bones.base) * MM)

    walked, target = trace(run.position), first_pass(trace(wanted.position))
    shown = [walked, target[np.isfinite(target[:, 0])]]
    still = bool(np.ptp(shown[1], axis=0).max() < 1.0)
    for axes in (side_view, path):
        axes.plot(*walked.T, color=style.FOOT, linewidth=PATH_WIDTH, alpha=0.8, zorder=3)
        if still:
            axes.plot(*target[0], **TARGET, zorder=6)
        else:
            _plot_wanted(axes, target[:, 0], wanted, target[:, 1], order=3.5)
    if beside is not None:
        shown.append(trace(beside.position))
        for axes in (side_view, path):
            axes.plot(*shown[-1].T, color=style.RECORDED, linewidth=style.THIN_WIDTH, alpha=0.55, zorder=2.6)
    chosen = well_spaced(walked, 4)
    for strength, k in zip((1.0, 0.25, 0.25, 0.25), chosen, strict=False):
        sketch(side_view, m, run.position[k], phase, strength=strength)
    label_parts(side_view, m, run.position[0], phase)
    style.dress(side_view, title="the robot at the start, later poses faded", x="x [mm]", y="y, downwards [mm]")
    style.dress(path, title=f"the {what} alone", x="x [mm]", y="y, downwards [mm]")
    start, end = walked[[0, -1]]
    path.plot(*start, marker="o", markersize=8, markerfacecolor="white", markeredgecolor=style.INK, zorder=5)
    path.plot(*end, marker="s", markersize=6, color=style.INK, zorder=5)
    _equal(side_view, np.concatenate([skeleton(m, run.position[chosen], phase).points * MM, *shown]), "box")
    side_view.set_anchor("N")
    _equal(path, np.concatenate(shown), "datalim")
    against = compared(run, wanted, beside)
    off = np.linalg.norm(trace(against.run) - trace(against.other), axis=1)
    draw_distance(strip, against.time, off, style.FOOT, LEAST_DISTANCE)
    strip.set_xlim(run.time[0], run.time[-1] + run.spec.control_dt)
    title = f"distance from the {DISTANCES[against.name]}, {_median_text(off)}"
    style.dress(strip, title=title, x="time [s]", y="[mm]")
    handles: list[Artist] = [Line2D([], [], color=style.FOOT, linewidth=PATH_WIDTH, alpha=0.8, label="this run")]
    handles += _line_handles(wanted, beside)
    if still:
        handles[1] = Line2D([], [], **TARGET, label=wanted.label)
    handles.append(Line2D([], [], marker="o", color=style.INK, markerfacecolor="white", linestyle="", label="start"))
    handles.append(Line2D([], [], marker="s", color=style.INK, linestyle="", label="end"))
    style.legend_below(figure, handles)
    return figure


def _median_text(distance: Array) -> str:
    """Of distances in mm."""
    median = float(np.median(distance))
    return f"median {median:.2g} mm" if median >= LEAST_DISTANCE else f"median below {LEAST_DISTANCE:g} mm"


def _equal(axes: Axes, points: Array, adjustable: Literal["box", "datalim"]) -> None:
    """Limits in which ``points`` (n, 2) fill a square with a margin, a millimetre being as long both ways.

    Args:
        axes: changed in place.
        points: what is to be seen [mm].
        adjustable: whether the axes shrink to that square, or show more beside it.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.56 * float((high - low).max()), 5.0)
    (x, y) = (low + high) / 2
    # Limits that are to give way may not be fixed, or matplotlib tells the user of it.
    auto = None if adjustable == "datalim" else False
    axes.set_xlim(x - half, x + half, auto=auto)
    axes.set_ylim(y + half, y - half, auto=auto)
    axes.set_aspect("equal", adjustable=adjustable)
