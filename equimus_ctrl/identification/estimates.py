"""What a fit found, as arrays and tables: covariance of parameters with names and units, residuals over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.frames import dataframe
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import DIVERGED
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.uncertainty import Uncertainty
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.shown import Short, by_name, counted
from equimus_ctrl.types import Array, frozen_array

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(Short):
    """Covariance of estimated parameters, robust to autocorrelated residuals (sandwich estimator, Newey & West 1987).

    A parameter's interval reaches to both sides by ``factor`` standard errors, the roots of the diagonal, and by
    ``step_error`` beside. NumPy takes it as the array ``values``.

    Attributes:
        names: of the parameters.
        units: of each, SI.
        values: (p, p) [products of the units]; inf on the diagonal and nan beside it where a parameter is not
            identifiable from the data.
        factor: quantile of Student's t distribution with the effective number of samples.
        step_error: (p,) by how much the error of the engine's physics step can move each [unit of each parameter].
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    factor: float
    step_error: Array

    def told(self) -> str:
        """How many parameters, and their standard errors."""
        return (
            f" of {counted(len(self.names), 'parameter')}: standard errors {by_name(self.names, self.standard_error)}"
        )

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)

    @property
    def standard_error(self) -> Array:
        """(p,) [unit of each parameter]."""
        return np.asarray(np.sqrt(np.diag(self.values)))

    @property
    def correlation(self) -> Array:
        """(p, p) between the errors of parameters; nan where one is not identifiable, or its error is zero."""
        spread = np.where(np.isfinite(self.standard_error) & (self.standard_error > 0), self.standard_error, np.nan)
        return np.asarray(self.values / np.outer(spread, spread))

    def to_dataframe(self) -> DataFrame:
        """A row and a column for each parameter.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        columns = {name: self.values[:, k] for k, name in enumerate(self.names)}
        return dataframe({"parameter": list(self.names), **columns}, "parameter")


def covariance_of(parameters: FreeParameters, known: Uncertainty) -> Covariance:
    """Of the parameters of a fit.

    Args:
        parameters: what was free.
        known: what the residuals say of them.
    """
    units = tuple(own.unit for own in parameters.free)
    step = np.zeros(len(units)) if known.step_error is None else known.step_error
    return Covariance(tuple(parameters.names), units, frozen_array(known.covariance), known.factor, frozen_array(step))


@dataclass(frozen=True, eq=False, repr=False)
class TrialResiduals(Short):
    """Measured − predicted positions of one trial.

    Attributes:
        name: of the trial.
        time: (m,) of the samples [s].
        values: (m, nj) [rad or m]; nan from where a simulation diverged on.
        joints: names of the columns.
        units: SI, of each.
    """

    name: str
    time: Array
    values: Array
    joints: tuple[str, ...]
    units: tuple[str, ...]

    def told(self) -> str:
        """Length and size."""
        rmse = by_name(self.joints, 1e3 * self.rmse)
        return f" of {self.name!r}: {len(self.time)} samples, RMSE {rmse} m{'/m'.join(dict.fromkeys(self.units))}"

    @property
    def rmse(self) -> Array:
        """(nj,) over the samples that are predicted [rad or m]; nan where none is."""
        known = np.isfinite(self.values)
        squares = np.where(known, self.values, 0.0) ** 2
        count = known.sum(axis=0)
        return np.asarray(np.sqrt(np.where(count > 0, squares.sum(axis=0) / np.maximum(count, 1), np.nan)))

    def to_dataframe(self) -> DataFrame:
        """A row for each sample by its ``time`` [s], a column for each joint.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        return dataframe({"time": self.time, **{j: self.values[:, k] for k, j in enumerate(self.joints)}}, "time")


def residuals_by_trial(
    robot: Robot, segments: Sequence[Segment], residuals: Sequence[Array]
) -> tuple[TrialResiduals, ...]:
    """Residuals of segments, those of one recording one after the other.

    Args:
        robot: whose joints.
        segments: what was measured.
        residuals: for each segment (m, nj + …), of joints first [rad or m].
    """
    nj = len(robot.joint_names)
    parts: dict[tuple[str, int], list[tuple[Array, Array]]] = {}
    for segment, found in zip(segments, residuals, strict=True):
        own = np.array(found[:, :nj])
        own[np.abs(own) >= DIVERGED * segment.scales[:nj]] = np.nan
        parts.setdefault((segment.recording_name, segment.recording), []).append((segment.trial.sample_times, own))
    return tuple(
        TrialResiduals(
            name, frozen_array(np.concatenate([t for t, _ in own])), frozen_array(np.concatenate([v for _, v in own])),
            robot.joint_names, robot.joint_units,
        )
        for (name, _), own in parts.items()
    )  # fmt: skip
