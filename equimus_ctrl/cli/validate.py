"""``equimus-ctrl validate``: the published verification, repeated, and both engines against an exact integration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import (
    ElasticFile,
    Figures,
    Force,
    Json,
    light_table,
    people,
    print_files,
    print_json,
)
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import bars, times
from equimus_ctrl.options import ValidateOptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from equimus_ctrl.types import Array
    from equimus_ctrl.validation.plan import Errors
    from equimus_ctrl.validation.validate import Validation

TITLES = {
    "static": "poses at rest",
    "swing": "step responses",
    "stance": "foot pinned",
    "three_dof": "three joints, pulses",
    "morphologies": "random robots",
    "conservation": "energy, momentum, work",
    "baseline": "massless actuators",
    "speed": "speed",
}


@with_options
def validate(
    model: ElasticFile = None,
    figures: Figures = True,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="For the record and figures; validation/results/… by default."
        ),
    ] = None,
    force: Force = False,
    *,
    options: ValidateOptions,
    as_json: Json = False,
) -> None:
    """Repeat the published verification of the EquiMus model and print its errors beside the published ones.

    Both engines run against an integration of the exact equations at tolerances of 1e-10. Exit code 3 says that an
    accuracy goal is missed; speeds are reported, not judged.

    \b
    [bold]Examples[/bold]
    equimus-ctrl validate
    equimus-ctrl validate --quick --no-figures
    equimus-ctrl validate --model my_leg.toml --json
    """  # noqa: D301
    from rich.progress import BarColumn, TextColumn

    from equimus_ctrl import outputs, presets, workflow

    default = presets.workspace() / "validation" / "results"
    results = outputs.Results(output, force, default)
    robot = workflow.load_elastic(model)
    console = people()
    columns = (TextColumn("{task.description:<22}"), BarColumn(), *times(), TextColumn("{task.fields[error]}"))
    with bars(console, *columns) as progress:
        tasks = {stage: progress.add_task(title, total=1.0, start=False, error="") for stage, title in TITLES.items()}
        from equimus_ctrl.workflow.validations import validate

        def notify(stage: str, share: float, error: float | None) -> None:
            task = tasks[stage]
            if share == 0.0:
                progress.start_task(task)
            progress.update(task, completed=share)
            if error is not None:
                progress.update(task, error=f"RMSE {error:.1e} rad")
            if share == 1.0 and not console.is_terminal:
                console.print(f"{TITLES[stage]}: done" + ("" if error is None else f", RMSE {error:.1e} rad"))

        found = validate(robot, options, notify=notify)
    record, drawn = found.to_dict(), list[Path]()
    folder = results.opened(default / presets.plain_name(robot.name))
    if figures:
        from equimus_ctrl.report.validation_figures import save_validation_figures

        drawn = save_validation_figures(found, folder)
    files = [outputs.write_record(folder, "validation.json", record, drawn), *drawn]
    _print(console, found)
    print_files(console, files)
    if as_json:
        print_json({**record, "files": [str(file) for file in files]})
    if not found.accurate:
        raise typer.Exit(3)


def _print(console: Console, found: Validation) -> None:
    from equimus_ctrl.validation.plan import ACCURACY_GOALS, PUBLISHED, PUBLISHED_SPEED, SPEED_GOALS

    table = light_table(f"{found.morphology.name}: errors of each joint, rad")
    table.add_column("", no_wrap=True)
    for name in ("runs", "RMSE", "largest", "goal", "published\nRMSE", "published\nlargest"):
        table.add_column(name, justify="right", no_wrap=True)
    for case, title, errors in _rows(found):
        published, goal = PUBLISHED.get(case), ACCURACY_GOALS.get(case)
        cells = [title, str(errors.runs), _joints(errors.rmse), _joints(errors.largest)]
        cells.append("" if goal is None else f"{goal:.0e}")
        for values in (None, None) if published is None else (published.rmse, published.largest):
            cells.append("" if values is None else "\n".join(f"{value:.5f}" for value in values))
        table.add_row(*cells)
    console.print(table)
    if found.effects_omitted:
        console.print(f"without the model's {', '.join(found.effects_omitted)}: no part of the equations under test")
    robots = found.robots
    worst = ", ".join(f"{robots.worst(name):.1e} ({name})" for name in robots.engines)
    console.print(f"{len(robots.robots)} random robots of 2 to 4 joints, worst RMSE: {worst} rad")
    kept = found.conservation
    for title, drifts in (
        ("energy", kept.energy),
        ("angular momentum", kept.momentum),
        ("balance of work", kept.work),
    ):
        console.print(f"{title} drifts by " + ", ".join(f"{d.largest:.1e} ({name})" for name, d in drifts.items()))
    counts = found.swing.counts
    console.print(
        f"step responses: {counts['scored']} of {counts['pairs']} random pairs scored, of which "
        f"{counts['touching_a_stop']} touch a stop; {counts['pressure_out_of_range']} need pressures out of range, "
        f"{counts['actuator_too_short']} shorten an actuator too far"
    )
    counts = found.stance.robot.counts
    console.print(
        f"foot pinned: {counts['scored']} of {counts['runs']} runs scored, of which {counts['touching_a_stop']} touch "
        "a stop"
    )
    console.print(f"the reference's own error: at most {_reference_error(found):.0e} rad")
    speed = found.speed
    speeds = light_table("Speed, × real time")
    for name in ("", "reached", "goal", "published"):
        speeds.add_column(name, justify="right" if name else "left")
    realtime, steps = found.speeds[1:]
    label = f"MuJoCo, {speed.threads} thread{'s' * (speed.threads > 1)}"
    speeds.add_row("MuJoCo, one thread", f"{speed.mujoco_one:.0f}", "", f"{PUBLISHED_SPEED:g}")
    speeds.add_row(label, f"{speed.mujoco_all:.0f}", f"{SPEED_GOALS['mujoco_x_realtime']:g}", f"{PUBLISHED_SPEED:g}")
    if speed.stops_one is not None and speed.stops_all is not None:
        speeds.add_row("on stops: MuJoCo, one thread", f"{speed.stops_one:.0f}", "", "")
        speeds.add_row(f"on stops: {label}", f"{speed.stops_all:.0f}", "", "")
    step = f"{1e3 * speed.reduced_step:g} ms"
    speeds.add_row(f"reduced, one thread, {step}", f"{realtime.value:.0f}", f"{realtime.goal:g}", "")
    speeds.add_row("reduced, million steps a second", f"{steps.value / 1e6:.1f}", f"{steps.goal / 1e6:g}", "")
    console.print(speeds)
    missed = [goal for goal in (*found.accuracy, *found.speeds) if not goal.met]
    for figure in missed:
        console.print(f"missed: {figure.name} is {figure.value:.3g}, the goal {figure.goal:g}", style="yellow")
    if not missed:
        console.print("every goal is met")


def _rows(found: Validation) -> Iterator[tuple[str, str, Errors]]:
    """(name of the goal and the published figure, title, errors)."""
    judged, stance = found.errors, found.stance.free
    rows = (
        ("static", "poses at rest", None),
        ("", "  massless actuators", found.baseline.static),
        ("swing", "step responses", None),
        ("swing_on_stops", "  touching a stop", None),
        ("reduced_swing", "  reduced engine", None),
        ("reduced_swing_on_stops", "  … touching a stop", None),
        ("", "  massless actuators", found.baseline.swing),
        ("stance", "foot pinned", None),
        ("stance_published", "  the published run", None),
        ("reduced_stance", "  reduced engine", None),
        ("stance_without_stops", "  without stops", None),
        ("", "  … the published run", found.stance.published(stops=False).errors("mujoco")),
        ("", "  … reduced engine", stance.errors("reduced") if "reduced" in stance.found else None),
        ("three_dof", "three joints, pulses", None),
        ("", "  reduced engine", found.three_dof.errors("reduced") if "reduced" in found.three_dof.found else None),
    )
    for name, title, own in rows:
        if errors := own or judged.get(name):
            yield name, title, errors


def _joints(values: Array) -> str:
    return "\n".join(f"{value:.1e}" for value in values)


def _reference_error(found: Validation) -> float:
    stance = found.stance
    cases = [found.swing, stance.robot, stance.free, found.three_dof, *found.robots.responses.values()]
    known = [case.reference_error for case in cases if case.reference_error == case.reference_error]
    return max(known, default=float("nan"))
