"""Where a verb's work is done, from its options."""

from __future__ import annotations

from pathlib import Path

from equimus_ctrl import outputs, presets
from equimus_ctrl.executors.on_slurm import slurm_settings
from equimus_ctrl.executors.where import Where


def where_of(workers: int | None = None, scheduler: str | None = None, slurm: Path | None = None) -> Where:
    """Where work is done.

    Args:
        workers: processes of this computer.
        scheduler: address of a Dask scheduler.
        slurm: a file for ``executors.on_slurm.slurm_settings``. Beside it is a folder for the jobs as long as they run.

    Raises:
        ConfigError: for a file that cannot be read, says what is unknown, or beside which no folder can be made.
        NotAvailable: where submitit is wanted and not installed.
    """
    if slurm is None:
        return Where(workers, scheduler)
    table = presets.read_toml(slurm)
    slurm_settings(table, slurm.parent, presets.shown(slurm))  # before a folder is made
    folder = outputs.new_folder(slurm.absolute().parent / f"{slurm.stem}-spool")
    return Where(workers, scheduler, slurm_settings(table, folder, presets.shown(slurm)))
