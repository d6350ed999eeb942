"""MuJoCo without its own words: warnings are counted in ``MjData``, which is where they are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def quietly() -> Iterator[None]:
    """MuJoCo's warnings neither on the screen nor in its log."""
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_counted)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


def _counted(message: str) -> None:
    """MuJoCo has counted it."""


def step_quietly(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """One step without MuJoCo's own words; False where it warned or lost its numbers."""
    # Not by the context manager, which takes a fifth of a leg's step.
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_counted)
    try:
        mujoco.mj_step(model, data)
    finally:
        mujoco.set_mju_user_warning(previous)
    return not data.warning.number.any()
