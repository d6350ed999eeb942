"""The engines under test, each given the same runs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.mjcf import SolverSettings, build_spec, compile_with_stops
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.plan import SAMPLE_RATE

BLOCK = 500
"""Runs simulated at once; their whole motion is kept in memory."""


class Progress(Protocol):
    """Called with the share done and, where it is known, the worst joint's RMSE so far [rad]."""

    def __call__(self, share: float, error: float | None = None) -> None:
        """Take note."""


def silent(share: float, error: float | None = None) -> None:
    """Progress that nobody watches."""


def finer(factor: int, settings: SolverSettings = FAST_SETTINGS) -> SolverSettings:
    """Settings with a time step shorter by a whole factor."""
    return replace(settings, timestep=settings.timestep / factor)


def batch_of(experiment: Experiment, settings: SolverSettings | None = None, threads: int | None = None) -> MujocoBatch:
    """MuJoCo with 3-2-1 elements for the runs of an experiment."""
    own = experiment.morphologies
    if len(own) == 1:
        return MujocoBatch(own[0], experiment.phase, settings, threads)
    return MujocoBatch.of(own, experiment.phase, settings, threads)


def mujoco_runs(
    experiment: Experiment,
    settings: SolverSettings = FAST_SETTINGS,
    threads: int | None = None,
) -> Array:
    """(n, m, nj) angles by MuJoCo with 3-2-1 elements [rad]; NaN after a divergence."""
    ratio = round(1 / (SAMPLE_RATE * settings.timestep))
    found = []
    shared = batch_of(experiment, settings, threads) if len(experiment.morphologies) == 1 else None
    for first in range(0, experiment.size, BLOCK):
        part = experiment.part(slice(first, first + BLOCK))
        batch = shared or batch_of(part, settings, threads)
        q, _ = batch.run(part.start, np.zeros_like(part.start), part.held(settings.timestep))
        found.append(q[:, ::ratio])
    return np.concatenate(found)


def reduced_runs(experiment: Experiment, dt: float, threads: int | None = None) -> Array:
    """(n, m, nj) angles by the reduced engine at its step dt [rad]; NaN after a divergence."""
    own = experiment.morphologies
    times = experiment.times
    trials = [
        Trial(f"run {i}", experiment.switch, pressure, pressure[0], 0.0, start, times)
        for i, (start, pressure) in enumerate(zip(experiment.start, experiment.pressure, strict=True))
    ]
    groups = [(own[0], trials)] if len(own) == 1 else [(m, [t]) for m, t in zip(own, trials, strict=True)]
    found = []
    for morphology, some in groups:
        model = Model(morphology, (), experiment.phase)
        # Whether the step is short enough is what is being measured.
        for predicted in simulate([model], some, dt=dt, threads=threads, check=False):
            q = predicted.position[0].copy()
            q[predicted.reached[0] :] = np.nan
            found.append(q)
    return np.array(found)


class NativeBatch:
    """The baseline: the same skeleton under MuJoCo's own actuators, spatial tendons without mass.

    A tendon between an actuator's two points has its stiffness, damping and rest length, and a drive of the same
    force; nothing has its mass.

    Args:
        morphology: what is simulated.
        phase: base fixed or foot pinned.
        settings: of the solver.
        threads: at most.
    """

    def __init__(
        self,
        morphology: Morphology,
        phase: Phase = "swing",
        settings: SolverSettings | None = None,
        threads: int | None = None,
    ) -> None:
        self.settings = settings or FAST_SETTINGS
        self.mujoco_model = native_model(morphology, phase, self.settings)
        joints = [self.mujoco_model.joint(name) for name in morphology.joint_names]
        self._qpos = [int(j.qposadr[0]) for j in joints]
        self._dof = [int(j.dofadr[0]) for j in joints]
        self._data = [mujoco.MjData(self.mujoco_model) for _ in range(threads or 1)]

    def run(self, q0: Array, v0: Array, pressure: Array) -> tuple[Array, Array]:
        """As ``MujocoBatch.run``, in swing."""
        model = self.mujoco_model
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        first = np.zeros((len(q0), mujoco.mj_stateSize(model, full)))
        q, v = slice(1, 1 + model.nq), slice(1 + model.nq, 1 + model.nq + model.nv)
        first[:, 1 + np.array(self._qpos)] = q0
        first[:, 1 + model.nq + np.array(self._dof)] = v0
        with Rollout(nthread=len(self._data) if len(self._data) > 1 else 0) as pool:
            states, _ = pool.rollout(model, self._data, first, np.ascontiguousarray(pressure))
        states = np.concatenate([first[:, None], states], axis=1)
        # A run that diverged repeats its last state: its clock stands still.
        behind = states[:, :, 0] < (np.arange(states.shape[1]) - 0.5) * model.opt.timestep
        angles, rates = states[:, :, q][:, :, self._qpos], states[:, :, v][:, :, self._dof]
        behind |= ~np.all(np.isfinite(angles) & (np.abs(rates) < MAX_SPEED), axis=2)
        lost = np.logical_or.accumulate(behind, axis=1)
        angles[lost] = rates[lost] = np.nan
        return angles, rates


def native_model(morphology: Morphology, phase: Phase, settings: SolverSettings) -> mujoco.MjModel:
    """A morphology whose 3-2-1 elements are replaced by massless spatial tendons."""
    spec = build_spec(morphology, phase, settings)
    for a in morphology.actuators:
        for old in (spec.actuator(a.name), *(spec.equality(f"{a.name}/{x}") for x in ("halves", "insertion"))):
            spec.delete(old)
        spec.delete(spec.tendon(f"{a.name}/length"))
        spec.delete(spec.body(f"{a.name}/upper"))
        tendon = spec.add_tendon(name=f"{a.name}/length")
        tendon.wrap_site(f"{a.name}/origin")
        tendon.wrap_site(f"{a.name}/insertion")
        tendon.stiffness[0], tendon.damping[0] = a.stiffness, a.damping
        tendon.springlength[:] = a.rest_length
        drive = spec.add_actuator(name=a.name, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=tendon.name)
        drive.gainprm[0] = a.area
        drive.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        drive.ctrlrange = (morphology.command_low, morphology.command_high)
    model = compile_with_stops(spec, morphology)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    return model


def native_runs(experiment: Experiment, settings: SolverSettings = FAST_SETTINGS, threads: int | None = None) -> Array:
    """(n, m, nj) angles by the baseline [rad], in swing; NaN after a divergence."""
    ratio = round(1 / (SAMPLE_RATE * settings.timestep))
    batch = NativeBatch(experiment.morphologies[0], experiment.phase, settings, threads)
    q, _ = batch.run(experiment.start, np.zeros_like(experiment.start), experiment.held(settings.timestep))
    return np.ascontiguousarray(q[:, ::ratio])


def mujoco_equilibrium(batch: MujocoBatch, data: mujoco.MjData, pressure: Array, steps: int = 30) -> float:
    """Move a placed MuJoCo state to the nearest one at rest, stable or not, by Newton's method on its accelerations.

    Args:
        batch: whose model.
        data: placed near a pose at rest; changed in place.
        pressure: (na,) [Pa].
        steps: at most.

    Returns:
        The largest acceleration that is left, in units of MuJoCo's coordinates per s²; infinite where none was found.
    """
    model = batch.mujoco_model
    data.ctrl[:] = pressure

    def acceleration(x: Array) -> Array:
        data.qpos[:], data.qvel[:] = x, 0.0
        mujoco.mj_forward(model, data)
        return np.array(data.qacc)

    x = np.array(data.qpos)
    left = math.inf
    for _ in range(steps):
        a = acceleration(x)
        left = float(np.abs(a).max())
        if not left < 1e12 or left < 1e-7:
            break
        slope = np.empty((model.nv, model.nv))
        for i in range(model.nv):
            there = x.copy()
            there[i] += 1e-6
            back = x.copy()
            back[i] -= 1e-6
            slope[:, i] = (acceleration(there) - acceleration(back)) / 2e-6
        x = x - np.linalg.solve(slope, a)
    acceleration(x)
    return left if left < 1e-4 else math.inf
