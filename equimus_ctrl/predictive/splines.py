"""Inputs over a horizon as splines: a few knots, evenly spaced from its beginning to its end."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.types import Array

DEGREES = {"zero": 0, "linear": 1, "cubic": 3}
"""What leads from knot to knot: each holds until the next, straight lines, or a cubic spline through all."""


class Spline:
    """Linear in its knots: values at any times are a matrix times their values.

    Args:
        kind: of ``DEGREES``.
        knots: how many.
        length: of the horizon [s].

    Attributes:
        times: (k,) of the knots [s]; those that hold until the next share the horizon evenly.

    Raises:
        ConfigError: for another kind, or too few knots for it.
    """

    def __init__(self, kind: str, knots: int, length: float) -> None:
        if kind not in DEGREES:
            raise ConfigError(unknown_name("spline", kind, DEGREES))
        self._degree = DEGREES[kind]
        if knots < self._degree + 1:
            raise ConfigError(f"knots is {knots}, expected at least {self._degree + 1} for a {kind} spline")
        self._length = length
        intervals = knots if self._degree == 0 else knots - 1
        self.times: Array = np.asarray(np.arange(knots) * (length / intervals), dtype=np.float64)

    def matrix(self, times: Array) -> Array:
        """(m, k) by which the knots' values are those at times (m,), beyond the last knot its own [s]."""
        k = len(self.times)
        inside = np.clip(times, 0.0, self.times[-1])
        if self._degree == 0:
            # Instants that are a knot's by all but rounding are that knot's.
            own = np.searchsorted(self.times, inside + 1e-9 * self._length, side="right") - 1
            return np.asarray(np.eye(k)[own])
        return np.asarray(make_interp_spline(self.times, np.eye(k), self._degree)(inside))
