"""An MJCF robot in the simulated plant, with all that the XML has: contacts, tendons, integrator and step.

Laws that MuJoCo has no field for are stepped beside it, see ``engines.mjcf_kernel``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from equimus_ctrl.effects.bodies import PayloadMass
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf import put_joints
from equimus_ctrl.engines.mjcf_commands import integrate_from_here
from equimus_ctrl.engines.mjcf_realised import LOST, function_address, realise
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.loads import numbers_of
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array


class MjcfBody:
    """See ``plants.body.Body``.

    Args:
        model: with its effects.
        dt: physics step [s].
        scene: adds what stands around it.
        integrator: none but the XML's own.

    Raises:
        ConfigError: where the motion of some joints is an input, which no plant has.
    """

    def __init__(self, model: Model, dt: float, scene: Scene | None = None, integrator: str | None = None) -> None:
        robot = mjcf_of(model.robot)
        if robot.prescribed_names:
            raise ConfigError(
                f"{robot.name}: the motion of {', '.join(robot.prescribed_names)} is an input, expected none in a plant"
            )
        self._model, self._dt = model, dt
        self.realised = self._own = own = realise(model, dt=dt, scene=scene)
        self._home = own.robot.home
        self.mujoco_model = own.mujoco
        self.mujoco_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        self.data = mujoco.MjData(self.mujoco_model)
        self.qpos, self.dof = own.places[:, 0], own.places[:, 1]
        self.control = np.array([drive.control for drive in own.robot.actuators], dtype=np.int64)
        self.valve, self.sensor = own.valve, own.sensor
        self._generated, self._kernel = compiled.load_mjcf(own.stepped)
        self._step = function_address("mj_step")
        self._fastest = np.full(len(self.dof), MAX_SPEED)
        nj, m = len(self.dof), self.mujoco_model
        self._out = np.empty((2, nj)), np.empty((2, nj))
        self._none, self._whole = np.empty((2, 0)), np.empty((0, m.nq + m.nv + m.na))

    def command_before(self, position: Array | None) -> Array:
        """What holds a pose, the file's own by default, as nearly as can be; nothing where that is not known."""
        low, high = self._own.robot.command_limits
        try:
            dynamics = Dynamics(self._model)
        except NotAvailable:
            return np.clip(np.zeros(len(low)), low, high)
        return np.clip(dynamics.holding(self._home if position is None else position)[0], low, high)

    def rest(self, command: Array | None) -> Array:
        """As of any body; where nobody says a command, the pose in which the file has it.

        Raises:
            ModelError, NotAvailable: see ``engines.rest.rest_pose``.
        """
        return self._home if command is None else rest_pose(self._model, command)

    def place(self, position: Array, velocity: Array | None, arrived: Array) -> None:
        """As of any body; filters have settled, integrators begin where their actuators are."""
        own, model, data = self._own, self.mujoco_model, self.data
        mujoco.mj_resetData(model, data)
        rates = np.zeros(len(position)) if velocity is None else velocity
        beside = np.zeros(2 * own.robot.loose_count)
        put_joints(own, data, *own.robot.with_unmeasured(position, rates, beside))
        model.dof_frictionloss[self.dof] = own.loss
        data.ctrl[self.control] = arrived
        for drive, settled in zip(own.robot.actuators, arrived.tolist(), strict=True):
            if drive.state is not None:
                data.act[drive.state] = min(max(settled, 0.0), 1.0) if drive.activates else settled
        integrate_from_here(model, data)
        mujoco.mj_forward(model, data)
        joints = zip(position.tolist(), rates.tolist(), own.laws, strict=True)
        self._states = np.array([self._generated.joint_start((q, v, 0.0), c) for q, v, c in joints])

    def exert(self) -> None:
        """Nothing: the kernel does it."""

    def advance(self, pushes: Sequence[Array]) -> bool:
        """As of any body."""
        own, model, data = self._own, self.mujoco_model, self.data
        force = np.array(pushes).sum(axis=0)[None] if pushes else np.empty((0, len(self.dof)))
        with quietly():
            sound = self._kernel.run_mjcf(
                self._step, model._address, data._address, own.places, own.laws, own.loss, self._fastest,
                np.array(data.ctrl)[None], force, self._states, data.qpos, data.qvel, data.ctrl, data.qfrc_applied,
                model.dof_frictionloss, data.qfrc_actuator, self._dt, own.moved, self._none, self._none, *self._out,
                data.act, self._whole,
            )  # fmt: skip
        return sound == len(self._out[0]) and not any(data.warning[kind].number for kind in LOST)

    def exerted(self) -> Array | None:
        """As of any body: JᵀF of MuJoCo's actuators; what effects do at joints is not theirs."""
        return np.array(self.data.qfrc_actuator[self.dof])

    def numbers(self) -> Mapping[str, Array]:
        """As of any body."""
        return numbers_of(self.mujoco_model)

    def loaded(self, loads: Sequence[tuple[str, float]]) -> Mapping[str, Array]:
        """As of any body."""
        effects = (*self._model.effects, *(PayloadMass(place, mass) for place, mass in loads))
        return numbers_of(realise(Model(self._model.robot, effects, self._model.phase), dt=self._dt).mujoco)
