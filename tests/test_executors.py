"""Where work is done changes nothing: processes, a real Dask scheduler with two worker processes, jobs by submitit."""

from __future__ import annotations

import gc
import itertools
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.executors import on_dask, on_slurm
from equimus_ctrl.executors.base import AHEAD, Executor
from equimus_ctrl.executors.calls import Call, Ended, Unfit, opened, perform
from equimus_ctrl.executors.child import Child
from equimus_ctrl.executors.on_slurm import slurm_settings
from equimus_ctrl.executors.versions import OtherProcessor, mismatch, processor, versions, warn_of_mix
from equimus_ctrl.executors.where import Where

# --- work


def square(x: float) -> float:
    return x * x


def who(_: int = 0) -> tuple[int, int]:
    """The process, and the threads that its linear algebra has."""
    import numpy as np
    from threadpoolctl import threadpool_info

    assert np.ones((2, 2)).sum() == 4
    return os.getpid(), max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")


def fail(x: int) -> int:
    if x == 1:
        raise ConfigError("x is 1, expected another")
    if x == 2:
        raise ValueError("two")
    print("this goes to nobody's results")
    return x


def doomed(x: int) -> int:
    if x == 1:
        os._exit(9)
    if x == 2:
        signal.raise_signal(signal.SIGKILL)
    return x


def begun_and_waits(index: int, folder: Path, begun: int) -> int:
    """Told to be begun; what is begun in the first ``begun`` processes waits for ever."""
    own = folder / f"{index}-{os.getpid()}"
    own.touch()
    while index < begun and len(list(folder.glob(f"{index}-*"))) == 1:
        time.sleep(0.02)
    return 10 * index


def stays(folder: Path, seconds: float) -> None:
    (folder / str(os.getpid())).touch()
    time.sleep(seconds)


prepared: list[int] = []


def prepare() -> None:
    prepared.append(os.getpid())


def seen_prepared() -> list[int]:
    return prepared


def missing_plugin() -> None:
    raise ConfigError("plugin.py: there is no such file")


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def within(seconds: float, found: Callable[[], Any]) -> Any:
    until = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < until, "nothing came of it"
        time.sleep(0.02)
    return value


# --- where

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A scheduler and two workers, each a process that its nanny starts again."""
    pytest.importorskip("distributed")
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0") as own:
        yield own


@pytest.fixture(params=["local", "dask", pytest.param("slurm", marks=pytest.mark.slow)])
def opened_executor(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Open:
    """Opens two workers of each kind."""
    if request.param == "local":
        return Where(workers=2).opened
    if request.param == "dask":
        return Where(scheduler=request.getfixturevalue("cluster").scheduler_address).opened
    pytest.importorskip("submitit")
    monkeypatch.setattr(on_slurm, "SHOWN_EVERY", 0.5)
    table = {"cluster": "local", "jobs": 2, "timeout_min": 5, "partition": "any"}
    return Where(slurm=slurm_settings(table, tmp_path / "jobs", "jobs.toml")).opened


@pytest.mark.slow
def test_pieces_come_to_the_same_wherever_they_are_done(opened_executor: Open) -> None:
    pool: Executor
    with opened_executor() as pool:
        assert pool.count == 2
        tasks = [(1.1 * k,) for k in range(7)]
        assert dict(pool.each(square, tasks)) == {k: square(1.1 * k) for k in range(7)}
        assert dict(pool.each(square, iter(()))) == {}
        assert pool.submit(square, 3.0).result() == 9.0
        processes = dict(pool.each_apart(who, [(k,) for k in range(3)])).values()
        assert len({pid for pid, _ in processes}) == 3 and {threads for _, threads in processes} == {1}
        shared = dict(pool.each(who, [(k,) for k in range(6)])).values()
        assert {threads for _, threads in shared} == {1} and os.getpid() not in {pid for pid, _ in shared}
        with pytest.raises(ConfigError, match="x is 1, expected another"):
            list(pool.each(fail, [(0,), (1,), (3,)]))
        ended = dict(pool.each_apart(fail, [(k,) for k in range(4)]))
        assert (ended[0], ended[3]) == (0, 3)
        assert [str(ended[k]) for k in (1, 2)] == ["ended (x is 1, expected another)", "ended (ValueError: two)"]
        ended = dict(pool.each_apart(doomed, [(k,) for k in range(4)]))
        assert (ended[0], ended[3]) == (0, 3)
        assert [str(ended[k]) for k in (1, 2)] == ["ended with exit code 9", "was ended from outside (SIGKILL)"]


def test_processes_are_prepared(opened_executor: Open) -> None:
    with opened_executor(prepare=prepare) as pool:
        assert [len(seen) for seen in dict(pool.each(seen_prepared, [(), (), ()])).values()] == [1, 1, 1]
        assert [len(seen) for seen in dict(pool.each_apart(seen_prepared, [(), ()])).values()] == [1, 1]


def test_what_no_process_can_do_is_told_at_once(opened_executor: Open) -> None:
    with (
        pytest.raises(Unfit, match=r"plugin.py: there is no such file"),
        opened_executor(prepare=missing_plugin) as pool,
    ):
        list(pool.each_apart(square, [(1.0,), (2.0,)]))


def test_what_nobody_wants_any_more_is_ended(opened_executor: Open, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    begun.mkdir()
    with opened_executor() as pool:
        done = pool.each_apart(stays, [(begun, 0.0), (begun, 600.0), (begun, 600.0)])
        assert next(done) == (0, None)
        within(60, lambda: len(list(begun.iterdir())) > 1)
        done.close()
        within(30, lambda: not any(alive(int(path.name)) for path in begun.iterdir()))
        assert dict(pool.each_apart(square, [(2.0,), (3.0,)])) == {0: 4.0, 1: 9.0}


def test_pieces_are_made_when_they_are_needed(opened_executor: Open) -> None:
    made: list[int] = []

    def tasks() -> Iterator[tuple[float]]:
        for k in range(40):
            made.append(k)
            yield (float(k),)

    with opened_executor() as pool:
        done = pool.each_apart(square, tasks())
        next(done)
        assert len(made) <= AHEAD * pool.count + 2
        done.close()


# --- workers that are lost


def test_a_lost_dask_worker_s_work_is_done_by_another(cluster: Any, tmp_path: Path) -> None:
    workers = {info["id"]: pid for info, pid in _workers(cluster)}
    with Where(scheduler=cluster.scheduler_address).opened() as pool:
        done: dict[int, Any] = {}
        collect = threading.Thread(
            target=lambda: done.update(pool.each_apart(begun_and_waits, [(k, tmp_path, 1) for k in range(6)]))
        )
        collect.start()
        (first,) = within(60, lambda: list(tmp_path.glob("0-*")))
        child = int(first.name.partition("-")[2])
        (killed,) = [pid for pid in workers.values() if pid == _parent(child)]
        os.kill(killed, signal.SIGKILL)
        within(30, lambda: not alive(child))  # it ends with the worker that it works for
        collect.join(timeout=60)
        assert done == {k: 10 * k for k in range(6)}
    cluster.scheduler  # noqa: B018 – it is still there
    within(30, lambda: len(list(_workers(cluster))) == 2)


@pytest.mark.slow
def test_what_is_done_is_not_done_again_where_its_worker_is_lost(cluster: Any, tmp_path: Path) -> None:
    gc.disable()  # nothing is let go of by chance
    try:
        with Where(scheduler=cluster.scheduler_address).opened() as pool:
            pieces = pool.each_apart(begun_and_waits, [(k, tmp_path, 0) for k in range(8)])
            had = [index for index, _ in itertools.islice(pieces, 4)]
            for _, pid in _workers(cluster):
                os.kill(pid, signal.SIGKILL)
            rest = dict(pieces)
    finally:
        gc.enable()
    assert {*had, *rest} == set(range(8))
    assert [len(list(tmp_path.glob(f"{k}-*"))) for k in had] == [1] * 4


def kills_its_worker(index: int, folder: Path) -> int:
    """The first one does; the others are beside it until it has done so four times."""
    if index == 0:
        (folder / str(os.getpid())).touch()
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(600)
    within(60, lambda: len(list(folder.iterdir())) >= 4)
    return index


@pytest.mark.slow
def test_what_takes_every_worker_with_it_is_left_out_and_nothing_else(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    own = distributed.LocalCluster(n_workers=1, threads_per_worker=3, processes=True, dashboard_address=":0")
    with own, Where(scheduler=own.scheduler_address).opened() as pool:
        done = dict(pool.each_apart(kills_its_worker, [(k, tmp_path) for k in range(3)]))
    assert str(done[0]) == "took 4 workers with it, one after the other"
    assert (done[1], done[2]) == (1, 2)


def _workers(cluster: Any) -> list[tuple[dict[str, Any], int]]:
    from distributed import Client

    with Client(cluster, set_as_default=False) as client:
        pids = client.run(os.getpid)
        infos = client.scheduler_info(n_workers=-1)["workers"]
        return [(infos[address], pid) for address, pid in pids.items() if address in infos]


def _parent(pid: int) -> int:
    with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
        return int(file.read().rpartition(")")[2].split()[1])


@pytest.mark.slow
def test_a_lost_job_s_work_is_done_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setattr(on_slurm, "SHOWN_EVERY", 0.5)
    (tmp_path / "begun").mkdir()
    settings = slurm_settings({"cluster": "local", "jobs": 2}, tmp_path / "jobs", "jobs.toml")
    with on_slurm.on_slurm(settings) as pool:
        done: dict[int, Any] = {}
        tasks = [(k, tmp_path / "begun", 1) for k in range(6)]
        collect = threading.Thread(target=lambda: done.update(pool.each_apart(begun_and_waits, tasks)))
        collect.start()
        (first,) = within(60, lambda: list((tmp_path / "begun").glob("0-*")))
        child = int(first.name.partition("-")[2])
        (job,) = [job for job in pool._jobs if (settings.folder / "doing" / str(job.job_id) / "0000000.1").exists()]
        os.kill(_parent(child), signal.SIGKILL)
        job._process.kill()
        within(30, lambda: not alive(child))
        collect.join(timeout=60)
        assert done == {k: 10 * k for k in range(6)}
    assert not settings.folder.exists()


@pytest.mark.slow
def test_jobs_that_all_end_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setattr(on_slurm, "SHOWN_EVERY", 0.3)
    monkeypatch.setattr(on_slurm, "work_as_job", print)  # what is submitted ends at once
    settings = slurm_settings({"cluster": "local", "jobs": 2}, tmp_path / "jobs", "jobs.toml")
    told = "jobs ended 5 times in a row before any work was done"
    with pytest.raises(NotAvailable, match=told), on_slurm.on_slurm(settings) as pool:
        list(pool.each(square, [(1.0,), (2.0,)]))


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_told(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    own = distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0")

    def interrupted() -> None:
        with Where(scheduler=own.scheduler_address).opened() as pool:
            done = pool.each_apart(begun_and_waits, [(0, tmp_path, 0), (1, tmp_path, 2)])
            assert next(done) == (0, 0)
            own.close()
            list(done)

    with pytest.raises(NotAvailable, match="scheduler is gone"):
        interrupted()


# --- what is told before work begins


def look_at(**where: Any) -> None:
    with Where(**where).opened():
        pass


def test_an_address_where_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(on_dask, "ANSWERS_WITHIN", 0.5)
    with pytest.raises(NotAvailable, match=r"tcp://127.0.0.1:9: no Dask scheduler answers there within 0.5 s"):
        look_at(scheduler="tcp://127.0.0.1:9")
    with pytest.raises(NotAvailable, match="nonsense://here: is no address of a Dask scheduler"):
        look_at(scheduler="nonsense://here")


def test_a_scheduler_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(on_dask, "ANSWERS_WITHIN", 0.5)
    told = "has no worker, and none came within 0.5 s; start some with `dask worker"
    own = distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=":0")
    with own, pytest.raises(NotAvailable, match=told):
        look_at(scheduler=own.scheduler_address)


def test_workers_of_another_version_are_refused(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    here = {**versions(), "numpy": "1.0"}
    monkeypatch.setattr(on_dask, "mismatch", lambda other: mismatch(other, here))
    with pytest.raises(NotAvailable, match=rf"worker tcp://.* has numpy {versions()['numpy']}, not 1\.0"):
        look_at(scheduler=cluster.scheduler_address)


def test_a_piece_of_another_version_is_not_done() -> None:
    call = Call.of(square, (2.0,), made_by=versions())
    assert opened(perform(call)) == 4.0
    other = replace(call, made_by={**versions(), "equimus_ctrl": "0.0.1"})
    with pytest.raises(Unfit, match=r"there is equimus_ctrl 0\.1\.0 \(.*\), not 0\.0\.1; the same has to be installed"):
        opened(perform(other))
    assert mismatch(versions()) is None
    assert mismatch({}) == f"equimus_ctrl none, not {versions()['equimus_ctrl']}"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"partiton": "cpu"}, r"jobs.toml: there is no setting of jobs 'partiton'; did you mean 'partition'\?"),
        ({"nodes": 2}, "there is no setting of jobs 'nodes'"),
        ({"jobs": 0}, "jobs.toml: jobs is 0, expected at least 1"),
        ({"jobs": "many"}, "jobs is 'many', expected a number"),
        ({"workers": 0}, "workers is 0, expected at least 1"),
        ({"cluster": "pbs"}, r"there is no cluster 'pbs' \(known: local, slurm\)"),
    ],
)
def test_settings_of_jobs_that_cannot_be(table: dict[str, Any], message: str, tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    with pytest.raises(ConfigError, match=message):
        slurm_settings(table, tmp_path, "jobs.toml")


def test_where_there_is_no_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    settings = slurm_settings({"partition": "cpu", "timeout_min": 60, "mem_gb": 2}, tmp_path / "jobs", "jobs.toml")
    with pytest.raises(NotAvailable, match='expected a machine of a Slurm cluster, or cluster = "local"'):
        look_at(slurm=settings)


@pytest.mark.parametrize(("library", "needs"), [("distributed", look_at), ("submitit", slurm_settings)])
def test_extras_that_are_not_installed(
    library: str, needs: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    given = (
        {"scheduler": "tcp://127.0.0.1:9"}
        if library == "distributed"
        else {"table": {}, "folder": tmp_path, "where": ""}
    )
    with pytest.raises(
        NotAvailable, match=rf"the {library} library, which is not installed; .*equimus-ctrl\[cluster\]"
    ):
        needs(**given)


def test_one_place_is_said() -> None:
    with pytest.raises(ConfigError, match="workers and scheduler are given, expected one"):
        Where(workers=2, scheduler="tcp://head:8786")
    assert Where(workers=2).here and not Where(scheduler="tcp://head:8786").here


# --- the process that does the work


def test_a_process_that_was_ended_says_so_and_is_gone() -> None:
    child = Child()
    assert opened(child.do(Call.of(square, (3.0,)))) == 9.0
    child.end()
    with pytest.raises(Ended, match=r"was ended from outside \(SIGKILL\)"):
        child.do(Call.of(square, (3.0,)))
    child.end()


def test_a_process_that_starts_as_the_loop_ends_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Between its start and its being known to the loop nothing may fall."""
    from equimus_ctrl.executors import local

    starting, go_on, made = threading.Event(), threading.Event(), []

    class Slow(Child):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)
            if len(made) > 1:
                starting.set()
                go_on.wait(30)

    monkeypatch.setattr(local, "Child", Slow)
    with Where(workers=2).opened() as pool:
        done = pool.each_apart(stays, [(tmp_path, 0.0), (tmp_path, 600.0)])
        threading.Timer(1.0, go_on.set).start()
        assert next(done) == (0, None)
        assert starting.wait(30)
        done.close()
        within(30, lambda: not any(alive(child._process.pid) for child in made))


@pytest.mark.slow
def test_a_kept_process_of_a_client_that_is_gone_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_dask, "IDLE", 1.5)
    monkeypatch.setattr(on_dask, "_task", lambda: None)
    given = pickle.dumps(Call.of(who, ()))
    first, _ = opened(on_dask._do("a session", given))
    time.sleep(1.0)
    again, _ = opened(on_dask._do("a session", given))
    time.sleep(1.0)
    assert again == first and alive(first)  # it had something to do meanwhile
    within(30, lambda: not alive(first))
    assert not on_dask._idle
    other, _ = opened(on_dask._do("a session", given))
    assert other != first
    on_dask._let_go("a session")
    assert not alive(other)


# --- processors


def test_a_worker_with_another_processor_is_told(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    here = processor()
    assert set(here) == {"blas", "numba"} and "" not in here.values() and "unknown" not in here.values()
    look_at(scheduler=cluster.scheduler_address)  # those of this computer are of its kind
    other = {**here, "numba": "cray-1"}
    monkeypatch.setattr(on_dask, "warn_of_mix", lambda found: warn_of_mix(found, other))
    with pytest.warns(
        OtherProcessor, match=rf"worker tcp://.* has another processor \(numba {here['numba']}, not cray-1"
    ):
        look_at(scheduler=cluster.scheduler_address)


def test_each_worker_that_does_a_piece_is_compared(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    other = {**processor(), "numba": "cray-1"}
    with Where(scheduler=cluster.scheduler_address).opened() as pool:
        assert dict(pool.each(square, [(2.0,)])) == {0: 4.0}  # of the kind of all: nothing is told
        monkeypatch.setattr(on_dask, "warn_of_mix", lambda found: warn_of_mix(found, other))
        with pytest.warns(
            OtherProcessor, match=r"worker tcp://.* has another processor \(numba .*, not cray-1"
        ) as told:
            assert dict(pool.each(square, [(1.0 * k,) for k in range(6)])) == {k: 1.0 * k * k for k in range(6)}
        assert len(told) == 1


@pytest.mark.slow
def test_a_worker_of_another_kind_that_joins_later_is_told() -> None:
    distributed = pytest.importorskip("distributed")
    own = distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0")
    with own, Where(scheduler=own.scheduler_address).opened() as pool:
        command = [sys.executable, "-m", "distributed.cli.dask_worker", own.scheduler_address, "--no-nanny"]
        late = subprocess.Popen(
            [*command, "--nthreads", "1"],
            env={**os.environ, "NUMBA_CPU_NAME": "generic", "PYTHONPATH": os.pathsep.join(sys.path)},
            stderr=subprocess.DEVNULL,
        )
        try:
            within(60, lambda: len(list(_workers(own))) == 2)
            with pytest.warns(OtherProcessor, match=r"has another processor \(numba generic, not "):
                assert len(dict(pool.each(who, [(k,) for k in range(12)]))) == 12
        finally:
            late.terminate()
            late.wait()
