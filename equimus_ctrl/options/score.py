"""Options of ``score``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.fields import engine_option, mapping_option, window_option
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.engines.base import EngineName
    from equimus_ctrl.options.fields import Window
    from equimus_ctrl.recordings import Mapping

StartName = Literal["fitted", "measured"]

MOST_RATE = 1e5
"""Of the grid that predictions are compared on [Hz]; nothing is recorded faster."""


@dataclass(frozen=True)
class ScoreOptions:
    """How a model is judged by recordings, open loop.

    Attributes:
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.
        window: (from, to) of each trial that counts; all of it by default [s].
        rate: of a grid to compare on; the recording's own rows by default [Hz].
        start: ``"measured"``, each trial begins as its first rows show, or ``"fitted"``, as predicts it best: by least
            squares over positions and velocities, as in ``diagnose``. Of a robot that starts at rest positions are
            measured in either case, and what effects with a memory begin with is fitted. By default ``"fitted"`` where
            a robot may begin in motion, for velocities of noisy positions decide more than the model does.

    Raises:
        ConfigError: for a value that cannot be.
    """

    engine: EngineName | None = engine_option()
    mapping: Mapping | Path | None = mapping_option()
    window: Window | None = window_option("Score this part of each trial, in s.")
    rate: float | None = option(
        None, float | None, "Compare on a grid of this rate, in Hz; at the recorded rows by default."
    )

    start: StartName | None = option(
        None,
        str | None,
        "fitted (as predicts a trial best, like diagnose) or measured (as its first rows show); by default measured "
        "where a robot starts at rest, else fitted.",
        metavar="fitted|measured",
    )

    def __post_init__(self) -> None:
        """Check the values."""
        if self.start is not None and self.start not in get_args(StartName):
            raise ConfigError(unknown_name("start", self.start, get_args(StartName)))
        if self.rate is not None and not 0 < self.rate <= MOST_RATE:
            raise ConfigError(
                f"the rate of the grid is {self.rate:g} Hz, expected more than 0 and at most {MOST_RATE:g}"
            )
