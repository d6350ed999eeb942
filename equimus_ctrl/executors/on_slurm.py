"""Work in jobs of a Slurm cluster, which submitit submits, and a folder that all of its nodes see.

    <folder>/todo/0000012.3       a piece to be done, for the third time
    <folder>/doing/<job>/<name>   that a job has taken, by renaming it
    <folder>/done/<name>          what it came to
    <folder>/client               a number that grows as long as somebody waits; jobs end when it does not
    <folder>/jobs/                submitit's own

So jobs take pieces as they come free, and however many there are, few jobs wait in Slurm's queue. What a job had taken
that has ended is given to another, and so is its place. Nothing but renaming has to be atomic, as it is on NFS.
"""

from __future__ import annotations

import itertools
import pickle
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import ConfigError, NotAvailable, one_line, unknown_name
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.calls import Call, Ended, Gone, failed
from equimus_ctrl.executors.child import Child

ATTEMPTS = 4
"""At most, of one piece; so many jobs in a row may end, too, before any more is done."""
LOOKED_EVERY, SHOWN_EVERY = 0.2, 5.0
"""How often a folder is looked at, and how often jobs are, and the client shows that it is there [s]."""
LEAVES_WITHIN = 10.0
"""A job whose client is gone, before it is cancelled [s]."""
GONE_AFTER = 120.0
"""What the client has not shown for so long, it never will [s]."""
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
        for name in ("todo", "doing", "done"):
            (self._folder / name).mkdir(parents=True, exist_ok=True)
        self._numbers = itertools.count()
        self._given: dict[int, tuple[Future[bytes], int]] = {}
        self._jobs: list[Any] = []
        self._lost_in_a_row, self._failed = 0, False
        self._lock, self._over = threading.Lock(), threading.Event()
        self._show()
        self._looking = threading.Thread(target=self._look, daemon=True)
        self._looking.start()

    @property
    def count(self) -> int:
        return self._settings.jobs * self._settings.workers

    def _give(self, call: Call) -> Future[bytes]:
        number, future = next(self._numbers), Future[bytes]()
        _write(self._folder / "todo" / _name(number, 1), pickle.dumps(call))
        with self._lock:
            self._given[number] = future, 1
        future.add_done_callback(lambda done: self._drop(number) if done.cancelled() else None)
        return future

    def _drop(self, number: int) -> None:
        with self._lock:
            _, attempt = self._given.pop(number, (None, 0))
        (self._folder / "todo" / _name(number, attempt)).unlink(missing_ok=True)
        for path in self._folder.glob(f"doing/*/{_name(number, attempt)}"):  # who does it sees that it is gone
            path.unlink(missing_ok=True)

    def _show(self) -> None:
        _write(self._folder / "client", str(time.monotonic_ns()).encode())

    def _look(self) -> None:
        last = -SHOWN_EVERY
        while not self._over.wait(LOOKED_EVERY):
            try:
                self._take()
                if time.monotonic() - last >= SHOWN_EVERY:
                    last = time.monotonic()
                    self._show()
                    self._look_after_jobs()
            except Gone as error:
                self._fail(error)
            except Exception as error:
                self._fail(Gone(one_line(f"{self._folder}: {error}")))

    def _take(self) -> None:
        for path in sorted((self._folder / "done").iterdir()):
            if path.name.startswith("."):
                continue
            number, _ = _numbers_in(path.name)
            found = path.read_bytes()
            path.unlink(missing_ok=True)
            self._tell(number, found)

    def _tell(self, number: int, found: bytes) -> None:
        with self._lock:
            future, _ = self._given.pop(number, (None, 0))
        if future is not None:
            self._lost_in_a_row = 0
            with suppress(InvalidStateError):
                future.set_result(found)

    def _look_after_jobs(self) -> None:
        with self._lock:
            wanted = min(self._settings.jobs, -(-len(self._given) // self._settings.workers))
        for job in [job for job in self._jobs if job.done(force_check=True)]:
            self._jobs.remove(job)
            self._lost_in_a_row += 1
            self._give_again(str(job.job_id))
            if self._lost_in_a_row > ATTEMPTS:
                raise Gone(f"{self._lost_in_a_row} jobs in a row ended before any work was done; {_last(job)}")
        if (missing := wanted - len(self._jobs)) > 0:
            self._submit(missing)

    def _submit(self, count: int) -> None:
        # One array in place of many jobs.
        with self._submitter.batch():
            jobs = [
                self._submitter.submit(_job, self._folder.resolve(), self._settings.workers, list(sys.path))
                for _ in range(count)
            ]
        self._jobs += jobs

    def _give_again(self, job: str) -> None:
        for path in sorted((self._folder / "doing" / job).glob("[0-9]*")):
            number, attempt = _numbers_in(path.name)
            with self._lock:
                future, _ = self._given.get(number, (None, 0))
                if future is not None:
                    self._given[number] = future, attempt + 1
            if future is None:
                path.unlink(missing_ok=True)
            elif attempt < ATTEMPTS:
                path.replace(self._folder / "todo" / _name(number, attempt + 1))
            else:
                path.unlink(missing_ok=True)
                self._tell(number, failed(Ended(f"took {ATTEMPTS} jobs with it, one after the other")))

    def _fail(self, error: Gone) -> None:
        self._failed = True
        with self._lock:
            given, self._given = list(self._given.values()), {}
        for future, _ in given:
            with suppress(InvalidStateError):
                future.set_exception(error)

    def close(self) -> None:
        """End all jobs, and take the folder away, which stays where they have failed: their logs are in it."""
        self._over.set()
        self._looking.join()
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
        while not all(job.done(force_check=True) for job in self._jobs):
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


def _cancel(job: Any) -> None:
    with suppress(Exception):  # it may have ended meanwhile
        job.cancel(check=False)


def _last(job: Any) -> str:
    """What a job said last."""
    lines = [line for line in (job.stderr() or "").splitlines() if line.strip()]
    return f"job {job.job_id} ({job.state}) said last: {one_line(lines[-1]) if lines else 'nothing'}"


def _name(number: int, attempt: int) -> str:
    return f"{number:07d}.{attempt}"


def _numbers_in(name: str) -> tuple[int, int]:
    number, attempt = name.split(".")
    return int(number), int(attempt)


def _write(path: Path, data: bytes) -> None:
    half = path.with_name(f".{path.name}.tmp")
    half.write_bytes(data)
    half.replace(path)


# --- in a job


def _job(folder: Path, workers: int, path: Sequence[str]) -> None:
    """Take pieces and do them, until the client is gone; modules are found where it finds them, see ``sys.path``."""
    sys.path += [place for place in path if place not in sys.path]
    own = folder / "doing" / str(_submitit().JobEnvironment().job_id)
    own.mkdir(parents=True, exist_ok=True)
    over = threading.Event()
    threads = [threading.Thread(target=_work_off, args=(folder, own, over)) for _ in range(workers)]
    for thread in threads:
        thread.start()
    last, seen = None, time.monotonic()
    try:
        while time.monotonic() - seen < GONE_AFTER and any(thread.is_alive() for thread in threads):
            with suppress(FileNotFoundError):
                if (now := (folder / "client").read_bytes()) != last:
                    last, seen = now, time.monotonic()
                time.sleep(LOOKED_EVERY * SHOWN_EVERY)
                continue
            return  # the client has taken it away
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _work_off(folder: Path, own: Path, over: threading.Event) -> None:
    kept: Child | None = None
    try:
        while not over.wait(0 if (taken := _taken(folder, own)) else LOOKED_EVERY):
            if taken is None:
                continue
            call = pickle.loads(taken.read_bytes())
            child = Child() if call.apart else (kept := kept or Child())
            done = threading.Event()
            watch = threading.Thread(target=_watch, args=(taken, child, over, done), daemon=True)
            watch.start()
            try:
                found = child.do(call)
            except Ended as error:
                kept = kept if call.apart else None
                found = failed(error)
            finally:
                done.set()
                watch.join()
                if call.apart:
                    child.end()
            if not over.is_set() and taken.exists():
                _write(folder / "done" / taken.name, found)
                taken.unlink(missing_ok=True)
    finally:
        if kept is not None:
            kept.end()


def _taken(folder: Path, own: Path) -> Path | None:
    """A piece that nobody else has taken; None of none."""
    with suppress(FileNotFoundError):
        for path in sorted((folder / "todo").glob("[0-9]*")):
            with suppress(FileNotFoundError):  # somebody was faster
                return path.rename(own / path.name)
    return None


def _watch(taken: Path, child: Child, over: threading.Event, done: threading.Event) -> None:
    while not done.wait(LOOKED_EVERY):
        if over.is_set() or not taken.exists():
            child.end()
            return
