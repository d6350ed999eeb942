"""Processors, processes and threads: who does the work changes nothing, and what ends it is told."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from equimus_ctrl import computer
from equimus_ctrl.computer import Workers, worker_count, workers
from equimus_ctrl.errors import ConfigError, NotAvailable


def script(text: str) -> subprocess.Popen[str]:
    """A user's script, in a process group of its own as in a terminal."""
    return subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


# --- how many


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system knows no affinity")
def test_processors_are_those_that_may_be_used() -> None:
    text = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
        "from equimus_ctrl.computer import processors, worker_count; print(processors(), worker_count(), worker_count(3))"
    )
    assert script(text).communicate() == ("1 1 3\n", "")


def test_workers_are_no_more_than_asked_for_and_no_more_than_there_is_to_do() -> None:
    assert worker_count() == computer.processors() >= 1
    assert (worker_count(7), worker_count(7, 3), worker_count(2, 3), worker_count(2, 0)) == (7, 3, 2, 1)
    with pytest.raises(ConfigError, match="threads is 0, expected at least 1"):
        worker_count(0, name="threads")
    with pytest.raises(ConfigError, match="workers is -1, expected at least 1"), workers(-1):
        pass


# --- processes


def who(_: int = 0) -> tuple[int, int]:
    """The process, and the threads that its linear algebra has."""
    import numpy as np
    from threadpoolctl import threadpool_info

    assert np.ones((2, 2)).sum() == 4
    return os.getpid(), max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")


def first_waits_until_second_was_seen(index: int, seen: Path) -> int:
    """What is begun first ends only after the result of the second was handed on."""
    until = time.monotonic() + 60.0
    while index == 0 and not seen.exists():
        assert time.monotonic() < until, "the result of the second was not handed on"
        time.sleep(0.01)
    return 10 * index


def fail(index: int) -> int:
    if index == 0:
        raise ConfigError("index is 0, expected more")
    return index


def test_results_come_as_they_are_done(tmp_path: Path) -> None:
    with workers(2) as pool:
        assert pool.count == 2
        done = pool.each(first_waits_until_second_was_seen, [(index, tmp_path / "seen") for index in range(2)])
        assert next(done) == (1, 10)
        (tmp_path / "seen").touch()
        assert list(done) == [(0, 0)]
        assert sorted(pool.each(fail, [(1,), (2,), (3,)])) == [(0, 1), (1, 2), (2, 3)]
        assert list(pool.each(fail, [])) == []


def test_linear_algebra_has_one_thread_whoever_works() -> None:
    own = os.getpid()
    assert dict(Workers().each(who, [(0,), (1,)])) == {0: (own, 1), 1: (own, 1)}
    with workers(2) as pool:
        beside = pool.start(who)
        seen = [*dict(pool.each(who, [(0,), (1,)])).values(), beside()]
    assert own not in {process for process, _ in seen}
    assert {threads for _, threads in seen} == {1}


def test_one_worker_is_this_process_which_works_when_it_is_asked() -> None:
    calls: list[int] = []
    with workers(1) as pool:
        result = pool.start(lambda: calls.append(1) or len(calls))
        assert calls == []
        assert (result(), result()) == (1, 1)


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_in_a_piece_of_work_is_that_of_the_whole(count: int) -> None:
    with pytest.raises(ConfigError, match="index is 0, expected more"), workers(count) as pool:
        list(pool.each(fail, [(1,), (0,), (2,)]))


def test_a_process_that_was_ended_is_told_in_a_sentence() -> None:
    with pytest.raises(NotAvailable, match="2 processes .* ended from outside"), workers(2) as pool:
        pool.start(os._exit, 9)()


STOPPED = """
import os, sys, time
from equimus_ctrl.computer import workers
from equimus_ctrl.executors.local import on_this_computer

def work(seconds):
    time.sleep(seconds)
    return os.getpid()

try:
    {begin}
        print(done, flush=True)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""


@pytest.mark.parametrize(
    "begin",
    [
        "with workers(2) as pool:\n      for done in pool.each(work, [(0.0,), (600.0,), (600.0,), (600.0,)]):",
        "with on_this_computer(2) as pool:\n      for done in pool.each_apart(time.sleep, [(0.0,), (600.0,), (600.0,)]):",
    ],
    ids=["shared", "apart"],
)
def test_ctrl_c_ends_them_at_once_and_leaves_what_is_done(begin: str) -> None:
    """Also in a script without ``if __name__ == "__main__"``; nobody but the script speaks."""
    process = script(STOPPED.format(begin=begin))
    assert process.stdout is not None
    try:
        assert process.stdout.readline().startswith("(0, ")
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=30)  # pipes end with the last of the processes that hold them
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert (out, err, process.returncode) == ("stopped\n", "", 0)


def ends_once(index: int, seen: Path) -> int:
    """The first to come here ends its process."""
    try:
        seen.touch(exist_ok=False)
    except FileExistsError:
        return 10 * index
    os._exit(9)


def test_what_a_process_had_begun_that_was_ended_is_given_to_another(tmp_path: Path) -> None:
    with workers(2) as pool:
        assert dict(pool.each(ends_once, [(k, tmp_path / "seen") for k in range(4)])) == {k: 10 * k for k in range(4)}
    assert (tmp_path / "seen").exists()


def test_processes_that_are_always_ended_end_the_work() -> None:
    with pytest.raises(NotAvailable, match="2 processes .* ended from outside"), workers(2) as pool:
        list(pool.each(os._exit, [(9,), (9,)]))


# --- threads


def test_threads_stay() -> None:
    pool = computer.threads(2)
    assert computer.threads(2) is pool
    assert list(pool.map(fail, [3, 4])) == [3, 4]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_pieces_side_by_side_come_in_order_and_may_be_left_out_meanwhile(count: int) -> None:
    """The largest so far leaves out what is smaller and has not begun."""
    begun: list[int] = []
    largest = 0

    def work(piece: int) -> int:
        begun.append(piece)
        time.sleep(0.01 * (5 - piece % 5))
        return fail(piece)

    found = []
    for piece, result in computer.side_by_side(count, work, (p for p in (2, 9, 4, 5, 11, 3) if p > largest)):
        assert result == piece
        if piece > largest:
            found.append(piece)
            largest = piece
    assert found == [2, 9, 11] and {2, 9, 11} <= set(begun)
    assert set(begun) <= {1: {2, 9, 11}, 2: {2, 9, 4, 11}}.get(count, {2, 9, 4, 5, 11})


@pytest.mark.parametrize("count", [1, 2])
def test_linear_algebra_has_one_thread_side_by_side(count: int) -> None:
    before = who(0)
    assert {threads for _, (_, threads) in computer.side_by_side(count, who, [0, 1, 2])} == {1}
    assert who(0) == before


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_side_by_side_is_that_of_the_whole(count: int) -> None:
    ended: list[int] = []

    def work(piece: int) -> int:
        try:
            return fail(piece)
        finally:
            time.sleep(0.02 * piece)
            ended.append(piece)

    done: list[int] = []
    with pytest.raises(ConfigError, match="index is 0, expected more"):
        done.extend(piece for piece, _ in computer.side_by_side(count, work, [2, 0, 3, 4]))
    assert done == [2] and 4 not in ended and set(ended) >= {0, 2}


def test_who_wants_no_more_waits_for_what_has_begun() -> None:
    ended: list[int] = []

    def work(piece: int) -> int:
        time.sleep(0.02)
        ended.append(piece)
        return piece

    pieces = computer.side_by_side(2, work, range(1, 9))
    assert next(pieces) == (1, 1)
    pieces.close()  # type: ignore[attr-defined]
    assert sorted(ended) in ([1, 2], [1, 2, 3])


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc's malloc")
@pytest.mark.parametrize("thread", [False, True])
def test_memory_that_is_freed_is_taken_again_without_being_cleared_page_by_page(thread: bool) -> None:
    many = """
import resource, sys, threading
from equimus_ctrl.computer import keep_freed_memory
keep_freed_memory()

def fill():
    return b"x" * (40 << 20)

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    if sys.argv[1] == "True":
        other = threading.Thread(target=fill)
        other.start()
        other.join()
    else:
        fill()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(faults(), faults())
"""
    ran = subprocess.run([sys.executable, "-c", many, str(thread)], capture_output=True, text=True, check=True)
    first, again = map(int, ran.stdout.split())
    assert again < 0.05 * first
