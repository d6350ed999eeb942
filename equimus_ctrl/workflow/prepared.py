"""What a diagnosis is asked of: trials read and checked, parameters chosen, trials held out; nothing is fitted yet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis import plausibility
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings
from equimus_ctrl.diagnosis.holdout import (
    LEAST_SAMPLES,
    Holdout,
    Split,
    check_samples,
    check_settings,
    motion_problem,
    never_held_out,
    split,
)
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.known import Known
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.servo_gains import ServoGain, servo_gains, told, with_servo_gains
from equimus_ctrl.engines.predict import check_columns
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import DiagnoseOptions
from equimus_ctrl.preflight.findings import Finding, stops, too_few
from equimus_ctrl.preflight.scatter import JointScatter, scatter_of
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.groups import by_folder, check_enough, check_fitted
from equimus_ctrl.workflow.identifications import choose, marked, simulator_of
from equimus_ctrl.workflow.scores import gather

if TYPE_CHECKING:
    from equimus_ctrl.options import Some


@dataclass(frozen=True, eq=False)
class Given:
    """What a diagnosis is asked of.

    Attributes:
        model: the nominal one.
        trials: all of them.
        judged: of each the part that counts, see ``DiagnoseOptions.window``; simulated is it from its first row on.
        groups: of each trial the one that it belongs to; none where all are alike.
        scatter: of each of these parts how its positions scatter.
        stops: why a diagnosis of them means nothing.
    """

    model: Model
    trials: Sequence[Recording]
    judged: Sequence[Recording]
    groups: Sequence[str]
    scatter: Sequence[Sequence[JointScatter]]
    stops: tuple[Finding, ...]


def read_given(recordings: Some, model: Model, options: DiagnoseOptions, budget: Budget) -> Given:
    """The trials, once they are seen to be what the model is of; see ``diagnose``.

    Raises:
        EquimusError: where something given cannot be used.
        BudgetSpent: where the budget ends.
    """
    if options.shoot is not None and model.robot.traits.held_in_place:
        raise ConfigError("multiple shooting is for MJCF robots; a leg's trials are fitted whole")
    if options.by is None:
        trials, group_of = gather(recordings, model, options.mapping), dict[str, str]()
    else:
        trials, group_of = by_folder(recordings, model, options.mapping)
    trials = marked(model, choose(trials, options.select), options)
    groups = [group_of[trial.name] for trial in trials] if group_of else []
    if groups:
        check_enough(groups, options)
    for trial in trials:
        check_columns(model, trial)
        check_samples(trial, model.robot.traits.most_angle)
    judged = [within(trial, options.window) for trial in trials]
    budget.check()
    scatter = [scatter_of(trial) for trial in judged]
    found = tuple(meaningless(model, judged, scatter))
    require_meaning(found, options.anyway)
    return Given(model, trials, judged, groups, scatter, found)


def within(trial: Recording, window: tuple[float, float] | None) -> Recording:
    """The part of a trial that counts.

    Raises:
        ConfigError: where it has too few rows to say anything.
    """
    if window is None:
        return trial
    rows = (trial.time >= window[0]) & (trial.time <= window[1])
    if np.count_nonzero(rows) < LEAST_SAMPLES:
        raise ConfigError(
            f"{trial.name}: has {np.count_nonzero(rows)} rows between {window[0]:g} and {window[1]:g} s, too few to "
            f"diagnose; expected at least {LEAST_SAMPLES} (it lasts from {trial.time[0]:g} to {trial.time[-1]:g} s)"
        )
    first = int(np.argmax(rows))
    return replace(
        trial,
        time=trial.time[rows],
        command=trial.command[rows],
        position=trial.position[rows],
        velocity=None if trial.velocity is None else trial.velocity[rows],
        measured=None if trial.measured is None else trial.measured[rows],
        sites={name: values[rows] for name, values in trial.sites.items()},
        inputs={name: values[rows] for name, values in trial.inputs.items()},
        before=trial.command[first - 1] if first else trial.before,
    )


def meaningless(
    model: Model, trials: Sequence[Recording], scatter: Sequence[Sequence[JointScatter]]
) -> Iterator[Finding]:
    """Why a diagnosis of trials means nothing: other units, signs or order, or no motion above steps and noise."""
    try:
        plausibility.check(model, trials)
    except ConfigError as error:
        yield Finding("stop", "conventions", str(error))
    if problem := motion_problem(model, trials):
        yield Finding("stop", "excitation", problem)
    yield from stops(model, scatter)


def require_meaning(findings: Sequence[Finding], anyway: bool) -> None:
    """Raise ConfigError, one sentence, where a diagnosis means nothing, unless it is wanted all the same."""
    if findings and not anyway:
        more = f" (and {len(findings) - 1} more, see equimus-ctrl check)" if len(findings) > 1 else ""
        raise ConfigError(f"{findings[0].sentence}{more}; --anyway goes on all the same")


def prepared(
    given: Given, options: DiagnoseOptions, budget: Budget, heldout: Holdout | None, known: Sequence[Known] = ()
) -> tuple[FreeParameters, Split, DiagnosisSettings]:
    """What is free, the trials fitted and held out, and how a diagnosis goes; see ``diagnose``.

    Args:
        given: see ``Given``.
        options: see ``DiagnoseOptions``.
        budget: asked before each step that may take seconds.
        heldout: what is held out, in the place of what the options say.
        known: explanations from before, the best first.

    Raises:
        EquimusError: where something given cannot be used.
        BudgetSpent: where the budget ends.
    """
    model, trials, groups = given.model, given.trials, given.groups
    said: dict[str, Any] = {
        "validation": options.validation,
        "test": options.test,
        "until": options.until,
        "window": options.window,
        "groups": groups,
        "heldout": heldout,
        "still": options.anyway,
    }
    chosen = default_free_parameters(model, options.free, options.bounds, options.fix)
    few = too_few(given.scatter, len(chosen.free))
    require_meaning(few, options.anyway)
    gains: tuple[ServoGain, ...] = ()
    budget.check()
    if options.free is None:
        gains = servo_gains(model, never_held_out(model, trials, **said))
    chosen = with_servo_gains(chosen, gains, options.bounds, options.fix)

    def simulator() -> Simulator:
        budget.check()  # the first simulation may compile equations
        return simulator_of(options.engine, None, options.threads, model, trials)

    begun = chosen.model_at(chosen.start) if gains else model
    best = known[0].model if known else None
    parts = split(begun, trials, simulator=simulator, shoot=options.shoot, known=best, **said)
    check_settings(chosen, parts)
    check_fitted(groups, parts.train)
    search = SearchSettings(most_parts=options.most)
    told_before = (
        *plausibility.other_joints(model.robot, trials),
        *plausibility.coarse_steps(model.robot, given.judged),
    )
    notes = (
        *told_before,
        *plausibility.left_out_at_first(trials, parts, options.window),
        *((told(gains),) if gains else ()),
        *(
            f"Gone on with all the same, as was asked (--anyway): {finding.sentence}"
            for finding in (*given.stops, *few)
        ),
    )
    settings = DiagnosisSettings(
        search,
        options.threads,
        options.engine,
        tuple(options.exclude),
        options.budget,
        notes=notes,
        known=tuple(known),
    )
    return chosen, parts, settings
