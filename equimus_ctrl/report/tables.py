"""The figures of one run as a table and as JSON data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ErrorFigures, Score
from equimus_ctrl.types import Array, Run


def score_to_dict(score: Score, run: Run, scenario: Scenario, controller_label: str) -> dict[str, Any]:
    """What a run came to, in plain JSON types and SI units.

    Args:
        score: of the run.
        run: whose joints and actuators are named.
        scenario: what was done.
        controller_label: name of the controller; published figures are carried only where they are of the same one.
    """
    joints = run.spec.joints
    recorded = published = None
    if score.recorded is not None and scenario.recorded is not None:
        recorded = {**_figures(joints, score.recorded), "name": scenario.recorded.name}
    if (figures := _published(scenario, controller_label)) is not None:
        published = {
            "rmse_rad": {str(joint): float(value) for joint, value in figures.items()},
            "controller": scenario.published_controller,
        }
    return {
        "scenario": scenario.name,
        "controller": controller_label,
        **_figures(joints, score.tracking),
        "recorded": recorded,
        "published": published,
        "window_s": [float(edge) for edge in score.window],
        "saturated_share": float(score.saturated),
        "effort_pa": _named(run.spec.actuators, score.effort),
        "solve_time_s": {"p50": float(score.solve_time[0]), "p99": float(score.solve_time[1])},
        "missing": scenario.missing,
    }


def run_table(score: Score, run: Run, scenario: Scenario, controller_label: str) -> RenderableType:
    """What a run came to, for a terminal of 80 columns: errors of each joint, then pressures and computing time.

    Args: as of ``score_to_dict``.
    """
    published = _published(scenario, controller_label)
    table = Table(
        title=Text(f"{scenario.name}, {controller_label}", style="bold"),
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        title_justify="left",
    )
    table.add_column("joint", overflow="fold")
    table.add_column("against", no_wrap=True)
    for quantity in ("RMSE", "MAE", "max"):
        table.add_column(f"{quantity}\nrad", justify="right", no_wrap=True)
        table.add_column("\ndeg", justify="right", no_wrap=True)
    if published is not None:
        table.add_column("published\nrad", justify="right", no_wrap=True)
    # Published figures are against a recording, so they keep its row even where there is none to compare with.
    compared: list[tuple[str, ErrorFigures | None]] = [("reference", score.tracking)]
    if score.recorded is not None or published is not None:
        compared.insert(0, ("recording", score.recorded))
    for j, joint in enumerate(run.spec.joints):
        for k, (against, figures) in enumerate(compared):
            cells = [joint if k == 0 else "", against]
            if figures is None:
                cells += ["–"] * 6
            else:
                for values in (figures.rmse, figures.mae, figures.largest):
                    cells += [f"{values[j]:.4f}", f"{np.degrees(values[j]):.2f}"]
            if published is not None:
                cells.append(f"{published[joint]:.4f}" if k == 0 and joint in published else "")
            table.add_row(*map(Text, cells), end_section=k == len(compared) - 1)
    parts: list[RenderableType] = [table, Padding(_facts(score, run), (0, 0, 0, 1))]
    if scenario.missing is not None:
        parts.append(Padding(Text(scenario.missing, style="yellow"), (1, 0, 0, 1)))
    return Group(*parts)


def _facts(score: Score, run: Run) -> Table:
    facts = Table.grid(padding=(0, 2))
    effort = ", ".join(f"{a} {e / 1e3:.2f} kPa" for a, e in zip(run.spec.actuators, score.effort, strict=True))
    low, high = score.window
    p50, p99 = score.solve_time
    for key, value in (
        ("scored", f"{low:g} to {high:g} s"),
        ("commands at a limit", f"{100 * score.saturated:.1f} %"),
        ("effort, RMS", effort),
        ("controller step", f"{_duration(p50)} (median), {_duration(p99)} (99th percentile)"),
    ):
        facts.add_row(Text(key, style="dim"), Text(value))
    return facts


def _duration(seconds: float) -> str:
    return f"{seconds * 1e6:.1f} µs" if seconds < 1e-3 else f"{seconds * 1e3:.2f} ms"


def _published(scenario: Scenario, controller_label: str) -> Mapping[str, float] | None:
    if scenario.published is None or controller_label != scenario.published_controller:
        return None
    return scenario.published


def _figures(joints: Iterable[str], figures: ErrorFigures) -> dict[str, Any]:
    return {
        "rmse_rad": _named(joints, figures.rmse),
        "mae_rad": _named(joints, figures.mae),
        "max_rad": _named(joints, figures.largest),
    }


def _named(names: Iterable[str], values: Array) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
