"""What a fit's numbers are not to be taken for: said before them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import largest_noise
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import joint_rmse
from equimus_ctrl.identification.step_error import step_error
from equimus_ctrl.identification.uncertainty import Uncertainty
from equimus_ctrl.types import Array

LEVEL = 1e-3
"""Probability, for each joint, that noise alone is as large as residuals that are called too large for noise."""
DIAGNOSE = "`equimus-ctrl diagnose` finds out which"


def caveats(found: Fit, recordings: int, judged: bool = False) -> tuple[str, ...]:
    """Sentences on a fit to trials: physics is missing, a bound decides, one trial is few, the data do not tell.

    Residuals are compared with the largest noise that their second differences allow (``noise.largest_noise``), whose
    correlation lasts no longer than a sensor's does. Where they would not be larger without as much as the error of the
    engine's physics step, that may be all that they are: ‖r − c‖ ≥ ‖r‖ − ‖c‖ for residuals r and its error c.

    Args:
        found: the fit.
        recordings: of how many trials.
        judged: whether others judge it.
    """
    joints = found.model.robot.joint_names
    sizes = joint_rmse(found.residuals)[: len(joints)]
    times = [segment.trial.sample_times for segment in found.problem.segments]
    noise = largest_noise(times, found.residuals, LEVEL)[: len(joints)]
    over = sizes / noise
    beyond = [f"{over[k]:.2g} times at the {joints[k]}" for k in np.argsort(-over) if over[k] > 1]
    said = []
    if beyond:
        engine = found.problem.simulator.engine
        counts = engine.discretisation if np.all(sizes - step_error(found)[: len(joints)] <= noise) else None
        why = f", or the physics step of {1e3 * counts.step:.3g} ms is too long (--dt)" if counts else ""
        said.append(
            f"Residuals are larger than noise can be ({', '.join(beyond)}): physics is missing{why}, and these "
            f"parameters make up for it as far as they can. {DIAGNOSE}."
        )
    if recordings == 1 and not judged:
        said.append(
            "From one trial: nothing is held out, and what fits it may predict no other. Give more, or --heldout."
        )
    return (*said, *of_parameters(found.parameters, found.at_bound, found.uncertainty, bool(beyond)))


def of_parameters(
    parameters: FreeParameters, at_bound: Array, known: Uncertainty, missing: bool = True
) -> tuple[str, ...]:
    """The same of parameters that ended at a bound, or that are not known to within their bounds.

    Args:
        parameters: what was free.
        at_bound: (p,) −1, 0, 1.
        known: intervals.
        missing: whether physics is, or may be, missing.
    """
    free, width, said = parameters.free, known.half_width, []
    wide = [f.name for f, w in zip(free, width, strict=True) if not 2 * w < f.high - f.low]
    held = [f.name for f, side in zip(free, at_bound, strict=True) if side and (missing or f.name not in wide)]
    count = len(free)
    if held:
        why = f"they may compensate missing physics. {DIAGNOSE}" if missing else "they would go on beyond it"
        said.append(f"{_of(held, count)} on a bound ({', '.join(held)}): {why}.")
    if wide:
        what = "are" if len(wide) > 1 else "is"
        said.append(
            f"{len(wide)} of {count} parameters {what} known no better from these data than from the bounds "
            f"({', '.join(wide)}): keep such a one by --fix, or record motions that show it."
        )
    return tuple(said)


def _of(names: Sequence[str], count: int) -> str:
    return f"{len(names)} of {count} parameters {'lie' if len(names) > 1 else 'lies'}"
