"""Work on the workers of a Dask cluster, whose scheduler is known by its address.

A worker passes pieces on to processes of its own, see ``child``: it stays in touch with the scheduler whatever is
computed, its number of threads is how many it does at a time, and a piece finds what it would find on this computer. A
worker that is lost loses the pieces that it had begun, which the scheduler gives to others.
"""

from __future__ import annotations

import logging
import pickle
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from equimus_ctrl.errors import NotAvailable, one_line
from equimus_ctrl.executors.base import Executor, Prepare
from equimus_ctrl.executors.calls import Call, Ended, Gone, Lost, failed
from equimus_ctrl.executors.child import Child
from equimus_ctrl.executors.versions import mismatch, processor, versions, warn_of_mix

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as DaskFuture

ANSWERS_WITHIN = 10.0
"""A scheduler, and the first of its workers [s]."""
COUNTED_EVERY = 2.0
"""How often the workers are counted, which come and go [s]."""
LOOKED_EVERY = 0.5
"""How often a worker looks whether what it does is still wanted [s]."""
IDLE = 300.0
"""A process of a worker that has had nothing to do for so long is ended: its client may have been killed [s]."""


class OnDask(Executor):
    """The workers of a Dask cluster.

    Args:
        client: connected.
        address: of the scheduler, for messages.
        prepare: see ``Prepare``.
    """

    def __init__(self, client: Client, address: str, prepare: Prepare | None = None) -> None:
        super().__init__(prepare)
        self._address, self._mixed = address, False
        self._client = client
        self._session = uuid.uuid4().hex
        self._count, self._counted = 0, -COUNTED_EVERY

    @property
    def count(self) -> int:
        if time.monotonic() - self._counted >= COUNTED_EVERY:
            with suppress(OSError):  # of a scheduler that is gone its tasks tell
                self._count = sum(self._client.nthreads().values())
            self._counted = time.monotonic()
        return max(self._count, 1)

    def _give(self, call: Call) -> Future[bytes]:
        return _told(self._client.submit(_do_here, self._session, pickle.dumps(call), pure=False), self.compare)

    def compare(self, processors: Mapping[str, Mapping[str, str]]) -> None:
        """Warn, once, where a worker has another kind of processor than this computer, also one that joined later.

        Args:
            processors: worker → its ``processor()``.
        """
        if not self._mixed:
            named = {f"{self._address}: worker {worker}": own for worker, own in sorted(processors.items())}
            self._mixed = warn_of_mix(named)

    def close(self) -> None:
        """Have the workers end the processes that did this work, and take leave."""
        with suppress(Exception):  # of a cluster that is gone nothing is left to be ended
            self._client.run(_let_go, self._session, on_error="ignore")
        with suppress(Exception):
            self._client.close(timeout=ANSWERS_WITHIN)


def _told(given: DaskFuture, seen: Callable[[Mapping[str, Mapping[str, str]]], None]) -> Future[bytes]:
    """What a piece comes to alone, with what goes wrong in Dask in the words of an executor.

    Args:
        given: the piece, as ``_do_here`` does it. It is let go of as soon as it is done: a worker keeps what somebody
            still wants, and where that worker is lost Dask has all of it done again.
        seen: told the worker that has done it, and its processor.
    """
    from distributed.scheduler import KilledWorker

    told: Future[bytes] = Future()

    def tell(done: DaskFuture) -> None:
        with suppress(InvalidStateError):  # cancelled meanwhile
            try:
                found, worker, own = done.result()
                seen({worker: own})
                told.set_result(found)
            except KilledWorker as error:
                told.set_exception(Lost(f"took {error.allowed_failures + 1} workers with it, one after the other"))
            except CancelledError:
                told.set_exception(
                    Gone("the Dask scheduler is gone, or it has dropped this work; the same command goes on from here")
                )
            except InvalidStateError:
                raise
            except BaseException as error:
                told.set_exception(error)
            finally:
                done.release()

    told.add_done_callback(lambda future: given.cancel() if future.cancelled() else None)
    given.add_done_callback(tell)
    return told


@contextmanager
def on_dask(address: str, prepare: Prepare | None = None) -> Iterator[OnDask]:
    """The workers of a scheduler; all of them are looked at first, and who joins later at the first piece that it does.

    Args:
        address: such as ``tcp://head:8786``.
        prepare: see ``Prepare``.

    Raises:
        NotAvailable: where Dask is not installed, no scheduler or no worker answers, or a worker has another version of
            the program, Python or a library; ``Gone`` where the scheduler goes away while it works.
    """
    client = _client(address)
    executor = OnDask(client, address, prepare)
    try:
        executor.compare(_look_at(client, address))
        yield executor
    finally:
        executor.close()


def _client(address: str) -> Client:
    try:
        import distributed
    except ImportError:
        raise NotAvailable(
            "a Dask cluster needs the distributed library, which is not installed; get it with: pip install "
            "'equimus-ctrl[cluster]'"
        ) from None
    # What is told of a lost worker or scheduler, we tell.
    for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # versions are looked at below
            return distributed.Client(address, timeout=ANSWERS_WITHIN, set_as_default=False, name="equimus-ctrl")
    except (OSError, TimeoutError):
        raise NotAvailable(
            f"{address}: no Dask scheduler answers there within {ANSWERS_WITHIN:g} s; expected the address that "
            "`dask scheduler` prints"
        ) from None
    except ValueError as error:
        raise NotAvailable(f"{address}: is no address of a Dask scheduler ({one_line(str(error))})") from None


def _look_at(client: Client, address: str) -> dict[str, Mapping[str, str]]:
    """Worker → its processor; raise NotAvailable where there is no worker, or one that cannot do the same work."""
    try:
        client.wait_for_workers(1, timeout=ANSWERS_WITHIN)
    except TimeoutError:
        raise NotAvailable(
            f"{address}: the scheduler has no worker, and none came within {ANSWERS_WITHIN:g} s; start some with "
            f"`dask worker {address}`"
        ) from None
    for worker, found in sorted(client.run(versions, on_error="return").items()):
        if isinstance(found, BaseException):
            why = f"cannot say its versions ({one_line(f'{type(found).__name__}: {found}')})"
        elif (other := mismatch(found)) is not None:
            why = f"has {other}"
        else:
            continue
        raise NotAvailable(f"{address}: worker {worker} {why}; expected what is installed here on every worker")
    return dict(client.run(processor, on_error="ignore"))


# --- on a worker

_idle: dict[tuple[str, int], tuple[Child, threading.Timer]] = {}
"""Session and thread → the process that waits for its next piece that needs none of its own, and what will end it."""


def _do_here(session: str, given: bytes) -> tuple[bytes, str, Mapping[str, str]]:
    """What a piece of work comes to, the address of the worker that does it, and its ``processor()``."""
    from distributed import get_worker

    return _do(session, given), str(get_worker().address), processor()


def _do(session: str, given: bytes) -> bytes:
    """Have a process of this worker do a piece of work; where it is not wanted any more, that process is ended."""
    call = pickle.loads(given)
    key = session, threading.get_ident()
    child = (None if call.apart else _awake(key)) or Child()
    done = threading.Event()
    watch = threading.Thread(target=_watch, args=(_task(), child, done), daemon=True)
    watch.start()
    kept = False
    try:
        found = child.do(call)
        kept = not call.apart
        return found
    except Ended as error:
        return failed(error)
    finally:
        done.set()
        watch.join()
        if kept:
            _put_aside(key, child)
        else:
            child.end()


def _task() -> Any:
    """What the worker knows of the task that this thread does."""
    from distributed import get_worker

    worker = get_worker()
    return worker.state.tasks.get(worker.get_current_task())


def _watch(task: Any, child: Child, done: threading.Event) -> None:
    while not done.wait(LOOKED_EVERY):
        if task is not None and task.state == "cancelled":
            child.end()
            return


def _awake(key: tuple[str, int]) -> Child | None:
    """The process that waits for a piece; None where there is none, or it has waited too long."""
    child, timer = _idle.pop(key, (None, None))  # whoever takes it out ends it
    if timer is not None:
        timer.cancel()
    return child


def _put_aside(key: tuple[str, int], child: Child) -> None:
    timer = threading.Timer(IDLE, _end, (key, child))
    timer.daemon = True
    _idle[key] = child, timer
    timer.start()


def _end(key: tuple[str, int], child: Child) -> None:
    if _idle.get(key, (None,))[0] is child and (own := _awake(key)) is not None:
        own.end()


def _let_go(session: str) -> None:
    for key in [key for key in list(_idle) if key[0] == session]:
        if (child := _awake(key)) is not None:
            child.end()
