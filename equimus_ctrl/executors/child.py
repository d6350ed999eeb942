"""A process that does pieces of work for another, and ends when that does, however it ends.

It does not hear Ctrl-C: who started it ends it. Linear algebra has one thread in it. What it prints goes to standard
error. It is started anew, not forked, for a fork copies locks that other threads may hold; and not through
``multiprocessing``, whose daemons, such as the workers of a Dask cluster, may have no processes of their own.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from queue import SimpleQueue
from typing import IO

from equimus_ctrl.computer import ONE_THREAD
from equimus_ctrl.executors.calls import Call, Ended, perform

LENGTH = 8
"""Bytes that say how many follow."""
START = "import sys; sys.path[:] = {path!r}; from equimus_ctrl.executors.child import serve; serve()"


class Child:
    """A process that waits for pieces of work."""

    def __init__(self) -> None:
        code = START.format(path=sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            start_new_session=True,  # where no Ctrl-C of the terminal comes
        )
        self._talking = threading.Lock()

    def do(self, call: Call) -> bytes:
        """What a piece of work comes to, see ``calls.opened``.

        Raises:
            Ended: where the process ended before it had done it.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        with self._talking:
            try:
                _send(self._process.stdin, pickle.dumps(call))
                found = _receive(self._process.stdout)
            except (BrokenPipeError, ValueError):  # it has ended, or was ended before
                found = None
        if found is None:
            code = self._process.wait()
            self.end()
            raise Ended(_how(code))
        return found

    def end(self) -> None:
        """End the process, whatever it does; whoever waits for that is told ``Ended``."""
        self._process.kill()
        self._process.wait()
        with self._talking:
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                with suppress(BrokenPipeError):  # what was not sent is not wanted any more
                    pipe.close()


def _how(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"was ended from outside ({name})"


def _send(pipe: IO[bytes], data: bytes) -> None:
    pipe.write(len(data).to_bytes(LENGTH, "big"))
    pipe.write(data)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> bytes | None:
    """What was sent; None where nothing more will be."""
    head = pipe.read(LENGTH)
    if len(head) < LENGTH:
        return None
    size = int.from_bytes(head, "big")
    data = pipe.read(size)
    return data if len(data) == size else None


def serve() -> None:
    """Do the pieces of work that come through standard input; end when that does, whatever is being done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(os.dup(1), "wb") as told:
        os.dup2(2, 1)  # anybody may print, and results go where nobody does
        sys.stdout = sys.stderr
        waiting: SimpleQueue[bytes] = SimpleQueue()
        threading.Thread(target=_listen, args=(waiting,), daemon=True).start()
        while True:
            _send(told, perform(pickle.loads(waiting.get())))


def _listen(waiting: SimpleQueue[bytes]) -> None:
    while (data := _receive(sys.stdin.buffer)) is not None:
        waiting.put(data)
    os._exit(0)
