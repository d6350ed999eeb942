"""Options of ``experiment run``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.experiment import DesignOptions
from equimus_ctrl.options.fields import NAMES, also_option, counted
from equimus_ctrl.options.offers import option


@dataclass(frozen=True)
class RunExperimentsOptions(DesignOptions):
    """How experiments go on: how each is designed, how all trials are diagnosed, and how many there are.

    Attributes:
        trials: designed ones, at most.
        seconds: that all trials may last together, the first one too [s]; as long as they need by default.
        free: as of ``DiagnoseOptions``, as are the others.
        fix: the same.
        exclude: the same.
        also: the same.
        validation: the same, and designed trials are fitted whole then; by default what a diagnosis of the recordings
            from before would hold out, and the last quarter of each designed trial.

    Raises:
        ConfigError: for a value that cannot be.
    """

    trials: int = option(3, int, "Designed trials, at most.")
    seconds: float | None = option(None, float | None, "All trials together may last so long, in s.")
    free: Sequence[str] | None = option(
        None, NAMES, "Parameters to estimate; see diagnose, as for --fix and --exclude.", metavar="NAME"
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    exclude: Sequence[str] = option((), NAMES, "Do not try this effect, see list effects.", metavar="EFFECT")
    also: Sequence[str] = also_option()
    validation: Sequence[str] = option(
        (),
        NAMES,
        "Trials by which effects are confirmed or rejected, by name; by default of those from before as diagnose has "
        "it.",
        metavar="PATTERN",
    )

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        counted("trials", self.trials)
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise ConfigError(f"all trials may last {self.seconds:g} s, expected a time above 0")
