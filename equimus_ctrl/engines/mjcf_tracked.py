"""MJCF robots that track references by feedback (``types.FeedbackLaw``), stepped by MuJoCo with all their effects.

Each model has its own closed loop: what its sensors show goes into the law, and what arrives of the law's commands
moves it. The law acts at the samples of the trial, on what is measured then, without a delay of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.effects.valves import shaped_commands, shaping_effects
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf import (
    Course,
    filled,
    forces_of,
    inner_of,
    law_starts,
    measured_of,
    put_joints,
    steps_of,
)
from equimus_ctrl.engines.mjcf_commands import integrate_from_here
from equimus_ctrl.engines.mjcf_realised import Realised, function_address, realise, scratch
from equimus_ctrl.engines.tracking_law import nothing_remembered
from equimus_ctrl.engines.trials import Predicted, Trial, check_size
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, FeedbackLaw


@dataclass(frozen=True, eq=False)
class Followed:
    """What models do in closed loop in one trial.

    Attributes:
        predicted: what their sensors show, without noise, and their true motion.
        command: (k, n, na) given at each sample, within the ranges; nan from where a simulation was lost.
        asked: (k, n, na) the same before it was clipped.
    """

    predicted: Predicted
    command: Array
    asked: Array


def simulate_tracked(
    models: Sequence[Model],
    trial: Trial,
    reference: Array,
    law: FeedbackLaw,
    *,
    starts: Array | None = None,
    noise: Array | None = None,
    threads: int | None = None,
    dt: float | None = None,
) -> Followed:
    """Every model through a trial in which its joints track a reference.

    Args:
        models: of one MJCF robot.
        trial: what is done: its commands are fed forward, and what was in force before them.
        reference: (n, nj) of the joints at its times [rad or m].
        law: of the feedback.
        starts: (k, 2 nj) true positions and rates at the start; the trial's by default.
        noise: (k, n, nj) that sensors have at its times, as the law sees them [rad or m]; none by default.
        threads: to use; all cores by default. The result does not depend on it.
        dt: another physics step than the XML's [s].

    Raises:
        ConfigError: for a robot with joints whose motion is an input or is not measured, a trial that begins inside, or
            commands along lines.
    """
    robot = mjcf_of(models[0].robot)
    others = (*robot.prescribed_names, *robot.unmeasured_names)
    if others or trial.linear or trial.start != trial.times[0]:
        why = (
            f"the motion of {', '.join(others)} is not measured or not its own" if others else "expected held commands"
        )
        raise ConfigError(f"{robot.name} cannot be simulated with feedback: {why}")
    check_size([trial], dt or robot.timestep)
    nj, (n, na), count = len(robot.joint_names), trial.commands.shape, len(models)
    trial = replace(trial, inner=True)
    found = Followed(Predicted.empty(count, trial, nj), *(np.full((count, n, na), np.nan) for _ in range(2)))

    def work(which: int) -> None:
        start = np.concatenate([trial.position, np.zeros(nj)]) if starts is None else starts[which]
        disturbed = np.zeros((n, nj)) if noise is None else noise[which]
        own = realise(models[which], trial, dt)
        course = _follow(own, trial, reference, law, start, disturbed, found.command[which], found.asked[which])
        shown = found.predicted
        shown.position[which], shown.reached[which] = measured_of(own, course, trial.sample_times)
        if shown.motion is not None:
            shown.motion[which] = inner_of(course, trial.sample_times)
        if shown.forces is not None:
            shown.forces[which] = forces_of(own, course, replace(trial, commands=found.command[which]))

    with quietly():
        work(0)  # what has to be compiled is compiled once
        rest = range(1, count)
        if computer.worker_count(threads, name="threads") == 1 or len(rest) < 2:
            for which in rest:
                work(which)
        else:
            list(computer.threads(computer.worker_count(threads, name="threads")).map(work, rest))
    return found


def _follow(
    own: Realised,
    trial: Trial,
    reference: Array,
    law: FeedbackLaw,
    start: Array,
    noise: Array,
    given: Array,
    asked: Array,
) -> Course:
    """The course of one model; its commands are written into (n, na) ``given`` and ``asked``."""
    model, nj, kernel = own.mujoco, len(own.places), compiled.load_mjcf_tracked(own.stepped)
    dt, total, names = float(model.opt.timestep), steps_of(trial, float(model.opt.timestep)), own.robot.actuator_names
    n, na = trial.commands.shape
    steps = np.append(np.floor((trial.times - trial.start) / dt + 1e-9).astype(np.int64), total)
    steps = np.minimum(steps, total)
    period = float(np.median(np.diff(trial.times))) if n > 1 else dt
    low, high = own.robot.command_limits
    q, v, ctrl = np.empty((total + 1, nj)), np.empty((total + 1, nj)), np.zeros((total, na))
    whole = np.empty((total + 1 if trial.forces else 0, model.nq + model.nv + model.na))
    data, shaping = scratch.data(model), bool(shaping_effects(own.effects))

    def reaching(command: Array) -> Array:
        return shaped_commands(own.effects, names, command[None], own.robot.command_ranges)[0] if shaping else command

    model.dof_frictionloss[own.places[:, 1]] = own.loss
    put_joints(own, data, start[:nj], start[nj:])
    data.act[:] = filled(own, trial)
    integrate_from_here(model, data)
    before, reach = np.array(reaching(trial.before)), np.empty((na, n))
    carried, memory = np.column_stack([before, np.full(na, -1.0)]), nothing_remembered(nj)
    states = law_starts(own, trial, start)
    q[0], v[0] = start[:nj], start[nj:]
    of_law = (
        np.array(reference), np.array(trial.commands), np.array(law.stiffness), np.array(law.damping), law.smoothing,
        period, memory, np.array(low), np.array(high),
    )  # fmt: skip
    of_steps = (
        function_address("mj_step"), model._address, data._address, own.places, own.laws, own.loss,
        np.full(nj, MAX_SPEED), states, data.qpos, data.qvel, data.ctrl, data.qfrc_applied, model.dof_frictionloss,
        data.qfrc_actuator, dt, data.act,
    )  # fmt: skip
    times, sensor, valve, disturbed = np.array(trial.times), own.sensor, own.valve, np.array(noise)

    def sampled(first: int, last: int) -> int:
        """Commands of samples that are not shaped, and what comes of them; the sample at which all is lost, or n."""
        return int(
            kernel.follow_samples(
                first,
                last,
                steps,
                times,
                sensor,
                disturbed,
                trial.start,
                of_law,
                of_steps,
                q,
                v,
                asked,
                given,
                reach,
                before,
                valve,
                carried,
                ctrl,
                whole,
            )
        )

    if not shaping:
        lost = sampled(0, n)
    else:
        lost = n
        for k in range(n):
            kernel.command_sample(k, steps, sensor, disturbed, trial.start, dt, *of_law, q, v, asked, given)
            reach[:, k] = reaching(given[k])
            if not kernel.advance_sample(
                k, steps, times, reach, before, valve, carried, trial.start, *of_steps, q, v, ctrl, whole
            ):
                lost = k
                break
    if lost < n:
        given[lost:], asked[lost:] = np.nan, np.nan
        q[steps[lost] + 1 :], v[steps[lost] + 1 :] = np.nan, np.nan
    sound = total + 1 if lost == n else int(steps[lost]) + 1
    return Course(trial.start, dt, q, v, ctrl, sound, whole if trial.forces else None)
