"""A robot with elastic actuators in the simulated plant: 3-2-1 elements, with force effects beside MuJoCo.

The equalities of the elements are held as hard as in ``engines.mujoco_batch`` and integrated by RK4, which keeps the
angles within 1e-5 rad of the exact Lagrangian at 480 Hz (about 1e-3 rad while a joint hits a stop).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from equimus_ctrl.effects.bodies import PayloadMass, changed_bodies
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_forces import ForceStepper
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import Scene, compile_model, place
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.loads import numbers_of
from equimus_ctrl.quiet import step_quietly
from equimus_ctrl.types import Array


class ElasticBody:
    """See ``plants.body.Body``.

    Args:
        model: with its effects.
        dt: physics step [s].
        scene: adds what stands around it.
        integrator: of MuJoCo's; that of ``FAST_SETTINGS`` by default.
    """

    def __init__(self, model: Model, dt: float, scene: Scene | None = None, integrator: str | None = None) -> None:
        self._settings = replace(FAST_SETTINGS, timestep=dt, integrator=integrator or FAST_SETTINGS.integrator)
        self._model = model
        self._robot = changed_bodies(model.effects, model.morphology)
        self._kinematics = Kinematics(self._robot, model.phase)
        self.mujoco_model = compile_model(self._robot, model.phase, self._settings, scene)
        self.mujoco_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        self.forces = ForceStepper(model, self._robot, self.mujoco_model)
        self.data = mujoco.MjData(self.mujoco_model)
        joints = [self.mujoco_model.joint(name) for name in model.morphology.joint_names]
        self.qpos = np.array([joint.qposadr[0] for joint in joints])
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        self.control = np.arange(len(model.morphology.actuators))
        self.valve = valve_settings(model.effects, model.morphology.actuator_names)
        self.sensor = sensor_settings(model.effects, model.morphology.joint_names)

    def command_before(self, position: Array | None) -> Array:
        """The lowest pressures."""
        return self._robot.command_limits[0]

    def rest(self, command: Array | None) -> Array:
        """(nj,) the pose at rest under a command (na,), the lowest pressures by default [rad]."""
        return rest_pose(self._model, self.command_before(None) if command is None else command)

    def place(self, position: Array, velocity: Array | None, arrived: Array) -> None:
        """As of any body; elements are closed."""
        mujoco.mj_resetData(self.mujoco_model, self.data)
        place(self.mujoco_model, self.data, self._kinematics, position, velocity)
        self.forces.reset(position)

    def exert(self) -> None:
        """As of any body."""
        self.forces.apply(self.data)

    def advance(self, pushes: Sequence[Array]) -> bool:
        """As of any body."""
        if not self.forces.active:
            self.data.qfrc_applied[:] = 0.0
        for torque in pushes:
            self.data.qfrc_applied[self.dof] += torque
        return step_quietly(self.mujoco_model, self.data)

    def exerted(self) -> Array | None:
        """Not known: the elements' forces are equalities and springs of MuJoCo's."""
        return None

    def numbers(self) -> Mapping[str, Array]:
        """As of any body."""
        return numbers_of(self.mujoco_model)

    def loaded(self, loads: Sequence[tuple[str, float]]) -> Mapping[str, Array]:
        """As of any body."""
        robot = self._robot
        for place_of, mass in loads:
            robot = changed_bodies((PayloadMass(place_of, mass),), robot)
        return numbers_of(compile_model(robot, self._model.phase, self._settings))
