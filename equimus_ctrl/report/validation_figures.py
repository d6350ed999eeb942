"""Figures of a validation: errors over the workspace, over runs, over robots and over time, and what speed costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from equimus_ctrl.report import style
from equimus_ctrl.types import Array
from equimus_ctrl.validation.conservation import Drift
from equimus_ctrl.validation.plan import ACCURACY_GOALS, PUBLISHED, PUBLISHED_SPEED
from equimus_ctrl.validation.responses import Responses
from equimus_ctrl.validation.validate import Validation

ENGINES = {
    "mujoco": ("MuJoCo, 3-2-1 elements", style.JOINT_COLOURS[0]),
    "reduced": ("reduced engine", style.JOINT_COLOURS[1]),
    "native": ("MuJoCo, massless actuators", style.ACTUATOR_COLOURS[0]),
    "mujoco, implicitfast": ("MuJoCo, implicitfast", style.ACTUATOR_COLOURS[1]),
}
MICRO = 1e6
LEAST = 1e-12
"""Where logarithmic axes end below; differences this small are rounding."""


def save_validation_figures(result: Validation, folder: Path) -> list[Path]:
    """Write static_map, swing_errors, responses, morphologies, conservation and, where there is one, front as PNG."""
    return style.save_all(validation_drawings(result), folder)


def validation_drawings(result: Validation) -> style.Drawings:
    """Poses at rest, step responses and their errors, random robots, conservation; speed over error where known."""
    return {
        "static_map": lambda: static_figure(result),
        "swing_errors": lambda: swing_figure(result),
        "responses": lambda: responses_figure(result),
        "morphologies": lambda: morphologies_figure(result),
        "conservation": lambda: conservation_figure(result),
        **({"front": lambda: front_figure(result)} if result.speed.front else {}),
    }


def static_figure(result: Validation) -> Figure:
    """Errors of MuJoCo's resting angles over the workspace, a map for each joint."""
    case, names = result.static, result.morphology.joint_names
    poses, error = np.degrees(case.poses[case.scored]), np.abs(case.error[case.scored]) * MICRO
    rmse = case.errors.rmse * MICRO
    width = min(max(4.8 * len(names) + 0.6, 6.4), 15.0)
    figure = style.new_figure(width, 4.6, f"Resting angles in MuJoCo, {len(poses)} poses")
    grid = figure.subplots(1, len(names), squeeze=False)[0]
    finite = error[np.isfinite(error) & (error > 0)]
    low, high = np.quantile(finite, [0.02, 1.0]) if len(finite) else (1e-3, 1.0)
    scale = LogNorm(low, max(high, 1.001 * low))
    drawn = None
    for j, (axes, name) in enumerate(zip(grid, names, strict=True)):
        if poses.shape[1] > 1:
            x, y, label = poses[:, 0], poses[:, 1], f"{names[1]} [°]"
        else:
            x, y, label = poses[:, 0], error[:, 0], "error [µrad]"
        shown = np.maximum(error[:, j], low)
        drawn = axes.scatter(
            x, y, c=shown, norm=scale, cmap="viridis", s=float(np.clip(30000 / len(poses), 6, 40)), linewidths=0
        )
        style.dress(axes, title=f"{name}: RMSE {rmse[j]:.2g} µrad", x=f"{names[0]} [°]", y=label if j == 0 else "")
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=list(grid), pad=0.02, extend="min")
        bar.set_label("error [µrad]", fontsize=style.TEXT_SIZE, color=style.INK)
        bar.ax.tick_params(labelsize=style.SMALL_SIZE)
    return figure


def swing_figure(result: Validation) -> Figure:
    """How the RMSE of single step responses is distributed: both engines and the baseline, a panel for each joint."""
    names = result.morphology.joint_names
    sets = {
        "reduced": result.swing.error("reduced"),
        "mujoco": result.swing.error("mujoco"),
        "native": result.baseline.swing_error,
    }
    single = {key: np.sqrt((error**2).mean(axis=1)) for key, error in sets.items()}  # (n, nj)
    values = np.concatenate([v.ravel() for v in single.values()])
    values = np.maximum(values[np.isfinite(values)], LEAST)
    decades = np.log10([values.min(), values.max()])
    edges = np.logspace(np.floor(decades[0]), np.ceil(decades[1]), int(8 * np.ceil(np.ptp(decades)) + 17))
    figure = style.new_figure(
        9.5,
        2.6 * len(names) + 1.0,
        f"Step responses, {len(sets['mujoco'])} runs of {result.swing.experiment.duration:g} s",
    )
    grid = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    published = PUBLISHED["swing"].rmse
    for j, (axes, name) in enumerate(zip(grid, names, strict=True)):
        for key, own in single.items():
            shown = np.maximum(own[np.isfinite(own[:, j]), j], LEAST)
            weights = np.full(len(shown), 100.0 / max(len(own), 1))
            axes.hist(shown, bins=edges, weights=weights, color=ENGINES[key][1], alpha=0.65, zorder=3)
        axes.axvline(ACCURACY_GOALS["swing"], color=style.INK, linestyle=style.DASHES, linewidth=1.1, zorder=4)
        if len(published) == len(names):
            axes.axvline(published[j], color=style.ALERT, linestyle=":", linewidth=1.5, zorder=4)
        axes.set_xscale("log")
        last = j == len(names) - 1
        style.dress(axes, title=name, x="RMSE of one run [rad]" if last else "", y="share of the runs [%]")
    handles: list[Line2D] = [
        Line2D([], [], color=ENGINES[key][1], linewidth=6, alpha=0.65, label=ENGINES[key][0]) for key in single
    ]
    handles.append(Line2D([], [], color=style.INK, linestyle=style.DASHES, label="goal, all runs together"))
    if len(published) == len(names):
        handles.append(Line2D([], [], color=style.ALERT, linestyle=":", label="published, all runs together"))
    style.legend_below(figure, handles)
    return figure


def responses_figure(result: Validation) -> Figure:
    """One example of every kind of motion, and the engines' errors below it."""
    cases = {
        "step response": result.swing,
        "foot pinned, published start and forces": result.stance.published(),
        "three joints under pulses": result.three_dof,
    }
    shown = {title: case for title, case in cases.items() if case.scored.any()}
    figure = style.new_figure(4.8 * len(shown), 6.4, "Examples")
    grid = figure.subplots(2, len(shown), squeeze=False, sharex="col", height_ratios=(1.25, 1))
    most = 0
    for k, (title, case) in enumerate(shown.items()):
        run = _typical(case)
        time = case.experiment.times
        exact = case.exact[run]
        most = max(most, exact.shape[1])
        for j in range(exact.shape[1]):
            grid[0, k].plot(time, np.degrees(exact[:, j]), color=style.joint_colour(j), linewidth=style.RUN_WIDTH)
            seen = np.degrees(case.found["mujoco"][run, :, j])
            grid[0, k].plot(time, seen, color=style.INK, linestyle=(0, (1.5, 4)), linewidth=1.6)
            for name, dashes in (("mujoco", "-"), ("reduced", (0, (4, 2)))):
                if name in case.found:
                    error = np.abs(case.found[name][run, 1:, j] - exact[1:, j])
                    grid[1, k].plot(
                        time[1:], np.maximum(error, LEAST), color=style.joint_colour(j), linestyle=dashes, linewidth=1.0
                    )
        grid[1, k].set_yscale("log")
        style.dress(grid[0, k], title=title, y="angle [°]" if k == 0 else "")
        style.dress(grid[1, k], x="time [s]", y="error [rad]" if k == 0 else "")
    low = min(axes.get_ylim()[0] for axes in grid[1])
    high = max(axes.get_ylim()[1] for axes in grid[1])
    for axes in grid[1]:
        axes.set_ylim(max(low, 1e-10), high)
    joints = [Line2D([], [], color=style.joint_colour(j), linewidth=2, label=f"joint {j + 1}") for j in range(most)]
    style.legend_below(
        figure,
        [
            *joints,
            Line2D([], [], color=style.INK, linestyle=(0, (1.5, 2)), linewidth=1.6, label="MuJoCo, above"),
            Line2D([], [], color=style.FAINT, label="error of MuJoCo"),
            Line2D([], [], color=style.FAINT, linestyle=(0, (4, 2)), label="error of the reduced engine"),
        ],
    )
    return figure


def _typical(case: Responses) -> int:
    """The scored run whose error in MuJoCo is the median."""
    rows = np.flatnonzero(case.scored)
    size = np.sqrt(((case.found["mujoco"][rows] - case.exact[rows]) ** 2).mean(axis=(1, 2)))
    return int(rows[np.argsort(size)[len(size) // 2]])


def morphologies_figure(result: Validation) -> Figure:
    """The worst joint's RMSE of every random robot, shape by shape."""
    case = result.robots
    figure = style.new_figure(9.5, 4.8, f"Random robots under pulses, {len(case.robots)} of two to four joints")
    axes = figure.add_subplot()
    shapes = list(dict.fromkeys(robot.shape for robot in case.robots))
    x, ticks = 0.0, []
    for k, shape in enumerate(shapes):
        own = sorted((r for r in case.robots if r.shape == shape), key=lambda r: r.worst("mujoco"))
        places = x + np.arange(len(own))
        if k % 2 == 0:
            axes.axvspan(x - 0.75, x + len(own) - 0.25, color=style.SHADE, alpha=0.6, zorder=0)
        for engine in case.engines:
            values = np.array([r.worst(engine) for r in own])
            axes.scatter(places, values, s=34, color=ENGINES[engine][1], linewidths=0, zorder=3)
        ticks.append((places.mean(), shape.replace("_", " ").replace("joints ", "joints,\n", 1)))
        x += len(own) + 0.5
    axes.axhline(ACCURACY_GOALS["morphologies"], color=style.INK, linestyle=style.DASHES, linewidth=1.1)
    axes.set_yscale("log")
    style.dress(axes, y="RMSE of the worst joint [rad]")
    axes.set_xticks([t[0] for t in ticks], [t[1] for t in ticks])
    axes.grid(False, axis="x")
    axes.set_xlim(-0.75, x - 0.75)
    handles = [
        Line2D([], [], marker="o", linestyle="", color=ENGINES[engine][1], label=ENGINES[engine][0])
        for engine in case.engines
    ]
    handles.append(Line2D([], [], color=style.INK, linestyle=style.DASHES, label="goal"))
    style.legend_below(figure, handles)
    return figure


def conservation_figure(result: Validation) -> Figure:
    """How far energy, angular momentum and the balance of work depart from their first value."""
    case = result.conservation
    panels = (
        ("energy without damping", case.energy, "share of the kinetic energy"),
        ("angular momentum", case.momentum, "share of itself"),
        ("balance of work", case.work, "share of what damping took"),
    )
    figure = style.new_figure(13.0, 4.4, "What motion must keep")
    grid = figure.subplots(1, 3, sharey=True)
    for k, (axes, (title, drifts, scale)) in enumerate(zip(grid, panels, strict=True)):
        for engine, drift in drifts.items():
            axes.plot(*_envelope(drift), color=ENGINES[engine][1], linewidth=1.2)
        axes.set_yscale("log")
        style.dress(axes, title=f"{title}\n({scale})", x="time [s]", y="largest departure so far" if k == 0 else "")
    handles = [
        Line2D([], [], color=ENGINES[e][1], label=f"{ENGINES[e][0]}, {1e3 * case.energy[e].step:.3g} ms")
        for e in case.energy
    ]
    style.legend_below(figure, handles)
    return figure


def _envelope(drift: Drift) -> tuple[Array, Array]:
    """Times and the largest departure up to each."""
    return drift.time[1:], np.maximum(np.maximum.accumulate(np.abs(drift.drift[1:])), 1e-13)


def front_figure(result: Validation) -> Figure:
    """What accuracy costs: RMSE against speed on one thread, each engine over its steps."""
    figure = style.new_figure(9.0, 5.4, "Accuracy against speed, one thread")
    axes = figure.add_subplot()
    engines = list(dict.fromkeys(point.engine for point in result.speed.front))
    for engine in engines:
        points = sorted((p for p in result.speed.front if p.engine == engine), key=lambda p: p.step)
        x, y = [p.x_realtime for p in points], [p.rmse for p in points]
        axes.plot(x, y, "o-", color=ENGINES[engine][1], markersize=6, linewidth=1.4, zorder=3)
        for p in points:
            _label(axes, p.x_realtime, p.rmse, f"{1e3 * p.step:.3g} ms")
    axes.plot([PUBLISHED_SPEED], [max(PUBLISHED["swing"].rmse)], "D", color=style.ALERT, markersize=7, zorder=4)
    axes.axhline(ACCURACY_GOALS["swing"], color=style.INK, linestyle=style.DASHES, linewidth=1.0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.12, y=0.1)
    style.dress(
        axes, x="simulated time over time taken (× real time)", y="RMSE of the worst joint, step responses [rad]"
    )
    handles = [Line2D([], [], marker="o", color=ENGINES[e][1], label=ENGINES[e][0]) for e in engines]
    handles.append(Line2D([], [], marker="D", linestyle="", color=style.ALERT, label="published"))
    handles.append(Line2D([], [], color=style.INK, linestyle=style.DASHES, label="goal"))
    style.legend_below(figure, handles)
    return figure


def _label(axes: Axes, x: float, y: float, text: str) -> None:
    axes.annotate(
        text,
        (x, y),
        xytext=(8, -4),
        textcoords="offset points",
        va="top",
        fontsize=style.SMALL_SIZE,
        color=style.INK,
        zorder=5,
    )
