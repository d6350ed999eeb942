"""What passes through the folder of a cluster's jobs, with jobs that end as one likes: no Slurm is needed."""

from __future__ import annotations

import errno
import itertools
import json
import pickle
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.executors import on_slurm, spool
from equimus_ctrl.executors.calls import Call, perform
from equimus_ctrl.executors.on_slurm import SlurmSettings
from equimus_ctrl.executors.versions import processor

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'equimus-ctrl[cluster]'")


def square(x: float) -> float:
    return x * x


def within(seconds: float, found: Any) -> Any:
    until = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < until, "nothing came of it"
        time.sleep(0.01)
    return value


class Jobs:
    """Jobs as submitit's, that do nothing but what a test says."""

    def __init__(self, settings: SlurmSettings) -> None:
        self.folder, self.all, self.asked, self._numbers = settings.folder, [], 0, itertools.count()
        self.slow = 0.0

    def batch(self) -> Any:
        return nullcontext()

    def submit(self, *_: Any) -> Any:
        self.all.append(Job(self, str(next(self._numbers))))
        return self.all[-1]


class Job:
    def __init__(self, jobs: Jobs, name: str) -> None:
        self.jobs, self.job_id, self.state, self.over, self.known = jobs, name, "RUNNING", False, False
        self.own = jobs.folder / "doing" / name

    def done(self, force_check: bool = False) -> bool:
        """As Slurm's: what is not asked for is what was known; to ask is to learn of all."""
        if force_check:
            self.jobs.asked += 1
            time.sleep(self.jobs.slow)
            for job in self.jobs.all:
                job.known = job.over
        return self.known

    def cancel(self, check: bool = True) -> None:
        self.over = True

    def stderr(self) -> str:
        return "time limit"

    def take(self) -> Path:
        self.own.mkdir(parents=True, exist_ok=True)
        return within(10, lambda: spool._taken(self.jobs.folder, self.own))

    def work(self) -> None:
        taken = self.take()
        spool.write(self.jobs.folder / "done" / taken.name, perform(pickle.loads(taken.read_bytes())))
        taken.unlink()


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Jobs, on_slurm.OnSlurm]]:
    """Six jobs, one piece at a time each."""
    settings = SlurmSettings(tmp_path / "spool", jobs=6)
    own = Jobs(settings)
    monkeypatch.setattr(on_slurm, "_submitter", lambda _: own)
    monkeypatch.setattr(on_slurm, "SHOWN_EVERY", 0.05)
    monkeypatch.setattr(on_slurm, "LOOKED_EVERY", 0.01)
    monkeypatch.setattr(on_slurm, "LEAVES_WITHIN", 0.2)
    with on_slurm.on_slurm(settings) as pool:
        yield own, pool
        for job in own.all:
            job.over = True


def test_jobs_that_end_together_are_one_round(jobs: Any) -> None:
    """All six reach their time limit at once, after one result, and so does the next round."""
    own, pool = jobs
    futures = [pool.submit(square, float(k)) for k in range(8)]
    within(10, lambda: len(own.all) == 6)
    own.all[0].work()
    within(10, lambda: any(future.done() for future in futures))
    for first in (0, 6):
        six = own.all[first : first + 6]
        for job in six[:3] if first else six:
            job.take()
        for job in six:
            job.over = True
        within(10, lambda first=first: len(own.all) == first + 12)
    for _ in range(7):
        own.all[-1].work()
    assert [future.result(timeout=10) for future in futures] == [square(float(k)) for k in range(8)]


def test_rounds_without_any_work_end_the_run(jobs: Any) -> None:
    own, pool = jobs
    future = pool.submit(square, 2.0)
    for k in range(spool.ATTEMPTS + 1):
        within(10, lambda k=k: len(own.all) > k)
        own.all[k].over = True
    with pytest.raises(
        NotAvailable, match=r"jobs ended 5 times in a row before any work was done; job 4 .* time limit"
    ):
        future.result(timeout=10)


def test_slurm_is_asked_of_all_jobs_at_once(jobs: Any) -> None:
    own, pool = jobs
    for k in range(6):
        pool.submit(square, float(k))
    within(10, lambda: len(own.all) == 6)
    with pool._lock:  # between looks
        before = own.asked
    looks = []
    done = on_slurm._done
    on_slurm._done = lambda of: looks.append(len(of)) or done(of)
    try:
        within(10, lambda: len(looks) > 5)
    finally:
        on_slurm._done = done
    assert set(looks) == {6} and own.asked - before <= len(looks) + 1


def test_the_client_is_seen_while_slurm_takes_its_time(jobs: Any) -> None:
    own, pool = jobs
    pool.submit(square, 1.0)
    within(10, lambda: own.all)
    own.slow = 1.0
    asked = own.asked
    within(10, lambda: own.asked > asked)
    seen = {(own.folder / "client").read_bytes() for _ in range(30) if not time.sleep(0.02)}
    assert len(seen) >= 3


def test_a_job_that_is_started_again_gives_back_what_it_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slurm requeues a preempted job with the same number; it never ends, as far as the client sees."""
    for name in ("todo", "done", "processors"):
        (tmp_path / name).mkdir()
    own = tmp_path / "doing" / "7_1"
    own.mkdir(parents=True)
    (own / spool.name_of(3, 1)).write_bytes(pickle.dumps(Call.of(square, (3.0,))))
    (own / spool.name_of(4, spool.ATTEMPTS)).write_bytes(b"takes its job with it")
    import submitit

    monkeypatch.setattr(submitit, "JobEnvironment", lambda: type("Environment", (), {"job_id": "7_1"})())
    (tmp_path / "client").write_bytes(b"1")
    job = threading.Thread(target=spool.work_as_job, args=(tmp_path, 1, []))
    job.start()
    names = {spool.name_of(3, 2), spool.name_of(4, spool.ATTEMPTS)}
    within(60, lambda: {path.name for path in (tmp_path / "done").iterdir()} == names)
    (tmp_path / "client").unlink()
    job.join(timeout=30)
    assert pickle.loads((tmp_path / "done" / spool.name_of(3, 2)).read_bytes()) == (True, 9.0)
    good, told = pickle.loads((tmp_path / "done" / spool.name_of(4, spool.ATTEMPTS)).read_bytes())
    assert not good and str(told) == "took 4 jobs with it, one after the other"
    assert not list(own.iterdir())
    assert json.loads((tmp_path / "processors" / "7_1").read_bytes()) == processor()


def test_jobs_on_another_processor_are_told_once(jobs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    own, _ = jobs
    told: list[Any] = []

    def tells(found: dict[str, dict[str, str]]) -> bool:
        mixed = any(own != processor() for own in found.values())
        told.extend([found] * mixed)
        return mixed

    monkeypatch.setattr(on_slurm, "warn_of_mix", tells)
    (own.folder / "processors" / "1").write_text(json.dumps(processor()))
    within(10, lambda: not list((own.folder / "processors").iterdir()))
    for name in ("2", "3"):
        (own.folder / "processors" / name).write_text(json.dumps({**processor(), "blas": "other"}))
        within(10, lambda: not list((own.folder / "processors").iterdir()))
    within(10, lambda: told)
    assert told == [{"job 2": {**processor(), "blas": "other"}}]


def test_a_piece_is_known_before_anybody_can_do_it(jobs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    own, pool = jobs
    write = spool.write

    def done_at_once(path: Path, data: bytes) -> None:
        if path.parent.name != "todo":
            return write(path, data)
        write(own.folder / "done" / path.name, perform(pickle.loads(data)))
        within(10, lambda: not (own.folder / "done" / path.name).exists())

    monkeypatch.setattr(on_slurm, "write", done_at_once)
    assert pool.submit(square, 5.0).result(timeout=10) == 25.0


@pytest.mark.parametrize("number", [errno.ENOENT, errno.ESTALE])
def test_files_that_are_taken_away_under_a_job_do_it_no_harm(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first piece is dropped just as a job has taken it; the second is done."""
    for name in ("todo", "done", "doing"):
        (tmp_path / name).mkdir()
    for k in range(2):
        (tmp_path / "todo" / spool.name_of(k, 1)).write_bytes(pickle.dumps(Call.of(square, (3.0,))))
    read = Path.read_bytes

    def dropped(path: Path) -> bytes:
        if path.name == spool.name_of(0, 1):
            raise OSError(number, "gone")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", dropped)
    over = threading.Event()
    thread = threading.Thread(target=spool._work_off, args=(tmp_path, tmp_path / "doing", over))
    thread.start()
    within(60, lambda: (tmp_path / "done" / spool.name_of(1, 1)).exists())
    over.set()
    thread.join(timeout=30)
    assert [path.name for path in (tmp_path / "done").iterdir()] == [spool.name_of(1, 1)]
