"""The figures of one run as a table and as JSON data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from equimus_ctrl.robots.reading import by_unit, reading
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ArrivalFigures, ErrorFigures, Score, StepFigures
from equimus_ctrl.types import Array, PlantSpec, Run


def score_to_dict(score: Score, run: Run, scenario: Scenario, controller_label: str) -> dict[str, Any]:
    """What a run came to, in plain JSON types and SI units.

    Args:
        score: of the run.
        run: whose joints and actuators are named.
        scenario: what was done.
        controller_label: name of the controller; published figures are carried only where they are of the same one.
    """
    spec = run.spec
    recorded = published = None
    if score.recorded is not None and scenario.recorded is not None:
        recorded = {**_figures(spec, score.recorded), "name": scenario.recorded.name}
    if (figures := _published(scenario, controller_label)) is not None:
        published = {
            **by_unit("rmse", list(figures), ["rad"] * len(figures), list(figures.values())),
            "controller": scenario.published_controller,
        }
    return {
        "scenario": scenario.name,
        "controller": controller_label,
        **_figures(spec, score.tracking),
        "approach": None if score.approach is None else _figures(spec, score.approach),
        "step": None if score.step is None else _step_figures(spec, score.step),
        "arrival": None if score.arrival is None else _arrival_figures(spec, score.arrival),
        "site": _site_figures(scenario, score),
        "recorded": recorded,
        "published": published,
        "window_s": [float(edge) for edge in score.window],
        "saturated_share": float(score.saturated),
        **by_unit("effort", spec.actuators, spec.command_units, score.effort),
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
    units = run.spec.joint_units
    alike = set(units) == {"rad"} and score.site is None
    for quantity in ("RMSE", "MAE", "max"):
        table.add_column(f"{quantity}\n{'rad' if alike else 'rad, m'}", justify="right", no_wrap=True)
        table.add_column("\n" + ("deg" if alike else "°, mm"), justify="right", no_wrap=True)
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
                    cells += [f"{values[j]:.4f}", f"{values[j] * reading(units[j]).factor:.2f}"]
            if published is not None:
                cells.append(f"{published[joint]:.4f}" if k == 0 and joint in published else "")
            table.add_row(*map(Text, cells), end_section=k == len(compared) - 1 > 0)
    if scenario.site is not None and score.site is not None:
        numbers = (values[0] for values in (score.site.rmse, score.site.mae, score.site.largest))
        cells = [text for value in numbers for text in (f"{value:.4f}", f"{value * reading('m').factor:.2f}")]
        table.add_row(*map(Text, [scenario.site.name, "its path", *cells]))
    parts: list[RenderableType] = [table]
    if score.step is not None:
        parts.append(_step_table(score.step, run.spec))
    parts.append(Padding(_facts(score, run), (0, 0, 0, 1)))
    if scenario.missing is not None:
        parts.append(Padding(Text(scenario.missing, style="yellow"), (1, 0, 0, 1)))
    return Group(*parts)


def _facts(score: Score, run: Run) -> Table:
    facts = Table.grid(padding=(0, 2))
    spec, units = run.spec, run.spec.joint_units
    effort = _each(spec.actuators, spec.command_units, score.effort)
    low, high = score.window
    p50, p99 = score.solve_time
    approach = () if score.approach is None else (("before, RMSE", _each(spec.joints, units, score.approach.rmse)),)
    for key, value in (
        *(() if score.arrival is None else (("arrived", _arrival_text(score.arrival, spec)),)),
        ("scored", f"{low:g} to {high:g} s"),
        *approach,
        ("saturated commands", f"{100 * score.saturated:.1f} %"),
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


def _figures(spec: PlantSpec, figures: ErrorFigures) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for what, values in (("rmse", figures.rmse), ("mae", figures.mae), ("max", figures.largest)):
        found |= by_unit(what, spec.joints, spec.joint_units, values)
    return found


def _site_figures(scenario: Scenario, score: Score) -> dict[str, Any] | None:
    if scenario.site is None or score.site is None:
        return None
    own = score.site
    kinds = ("rmse_m", own.rmse), ("mae_m", own.mae), ("max_m", own.largest)
    return {"name": scenario.site.name, **{key: float(values[0]) for key, values in kinds}}


def _step_figures(spec: PlantSpec, step: StepFigures) -> dict[str, Any]:
    def table(values: Array) -> dict[str, float | None]:
        return {name: None if math.isnan(v) else v for name, v in zip(spec.joints, values.tolist(), strict=True)}

    return {
        **by_unit("size", spec.joints, spec.joint_units, step.size),
        **by_unit("offset", spec.joints, spec.joint_units, step.offset),
        "rise_s": table(step.rise),
        "settling_s": table(step.settling),
        "overshoot_share": table(step.overshoot),
    }


def _arrival_figures(spec: PlantSpec, arrival: ArrivalFigures) -> dict[str, Any]:
    return {
        "arrived": arrival.arrived,
        "time_s": float(arrival.time) if arrival.arrived else None,
        **by_unit("within", spec.joints, spec.joint_units, arrival.near),
        **by_unit("left", spec.joints, spec.joint_units, arrival.left),
    }


def _arrival_text(arrival: ArrivalFigures, spec: PlantSpec) -> str:
    near = ", ".join(
        f"{joint} {reading(unit).text(size)}"
        for joint, unit, size in zip(spec.joints, spec.joint_units, arrival.near.tolist(), strict=True)
    )
    if arrival.arrived:
        return f"after {arrival.time:.2f} s, and stays there within {near}"
    left = _each(spec.joints, spec.joint_units, arrival.left)
    return f"no: {left} off in the last second, wanted within {near}"


def _step_table(step: StepFigures, spec: PlantSpec) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("joint", overflow="fold")
    for head in ("step", "rise, s", "overshoot, %", "settled, s", "left at the end"):
        table.add_column(head, justify="right", no_wrap=True)
    for j, joint in enumerate(spec.joints):
        text = reading(spec.joint_units[j]).text
        numbers = [(step.rise[j], ".3f"), (100 * step.overshoot[j], ".1f"), (step.settling[j], ".3f")]
        shown = ["–" if math.isnan(value) else f"{value:{digits}}" for value, digits in numbers]
        table.add_row(*map(Text, (joint, text(step.size[j], ".1f"), *shown, text(step.offset[j], ".3f"))))
    return table


def _each(names: Iterable[str], units: Iterable[str], values: Array) -> str:
    found = zip(names, units, values.tolist(), strict=True)
    return ", ".join(f"{name} {reading(unit).text(value, '.2f')}" for name, unit, value in found)
