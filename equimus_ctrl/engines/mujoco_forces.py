"""Force effects, stepped beside a MuJoCo model.

Torques and forces are those in the middle of each step, which is reached by the speeds and accelerations at its start;
the effects' own states move by the midpoint rule. Dry friction is MuJoCo's own: a friction loss on the joint, or on the
tendon that measures an actuator's length.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import mujoco
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.engines.native import native
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

STICKING = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of dry friction: what sticks creeps by a ten-thousandth of what it would slide."""


@lru_cache(maxsize=16)
def _functions(form: Structure, phase: Phase, laws: Laws) -> tuple[ca.Function, ca.Function]:
    m = augmented_model(form, phase, laws)
    bound = m.bound_here
    force = m.force + m.more_area * m.pressure
    forces = ca.Function("forces", [m.q, m.v, m.z, m.pressure, m.p], [m.torque, force, m.z_rate, bound])
    return forces, ca.Function("rest", [m.q, m.p], [m.rest_state])


class ForceStepper:
    """The force effects of one model beside its MuJoCo counterpart.

    Args:
        model: whose effects.
        robot: its morphology with the effects on its bodies.
        mujoco_model: made from ``robot``; its friction losses are changed.
    """

    def __init__(self, model: Model, robot: Morphology, mujoco_model: mujoco.MjModel) -> None:
        laws = laws_of(model.effects)
        self.active = bool(laws)
        if not self.active:
            return
        form = structure(robot)
        augmented = augmented_model(form, model.phase, laws)
        names = robot.joint_names, robot.actuator_names
        self._parameters = np.concatenate([pack(robot), law_parameters(augmented.slots, model.effects, *names)])
        self.functions = _functions(form, model.phase, laws)
        forces, self._rest = self.functions
        self._forces = Buffered(forces)
        self._forces.arguments[-1][:] = self._parameters
        self._model = mujoco_model
        self._dof = np.array([mujoco_model.joint(name).dofadr[0] for name in robot.joint_names])
        self._qpos = np.array([mujoco_model.joint(name).qposadr[0] for name in robot.joint_names])
        halves = [[mujoco_model.joint(f"{n}/{h}") for h in ("middle", "lower")] for n in robot.actuator_names]
        self._slides = np.array([[joint.dofadr[0] for joint in pair] for pair in halves])
        self._tendons = np.array([mujoco_model.tendon(f"{name}/length").id for name in robot.actuator_names])
        self._rubbing = augmented.rubbing
        self._actuators = np.array([mujoco_model.actuator(name).id for name in robot.actuator_names])
        dt = mujoco_model.opt.timestep
        for kind, i in self._rubbing:
            if kind == "joint":
                mujoco_model.dof_solref[self._dof[i]] = (2 * dt, 1.0)
                mujoco_model.dof_solimp[self._dof[i]] = STICKING
            else:
                mujoco_model.tendon_solref_fri[self._tendons[i]] = (2 * dt, 1.0)
                mujoco_model.tendon_solimp_fri[self._tendons[i]] = STICKING
        self._z: Array = np.zeros(augmented.z.numel())
        self._begins = True

    def reset(self, q: Array) -> None:
        """The effects' states after a long rest at the joint angles q (nj,) [rad]."""
        if self.active:
            self._z[:] = np.array(self._rest(q, self._parameters)).ravel()
            self._begins = True

    def apply(self, data: mujoco.MjData) -> None:
        """Set what the effects exert over the step that comes, and move their states to its end."""
        if not self.active:
            return
        half = 0.5 * self._model.opt.timestep
        own_q, own_v, own_z, pressure, _ = self._forces.arguments
        own_q[:], own_v[:], own_z[:] = data.qpos[self._qpos], data.qvel[self._dof], self._z
        pressure[:] = data.ctrl[self._actuators]
        self._forces()
        if self._begins:
            # What stands in the data are accelerations without commands and effects.
            self._exert(data)
            mujoco.mj_forward(self._model, data)
            self._begins = False
        a, rate = data.qacc[self._dof], self._forces.results[2]
        own_q += half * own_v + 0.5 * half * half * a
        own_v += half * a
        own_z += half * rate
        self._forces()
        self._z += 2 * half * rate
        self._exert(data)

    def _exert(self, data: mujoco.MjData) -> None:
        torque, force, _, bound = self._forces.results
        data.qfrc_applied[self._dof] = torque
        data.qfrc_applied[self._slides] = force[:, None]
        for (kind, i), size in zip(self._rubbing, bound, strict=True):
            if kind == "joint":
                self._model.dof_frictionloss[self._dof[i]] = size
            else:
                self._model.tendon_frictionloss[self._tendons[i]] = size


class ForceBatch:
    """``ForceStepper`` for many robots of one structure with the same effects, in a ``mujoco.batch.Batch``.

    Args:
        first: of one of them.
        runs: the batch; rates and angles are read there, what is exerted is written there.
    """

    def __init__(self, first: ForceStepper, runs: Any) -> None:
        n = runs.nsim
        self._first = first
        forces = first.functions[0]
        self._forces = Buffered((native(forces, "forces") or forces).map(n))
        self._runs = runs
        self._qpos, self._qvel, self._ctrl, self._qacc, self._applied = (
            runs.bind(name) for name in ("qpos", "qvel", "ctrl", "qacc", "qfrc_applied")
        )
        self._losses = [
            (runs.expand("dof_frictionloss"), first._dof[i])
            if kind == "joint"
            else (runs.expand("tendon_frictionloss"), first._tendons[i])
            for kind, i in first._rubbing
        ]
        self._half = 0.5 * first._model.opt.timestep
        q, v, z, pressure, p = (array.reshape(n, -1) for array in self._forces.arguments)
        self._own = q, v, z, pressure, p
        self._z: Array = np.zeros((n, first._z.size))
        self._begins = np.zeros(n, dtype=bool)
        self._torque, self._force, self._rate, self._bound = (
            part.T if part.ndim > 1 and part.size else part.reshape(n, -1) for part in self._forces.results
        )

    def begin(self, row: int, stepper: ForceStepper, q: Array) -> None:
        """One of the robots has rested for long at joint angles q (nj,) [rad]."""
        self._own[4][row] = stepper._parameters
        self._z[row] = np.array(stepper._rest(q, stepper._parameters)).ravel()
        self._begins[row] = True

    def apply(self, rows: NDArray[np.int64]) -> None:
        """``ForceStepper.apply`` of some of them."""
        first, half = self._first, self._half
        q, v, z, pressure, _ = self._own
        q[:], v[:] = self._qpos[:, first._qpos], self._qvel[:, first._dof]
        z[:], pressure[:] = self._z, self._ctrl[:, first._actuators]
        self._forces()
        if self._begins[rows].any():
            new = rows[self._begins[rows]]
            self._exert(new)
            self._runs.forward(ids=new)
            self._begins[new] = False
        a, rate = self._qacc[:, first._dof], self._rate.copy()
        q += half * v + 0.5 * half * half * a
        v += half * a
        z += half * rate
        self._forces()
        self._z[rows] += 2 * half * self._rate[rows]
        self._exert(rows)

    def _exert(self, rows: NDArray[np.int64]) -> None:
        self._applied[np.ix_(rows, self._first._dof)] = self._torque[rows]
        for i, slides in enumerate(self._first._slides):
            self._applied[np.ix_(rows, slides)] = self._force[rows, i, None]
        for k, (loss, place) in enumerate(self._losses):
            loss[rows, place] = self._bound[rows, k]
