"""Models against recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.predict import check_columns, predict
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.frames import dataframe
from equimus_ctrl.identification.estimates import TrialResiduals
from equimus_ctrl.identification.residuals import followed
from equimus_ctrl.identification.results import small_units
from equimus_ctrl.identification.segments import LEAST_SAMPLES, cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.augmented import unknown_starts
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import ScoreOptions, with_changes
from equimus_ctrl.options.score import StartName
from equimus_ctrl.recordings import LEG, Mapping, read_set
from equimus_ctrl.scenarios.scoring import on_grid
from equimus_ctrl.shown import Short, by_name, counted
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow.mjcf import as_modelled, mapping_of, read_trials

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False, repr=False)
class TrialScore(Short):
    """How far a model's prediction lies from one trial.

    Attributes:
        recording: the trial.
        predicted: (n, nj) at the trial's times [rad or m].
        rmse: (nj,) over the scored samples [rad or m].
        squares: (nj,) sum of squared errors over them [rad² or m²].
        samples: how many.
        start: how it begins, see ``ScoreOptions``; measured where it has too few rows to fit a start to.
    """

    recording: Recording
    predicted: Array
    rmse: Array
    squares: Array
    samples: int
    start: StartName

    def told(self) -> str:
        """The trial and its error."""
        error = by_name(self.recording.joints, 1e3 * self.rmse)
        return f" {self.recording.name!r}: RMSE {error} thousandths of rad or m, {self.start} start"

    @property
    def residuals(self) -> Array:
        """(n, nj) measured − predicted at the trial's times [rad or m]."""
        return np.asarray(self.recording.position - self.predicted)

    def to_dataframe(self) -> DataFrame:
        """A row for each sample by its ``time`` [s]: measured ``pos.*``, ``predicted.*``, ``residual.*``.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        kinds = (("pos", self.recording.position), ("predicted", self.predicted), ("residual", self.residuals))
        columns = {
            f"{kind}.{joint}": values[:, k] for kind, values in kinds for k, joint in enumerate(self.recording.joints)
        }
        return dataframe({"time": self.recording.time, **columns}, "time")


@dataclass(frozen=True, eq=False, repr=False)
class RecordingsScore(Short):
    """A model against recordings.

    Attributes:
        model: the model.
        trials: one score each.
        rmse: (nj,) over all samples of all trials [rad or m].
        engine: that predicted.
        start: how trials begin, see ``ScoreOptions``.
    """

    model: Model
    trials: tuple[TrialScore, ...]
    rmse: Array
    engine: Engine
    start: StartName

    def told(self) -> str:
        """How many trials, and the error."""
        error = by_name(self.model.robot.joint_names, 1e3 * self.rmse)
        return (
            f" of {self.model.name} on {counted(len(self.trials), 'trial')}: RMSE {error} "
            f"{small_units(self.model.robot)}, {self.start} starts"
        )

    def trial_residuals(self) -> tuple[TrialResiduals, ...]:
        """Measured − predicted with times, of each trial, all its rows."""
        robot = self.model.robot
        return tuple(
            TrialResiduals(own.recording.name, own.recording.time, own.residuals, robot.joint_names, robot.joint_units)
            for own in self.trials
        )

    def to_dataframe(self) -> DataFrame:
        """A row for each trial: RMSE of each joint [rad or m] and how many samples are scored.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        joints = self.model.robot.joint_names
        rows = [
            {"trial": t.recording.name, **dict(zip(joints, t.rmse.tolist(), strict=True)), "samples": t.samples}
            for t in self.trials
        ]
        return dataframe(rows, "trial")

    def to_dict(self) -> dict[str, Any]:
        """What ``score --json`` prints."""
        joints = self.model.robot.joint_names

        def table(values: Array) -> dict[str, float]:
            return {joint: float(value) for joint, value in zip(joints, values, strict=True)}

        return {
            "model": self.model.name,
            "engine": self.engine.to_dict(),
            "start": self.start,
            "rmse_rad": table(self.rmse),
            "trials": [{"name": t.recording.name, "start": t.start, "rmse_rad": table(t.rmse)} for t in self.trials],
        }


def gather(
    recordings: Path | str | Iterable[Path | str | Recording],
    model: Model | None = None,
    mapping: Mapping | Path | str | None = None,
    rotating: Sequence[str] = (),
) -> list[Recording]:
    """The trials that files, folders or trials themselves mean.

    Args:
        recordings: they.
        model: of what; its joints and actuators are those wanted.
        mapping: what the columns of files of other formats than the project's are, or its file.
        rotating: joints that turn without end, so that no angle of theirs is odd.

    Raises:
        EquimusError: where one cannot be read.
    """
    given = [recordings] if isinstance(recordings, Path | str) else list(recordings)
    files = [Path(item) for item in given if isinstance(item, Path | str)]
    trials = [item for item in given if isinstance(item, Recording)]
    if files or not trials:
        own = mapping_of(mapping)
        limits = replace(LEG, rotating=tuple(rotating))
        trials += (
            read_set(files, mapping=own, limits=limits)
            if model is None
            else read_trials(files, model.robot, own, rotating)
        )
    return trials if model is None else [as_modelled(trial, model.robot) for trial in trials]


def score(
    recordings: Path | str | Iterable[Path | str | Recording],
    model: Model | None = None,
    options: ScoreOptions | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **changes: Any,
) -> RecordingsScore:
    """Open-loop prediction error of a model, each trial whole, from a start of its own, see ``ScoreOptions``.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        options: see ``ScoreOptions``.
        progress: called with the share done.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where a recording or the model cannot be used, a simulation diverges, or a window holds no
            samples.
    """
    model = model or nominal_model()
    options = with_changes(ScoreOptions, options, changes)
    trials = gather(recordings, model, options.mapping)
    for trial in trials:
        check_columns(model, trial)
    scores = []
    chosen = engine_for(model, options.engine, positions=[trial.poses for trial in trials])
    start: StartName = options.start or ("measured" if model.robot.traits.starts_at_rest else "fitted")
    for k, trial in enumerate(trials):
        own: StartName = start if len(trial.time) >= LEAST_SAMPLES else "measured"
        predicted = (_from_fitted_start if own == "fitted" else _from_measured_start)(model, trial, chosen)
        error = _scored_error(trial, predicted, options.window, options.rate)
        squares = (error**2).sum(axis=0)
        scores.append(TrialScore(trial, predicted, np.sqrt(squares / len(error)), squares, len(error), own))
        if progress is not None:
            progress((k + 1) / len(trials))
    total = sum(s.samples for s in scores)
    rmse = np.sqrt(np.sum([s.squares for s in scores], axis=0) / total)
    return RecordingsScore(model, tuple(scores), rmse, chosen, start)


def _from_measured_start(model: Model, trial: Recording, engine: Engine) -> Array:
    return predict(model, trial, engine=engine.name)


def _from_fitted_start(model: Model, trial: Recording, engine: Engine) -> Array:
    """(n, nj) positions at the trial's times, from the start that predicts them best."""
    simulator = Simulator(engine)
    segments = [replace(segment, may_remember=True) for segment in cut(model, [trial], from_first_row=True)]
    (start,), _ = followed(model, segments, simulator)
    (found,) = simulator([model], [segments[0].with_unknown(unknown_starts(model.effects))], [start[None, :]])
    if (reached := int(found.reached[0])) < len(trial.time):
        raise SimulationDiverged(
            f"{trial.name}: the simulation of {model.name} diverged at {trial.time[reached]:.3f} s"
        )
    return np.asarray(found.position[0][:, : len(trial.joints)])


def _scored_error(trial: Recording, predicted: Array, window: tuple[float, float] | None, rate: float | None) -> Array:
    low, high = window or (float(trial.time[0]), float(trial.time[-1]))
    if rate is None:
        inside = (trial.time >= low) & (trial.time <= high)
        error = predicted[inside] - trial.position[inside]
    else:
        low, high = max(low, float(trial.time[0])), min(high, float(trial.time[-1]))
        grid = low + np.arange(max(int(np.floor((high - low) * rate + 1e-9)) + 1, 0)) / rate
        error = on_grid(trial.time, predicted, grid) - on_grid(trial.time, trial.position, grid)
    if len(error) == 0:
        raise ConfigError(
            f"{trial.name}: has no samples between {low:g} and {high:g} s; it lasts from {trial.time[0]:g} to "
            f"{trial.time[-1]:g} s"
        )
    return np.asarray(error, dtype=np.float64)
