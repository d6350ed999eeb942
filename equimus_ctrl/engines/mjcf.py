"""Many models of an MJCF robot through many trials, stepped by MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.command import FILL, VENT, mixed_history, pressure_history
from equimus_ctrl.effects.following import arrived
from equimus_ctrl.effects.sensors import PLAY, inner, sample
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf_commands import integrate_from_here, integrate_since, valves_of
from equimus_ctrl.engines.mjcf_kernel import drive_forces
from equimus_ctrl.engines.mjcf_lead import Hidden, Leader, remembers
from equimus_ctrl.engines.mjcf_realised import Realised, function_address, realise, scratch, stepped_laws
from equimus_ctrl.engines.trials import Condition, Predicted, Trial, check_size
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.mjcf.entries import Drive
from equimus_ctrl.robots.mjcf.parts import hook_of
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array

SETTLED = 10.0
"""Time constants after which a filter has forgotten what was."""
MUSCLE_SLOWEST = 2.0
"""A muscle's time constants are those of its file, times 0.5 to 2 by its activation."""
AT_ONCE = 1e-9
"""A step in which nothing moves [s]."""
TO_FORCES = "mj_fwdPosition", "mj_fwdVelocity", "mj_fwdActuation"
"""What MuJoCo works out of a state until it knows the forces of actuators."""


@dataclass(frozen=True, eq=False)
class Course:
    """Where an MJCF robot's joints are on its physics steps.

    Attributes:
        start: [s].
        dt: [s].
        q: (steps + 1, nj) [rad or m].
        v: (steps + 1, nj) [rad/s or m/s].
        ctrl: (steps, na) commands that act over each step, with accelerations that are prescribed behind them.
        sound: number of entries that mean something.
        whole: (steps + 1, nq + nv + na) all of MuJoCo's state; None where it is not wanted.
    """

    start: float
    dt: float
    q: Array
    v: Array
    ctrl: Array
    sound: int
    whole: Array | None = None


def steps_of(trial: Trial, dt: float) -> int:
    """Physics steps that a trial takes."""
    span = trial.sample_times[-1] - trial.start if len(trial.sample_times) else 0.0
    return max(int(np.ceil(span / dt - 1e-9)), 1)


def _shaped(own: Realised, trial: Trial) -> Array:
    """(1 + n, na) what gets on the way to the actuators, before the first row, then row by row."""
    given, robot = np.vstack([trial.before, trial.commands]), own.robot
    return shaped_commands(own.effects, robot.actuator_names, given, robot.command_ranges)


def rows_of(own: Realised, trial: Trial) -> Array:
    """(1 + n, na + np) the same with accelerations that are prescribed; of parts of a recording worked out once."""
    key = trial.history
    if key in own.rows:
        return own.rows[key]
    rows = np.ascontiguousarray(trial.with_accelerations(own.robot, _shaped(own, trial)))
    if trial.recorded is not None:
        own.rows[key] = rows
    return rows


def commands_on(own: Realised, trial: Trial) -> Array:
    """(steps, na) means over physics steps of the commands as they arrive at the actuators, see ``Course.ctrl``."""
    dt, rows = float(own.mujoco.opt.timestep), rows_of(own, trial)
    out, lines = np.empty((steps_of(trial, dt), 2, rows.shape[1])), trial.lines(own.robot)
    mixed_history(trial.times, rows[1:], rows[0].copy(), valves_of(own), trial.start, dt, out, lines)
    return np.ascontiguousarray(out[:, 0])


def filled(own: Realised, trial: Trial) -> Array:
    """(n,) of MuJoCo's activations at a trial's start: what filters of commands, and muscles, came to by then.

    As if the command before the recording had been in force for long.
    """
    model = own.mujoco
    out = np.zeros(model.na)
    drives = [drive for drive in own.robot.actuators if drive.state is not None]
    if not drives:
        return out
    longest = max(_memory(model, drive) for drive in drives)
    lead = min(SETTLED * longest, max(trial.start - float(trial.times[0]), 0.0))
    early, dt = replace(trial, start=trial.start - lead, sample_times=np.array([trial.start])), model.opt.timestep
    first = commands_on(own, replace(early, start=early.start - dt, sample_times=np.array([early.start])))
    rows = np.concatenate([first, commands_on(own, early)]) if lead > 0 else first
    rows = rows[:, : len(own.robot.actuators)].copy()
    for drive in drives:
        k = drive.control
        if model.actuator_ctrllimited[k]:
            rows[:, k] = np.clip(rows[:, k], *model.actuator_ctrlrange[k])
    lags = valve_settings((), own.robot.actuator_names)
    for drive in drives:
        if not drive.activates:
            lags[drive.control, [FILL, VENT]] = model.actuator_dynprm[drive.index, 0]
    found = np.empty((1, 2, rows.shape[1]))
    times = early.start + dt * np.arange(-1, len(rows) - 1)
    pressure_history(times, rows, rows[0].copy(), lags, trial.start, AT_ONCE, found)
    for drive in drives:
        came_to = found[0, 0, drive.control]
        out[drive.state] = _activated(model, drive, rows[:, drive.control]) if drive.activates else came_to
    return out


def _memory(model: Any, drive: Drive) -> float:
    """Longest time constant with which a drive follows its command [s]."""
    if drive.activates:
        return MUSCLE_SLOWEST * float(model.actuator_dynprm[drive.index, :2].max())
    return float(model.actuator_dynprm[drive.index, 0])


def _activated(model: Any, drive: Drive, commands: Array) -> float:
    """What a muscle's activation has come to, settled under the first of its commands, each of a physics step.

    By MuJoCo's own law and step (Euler's); see its documentation, "Muscles".
    """
    dynamics, dt = np.array(model.actuator_dynprm[drive.index]), float(model.opt.timestep)
    act = float(np.clip(commands[0], 0.0, 1.0))
    for command in commands[1:].tolist():
        act += dt * mujoco.mju_muscleDynamics(command, act, dynamics[:3])
    return act


def leader_of(own: Realised) -> Leader | None:
    """What leads a robot's hidden states to where trials start; None where it has none."""
    if not remembers(own):
        return None
    _, kernel = compiled.load_mjcf(own.stepped)

    def begin(trial: Trial, start: Array, first: Array) -> Hidden:
        data, act = scratch.data(own.mujoco), filled(own, trial)
        put_joints(own, data, *np.split(first, 2))
        data.act[:] = act
        integrate_from_here(own.mujoco, data)
        act = np.array(data.act)
        integrate_since(own, trial, rows_of(own, trial), act)
        nj = len(own.places)
        position, velocity = (values[:nj] for values in np.split(start, 2))
        rotors = np.array([(position[j], velocity[j]) for *_, j in own.rotors]).reshape(-1, 2)
        return Hidden(rotors, act, law_starts(own, trial, np.concatenate([position, velocity])))

    return Leader(own, kernel, rows_of, begin)


def put_joints(own: Realised, data: Any, position: Array, velocity: Array) -> None:
    """Put joints, and those that are prescribed or were not measured behind them, with drives that are not ahead."""
    nj = len(own.places)
    data.qpos[own.places[:, 0]], data.qvel[own.places[:, 1]] = position[:nj], velocity[:nj]
    for q, v, joint in own.rotors:
        data.qpos[q], data.qvel[v] = position[joint], velocity[joint]
    data.qpos[own.others[:, 0]], data.qvel[own.others[:, 1]] = position[nj:], velocity[nj:]


def follow(
    own: Realised,
    trial: Trial,
    start: Array,
    ctrl: Array,
    force: Array | None = None,
    leader: Leader | None = None,
) -> Course:
    """Step an MJCF robot through a trial.

    Args:
        own: the robot.
        trial: what is done with it.
        start: (2 nj,) coordinates and rates of the joints, or (2 nj + 2 nl,) see ``Trial.begun``.
        ctrl: see ``commands_on``.
        force: (steps, nj) further generalised forces on the joints [N·m or N].
        leader: of the robot, see ``leader_of``: the recorded motion before the start says what hidden states are there.
            Without, they begin as if nothing had been before.
    """
    _, kernel = compiled.load_mjcf(own.stepped)
    model, nj = own.mujoco, len(own.places)
    begun = trial.begun(own.robot, start[:nj], start[nj : 2 * nj], start[2 * nj :])
    hidden = None if leader is None or trial.led is None else leader.at(trial, np.concatenate(begun))
    dt, wanted = float(model.opt.timestep), len(ctrl) + 1
    whole = np.empty((wanted if trial.forces else 0, model.nq + model.nv + model.na))
    out_q, out_v = np.empty((wanted, nj)), np.empty((wanted, nj))
    if hidden is not None and not hidden.sound:
        out_q[:], out_v[:], whole[:] = np.nan, np.nan, np.nan
        return Course(trial.start, dt, out_q, out_v, ctrl, 0, whole if trial.forces else None)
    states = law_starts(own, trial, start[: 2 * nj]) if hidden is None else hidden.states.copy()
    data = scratch.data(model)
    model.dof_frictionloss[own.places[:, 1]] = own.loss
    put_joints(own, data, *begun)
    data.act[:] = filled(own, trial)
    given = moved_along(own, trial, trial.start + dt * np.arange(wanted, dtype=np.float64))
    integrate_from_here(model, data)
    if hidden is not None:
        data.qpos[own.rotors[:, 0]], data.qvel[own.rotors[:, 1]] = hidden.rotors.T
        data.act[:] = hidden.act
    sound = kernel.run_mjcf(
        function_address("mj_step"), model._address, data._address, own.places, own.laws, own.loss,
        np.full(nj, MAX_SPEED), ctrl, np.empty((0, nj)) if force is None else force,
        states,
        data.qpos, data.qvel, data.ctrl, data.qfrc_applied, model.dof_frictionloss, data.qfrc_actuator, dt,
        own.moved, *given, out_q, out_v, data.act, whole,
    )  # fmt: skip
    return Course(trial.start, dt, out_q, out_v, ctrl, int(sound), whole if trial.forces else None)


def moved_along(own: Realised, trial: Trial, times: Array) -> tuple[Array, Array]:
    """(n, np) positions and rates of the joints whose motion is prescribed."""
    if not len(own.moved):
        return np.empty((len(times), 0)), np.empty((len(times), 0))
    position, rate, _ = trial.motion_of(own.robot.prescribed_names).at(times)
    return position, rate


def others_along(own: Realised, trial: Trial, times: Array) -> tuple[Array, Array]:
    """(n, np + nu) positions and rates of these, and of unmeasured joints as they are supposed to move."""
    moved = moved_along(own, trial, times)
    if len(own.others) == len(own.moved) or trial.supposed is None:
        return moved
    beside = trial.supposed.at(times)
    return np.column_stack([moved[0], beside[0]]), np.column_stack([moved[1], beside[1]])


def law_starts(own: Realised, trial: Trial, start: Array) -> Array:
    """(nj, nz) the laws' states where a trial starts, the joints at (2 nj,) coordinates and rates."""
    generated, _ = compiled.load_mjcf(own.stepped)
    time = float(trial.start - trial.times[0])
    joints = zip(*np.split(start, 2), own.laws, strict=True)
    return np.array([generated.joint_start((float(q), float(v), time), c) for q, v, c in joints])


def measured_of(own: Realised, path: Course, times: Array, trial: Trial | None = None) -> tuple[Array, int]:
    """(m, nj) what sensors show of a path, and how many of the samples there are before it diverged.

    Args:
        own: the robot.
        path: of its joints.
        times: (m,) ascending [s].
        trial: that it is of: inside a recording sensors go on from what they showed.
    """
    nj, play = len(own.places), bool(np.any(own.sensor[:, PLAY] > 0.0))
    going = trial.going if play and trial is not None else None
    out = np.empty((len(times), nj))
    with np.errstate(all="ignore"):
        for j in range(nj):
            column = np.empty(len(times))
            # A sensor with a delay shows what was before the start: there the joint moved as fast as it does at the
            # start, and inside a recording as it goes on from there.
            q, v = path.q[:, j].copy(), path.v[:, j].copy()
            faster = (v[1] - v[0]) / path.dt if trial is not None and trial.led is not None else 0.0
            shown = going[0][j] if going is not None else np.nan
            sample(q, v, path.start, path.dt, own.sensor[j], times, column, v[0], shown, faster)
            out[:, j] = column
    if path.sound == len(path.q):
        return out, len(times)
    return out, int(np.searchsorted(times, path.start + (path.sound - 1) * path.dt, side="right"))


def inner_of(path: Course, times: Array) -> Array:
    """(m, 2 nj) true positions and rates of a path at given times."""
    nj = path.q.shape[1]
    out = np.empty((2 * nj, len(times)))
    with np.errstate(all="ignore"):
        for j in range(nj):
            inner(path.q[:, j].copy(), path.v[:, j].copy(), path.start, path.dt, times, out[j], out[nj + j])
    return out.T


def forces_of(own: Realised, path: Course, trial: Trial) -> Array:
    """(m, na) for each command the force of its actuator before the gear, at a trial's sample times [N·m or N].

    MuJoCo's own law of the actuator, in the state between two steps and under what has arrived of the command by then.
    """
    assert path.whole is not None  # of trials that ask for forces
    model, times = own.mujoco, trial.sample_times
    nq, nv = model.nq, model.nv  # the same, of hinges and slides
    given = _shaped(own, trial)
    ctrl, at_once = np.empty((len(times), given.shape[1])), np.zeros((given.shape[1], 6))
    arrived(
        trial.times, given[1:].copy(), given[0].copy(), own.valve, at_once, given[0], trial.start, path.dt, times, ctrl,
        trial.lines(own.robot)[: given.shape[1]],
    )  # fmt: skip
    place = np.maximum((times - path.start) / path.dt, 0.0)
    step = np.minimum(place.astype(np.int64), len(path.whole) - 2)
    with np.errstate(all="ignore"):  # numbers after a divergence mean nothing
        states = path.whole[step] + (place - step)[:, None] * (path.whole[step + 1] - path.whole[step])
        for j in range(nq):
            q, v = path.whole[:, j].copy(), path.whole[:, nq + j].copy()
            inner(q, v, path.start, path.dt, times, states[:, j], states[:, nv + j])
    states[step + 1 >= path.sound] = np.nan
    data, out = scratch.data(model), np.empty_like(ctrl)
    controls = [drive.control for drive in own.robot.actuators]
    command = np.zeros((len(times), model.nu))
    command[:, controls] = ctrl
    drive_forces(
        np.array([function_address(name) for name in TO_FORCES], dtype=np.int64), model._address, data._address, states,
        command, data.qpos, data.qvel, data.act, data.ctrl, data.actuator_force,
        np.array([model.actuator_outadr[drive.index] for drive in own.robot.actuators], dtype=np.int64), out,
    )  # fmt: skip
    return out


def parted(trials: Sequence[Trial], parts: int) -> list[list[int]]:
    """Trials, as indices, in so many parts of about as much time: those of one recording one after the other.

    So a part passes through a recording once, up to its last start.
    """
    histories: dict[Hashable, list[int]] = {}
    for i, trial in enumerate(trials):
        histories.setdefault(trial.history, []).append(i)
    order = [i for own in histories.values() for i in sorted(own, key=lambda i: trials[i].start)]
    spans = [max(float(trials[i].sample_times[-1:].sum()) - trials[i].start, 0.0) + AT_ONCE for i in order]
    middles = np.cumsum(spans) - np.array(spans) / 2
    chunks: list[list[int]] = [[] for _ in range(parts)]
    for i, middle in zip(order, middles, strict=True):
        chunks[min(int(middle / sum(spans) * parts), parts - 1)].append(i)
    return [chunk for chunk in chunks if chunk]


def simulate_mjcf(
    models: Sequence[Model],
    trials: Sequence[Trial],
    *,
    starts: Sequence[Array] | None = None,
    threads: int | None = None,
    dt: float | None = None,
    hard_friction: bool = True,
) -> list[Predicted]:
    """Every model through every trial, with the integrator, solver and step that the MuJoCo model asks for.

    Dry friction that is an effect stops a joint within a step, through MuJoCo's own friction constraint. Other laws act
    on the state at the beginning of a step; states of their own go on with the rate at its end.

    Args:
        models: of MJCF robots.
        trials: what is predicted.
        starts: for each trial (k, 2 nj) coordinates and rates at the start, one row a model, or (k, 2 nj + 2 nl), see
            ``Trial.begun``; the trial's by default.
        threads: to use; all cores by default. The result does not depend on it.
        dt: another physics step [s].
        hard_friction: see ``realise``.

    Returns:
        One ``Predicted`` for each trial.

    Raises:
        ConfigError: where ``dt`` is no step.
    """
    if dt is not None and not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    check_size(trials, dt or mjcf_of(models[0].robot).timestep)
    nj, k = len(models[0].robot.joint_names), len(models)
    results = [Predicted.empty(k, trial, nj) for trial in trials]
    histories: dict[tuple[int, tuple[Effect, ...], bytes, float], Array] = {}
    count = computer.worker_count(threads, name="threads")
    chunks = parted(trials, max(math.ceil(count / k), 1))

    def command(i: int, own: Realised) -> Array:
        shaping = tuple(e for e in own.effects if e.side == "command")
        key = (i, shaping, own.valve.tobytes(), float(own.mujoco.opt.timestep))
        if key not in histories:
            histories[key] = commands_on(own, trials[i])
        return histories[key]

    def work(task: tuple[int, list[int]]) -> None:
        which, chunk = task
        made: dict[Condition, tuple[Realised, Leader | None]] = {}
        for i in chunk:
            trial = trials[i]
            condition = trial.condition
            if condition not in made:
                own = realise(models[which], trial, dt, hard_friction)
                made[condition] = own, leader_of(own)
            own, leader = made[condition]
            if starts is not None:
                start = np.asarray(starts[i][which], dtype=np.float64)
                start = start if len(start) >= 2 * nj else np.concatenate([start, np.zeros(nj)])
            else:
                velocity = np.zeros(nj) if trial.velocity is None else trial.velocity
                start = np.concatenate([trial.position, velocity])
            path = follow(own, trial, start, command(i, own), leader=leader)
            found = measured_of(own, path, trial.sample_times, trial)
            results[i].position[which], results[i].reached[which] = found
            if (motion := results[i].motion) is not None:
                motion[which] = inner_of(path, trial.sample_times)
            if (forces := results[i].forces) is not None:
                forces[which] = forces_of(own, path, trial)

    tasks = [(which, chunk) for which in range(k) for chunk in chunks]
    with quietly():
        for stepped in dict.fromkeys(stepped_laws(model.effects) for model in models):
            _, kernel = compiled.load_mjcf(stepped)
            if not kernel.run_mjcf.signatures:  # what has to be compiled is compiled once
                first = next(task for task in tasks if stepped_laws(models[task[0]].effects) == stepped)
                tasks.remove(first)
                work(first)
        if count == 1 or len(tasks) <= 1:
            for task in tasks:
                work(task)
        else:
            list(computer.threads(count).map(work, tasks))
    return results


def command_at(trial: Trial, times: Array) -> Array:
    """(n, na) the commands in force at instants (n,) [s]."""
    return trial.command_at(times)


@quietly()
def joint_forces(
    own: Realised, position: Array, velocity: Array, command: Array, moved: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """Forces of the drives (n, na) and of gravity and motion on the joints (n, nj), without accelerations [N·m or N].

    Args:
        own: the robot.
        position: (n, nj) of the joints.
        velocity: (n, nj) their rates.
        command: (n, na) in force.
        moved: (n, np + nu) positions and rates of the other joints, see ``others_along``; at rest at 0 by default.
    """
    model, data = own.mujoco, scratch.data(own.mujoco)
    which = [drive.index for drive in own.robot.actuators]
    drives, weights = np.empty((len(position), len(which))), np.empty(position.shape)
    moved = moved or (np.zeros((len(position), len(own.others))),) * 2
    for k in range(len(position)):
        data.qpos[own.places[:, 0]], data.qvel[own.places[:, 1]] = position[k], velocity[k]
        for q, v, joint in own.rotors:
            data.qpos[q], data.qvel[v] = position[k, joint], velocity[k, joint]
        data.qpos[own.others[:, 0]], data.qvel[own.others[:, 1]] = moved[0][k], moved[1][k]
        data.ctrl[: command.shape[1]] = command[k]
        for drive in own.robot.actuators:
            if drive.state is not None:
                settled = command[k, drive.control]
                data.act[drive.state] = min(max(settled, 0.0), 1.0) if drive.activates else settled
        mujoco.mj_forward(model, data)
        drives[k] = data.actuator_force[which]
        weights[k] = data.qfrc_bias[own.places[:, 1]]
    return drives, weights


def places_in_room(own: Realised, position: Array, places: Sequence[str], moved: Array) -> Array:
    """(n, k, 3) where k sites or bodies' centres of mass are in the room [m].

    Args:
        own: the robot.
        position: (n, nj) of the joints.
        places: names of the sites and bodies.
        moved: (n, np + nu) of the others.
    """
    model, data = own.mujoco, scratch.data(own.mujoco)
    hooks = [hook_of(model, place) for place in places]
    found = np.empty((len(position), len(hooks), 3))
    for k in range(len(position)):
        data.qpos[own.places[:, 0]], data.qpos[own.others[:, 0]] = position[k], moved[k]
        mujoco.mj_kinematics(model, data)
        found[k] = [data.xpos[body] + data.xmat[body].reshape(3, 3) @ point for body, point in hooks]
    return found
