"""Options of ``autotune``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.fields import NAMES, check_where, scheduler_option, slurm_option, workers_option
from equimus_ctrl.options.offers import option


@dataclass(frozen=True)
class AutotuneOptions:
    """How a controller is tuned, beside what a study says.

    Attributes:
        scenarios: objectives in place of the study's own, each of the same weight.
        candidates: sets of numbers to try in all, in place of the study's number.
        seed: of the search, the ensemble and the noise, in place of the study's.
        output: settings file to write; the controller's own in ``controllers/`` by default, where there is none yet.
            They are also written into ``folder``.
        folder: of the record and the journal; ``tuning/results/<study>`` by default, numbered where that holds another
            tuning.
        recordings: folder that scenarios may take recordings from; none by default, so that the same command gives the
            same gains whether recordings are at hand or not.
        fresh: do not take up an interrupted run.
        force: replace settings that are there already, and the results of another tuning in ``folder``.
        workers: threads or processes; all cores by default.
        scheduler: address of a Dask cluster that tries the candidates in their place.
        slurm: file that says how jobs of a Slurm cluster are asked for, which try them in their place.
        budget: the search gives its best so far after this time; as long as its candidates take by default [s].

    Raises:
        ConfigError: for a value that cannot be.
    """

    scenarios: Sequence[str] = option(
        (), NAMES, "Objective in place of the study's own; may be repeated.", "--scenario"
    )
    candidates: int | None = option(None, int | None, "Sets of numbers to try in all.")
    seed: int | None = option(None, int | None, "Of the search, the ensemble and the noise.")
    output: Path | None = option(
        None,
        Path | None,
        "Settings file to write; by default controllers/<controller>.toml, if there is none.",
        "--output",
        "-o",
    )
    folder: Path | None = option(
        None, Path | None, "Folder for record, journal and figures; tuning/results/<study> by default.", "--results"
    )
    recordings: Path | None = option(
        None, Path | None, "Folder that scenarios may take recordings from; none by default.", metavar="DIR"
    )
    fresh: bool = option(False, bool, "Start anew instead of going on where a run stopped.", "--fresh")
    force: bool = option(False, bool, "Replace settings that are there already.", "--force")
    workers: int | None = workers_option("Threads or processes; all cores by default.")
    scheduler: str | None = scheduler_option()
    slurm: Path | None = slurm_option()
    budget: float | None = option(
        None,
        float | None,
        "Give the best so far after this time; the same command with more goes on from there.",
        metavar="SECONDS",
    )

    def __post_init__(self) -> None:
        """Check the values; what a study may say is checked as a study's."""
        check_where(self.workers, self.scheduler, self.slurm)
        if self.budget is not None and not 0 < self.budget < math.inf:
            raise ConfigError(f"the budget is {self.budget:g} s, expected more than 0")
