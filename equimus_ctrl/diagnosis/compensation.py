"""What the other parameters make up for where a part of a hypothesis is left out, to first order."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.types import Array

WEAK = 1e-6
"""Directions of the parameters weaker than this share of the strongest make up for nothing."""


def compensated(data: Data, fitted: Fitted, hypothesis: Hypothesis) -> Array | None:
    """(p,) θ of a hypothesis with some parts less, the others moved so that predictions stay as they are.

    A part that stands for a parameter of another, a constant force for the rest position of a spring, has taken up what
    is missing of that one. Fitted from the present values without it the other would begin far off, and may end in
    another local minimum. With S the derivatives by what stays and s those by the sizes d of what is left out,
    θ ← θ + S⁺ s d.

    Args:
        data: what was measured.
        fitted: the hypothesis with these parts.
        hypothesis: the rest, in its order and with its values.

    Returns:
        None where nothing is left out, where what stays is not as it was, or where no size of a part is nothing.
    """
    kept = {part.candidate.label for part in hypothesis}
    gone = [part for part in fitted.hypothesis if part.candidate.label not in kept]
    stay = [part for part in fitted.hypothesis if part.candidate.label in kept]
    if not gone or stay != list(hypothesis) or not all(part.candidate.fades_to() for part in gone):
        return None
    base = len(data.free.free)
    rows, change = list(range(base)), np.zeros(len(fitted.fit.theta))
    place = base
    for part in fitted.hypothesis:
        own = [parameter.name for parameter in part.candidate.parameters]
        if part.candidate.label in kept:
            rows += range(place, place + len(own))
        else:
            for i, name in enumerate(own):
                if name in part.candidate.fades_to():
                    change[place + i] = part.values[name] - part.candidate.fades_to()[name]
        place += len(own)
    scale = fitted.fit.parameters.scale
    slopes = whiten_fit(data.times, fitted.fit, fitted.noise).slopes
    moved = np.linalg.lstsq(slopes[:, rows], slopes @ (change / scale), rcond=WEAK)[0]
    return np.asarray(fitted.fit.theta[rows] + moved * scale[rows])
