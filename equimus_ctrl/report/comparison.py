"""What a comparison of controllers came to: a table for a terminal, and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from equimus_ctrl.report import style
from equimus_ctrl.report.error_panel import error_limits
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.scenarios.comparison import Comparison, Entry
from equimus_ctrl.scenarios.scoring import off_reference
from equimus_ctrl.types import Array

MRAD = 1e3
SMALL = {"rad": "mrad", "m": "mm"}
"""SI unit of a joint → a thousandth of it."""
TIMING = ["step, ms\np50/p99", "overrun/\nfallback, %"]
"""Columns that a table leaves out where it would be too wide."""
MOST_COLUMNS = 3
"""Joints that have a column each; of more, or where these are too wide, the table has the worst."""
WIDTHS = (3.2, 2.2, 1.2)
"""Of the controllers' lines, so that those drawn later hide none."""
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
SHOWN = 4
"""Conditions whose motion is drawn, at most."""
LEAST_ERROR = 0.01
"""The least limit of an axis of errors [° or mm]."""


@dataclass(frozen=True, eq=False)
class _Fitting:
    """The first of some tables that is not too wide, else the last."""

    tables: Sequence[Table]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        whole = options.update(max_width=10_000)
        for table in self.tables[:-1]:
            if Measurement.get(console, whole, table).maximum <= options.max_width:
                yield table
                return
        yield self.tables[-1]


def comparison_table(found: Comparison) -> RenderableType:
    """For a terminal of 80 columns: a table for each scenario, a row for each condition and controller.

    Where joints, or a column each, are too many it has the worst joint, and where that is too wide no times;
    controllers are never cut short.
    """
    parts: list[RenderableType] = []
    few = len(found.model.robot.joint_names) <= MOST_COLUMNS
    for name in found.scenarios:
        tables = [
            _table(found, name, each=each, brief=brief)
            for each in ([True, False] if few else [False])
            for brief in (False, True)
        ]
        parts.append(_Fitting(sorted(tables, key=lambda table: -len(table.columns))))
    for entry in found.failures:
        parts.append(Text(f"{entry.controller}, {entry.scenario}, {entry.condition}: {entry.failure}", style="yellow"))
    parts.append(
        Text(
            "Errors are of the true positions. Limit: commands at one. Overrun: steps longer than a control period. "
            "Fallback: commands of what a controller falls back on.",
            style="dim",
        )
    )
    return Group(*parts)


def _table(found: Comparison, name: str, *, each: bool, brief: bool) -> Table:
    """Of a scenario, with a column for each joint or one for the worst, whose words may be broken if it is brief."""
    robot = found.model.robot
    joints, units = robot.joint_names, [SMALL[unit] for unit in robot.joint_units]
    table = Table(
        title=Text(f"{name}: {found.scenarios[name].summary}", style="bold"), box=SIMPLE_HEAD, padding=(0, 1, 0, 0),
        title_justify="left",
    )  # fmt: skip
    heads = [f"{joint}, {unit}\nRMSE/max" for joint, unit in zip(joints, units, strict=True)]
    if not each:
        heads = [f"worst joint, {' or '.join(dict.fromkeys(units))}\nRMSE/max"]
    breaks = brief and not each
    for head in ("condition", "by"):
        table.add_column(head, no_wrap=not breaks, overflow="fold")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=not breaks, overflow="fold")
    unit = _effort_unit(robot)
    for head in ([f"effort\n{unit}"] if unit else []) + ["limit\n%"] + ([] if brief else TIMING):
        table.add_column(head, justify="right", no_wrap=True)
    for condition in found.conditions:
        rows = [e for e in found.entries if (e.scenario, e.condition) == (name, condition.name)]
        for k, entry in enumerate(rows):
            cells = [condition.name if k == 0 else "", entry.controller, *_cells(entry, each)]
            cells = cells[: len(table.columns)]
            table.add_row(*map(Text, cells), end_section=k == len(rows) - 1)
    return table


def _cells(entry: Entry, each: bool) -> list[str]:
    if entry.score is None or entry.error is None or entry.run is None:
        return ["ended early"]
    rmse, largest, spec = MRAD * entry.error.rmse, MRAD * entry.error.largest, entry.run.spec
    if each:
        cells = [f"{own:.2f}/{_most(most)}" for own, most in zip(rmse, largest, strict=True)]
    else:
        j = int(rmse.argmax())
        cells = [f"{spec.joints[j]} {rmse[j]:.2f}/{_most(largest[j])}"]
    p50, p99 = entry.score.solve_time
    kinds = set(spec.command_units)
    effort = []
    if len(kinds) == 1:
        effort = [f"{reading(kinds.pop()).factor * float(np.sqrt((entry.score.effort**2).mean())):.1f}"]
    return [
        *cells, *effort, f"{100 * entry.score.saturated:.0f}", f"{1e3 * p50:.3g}/{1e3 * p99:.3g}",
        f"{100 * entry.missed:.1f}/{100 * entry.fallbacks:.1f}",
    ]  # fmt: skip


def _most(largest: float) -> str:
    """The largest error of a joint, of which small ones have a digit more."""
    return f"{largest:.0f}" if largest >= 10 else f"{largest:.1f}"


def _effort_unit(robot: Robot) -> str:
    """Of commands where all have the same; else they cannot be added."""
    kinds = set(robot.command_units)
    return reading(kinds.pop()).unit if len(kinds) == 1 else ""


MARKERS = "osD^vP"
"""Of controllers, in their order."""


def comparison_figures(found: Comparison) -> dict[str, Figure]:
    """``errors`` (RMSE of every controller), ``times`` (of their steps), and one for the motion in each scenario."""
    return style.drawn(comparison_drawings(found))


def comparison_drawings(found: Comparison) -> style.Drawings:
    """See ``comparison_figures``."""
    motions = {f"motion_{name}": partial(_motion, found, name) for name in found.scenarios}
    return {"errors": lambda: _errors(found), "times": lambda: _times(found), **motions}


def _controllers(found: Comparison) -> list[str]:
    return list(dict.fromkeys(entry.controller for entry in found.entries))


def _errors(found: Comparison) -> Figure:
    """Dots of RMSE on a logarithmic scale (it has no zero for bars): a panel for each joint and scenario."""
    names, controllers = list(found.scenarios), _controllers(found)
    joints, units = found.model.robot.joint_names, found.model.robot.joint_units
    conditions = [c.name for c in found.conditions]
    width = max(7.0, 1.6 + 0.26 * len(conditions) * (len(controllers) + 1) * len(joints))
    figure = style.new_figure(width, 1.2 + 2.3 * len(names), "Tracking error")
    axes = figure.subplots(len(names), len(joints), squeeze=False, sharey="row")
    bar = 0.8 / len(controllers)
    for row, name in enumerate(names):
        for j, joint in enumerate(joints):
            panel = axes[row][j]
            for c, controller in enumerate(controllers):
                values = [_rmse(found, controller, name, condition, j) for condition in conditions]
                place = np.arange(len(conditions)) + (c - (len(controllers) - 1) / 2) * bar
                shape = MARKERS[c % len(MARKERS)]
                panel.plot(place, values, shape, markersize=5.5, color=style.actuator_colour(c), label=controller)
            for between in np.arange(len(conditions) - 1) + 0.5:
                panel.axvline(between, color=style.REFERENCE, linewidth=0.5, alpha=0.4)
            panel.set_xlim(-0.5, len(conditions) - 0.5)
            panel.set_yscale("log")
            panel.margins(y=0.15)
            panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.yaxis.set_major_formatter(PLAIN)
            panel.yaxis.set_minor_locator(NullLocator())
            panel.set_xticks(np.arange(len(conditions)), conditions, rotation=25, ha="right", fontsize=style.SMALL_SIZE)
            panel.tick_params(labelbottom=row == len(names) - 1)
            alone = len(set(units)) > 1 or j == 0
            style.dress(panel, title=f"{name}, {joint}", y=f"RMSE [{SMALL[units[j]]}]" if alone else "")
            panel.grid(False, axis="x")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
    return figure


def _rmse(found: Comparison, controller: str, scenario: str, condition: str, joint: int) -> float:
    for entry in found.entries:
        if (entry.controller, entry.scenario, entry.condition) == (controller, scenario, condition) and entry.error:
            return MRAD * float(entry.error.rmse[joint])
    return float("nan")


def _times(found: Comparison) -> Figure:
    """What share of each controller's steps took at most so long; what compiles has done so before."""
    figure = style.new_figure(7.0, 3.6, "Time of a controller's step")
    panel = figure.subplots()
    period = None
    for c, controller in enumerate(_controllers(found)):
        runs = [e.run for e in found.entries if e.controller == controller and e.run is not None]
        if not runs:
            continue
        period = runs[0].spec.control_dt
        times = np.sort(np.concatenate([run.solve_time for run in runs])) * 1e3
        share = 100 * np.arange(1, len(times) + 1) / len(times)
        panel.plot(times, share, color=style.actuator_colour(c), linewidth=style.RUN_WIDTH, label=controller)
    if period is not None:
        panel.axvline(1e3 * period, color=style.REFERENCE, linewidth=style.REFERENCE_WIDTH, linestyle=style.DASHES)
        panel.annotate(
            "control period", (1e3 * period, 0), xytext=(-4, 4), textcoords="offset points", rotation=90, ha="right",
            va="bottom", fontsize=style.SMALL_SIZE, color=style.INK,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
        )  # fmt: skip
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(PLAIN)
    style.dress(panel, x="time [ms]", y="share of steps [%]")
    if period is not None:
        panel.legend(frameon=False, fontsize=style.SMALL_SIZE, loc="lower right")
    return figure


def _motion(found: Comparison, name: str) -> Figure:
    """True angles and, under them, their errors: two rows for each joint, a column for each of the first conditions."""
    joints, controllers = found.model.robot.joint_names, _controllers(found)
    readings = [reading(unit) for unit in found.model.robot.joint_units]
    what = "true angles" if set(found.model.robot.joint_units) == {"rad"} else "true positions"
    shown: Sequence[str] = [c.name for c in found.conditions][:SHOWN]
    figure = style.new_figure(1.2 + 3.6 * len(shown), 1.2 + 3.4 * len(joints), f"{name}: {what}, and errors below")
    axes = figure.subplots(
        2 * len(joints), len(shown), squeeze=False, sharex=True, height_ratios=[2.0, 1.2] * len(joints)
    )
    for k, j in product(range(1, len(shown)), range(len(joints))):
        axes[2 * j][k].sharey(axes[2 * j][0])
        axes[2 * j][k].tick_params(labelleft=False)
    for k, condition in enumerate(shown):
        drawn, errors = False, [list[Array]() for _ in joints]
        for entry in found.entries:
            if (entry.scenario, entry.condition) != (name, condition) or entry.run is None:
                continue
            run, c = entry.run, controllers.index(entry.controller)
            assert run.truth is not None
            off = off_reference(run.truth, run.reference, run.spec, found.scenarios[name])
            for j, own in enumerate(readings):
                panel, strip = axes[2 * j][k], axes[2 * j + 1][k]
                if not drawn:
                    panel.plot(
                        run.time, own.factor * run.reference[:, j], color=style.REFERENCE,
                        linewidth=style.REFERENCE_WIDTH, linestyle=style.DASHES, label="reference", zorder=5,
                    )  # fmt: skip
                colour, width = style.actuator_colour(c), WIDTHS[min(c, len(WIDTHS) - 1)]
                panel.plot(
                    run.time, own.factor * run.truth[:, j], color=colour, linewidth=width, label=entry.controller
                )
                errors[j].append(own.factor * off[:, j])
                strip.plot(run.time, errors[j][-1], color=colour, linewidth=1.0)
            drawn = True
        for j, (joint, own) in enumerate(zip(joints, readings, strict=True)):
            style.dress(axes[2 * j][k], title=condition if j == 0 else "", y=f"{joint} [{own.unit}]" if k == 0 else "")
            error_limits(axes[2 * j + 1][k], errors[j], own.unit, LEAST_ERROR)
            last = j == len(joints) - 1
            style.dress(axes[2 * j + 1][k], x="time [s]" if last else "", y=f"error [{own.unit}]" if k == 0 else "")
    figure.align_ylabels()
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
    return figure
