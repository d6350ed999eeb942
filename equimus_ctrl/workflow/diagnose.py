"""Diagnosis from recordings, for the command and for users of the library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis import preflight
from equimus_ctrl.diagnosis.budget import Asked, Budget, never
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, Progress, diagnose_within
from equimus_ctrl.diagnosis.experiment import Design
from equimus_ctrl.diagnosis.holdout import Holdout, Split, check_settings, never_held_out, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.random_splits import random_holdouts
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.servo_gains import ServoGain, servo_gains, told, with_servo_gains
from equimus_ctrl.engines.predict import check_columns
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import DiagnoseOptions, with_changes
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.groups import by_folder, check_enough, check_fitted
from equimus_ctrl.workflow.identify import choose, marked, simulator_of, with_file
from equimus_ctrl.workflow.scores import gather
from equimus_ctrl.workflow.splits import over_splits

if TYPE_CHECKING:
    from equimus_ctrl.options import Some

SWEEPS = {"mean": (10.0, 15.0, 20.0), "amplitude": (4.0, 9.0), "high": (0.5, 2.0, 6.0)}
"""Settings of the scenario ``chirp`` among which an experiment is chosen [kPa, kPa, Hz]."""


def diagnose_recordings(
    recordings: Some,
    model: Model | None = None,
    options: DiagnoseOptions | None = None,
    *,
    progress: Progress = lambda stage, share, best: None,
    asked: Asked = never,
    **changes: Any,
) -> Diagnosis:
    """Find the physics that a model lacks, from recordings: where, which effect, how large, and how certain.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        options: see ``DiagnoseOptions``.
        progress: called with the stage, the share done and the best hypothesis so far.
        asked: whether its best so far is to be given now.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used.
    """
    model = model or nominal_model()
    options = with_file(with_changes(DiagnoseOptions, options, changes), model)
    budget = Budget.beginning_now(options.budget, asked)

    def diagnosed(heldout: Holdout | None, told: Progress) -> Diagnosis:
        free, parts, settings = _prepared(given, options, budget, heldout)
        designs = partial(sweeps, model)
        return diagnose_within(budget, free, parts, settings, nominal=model, designs=designs, progress=told)

    with budget.with_nothing_yet():
        given = _read(recordings, model, options, budget)
        if not options.splits:
            return diagnosed(None, progress)
        names = [trial.name for trial in given.trials]
        others = random_holdouts(names, options.splits, options.seed, test=options.test, groups=given.groups)
        return over_splits(diagnosed, others, options.splits, progress)


@dataclass(frozen=True, eq=False)
class _Given:
    """What a diagnosis is asked of.

    Attributes:
        model: the nominal one.
        trials: all of them.
        groups: of each trial the one that it belongs to; none where all are alike.
    """

    model: Model
    trials: Sequence[Recording]
    groups: Sequence[str]


def _read(recordings: Some, model: Model, options: DiagnoseOptions, budget: Budget) -> _Given:
    """The trials, once they are seen to be what the model is of; see ``diagnose_recordings``.

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
    preflight.check(model, trials)
    return _Given(model, trials, groups)


def _prepared(
    given: _Given, options: DiagnoseOptions, budget: Budget, heldout: Holdout | None
) -> tuple[FreeParameters, Split, DiagnosisSettings]:
    """What is free, the trials fitted and held out, and how a diagnosis goes; see ``diagnose_recordings``.

    Args:
        given: see ``_Given``.
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
    }
    chosen = default_free_parameters(model, options.free, options.bounds, options.fix)
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
    )
    settings = DiagnosisSettings(
        search, options.threads, options.engine, tuple(options.exclude), options.budget, notes=notes
    )
    return chosen, parts, settings


def sweeps(model: Model) -> list[Design]:
    """Experiments that ``equimus-ctrl run chirp`` can make with a robot; none where its commands are no pressures."""
    # Only where effects are not distinguishable does a diagnosis need what runs scenarios.
    from equimus_ctrl.workflow.runs import load_scenario

    designs: list[Design] = []
    if not model.robot.traits.commands_are_pressures:
        return designs
    for values in product(*SWEEPS.values()):
        settings = dict(zip(SWEEPS, values, strict=True))
        options = {key: f"{value:g}" for key, value in settings.items()}
        try:
            scenario = load_scenario("chirp", model.morphology, phase=model.phase, options=options, search=False)
        except EquimusError:  # a robot that these pressures are not for
            continue
        if scenario.commands is not None:
            times, commands = (np.array(part) for part in (scenario.commands.times, scenario.commands.values))
            designs.append(Design("chirp", settings, times, commands))
    return designs
