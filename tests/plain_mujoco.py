"""Files simulated by MuJoCo alone: loaded, reset, and stepped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.types import Array


def begins(path: Path, joints: Sequence[str]) -> Array:
    """(nj,) where the joints of a file are after a reset [rad or m]."""
    model = mujoco.MjModel.from_xml_path(str(path))
    return np.array([model.qpos0[model.joint(name).qposadr[0]] for name in joints])


def played(path: Path, trial: Trial, joints: Sequence[str], actuators: Sequence[str]) -> Array:
    """(m, nj) what a file's sensors show of its joints, and where it has none the joints, at a trial's sample times.

    It begins where a reset puts it, which is where the trial has to begin, at rest and settled under the command
    before. Sample times are physics steps.
    """
    model = mujoco.MjModel.from_xml_path(str(path))
    data, step = mujoco.MjData(model), model.opt.timestep
    mujoco.mj_resetData(model, data)
    places = [int(model.joint(name).qposadr[0]) for name in joints]
    np.testing.assert_allclose(data.qpos[places], trial.position, atol=1e-6)
    order = [int(model.actuator(name).id) for name in actuators]
    for i, before in zip(order, trial.before, strict=True):
        if model.actuator_actadr[i] >= 0:
            data.act[model.actuator_actadr[i]] = before
        if n := int(model.actuator_history[i, 0]):
            mujoco.mj_initCtrlHistory(model, data, i, np.arange(-n, 0) * step, np.full((n, 1), before))
    sensors = {name: k for name in joints for k in range(model.nsensor) if model.sensor(k).name == f"pos.{name}"}
    for name, k in sensors.items():
        if n := int(model.sensor_history[k, 0]):
            scale = 1.0
            if int(model.sensor_type[k]) == int(mujoco.mjtSensor.mjSENS_TENDONPOS):
                scale = float(model.wrap_prm[model.tendon_adr[model.sensor_objid[k]]])
            seen = scale * data.qpos[places[list(joints).index(name)]]
            mujoco.mj_initSensorHistory(model, data, k, np.arange(-n, 0) * step, np.full((n, 1), seen), 0.0)
    every = round((trial.sample_times[1] - trial.sample_times[0]) / step)
    out = []
    control = [int(model.actuator_ctrladr[i]) for i in order]
    for k in range((len(trial.sample_times) - 1) * every + 1):
        data.ctrl[control] = trial.commands[np.searchsorted(trial.times, (k + 0.5) * step, side="right") - 1]
        here = data.qpos[places].copy()
        mujoco.mj_step(model, data)
        if k % every == 0:
            for name, own in sensors.items():
                here[list(joints).index(name)] = data.sensordata[model.sensor_adr[own]]  # of the step's beginning
            out.append(here)
    return np.array(out)
