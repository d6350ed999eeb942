"""Ground truths of MJCF robots in MuJoCo, free of discretisation error, by other code than the diagnosis uses.

MuJoCo is stepped from Python. The effects' forces are a CasADi function, evaluated at the midpoint of each step, that
is at coordinates and rates carried on from its start. The diagnosis gives MuJoCo's fields what they can hold and
evaluates the rest in machine code at the start of its own, longer steps. Dry friction is MuJoCo's in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import casadi as ca
import mujoco
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.native import harden
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf import Course, commands_on, filled, measured_of, steps_of
from equimus_ctrl.engines.mjcf_realised import Realised, realise
from equimus_ctrl.engines.predict import in_its_condition
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.drawing import Excess, GroundTruth, along, recordings_of
from equimus_ctrl.proof.outside import Motion, MotionEffect
from equimus_ctrl.proof.sources import Driven
from equimus_ctrl.proof.strength import rounded
from equimus_ctrl.proof.tracking import Tracking
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, Recording

FINER, FINEST = 8, 256
"""Physics steps for each of the nominal model's, at first and at most. Half as many are simulated too; the
extrapolation of both to an infinitely short step is the ground truth."""
EXACT = 0.05
"""By so much of the noise's standard deviation the ground truth may be off, estimated from the next finer steps."""
SEARCH = FitSettings(tolerance=1e-3, steps=30)
"""Of the refit that says how strong a case is; it begins at the truth."""


@dataclass(frozen=True, eq=False)
class Done:
    """What was done in a trial.

    Attributes:
        shown: (n, nj) by sensors without noise [rad or m].
        command: (n, na) as it was given.
        motion: (n, 2 nj) where the joints are, and their rates.
    """

    shown: Array
    command: Array
    motion: Array


def simulate_mjcf_truth(truth: GroundTruth, tracking: Sequence[Tracking] = ()) -> tuple[GroundTruth, list[Array]]:
    """The ground truth as it was driven, and for each trial (n, nj) what sensors without noise show [rad or m]."""
    found = driven_mjcf(truth, tracking)
    return found.ground_truth, found.shown


def driven_mjcf(truth: GroundTruth, tracking: Sequence[Tracking] = ()) -> Driven:
    """A ground truth on its trials.

    Args:
        truth: what there is.
        tracking: the controller of each trial; none where commands are given as they are.

    Raises:
        SimulationDiverged: where the robot's parameters are impossible, or its motion is too sensitive to be simulated.
    """
    stepped = Stepped(truth)
    controllers: Sequence[Tracking | None] = tracking or [None] * len(truth.trials)
    done = [_without_step(stepped, *both) for both in zip(trials_of(truth), controllers, strict=True)]
    trials = tuple(replace(trial, command=own.command) for trial, own in zip(truth.trials, done, strict=True))
    return Driven(replace(truth, trials=trials), [own.shown for own in done], [own.motion for own in done])


def _without_step(stepped: Stepped, trial: Trial, tracking: Tracking | None) -> Done:
    """What was done, extrapolated to an infinitely short step (Richardson), steps halved until that has converged.

    Where errors grow along a trial, two motions that have diverged from each other cannot be extrapolated.
    """
    truth, steps, before, exact = stepped.truth, FINER, None, EXACT * np.array(stepped.truth.noise)
    coarse = stepped.done(trial, steps // 2, tracking)
    while steps <= FINEST:
        fine = stepped.done(trial, steps, tracking)
        # The error of a step is of first order (Richardson, 1911).
        found = Done(*(2.0 * getattr(fine, own.name) - getattr(coarse, own.name) for own in fields(Done)))
        if tracking is not None:
            found = replace(found, command=tracking.within(found.command))
        # The remaining error is of second order: a quarter at half the step.
        if (
            before is not None
            and np.all(np.abs(found.shown - before.shown) / 3.0 < exact)
            and (tracking is None or tracking.converged((found.command - before.command) / 3.0, exact))
        ):
            return found
        steps, coarse, before = 2 * steps, fine, found
    raise SimulationDiverged(
        f"case {truth.case} of seed {truth.seed}: {trial.name} is so sensitive that its motion converges at no step"
    )


class Stepped:
    """A ground truth in MuJoCo, generalised forces that it has no field for put before each of its steps."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth = truth
        self._bodies = Model(truth.robot, tuple(e for e in truth.effects if not isinstance(e, ForceEffect)))
        self._applied = _applied_forces(truth)

    def done(self, trial: Trial, steps: int, tracking: Tracking | None = None) -> Done:
        """What is done in a trial, with so many steps for each of the XML's.

        Raises:
            SimulationDiverged: where it diverges.
        """
        own = realise(self._bodies, trial, mjcf_of(self.truth.robot).timestep / steps)
        with quietly():
            course, command = _follow(own, trial, self._applied, tracking)
        if course.sound < len(course.q):
            raise SimulationDiverged(f"case {self.truth.case} of seed {self.truth.seed}: the simulation diverged")
        steps_at: Array = course.start + course.dt * np.arange(len(course.q), dtype=np.float64)
        motion = along(trial.sample_times, steps_at, np.concatenate([course.q, course.v], axis=1))
        return Done(measured_of(own, course, trial.sample_times)[0], command, motion)


def trials_of(truth: GroundTruth) -> list[Trial]:
    """What is done, each from rest at its first angles."""
    model, found = Model(truth.robot), []
    still = [np.broadcast_to(d.start, (len(d.time), len(truth.noise))) for d in truth.trials if d.start is not None]
    for recording in recordings_of(truth, still):
        trial = Trial.of(recording, recording.position[0])
        found.append(in_its_condition(model, recording, trial))
    return found


class _AppliedForces:
    """The forces of all effects at once, through buffers, and the effects' states."""

    def __init__(self, function: ca.Function, start: ca.Function, rubbing: tuple[int, ...]) -> None:
        self.rubbing, self._evaluate, self._start = rubbing, Buffered(function), start

    def states(self, q: Array) -> Array:
        """(nz,) the effects' states where a trial begins, at rest."""
        return np.array(self._start(q)).ravel()

    def __call__(
        self, q: Array, v: Array, z: Array, load: Array, command: Array, time: float
    ) -> tuple[Array, Array, Array]:
        """(nj,) generalised forces, (nj,) bounds of dry friction and (nz,) rates of the states."""
        values: tuple[Array | float, ...] = (q, v, z, load, command, time)
        for array, value in zip(self._evaluate.arguments, values, strict=True):
            array[:] = value
        self._evaluate()
        torque, bound, rates = self._evaluate.results
        return torque, bound, rates


def _applied_forces(truth: GroundTruth) -> _AppliedForces | None:
    effects: list[Effect] = [e for e in truth.effects if isinstance(e, ForceEffect)]
    effects += truth.outside
    if not effects:
        return None
    robot = truth.robot
    nj, na = len(robot.joints), len(robot.actuators)
    q, v, load, command = ca.SX.sym("q", nj), ca.SX.sym("v", nj), ca.SX.sym("load", nj), ca.SX.sym("u", na)
    time = ca.SX.sym("t")
    torque, bound, rubbing = ca.SX.zeros(nj), ca.SX.zeros(nj), set()
    states, rates, starts = list[ca.SX](), list[ca.SX](), list[ca.SX]()
    by_name = dict(zip(robot.joint_names, range(nj), strict=True))
    at = Motion(
        truth.robot, time, {name: q[j] for name, j in by_name.items()}, {name: v[j] for name, j in by_name.items()},
        dict(zip(robot.actuator_names, ca.vertsplit(command), strict=True)),
    )  # fmt: skip
    for effect in effects:
        if isinstance(effect, MotionEffect):
            for name, value in effect.forces(at).items():
                torque[by_name[name]] += value
            continue
        assert isinstance(effect, ForceEffect)
        j, p = by_name[effect.location], {key: ca.SX(value) for key, value in effect.parameters().items()}
        speed = ca.fabs(v[j])
        own = [ca.SX.sym("z") for _ in range(effect.n_states)]
        states += own
        rates += effect.state_rate(q[j], v[j], own, p)
        starts += effect.start_state(q[j], ca.SX(0), ca.SX(0), p)
        torque[j] += effect.force(q[j], v[j], own, p) + effect.force_of_drive(load[j], p)
        bound[j] += effect.dry_friction(q[j], speed, p) + effect.friction_of_load(ca.fabs(load[j]), speed, p)
        if effect.rubs or effect.loads:
            rubbing.add(j)
    none = ca.SX(0, 1)
    given = [q, v, ca.vertcat(*states, none), load, command, time]
    forces = ca.Function("forces", given, [torque, bound, ca.vertcat(*rates, none)])
    return _AppliedForces(forces, ca.Function("start", [q], [ca.vertcat(*starts, none)]), tuple(sorted(rubbing)))


def _follow(
    own: Realised, trial: Trial, applied: _AppliedForces | None, tracking: Tracking | None
) -> tuple[Course, Array]:
    """The course of a trial, and the commands (n, na) that were given."""
    model, nj = own.mujoco, len(own.places)
    dt = float(model.opt.timestep)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    data = mujoco.MjData(model)
    at, dofs, drives = own.places.T
    rubbing = set(applied.rubbing if applied else ()) | {j for j, size in enumerate(own.loss) if size > 0}
    for j in sorted(rubbing):
        harden(model, int(dofs[j]))
    loss = own.loss.copy()
    data.qpos[at] = trial.position
    for place, _, joint in own.rotors:
        data.qpos[place] = trial.position[joint]
    data.act[:] = filled(own, trial)
    z = np.zeros(0) if applied is None else applied.states(trial.position)
    ctrl, steps = commands_on(own, trial), steps_of(trial, dt)
    given, due = trial.commands.copy(), _steps_of_samples(trial, dt)
    q, v = np.zeros((2, steps + 1, nj))
    sound = steps + 1
    for k in range(steps + 1):
        q[k], v[k] = data.qpos[at], data.qvel[dofs]
        if not np.all(np.abs(v[k]) < MAX_SPEED):
            sound = k
            break
        if k == steps:
            break
        while tracking is not None and len(due) and due[0] <= k:
            # Commands along a line have to be known one sample ahead.
            sample, ahead = len(given) - len(due), int(trial.linear)
            due = due[1:]
            if sample + ahead < len(given):
                given[sample + ahead] = tracking.at(sample, q[k], v[k], ahead)
            if len(due):
                _arrive(own, trial, given[: sample + ahead + 1], ctrl[: due[0] + 1])
        data.ctrl[:] = ctrl[k]
        if applied is not None:
            gain = 0.5 * (v[k] - v[max(k - 1, 0)])
            midpoint = q[k] + 0.5 * dt * (v[k] + 0.5 * gain)
            load = data.qfrc_actuator[drives]
            of_middle = load, ctrl[k], trial.start + (k + 0.5) * dt
            half = z
            if len(z):  # their own midpoint
                *_, rates = applied(midpoint, v[k] + gain, z, *of_middle)
                half = z + 0.5 * dt * rates
            torque, bound, rates = applied(midpoint, v[k] + gain, half, *of_middle)
            z = z + dt * rates
            data.qfrc_applied[dofs] = torque
            model.dof_frictionloss[dofs] = loss + bound
        mujoco.mj_step(model, data)
    return Course(trial.start, dt, q, v, ctrl, sound), given


def _steps_of_samples(trial: Trial, dt: float) -> NDArray[np.int64]:
    """(n,) the physics step in which each command is given."""
    return np.floor((trial.times - trial.start) / dt + 1e-9).astype(np.int64)


def _arrive(own: Realised, trial: Trial, given: Array, ctrl: Array) -> None:
    """Write what arrives at the actuators over physics steps (k, na), of commands (i, na) that were given so far."""
    until = trial.start + len(ctrl) * float(own.mujoco.opt.timestep)
    so_far = replace(trial, times=trial.times[: len(given)], commands=given, sample_times=np.array([until]))
    ctrl[:] = commands_on(own, so_far)[: len(ctrl)]


def mjcf_recordings(truth: GroundTruth, clean: Sequence[Array], disturbed: Sequence[Array]) -> list[Recording]:
    """What a diagnosis may see, to a thousandth of the noise.

    Args:
        truth: what happened.
        clean: for each trial (n, nj) what sensors without noise would show [rad or m].
        disturbed: the noise.
    """
    digits = int(3 - np.floor(np.log10(min(truth.noise))))
    return recordings_of(truth, [shown + more for shown, more in zip(clean, disturbed, strict=True)], digits)


def mjcf_excess(truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = ()) -> Excess:
    """The excess residual variance of a robot with ``effects`` alone fitted to a ground truth, see ``strength.excess``.

    It is fitted as a diagnosis would be: with the same shooting intervals, their starts and the default parameters
    free. The error of the physics step is no part of it.
    """
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        model = Model(truth.robot, tuple(effects))
        silent = mjcf_recordings(truth, clean, [np.zeros_like(c) for c in clean])
        segments = split(model, silent).train
        free, noise = default_free_parameters(model), tuple(JointNoise(sigma) for sigma in truth.noise)
        simulator = Simulator(engine_for(model).without_step_error(), threads=1)
        found = fit(free, segments, simulator=simulator, settings=SEARCH, noise=noise)
        joints = ((np.concatenate(found.residuals) / np.array(truth.noise)) ** 2).mean(axis=0)
        return rounded(joints, dict(zip(free.names, found.theta.tolist(), strict=True)))
