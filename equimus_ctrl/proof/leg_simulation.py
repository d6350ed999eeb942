"""Ground truths of legs in MuJoCo: the leg of 3-2-1 elements at a fine step, all trials side by side.

All forces of effects are evaluated at the midpoint of each step, that is at positions and speeds carried on from its
start. Dry friction is MuJoCo's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import mujoco
import numpy as np
from mujoco import batch as mjbatch

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.sensors import sample, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_forces import STICKING
from equimus_ctrl.engines.rest import settle
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.models.augmented import augmented_model, law_parameters
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import compile_model, place
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.proof.drawing import GroundTruth, along, noise, recordings_of
from equimus_ctrl.proof.outside import Motion, MotionEffect
from equimus_ctrl.proof.sources import Driven
from equimus_ctrl.robots.elastic.morphology import Morphology, pack, structure
from equimus_ctrl.types import Array, Recording

RATE = 1920.0
"""Physics steps a second."""
HALVES = ("middle", "lower")
"""The two drives of a 3-2-1 element."""


@dataclass(frozen=True, eq=False)
class _AppliedForces:
    """The forces of all effects, as compiled functions of the state.

    Attributes:
        forces: (q, v, z, pressure, t) → (torque (nj,), force (na,), dz/dt, bound of dry friction (nr,)).
        rest: q → z after a long rest.
        rubbing: (kind, index) of the place of each bound.
        n_states: size of z.
    """

    forces: ca.Function
    rest: ca.Function
    rubbing: tuple[tuple[str, int], ...]
    n_states: int


def _applied_forces(ground_truth: GroundTruth, robot: Morphology) -> _AppliedForces | None:
    effects = [e for e in (*ground_truth.effects, *ground_truth.outside) if isinstance(e, ForceEffect)]
    free = [e for e in ground_truth.outside if isinstance(e, MotionEffect)]
    if not effects and not free:
        return None
    laws = tuple(sorted({type(e) for e in effects}, key=lambda law: law.name))
    m = augmented_model(structure(robot), "swing", laws)
    joints, actuators = robot.joint_names, robot.actuator_names
    base = build(structure(robot), "swing")
    parameters = [*pack(robot), *law_parameters(m.slots, effects, joints, actuators)]
    time = ca.SX.sym("t")
    coordinates = ca.vertsplit(ca.vertcat(m.q, base.lengths))
    rates = ca.vertsplit(ca.vertcat(m.v, base.jacobian @ m.v))
    names = (*joints, *actuators)
    at = Motion(
        robot,
        time,
        dict(zip(names, coordinates, strict=True)),
        dict(zip(names, rates, strict=True)),
        dict(zip(actuators, ca.vertsplit(m.pressure), strict=True)),
    )
    torque, force = ca.SX(m.torque), ca.SX(m.force + m.more_area * m.pressure)
    for effect in free:
        for name, value in effect.forces(at).items():
            if name in joints:
                torque[joints.index(name)] += value
            else:
                force[actuators.index(name)] += value
    bound = m.bound_here
    outputs = ca.substitute(
        [torque, force, m.z_rate, bound, m.rest_state],
        [m.p, base.p],
        [ca.SX(ca.DM(parameters)), ca.SX(ca.DM(pack(robot)))],
    )
    forces = ca.Function("forces", [m.q, m.v, m.z, m.pressure, time], outputs[:4])
    return _AppliedForces(forces, ca.Function("rest", [m.q], [outputs[4]]), m.rubbing, int(m.z.numel()))


def settled(kinematics: Kinematics, acting: _AppliedForces | None, pressure: Array, bias: Array) -> Array:
    """(nj,) where the leg rests under constant pressures, all forces of effects included [rad].

    Args:
        kinematics: of the leg.
        acting: the forces of its effects.
        pressure: (na,) [Pa].
        bias: (nj + na,) share of its dry friction that holds each joint and actuator.

    Raises:
        ModelError: where there is no such place.
    """
    if acting is None:
        return kinematics.equilibrium(pressure)
    nj = len(kinematics.morphology.joints)

    def exerted(q: Array, pressure: Array) -> tuple[Array, Array]:
        found = acting.forces(q, np.zeros(nj), acting.rest(q), pressure, 0.0)
        joint, force, _, bound = (np.array(part).ravel() for part in found)
        for (kind, i), size in zip(acting.rubbing, bound, strict=True):
            if kind == "joint":
                joint[i] += bias[i] * size
            else:
                force[i] += bias[nj + i] * size
        return joint, force

    return settle(kinematics, pressure, exerted)


def simulate(ground_truth: GroundTruth, rate: float = RATE) -> list[Array]:
    """For each trial (n, nj) the angles that the sensors would show without noise [rad], see ``driven``."""
    return driven(ground_truth, rate).shown


def driven(ground_truth: GroundTruth, rate: float = RATE) -> Driven:
    """A leg on its trials.

    Args:
        ground_truth: what happens.
        rate: physics steps a second.

    Raises:
        ModelError: where the leg finds no rest to begin from.
        SimulationDiverged: where the leg's state is not finite.
    """
    model, dt = ground_truth.model, 1.0 / rate
    require_simulated(model.effects, f"case {ground_truth.case}")
    names = ground_truth.leg.actuator_names
    robot = changed_bodies(model.effects, ground_truth.leg)
    steps = max(int(np.ceil(trial.time[-1] * rate - 1e-9)) for trial in ground_truth.trials)
    pressure = np.empty((len(ground_truth.trials), steps, 2, len(names)))
    starts = []
    acting, kinematics = _applied_forces(ground_truth, robot), Kinematics(robot)
    for k, trial in enumerate(ground_truth.trials):
        shaped = shaped_commands(model.effects, names, trial.command)
        valve = valve_settings(model.effects, names)
        pressure_history(np.array(trial.time), shaped, shaped[0].copy(), valve, 0.0, dt, pressure[k])
        starts.append(settled(kinematics, acting, shaped[0], ground_truth.rest_bias[k]))
    q, v = _run(robot, acting, np.array(starts), pressure[:, :, 0].copy(), dt)
    if not (np.all(np.isfinite(q)) and np.all(np.abs(v) < MAX_SPEED)):
        raise SimulationDiverged(f"case {ground_truth.case} of seed {ground_truth.seed}: the simulation diverged")
    sensors = sensor_settings(model.effects, robot.joint_names)
    clean, motion, steps_at = [], [], np.asarray(dt * np.arange(q.shape[1]), dtype=np.float64)
    for k, trial in enumerate(ground_truth.trials):
        motion.append(along(trial.time, steps_at, np.concatenate([q[k], v[k]], axis=1)))
        seen = np.empty((len(trial.time), q.shape[2]))
        for j, sensor in enumerate(sensors):
            column = np.empty(len(trial.time))
            sample(q[k, :, j].copy(), v[k, :, j].copy(), 0.0, dt, sensor, np.array(trial.time), column)
            seen[:, j] = column
        clean.append(seen)
    return Driven(ground_truth, clean, motion)


def _run(
    robot: Morphology, acting: _AppliedForces | None, q0: Array, pressure: Array, dt: float
) -> tuple[Array, Array]:
    """(trials, steps + 1, nj) angles and speeds from rest at q0 (trials, nj) under pressures (trials, steps, na)."""
    compiled = compile_model(robot, "swing", replace(FAST_SETTINGS, timestep=dt))
    for flag in (mujoco.mjtDisableBit.mjDSBL_AUTORESET, mujoco.mjtDisableBit.mjDSBL_ISLAND):
        compiled.opt.disableflags |= flag.value
    joints = [compiled.joint(name) for name in robot.joint_names]
    at, dof = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    tendons = [compiled.tendon(f"{name}/length").id for name in robot.actuator_names]
    for kind, i in acting.rubbing if acting else ():
        if kind == "joint":
            compiled.dof_solref[dof[i]], compiled.dof_solimp[dof[i]] = (2 * dt, 1.0), STICKING
        else:
            compiled.tendon_solref_fri[tendons[i]], compiled.tendon_solimp_fri[tendons[i]] = (2 * dt, 1.0), STICKING
    n, steps = pressure.shape[:2]
    runs = mjbatch.Batch(compiled, n, 1)
    runs.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    data, kinematics = mujoco.MjData(compiled), Kinematics(robot)
    for k, position in enumerate(q0):
        mujoco.mj_resetData(compiled, data)
        place(compiled, data, kinematics, position)
        runs.bind("qpos")[k], runs.bind("qvel")[k] = data.qpos, data.qvel
    q, v = np.zeros((2, n, steps + 1, len(at)))
    q[:, 0] = q0
    if acting is None:
        found = runs.rollout(steps, pressure, record=("qpos", "qvel"))
        q[:, 1:], v[:, 1:] = found["qpos"][:, :, at], found["qvel"][:, :, dof]
        return q, v
    loop = _Loop(acting, n)
    loop.z[:] = np.array([np.array(acting.rest(position)).ravel() for position in q0])
    control, applied, qpos, qvel = (runs.bind(name) for name in ("ctrl", "qfrc_applied", "qpos", "qvel"))
    slides = [[compiled.joint(f"{name}/{half}").dofadr[0] for name in robot.actuator_names] for half in HALVES]
    losses = {"joint": runs.expand("dof_frictionloss"), "actuator": runs.expand("tendon_frictionloss")}
    places = [losses[kind][:, dof[i] if kind == "joint" else tendons[i]] for kind, i in acting.rubbing]
    for s in range(steps):
        torque, force, bound = loop.at_midpoint(q[:, s], v[:, s], v[:, max(s - 1, 0)], pressure[:, s], s * dt, dt)
        control[:] = pressure[:, s]
        applied[:, dof] = torque
        for half in slides:
            applied[:, half] = force
        for row, size in zip(places, bound.T, strict=True):
            row[:] = size
        runs.step()
        q[:, s + 1], v[:, s + 1] = qpos[:, at], qvel[:, dof]
    return q, v


class _Loop:
    """The forces of all trials at once, through buffers: that takes a tenth of the time of calls with arrays."""

    def __init__(self, acting: _AppliedForces, n: int) -> None:
        # Lanes stand side by side in CasADi's columns, which are the rows of an array.
        self._evaluate = Buffered(acting.forces.map(n))
        self._given = [array.reshape(n, -1) for array in self._evaluate.arguments]
        self._found = [array.T.reshape(n, -1) for array in self._evaluate.results]
        self.z: Array = np.zeros((n, acting.n_states))

    def at_midpoint(
        self, q: Array, v: Array, before: Array, pressure: Array, time: float, dt: float
    ) -> tuple[Array, Array, Array]:
        """Torques, forces and friction bounds at the midpoint of a step, the effects' states moved to its end.

        Args:
            q: (n, nj) at the step's start [rad].
            v: (n, nj) there [rad/s].
            before: (n, nj) a step earlier [rad/s].
            pressure: (n, na) mean over the step [Pa].
            time: of the step's start [s].
            dt: [s].
        """
        own_q, own_v, own_z, own_pressure, own_time = self._given
        torque, force, rate, bound = self._found
        own_pressure[:] = pressure
        gain = 0.5 * (v - before)
        if self.z.size:
            own_q[:], own_v[:], own_z[:], own_time[:] = q, v, self.z, time
            self._evaluate()
            own_z += 0.5 * dt * rate
        own_q[:] = q + 0.5 * dt * (v + 0.5 * gain)
        own_v[:] = v + gain
        own_time[:] = time + 0.5 * dt
        self._evaluate()
        self.z += dt * rate
        return torque, force, bound


def recordings(ground_truth: GroundTruth, clean: Sequence[Array]) -> list[Recording]:
    """What a diagnosis may see: commands and noisy angles, to 0.01 mrad.

    Args:
        ground_truth: what happened.
        clean: for each trial (n, nj), see ``simulate``.
    """
    noisy = [angles + disturbed for angles, disturbed in zip(clean, noise(ground_truth), strict=True)]
    return recordings_of(ground_truth, noisy, digits=5)
