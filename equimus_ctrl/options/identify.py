"""Options of ``identify``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.fields import (
    NAMES,
    also_option,
    bounds_option,
    counted,
    dt_option,
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
    from equimus_ctrl.identification.fit import FitSettings
    from equimus_ctrl.options.fields import Bounds, Some, Window
    from equimus_ctrl.recordings import Mapping, StaticPoses


@dataclass(frozen=True)
class IdentifyOptions:
    """How parameters are identified from trials, poses at rest, or both.

    Attributes:
        free: names or patterns of the parameters to estimate; stiffness, area, rest length and damping by default, of
            poses at rest the first three.
        fix: names or patterns of parameters to keep at their values all the same.
        bounds: (low, high) of some of them.
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.
        select: patterns of the names of the trials to use; all by default.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``; ``free`` adds, ``bounds`` win.
        heldout: held-out files, folders, trials or poses; those that take part in the fit are dropped.
        window: (from, to) of each trial that is compared; all of it by default [s].
        shoot: length of multiple-shooting intervals, each with a free initial state [s].
        also: names or patterns of recorded columns that are compared beside joint positions: ``vel.*``, ``site.*``,
            ``meas.*``.
        zero_per_trial: names or patterns of joints whose sensors have an unknown zero of their own in each trial.
        fit_start: estimate each trial's first angles too, from what was measured: a tenth of a second of measurements
            knows them less well than all of the motion does, and what it does not know would be taken for parameters.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        dt: physics step [s].
        folds: of the k-fold cross-validation; less than two for none.
        threads: all cores by default.
        settings: how it searches.

    Raises:
        ConfigError: for a value that cannot be.
    """

    free: Sequence[str] | None = option(
        None,
        NAMES,
        "Parameters to estimate, such as 'maa.*', or base_parameters; by default the least certain ones.",
        metavar="NAME",
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    bounds: Bounds | None = bounds_option()
    mapping: Mapping | Path | None = mapping_option()
    select: Sequence[str] | None = select_option()
    parameters: Path | None = parameters_option()
    heldout: Some | Sequence[StaticPoses] = option(
        (),
        list[Path] | None,
        "Held-out trials or poses; those that are fitted are dropped.",
        metavar="PATH",
    )
    window: Window | None = window_option("Use this part of each trial only, in s.")
    shoot: float | None = option(
        None, float | None, "Length of multiple-shooting intervals, each with a free initial state.", metavar="SECONDS"
    )
    also: Sequence[str] = also_option()
    zero_per_trial: Sequence[str] = zero_option()
    fit_start: bool = option(
        True,
        bool,
        "Estimate each trial's first angles too (default), or take its first rows'.",
        "--fit-start/--no-fit-start",
    )
    engine: EngineName | None = engine_option()
    dt: float | None = dt_option()
    folds: int = option(4, int, "Of the k-fold cross-validation; 0 for none.")
    threads: int | None = threads_option()
    settings: FitSettings | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.folds < 0:
            raise ConfigError(f"the cross-validation has {self.folds} folds, expected 0 or more")
        counted("threads", self.threads)

    def given(self, names: Iterable[str]) -> list[str]:
        """Those of some fields that have another value than by default."""
        default = type(self)()
        return [name for name in names if getattr(self, name) != getattr(default, name)]
