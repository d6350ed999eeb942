"""Laws that MuJoCo has no field for, stepped beside many robots in one ``mujoco.batch.Batch``."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Robots
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.mujoco_forces import ForceBatch
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.body import Body
from equimus_ctrl.plants.elastic_body import ElasticBody
from equimus_ctrl.plants.mjcf_body import MjcfBody
from equimus_ctrl.types import Array


class Laws(Protocol):
    """The laws of robots that have the same."""

    def begin(self, row: int, body: Body, position: Array, velocity: Array) -> None:
        """One of the robots has been put into a pose (nj,) with rates (nj,)."""
        ...

    def before(self, rows: NDArray[np.int64]) -> None:
        """Set what they exert over the step that comes."""
        ...

    def after(self, rows: NDArray[np.int64]) -> None:
        """A step has been taken."""
        ...


class ElasticLaws:
    """Force effects of robots with elastic actuators, see ``engines.mujoco_forces.ForceBatch``."""

    def __init__(self, body: ElasticBody, runs: Any) -> None:
        self._forces = ForceBatch(body.forces, runs)

    def begin(self, row: int, body: Body, position: Array, velocity: Array) -> None:
        """As of any laws."""
        self._forces.begin(row, cast("ElasticBody", body).forces, position)

    def before(self, rows: NDArray[np.int64]) -> None:
        """As of any laws."""
        self._forces.apply(rows)

    def after(self, rows: NDArray[np.int64]) -> None:
        """Nothing: states have moved to the end of the step already."""


class MjcfLaws:
    """Laws at joints of MJCF robots, see ``engines.mjcf_kernel``."""

    def __init__(self, body: MjcfBody, runs: Any) -> None:
        own = body.realised
        self._places, self._dt = own.places, float(own.mujoco.opt.timestep)
        self._generated, self._kernel = compiled.load_mjcf(own.stepped)
        self._bound = [runs.bind(name) for name in ("qpos", "qvel", "qfrc_actuator")]
        self._applied, self._loss = runs.bind("qfrc_applied"), runs.expand("dof_frictionloss")
        self._laws = np.zeros((runs.nsim, *own.laws.shape))
        self._own_loss = np.zeros((runs.nsim, len(own.places)))
        self._states: Array | None = None
        self._runs = runs

    def begin(self, row: int, body: Body, position: Array, velocity: Array) -> None:
        """As of any laws."""
        own = cast("MjcfBody", body).realised
        joints = zip(position.tolist(), velocity.tolist(), own.laws, strict=True)
        begun = np.array([self._generated.joint_start((q, v, 0.0), c) for q, v, c in joints], dtype=np.float64)
        if self._states is None:
            self._states = np.zeros((self._runs.nsim, *begun.shape))
        self._laws[row], self._own_loss[row], self._states[row] = own.laws, own.loss, begun
        self._runs.forward(ids=[row])  # tells what actuators exert before the first step

    def before(self, rows: NDArray[np.int64]) -> None:
        """As of any laws."""
        self._kernel.exert_laws(
            rows, self._places, self._laws, self._own_loss, self._states, *self._bound, self._dt, self._applied,
            self._loss,
        )  # fmt: skip

    def after(self, rows: NDArray[np.int64]) -> None:
        """As of any laws."""
        self._kernel.move_laws(rows, self._places, self._laws, self._states, *self._bound, self._dt)


def _elastic(model: Model, body: Body) -> Hashable:
    forces = cast("ElasticBody", body).forces
    return forces.functions if forces.active else None


def _mjcf(model: Model, body: Body) -> Hashable:
    stepped = cast("MjcfBody", body).realised.stepped
    return stepped if any(type(effect) in stepped for effect in model.effects) else None


Kind = Callable[[Model, Body], Hashable]
LAWS_OF: dict[Robots, tuple[Kind, Callable[[Any, Any], Laws]]] = {
    "elastic": (_elastic, ElasticLaws),
    "mjcf": (_mjcf, MjcfLaws),
}
"""Kind of robots → what tells which laws a model has, None of none; and these beside a batch."""


def laws_key(model: Model, body: Body) -> Hashable:
    """Equal of models with the same laws that are stepped beside MuJoCo; None of those without."""
    return LAWS_OF[model.robot.traits.catalogue][0](model, body)


def laws_beside(model: Model, body: Body, runs: Any) -> Laws:
    """These laws of a model and others like it beside a batch."""
    return LAWS_OF[model.robot.traits.catalogue][1](body, runs)
