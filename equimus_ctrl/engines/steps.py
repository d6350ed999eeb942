"""Whether a physics step follows a robot's fastest motion."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from equimus_ctrl.engines.limits import FOLLOWED, MOST_DIVISOR, PRESSED
from equimus_ctrl.models.linear import fastest_rates
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array

STABLE = 2.78
"""Largest |λ|·dt at which the Runge–Kutta method of order four is stable."""
FEW = 100


def rates_at(morphology: Morphology, phase: Phase, poses: Sequence[Array]) -> tuple[float, float]:
    """Largest |λ| [1/s] away from the stops and with them pressed, over a few of the poses and the joints' ends."""
    ends = [np.where(np.isfinite(side), side, 0.0) for side in morphology.joint_range]
    chosen = [*list(poses)[:: max(len(poses) // FEW, 1)], *ends]
    found = [fastest_rates(morphology, pose, phase) for pose in chosen]
    return max(free for free, _ in found), max(pressed for _, pressed in found)


def step_divisor(morphology: Morphology, phase: Phase, poses: Sequence[Array], dt: float, *, stops: bool = True) -> int:
    """By how much a step dt [s] is to be divided so that it follows the robot, and its joints' stops if so asked."""
    free, pressed = rates_at(morphology, phase, poses)
    wanted = max(free * dt / FOLLOWED, pressed * dt / PRESSED if stops else 0.0, 1.0)
    return min(math.ceil(wanted), MOST_DIVISOR) if math.isfinite(wanted) else MOST_DIVISOR


def warn_if_coarse(
    morphology: Morphology,
    phase: Phase,
    poses: Sequence[Array],
    dt: float,
    reached: Sequence[Array],
    pressed_divisor: int = 1,
) -> None:
    """Warn where a step is too long for a robot, or for the stops that its joints (n, nj) reached [rad].

    Args:
        morphology: the robot.
        phase: base fixed or foot pinned.
        poses: (nj,) each, where its rates are taken [rad].
        dt: the step [s].
        reached: what the joints went through.
        pressed_divisor: by how much the engine divides its steps at most while a stop is pressed.
    """
    free, pressed = rates_at(morphology, phase, poses)
    if free * dt > STABLE:
        warnings.warn(
            f"{morphology.name}: a physics step of {dt * 1e3:g} ms is too long for its fastest motion; "
            f"expected at most {FOLLOWED / free * 1e3:.2g} ms",
            stacklevel=3,
        )
        return
    low, high = morphology.joint_range
    touched = any(np.any((q < low) | (q > high)) for q in reached)
    if touched and pressed * dt > STABLE * pressed_divisor:
        warnings.warn(
            f"{morphology.name}: a joint stop was touched, and a physics step of {dt * 1e3:g} ms is too long for its "
            f"force; expected at most {PRESSED * pressed_divisor / pressed * 1e3:.2g} ms",
            stacklevel=3,
        )
