"""Figures of a tuning: how it converged, the response before and after, and how it holds on other legs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.report import style
from equimus_ctrl.report.error_panel import error_limits
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.tuning.autotune import unseen_problem
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.objective import Problem
from equimus_ctrl.tuning.plant_tuning import PlantTuning
from equimus_ctrl.tuning.result import TuningResult
from equimus_ctrl.tuning.study import Study

STAGES = {
    "start": ("start", style.INK),
    "spread": ("spread", style.JOINT_COLOURS[2]),
    "cma-es": ("CMA-ES", style.JOINT_COLOURS[0]),
    "surrogate": ("surrogate", style.JOINT_COLOURS[0]),
    "nelder-mead": ("Nelder–Mead", style.JOINT_COLOURS[1]),
}
BEFORE, AFTER = style.FAINT, style.JOINT_COLOURS[0]
LEAST_ERROR = 0.1
"""The least limit of an axis of errors [°]."""
MOST_LEGS = 20
SHOWN = 2
"""Robots whose responses are drawn where each is simulated again for that: the model and the hardest."""
LINES: tuple[tuple[float, Sequence[float]], ...] = ((0, ()), (0, (1, 1)), (0, (4, 1, 1, 1)))


def save_tuning_figures(result: TuningResult, folder: Path) -> list[Path]:
    """Write convergence.png, response.png and robustness.png."""
    return style.save_all(tuning_drawings(result), folder)


def tuning_drawings(result: TuningResult) -> style.Drawings:
    """Convergence, response, robustness."""
    found: dict[str, Callable[[], Figure]] = {"convergence": lambda: convergence_figure(result)}
    if isinstance(result, PlantTuning):
        found |= {
            "response": lambda: plant_response_figure(result),
            "robustness": lambda: plant_robustness_figure(result),
        }
    else:
        found |= {"response": lambda: response_figure(result), "robustness": lambda: robustness_figure(result)}
    return found


def convergence_figure(result: TuningResult) -> Figure:
    """Cost of every candidate, in the order they were tried, and the best so far."""
    figure = style.new_figure(9.0, 4.6, "Convergence")
    axes = figure.add_subplot()
    trials = result.history
    allowed = [t for t in trials if t.evaluation.feasible]
    costs = np.array([t.evaluation.cost for t in allowed])
    low = costs.min()
    begun = result.start_evaluation
    high = max(low + 1.15 * (np.quantile(costs, 0.9) - low), begun.cost if begun.feasible else low, low + 1e-3)
    top = high + 0.06 * (high - low)
    handles = []
    for stage, (label, colour) in STAGES.items():
        own = [t for t in allowed if t.stage == stage]
        if own:
            shown = np.minimum([t.evaluation.cost for t in own], high)
            size = 70 if stage == "start" else 16
            axes.scatter([t.index for t in own], shown, s=size, color=colour, alpha=0.75, linewidths=0, zorder=3)
            handles.append(Line2D([], [], marker="o", linestyle="", color=colour, label=f"{label} ({len(own)})"))
    beaten = [(t.index, min(t.evaluation.cost, high)) for t in trials if t.evaluation.beaten]
    if beaten:
        places = np.array(beaten)
        axes.scatter(places[:, 0], places[:, 1], s=16, facecolors="none", edgecolors=style.FAINT, zorder=2)
        label = f"not tried to the end ({len(beaten)})"
        handles.append(Line2D([], [], marker="o", linestyle="", mfc="none", color=style.FAINT, label=label))
    refused = [t.index for t in trials if not t.evaluation.within]
    axes.plot(refused, np.full(len(refused), top), "|", color=style.ALERT, markersize=7, alpha=0.7, zorder=2)
    if refused:
        handles.append(
            Line2D(
                [],
                [],
                marker="|",
                linestyle="",
                color=style.ALERT,
                label=f"unstable or beyond a limit ({len(refused)})",
            )
        )
    best = np.minimum.accumulate([t.evaluation.cost if t.evaluation.feasible else np.inf for t in trials])
    axes.plot(np.arange(len(trials)), np.where(best > high, np.nan, best), color=style.INK, linewidth=1.6, zorder=4)
    handles.append(Line2D([], [], color=style.INK, linewidth=1.6, label="best so far"))
    axes.set_ylim(low - 0.06 * (high - low), top + 0.05 * (high - low))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    before, after = begun.told, result.best.evaluation.told
    robots = len(result.problem.members)
    style.dress(
        axes,
        title=f"cost {before} before, {after} after {len(trials)} {result.noun} on {robots} robots",
        x=f"{result.noun}, in the order tried",
        y="cost",
    )
    style.legend_below(figure, handles)
    return figure


def plant_response_figure(result: PlantTuning) -> Figure:
    """Errors of the true positions with the first and the tuned settings, on the model and on the hardest robot."""
    problem = result.problem
    robot = problem.model.robot
    shown = [j for j, acts in enumerate(problem.driven) if acts]
    width = 5.0 * len(problem.tasks) + 1.0
    figure = style.new_figure(width, 1.7 * len(shown) + 1.4, "Errors before and after")
    grid = figure.subplots(len(shown), len(problem.tasks), squeeze=False, sharex="col")
    for k, task in enumerate(problem.tasks):
        for settings, colour in ((result.start, BEFORE), (result.settings, AFTER)):
            for member, own_robot in enumerate(problem.members[:SHOWN]):
                run = problem.driven_by(settings, own_robot, task)
                assert run.truth is not None  # a simulated plant knows it
                for row, j in enumerate(shown):
                    own = reading(robot.joint_units[j])
                    error = own.factor * (run.truth[:, j] - run.reference[:, j])
                    grid[row, k].plot(run.time, error, color=colour, linestyle=LINES[member], linewidth=1.5)
        for row, j in enumerate(shown):
            unit, last = reading(robot.joint_units[j]).unit, row == len(shown) - 1
            title = f"{task.name}: {robot.joint_names[j]}"
            style.dress(grid[row, k], title=title, y=f"error [{unit}]", x="time [s]" if last else "")
    handles = [
        Line2D([], [], color=BEFORE, label="first settings"),
        Line2D([], [], color=AFTER, label="tuned"),
        *(
            Line2D([], [], color=style.INK, linestyle=LINES[member], label=label)
            for member, label in enumerate(("on the model", "on the robot that is latest")[: len(problem.members)])
        ),
    ]
    style.legend_below(figure, handles)
    return figure


def response_figure(result: TuningResult) -> Figure:
    """What the model's leg does with the first and with the tuned gains, and the tuned ones on every leg."""
    problem = result.problem
    joints = problem.model.morphology.joint_names
    rows, heights = 2 * len(joints) + 1, [*[2.0, 1.2] * len(joints), 1.8]
    figure = style.new_figure(5.0 * len(problem.tasks) + 1.0, 1.1 * sum(heights), "Response before and after")
    grid = figure.subplots(rows, len(problem.tasks), squeeze=False, sharex="col", height_ratios=heights)
    own = reading("rad")
    for k, task in enumerate(problem.tasks):
        time = np.arange(len(task.reference)) * task.control_dt
        q_before, u_before, done_before = problem.simulate(result.start, 0, k)
        q_after, u_after, _ = problem.simulate(result.settings, 0, k)
        others = [run.position for run in problem.simulate_all(_on_each(problem, result)[1:], k)]
        wanted = problem.wanted(k)
        for j, joint in enumerate(joints):
            axes, strip = grid[2 * j, k], grid[2 * j + 1, k]
            errors = []
            for position, done, colour, width, alpha in (
                *((other, len(time), AFTER, 0.8, 0.25) for other in others),
                (q_before, done_before, BEFORE, 1.5, 1.0),
                (q_after, len(time), AFTER, 1.8, 1.0),
            ):
                angle = own.factor * position[:done, j]
                errors.append(angle - own.factor * wanted[:done, j])
                for panel, values in ((axes, angle), (strip, errors[-1])):
                    panel.plot(time[:done], values, color=colour, alpha=alpha, linewidth=width)
            axes.plot(time, own.factor * wanted[:, j], color=style.REFERENCE, linestyle=style.DASHES, linewidth=1.1)
            error_limits(strip, errors, own.unit, LEAST_ERROR)
            style.dress(axes, title=f"{task.name}: {joint}", y="angle [°]")
            style.dress(strip, y="error [°]")
        _pressure_panel(grid[-1, k], result, time, u_before[:done_before], u_after)
    figure.align_ylabels()
    handles = [
        Line2D([], [], color=style.REFERENCE, linestyle=style.DASHES, label="reference"),
        Line2D([], [], color=BEFORE, linewidth=1.5, label="first gains"),
        Line2D([], [], color=AFTER, linewidth=1.8, label="tuned"),
        Line2D([], [], color=AFTER, alpha=0.4, linewidth=0.8, label="tuned, on the other legs of the ensemble"),
    ]
    for i, actuator in enumerate(problem.model.morphology.actuator_names):
        handles.append(
            Line2D([], [], color=style.INK, linestyle=LINES[i % len(LINES)], label=f"pressure of {actuator}")
        )
    style.legend_below(figure, handles)
    return figure


def _on_each(problem: Problem, result: TuningResult) -> list[tuple[PidSettings, int]]:
    """The result on every leg of a problem."""
    return [(result.settings, member) for member in range(len(problem.members))]


def _pressure_panel(axes: Axes, result: TuningResult, time: np.ndarray, before: np.ndarray, after: np.ndarray) -> None:
    for i in range(after.shape[1]):
        axes.plot(time[: len(before)], before[:, i] / 1e3, color=BEFORE, linestyle=LINES[i % len(LINES)], linewidth=1.1)
        axes.plot(time, after[:, i] / 1e3, color=AFTER, linestyle=LINES[i % len(LINES)], linewidth=1.3)
    style.dress(axes, title="commands", x="time [s]", y="pressure [kPa]")


def robustness_figure(result: TuningResult) -> Figure:
    """Cost on every leg before and after, and the tuned response on legs that took no part in the tuning."""
    figure = style.new_figure(11.0, 5.4, "Robustness")
    spans = figure.add_gridspec(len(result.problem.model.morphology.joints), 2, width_ratios=(1.1, 1))
    handles = _robot_costs(figure.add_subplot(spans[:, 0]), result)
    handles.append(Line2D([], [], color=style.REFERENCE, linestyle=style.DASHES, label="reference"))
    _unseen_panels(figure, spans, result)
    style.legend_below(figure, handles)
    return figure


def plant_robustness_figure(result: PlantTuning) -> Figure:
    """Cost on every robot before and after."""
    figure = style.new_figure(9.0, 5.0, "Robustness")
    style.legend_below(figure, _robot_costs(figure.add_subplot(), result))
    return figure


def _robot_costs(axes: Axes, result: TuningResult) -> list[Line2D]:
    """Draw the cost on every robot, tuned on and not, before and after; the legend's handles."""
    seen_after = list(result.best.evaluation.member_costs)
    seen_before = list(result.start_evaluation.member_costs)
    if len(seen_before) < len(seen_after):  # it failed on some robots, and was not tried on the others
        tried = [number for stage in result.problem.stages for number in stage][: len(seen_before)]
        seen_before = [np.inf if k in tried else np.nan for k in range(len(seen_after))]
    groups = [
        (seen_before, seen_after, "tuned on"),
        (_costs(result.start_unseen), _costs(result.unseen), "never tuned on"),
    ]
    finite = [c for before, after, _ in groups for c in (*before, *after) if np.isfinite(c)]
    low, high = min(finite), max(finite)
    high = max(high, low + 1e-3)
    lost = high + 0.12 * (high - low)
    x = 0
    for before, after, label in groups:
        if not after:
            continue
        order = np.argsort(after)
        places = x + np.arange(len(after))
        for values, colour, size in ((before, BEFORE, 22), (after, AFTER, 30)):
            shown = np.array([values[i] for i in order])
            good, failed = np.isfinite(shown), np.isinf(shown)
            axes.scatter(places[good], shown[good], s=size, color=colour, linewidths=0, zorder=3)
            axes.scatter(places[failed], np.full(failed.sum(), lost), s=36, color=colour, marker="x", zorder=3)
        axes.text(
            places.mean(),
            low - 0.1 * (high - low),
            f"{label}\n({len(after)})",
            ha="center",
            va="top",
            fontsize=style.SMALL_SIZE,
        )
        axes.axvspan(
            x - 0.6, x + len(after) - 0.4, color=style.SHADE, zorder=0, alpha=0.6 if label == "tuned on" else 0.25
        )
        x += len(after) + 2
    axes.set_xticks([])
    axes.set_ylim(low - 0.32 * (high - low), lost + 0.08 * (high - low))
    style.dress(axes, title=f"cost on each {result.member}, from the easiest to the hardest", y="cost")
    if any(np.isinf(c) for before, after, _ in groups for c in (*before, *after)):
        axes.axhline(lost, color=style.ALERT, linewidth=0.8, linestyle=":")
    return [
        Line2D([], [], marker="o", linestyle="", color=BEFORE, label="first"),
        Line2D([], [], marker="o", linestyle="", color=AFTER, label="tuned"),
        Line2D([], [], marker="x", linestyle="", color=style.INK, label="unstable"),
    ]


def _unseen_panels(figure: Figure, spans: object, result: TuningResult) -> None:
    if not result.unseen:
        return
    assert isinstance(result.study, Study)
    problem = unseen_problem(result.problem, result.study)
    problem.warm_up()
    task = problem.tasks[0]
    time = np.arange(len(task.reference)) * task.control_dt
    angles = np.array([run.position for run in problem.simulate_all(_on_each(problem, result)[:MOST_LEGS], 0)])
    wanted = np.degrees(problem.wanted(0))
    for j, joint in enumerate(problem.model.morphology.joint_names):
        axes = figure.add_subplot(spans[j, 1])  # type: ignore[index]
        for leg in angles:
            axes.plot(time, np.degrees(leg[:, j]), color=AFTER, alpha=0.35, linewidth=0.9)
        axes.plot(time, wanted[:, j], color=style.REFERENCE, linestyle=style.DASHES, linewidth=1.1)
        last = j == len(problem.model.morphology.joints) - 1
        title = f"{task.name}: {joint}, on {len(angles)} legs never tuned on"
        style.dress(axes, title=title, y="angle [°]", x="time [s]" if last else "")


def _costs(evaluations: list[Evaluation]) -> list[float]:
    """Costs of single robots without the penalty of a limit; infinite where unstable."""
    return [e.member_costs[0] if e.stable else np.inf for e in evaluations]
