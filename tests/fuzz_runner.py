"""Runs cases of wrong input in one process and says of each what it broke; ``python tests/fuzz_runner.py --help``.

A process of its own, for it bounds its memory, replaces the descriptors of its output, and may be killed by a case.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from fuzz_cases import Case, case, right_files, unchanged

from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.executors.where import Where
from equimus_ctrl.plants.hardware import transports
from equimus_ctrl.recordings import download
from equimus_ctrl.validation import validate as validation
from equimus_ctrl.workflow import diagnoses, plugins

SECONDS, WALL = 15, 120
"""Of processor time that a case may take, and by the clock."""
ADDRESSES, GROWTH = 12 * 2**30, 1.5 * 2**20
"""Address space of the process [B], and by how much a case may raise the most memory it ever had [kB]."""
SENTENCE, MANY = 1100, 12
"""Characters of a message, and warnings at most."""


class TooLong(BaseException):
    """A case that takes more time than any input may."""


def stopped(*_: Any, **__: Any) -> Any:
    """In the place of what is shared out among processes, sent or fetched: all that is given was checked by then."""
    raise NotAvailable("the fuzzer goes no farther")


def seal() -> None:
    """No processes, no network and no robot."""
    Where.opened = Where.shared = stopped  # type: ignore[method-assign]
    for module, name in ((validation, "validate"), (diagnoses, "diagnose_within"), (download, "_tree")):
        assert callable(getattr(module, name))  # else another is called
        setattr(module, name, stopped)
    transports.TRANSPORTS["dds"] = transports.TransportEntry("none in here", stopped, stopped)


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Raise ``TooLong`` in here after so much time."""

    def over(number: int, frame: FrameType | None) -> None:
        raise TooLong("by the clock" if number == signal.SIGALRM else "of the processor")

    signal.signal(signal.SIGPROF, over)
    signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WALL)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


@contextlib.contextmanager
def captured(folder: Path) -> Iterator[None]:
    """What is printed, by whatever library, goes to ``out`` and ``err``."""
    kept = os.dup(1), os.dup(2)
    streams = sys.stdout, sys.stderr
    with open(folder / "out", "w+b") as out, open(folder / "err", "w+b") as err:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        sys.stdout, sys.stderr = (
            io.TextIOWrapper(io.FileIO(fd, "w", closefd=False), "utf-8", "backslashreplace") for fd in (1, 2)
        )
        try:
            yield
        finally:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):
                    stream.flush()
            sys.stdout, sys.stderr = streams
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            os.close(kept[0])
            os.close(kept[1])


def lay_out(folder: Path, own: Case) -> None:
    """The folder that a case is run in: its files, and some odd ones."""
    for name, data in own.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    (folder / "link").symlink_to("nowhere")
    for name in ("folder", "empty", "sealed"):
        (folder / name).mkdir()
    (folder / "file").write_text("in the way")
    (folder / "folder" / "other.txt").write_text("somebody's")
    (folder / "sealed").chmod(0o555)


def held(folder: Path) -> dict[str, Any]:
    """What is in a folder."""
    found: dict[str, Any] = {}
    for path in folder.rglob("*"):
        if "__pycache__" in path.parts:
            continue
        mode = path.lstat().st_mode
        found[str(path.relative_to(folder))] = path.read_bytes() if stat.S_ISREG(mode) else stat.S_IFMT(mode)
    return found


def problems(own: Case, code: Any, out: str, err: str, before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """What a case broke, in words."""
    if code not in (0, 2, 3):
        yield f"exit code {code}"
    if "Traceback" in err or "Exception ignored" in err:
        yield "a traceback"
    said = [
        line
        for line in err.splitlines()
        if line.startswith("equimus-ctrl: ") and not line.startswith("equimus-ctrl: warning: ")
    ]
    judged = code == 2 and own.arguments[:1] == ("check",) and not said  # its report says what stops a diagnosis
    if code in (2, 3) and len(said) != 1 and not judged and not (code == 3 and own.arguments[0] == "compare"):
        yield f"{len(said)} sentences"
    for line in err.splitlines() + out.splitlines():
        if line.startswith("equimus-ctrl: ") and len(line) > SENTENCE:
            yield f"a sentence of {len(line)} characters"
        if re.search(r"MemoryError|Unable to allocate|(^|\s)WARNING:|mujoco\.FatalError|RuntimeWarning", line):
            yield f"says {line[:120]}"
    if err.count("equimus-ctrl: warning: ") > MANY:
        yield "too many warnings"
    if code == 0 and said:
        yield "a sentence of what is wrong, and exit code 0"
    if "--json" in own.arguments:
        if out:
            try:
                json.loads(out, parse_constant=lambda name: (_ for _ in ()).throw(ValueError(name)))
            except ValueError as error:
                yield f"no JSON: {error}"
        elif code == 0 and "--help" not in own.arguments:
            yield "no JSON at all"
    elif out and code not in (0, None) and "Usage:" not in out:
        yield f"on standard output: {out[:100]}"
    for path in sorted({*before, *after}):
        if before.get(path) != after.get(path) and not any(_below(path, where) for where in own.outputs):
            yield f"{path!r} was {'written' if path not in before else 'taken away' if path not in after else 'changed'}"


def _below(path: str, where: str) -> bool:
    where = os.path.normpath(where)
    return (
        where == "."
        or path == where
        or path.startswith(where + "/")
        or where.startswith(path + "/")
        or path.startswith(where + ".")
    )


def run(own: Case, scratch: Path) -> dict[str, Any]:
    """Run a case; what came of it."""
    registries: list[dict[Any, Any]] = [*plugins.known(), plugins._loaded]
    kept = [dict(known) for known in registries]
    folder, said, loose = scratch / "here", scratch / "said", scratch / "tmp"
    for path in (folder, said, loose):
        path.mkdir()
    lay_out(folder, own)
    tempfile.tempdir = str(loose)
    os.chdir(folder)
    before, most, begun = held(folder), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    code: Any = None
    failed = ""
    with captured(said), warnings.catch_warnings():
        warnings.simplefilter("default")
        try:
            with bounded():
                code = main(list(own.arguments))
        except BaseException as error:  # whatever it is, it is a finding
            failed = f"{type(error).__name__}: {error}"
            code = "".join(traceback.format_exception(error, limit=-4))
    os.chdir(scratch)
    seconds = time.process_time() - begun
    out, err = ((said / name).read_text(encoding="utf-8", errors="replace") for name in ("out", "err"))
    found = list(problems(own, code, out, err, before, held(folder)))
    if (grown := resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - most) > GROWTH:
        found.append(f"{grown / 2**20:.1f} GB of memory")
    if left := sorted(path.name for path in loose.iterdir()):
        found.append(f"left {left} among temporary files")
    for known, held_before in zip(registries, kept, strict=True):
        known.clear()
        known.update(held_before)
    (folder / "sealed").chmod(0o755)
    for path in (folder, said, loose):
        shutil.rmtree(path)
    return {"case": own.name, "arguments": own.arguments, "code": code if isinstance(code, int) else None,
            "failed": failed, "problems": found, "seconds": seconds, "err": err[-3000:], "out": out[-300:]}  # fmt: skip


def main_of(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--log", type=Path, help="a line of JSON for each case, and one before it with its name")
    parser.add_argument("--keep", type=Path, help="put a case's files there and run nothing")
    parser.add_argument("--right", action="store_true", help="the calls as they are, nothing changed")
    given = parser.parse_args(arguments)
    seal()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        right = right_files(scratch / "right")
        if given.keep:
            own = case(given.seed, given.first, right)
            given.keep.mkdir()
            lay_out(given.keep, own)
            print(json.dumps(own.arguments))
            return 0
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, resource.getrlimit(resource.RLIMIT_AS)[1]))
        log = given.log.open("w") if given.log else sys.stdout
        wrong = 0
        made = (case(given.seed, k, right) for k in range(given.first, given.first + given.count))
        for own in unchanged(right) if given.right else made:
            print(json.dumps({"begun": own.name, "arguments": own.arguments}), file=log, flush=True)
            done = run(own, scratch)
            wrong += bool(done["problems"])
            print(json.dumps(done), file=log, flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main_of())
