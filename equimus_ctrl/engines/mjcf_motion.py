"""What moves inside an MJCF robot in a trial, and how it responds to small generalised forces: by simulating them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.computer import threads, worker_count
from equimus_ctrl.engines.mjcf import Course, commands_on, follow, forces_of, inner_of, leader_of, measured_of
from equimus_ctrl.engines.mjcf_lead import Leader
from equimus_ctrl.engines.mjcf_realised import Realised, realise
from equimus_ctrl.engines.motion import Inner, Motion, hermite_arrays
from equimus_ctrl.engines.trials import Condition, Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array

SMALL = 1e-3
"""A force that is simulated to see what it does, as a share of what the drives and gravity exert."""


@dataclass(frozen=True, eq=False)
class SimulatedResponse:
    """An MJCF robot's motions, and its response to small generalised forces.

    Attributes:
        model: what moves.
        trials: what was done.
        starts: for each trial (2 nj,) coordinates and rates at its start.
        motions: what came of it.
        scale: (nj,) usual size of forces [N·m or N].
        threads: among which forces are shared out; as many as there are processors by default.
    """

    model: Model
    trials: tuple[Trial, ...]
    starts: tuple[Array, ...]
    motions: tuple[Motion, ...]
    scale: Array
    threads: int | None = None

    def response(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m, nj, k) the change of the measured coordinates by small forces, over the force.

        Args:
            torques: for each trial (m − 1, nj, k), constant over each interval between samples [N·m or N].

        Raises:
            ConfigError: where there are not as many as trials.
        """

        def read(own: Realised, course: Course, trial: Trial) -> Array:
            return measured_of(own, course, trial.sample_times, trial)[0]

        return self._responses(torques, read, len(self.scale))

    def inner_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, 2 nj, k) of the true positions and rates."""

        def read(own: Realised, course: Course, trial: Trial) -> Array:
            return inner_of(course, trial.sample_times)

        return self._responses(torques, read, 2 * len(self.scale))

    def drive_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, na, k) of the forces of each command's actuator, in trials that ask for them."""
        return self._responses(torques, forces_of, len(self.model.robot.actuator_names))

    def _responses(
        self, torques: Sequence[Array], read: Callable[[Realised, Course, Trial], Array], numbers: int
    ) -> list[Array]:
        """Changes of so many numbers that are read off courses."""
        if len(torques) != len(self.trials):
            raise ConfigError(f"torques are for {len(torques)} trials, expected {len(self.trials)}")
        found = [
            np.zeros((len(t.sample_times), numbers, torque.shape[2]))
            for t, torque in zip(self.trials, torques, strict=True)
        ]
        count = torques[0].shape[2]

        def work(columns: Sequence[int]) -> None:
            known: dict[Condition, tuple[Realised, Leader | None]] = {}
            for i, trial in enumerate(self.trials):
                condition = trial.condition
                if condition not in known:
                    own = realise(self.model, trial)
                    known[condition] = own, leader_of(own)
                own, leader = known[condition]
                dt = float(own.mujoco.opt.timestep)
                ctrl = commands_on(own, trial)
                plain = read(own, follow(own, trial, self.starts[i], ctrl, leader=leader), trial)
                for column in columns:
                    torque = torques[i][:, :, column]
                    size = float(np.max(np.abs(torque) / self.scale, initial=0.0))
                    if size == 0.0:
                        continue
                    factor = SMALL / size
                    force = _on_steps(trial, torque * factor, dt, len(ctrl))
                    course = follow(own, trial, self.starts[i], ctrl, force, leader)
                    if course.sound == len(course.q):
                        found[i][:, :, column] = (read(own, course, trial) - plain) / factor

        parts = worker_count(self.threads)
        with quietly():
            list(threads(parts).map(work, [range(k, count, parts) for k in range(parts)]))
        return found


def _on_steps(trial: Trial, torque: Array, dt: float, steps: int) -> Array:
    """(steps, nj) means over physics steps of what is constant between samples (m − 1, nj)."""
    times = trial.sample_times
    whole = np.vstack([np.zeros_like(torque[:1]), np.cumsum(torque * np.diff(times)[:, None], axis=0)])
    edges = trial.start + dt * np.arange(steps + 1)
    sums = np.column_stack([np.interp(edges, times, column) for column in whole.T])
    return np.ascontiguousarray(np.diff(sums, axis=0) / dt)


def mjcf_motion(model: Model, trial: Trial, start: Array) -> Motion:
    """Follow an MJCF robot through a trial.

    Args:
        model: what moves.
        trial: its commands and sample times.
        start: (2 nj,) coordinates and rates at the start.

    Raises:
        SimulationDiverged: where the simulation does.
    """
    own = realise(model, trial)
    with quietly():
        course = follow(own, trial, start, commands_on(own, trial), leader=leader_of(own))
    if course.sound < len(course.q):
        raise SimulationDiverged(f"{trial.name}: the simulation of {model.name} diverged")
    names = own.robot.joint_names
    gear = np.zeros((len(own.robot.actuators), len(names)))
    for i, drive in enumerate(own.robot.actuators):
        gear[i, names.index(drive.joint)] = own.mujoco.actuator_gear[own.mujoco.actuator_outadr[drive.index], 0]
    times = np.asarray(trial.sample_times)
    edges = np.vstack([np.zeros_like(course.ctrl[:1]), np.cumsum(course.ctrl, axis=0) * course.dt])
    grid = course.start + course.dt * np.arange(len(edges))
    whole = np.column_stack([np.interp(times, grid, column) for column in edges.T])
    middles = (times[1:] + times[:-1]) / 2
    between = _inner(course, gear, middles, np.diff(whole, axis=0) / np.diff(times)[:, None])
    step = np.clip(((times - course.start) / course.dt).astype(int), 0, len(course.ctrl) - 1)
    at = _inner(course, gear, times, course.ctrl[step])
    return Motion(**vars(at), name=trial.name, start=float(trial.times[0]), between=between)


def _inner(course: Course, gear: Array, times: Array, command: Array) -> Inner:
    place = (times - course.start) / course.dt
    step = np.clip(place.astype(int), 0, len(course.ctrl) - 1)
    share = (place - step)[:, None]
    q, v = course.q, course.v
    position = hermite_arrays(q[step], v[step], q[step + 1], v[step + 1], course.dt, share)
    velocity = v[step] + share * (v[step + 1] - v[step])
    arm = np.broadcast_to(gear, (len(times), *gear.shape)).copy()
    return Inner(
        np.array(times),
        position,
        velocity,
        command,
        position @ gear.T,
        velocity @ gear.T,
        arm,
        position,
        velocity,
        np.empty((len(times), 0)),
    )


def simulated_response(
    model: Model, trials: Sequence[Trial], starts: Sequence[Array], scale: Array, count: int | None = None
) -> SimulatedResponse:
    """An MJCF robot with its motions through trials.

    Args:
        model: what moves.
        trials: what is done.
        starts: for each (2 nj,) coordinates and rates at the start.
        scale: (nj,) usual size of forces [N·m or N].
        count: of threads among which forces are shared out; as many as there are processors by default.

    Raises:
        SimulationDiverged: where it diverges in one of them.
    """
    motions = tuple(mjcf_motion(model, trial, start) for trial, start in zip(trials, starts, strict=True))
    return SimulatedResponse(model, tuple(trials), tuple(starts), motions, scale, count)
