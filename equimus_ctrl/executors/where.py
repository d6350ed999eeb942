"""Where work is done, as one says it: processes of this computer, a Dask cluster, or jobs of a Slurm cluster."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.local import in_threads, on_this_computer
from equimus_ctrl.executors.on_slurm import SlurmSettings


@dataclass(frozen=True)
class Where:
    """Where work is done.

    Attributes:
        workers: processes of this computer; as many as there are usable processors by default.
        scheduler: address of a Dask cluster's scheduler, in their place.
        slurm: how jobs of a Slurm cluster are asked for, in their place.

    Raises:
        ConfigError: for more than one of them.
    """

    workers: int | None = None
    scheduler: str | None = None
    slurm: SlurmSettings | None = None

    def __post_init__(self) -> None:
        given = [name for name in ("workers", "scheduler", "slurm") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ConfigError(f"{' and '.join(given)} are given, expected one: they say where work is done")

    @property
    def here(self) -> bool:
        """Whether that is this computer."""
        return self.scheduler is None and self.slurm is None

    def shared(self, prepare: Prepare | None = None) -> AbstractContextManager[Executor]:
        """The same for work that threads can share where it is done here: they need no copy of what it is about."""
        return in_threads(self.workers) if self.here else self.opened(prepare=prepare)

    def opened(self, tasks: int | None = None, prepare: Prepare | None = None) -> AbstractContextManager[Executor]:
        """What does the work, for the length of a block.

        Args:
            tasks: how many pieces the work has, where it is known.
            prepare: what a process has to do before its first piece, such as to load what a user's files define.

        Raises:
            NotAvailable: where it is not there, or goes away.
        """
        if self.scheduler is not None:
            from equimus_ctrl.executors.on_dask import on_dask

            return on_dask(self.scheduler, prepare)
        if self.slurm is not None:
            from equimus_ctrl.executors.on_slurm import on_slurm

            return on_slurm(self.slurm, prepare)
        return on_this_computer(self.workers, tasks, prepare)
