"""Options of ``diagnose``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.fields import (
    NAMES,
    also_option,
    at_least,
    bounds_option,
    counted,
    engine_option,
    mapping_option,
    parameters_option,
    select_option,
    threads_option,
    window_option,
    zero_option,
)
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.engines.base import EngineName
    from equimus_ctrl.options.fields import Bounds, Window
    from equimus_ctrl.recordings import Mapping


GROUPINGS = ("folder",)
"""By what trials may be grouped."""


@dataclass(frozen=True)
class DiagnoseOptions:
    """How a diagnosis is made.

    Attributes:
        free: names or patterns of the parameters to estimate; stiffness, area, rest length and damping by default.
        fix: names or patterns of parameters to keep at their values all the same.
        bounds: (low, high) of some of them.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``; ``free`` adds, ``bounds`` win.
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.
        select: patterns of the names of the trials to use; all by default.
        validation: patterns of the names of trials by which effects are confirmed or rejected; see
            ``diagnosis.holdout.split`` for the default.
        test: patterns of the names of trials whose errors no fit and no choice sees.
        until: of every trial only what comes before this time is fitted; the rest is held out [s].
        window: (from, to) of each trial that counts at all [s].
        shoot: length of multiple-shooting intervals where nothing holds the robot in place [s]; see
            ``diagnosis.intervals.longest_interval``.
        also: names or patterns of recorded columns that are compared beside joint positions: ``vel.*``, ``site.*``,
            ``meas.*``.
        zero_per_trial: names or patterns of joints whose sensors have an unknown zero of their own in each trial.
        most: largest number of effects, 1 to 6.
        exclude: names of effects that are not tried.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        threads: of the simulations; all cores by default.
        budget: how long it may take; its best so far is given then. As long as it needs by default [s].
        by: ``"folder"`` where the trials of each folder are another unit of the robot, or of another day: one model is
            found for all, with what differs between them; None where all are alike.
        splits: how many random halves of the trials are diagnosed, too; see ``diagnosis.random_splits``.
        seed: of the random halves.
        anyway: whether it goes on where an answer would mean nothing, see ``preflight``.

    Raises:
        ConfigError: for a value that cannot be.
    """

    validation: Sequence[str] = option(
        (),
        NAMES,
        "Trials by which effects are confirmed or rejected, by name; every fourth by default, the end of a single one.",
        metavar="PATTERN",
    )
    test: Sequence[str] = option(
        (),
        NAMES,
        "Trials whose errors no fit and no choice sees, by name; by default half of every fourth, from 8 trials on.",
        metavar="PATTERN",
    )
    until: float | None = option(
        None, float | None, "Fit each trial up to this time only; the rest is held out.", metavar="SECONDS"
    )
    mapping: Mapping | Path | None = mapping_option()
    select: Sequence[str] | None = select_option()
    window: Window | None = window_option("Use this part of each trial only, in s.")
    free: Sequence[str] | None = option(
        None,
        NAMES,
        "Parameters to estimate, such as '*.mass', or base_parameters; by default the least certain ones, see list "
        "parameters.",
        metavar="NAME",
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    bounds: Bounds | None = bounds_option()
    parameters: Path | None = parameters_option()
    shoot: float | None = option(
        None,
        float | None,
        "Of an MJCF robot: length of the multiple-shooting intervals, each with a free initial state; by default as "
        "long as the nominal model's predictions stay close.",
        metavar="SECONDS",
    )
    also: Sequence[str] = also_option()
    zero_per_trial: Sequence[str] = zero_option()
    most: int = option(4, int, "Largest number of effects in a hypothesis.")
    exclude: Sequence[str] = option((), NAMES, "Do not try this effect, see list effects.", metavar="EFFECT")
    engine: EngineName | None = engine_option()
    threads: int | None = threads_option()
    budget: float | None = option(
        None,
        float | None,
        "Give the best so far after this time, with what was not tried.",
        metavar="SECONDS",
    )
    by: Literal["folder"] | None = option(
        None,
        str | None,
        "folder: the trials of each folder are another unit of the robot, or of another day; what differs between them "
        "is told.",
        metavar="folder",
    )

    splits: int = option(
        0,
        int,
        "Diagnose so many random halves of the trials, too, and tell on which findings all agree.",
        metavar="COUNT",
    )
    seed: int = option(0, int, "Of the random halves.")
    anyway: bool = option(
        False, bool, "Go on where the recordings cannot give an answer that means anything, see check.", "--anyway"
    )

    def __post_init__(self) -> None:
        """Check the values."""
        if self.by not in (None, *GROUPINGS):
            raise ConfigError(unknown_name("grouping", str(self.by), GROUPINGS, "by"))
        if not 1 <= self.most <= 6:
            raise ConfigError(f"the largest number of effects is {self.most}, expected 1 to 6")
        if self.until is not None and not math.isfinite(self.until):
            raise ConfigError(f"the end of what is fitted is {self.until:g} s, expected a finite time")
        if self.splits and (self.validation or self.until is not None):
            said = "validation" if self.validation else "until"
            raise ConfigError(f"splits are drawn at random, and {said} says what is held out; expected one of both")
        counted("threads", self.threads)
        counted("splits", self.splits, 0)
        at_least("seed", self.seed, 0)
