"""Identification and sensitivity from recordings, for the commands and for users of the library."""

from __future__ import annotations

import fnmatch
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args

import numpy as np

from equimus_ctrl.diagnosis.intervals import longest_interval
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.predict import FREE, ZERO, check_columns
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.identification import sensitivity as sensitivities
from equimus_ctrl.identification.channels import unused, with_channels
from equimus_ctrl.identification.crosscheck import cross_check
from equimus_ctrl.identification.fit import Fit, FitSettings, fit
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import FreeParameters, free_parameters
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.results import Identification, Identified, IdentifiedPoses, Judged, together
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.statics import fit_static, pose_residuals, static_names
from equimus_ctrl.identification.step_error import with_step_error
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import CheckOptions, DiagnoseOptions, IdentifyOptions, SensitivityOptions, with_changes
from equimus_ctrl.recordings import StaticPoses, checks, read_static_poses
from equimus_ctrl.recordings.sheet import header_of
from equimus_ctrl.recordings.upstream import STATIC_POSES, kind
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.mjcf import read_free
from equimus_ctrl.workflow.scores import gather

if TYPE_CHECKING:
    from equimus_ctrl.options import Some

TRIALS_ONLY = ("window", "shoot", "also", "zero_per_trial", "fit_start", "engine", "dt")
"""What poses at rest have no use for."""
REWEIGHTED = 3
"""So often residuals give the weights of a fit with more than joint positions; no digit that is shown changes after."""
FOLD_SHARE = 0.15
"""What a fold of the cross-check takes beside the search, for the share done."""
Measured = Path | str | Recording | StaticPoses
"""A trial, poses at rest, or a file or folder of them."""
Progress = Callable[[str, float, float], None]
"""Called with the stage, the share of the whole that is done, and the best RMSE over all joints so far [rad], nan where
there is none yet."""


def simulator_of(
    engine: str | None,
    dt: float | None = None,
    threads: int | None = None,
    model: Model | None = None,
    trials: Sequence[Recording] = (),
) -> Simulator:
    """The engine by its name: ``reduced`` or ``mujoco``, with a physics step [s] of its own choice by default.

    For a model's robot, by default the nominal leg, and what it did in some trials; see ``engine_for``.

    Raises:
        ConfigError: for another name or a step that is none.
    """
    names = get_args(EngineName)
    if engine is not None and engine not in names:
        raise ConfigError(unknown_name("engine", engine, names))
    positions = [trial.poses for trial in trials]
    chosen = engine_for(model or nominal_model(), cast("EngineName | None", engine), dt, positions)
    return Simulator(chosen, threads)


def choose(trials: Sequence[Recording], patterns: Sequence[str] | None) -> list[Recording]:
    """The trials whose names fit one of some patterns such as ``step_release_p1*``; all where there is no pattern.

    Raises:
        ConfigError: for a pattern that fits none.
    """
    if not patterns:
        return list(trials)
    names = [trial.name for trial in trials]
    for pattern in patterns:
        if not fnmatch.filter(names, pattern):
            raise ConfigError(unknown_name("trial", pattern, names))
    return [trial for trial in trials if any(fnmatch.fnmatchcase(trial.name, pattern) for pattern in patterns)]


def with_free_zeros(trials: Sequence[Recording], joints: Sequence[str]) -> list[Recording]:
    """Trials that say of some joints, by names or patterns, that their sensors' zeros are unknown, see ``free_zeros``.

    Raises:
        ConfigError: for a pattern that fits no joint.
    """
    marked = []
    for trial in trials:
        for pattern in joints:
            if not fnmatch.filter(trial.joints, pattern):
                raise ConfigError(unknown_name("joint", pattern, trial.joints, f"{trial.name}: zero of each trial"))
        chosen = [name for name in trial.joints if any(fnmatch.fnmatchcase(name, p) for p in joints)]
        marked.append(replace(trial, notes={**trial.notes, **{ZERO + name: FREE for name in chosen}}))
    return marked


Free = TypeVar("Free", CheckOptions, DiagnoseOptions, IdentifyOptions)


def marked(model: Model, trials: Sequence[Recording], options: DiagnoseOptions | IdentifyOptions) -> list[Recording]:
    """Trials with notes of what options ask to be compared beside positions, and of unknown zeros.

    Warns of what is recorded and takes no part.
    """
    found = with_channels(with_free_zeros(trials, options.zero_per_trial), options.also)
    if idle := unused(found):
        hint = "" if model.robot.traits.starts_at_rest else "; --also compares vel.* and site.*"
        checks.warn([f"recorded, and not compared with the model: {', '.join(idle)}{hint}"])
    return found


def with_file(options: Free, model: Model) -> Free:
    """Options with what their file of free parameters says in the place of the file.

    Raises:
        ConfigError: where the file says nothing that can be.
    """
    if options.parameters is None:
        return options
    free, bounds = read_free(options.parameters, model).with_more(options.free, options.bounds)
    return replace(options, parameters=None, free=free, bounds=bounds)


def identify_recordings(
    recordings: Some,
    model: Model | None = None,
    options: IdentifyOptions | None = None,
    *,
    progress: Progress = lambda stage, share, best: None,
    **changes: Any,
) -> Identified:
    """Parameters of a model from trials, with intervals, and a k-fold cross-validation over trials.

    Args:
        recordings: files, folders or trials.
        model: where the search starts; the nominal leg by default.
        options: see ``IdentifyOptions``.
        progress: see ``Progress``.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used.
    """
    model = model or nominal_model()
    options = with_file(with_changes(IdentifyOptions, options, changes), model)
    trials = marked(model, choose(gather(recordings, model, options.mapping), options.select), options)
    simulator = simulator_of(options.engine, options.dt, options.threads, model, trials)
    heldout = _each_of(options.heldout)
    others = marked(model, _unseen(gather(heldout, model, options.mapping), trials), options) if heldout else []
    parameters = free_parameters(model, options.free, options.bounds, options.fix)
    in_place = model.robot.traits.held_in_place
    window, shoot, folds, settings = options.window, options.shoot, options.folds, options.settings
    if not in_place:
        shoot = shoot or longest_interval(model, trials, window, simulator).length or math.inf
    segments = cut(model, trials, window=window, shoot=shoot, fit_start=options.fit_start)
    judged = cut(model, others, window=window, shoot=None if in_place else shoot)
    share = _Share(min(folds, len(trials)) if min(folds, len(trials)) > 1 else 0, settings or FitSettings())
    progress("compiling", 0.0, math.nan)
    simulator([model], segments[:1], [segments[0].start[None, :]])
    begun = time.perf_counter()
    progress("search", 0.0, math.nan)
    found = _fitted(
        parameters,
        segments,
        simulator,
        settings,
        lambda evaluations, rmse: progress("search", share.of_search(rmse), rmse),
    )
    best = together(found.rmse)
    searched = time.perf_counter()
    check = cross_check(
        found,
        segments,
        simulator,
        folds,
        settings,
        lambda done: progress("cross-check", share.of_folds(done), best),
    )
    if (step := simulator.engine.discretisation) is not None:
        other = Simulator(simulator.engine.with_finer_step(), options.threads)
        found = with_step_error(found, segments, simulator, other, 1 / step.finer, found.problem.noise)
    checked = time.perf_counter()
    pairs = zip(
        judged, residuals_of(model, judged, simulator), residuals_of(found.model, judged, simulator), strict=True
    )
    nj = len(model.robot.joint_names)
    unseen = tuple(Judged(s.trial.name, before[:, :nj], after[:, :nj], s) for s, before, after in pairs)
    progress("done", 1.0, best)
    took = searched - begun, checked - searched
    return Identified(found, tuple(segments), tuple(trials), check, unseen, simulator.engine, *took)


def _fitted(
    parameters: FreeParameters,
    segments: Sequence[Segment],
    simulator: Simulator,
    settings: FitSettings | None,
    notify: Callable[[int, float], None],
) -> Fit:
    """Least squares; what is compared beside joint positions is weighed as its residuals ask for, as those are."""
    found = first = fit(parameters, segments, simulator=simulator, settings=settings, notify=notify)
    for _ in range(REWEIGHTED if any(s.channels for s in segments) else 0):
        found = fit(
            parameters, segments, simulator=simulator, settings=settings, notify=notify,
            noise=white_noise(found.residuals), begin=[(found.theta, found.starts)],
        )  # fmt: skip
    return replace(found, before=first.before)


class _Share:
    """How much of the work is done: the search counts as one, by how far its gains have come down to the tolerance."""

    def __init__(self, folds: int, settings: FitSettings) -> None:
        self.whole = 1.0 + FOLD_SHARE * folds
        self.tolerance = settings.tolerance
        self.last = math.nan
        self.done = 0.0

    def of_search(self, rmse: float) -> float:
        gain = 1.0 - (rmse / self.last) ** 2 if self.last > 0 else math.nan
        self.last = rmse
        if gain < 1:
            self.done = max(self.done, min(math.log(max(gain, self.tolerance)) / math.log(self.tolerance), 1.0))
        return self.done / self.whole

    def of_folds(self, done: int) -> float:
        return min((1.0 + FOLD_SHARE * done) / self.whole, 1.0)


def _unseen(heldout: Sequence[Recording], used: Sequence[Recording]) -> list[Recording]:
    """The trials held out less those that take part, which a file given for both has."""

    def same(a: Recording, b: Recording) -> bool:
        return np.array_equal(a.time, b.time) and np.array_equal(a.position, b.position)

    left = [trial for trial in heldout if not any(same(trial, other) for other in used)]
    if not left:
        raise ConfigError("every trial held out takes part in the fit too; hold out others, or select fewer to fit")
    return left


def identify_poses(
    poses: Path | str | StaticPoses,
    model: Model | None = None,
    options: IdentifyOptions | None = None,
    *,
    progress: Progress = lambda stage, share, best: None,
    **changes: Any,
) -> IdentifiedPoses:
    """Parameters of a model from poses at rest under known pressures.

    Args:
        poses: the poses or their file.
        model: where the search starts; the nominal leg by default.
        options: see ``IdentifyOptions``; free are by default stiffness, area and rest length of every actuator.
        progress: see ``Progress``.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used, or is for trials.
    """
    model = model or nominal_model()
    options = with_file(with_changes(IdentifyOptions, options, changes), model)
    if options.select:
        raise ConfigError("there is no trial to select from: only poses at rest are given")
    for name in options.given(TRIALS_ONLY):
        raise ConfigError(f"--{name.replace('_', '-')} is for trials, but only poses at rest are given")
    given = _poses_for(model, poses)
    others = [_unseen_poses(_poses_for(model, item), given) for item in _each_of(options.heldout)]
    free = options.free if options.free is not None else static_names(model)
    parameters = free_parameters(model, free, options.bounds, options.fix)
    begun = time.perf_counter()
    progress("poses at rest", 0.0, math.nan)
    found = fit_static(
        parameters,
        given.pressure,
        given.position,
        notify=lambda share: progress("poses at rest", share, math.nan),
    )
    seconds = time.perf_counter() - begun
    judged = tuple(judge_poses(model, found.model, other) for other in others)
    progress("done", 1.0, together(found.rmse))
    return IdentifiedPoses(found, given, judged, seconds)


def judge_poses(before: Model, after: Model, poses: StaticPoses) -> Judged:
    """Two models on poses at rest."""
    first, last = (pose_residuals(model, poses.pressure, poses.position) for model in (before, after))
    return Judged(poses.name, first, last)


def _unseen_poses(heldout: StaticPoses, used: StaticPoses) -> StaticPoses:
    """The poses held out less those that take part."""
    rows = {tuple(row) for row in np.hstack([used.pressure, used.position]).tolist()}
    own = np.hstack([heldout.pressure, heldout.position]).tolist()
    left = np.array([tuple(row) not in rows for row in own], dtype=bool)
    if not left.any():
        raise ConfigError(f"{heldout.name}: every pose held out takes part in the fit too; hold out others")
    return replace(heldout, pressure=heldout.pressure[left], position=heldout.position[left])


def _poses_for(model: Model, poses: Path | str | StaticPoses) -> StaticPoses:
    given = poses if isinstance(poses, StaticPoses) else read_static_poses(Path(poses))
    m = model.morphology
    if (given.joints, given.actuators) != (m.joint_names, m.actuator_names):
        raise ConfigError(
            f"{given.name}: has joints {', '.join(given.joints)} and actuators {', '.join(given.actuators)}, but the "
            f"model {m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
        )
    return given


def identify(
    recordings: Measured | Iterable[Measured],
    model: Model | None = None,
    options: IdentifyOptions | None = None,
    *,
    progress: Progress = lambda stage, share, best: None,
    **changes: Any,
) -> Identification:
    """Parameters of a model from trials, from poses at rest, or from both, with intervals, judged on held-out data.

    Files of poses are recognised by their header. Where both are given the poses come first (stiffness, area and rest
    length, as far as these are free), then the trials, from the model that the poses gave and between the bounds about
    the initial model.

    Args:
        recordings: files, folders of trials, trials or poses.
        model: where the search starts; the nominal leg by default.
        options: see ``IdentifyOptions``.
        progress: see ``Progress``.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used.
    """
    model = model or nominal_model()
    options = with_file(with_changes(IdentifyOptions, options, changes), model)
    sources = _each_of(recordings)
    if not model.robot.traits.held_in_place:  # so poses at rest tell nothing
        return Identification(model, None, identify_recordings(sources, model, options, progress=progress))
    poses, files = _sorted_out(sources)
    judging_files, judging = _sorted_out(_each_of(options.heldout))
    judging_poses = [_poses_for(model, path) for path in judging_files]
    if not files:
        if judging:
            first = judging[0].name if isinstance(judging[0], Recording) else judging[0]
            raise ConfigError(
                f"{first}: trials are held out, but only poses at rest are given, which do not identify damping; "
                "give trials to fit too"
            )
        still = identify_poses(_stacked(poses), model, replace(options, heldout=judging_poses), progress=progress)
        return Identification(model, still, None)
    trials = choose(gather(files, mapping=options.mapping), options.select)
    for trial in trials:
        check_columns(model, trial)
    others = _unseen(gather(judging, mapping=options.mapping), trials) if judging else ()
    if poses:
        judging_poses = [_unseen_poses(p, _stacked(poses)) for p in judging_poses]
    chosen = free_parameters(model, options.free, options.bounds, options.fix)
    limits = {f.name: (f.low, f.high) for f in chosen.free}
    rest = None
    start = model
    if poses:
        seen = [name for name in chosen.names if name in static_names(model)]
        if not seen:
            raise ConfigError(
                f"none of the free parameters ({', '.join(chosen.names)}) is one that poses at rest are for "
                f"({', '.join(static_names(model))}); give the trials alone"
            )
        own = IdentifyOptions(free=seen, bounds={name: limits[name] for name in seen})
        rest = identify_poses(_stacked(poses), model, own, progress=progress)
        start = rest.fit.model
    own = replace(options, free=chosen.names, fix=(), bounds=limits, select=None, heldout=others)
    found = identify_recordings(trials, start, own, progress=progress)
    # Held-out data are judged against the initial model, whatever the poses made of it.
    simulator = simulator_of(options.engine, options.dt, options.threads, model)
    judged = [
        replace(h, before=residuals_of(model, [h.segment], simulator)[0])
        for h in found.heldout
        if h.segment is not None
    ]
    judged += [judge_poses(model, found.fit.model, p) for p in judging_poses]
    return Identification(model, rest, replace(found, heldout=tuple(judged)))


def _each_of(given: Measured | Iterable[Measured]) -> list[Any]:
    """What is given, one or several."""
    return [given] if isinstance(given, Path | str | StaticPoses | Recording) else list(given)


def _sorted_out(given: Sequence[Measured]) -> tuple[list[StaticPoses | Path | str], list[Recording | Path | str]]:
    """(poses and files of them, all others)."""
    poses: list[StaticPoses | Path | str] = []
    others: list[Recording | Path | str] = []
    for own in given:
        if isinstance(own, StaticPoses):
            poses.append(own)
        elif isinstance(own, Recording) or kind(header_of(Path(own))) != STATIC_POSES:
            others.append(own)
        else:
            poses.append(own)
    return poses, others


def _stacked(given: Sequence[StaticPoses | Path | str]) -> StaticPoses:
    read = [own if isinstance(own, StaticPoses) else read_static_poses(Path(own)) for own in given]
    if len(read) == 1:
        return read[0]
    names = "+".join(p.name for p in read)
    return StaticPoses(names, np.vstack([p.pressure for p in read]), np.vstack([p.position for p in read]))


def sensitivity(
    recordings: Some,
    model: Model | None = None,
    options: SensitivityOptions | None = None,
    *,
    progress: Callable[[float], None] = lambda share: None,
    **changes: Any,
) -> sensitivities.Sensitivity:
    """How a model's errors on recordings change with each of its parameters.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        options: see ``SensitivityOptions``.
        progress: called with the share done.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used.
    """
    model = model or nominal_model()
    options = with_changes(SensitivityOptions, options, changes)
    trials = choose(gather(recordings, model, options.mapping), options.select)
    simulator = simulator_of(options.engine, options.dt, options.threads, model, trials)
    segments = cut(model, trials, window=options.window)
    shares = sensitivities.SHARES if options.shares is None else options.shares
    return sensitivities.sensitivity(
        model, segments, patterns=options.parameters, shares=shares, simulator=simulator, notify=progress
    )
