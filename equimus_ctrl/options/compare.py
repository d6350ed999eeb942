"""Options of ``compare``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl.options.fields import (
    NAMES,
    at_least,
    check_where,
    counted,
    scheduler_option,
    set_of,
    settings_of,
    slurm_option,
    workers_option,
)
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.scenarios.comparison import Condition
    from equimus_ctrl.types import Controller


@dataclass(frozen=True)
class CompareOptions:
    """How controllers are compared.

    Attributes:
        controllers: names, ``path.py:Name``, controllers, classes or functions; all that are made for it, and can drive
            the robot, by default.
        under: names of ``workflow.comparisons.CONDITIONS``, or conditions; by default the first ones, and with a
            corrected model the last ones too.
        draws: how many perturbed robots.
        scenario_options: of the scenarios, as text.
        settings: controller → its settings file.
        seed: of noise and perturbed robots.
        recordings: folder to look for recordings in.
        workers: processes at a time, one a processor by default. Runs beside each other share the computer's memory and
            clock rate: times of steps are shortest with one.
        scheduler: address of a Dask cluster that does the runs in their place.
        slurm: file that says how jobs of a Slurm cluster are asked for, which do them in their place.

    Raises:
        ConfigError: for a value that cannot be.
    """

    controllers: Sequence[str | Controller | Callable[..., Any]] | None = option(
        None,
        NAMES,
        "By name, file.py:Name, policy.zip or .onnx; repeatable. By default pid, lqr, nmpc, sampling, plugins'.",
        "--controller",
        "-c",
    )
    under: Sequence[str | Condition] | None = option(
        None,
        NAMES,
        "nominal, noisy, delayed, unmodelled_delay, perturbed, corrected or uncorrected; repeatable.",
        "--condition",
        metavar="NAME",
    )
    draws: int = option(3, int, "How many perturbed robots.")
    scenario_options: Mapping[str, str] | None = option(
        None, NAMES, "An option of the scenarios.", "--set", metavar="KEY=VALUE", read=set_of
    )
    settings: Mapping[str, Path] | None = option(
        None, NAMES, "Settings file of a controller (TOML); repeatable.", metavar="NAME=FILE", read=settings_of
    )
    seed: int = option(0, int, "Of noise and perturbed robots.")
    recordings: Path | None = option(
        None, Path | None, "Folder with recordings; $EQUIMUS_RECORDINGS by default.", metavar="DIR"
    )

    workers: int | None = workers_option(
        "Runs at a time, each in a process; one a processor by default. With 1, nothing disturbs the times of steps."
    )
    scheduler: str | None = scheduler_option()
    slurm: Path | None = slurm_option()

    def __post_init__(self) -> None:
        """Check the values."""
        check_where(self.workers, self.scheduler, self.slurm)
        counted("draws", self.draws)
        at_least("seed", self.seed, 0)
