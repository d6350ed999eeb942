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
    """(generalised force, greatest dry friction, rates of the laws' states …) of coordinate, rate, load and states."""
    raise NotImplementedError


def joint_rest(x: Any, c: Array) -> Any:
    """The laws' states after a long rest at a coordinate (x,)."""
    raise NotImplementedError


def state_tuple(values: Array) -> Any:
    """States as a tuple."""
    raise NotImplementedError
