"""What an identification found, for figures, for people and as plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.frames import dataframe
from equimus_ctrl.identification.caveats import caveats, of_parameters
from equimus_ctrl.identification.crosscheck import CrossCheck
from equimus_ctrl.identification.estimates import (
    Covariance,
    TrialResiduals,
    covariance_of,
    residuals_by_trial,
)
from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import Noise, white_noise
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.residuals import joint_rmse
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.statics import StaticFit
from equimus_ctrl.identification.uncertainty import TradeOff, Uncertainty
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.recordings import StaticPoses
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.shown import Short, by_name, counted, listed
from equimus_ctrl.types import Array, Recording

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "equimus-ctrl/identification/1"
STATES = ("initial", "identified")
"""Of the model, before and after."""


@dataclass(frozen=True, eq=False, repr=False)
class Judged(Short):
    """Something held out that the model is judged on.

    Attributes:
        name: of the trial or the poses.
        before: (m, nj) measured − predicted by the initial model [rad].
        after: (m, nj) the same by the model identified [rad].
        segment: the trial, or None where it is poses at rest.
    """

    name: str
    before: Array
    after: Array
    segment: Segment | None = None

    def to_dict(self, joints: Sequence[str]) -> dict[str, Any]:
        """As JSON data."""
        rows = joint_rmse([self.before]), joint_rmse([self.after])
        what = "poses" if self.segment is None else "trial"
        return {what: self.name, "before": _by_joint(joints, rows[0]), "after": _by_joint(joints, rows[1])}


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Short):
    """Parameters found from trials.

    Attributes:
        fit: what was found.
        segments: what it was found from.
        recordings: the trials.
        check: errors on held-out trials (k-fold cross-validation), or None where there was one trial only.
        heldout: trials that took no part at all.
        engine: that simulated.
        seconds: how long the search took.
        check_seconds: how long the cross-check took.
    """

    fit: Fit
    segments: tuple[Segment, ...]
    recordings: tuple[Recording, ...]
    check: CrossCheck | None
    heldout: tuple[Judged, ...]
    engine: Engine
    seconds: float
    check_seconds: float

    def told(self) -> str:
        """Errors before and after."""
        found, joints = self.fit, self.fit.model.robot.joint_names
        before, after = (by_name(joints, 1e3 * rmse) for rmse in (found.rmse_before, found.rmse))
        return (
            f" of {listed(found.parameters.names, 'parameter')} of {found.model.name} from "
            f"{counted(len(self.recordings), 'trial')}: RMSE {before} → {after} {small_units(found.model.robot)}"
        )

    @property
    def covariance(self) -> Covariance:
        """Of the parameters, with their names and units; as wide as the intervals."""
        return covariance_of(self.fit.parameters, self.fit.uncertainty)

    def trial_residuals(self, state: str = "identified") -> tuple[TrialResiduals, ...]:
        """Measured − predicted with times, of each trial fitted and then of each held out.

        Args:
            state: of the model, ``"identified"`` or ``"initial"``.

        Raises:
            ConfigError: for another state.
        """
        if state not in STATES:
            raise ConfigError(unknown_name("state of the model", state, STATES))
        robot, identified = self.fit.model.robot, state == "identified"
        fitted = residuals_by_trial(robot, self.segments, self.fit.residuals if identified else self.fit.before)
        pairs = [(own.segment, own.after if identified else own.before) for own in self.heldout if own.segment]
        return (*fitted, *residuals_by_trial(robot, [s for s, _ in pairs], [r for _, r in pairs]))

    def to_dataframe(self) -> DataFrame:
        """A row for each parameter: value, interval, bounds.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        found = self.fit
        return parameter_frame(found.parameters, found.theta, found.uncertainty, found.at_bound)

    @cached_property
    def caveats(self) -> tuple[str, ...]:
        """What the numbers are not to be taken for, see ``identification.caveats``."""
        return caveats(self.fit, len(self.recordings), bool(self.heldout))

    @property
    def channels(self) -> tuple[FittedChannel, ...]:
        """What was compared beside the joints' positions, before and after."""
        return fitted_channels(self.fit, white_noise(self.fit.residuals), self.fit.before)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; angles in rad, and null where an interval has no end."""
        found, joints = self.fit, self.fit.model.robot.joint_names
        data: dict[str, Any] = {
            "engine": self.engine.name,
            "engine_reason": self.engine.reason,
            "trials": [r.name for r in self.recordings],
            "samples": int(sum(len(r) for r in found.residuals)),
            "converged": found.converged,
            "evaluations": found.evaluations,
            "seconds": self.seconds,
            "rmse_rad": _before_and_after(joints, found.rmse_before, found.rmse),
            "parameters": parameter_rows(found.parameters, found.theta, found.uncertainty, found.at_bound),
            "caveats": list(self.caveats),
            "channels": [asdict(channel) for channel in self.channels],
            "zeros": [asdict(zero) for zero in found.zeros],
            "trade_offs": [_trade(t) for t in found.uncertainty.trade_offs],
            "effective_samples": found.uncertainty.effective_samples,
            "cross_check": None,
            "heldout": [judged.to_dict(joints) for judged in self.heldout],
            "heldout_rmse_rad": None,
        }
        if self.check is not None:
            data["cross_check"] = {
                "folds": self.check.folds,
                "seconds": self.check_seconds,
                "rmse_rad": _before_and_after(joints, self.check.rmse_before, self.check.rmse),
            }
        if self.heldout:
            before, after = (joint_rmse([getattr(h, key) for h in self.heldout]) for key in ("before", "after"))
            data["heldout_rmse_rad"] = _before_and_after(joints, before, after)
        return data


@dataclass(frozen=True)
class FittedChannel:
    """Something that is compared beside the joints' positions, such as a recorded velocity.

    Attributes:
        name: of its column.
        unit: of what follows.
        noise: standard deviation of its noise.
        before: RMSE of the model that the fitted one is set against.
        rmse: of the fitted one.
    """

    name: str
    unit: str
    noise: float
    before: float
    rmse: float


def fitted_channels(found: Fit, noise: Noise, before: Sequence[Array]) -> tuple[FittedChannel, ...]:
    """What a fit compared beside the joints' positions; all of its recordings have the same.

    Args:
        found: the fit.
        noise: of joints and channels.
        before: for each segment (m, nj + ne) residuals of the model that it is set against.
    """
    robot, channels = found.model.robot, found.problem.segments[0].channels
    names, units, nj = channels.names(robot), channels.units(robot), len(robot.joint_names)
    before, after = (joint_rmse(values)[nj:].tolist() for values in (before, found.residuals))
    rows = zip(names, units, noise[nj:], before, after, strict=True)
    return tuple(FittedChannel(name, unit, own.sigma, *rmse) for name, unit, own, *rmse in rows)


def zeros_sentence(found: Fit) -> str:
    """What the sensors' unknown zeros came to, for a person; empty where there are none."""
    said = [f"{zero.recording} {zero.joint} {zero.value:+.4g} {zero.unit}" for zero in found.zeros]
    return f"Zeros of the sensors (what they show too much): {', '.join(said)}." if said else ""


def small_units(robot: Robot) -> str:
    """Thousandths of the units of a robot's joints, such as ``mrad`` or ``mrad or mm``."""
    return " or ".join(f"m{unit}" for unit in dict.fromkeys(robot.joint_units))


def together(rmse: Array) -> float:
    """Root mean square over all joints of a root mean square of each."""
    return float(np.sqrt(np.mean(rmse**2)))


def _by_joint(joints: Sequence[str], values: Array) -> dict[str, float]:
    return {joint: float(v) for joint, v in zip(joints, values, strict=True)}


def _before_and_after(joints: Sequence[str], before: Array, after: Array) -> dict[str, Any]:
    return {
        "before": _by_joint(joints, before),
        "after": _by_joint(joints, after),
        "before_together": together(before),
        "after_together": together(after),
    }


def _trade(trade: TradeOff) -> dict[str, Any]:
    return {"parameters": trade.weights, "correlation": trade.correlation}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def parameter_rows(
    parameters: FreeParameters, theta: Array, known: Uncertainty, at_bound: Array
) -> list[dict[str, Any]]:
    """One table row for each parameter, intervals without an end as None."""
    rows = []
    for i, free in enumerate(parameters.free):
        rows.append(
            {
                "name": free.name,
                "unit": free.unit,
                "start": free.start,
                "value": float(theta[i]),
                "low": _finite(theta[i] - known.half_width[i]),
                "high": _finite(theta[i] + known.half_width[i]),
                "bounds": [free.low, free.high],
                "at_bound": {-1: "low", 0: None, 1: "high"}[int(at_bound[i])],
            }
        )
    return rows


def parameter_frame(parameters: FreeParameters, theta: Array, known: Uncertainty, at_bound: Array) -> DataFrame:
    """``parameter_rows`` as a data frame, an end of an interval that is none as infinity.

    Raises:
        NotAvailable: where pandas is not installed.
    """
    rows = []
    for row in parameter_rows(parameters, theta, known, at_bound):
        least, most = row.pop("bounds")
        low, high = (math.inf * sign if row[key] is None else row[key] for key, sign in (("low", -1), ("high", 1)))
        rows.append({**row, "low": low, "high": high, "least": least, "most": most})
    return dataframe(rows, "name")


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedPoses(Short):
    """Parameters found from poses at rest.

    Attributes:
        fit: what was found.
        poses: what it was found from.
        heldout: poses that took no part.
        seconds: how long it took.
    """

    fit: StaticFit
    poses: StaticPoses
    heldout: tuple[Judged, ...]
    seconds: float

    def told(self) -> str:
        """Errors before and after."""
        found, joints = self.fit, self.fit.model.robot.joint_names
        before, after = (by_name(joints, 1e3 * joint_rmse([own])) for own in (found.before, found.residuals))
        return (
            f" of {listed(found.parameters.names, 'parameter')} of {found.model.name} from "
            f"{counted(len(self.poses.pressure), 'pose')} at rest: RMSE {before} → {after} mrad"
        )

    @property
    def covariance(self) -> Covariance:
        """Of the parameters, with their names and units; as wide as the intervals."""
        return covariance_of(self.fit.parameters, self.fit.uncertainty)

    def to_dataframe(self) -> DataFrame:
        """A row for each parameter: value, interval, bounds.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        found = self.fit
        return parameter_frame(found.parameters, found.theta, found.uncertainty, found.at_bound)

    @property
    def caveats(self) -> tuple[str, ...]:
        """What the numbers are not to be taken for."""
        return of_parameters(self.fit.parameters, self.fit.at_bound, self.fit.uncertainty)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; angles in rad, pressures in Pa."""
        found = self.fit
        m = found.model.morphology
        before, after, heldout = (joint_rmse([r]) for r in (found.before, found.residuals, found.heldout))
        loose = np.isfinite(found.pressure_error).all(axis=1)
        pressure = found.pressure_error[loose]
        return {
            "poses": len(self.poses.pressure),
            "name": self.poses.name,
            "seconds": self.seconds,
            "rmse_rad": _before_and_after(m.joint_names, before, after),
            "parameters": parameter_rows(found.parameters, found.theta, found.uncertainty, found.at_bound),
            "caveats": list(self.caveats),
            "trade_offs": [_trade(t) for t in found.uncertainty.trade_offs],
            "effective_samples": found.uncertainty.effective_samples,
            "cross_check": {
                "folds": found.folds,
                "rmse_rad": _before_and_after(m.joint_names, before, heldout),
            },
            "loose_poses": int(loose.sum()),
            "pressure_rmse_pa": _by_joint(m.actuator_names, joint_rmse([pressure])) if loose.any() else None,
            "heldout": [judged.to_dict(m.joint_names) for judged in self.heldout],
        }


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Short):
    """Identification from poses at rest, then from trials beginning at the model that the poses gave.

    Attributes:
        start: the initial model.
        poses: result of the poses at rest, or None where there were none.
        trials: result of the trials, or None where there were none.
    """

    start: Model
    poses: IdentifiedPoses | None
    trials: Identified | None

    @property
    def last(self) -> Identified | IdentifiedPoses:
        """What the model is from: the trials, or the poses where there were none."""
        last = self.trials or self.poses
        assert last is not None  # whoever identifies has data
        return last

    @property
    def model(self) -> Model:
        """The model identified."""
        return self.last.fit.model

    @property
    def covariance(self) -> Covariance:
        """Of the parameters that were found last, with their names and units."""
        return self.last.covariance

    def trial_residuals(self, state: str = "identified") -> tuple[TrialResiduals, ...]:
        """Measured − predicted with times, of each trial; none where only poses at rest were given.

        Args:
            state: of the model, ``"identified"`` or ``"initial"``: where the trials' search began.

        Raises:
            ConfigError: for another state.
        """
        return () if self.trials is None else self.trials.trial_residuals(state)

    def to_dataframe(self) -> DataFrame:
        """A row for each parameter that was found last: value, interval, bounds.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        return self.last.to_dataframe()

    def told(self) -> str:
        """As of what was found last."""
        return self.last.told()

    def to_dict(self) -> dict[str, Any]:
        """As JSON data: null for a part that was not done."""
        return {
            "schema": SCHEMA,
            "start": self.start.name,
            "poses": None if self.poses is None else self.poses.to_dict(),
            "trials": None if self.trials is None else self.trials.to_dict(),
            "model": model_to_dict(self.model),
        }
