"""``equimus-ctrl validate``: the published verification, repeated, and both engines against an exact integration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from equimus_ctrl.cli.common import Json, ModelFile, people, print_json, shown_path

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


def validate(
    model: ModelFile = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer runs of everything, no front: half a minute.")] = False,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
    threads: Annotated[int | None, typer.Option(help="At most; all cores by default. Changes no error.")] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures.")] = True,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="For the record and figures; validation/results by default."
        ),
    ] = None,
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
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from equimus_ctrl import presets, workflow
    from equimus_ctrl.errors import ConfigError

    if threads is not None and threads < 1:
        raise ConfigError(f"threads is {threads}, expected at least 1")
    folder = output or presets.workspace() / "validation" / "results"
    presets.check_folder(folder)
    robot = workflow.load_model(model)
    console = people()
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[error]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        tasks = {stage: progress.add_task(title, total=1.0, start=False, error="") for stage, title in TITLES.items()}
        from equimus_ctrl.validation.plan import QUICK, Plan
        from equimus_ctrl.validation.validate import validate as run

        def notify(stage: str, share: float, error: float | None) -> None:
            task = tasks[stage]
            if share == 0.0:
                progress.start_task(task)
            progress.update(task, completed=share)
            if error is not None:
                progress.update(task, error=f"RMSE {error:.1e} rad")
            if share == 1.0 and not console.is_terminal:
                console.print(f"{TITLES[stage]}: done" + ("" if error is None else f", RMSE {error:.1e} rad"))

        found = run(robot, QUICK if quick else Plan(), seed, threads=threads, notify=notify)
    record = found.to_dict()
    files = [folder / "validation.json"]
    presets.write_text(files[0], presets.json_text(record))
    if figures:
        from equimus_ctrl.report.validation_figures import save_validation_figures

        files += save_validation_figures(found, folder)
    _tell(console, found)
    for file in files:
        console.print(f"wrote {shown_path(file)}", markup=False, soft_wrap=True)
    if as_json:
        print_json({**record, "files": [str(file) for file in files]})
    if not found.accurate:
        raise typer.Exit(3)


def _tell(console: Console, found: Validation) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from equimus_ctrl.validation.plan import ACCURACY_GOALS, PUBLISHED, PUBLISHED_SPEED, SPEED_GOALS

    table = Table(
        title=f"{found.morphology.name}: errors of each joint, rad",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
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
    if found.left_out:
        console.print(f"without the model's {', '.join(found.left_out)}: no part of the equations under test")
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
        f"step responses: {counts['scored']} of {counts['pairs']} random pairs scored; "
        f"{counts['pressure_out_of_range']} need pressures out of range, {counts['touching_a_stop']} touch a stop, "
        f"{counts['actuator_too_short']} shorten an actuator too far"
    )
    console.print(f"the reference's own error: at most {_reference_error(found):.0e} rad")
    speed = found.speed
    speeds = Table(title="Speed, × real time", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("", "reached", "goal", "published"):
        speeds.add_column(name, justify="right" if name else "left")
    realtime, steps = found.speeds[1:]
    speeds.add_row("MuJoCo, one thread", f"{speed.mujoco_one:.0f}", "", f"{PUBLISHED_SPEED:g}")
    label = f"MuJoCo, {speed.threads} thread{'s' * (speed.threads > 1)}"
    speeds.add_row(label, f"{speed.mujoco_all:.0f}", f"{SPEED_GOALS['mujoco_x_realtime']:g}", f"{PUBLISHED_SPEED:g}")
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
    yield "static", "poses at rest", found.static.errors
    yield "", "  massless actuators", found.baseline.static
    yield "swing", "step responses", found.swing.errors("mujoco")
    yield "reduced_swing", "  reduced engine", found.swing.errors("reduced")
    yield "", "  massless actuators", found.baseline.swing
    if found.swing_on_stops is not None:
        yield "", "  touching a stop", found.swing_on_stops.errors["mujoco"]
        yield "", "  … a tenth of the step", found.swing_on_stops.errors["mujoco_fine"]
    yield "stance", "foot pinned", found.stance.errors
    if "reduced" in found.stance.free.found:
        yield "", "  reduced engine", found.stance.free.errors("reduced")
    if found.stance.published.scored.any():
        yield "", "  the published run", found.stance.published.errors("mujoco")
    if found.stance.published_on_stops is not None:
        yield "", "  … on its stop", found.stance.published_on_stops.errors["mujoco"]
        yield "", "  … a tenth of the step", found.stance.published_on_stops.errors["mujoco_fine"]
    if found.stance.on_stops is not None:
        yield "", "  touching a stop", found.stance.on_stops.errors["mujoco"]
        yield "", "  … a tenth of the step", found.stance.on_stops.errors["mujoco_fine"]
    yield "three_dof", "three joints, pulses", found.three_dof.errors("mujoco")
    if "reduced" in found.three_dof.found:
        yield "", "  reduced engine", found.three_dof.errors("reduced")


def _joints(values: Array) -> str:
    return "\n".join(f"{value:.1e}" for value in values)


def _reference_error(found: Validation) -> float:
    cases = [found.swing, found.stance.free, found.three_dof, *found.robots.responses.values()]
    known = [case.reference_error for case in cases if case.reference_error == case.reference_error]
    return max(known, default=float("nan"))
