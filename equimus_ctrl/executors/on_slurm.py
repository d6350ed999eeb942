"""Work in jobs of a Slurm cluster, which submitit submits; pieces pass through a folder, see ``spool``."""

from __future__ import annotations

import itertools
import json
import pickle
import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, InvalidStateError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import ConfigError, NotAvailable, one_line, unknown_name
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.calls import Call, Gone
from equimus_ctrl.executors.spool import (
    ATTEMPTS,
    LOOKED_EVERY,
    name_of,
    numbers_in,
    others_rename,
    put_back,
    work_as_job,
    write,
)
from equimus_ctrl.executors.versions import warn_of_mix

SHOWN_EVERY = 5.0
"""How often jobs are looked at, and the client shows that it is there [s]."""
LEAVES_WITHIN = 10.0
"""A job whose client is gone, before it is cancelled [s]."""
OWN = {"cluster": "slurm", "jobs": 1, "workers": 1}
"""Settings that are not submitit's, with their defaults."""
TYPES: Mapping[str, type] = {"cluster": str, "jobs": int, "workers": int}
NOT_OURS = ("nodes", "tasks_per_node", "ntasks_per_node", "array_parallelism", "job_name", "name", "stderr_to_stdout")
"""Of submitit's settings those that follow from ours: a job is one task, on one node."""
CLUSTERS = ("slurm", "local")


@dataclass(frozen=True)
class SlurmSettings:
    """How jobs are asked for.

    Attributes:
        folder: that all nodes see.
        jobs: how many.
        workers: pieces that each does at a time.
        cluster: ``slurm``, or ``local`` for processes of this computer, to try all of it.
        parameters: for submitit, such as ``partition``, ``timeout_min``, ``mem_gb``.

    Raises:
        ConfigError: for a value that cannot be.
    """

    folder: Path
    jobs: int = 1
    workers: int = 1
    cluster: str = "slurm"
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("jobs", "workers"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}, expected at least 1")
        if self.cluster not in CLUSTERS:
            raise ConfigError(unknown_name("cluster", self.cluster, CLUSTERS))


def slurm_settings(table: Mapping[str, Any], folder: Path, where: str) -> SlurmSettings:
    """Settings from a table: ``jobs``, ``workers`` and ``cluster``; all else is submitit's, most of it Slurm's.

    Args:
        table: of a file.
        folder: that all nodes see.
        where: the file, for messages.

    Raises:
        ConfigError: for what is unknown or cannot be.
        NotAvailable: where submitit is not installed.
    """
    known = {*OWN, *_shared(), *_of_slurm()} - set(NOT_OURS)
    for key, value in table.items():
        if key not in known:
            raise ConfigError(unknown_name("setting of jobs", key, known, where))
        if key in TYPES and type(value) is not TYPES[key]:
            raise ConfigError(f"{where}: {key} is {value!r}, expected {'a text' if key == 'cluster' else 'a number'}")
    own = {key: table.get(key, default) for key, default in OWN.items()}
    more = {key: value for key, value in table.items() if key not in OWN}
    more.setdefault("cpus_per_task", own["workers"])
    try:
        return SlurmSettings(folder, own["jobs"], own["workers"], own["cluster"], more)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _submitit() -> Any:
    try:
        import submitit
    except ImportError:
        raise NotAvailable(
            "jobs of a Slurm cluster need the submitit library, which is not installed; get it with: pip install "
            "'equimus-ctrl[cluster]'"
        ) from None
    return submitit


def _shared() -> set[str]:
    return set(_submitit().AutoExecutor._valid_parameters())


def _of_slurm() -> set[str]:
    return set(_submitit().SlurmExecutor._valid_parameters())


class OnSlurm(Executor):
    """Jobs of a Slurm cluster.

    Args:
        settings: how they are asked for.
        prepare: see ``Prepare``.

    Raises:
        NotAvailable: where submitit is not installed, or this is no machine of a Slurm cluster.
        ConfigError: for what submitit does not take.
    """

    def __init__(self, settings: SlurmSettings, prepare: Prepare | None = None) -> None:
        super().__init__(prepare)
        self._settings, self._folder = settings, settings.folder
        self._submitter = _submitter(settings)
        for name in ("todo", "doing", "done", "processors"):
            (self._folder / name).mkdir(parents=True, exist_ok=True)
        self._numbers = itertools.count()
        self._given: dict[int, Future[bytes]] = {}
        self._jobs: dict[Any, int] = {}  # and how many times in a row jobs were lost before it without a result
        self._lost, self._failed = 0, False
        self._mixed = False
        self._lock, self._over = threading.Lock(), threading.Event()
        self._show()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._look, self._go_on_showing)]
        for thread in self._threads:
            thread.start()

    @property
    def count(self) -> int:
        return self._settings.jobs * self._settings.workers

    def _give(self, call: Call) -> Future[bytes]:
        number, future = next(self._numbers), Future[bytes]()
        with self._lock:  # before anybody can have done it
            self._given[number] = future
        write(self._folder / "todo" / name_of(number, 1), pickle.dumps(call))
        future.add_done_callback(lambda done: self._drop(number) if done.cancelled() else None)
        return future

    def _drop(self, number: int) -> None:
        with self._lock:
            self._given.pop(number, None)
            for where in ("todo", "doing/*"):  # who does it sees that it is gone
                for path in self._folder.glob(f"{where}/{name_of(number, '*')}"):
                    path.unlink(missing_ok=True)

    def _show(self) -> None:
        write(self._folder / "client", str(time.monotonic_ns()).encode())

    def _go_on_showing(self) -> None:
        """In a thread of its own: asking Slurm may take long, and jobs leave a client that is not seen."""
        while not self._over.wait(SHOWN_EVERY):
            with suppress(OSError):  # the next may succeed, and what cannot be written at all the other thread tells
                self._show()

    def _look(self) -> None:
        last = -SHOWN_EVERY
        while not self._over.wait(LOOKED_EVERY):
            try:
                self._take()
                if time.monotonic() - last >= SHOWN_EVERY:
                    last = time.monotonic()
                    self._look_after_jobs()
                    self._look_at_processors()
            except Gone as error:
                self._fail(error)
            except Exception as error:
                self._fail(Gone(one_line(f"{self._folder}: {error}")))

    def _take(self) -> None:
        for path in sorted((self._folder / "done").iterdir()):
            if path.name.startswith("."):
                continue
            number, _ = numbers_in(path.name)
            with others_rename():  # what is stale now is there at the next look
                found = path.read_bytes()
                path.unlink(missing_ok=True)
                self._tell(number, found)

    def _tell(self, number: int, found: bytes) -> None:
        with self._lock:
            future = self._given.pop(number, None)
        if future is not None:
            self._lost, self._jobs = 0, dict.fromkeys(self._jobs, 0)
            with suppress(InvalidStateError):
                future.set_result(found)

    def _look_after_jobs(self) -> None:
        with self._lock:
            wanted = min(self._settings.jobs, -(-len(self._given) // self._settings.workers))
        for job in _done(self._jobs):
            self._lost = max(self._lost, self._jobs.pop(job) + 1)  # those of one round may end together
            self._give_again(str(job.job_id))
            if self._lost > ATTEMPTS:
                raise Gone(f"jobs ended {self._lost} times in a row before any work was done; {_last(job)}")
        if (missing := wanted - len(self._jobs)) > 0:
            self._submit(missing)

    def _look_at_processors(self) -> None:
        """Warn, once, of jobs on processors of another kind than this one."""
        found = {}
        for path in (self._folder / "processors").glob("[!.]*"):
            with others_rename():
                found[f"job {path.name}"] = json.loads(path.read_bytes())
                path.unlink(missing_ok=True)
        if not self._mixed:
            self._mixed = warn_of_mix(found)

    def _submit(self, count: int) -> None:
        # One array in place of many jobs.
        with self._submitter.batch():
            jobs = [
                self._submitter.submit(work_as_job, self._folder.resolve(), self._settings.workers, list(sys.path))
                for _ in range(count)
            ]
        self._jobs |= dict.fromkeys(jobs, self._lost)

    def _give_again(self, job: str) -> None:
        with self._lock:
            own = self._folder / "doing" / job
            for path in own.glob("[0-9]*"):
                if numbers_in(path.name)[0] not in self._given:
                    path.unlink(missing_ok=True)
            put_back(self._folder, own)

    def _fail(self, error: Gone) -> None:
        self._failed = True
        with self._lock:
            given, self._given = list(self._given.values()), {}
        for future in given:
            with suppress(InvalidStateError):
                future.set_exception(error)

    def close(self) -> None:
        """End all jobs, and take the folder away, which stays where they have failed: their logs are in it."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        (self._folder / "client").unlink(missing_ok=True)  # which ends those that run
        for job in self._jobs:
            if job.state != "RUNNING":
                _cancel(job)
        if not self._ended(LEAVES_WITHIN):
            for job in self._jobs:
                _cancel(job)
            self._ended(LEAVES_WITHIN)
        if not self._failed:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _ended(self, seconds: float) -> bool:
        """Whether all jobs have ended before so long."""
        until = time.monotonic() + seconds
        while len(_done(self._jobs)) < len(self._jobs):
            if time.monotonic() > until:
                return False
            time.sleep(LOOKED_EVERY)
        return True


@contextmanager
def on_slurm(settings: SlurmSettings, prepare: Prepare | None = None) -> Iterator[OnSlurm]:
    """Jobs of a Slurm cluster, see ``OnSlurm``; they end with the block."""
    executor = OnSlurm(settings, prepare)
    try:
        yield executor
    finally:
        executor.close()


def _submitter(settings: SlurmSettings) -> Any:
    submitit = _submitit()
    named = {k if k in _shared() else f"slurm_{k}": value for k, value in settings.parameters.items()}
    try:
        submitter = submitit.AutoExecutor(settings.folder / "jobs", settings.cluster)
        submitter.update_parameters(name="equimus-ctrl", **named)
    except RuntimeError as error:
        raise NotAvailable(
            f"jobs cannot be submitted here ({one_line(str(error))}); expected a machine of a Slurm cluster, or "
            'cluster = "local" to try it on this one'
        ) from None
    except (ValueError, TypeError, AssertionError) as error:
        raise ConfigError(f"submitit does not take these settings of jobs ({one_line(str(error))})") from None
    return submitter


def _done(jobs: Iterable[Any]) -> list[Any]:
    """Those that have ended. Slurm is asked once, of all of them."""
    ended: list[Any] = []
    left: list[Any] = []
    for job in jobs:
        (ended if job.done() else left).append(job)
    return ended + [job for k, job in enumerate(left) if job.done(force_check=k == 0)]


def _cancel(job: Any) -> None:
    with suppress(Exception):  # it may have ended meanwhile
        job.cancel(check=False)


def _last(job: Any) -> str:
    """What a job said last."""
    lines = [line for line in (job.stderr() or "").splitlines() if line.strip()]
    return f"job {job.job_id} ({job.state}) said last: {one_line(lines[-1]) if lines else 'nothing'}"
