"""The validation of the physics, for the command and for users of the library."""

from __future__ import annotations

from typing import Any

from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import ValidateOptions, with_changes
from equimus_ctrl.validation import plan
from equimus_ctrl.validation import validate as validation


def validate(
    model: Model | None = None,
    options: ValidateOptions | None = None,
    *,
    notify: validation.Notify = lambda stage, share, error: None,
    **changes: Any,
) -> validation.Validation:
    """Repeat the published verification of a model, and check both engines against an exact integration.

    Args:
        model: the nominal leg by default.
        options: see ``ValidateOptions``.
        notify: called with the stage, its share done, and its RMSE so far [rad] where there is one.
        **changes: of the options, one by one.

    Raises:
        EquimusError: for a robot that this verification cannot be repeated with.
    """
    options = with_changes(ValidateOptions, options, changes)
    chosen = plan.QUICK if options.quick else plan.Plan()
    return validation.validate(model or nominal_model(), chosen, options.seed, threads=options.threads, notify=notify)
