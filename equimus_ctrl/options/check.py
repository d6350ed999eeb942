"""Options of ``check``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.fields import (
    NAMES,
    bounds_option,
    counted,
    engine_option,
    mapping_option,
    parameters_option,
    select_option,
    threads_option,
    window_option,
)
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.engines.base import EngineName
    from equimus_ctrl.options.fields import Bounds, Window
    from equimus_ctrl.recordings import Mapping

BUDGET = 30.0
"""What finding out which effects recordings could show may take [s]."""


@dataclass(frozen=True)
class CheckOptions:
    """How recordings are checked.

    Attributes:
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.
        select: patterns of the names of the trials to use; all by default.
        window: (from, to) of each trial that counts at all [s].
        free: names or patterns of the parameters to estimate; those of ``diagnose`` by default.
        fix: names or patterns of parameters to keep at their values all the same.
        bounds: (low, high) of some of them.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``.
        exclude: names of effects that are not looked at.
        quick: whether signals alone are looked at, without any simulation.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        threads: of the simulations; all cores by default.
        budget: what finding out which effects they could show may take, about [s].

    Raises:
        ConfigError: for a value that cannot be.
    """

    mapping: Mapping | Path | None = mapping_option()
    select: Sequence[str] | None = select_option()
    window: Window | None = window_option("Use this part of each trial only, in s.")
    free: Sequence[str] | None = option(
        None, NAMES, "Parameters to estimate, such as '*.mass'; by default those of diagnose.", metavar="NAME"
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    bounds: Bounds | None = bounds_option()
    parameters: Path | None = parameters_option()
    exclude: Sequence[str] = option((), NAMES, "Do not look at this effect, see list effects.", metavar="EFFECT")
    quick: bool = option(False, bool, "Signals alone, without any simulation.", "--quick")
    engine: EngineName | None = engine_option()
    threads: int | None = threads_option()
    budget: float = option(
        BUDGET, float, "What finding out which effects they could show may take, about.", metavar="SECONDS"
    )

    def __post_init__(self) -> None:
        """Check the values."""
        counted("threads", self.threads)
        if not self.budget > 0:
            raise ConfigError(f"the budget is {self.budget:g} s, expected a time above 0")
