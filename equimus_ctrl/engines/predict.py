"""Open-loop prediction: what a model says a recorded command history should have done."""

from __future__ import annotations

from typing import Literal, get_args

import mujoco
import numpy as np

from equimus_ctrl.effects.command import lag, mean_command
from equimus_ctrl.effects.valves import DELAY, FILL, VENT, valve_settings
from equimus_ctrl.engines import compiled, trial_kernel
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.errors import ConfigError, SimulationDiverged, unknown_name
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings, compile_model, place, step_quietly
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.morphology import pack
from equimus_ctrl.types import Array, Recording

Engine = Literal["reduced", "mujoco"]
SETTLED_SPAN = 0.1
"""How long at most the first measurements are averaged for the start of a trial [s]."""


def measured_start(recording: Recording) -> Array:
    """(nj,) the angles a trial starts from [rad]: the mean of its first 0.1 s while the command before it still holds.

    A recording starts at rest (see the recording format), so these samples differ by noise alone. Where the command
    changes in the very first row, or a note says ``settled = no``, the first measurement stands alone.
    """
    if recording.notes.get("settled") == "no":
        return np.array(recording.position[0])
    time = recording.time
    unchanged = np.all(recording.command == recording.command_before, axis=1)
    changed = int(np.argmin(unchanged)) if not unchanged.all() else len(time)
    span = int(np.searchsorted(time, time[0] + SETTLED_SPAN, side="right"))
    return np.asarray(recording.position[: max(min(changed, span), 1)].mean(axis=0), dtype=np.float64)


def check_columns(model: Model, recording: Recording) -> None:
    """Raise ConfigError unless the recording's joints and actuators are the model's, in its order."""
    m = model.morphology
    if (recording.joints, recording.actuators) != (m.joint_names, m.actuator_names):
        raise ConfigError(
            f"{recording.name}: has joints {', '.join(recording.joints)} and actuators "
            f"{', '.join(recording.actuators)}, but the model {m.name} has {', '.join(m.joint_names)} and "
            f"{', '.join(m.actuator_names)}"
        )


def predict(
    model: Model,
    recording: Recording,
    *,
    engine: Engine = "reduced",
    start: Array | None = None,
    dt: float | None = None,
) -> Array:
    """(n, nj) angles at the recording's times under its commands [rad], from rest at ``start``.

    Args:
        model: what is simulated.
        recording: whose commands and times.
        engine: ``"reduced"`` (exact Lagrangian, compiled) or ``"mujoco"`` (3-2-1 elements).
        start: (nj,) first angles [rad]; the measured start by default.
        dt: physics step [s]; 1 ms (reduced) or 1/480 s (MuJoCo) by default.

    Raises:
        ConfigError: where names do not match or the engine is unknown.
        SimulationDiverged: where the simulation does.
    """
    check_columns(model, recording)
    if engine not in get_args(Engine):
        raise ConfigError(unknown_name("engine", engine, get_args(Engine)))
    q0 = measured_start(recording) if start is None else np.asarray(start, dtype=np.float64)
    if q0.shape != (len(recording.joints),) or not np.all(np.isfinite(q0)):
        raise ConfigError(
            f"{recording.name}: the start is {q0.tolist()}, expected one finite angle in rad for each of "
            f"{', '.join(recording.joints)}"
        )
    if dt is not None and not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    out = np.empty_like(recording.position)
    if engine == "mujoco":
        reached = _mujoco_trial(model, recording, q0, dt or 1 / 480, out)
    else:
        kernel = compiled.load(model.morphology, model.phase, trial_kernel)
        reached = kernel.run_trial(
            pack(model.morphology),
            valve_settings(model.effects, model.morphology.actuator_names),
            np.array(recording.time),
            np.array(recording.command),
            np.array(recording.command_before),
            np.array(q0),
            np.zeros(len(q0)),
            dt or 1e-3,
            np.array(recording.time),
            out,
        )
    if reached < len(out):
        raise SimulationDiverged(
            f"{recording.name}: the simulation of {model.name} diverged at {recording.time[reached]:.3f} s"
        )
    return out


def _mujoco_trial(model: Model, recording: Recording, q0: Array, dt: float, out: Array) -> int:
    m = model.morphology
    compiled_model = compile_model(m, model.phase, SolverSettings(timestep=dt, integrator="RK4"))
    compiled_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    data = mujoco.MjData(compiled_model)
    qpos = np.array([compiled_model.joint(name).qposadr[0] for name in m.joint_names])
    dof = np.array([compiled_model.joint(name).dofadr[0] for name in m.joint_names])
    place(compiled_model, data, Kinematics(m, model.phase), q0)
    valve = valve_settings(model.effects, m.actuator_names)
    # Plain copies: numba compiles anew for read-only arrays.
    time, command, before = np.array(recording.time), np.array(recording.command), recording.command_before
    pressure, cursor = np.array(before), [-1] * len(before)
    k, step = 0, 0
    while k < len(time):
        t = time[0] + step * dt
        for i in range(len(pressure)):
            at = t - valve[i, DELAY]
            target, cursor[i] = mean_command(time, command[:, i], before[i], cursor[i], at, at + dt)
            pressure[i], data.ctrl[i] = lag(pressure[i], target, valve[i, FILL], valve[i, VENT], dt)
        q, v = data.qpos[qpos].copy(), data.qvel[dof].copy()
        if not step_quietly(compiled_model, data) or not np.all(np.abs(data.qvel[dof]) < MAX_SPEED):
            return k
        while k < len(time) and time[k] <= t + dt:
            share = (time[k] - t) / dt
            out[k] = [
                trial_kernel.hermite(q[j], v[j], data.qpos[qpos[j]], data.qvel[dof[j]], dt, share)
                for j in range(len(q))
            ]
            k += 1
        step += 1
    return k
