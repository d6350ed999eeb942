"""Diagnosis from recordings, for the command and for users of the library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from equimus_ctrl.diagnosis.budget import Asked, Budget, never
from equimus_ctrl.diagnosis.diagnose import Progress, diagnose_within
from equimus_ctrl.diagnosis.holdout import Holdout
from equimus_ctrl.diagnosis.known import Known
from equimus_ctrl.diagnosis.random_splits import random_holdouts
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import DiagnoseOptions, with_changes
from equimus_ctrl.workflow.identifications import with_file
from equimus_ctrl.workflow.prepared import prepared, read_given
from equimus_ctrl.workflow.splits import over_splits

if TYPE_CHECKING:
    from equimus_ctrl.options import Some


def diagnose(
    recordings: Some,
    model: Model | None = None,
    options: DiagnoseOptions | None = None,
    *,
    heldout: Holdout | None = None,
    known: Sequence[Known] = (),
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
        known: explanations that an earlier diagnosis of the same robot left, see ``DiagnosisSettings``.
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
        free, parts, settings = prepared(given, options, budget, heldout, known)
        return diagnose_within(budget, free, parts, settings, nominal=model, progress=told)

    with budget.with_nothing_yet():
        given = read_given(recordings, model, options, budget)
        if not options.splits:
            return diagnosed(heldout, progress)
        names = [trial.name for trial in given.trials]
        others = random_holdouts(names, options.splits, options.seed, test=options.test, groups=given.groups)
        return over_splits(diagnosed, others, options.splits, progress)
