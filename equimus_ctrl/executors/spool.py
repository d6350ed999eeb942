"""The folder through which pieces of work come to jobs of a cluster, and what a job does; all nodes see it.

    <folder>/todo/0000012.3       a piece to be done, for the third time
    <folder>/doing/<job>/<name>   that a job has taken, by renaming it
    <folder>/done/<name>          what it came to
    <folder>/client               a number that grows as long as somebody waits; jobs end when it does not
    <folder>/processors/<job>     of which kind its processor is
    <folder>/jobs/                submitit's own

So jobs take pieces as they come free, and however many there are, few jobs wait in Slurm's queue. What a job had taken
that has ended is given to another, and so is its place; one that Slurm starts again, with the same number, gives it
back itself. Nothing but renaming has to be atomic, as it is on NFS, where a file that another renames may be stale as
well.
"""

from __future__ import annotations

import errno
import json
import pickle
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from equimus_ctrl.executors.calls import Ended, Lost, failed
from equimus_ctrl.executors.child import Child
from equimus_ctrl.executors.versions import processor

ATTEMPTS = 4
"""At most, of one piece; so many times in a row jobs may be submitted, too, before any more is done."""
LOOKED_EVERY, CLIENT_EVERY = 0.2, 1.0
"""How often a folder is looked at, and whether the client is there [s]."""
GONE_AFTER = 120.0
"""What the client has not shown for so long, it never will [s]."""


def name_of(number: int, attempt: int | str) -> str:
    """Of a piece."""
    return f"{number:07d}.{attempt}"


def numbers_in(name: str) -> tuple[int, int]:
    """Which piece, for which time."""
    number, attempt = name.split(".")
    return int(number), int(attempt)


def write(path: Path, data: bytes) -> None:
    """Whole or not at all."""
    half = path.with_name(f".{path.name}.tmp")
    half.write_bytes(data)
    half.replace(path)


@contextmanager
def others_rename() -> Iterator[None]:
    """For files that another machine may take away meanwhile: they are gone, or stale, as NFS says."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.ESTALE):
            raise


def put_back(folder: Path, own: Path) -> None:
    """Give what a job had taken that has ended to others; what has taken too many with it is told."""
    for path in sorted(own.glob("[0-9]*")):
        number, attempt = numbers_in(path.name)
        with others_rename():
            if attempt < ATTEMPTS:
                path.replace(folder / "todo" / name_of(number, attempt + 1))
            else:
                told = failed(Lost(f"took {ATTEMPTS} jobs with it, one after the other"))
                write(folder / "done" / path.name, told)
                path.unlink(missing_ok=True)


# --- in a job


def work_as_job(folder: Path, workers: int, path: Sequence[str]) -> None:
    """Take pieces and do them, until the client is gone; modules are found where it finds them, see ``sys.path``."""
    import submitit

    sys.path += [place for place in path if place not in sys.path]
    own = folder / "doing" / str(submitit.JobEnvironment().job_id)
    own.mkdir(parents=True, exist_ok=True)
    write(folder / "processors" / own.name, json.dumps(processor()).encode())
    put_back(folder, own)  # of the same job, before it was preempted and started again
    over = threading.Event()
    threads = [threading.Thread(target=_work_off, args=(folder, own, over)) for _ in range(workers)]
    for thread in threads:
        thread.start()
    last, seen = None, time.monotonic()
    try:
        while time.monotonic() - seen < GONE_AFTER and any(thread.is_alive() for thread in threads):
            try:
                if (now := (folder / "client").read_bytes()) != last:
                    last, seen = now, time.monotonic()
            except FileNotFoundError:
                return  # the client has taken it away
            except OSError as error:  # it was just replaced
                if error.errno != errno.ESTALE:
                    raise
            time.sleep(CLIENT_EVERY)
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
            data = b""
            with others_rename():  # it may be dropped by now
                data = taken.read_bytes()
            if not data:
                continue
            call = pickle.loads(data)
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
                write(folder / "done" / taken.name, found)
                taken.unlink(missing_ok=True)
    finally:
        if kept is not None:
            kept.end()


def _taken(folder: Path, own: Path) -> Path | None:
    """A piece that nobody else has taken; None of none."""
    with others_rename():
        for path in sorted((folder / "todo").glob("[0-9]*")):
            with others_rename():  # somebody was faster
                return path.rename(own / path.name)
    return None


def _watch(taken: Path, child: Child, over: threading.Event, done: threading.Event) -> None:
    while not done.wait(LOOKED_EVERY):
        if over.is_set() or not taken.exists():
            child.end()
            return
