"""``equimus-ctrl identify``: a model's parameters from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from equimus_ctrl.cli.common import (
    Figures,
    Force,
    Json,
    PluginFiles,
    check_model_file,
    people,
    print_engine,
    print_files,
    print_json,
    write_results,
)
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import with_options
from equimus_ctrl.cli.progress import stage_bar
from equimus_ctrl.options import IdentifyOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure
    from rich.console import Console

    from equimus_ctrl.identification.fit import Fit
    from equimus_ctrl.identification.results import Identification, Identified, IdentifiedPoses, Judged
    from equimus_ctrl.identification.statics import StaticFit
    from equimus_ctrl.types import Array


@with_options
def identify(
    recordings: Annotated[
        list[Path], typer.Argument(help="Trials (files, or folders of them), files of poses at rest, or both.")
    ],
    chosen: ModelChoice,
    write_model: Annotated[
        Path | None, typer.Option("--write-model", metavar="FILE", help="Write the identified model, for --model.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="For figures and record.json; identification/results/…"),
    ] = None,
    force: Force = False,
    figures: Figures = True,
    *,
    options: IdentifyOptions,
    plugins: PluginFiles = None,
    as_json: Json = False,
) -> None:
    """Identify a model's parameters by simulating recordings, with intervals, and validate them on held-out data.

    Poses at rest (P1 (kPa), P2 (kPa), theta1 (deg), theta2 (deg)) are recognised by their header. Where they are given
    together with trials they come first, for stiffness, area and rest length; the trials go on from there.

    \b
    [bold]Examples[/bold]
    equimus-ctrl identify my_recordings --write-model identified.toml
    equimus-ctrl identify step_release.csv --window 5 9 --select 'step_release_p1*' --heldout step_release.csv
    equimus-ctrl identify static_poses_36.csv --json
    equimus-ctrl identify runs --model robot.xml --free '*.mass' --free '*.damping'
    equimus-ctrl identify static_poses_13.csv my_recordings --free '*.damping' --free 'maa.*' --bound maa.area=3e-4,5e-4
    """  # noqa: D301
    from equimus_ctrl import outputs, presets

    default = presets.workspace() / "identification" / "results" / recordings[0].resolve().stem
    results = outputs.Results(output, force, default)
    check_model_file(write_model, force)
    console = people()
    with stage_bar(console, "getting ready", width=13) as show:
        from equimus_ctrl import workflow

        workflow.load_plugins(plugins or ())

        def notify(stage: str, share: float, best: float) -> None:
            show(stage, share, "" if best != best else f"best {best:.5f} rad")

        found = workflow.identify(
            recordings,
            chosen.read(recordings),
            options,
            progress=notify,
        )
        record = found.to_dict()

        def draw() -> dict[str, Figure]:
            from equimus_ctrl.report.identification_figures import identification_figures

            show("figures")
            return identification_figures(found) if figures else {}

        files = write_results(results, default, draw, record)
    if write_model is not None:
        files += workflow.save_model(write_model, workflow.renamed(found.model, write_model.stem), chosen.model)
    print_identification(console, found)
    print_files(console, files)
    if as_json:
        print_json({**record, "files": [str(file) for file in files]})


def print_identification(console: Console, found: Identification) -> None:
    """What was found, for people."""
    if found.poses is not None:
        _print_poses(console, found.poses)
    if found.trials is not None:
        if found.poses is not None:
            console.print("\nThen the trials, from the model that the poses gave:\n")
        _print_trials(console, found.trials, found.poses is not None)


def _print_poses(console: Console, done: IdentifiedPoses) -> None:
    found = done.fit
    m = found.model.morphology
    console.print(f"{len(done.poses.pressure)} poses at rest of {done.poses.name}, {done.seconds:.1f} s", markup=False)
    rows = [
        ("initial model", found.before),
        ("identified", found.residuals),
        (f"cross-validation ({found.folds} folds)", found.heldout),
    ]
    _warn(console, done.caveats)
    _rmse_table(console, m.joint_names, rows, done.heldout)
    _parameter_table(console, found, "of the initial model")
    _explain(console, found, found.residuals.size)
    loose = ~_any_nan(found.pressure_error)
    if loose.any():
        errors = (found.pressure_error[loose] ** 2).mean(axis=0) ** 0.5 / 1e3
        text = ", ".join(f"{name} {error:.2f} kPa" for name, error in zip(m.actuator_names, errors, strict=True))
        console.print(
            f"The pressures that would hold the {loose.sum()} poses clear of the stops differ from those commanded by "
            f"{text} (RMSE).",
            markup=False,
        )


def _warn(console: Console, caveats: Sequence[str]) -> None:
    for text in caveats:
        console.print(text, style="yellow", markup=False)


def _any_nan(values: Array) -> Any:
    return (values != values).any(axis=1)


def _print_trials(console: Console, done: Identified, from_poses: bool) -> None:
    found = done.fit
    m = found.model.robot
    samples = sum(len(r) for r in found.residuals)
    checked = f", cross-validation {done.check_seconds:.1f} s" if done.check is not None else ""
    console.print(
        f"{len(done.recordings)} trial{'s' * (len(done.recordings) != 1)}, {samples} samples, "
        f"{done.engine.name} engine; "
        f"search {done.seconds:.1f} s over {found.evaluations} sets of parameters{checked}",
        markup=False,
    )
    print_engine(console, done.engine)
    _warn(console, done.caveats)
    import numpy as np

    from equimus_ctrl.identification.results import zeros_sentence

    before, after = (np.concatenate(r)[:, : len(m.joint_names)] for r in (found.before, found.residuals))
    origin = "from the poses" if from_poses else "of the initial model"
    rows = [("fitted to the poses" if from_poses else "initial model", before), ("identified", after)]
    slides = [name for name in m.joint_names if m.slides(name)]
    _rmse_table(
        console,
        m.joint_names,
        rows,
        done.heldout,
        None if done.check is None else (f"cross-validation ({done.check.folds} folds)", done.check.rmse),
        "m" if len(slides) == len(m.joint_names) else f"rad, {', '.join(slides)} in m" if slides else "rad",
    )
    _parameter_table(console, found, origin)
    if not found.converged:
        console.print("The search was stopped before it had converged.", style="yellow")
    _explain(console, found, after.size)
    for own in done.channels:
        console.print(
            f"{own.name}: RMSE {own.before:.4g} {own.unit} before, {own.rmse:.4g} {own.unit} after.", markup=False
        )
    if zeros := zeros_sentence(found):
        console.print(zeros, markup=False)


def _rmse_table(
    console: Console,
    joints: Sequence[str],
    residuals: Sequence[tuple[str, Array]],
    heldout: Sequence[Judged],
    more: tuple[str, Array] | None = None,
    unit: str = "rad",
) -> None:
    import numpy as np

    from equimus_ctrl.identification.results import together
    from equimus_ctrl.report.paged import PagedTable

    def rmse(values: Array) -> Array:
        return np.asarray(np.sqrt((values**2).mean(axis=0)))

    rows = [(label, rmse(values)) for label, values in residuals]
    if more is not None:
        rows.append(more)
    told, sections = [], []

    def tell(label: str, values: Array) -> None:
        told.append((label, *(f"{v:.5f}" for v in (*values, together(values)))))

    for label, values in rows:
        tell(label, values)
    worse = []
    for what, own in (
        ("held-out trial", [h for h in heldout if h.segment is not None]),
        ("held-out pose", [h for h in heldout if h.segment is None]),
    ):
        if not own:
            continue
        sections.append(len(told) - 1)
        count = len(own) if what == "held-out trial" else sum(len(h.before) for h in own)
        label = f"{count} {what}{'s' * (count > 1)}"
        before, after = (rmse(np.concatenate([getattr(h, key) for h in own])) for key in ("before", "after"))
        for state, values in (("initial model", before), ("identified", after)):
            tell(f"{label}: {state}", values)
        if together(after) > together(before):
            worse.append(
                f"On the {label} the identified model is worse than the initial one, {together(after):.4f} "
                f"against {together(before):.4f} {unit}: what was found does not carry over."
            )
    console.print(PagedTable(f"RMSE in {unit}", ("", *joints, "all joints"), told, sections))
    for text in worse:
        console.print(text, style="yellow", markup=False)


def _parameter_table(console: Console, found: Fit | StaticFit, origin: str) -> None:
    from equimus_ctrl.report.diagnosis_words import interval_digits, interval_text, number
    from equimus_ctrl.report.paged import PagedTable

    rows = []
    for i, free in enumerate(found.parameters.free):
        value, width = float(found.theta[i]), float(found.uncertainty.half_width[i])
        # An end beyond what the parameter can be says nothing.
        low = value - width if value - width >= free.low else float("-inf")
        high = value + width if value + width <= free.high else float("inf")
        digits = interval_digits(value, low, high)
        mark = {-1: "low", 0: "", 1: "high"}[int(found.at_bound[i])]
        numbers = number(free.start), number(value, digits), interval_text(value, low, high)
        rows.append((free.name, free.unit, *numbers, mark))
    heads = ("parameter", "unit", "before", "after", "interval", "at bound")
    title = f"Parameters: before {origin}, after with 95 % intervals"
    console.print(PagedTable(title, heads, rows, leading=2))


def _explain(console: Console, found: Fit | StaticFit, angles: int) -> None:
    def say(text: str) -> None:
        console.print(text, markup=False, soft_wrap=False)

    effective = found.uncertainty.effective_samples
    if effective < 0.9 * angles:
        say(
            f"Residuals are autocorrelated: {angles} measured angles have an effective sample size of {effective:.0f}, "
            "which the intervals take into account."
        )
    blind = [t for t in found.uncertainty.trade_offs if t.correlation is None]
    close = [t for t in found.uncertainty.trade_offs if t.correlation is not None]
    for trade in blind:
        say(f"Not identifiable: {trade}.")
    for trade in close:
        say(f"Practically unidentifiable: {trade}.")
