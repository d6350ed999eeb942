"""Diagnosis from recordings, for the command and for users of the library."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from equimus_ctrl.diagnosis.budget import Asked, never
from equimus_ctrl.diagnosis.candidates import uncertain
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, Progress, diagnose
from equimus_ctrl.diagnosis.experiment import Design
from equimus_ctrl.diagnosis.holdout import check_settings, split
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.workflow.identify import Some, choose
from equimus_ctrl.workflow.mjcf import read_free
from equimus_ctrl.workflow.runs import load_scenario
from equimus_ctrl.workflow.scores import gather

SWEEPS = {"mean": (10.0, 15.0, 20.0), "amplitude": (4.0, 9.0), "high": (0.5, 2.0, 6.0)}
"""Settings of the scenario ``chirp`` among which an experiment is chosen [kPa, kPa, Hz]."""


def diagnose_recordings(
    recordings: Some,
    model: Model | None = None,
    *,
    free: Sequence[str] | None = None,
    fix: Sequence[str] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    select: Sequence[str] | None = None,
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    until: float | None = None,
    window: tuple[float, float] | None = None,
    shoot: float | None = None,
    parameters: Path | None = None,
    most: int = 3,
    exclude: Sequence[str] = (),
    engine: EngineName | None = None,
    threads: int | None = None,
    budget: float | None = None,
    progress: Progress = lambda stage, share, best: None,
    asked: Asked = never,
) -> Diagnosis:
    """Find what a model leaves out of recordings: where, what, how much, and how sure.

    Args:
        recordings: files, folders or trials.
        model: the nominal leg by default.
        free: names or patterns of what may be wrong about its numbers; stiffness, area, rest length and damping by
            default.
        fix: names or patterns of what is right all the same.
        bounds: (low, high) of some of them.
        select: patterns of the names of the trials to use; all by default.
        validation: patterns of the names of trials by which effects are confirmed or rejected; see
            ``diagnosis.holdout.split`` for the default.
        test: patterns of the names of trials that no fit and no choice sees.
        until: of every trial only what comes before this time is fitted, and the rest judges too [s].
        window: (from, to) of each trial that counts at all [s].
        shoot: length of the windows that trials are cut into where nothing holds the robot in place [s]; see
            ``holdout.window_length``.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``; ``free`` adds, ``bounds`` win.
        most: largest number of effects.
        exclude: names of effects that are not looked for.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        threads: all cores by default.
        budget: how long it may take [s]; its best so far is given then. As long as it needs by default.
        progress: called with the stage, the share done and the best hypothesis so far.
        asked: whether its best so far is to be given now.

    Raises:
        EquimusError: where something given cannot be used.
    """
    model = model or nominal_model()
    if not 1 <= most <= 6:
        raise ConfigError(f"the largest number of effects is {most}, expected 1 to 6")
    if until is not None and not math.isfinite(until):
        raise ConfigError(f"the end of what is fitted is {until:g} s, expected a finite time")
    if shoot is not None and model.robot.traits.held_in_place:
        raise ConfigError("windows to shoot over are for MJCF robots; a leg's trials are fitted whole")
    trials = choose(gather(recordings, model), select)
    if parameters is not None:
        free, bounds = read_free(parameters, model).with_more(free, bounds)
    chosen = uncertain(model, free, bounds, fix)
    parts = split(model, trials, validation=validation, test=test, until=until, window=window, shoot=shoot)
    check_settings(chosen, parts)
    settings = DiagnosisSettings(SearchSettings(most_parts=most), threads, engine, tuple(exclude), budget)
    return diagnose(chosen, parts, settings=settings, designs=sweeps(model), progress=progress, asked=asked)


def sweeps(model: Model) -> list[Design]:
    """Experiments that ``equimus-ctrl run chirp`` can make with a robot; none where its commands are no pressures."""
    designs: list[Design] = []
    if not model.robot.traits.commands_are_pressures:
        return designs
    for values in product(*SWEEPS.values()):
        settings = dict(zip(SWEEPS, values, strict=True))
        options = {key: f"{value:g}" for key, value in settings.items()}
        try:
            scenario = load_scenario("chirp", model.morphology, phase=model.phase, options=options, search=False)
        except EquimusError:  # a robot that these pressures are not for
            continue
        if scenario.commands is not None:
            times, commands = (np.array(part) for part in (scenario.commands.times, scenario.commands.values))
            designs.append(Design("chirp", settings, times, commands))
    return designs
