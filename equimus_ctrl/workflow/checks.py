"""What recordings are like and what they could show, for the command and for users of the library."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis import plausibility
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError, SimulationDiverged, unknown_name
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import CheckOptions, DiagnoseOptions, with_changes
from equimus_ctrl.preflight.findings import SEVERITIES, Finding, too_few
from equimus_ctrl.preflight.information import Information, information
from equimus_ctrl.preflight.judgement import judged
from equimus_ctrl.preflight.latency import latencies
from equimus_ctrl.preflight.result import CheckResult
from equimus_ctrl.preflight.runs import repeats_of, rest_poses
from equimus_ctrl.preflight.signals import Signals, signals_of
from equimus_ctrl.types import Array
from equimus_ctrl.workflow.identifications import with_file
from equimus_ctrl.workflow.prepared import Given, prepared, read_given

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from equimus_ctrl.options import Some

Progress = Callable[[str, float], None]
"""Called with the stage, and the share of the whole that is done."""
SIGNALS_DONE, READY = 0.05, 0.2
"""Share of the whole that is done when signals are known, and when trials are held out."""


@dataclass(frozen=True, eq=False, repr=False)
class Check(CheckResult):
    """What recordings are like, and what they could show of a model; see ``CheckResult``."""

    def figure(self) -> Figure:
        """Travel, noise and steps of the joints, and what these recordings determine and could show."""
        from equimus_ctrl.report.check_figure import check_figure

        return check_figure(self)


def check(
    recordings: Some,
    model: Model | None = None,
    options: CheckOptions | None = None,
    *,
    progress: Progress = lambda stage, share: None,
    **changes: Any,
) -> Check:
    """What recordings are like, and which parameters and effects they could show at which size.

    Clock, dead times, steps and noise of the sensors, clipping, saturation, rests, repeats and differences between runs
    are read off the recordings; what they determine and could show follows from linear response about the model.
    Nothing is fitted.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        options: see ``CheckOptions``.
        progress: see ``Progress``.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used.
    """
    begun = time.perf_counter()
    model = model or nominal_model()
    options = with_file(with_changes(CheckOptions, options, changes), model)
    for name in options.exclude:
        if name not in REGISTRY:
            raise ConfigError(unknown_name("effect", name, REGISTRY))
    asked = _as_diagnosed(options)
    given = read_given(recordings, model, asked, Budget())
    trials = given.judged
    progress("signals", 0.0)
    signals = tuple(signals_of(trial, model.robot.command_limits) for trial in trials)
    driven = {name: model.robot.driven_joints(name) for name in model.robot.actuator_names}
    late = latencies(trials, signals, driven)
    repeats = repeats_of(trials, signals)
    progress("signals", SIGNALS_DONE)
    found = [*given.stops, *judged(model, signals, late, repeats, rest_poses(trials, signals))]
    found += _notes(model, given)
    known: Information | None = None
    if not options.quick:
        known, more = _known(given, asked, signals, options.budget, progress)
        found += more
    found = list({own.sentence: own for own in found}.values())
    found.sort(key=lambda own: SEVERITIES.index(own.severity))
    return Check(model, tuple(found), signals, late, repeats, known, time.perf_counter() - begun)


def _as_diagnosed(options: CheckOptions) -> DiagnoseOptions:
    """What a diagnosis of the same would be asked; nothing ends it here."""
    return DiagnoseOptions(
        mapping=options.mapping,
        select=options.select,
        window=options.window,
        free=options.free,
        fix=options.fix,
        bounds=options.bounds,
        exclude=options.exclude,
        engine=options.engine,
        threads=options.threads,
        anyway=True,
    )


def _notes(model: Model, given: Given) -> list[Finding]:
    """What a report of a diagnosis would say of them before anything else."""
    told = {
        "model": plausibility.other_joints(model.robot, given.trials),
        "quantisation": plausibility.coarse_steps(model.robot, given.judged),
    }
    return [Finding("note", about, sentence) for about, own in told.items() for sentence in own]


def _known(
    given: Given, asked: DiagnoseOptions, signals: Sequence[Signals], seconds: float, progress: Progress
) -> tuple[Information | None, list[Finding]]:
    """What recordings determine and could show; why not, where that cannot be said."""
    try:
        free, parts, settings = prepared(given, asked, Budget(), None)
        progress("parameters", READY)
        few = too_few([own.joints for own in signals], len(free.free))
        if any(own.about == "excitation" for own in given.stops):
            return None, few
        budget = Budget.beginning_now(seconds)
        found = information(
            free,
            parts,
            _noise(signals),
            settings,
            budget,
            lambda stage, done: progress(stage, READY + (1 - READY) * done),
        )
    except SimulationDiverged as error:
        return None, [Finding("warning", "model", f"{error}; so nothing is said of what these recordings could show")]
    return found, [*few, *_of_model(found)]


def _noise(signals: Sequence[Signals]) -> Array:
    """(nj,) root mean square over the recordings, each by its rows [rad or m]."""
    rows = np.array([own.clock.rows for own in signals], dtype=float)
    return np.asarray(np.sqrt(rows @ np.array([own.noise**2 for own in signals]) / rows.sum()))


def _of_model(found: Information) -> list[Finding]:
    """What linear response says that a person has to know."""
    told = []
    hidden = [own.name for own in found.parameters if math.isinf(own.deviation)]
    if hidden:
        told.append(
            Finding(
                "warning", "excitation", f"not identifiable from these recordings, whatever their noise: "
                f"{', '.join(hidden)}; record motion that they change, or keep them fixed (--fix)",
            )
        )  # fmt: skip
    wide = [own.name for own in found.parameters if own.range / math.sqrt(12) < own.deviation < math.inf]
    if wide:
        told.append(
            Finding(
                "warning", "excitation", f"hardly identifiable: {', '.join(wide)} will have standard deviations "
                "above those "
                "of an even spread over their bounds; record more or faster motion, or keep them fixed (--fix)",
            )
        )  # fmt: skip
    return told
