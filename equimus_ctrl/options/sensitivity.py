"""Options of ``sensitivity``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from equimus_ctrl.options.fields import (
    NAMES,
    counted,
    dt_option,
    engine_option,
    mapping_option,
    select_option,
    shares_of,
    threads_option,
    window_option,
)
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.engines.base import EngineName
    from equimus_ctrl.options.fields import Window
    from equimus_ctrl.recordings import Mapping


@dataclass(frozen=True)
class SensitivityOptions:
    """How it is found which numbers of a model matter to its predictions.

    Attributes:
        parameters: names or patterns; all by default.
        shares: by which each is changed; ``identification.sensitivity.SHARES`` by default.
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.
        select: patterns of the names of the trials to use; all by default.
        window: (from, to) of each trial that is compared; all of it by default [s].
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        dt: physics step [s].
        threads: all cores by default.

    Raises:
        ConfigError: for a value that cannot be.
    """

    parameters: Sequence[str] = option(
        ("*",), NAMES, "Which, such as 'baa.*'; all by default.", "--parameter", metavar="NAME"
    )
    shares: Sequence[float] | None = option(
        None,
        list[float] | None,
        "By how much each is changed; ±1, ±5 and ±10 by default.",
        "--share",
        metavar="PERCENT",
        read=shares_of,
    )
    mapping: Mapping | Path | None = mapping_option()
    select: Sequence[str] | None = select_option()
    window: Window | None = window_option("Use this part of each trial only, in s.")
    engine: EngineName | None = engine_option()
    dt: float | None = dt_option()
    threads: int | None = threads_option()

    def __post_init__(self) -> None:
        """Check the values."""
        counted("threads", self.threads)
