"""Pieces of work on their way to another process: bytes until the process that does them.

Who only passes them on (a scheduler, a worker of a cluster) imports nothing of what they are made of. A piece comes
from a program of some version and is done by the same one or not at all.
"""

from __future__ import annotations

import hashlib
import pickle
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cloudpickle

from equimus_ctrl.errors import EquimusError, NotAvailable, one_line
from equimus_ctrl.executors.versions import mismatch, versions

KEPT = 4
"""Functions, with what they are bound to, that a process keeps ready."""


class Unfit(NotAvailable):
    """A process that cannot do this work, whichever piece of it: another version, or what it needs is not there."""


class Gone(NotAvailable):
    """What was to do the work is not there any more."""


class Ended(EquimusError):
    """A process ended before its piece of work was done; the message says how."""


class Lost(Ended):
    """Workers were lost that did this piece, perhaps others beside it, so whether it ended them is not known."""


@dataclass(frozen=True)
class Call:
    """One piece of work.

    Attributes:
        work: a function, pickled, with what it is bound to.
        args: its arguments, pickled.
        prepare: what a process has to do first, pickled.
        apart: whether a process of its own does it, which has done nothing before.
        made_by: versions where it comes from, which whoever does it has to have.
    """

    work: bytes
    args: bytes
    prepare: bytes | None = None
    apart: bool = False
    made_by: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        work: Callable[..., Any],
        args: tuple[Any, ...],
        prepare: Callable[[], object] | None = None,
        apart: bool = False,
        made_by: Mapping[str, str] | None = None,
    ) -> Call:
        """Of a function and arguments that can be pickled."""
        before = None if prepare is None else cloudpickle.dumps(prepare)
        return cls(cloudpickle.dumps(work), cloudpickle.dumps(args), before, apart, made_by or {})

    @property
    def digest(self) -> str:
        """Of the function with what it is bound to: the same of many pieces."""
        return hashlib.sha256(self.work).hexdigest()


def cannot_be_sent(thing: Any) -> str | None:
    """Why something cannot be given to another process; None where it can."""
    try:
        cloudpickle.dumps(thing)
    except Exception as error:  # whatever a user's own object raises
        return one_line(f"{type(error).__name__}: {error}")
    return None


_prepared: set[bytes] = set()
_kept: OrderedDict[str, Any] = OrderedDict()


def perform(call: Call) -> bytes:
    """Do a piece of work in this process: what it came to, or the exception that ended it, pickled; see ``opened``."""
    try:
        _check(call)
        result = (True, _work(call)(*pickle.loads(call.args)))
        return bytes(cloudpickle.dumps(result))
    except Exception as error:
        if not isinstance(error, EquimusError):
            error.add_note(traceback.format_exc())
        return failed(error)


def failed(error: Exception) -> bytes:
    """What ``perform`` gives for work that an exception ended."""
    try:
        return bytes(cloudpickle.dumps((False, error)))
    except Exception:
        return bytes(cloudpickle.dumps((False, EquimusError(one_line(f"{type(error).__name__}: {error}")))))


def _check(call: Call) -> None:
    if (other := mismatch(versions(), call.made_by)) is not None:
        raise Unfit(f"there is {other}; the same has to be installed wherever the work is done")
    if call.prepare is not None and call.prepare not in _prepared:
        try:
            pickle.loads(call.prepare)()
        except EquimusError as error:
            raise Unfit(str(error)) from None
        _prepared.add(call.prepare)


def _work(call: Call) -> Callable[..., Any]:
    key = call.digest
    if key not in _kept:
        _kept[key] = pickle.loads(call.work)
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
    _kept.move_to_end(key)
    return _kept[key]  # type: ignore[no-any-return]


def opened(found: bytes) -> Any:
    """What a piece of work came to.

    Raises:
        Exception: the one that ended it.
    """
    good, value = pickle.loads(found)
    if not good:
        raise value
    return value
