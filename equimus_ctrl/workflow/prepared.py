"""What a diagnosis is asked of: trials read and checked, parameters chosen, trials held out; nothing is fitted yet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis import preflight
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings
from equimus_ctrl.diagnosis.holdout import Holdout, Split, check_settings, motion_problem, never_held_out, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.servo_gains import ServoGain, servo_gains, told, with_servo_gains
from equimus_ctrl.engines.predict import check_columns
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import DiagnoseOptions
from equimus_ctrl.preflight.findings import Finding, backward, stops, too_few
from equimus_ctrl.preflight.scatter import Clock, JointScatter, scatter_of
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
        groups: of each trial the one that it belongs to; none where all are alike.
        scatter: of each trial how its positions scatter.
        stops: why a diagnosis of them means nothing.
    """

    model: Model
    trials: Sequence[Recording]
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
    budget.check()
    # What is not finite is refused before anything is simulated.
    scatter = [scatter_of(trial) for trial in trials if np.isfinite(trial.position).all()]
    found = tuple(meaningless(model, trials, scatter))
    require_meaning(found, options.anyway)
    return Given(model, trials, groups, scatter, found)


def meaningless(
    model: Model, trials: Sequence[Recording], scatter: Sequence[Sequence[JointScatter]]
) -> Iterator[Finding]:
    """Why a diagnosis of trials means nothing: other units, signs or order, or no motion above steps and noise."""
    try:
        preflight.check(model, trials)
    except ConfigError as error:
        yield Finding("stop", "conventions", str(error))
    for trial in trials:
        yield from backward(trial.name, Clock.of(trial.time))
    if problem := motion_problem(model, trials):
        yield Finding("stop", "excitation", problem)
    if len(scatter) == len(trials):
        yield from stops(model, scatter)


def require_meaning(findings: Sequence[Finding], anyway: bool) -> None:
    """Raise ConfigError, one sentence, where a diagnosis means nothing, unless it is wanted all the same."""
    if findings and not anyway:
        more = f" (and {len(findings) - 1} more, see equimus-ctrl check)" if len(findings) > 1 else ""
        raise ConfigError(f"{findings[0].sentence}{more}; --anyway goes on all the same")


def prepared(
    given: Given, options: DiagnoseOptions, budget: Budget, heldout: Holdout | None
) -> tuple[FreeParameters, Split, DiagnosisSettings]:
    """What is free, the trials fitted and held out, and how a diagnosis goes; see ``diagnose``.

    Args:
        given: see ``Given``.
        options: see ``DiagnoseOptions``.
        budget: asked before each step that may take seconds.
        heldout: what is held out, in the place of what the options say.

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
    few = too_few(given.scatter, len(chosen.free)) if len(given.scatter) == len(trials) else []
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
    parts = split(begun, trials, simulator=simulator, shoot=options.shoot, **said)
    check_settings(chosen, parts)
    check_fitted(groups, parts.train)
    search = SearchSettings(most_parts=options.most)
    told_before = (*preflight.other_joints(model.robot, trials), *preflight.coarse_steps(model.robot, trials))
    notes = (
        *told_before,
        *preflight.left_out_at_first(trials, parts, options.window),
        *((told(gains),) if gains else ()),
        *(
            f"Gone on with all the same, as was asked (--anyway): {finding.sentence}"
            for finding in (*given.stops, *few)
        ),
    )
    settings = DiagnosisSettings(
        search, options.threads, options.engine, tuple(options.exclude), options.budget, notes=notes
    )
    return chosen, parts, settings
