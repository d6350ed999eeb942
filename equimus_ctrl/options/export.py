"""Options of ``export``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.fields import NAMES
from equimus_ctrl.options.offers import option

LEAST_STEP, MOST_STEP = 1e-5, 0.05
"""Between what a physics step of a file can be [s]."""


@dataclass(frozen=True)
class ExportOptions:
    """How a model is written for another program.

    Attributes:
        leave_out: effects that are not written, each a name or ``NAME@PLACE``.
        timestep: physics step of the file; the XML's own by default, of a robot with elastic actuators 2 ms, or less
            where its stops ask for that [s].
        force: whether a file that is there is replaced.

    Raises:
        ConfigError: for a value that cannot be.
    """

    leave_out: Sequence[str] = option(
        (),
        NAMES,
        "Leave out an effect that the format cannot hold, such as 'backlash' or 'backlash@knee'; repeatable.",
        metavar="EFFECT[@PLACE]",
    )
    timestep: float | None = option(
        None,
        float | None,
        "Physics step of the file, in s; the XML's own by default, of a robot with elastic actuators 0.002, or less "
        "where its stops ask for that.",
    )
    force: bool = option(False, bool, "Replace the file where it is there already; else it is refused.", "--force")

    def __post_init__(self) -> None:
        """Check the values."""
        if self.timestep is not None and not LEAST_STEP <= self.timestep <= MOST_STEP:
            raise ConfigError(f"the physics step is {self.timestep:g} s, expected {LEAST_STEP:g} to {MOST_STEP:g}")
