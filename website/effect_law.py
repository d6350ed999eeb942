"""What to draw of an effect's law."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.effects import Effect
from equimus_ctrl.types import Array

POINTS = 241
CHANGED = 1e-6
"""A law depends on an argument where it varies by this share of its size."""


@dataclass(frozen=True, eq=False)
class Law:
    """What to draw of an effect.

    Attributes:
        effect: with parameters.
        shown: what is drawn, a phrase.
        x: (n,) argument [x_unit].
        x_axis: what it is.
        x_unit: SI.
        values: (n,) what there is with the effect [y_unit].
        without: (n,) the same without.
        y_axis: what it is.
        y_unit: SI.
    """

    effect: Effect
    shown: str
    x: Array
    x_axis: str
    x_unit: str
    values: Array
    without: Array
    y_axis: str
    y_unit: str

    @property
    def strength(self) -> float:
        """How far it is from what there is without the effect, in the mean [y_unit]."""
        return float(np.mean(np.abs(self.values - self.without)))


def thinned(found: Law, most: int = POINTS) -> Law:
    """The same with no more points than a small figure shows, jumps kept."""
    if len(found.x) <= most:
        return found
    kept = np.unique(np.linspace(0, len(found.x) - 1, most).round().astype(int))
    jump = np.abs(np.diff(found.values)) > 0.2 * np.ptp(found.values)
    edges = np.flatnonzero(jump)
    kept = np.unique(np.concatenate([kept, edges, edges + 1]))
    return replace(found, x=found.x[kept], values=found.values[kept], without=found.without[kept])
