"""MuJoCo's numbers of bodies, which a load changes while a robot moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from equimus_ctrl.types import Array

BODIES = (
    "body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0", "dof_invweight0",
    "dof_M0", "tendon_invweight0", "actuator_acc0",
)  # fmt: skip
"""What MuJoCo works out of the bodies' masses."""


def numbers_of(model: Any) -> Mapping[str, Array]:
    """A copy of ``BODIES`` of an ``mujoco.MjModel``."""
    return {name: np.array(getattr(model, name)) for name in BODIES}
