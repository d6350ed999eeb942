"""Models whose parameters are overwritten before each use: that takes less time than a copy."""

from __future__ import annotations

import copy
from threading import local
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.plan import Assets
from equimus_ctrl.types import Array

KEPT = 64
"""So many models are kept in each thread."""
_WRITTEN = ("body_", "dof_", "jnt_", "qpos_", "tendon_", "actuator_")
"""Prefixes of the arrays of a model that hold a robot's parameters."""


class Scratch(local):
    """One such model for each file and thread."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, Assets], tuple[Any, Any, list[tuple[Array, Array]]]] = {}

    def blank(self, xml: str, assets: Assets, base: Any) -> tuple[Any, Any]:
        """A model with the parameters of ``base``, to be used before the next is asked for, and its data."""
        key = (xml, assets)
        if key not in self.known:
            if len(self.known) >= KEPT:
                self.known.clear()
            model = copy.copy(base)
            names = [n for n in dir(base) if n.startswith(_WRITTEN) and isinstance(getattr(base, n), np.ndarray)]
            pairs = [(getattr(model, name), getattr(base, name)) for name in names]
            self.known[key] = model, mujoco.MjData(model), [(own, given) for own, given in pairs if own.size]
        model, data, pairs = self.known[key]
        for own, given in pairs:
            own[...] = given
        model.opt.gravity[:], model.opt.timestep = base.opt.gravity, base.opt.timestep
        model.opt.disableflags = base.opt.disableflags
        return model, data
