"""Robots of one structure in one ``mujoco.batch.Batch``, each with parameters of its own."""

from __future__ import annotations

import copy
from collections.abc import Hashable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from mujoco import batch as mjbatch
from numpy.typing import NDArray

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.valves import shaping_laws
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf_realised import sizes_of
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.batch_laws import Laws, laws_beside, laws_key
from equimus_ctrl.plants.body import Body, body_of
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array

FIELDS = tuple(sorted(name for name in mjbatch.MODEL_FIELDS if not name.startswith(("name_", "names_"))))
"""Of a MuJoCo model, those that may be others in each simulation of a batch."""


@dataclass(frozen=True, eq=False)
class Unit:
    """A robot that can be put into a batch.

    Attributes:
        model: with its effects.
        body: in MuJoCo, by which it is put into poses.
        shaping: (m, 3) see ``effects.shaping.shape_command``; None where one of the laws is Python alone.
        kind: equal of units with the same laws beside MuJoCo, None without any.
        key: equal of units whose data in MuJoCo have the same sizes, and with the same laws.
    """

    model: Model
    body: Body
    shaping: Array | None
    kind: Hashable
    key: Hashable

    @classmethod
    def of(cls, model: Model, dt: float, scene: Scene | None = None, integrator: str | None = None) -> Unit:
        """Prepare a model, see ``plants.body.body_of``."""
        require_simulated(model.effects, f"{model.name}: many robots at once")
        body = body_of(model, dt, scene, integrator)
        # To look for what hangs together takes longer than to solve a few joints at once.
        body.mujoco_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value
        kind = laws_key(model, body)
        shaping = shaping_laws(model.effects, model.robot.actuator_names)
        return cls(model, body, shaping, kind, (sizes_of(body.mujoco_model), body.mujoco_model.names, kind))

    def other_fields(self, than: Any) -> list[str]:
        """Fields of its MuJoCo model that are others in another one of the same sizes."""
        return [name for name in FIELDS if not _same(field_of(self.body.mujoco_model, name), field_of(than, name))]


def field_of(model: Any, name: str) -> Any:
    """A field of a MuJoCo model, by a name such as ``opt.gravity``."""
    return attrgetter(name)(model)


def _same(first: Any, second: Any) -> bool:
    return bool(np.array_equal(first, second, equal_nan=np.asarray(first).dtype.kind == "f"))


@dataclass(frozen=True, eq=False)
class Moved:
    """What robots did over a few physics steps, one row each.

    Attributes:
        qpos: (r, k, nq) after each step.
        qvel: (r, k, nv) after each step.
        sensors: (r, k, ns) what MuJoCo's sensors showed at the start of each.
        sound: (r,) whether all numbers mean something.
    """

    qpos: Array
    qvel: Array
    sensors: Array
    sound: NDArray[np.bool_]


class Group:
    """Robots in one batch: as many as the plant has, of which some rows are in use.

    Args:
        first: any of them.
        n: rows.
        threads: to use; the same bits whatever their number.
    """

    def __init__(self, first: Unit, n: int, threads: int) -> None:
        body = first.body
        self.base = copy.copy(body.mujoco_model)
        self.runs = mjbatch.Batch(self.base, n, threads)
        self.qpos, self.dof, self.control = body.qpos, body.dof, body.control
        self._state = {name: self.runs.bind(name) for name in STATE}
        self._sensors = self.runs.bind("sensordata")
        self._own: dict[str, Array] = {}
        self._warned = np.zeros(n, dtype=np.int64)
        self.laws: Laws | None = None if first.kind is None else laws_beside(first.model, body, self.runs)
        self._known: dict[Unit, list[str]] = {}

    def put(self, row: int, unit: Unit) -> None:
        """Take over a unit's parameters and the state that its body has, as row ``row``."""
        for name in self._differing(unit):
            if name not in self._own:
                self._own[name] = self.runs.expand(name)
        for name, values in self._own.items():
            values[row] = field_of(unit.body.mujoco_model, name)
        self.runs.reset(ids=[row], stage=mujoco.mjtStage.mjSTAGE_NONE)
        for name, values in self._state.items():
            values[row] = getattr(unit.body.data, name)
        self._warned[row] = self._warnings()[row]

    def _differing(self, unit: Unit) -> list[str]:
        if unit not in self._known:
            self._known[unit] = unit.other_fields(self.base)
        return self._known[unit]

    def _warnings(self) -> NDArray[np.int64]:
        return np.asarray(self.runs.warning[:, :, 1].sum(axis=1))

    def advance(self, rows: NDArray[np.int64], ctrl: Array) -> Moved:
        """Physics steps under commands (r, k, nu) that act over each."""
        k, whole = ctrl.shape[1], len(rows) == self.runs.nsim
        ids = None if whole else rows
        bound = [*(self._state[name] for name in RECORDED[:2]), self._sensors]
        found = {name: np.empty((len(rows), k, values.shape[1])) for name, values in zip(RECORDED, bound, strict=True)}
        failed: list[int] = []
        with quietly():
            if self.laws is None:
                try:
                    self.runs.rollout(k, ctrl, record=RECORDED, ids=ids, out=found)
                except mjbatch.SimulationError as error:
                    failed = list(error.ids)
            else:
                self._step_by_step(self.laws, rows, ctrl, ids, found, failed)
        qpos, qvel, sensors = (found[name] for name in RECORDED)
        fast = np.abs(qvel[:, :, self.dof]) < MAX_SPEED
        sound = np.isfinite(qpos).all(axis=(1, 2)) & fast.all(axis=(1, 2))
        sound &= self._warnings()[rows] == self._warned[rows]
        if failed:
            sound &= ~np.isin(rows, failed)
        return Moved(qpos, qvel, sensors, sound)

    def _step_by_step(
        self,
        laws: Laws,
        rows: NDArray[np.int64],
        ctrl: Array,
        ids: NDArray[np.int64] | None,
        found: dict[str, Array],
        failed: list[int],
    ) -> None:
        bound = [self._state["qpos"], self._state["qvel"], self._sensors]
        for s in range(ctrl.shape[1]):
            self._state["ctrl"][rows] = ctrl[:, s]
            laws.before(rows)
            try:
                self.runs.step(ids=ids)
            except mjbatch.SimulationError as error:
                failed += list(error.ids)
            laws.after(rows)
            for name, values in zip(RECORDED, bound, strict=True):
                found[name][:, s] = values[rows]


STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "time", "qfrc_applied")
"""What of a state is taken over; all else is as MuJoCo resets it."""
RECORDED = ("qpos", "qvel", "sensordata")
