"""What is generated for the joints of MJCF robots: here only by name, so that the kernel can be read and checked."""

from __future__ import annotations

from typing import Any

from equimus_ctrl.types import Array

N_STATES = 0
"""Of all laws at one joint, at least one."""


def prepare(p: Array) -> Array:
    """Constants that follow from the laws' parameters at one joint."""
    raise NotImplementedError


def joint_force(x: Any, z: Any, c: Array) -> Any:
    """(generalised force, greatest dry friction, changes of the laws' states over a step …).

    Of (coordinate, rate, load, step) and the states; see ``models.augmented.state_change``.
    """
    raise NotImplementedError


def joint_start(x: Any, c: Array) -> Any:
    """The laws' states where a trial starts, at (coordinate, rate, time since the recording began)."""
    raise NotImplementedError


def state_tuple(values: Array) -> Any:
    """States as a tuple."""
    raise NotImplementedError
