"""Many models through many trials at once, in MuJoCo; the counterpart of ``engines.batch.simulate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.force import force_effects
from equimus_ctrl.effects.sensors import sample, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch, near_stop, stop_divisor
from equimus_ctrl.engines.mujoco_forces import ForceStepper
from equimus_ctrl.engines.steps import step_divisor, warn_if_coarse
from equimus_ctrl.engines.trials import Condition, Predicted, Trial, check_size
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings, compile_model, place
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import step_quietly
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array


def simulate_mujoco(
    models: Sequence[Model],
    trials: Sequence[Trial],
    *,
    starts: Sequence[Array] | None = None,
    settings: SolverSettings | None = None,
    threads: int | None = None,
) -> list[Predicted]:
    """Every model through every trial. Models with force effects are stepped one by one, which is slow.

    Runs that come near a joint's stop are simulated anew with steps short enough for its force, as in ``MujocoBatch``.

    Args:
        models: of one structure and phase; they may differ in all parameters and in effects.
        trials: what is predicted.
        starts: for each trial (k, nj) angles at the start, or (k, 2 nj) angles and velocities, one row a model [rad,
            rad/s]; the trial's own by default.
        settings: of the solver; by default ``FAST_SETTINGS`` with a time step that follows the first model, its joint
            stops included.
        threads: to use; as many as there are cores by default. The result does not depend on it.

    Returns:
        One ``Predicted`` for each trial.

    Raises:
        ConfigError: for no model, models of two phases, or an effect that is not simulated here.
        ModelError: where the models differ in structure.
    """
    if not models:
        raise ConfigError("no model was given to simulate")
    for model in models:
        require_simulated(model.effects, f"{model.name}: MuJoCo")
        if model.phase != models[0].phase:
            raise ConfigError(f"{model.name} and {models[0].name} differ in phase, so they cannot run together")
    m = models[0].morphology
    poses = [trial.position for trial in trials]
    known: dict[Condition, list[Morphology]] = {}
    for trial in trials:
        if trial.condition not in known:
            own = [changed_bodies(model.effects, trial.robot_in(model.morphology)) for model in models]
            known[trial.condition] = own
    robots = next(iter(known.values()), [changed_bodies(model.effects, model.morphology) for model in models])
    if settings is None:
        divisor = step_divisor(robots[0], models[0].phase, poses, FAST_SETTINGS.timestep)
        settings = replace(FAST_SETTINGS, timestep=FAST_SETTINGS.timestep / divisor)
    check_size(trials, settings.timestep)
    batches = {key: MujocoBatch.of(own, models[0].phase, settings, threads) for key, own in known.items()}
    results = [
        _one_trial(
            models, known[trial.condition], batches[trial.condition], trial, None if starts is None else starts[k],
            len(m.joints),
        )
        for k, trial in enumerate(trials)
    ]  # fmt: skip
    if all(found.sound[0] for found in results):  # a divergence is visible by itself
        # Runs on stops have had steps of their own.
        warn_if_coarse(robots[0], models[0].phase, poses, settings.timestep, [])
    return results


def _one_trial(
    models: Sequence[Model],
    robots: Sequence[Morphology],
    batch: MujocoBatch,
    trial: Trial,
    start: Array | None,
    nj: int,
) -> Predicted:
    k, dt = len(models), batch.settings.timestep
    m = models[0].morphology
    span = trial.sample_times[-1] - trial.start if len(trial.sample_times) else 0.0
    steps = max(int(np.ceil(span / dt - 1e-9)), 1)
    q0 = np.tile(trial.position, (k, 1))
    v0 = np.zeros((k, nj)) if trial.velocity is None else np.tile(trial.velocity, (k, 1))
    if start is not None:
        q0 = np.array(start[:, :nj])
        v0 = np.array(start[:, nj:]) if start.shape[1] > nj else v0
    pressure = np.empty((k, steps, 2, len(m.actuators)))
    given = np.vstack([trial.before, trial.commands])
    for i, model in enumerate(models):
        if i > 0 and model.effects == models[i - 1].effects:
            pressure[i] = pressure[i - 1]
            continue
        commands = shaped_commands(model.effects, m.actuator_names, given)
        valve = valve_settings(model.effects, m.actuator_names)
        pressure_history(
            trial.times, commands[1:].copy(), commands[0].copy(), valve, trial.start, dt, pressure[i], trial.linear
        )
    if any(force_effects(model.effects) for model in models):
        runs = [
            _followed(model, robot, batch.settings, q0[i], v0[i], pressure[i, :, 0])
            for i, (model, robot) in enumerate(zip(models, robots, strict=True))
        ]
        q, v = np.array([run[0] for run in runs]), np.array([run[1] for run in runs])
    else:
        q, v = batch.run(q0, v0, pressure[:, :, 0])
    position = np.empty((k, len(trial.sample_times), nj))
    column = np.empty(len(trial.sample_times))
    for i, model in enumerate(models):
        sensor = sensor_settings(model.effects, m.joint_names)
        for j in range(nj):
            sample(q[i, :, j].copy(), v[i, :, j].copy(), trial.start, dt, sensor[j], trial.sample_times, column)
            position[i, :, j] = column
    lost = ~np.all(np.isfinite(position), axis=2)
    return Predicted(position, np.where(lost.any(axis=1), lost.argmax(axis=1), position.shape[1]).astype(np.int64))


def _followed(
    model: Model, robot: Morphology, settings: SolverSettings, q0: Array, v0: Array, pressure: Array
) -> tuple[Array, Array]:
    """One run by ``_stepped``, with shorter steps where it comes near a stop."""
    q, v = _stepped(model, robot, settings, q0, v0, pressure)
    dt = settings.timestep
    if not near_stop([robot], q[None], v[None], dt)[0]:
        return q, v
    divisor = stop_divisor(robot, model.phase, q0, dt)
    if divisor > 1:
        finer = replace(settings, timestep=dt / divisor)
        q, v = _stepped(model, robot, finer, q0, v0, np.repeat(pressure, divisor, axis=0))
    return q[::divisor], v[::divisor]


def _stepped(
    model: Model, robot: Morphology, settings: SolverSettings, q0: Array, v0: Array, pressure: Array
) -> tuple[Array, Array]:
    """One run step by step, with its force effects; (q, v), each (steps + 1, nj), nan after a divergence."""
    compiled = compile_model(robot, model.phase, settings)
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    data = mujoco.MjData(compiled)
    joints = [compiled.joint(name) for name in robot.joint_names]
    qpos, dof = [joint.qposadr[0] for joint in joints], [joint.dofadr[0] for joint in joints]
    forces = ForceStepper(model, robot, compiled)
    place(compiled, data, Kinematics(robot, model.phase), q0, v0)
    forces.reset(q0)
    q, v = np.full((2, len(pressure) + 1, len(joints)), np.nan)
    q[0], v[0] = q0, v0
    for k, held in enumerate(pressure):
        data.ctrl[:] = held
        forces.apply(data)
        if not step_quietly(compiled, data) or not np.all(np.abs(data.qvel[dof]) < MAX_SPEED):
            break
        q[k + 1], v[k + 1] = data.qpos[qpos], data.qvel[dof]
    return q, v
