"""Figures of a diagnosis: before and after, where the error lies, all candidates, and the curves of what was found."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.localization import commands, speeds
from equimus_ctrl.diagnosis.results import SETS, STATES, Diagnosis
from equimus_ctrl.identification.residuals import DIVERGED
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.report import diagnosis_text, style
from equimus_ctrl.report.diagnosis_curves import panels, unexplained_panel
from equimus_ctrl.report.diagnosis_drawing import (
    WIDTH,
    draw,
    finding_figure,
    handles_of,
    ranking_figure,
    splits_figure,
    unexplained_figure,
)
from equimus_ctrl.report.diagnosis_panels import Panel, Scene
from equimus_ctrl.report.diagnosis_words import listed, number, reading, short
from equimus_ctrl.types import Array

COLOURS = {"nominal": style.JOINT_COLOURS[3], "refitted": "#D55E00", "corrected": "#0072B2"}
WORDS = {"nominal": "nominal", "refitted": "refitted", "corrected": "augmented"}
MOST_TRIALS = 3
"""Rows of joints of which a trial is shown: so many trials of a few joints, one of many."""
JOINTS_A_ROW, OF_TRIAL = 3, 34
"""Joints side by side; characters of the title over each."""
MOST_COMMANDS = 3
"""Of more actuators than so many a joint's residuals are drawn against those that drive it."""
COLUMNS_CHARACTERS = 120
"""Of the labels of all columns of residuals together."""
SUMMARY_CHARACTERS, CURVE_CHARACTERS, PLACE_CHARACTERS = 88, 30, 20
"""Of the summary's title in a line, of its curve's, and of the name of a place."""
NARROW, NARROW_CHARACTERS = (4.4, 6.6), 46
"""Of the summary for a phone: its size [inch], and characters of its title in a line."""
LONG_NAME = 34
BINS, LEAST_IN_BIN = 12, 5
SINCE = "time since a step [s]"
STEP_SHARE = 0.02
"""Share of the largest command that a change must have to count as a step."""


def diagnosis_figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """Name → figure of everything that was found."""
    return style.drawn(diagnosis_drawings(diagnosis))


def diagnosis_drawings(diagnosis: Diagnosis) -> style.Drawings:
    """See ``diagnosis_figures``."""
    scene = cache(lambda: Scene.of(diagnosis))
    drawings: dict[str, Callable[[], Figure | None]] = {
        "summary": lambda: summary_figure(diagnosis, scene()),
        "before_after": lambda: before_after_figure(diagnosis),
        "residuals": lambda: residuals_figure(diagnosis),
    }
    if (splits := diagnosis.splits) is not None and splits.effects:
        drawings["splits"] = lambda: splits_figure(splits)
    if diagnosis.ranking:
        drawings["ranking"] = lambda: ranking_figure(diagnosis)
    for law in diagnosis_text.grouped(diagnosis.findings):
        drawings[f"finding_{law.first + 1}"] = lambda law=law: finding_figure(scene(), law)  # type: ignore[misc]
    for k, residual in enumerate(diagnosis.unexplained):
        drawings[f"unexplained_{k + 1}"] = lambda own=residual: unexplained_figure(scene(), own)  # type: ignore[misc]
    return drawings


# Trials: which are shown, and what was predicted of them.


def _part(diagnosis: Diagnosis) -> tuple[str, Sequence[Segment]]:
    for part in ("test", "validation"):
        if segments := getattr(diagnosis, part):
            return part, segments
    return "train", diagnosis.train


def _residual(diagnosis: Diagnosis, state: str, k: int) -> Array:
    """(m, nj) of a segment [rad or m]; nan where the model diverged."""
    part, _ = _part(diagnosis)
    values = np.array(getattr(diagnosis.residuals[state], part)[k])
    values[np.abs(values) >= DIVERGED] = np.nan
    return values


def _worst(diagnosis: Diagnosis) -> list[int]:
    """The trials of which the refitted model is worst, worst first; of many joints fewer."""
    part, segments = _part(diagnosis)
    most = max(MOST_TRIALS // _rows(diagnosis), 1)
    squares = [((r / diagnosis.sigma) ** 2).mean() for r in getattr(diagnosis.residuals["refitted"], part)]
    return [int(k) for k in np.argsort(squares)[::-1][: min(most, len(segments))]]


def _rows(diagnosis: Diagnosis) -> int:
    """Rows of joints, see ``JOINTS_A_ROW``."""
    return -(-len(diagnosis.joints) // JOINTS_A_ROW)


def _trial_name(diagnosis: Diagnosis, k: int) -> str:
    part, segments = _part(diagnosis)
    name = segments[k].trial.name
    name = name if len(name) <= LONG_NAME else f"…{name[-LONG_NAME:]}"
    return f"{name} ({'fitted' if part == 'train' else part})"


def _draw_angles(axes: Axes, diagnosis: Diagnosis, k: int, j: int, states: Sequence[str]) -> None:
    segment = _part(diagnosis)[1][k]
    time, measured = segment.trial.sample_times, segment.measured[:, j]
    factor = display_units.position(diagnosis.model, diagnosis.joints[j]).factor
    axes.plot(time, measured * factor, color=style.RECORDED, linewidth=2.2, alpha=0.45)
    for state in states:
        predicted = (measured - _residual(diagnosis, state, k)[:, j]) * factor
        axes.plot(time, predicted, color=COLOURS[state], linewidth=1.3)
    axes.set_xlim(time[0], time[-1])


def _draw_residuals(axes: Axes, diagnosis: Diagnosis, k: int, j: int) -> None:
    factor = display_units.error(diagnosis.model, diagnosis.joints[j]).factor
    time, sigma = _part(diagnosis)[1][k].trial.sample_times, diagnosis.sigma[j] * factor
    axes.axhspan(-2 * sigma, 2 * sigma, color=style.SHADE, linewidth=0)
    top = 3 * sigma
    for state in diagnosis_text.states(diagnosis)[1:]:
        values = _residual(diagnosis, state, k)[:, j] * factor
        if np.isfinite(values).any():
            top = max(top, float(np.nanquantile(np.abs(values), 0.995)) * 1.1)
        axes.plot(time, values, color=COLOURS[state], linewidth=1.0, alpha=0.9)
    axes.set_ylim(-top, top)
    axes.set_xlim(time[0], time[-1])


def _draw_commands(axes: Axes, diagnosis: Diagnosis, segment: Segment) -> None:
    values, _, _ = commands(segment)
    for a, name in enumerate(diagnosis.model.robot.actuator_names):
        shown = values[:, a] * display_units.command(diagnosis.model, name).factor
        axes.step(segment.trial.sample_times, shown, where="post", color=style.actuator_colour(a), linewidth=1.1)


def _state_handles(states: Sequence[str]) -> list[Artist]:
    handles: list[Artist] = [Line2D([], [], color=style.RECORDED, linewidth=2.2, alpha=0.45, label="measured")]
    return handles + [Line2D([], [], color=COLOURS[s], linewidth=1.6, label=WORDS[s]) for s in states]


def _position_label(diagnosis: Diagnosis, joint: str) -> str:
    return f"{display_units.noun(diagnosis.model, joint)} {display_units.position(diagnosis.model, joint).bracket}"


def _command_label(diagnosis: Diagnosis) -> str:
    shown = {display_units.command(diagnosis.model, name).unit for name in diagnosis.model.robot.actuator_names}
    return f"[{', '.join(sorted(shown))}]" if shown - {""} else "command"


def before_after_figure(diagnosis: Diagnosis) -> Figure:
    """The trials of which the refitted model is worst: angles, residuals and commands."""
    chosen, rows, states = _worst(diagnosis), _rows(diagnosis), diagnosis_text.states(diagnosis)
    title = f"Before and after (RMSE {' → '.join(WORDS[s] for s in states)})"
    figure = style.new_figure(WIDTH, 0.9 + (0.8 + 3.1 * rows) * len(chosen), title)
    blocks = figure.subfigures(len(chosen), 1, squeeze=False)[:, 0]
    for block, k in zip(blocks, chosen, strict=True):
        _draw_trial(block, diagnosis, k)
    handles = _state_handles(states)
    handles.append(Patch(facecolor=style.SHADE, label="± 2 σ of the noise"))
    for a, name in enumerate(diagnosis.model.robot.actuator_names):
        handles.append(Line2D([], [], color=style.actuator_colour(a), linewidth=1.4, label=f"command of {name}"))
    style.legend_below(figure, handles)
    return figure


def _draw_trial(block: SubFigure, diagnosis: Diagnosis, k: int) -> None:
    """One trial: rows of joints, angles over residuals, and the commands under the last row."""
    joints, rows, segment = diagnosis.joints, _rows(diagnosis), _part(diagnosis)[1][k]
    columns = min(len(joints), JOINTS_A_ROW)
    heights = [2.1, 1.5] * rows + [0.7]
    titles = [f"{joint}: RMSE {_errors(diagnosis, k, j)}" for j, joint in enumerate(joints)]
    if max(map(len, titles)) > OF_TRIAL * JOINTS_A_ROW / columns:
        titles = [title.replace(": ", "\n", 1) for title in titles]
    titles[0] = f"{_trial_name(diagnosis, k)}\n{titles[0]}"
    grid = block.subplots(2 * rows + 1, columns, squeeze=False, sharex=True, height_ratios=heights)
    for j, joint in enumerate(joints):
        row, column = divmod(j, columns)
        top, bottom = grid[2 * row, column], grid[2 * row + 1, column]
        _draw_angles(top, diagnosis, k, j, diagnosis_text.states(diagnosis))
        _draw_residuals(bottom, diagnosis, k, j)
        label = column == 0
        style.dress(top, title=titles[j], y=_position_label(diagnosis, joint) if label else "")
        style.dress(bottom, y=f"error {display_units.error(diagnosis.model, joint).bracket}" if label else "")
    for axes in grid.flat[len(joints) // columns * 2 * columns :]:
        if not axes.has_data():
            axes.set_axis_off()
    for column in range(columns):
        grid[-1, column].set_axis_on()
        _draw_commands(grid[-1, column], diagnosis, segment)
        style.dress(grid[-1, column], x="time [s]", y=_command_label(diagnosis) if column == 0 else "")
    block.align_ylabels()


def _errors(diagnosis: Diagnosis, k: int, j: int) -> str:
    """A joint's RMSE in a trial with each state of the model."""
    unit = display_units.error(diagnosis.model, diagnosis.joints[j])
    of_states = (_residual(diagnosis, s, k)[:, j] for s in diagnosis_text.states(diagnosis))
    errors = [float(np.sqrt(np.mean(r**2))) * unit.factor for r in of_states]
    shown = ("diverged" if np.isnan(e) else number(e) if e < 1 else f"{e:.1f}" for e in errors)
    return f"{' → '.join(shown)} {unit.unit}"


def residuals_figure(diagnosis: Diagnosis) -> Figure:
    """Size and mean of the residuals against time since a step, the joint's angle and speed, and the commands."""
    model, joints = diagnosis.model, diagnosis.joints
    states = diagnosis_text.states(diagnosis)[1:]
    segments = (*diagnosis.train, *diagnosis.validation, *diagnosis.test)
    rows = {s: [r for part in SETS for r in getattr(diagnosis.residuals[s], part)] for s in states}
    residuals = {s: np.concatenate(r) for s, r in rows.items()}
    figure = style.new_figure(WIDTH + 1, 0.9 + 3.3 * len(joints), "Where the error lies")
    columns = _columns(model, segments)
    grid = figure.subplots(
        2 * len(joints),
        max(map(len, columns.values())),
        squeeze=False,
        sharey="row",
        height_ratios=[1.3, 1] * len(joints),
    )
    for j, joint in enumerate(joints):
        unit, sigma = display_units.error(model, joint), diagnosis.sigma[j]
        of_joint = {state: r[:, j] * unit.factor for state, r in residuals.items()}
        for c, (label, values) in enumerate(columns[joint]):
            top, bottom = grid[2 * j, c], grid[2 * j + 1, c]
            in_time = label == SINCE
            _draw_binned(top, bottom, values, of_joint, even=not in_time)
            for axes in (top, bottom) if in_time else ():
                _log_time(axes)
            top.axhline(sigma * unit.factor, color=style.INK, linewidth=1.0, linestyle=":")
            title = f"{joint}: size of the error" if c == 0 else ""
            style.dress(top, title=title, y=f"RMS {unit.bracket}" if c == 0 else "")
            style.dress(
                bottom,
                x=textwrap.fill(label, COLUMNS_CHARACTERS // grid.shape[1]),
                y=f"mean {unit.bracket}" if c == 0 else "",
            )
            bottom.xaxis.label.set_size(style.SMALL_SIZE)
        for axes in grid[2 * j : 2 * j + 2, len(columns[joint]) :].flat:
            axes.set_axis_off()
        grid[2 * j, 0].set_ylim(bottom=0)
    figure.align_ylabels()
    handles: list[Artist] = [Line2D([], [], color=COLOURS[s], marker="o", label=WORDS[s]) for s in states]
    handles.append(Line2D([], [], color=style.INK, linewidth=1.0, linestyle=":", label="noise"))
    style.legend_below(figure, handles)
    return figure


def _columns(model: Model, segments: Sequence[Segment]) -> dict[str, list[tuple[str, Array]]]:
    """For each joint what its residuals are drawn against: labels, and (m,) values in units that a person reads."""
    positions = np.concatenate([s.measured for s in segments])
    rates = np.concatenate([speeds(s) for s in segments])
    given = np.concatenate([commands(s)[0] for s in segments])
    since = np.concatenate([_since_step(s, float(given.max(initial=0.0))) for s in segments])
    names = model.robot.actuator_names
    shown = {name: display_units.command(model, name) for name in names}
    driving = {
        name: (f"command of {name} {unit.bracket}".rstrip(), given[:, a] * unit.factor)
        for a, (name, unit) in enumerate(shown.items())
    }
    stepped = [(SINCE, since)] if np.median(since) > 0 else []  # else commands change all the time
    columns = {}
    for j, joint in enumerate(model.robot.joint_names):
        place, fast = display_units.position(model, joint), display_units.speed(model, joint)
        columns[joint] = [
            *stepped,
            (f"{display_units.noun(model, joint)} of {joint} {place.bracket}", positions[:, j] * place.factor),
            (f"speed of {joint} {fast.bracket}", rates[:, j] * fast.factor),
            *(
                driving[name]
                for name in names
                if len(names) <= MOST_COMMANDS or joint in model.robot.driven_joints(name)
            ),
        ]
    return columns


def _draw_binned(top: Axes, bottom: Axes, values: Array, residuals: Mapping[str, Array], even: bool) -> None:
    """RMS above and mean below of each state's residuals in bins of values, see ``_binned``."""
    for state, residual in residuals.items():
        x, size, mean = _binned(values, residual, even)
        for axes, y in ((top, size), (bottom, mean)):
            axes.plot(x, y, color=COLOURS[state], linewidth=1.4, marker="o", markersize=3.5)
    bottom.axhline(0.0, color=style.FAINT, linewidth=0.8)
    top.tick_params(labelbottom=False)


def _log_time(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def _since_step(segment: Segment, largest: float) -> Array:
    """(m,) time since any command last changed by much at once, or since the start [s]."""
    trial = segment.trial
    rows = np.vstack([trial.before, trial.commands])
    steps = trial.times[np.any(np.abs(np.diff(rows, axis=0)) > STEP_SHARE * largest, axis=1)]
    instants = np.concatenate([[min(trial.start, trial.sample_times[0])], steps])
    instants = np.sort(instants)
    return np.asarray(trial.sample_times - instants[np.searchsorted(instants, trial.sample_times, side="right") - 1])


def _binned(values: Array, residual: Array, even: bool) -> tuple[Array, Array, Array]:
    """Median of the values, RMS and mean of the residuals in bins with as many samples each, or half way to as wide."""
    edges = np.quantile(values, np.linspace(0, 1, BINS + 1))
    if even:
        edges = (edges + np.linspace(edges[0], edges[-1], BINS + 1)) / 2
    edges = np.unique(edges)
    edges[-1] = np.inf
    rows = []
    for low, high in pairwise(edges):
        binned = residual[(values >= low) & (values < high)]
        if len(binned) >= LEAST_IN_BIN:
            middle = np.median(values[(values >= low) & (values < high)])
            rows.append((middle, np.sqrt((binned**2).mean()), binned.mean()))
    if not rows:
        rows = [(np.median(values), np.sqrt((residual**2).mean()), residual.mean())]
    x, size, mean = np.array(rows).T
    return x, size, mean


def summary_figure(diagnosis: Diagnosis, scene: Scene, narrow: bool = False) -> Figure:
    """One picture of it all: a trial before and after, and the curve of what was found first.

    Args:
        diagnosis: what was found.
        scene: what its curves are drawn from.
        narrow: one panel below the other, for a phone.
    """
    figure = style.new_figure(*(NARROW if narrow else (8.4, 3.75)))
    text, model = "Refitted, the model leaves nothing but noise.", diagnosis.model
    if diagnosis.findings:
        first, *others = diagnosis_text.grouped(diagnosis.findings)
        also = f" Also: {listed([short(law.named, model) for law in others])}." if others else ""
        text = diagnosis_text.law_sentence(first, model) + also
    elif diagnosis.unexplained:
        text = f"Unexplained at {diagnosis.unexplained[0].location}: none of the known effects does this."
    figure.suptitle(
        textwrap.fill(text, NARROW_CHARACTERS if narrow else SUMMARY_CHARACTERS),
        x=0.012,
        ha="left",
        fontsize=style.PANEL_SIZE,
        fontweight="bold",
        color=style.INK,
    )
    k, j = _most_telling(diagnosis)
    if narrow:
        top, bottom, right = figure.subplots(3, 1, height_ratios=[2.2, 1.2, 2.6])
    else:
        grid = figure.add_gridspec(2, 2, width_ratios=[1.45, 1.0], height_ratios=[2.2, 1.0])
        top, bottom, right = (figure.add_subplot(g) for g in (grid[0, 0], grid[1, 0], grid[:, 1]))
    states = diagnosis_text.states(diagnosis)[-2:]
    _draw_angles(top, diagnosis, k, j, states)
    _draw_residuals(bottom, diagnosis, k, j)
    joint = diagnosis.joints[j]
    style.dress(
        top, title=textwrap.fill(f"{joint}, {_trial_name(diagnosis, k)}", 46), y=_position_label(diagnosis, joint)
    )
    style.dress(bottom, x="time [s]", y=f"error {display_units.error(diagnosis.model, joint).bracket}")
    top.tick_params(labelbottom=False)
    panel, found = _first_panel(diagnosis, scene), diagnosis_text.grouped(diagnosis.findings)
    if found and len(found[0].findings) > 1:
        panel = None
        _draw_sizes(right, diagnosis, found[0])
    elif panel is None:
        _draw_against_noise(right, diagnosis)
    else:
        draw(right, panel, CURVE_CHARACTERS)
    style.legend_below(figure, [*_state_handles(states), *(handles_of([panel], "")[:2] if panel else [])])
    return figure


def _most_telling(diagnosis: Diagnosis) -> tuple[int, int]:
    """Trial and joint whose error falls most by what was found, in units of the noise.

    Where nothing was found but residuals are unexplained, those whose error is largest, at their joint if it is one.
    """
    part, segments = _part(diagnosis)
    nothing_named = bool(diagnosis.unexplained) and not diagnosis.findings
    worse, better = ("refitted", "corrected") if diagnosis.findings else ("nominal", "refitted")

    def squares(state: str) -> Array:
        return np.array(
            [(getattr(diagnosis.residuals[state], part)[k] ** 2).mean(axis=0) for k in range(len(segments))]
        )

    shown = (squares(better) if nothing_named else squares(worse) - squares(better)) / diagnosis.sigma**2
    if nothing_named and (at := diagnosis.unexplained[0].location) in diagnosis.joints:
        shown[:, [j for j, joint in enumerate(diagnosis.joints) if joint != at]] = -np.inf
    best = np.unravel_index(int(np.argmax(shown)), shown.shape)
    return int(best[0]), int(best[1])


def _first_panel(diagnosis: Diagnosis, scene: Scene) -> Panel | None:
    if diagnosis.findings:
        first = diagnosis.findings[0]
        return replace(panels(scene, first)[0], title=short(first.named))
    drawn = (unexplained_panel(scene, residual) for residual in diagnosis.unexplained)
    return next((panel for panel in drawn if panel is not None), None)


def _draw_sizes(axes: Axes, diagnosis: Diagnosis, law: diagnosis_text.Law) -> None:
    """The first parameter of a law at each of its places, with its interval."""
    key = next(iter(law.findings[0].parameters))
    sizes = [f.parameters[key] for f in law.findings]
    unit = reading(sizes[0].unit, max(abs(size.value) for size in sizes))
    rows = np.arange(len(sizes))
    axes.barh(rows, [size.value * unit.factor for size in sizes], height=0.62, color=COLOURS["corrected"], alpha=0.55)
    for row, size in zip(rows, sizes, strict=True):
        least, most = sorted((0.0, 2 * size.value))
        ends = [min(max(end, least), most) for end in (size.low, size.high)]
        axes.plot(np.array(ends) * unit.factor, [row, row], color=style.INK, linewidth=1.2, marker="|", markersize=9)
    axes.set_yticks(rows, [textwrap.fill(listed(f.named.locations), PLACE_CHARACTERS) for f in law.findings])
    axes.invert_yaxis()
    title = f"{law.named.effect.replace('_', ' ')}, and its 95 % interval"
    style.dress(axes, title=textwrap.fill(title, CURVE_CHARACTERS), x=f"{key} {unit.bracket}".rstrip())
    axes.grid(False, axis="y")


def _draw_against_noise(axes: Axes, diagnosis: Diagnosis) -> None:
    """Error of every state of the model and the noise, joint by joint."""
    part, _ = _part(diagnosis)
    rows = np.arange(len(diagnosis.joints))
    shown = [display_units.error(diagnosis.model, joint) for joint in diagnosis.joints]
    factors = np.array([u.factor for u in shown])
    for s, state in enumerate(STATES[:2]):
        errors = diagnosis.rmse(state, part) * factors  # type: ignore[arg-type]
        axes.barh(rows + 0.36 * (s - 0.5), errors, height=0.34, color=COLOURS[state], label=WORDS[state])
    for row, sigma in enumerate(diagnosis.sigma * factors):
        axes.vlines(sigma, row - 0.4, row + 0.4, color=style.INK, linewidth=1.4, linestyle=":")
    axes.set_yticks(rows, diagnosis.joints)
    axes.invert_yaxis()
    style.dress(
        axes, title="error, and the noise (dotted)", x=f"RMSE [{', '.join(dict.fromkeys(u.unit for u in shown))}]"
    )
    axes.grid(False, axis="y")
