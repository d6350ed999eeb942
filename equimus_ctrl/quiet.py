"""MuJoCo without its own words: warnings are counted in ``MjData``, which is where they are read."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def quietly() -> Iterator[None]:
    """MuJoCo's warnings neither on the screen nor in its log; in several threads, until the last of them leaves."""
    _ENTERED.enter()
    try:
        yield
    finally:
        _ENTERED.leave()


class _Entered:
    """How many are in ``quietly``, and what heard warnings before the first of them: MuJoCo has one handler for all."""

    def __init__(self) -> None:
        self._lock, self._count, self._before = threading.Lock(), 0, None

    def enter(self) -> None:
        with self._lock:
            if self._count == 0:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_counted)
            self._count += 1

    def leave(self) -> None:
        with self._lock:
            self._count -= 1
            if self._count == 0:
                mujoco.set_mju_user_warning(self._before)


_ENTERED = _Entered()


def _counted(message: str) -> None:
    """MuJoCo has counted it."""


def step_quietly(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """One step without MuJoCo's own words; False where it warned or lost its numbers."""
    # Not by the context manager, which takes a fifth of a leg's step.
    _ENTERED.enter()
    try:
        mujoco.mj_step(model, data)
    finally:
        _ENTERED.leave()
    return not data.warning.number.any()
