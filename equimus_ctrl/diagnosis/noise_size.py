"""How large the noise is that residuals are judged against: no larger than physics left out of a model can make it."""

from __future__ import annotations

import math

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.identification.noise import LEAST, largest_noise, step_of
from equimus_ctrl.types import Array


def noise_sizes(data: Data, fitted: Fitted) -> Array:
    """(nj + ne,) standard deviation of the noise of each joint or channel [its unit], to judge residuals by.

    max(min(σ, s), q/√12), with σ as a fit estimates it from the residuals it leaves, of which slow ones pass for
    coloured noise; s what their second differences allow, see ``largest_noise``; q the step in which measurements come.
    These are off by up to q/2 and, at rest, for as long as one likes: q/2 is less than twice q/√12. A measurement that
    never changes allows anything. None is less than ``Data.least_noise``.

    Args:
        data: what was fitted; of its thresholds ``noise_bound`` is the level of s, and ``longest_noise`` the longest
            correlation.
        fitted: a hypothesis.
    """
    thresholds = data.thresholds
    largest = largest_noise(data.times, fitted.fit.residuals, thresholds.noise_bound, thresholds.longest_noise)
    measured = np.concatenate([segment.outputs for segment in data.segments])
    steps = np.array([step_of(column) for column in measured.T])
    estimated = np.array([own.sigma for own in fitted.noise])
    allowed = np.where(steps < math.inf, np.maximum(largest, LEAST), math.inf)
    least = np.where(steps < math.inf, steps / math.sqrt(12), 0.0)
    if data.least_noise is not None:
        least = np.maximum(least, data.least_noise)
    return np.asarray(np.maximum(np.minimum(estimated, allowed), least))
