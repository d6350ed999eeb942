"""Diagnosis from recordings, for the command and for users of the library."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis.budget import Asked, Budget, never
from equimus_ctrl.diagnosis.diagnose import Progress, diagnose_within
from equimus_ctrl.diagnosis.experiment import Design
from equimus_ctrl.diagnosis.holdout import Holdout
from equimus_ctrl.diagnosis.random_splits import random_holdouts
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import DiagnoseOptions, with_changes
from equimus_ctrl.workflow.identifications import with_file
from equimus_ctrl.workflow.prepared import prepared, read_given
from equimus_ctrl.workflow.splits import over_splits

if TYPE_CHECKING:
    from equimus_ctrl.options import Some

SWEEPS = {"mean": (10.0, 15.0, 20.0), "amplitude": (4.0, 9.0), "high": (0.5, 2.0, 6.0)}
"""Settings of the scenario ``chirp`` among which an experiment is chosen [kPa, kPa, Hz]."""


def diagnose(
    recordings: Some,
    model: Model | None = None,
    options: DiagnoseOptions | None = None,
    *,
    heldout: Holdout | None = None,
    progress: Progress = lambda stage, share, best: None,
    asked: Asked = never,
    **changes: Any,
) -> Diagnosis:
    """Find the physics that a model lacks, from recordings: where, which effect, how large, and how certain.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        options: see ``DiagnoseOptions``.
        heldout: what is held out, in the place of what the options say.
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
        free, parts, settings = prepared(given, options, budget, heldout)
        designs = partial(sweeps, model)
        return diagnose_within(budget, free, parts, settings, nominal=model, designs=designs, progress=told)

    with budget.with_nothing_yet():
        given = read_given(recordings, model, options, budget)
        if not options.splits:
            return diagnosed(heldout, progress)
        names = [trial.name for trial in given.trials]
        others = random_holdouts(names, options.splits, options.seed, test=options.test, groups=given.groups)
        return over_splits(diagnosed, others, options.splits, progress)


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
