"""Options of ``autotune-pid``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from equimus_ctrl.options.fields import NAMES, at_least, threads_option
from equimus_ctrl.options.offers import option


@dataclass(frozen=True)
class AutotuneOptions:
    """How the PID is tuned, beside what a study says.

    Attributes:
        scenarios: objectives in place of the study's own, each of the same weight.
        candidates: sets of gains to try in all, in place of the study's number.
        seed: of the search, the ensemble and the noise, in place of the study's.
        output: settings file to write; ``controllers/pid.toml`` by default.
        folder: of the record and the journal; ``tuning/results/<study>`` by default.
        recordings: folder that scenarios may take recordings from; none by default, so that the same command gives the
            same gains whether recordings are at hand or not.
        fresh: do not take up an interrupted run.
        workers: threads; all cores by default.

    Raises:
        ConfigError: for a value that cannot be.
    """

    scenarios: Sequence[str] = option(
        (), NAMES, "Objective in place of the study's own; may be repeated.", "--scenario"
    )
    candidates: int | None = option(None, int | None, "Sets of gains to try in all.")
    seed: int | None = option(None, int | None, "Of the search, the ensemble and the noise.")
    output: Path | None = option(
        None, Path | None, "Settings file to write; controllers/pid.toml by default.", "--output", "-o"
    )
    folder: Path | None = option(
        None, Path | None, "Folder for record, journal and figures; tuning/results/<study> by default.", "--results"
    )
    recordings: Path | None = option(
        None, Path | None, "Folder that scenarios may take recordings from; none by default.", metavar="DIR"
    )
    fresh: bool = option(False, bool, "Start anew instead of going on where a run stopped.", "--fresh")
    workers: int | None = threads_option("Threads; all cores by default.")

    def __post_init__(self) -> None:
        """Check the values; what a study may say is checked as a study's."""
        at_least("workers", self.workers, 1)
