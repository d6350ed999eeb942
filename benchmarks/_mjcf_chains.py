"""Robots, commands and runs with which ``engines.py --mjcf`` compares the reduced engine and MuJoCo.

Commands are held for 10 ms, as a controller of 100 Hz holds them. Runs of one trial share them and differ in where they
start: the reduced engine has them side by side in the lanes of one loop. Contacts are off.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from mujoco.rollout import Rollout

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import Encoded, encode
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

HELD = 0.01
"""So long a command is held [s]."""
LANES = 8
"""Runs of one trial."""
SHARE_OF_WEIGHT, ACCELERATION = 0.5, 6.0
"""Torques of motors: a share of gravity's in random poses, and what accelerates the joint so much [rad/s²]."""
FREQUENCIES = 0.3, 1.5
"""Of the sines of commands, lowest and highest [Hz]."""
GOALS = 0.3
"""Largest way of a servo's goal from the middle [rad or m]."""
SPREAD = 0.3
"""Of starts: joint coordinates and rates [rad, rad/s]."""
LEAST_TIME = 0.02
"""A job that is shorter is timed several times in a row [s of CPU]."""
AXES = "0.2 1 0.1", "1 0.1 -0.3", "0.1 0.9 0.4"

FIRST_START = """
import sys, time
from pathlib import Path
from equimus_ctrl import workflow
from equimus_ctrl.engines.batch import compile_kernel
from equimus_ctrl.models.model import Model
model = Model(workflow.load_mjcf(Path(sys.argv[1])))
begun = time.process_time()
compile_kernel(model)
print(time.process_time() - begun)
"""


def chain(n: int) -> str:
    """MJCF of n hinges in a row: oblique frames, axes and inertias, damping, armature and motors, no geoms."""
    bodies, motors = "", ""
    for i in range(n):
        size = 1.5 / (1 + 0.5 * i)
        bodies += (
            f'<body name="link{i}" pos="{0.03 * (i % 2)} 0.02 {-0.2 if i else 1.5}" euler="{0.15 * i} -0.2 {0.4 * i}">'
            f'<joint name="joint{i}" axis="{AXES[i % 3]}" damping="{0.4 * size}" armature="{0.03 * size}"/>'
            f'<inertial pos="0.02 -0.01 -0.11" euler="0.3 {0.2 * i} 0.1" mass="{size}" '
            f'diaginertia="{0.009 * size} {0.008 * size} {0.003 * size}"/>'
        )
        motors += f'<motor name="motor{i}" joint="joint{i}"/>'
    return (
        f'<mujoco model="chain of {n}"><compiler angle="radian"/><worldbody>{bodies}{"</body>" * n}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def compile_times(xml: Path, cache: Path) -> tuple[float, float]:
    """CPU time [s] until the kernel of a robot can be called, for the first time and again, each in a new process."""
    took = [
        float(
            subprocess.run(
                [sys.executable, "-c", FIRST_START, str(xml)],
                env={**os.environ, "EQUIMUS_CACHE": str(cache)},
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            ).stdout
        )
        for _ in range(2)
    ]
    return took[0], took[1]


def with_friction(robot: MjcfRobot, size: Array) -> MjcfRobot:
    """The robot with dry friction (nj,) in its joints in place of its own [N·m or N]."""
    return robot.with_parameters({f"{j}.frictionloss": float(s) for j, s in zip(robot.joint_names, size, strict=True)})


def mujoco_model(robot: MjcfRobot, integrator: str, dt: float) -> Any:
    """MuJoCo's model of a robot with an integrator and a step [s], contacts off."""
    model = robot.mujoco_model(dt)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    return model


def hanging_pose(robot: MjcfRobot) -> Array:
    """(nj,) where gravity brings the joints to, so much damped that they do not swing; servos hold the middle."""
    model = mujoco_model(robot, "implicitfast", 2e-3)
    model.dof_damping[:] = np.maximum(20 * model.dof_M0, model.dof_damping)
    data = mujoco.MjData(model)
    low, high = robot.joint_range
    middle = np.zeros(len(low))
    limited = np.isfinite(low) & np.isfinite(high)
    middle[limited] = (low[limited] + high[limited]) / 2
    data.qpos[[axis.position for axis in robot.joints]] = middle + 0.1
    for drive in robot.actuators:
        if drive.servo:
            data.ctrl[drive.control] = middle[robot.joint_names.index(drive.joint)]
    for _ in range(10_000):
        mujoco.mj_step(model, data)
    return np.array(data.qpos[[axis.position for axis in robot.joints]])


def drive_torques(robot: MjcfRobot, seed: int = 0) -> Array:
    """(nj,) torques or forces of a size that moves each joint well."""
    model, rng = robot.mujoco_model(), np.random.default_rng(seed)
    data, dofs = mujoco.MjData(model), [axis.dof for axis in robot.joints]
    weights, inertias = [], []
    for _ in range(50):
        data.qpos[[axis.position for axis in robot.joints]] = rng.uniform(-np.pi, np.pi, len(dofs))
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        weights.append(np.abs(data.qfrc_bias[dofs]))
        inertias.append(np.diag(full)[dofs])
    return np.array(SHARE_OF_WEIGHT * np.mean(weights, axis=0) + ACCELERATION * np.mean(inertias, axis=0))


def grid(duration: float, step: float) -> Array:
    """Instants from 0 to the end [s]."""
    return np.array(step * np.arange(round(duration / step) + 1), dtype=np.float64)


def sines(times: Array, columns: int, rng: np.random.Generator) -> Array:
    """(n, columns) two sines each, between −1 and 1."""
    phase, frequency = rng.uniform(0, 2 * np.pi, (2, columns)), rng.uniform(*FREQUENCIES, (2, columns))
    return np.array(np.sin(2 * np.pi * times[:, None, None] * frequency + phase).mean(axis=1))


@dataclass(frozen=True, eq=False)
class Work:
    """What both engines simulate.

    Attributes:
        robot: whose motion.
        duration: of each run [s].
        commands: (trials, n, na), each held for ``HELD``.
        position: (trials, LANES, nj) at the start [rad or m].
        velocity: (trials, LANES, nj) at the start [rad/s or m/s].
    """

    robot: MjcfRobot
    duration: float
    commands: Array
    position: Array
    velocity: Array

    @classmethod
    def of(cls, robot: MjcfRobot, trials: int, duration: float, seed: int) -> Work:
        """Motors have torques of ``drive_torques``; servos have goals around the pose where the robot is at rest."""
        names, rng = robot.joint_names, np.random.default_rng(seed)
        rest, torque, model = hanging_pose(robot), drive_torques(robot), robot.mujoco_model()
        times = grid(duration, HELD)[:-1]
        commands = np.empty((trials, len(times), len(robot.actuators)))
        for t in range(trials):
            commands[t] = sines(times, commands.shape[2], rng)
        position = rest + rng.uniform(-SPREAD, SPREAD, (trials, LANES, len(names)))
        velocity = rng.uniform(-SPREAD, SPREAD, (trials, LANES, len(names)))
        for i, drive in enumerate(robot.actuators):
            joint = names.index(drive.joint)
            if drive.servo:
                commands[:, :, i] = rest[joint] + GOALS * commands[:, :, i]
            else:
                unit = model.actuator_gainprm[drive.index, 0] * model.actuator_gear[drive.index, 0]
                if not unit:
                    raise SystemExit(f"{robot.name}: actuator {drive.name!r} has no gain, expected motors and servos")
                commands[:, :, i] *= torque[joint] / unit
        return cls(robot, duration, commands, position, velocity)

    def part(self, trials: int) -> Work:
        """The first trials alone."""
        return Work(self.robot, self.duration, *(a[:trials] for a in (self.commands, self.position, self.velocity)))

    def on(self, robot: MjcfRobot) -> Work:
        """The same with another robot."""
        return Work(robot, self.duration, self.commands, self.position, self.velocity)

    @property
    def runs(self) -> int:
        """How many."""
        return len(self.commands) * LANES

    @cached_property
    def coded(self) -> Encoded:
        """The robot, once for each lane."""
        return encode([Model(self.robot)] * LANES)

    def reduced(self, dt: float, sampled: float) -> Array:
        """(runs, m, nj) joint coordinates every ``sampled`` seconds by the reduced engine with a step [s]."""
        found = simulate(self.coded, self.trials(sampled), starts=self.starts, dt=dt, threads=1, check=False)
        return np.concatenate([f.position for f in found])

    @cached_property
    def starts(self) -> list[Array]:
        """(LANES, 2 nj) for each trial."""
        return list(np.concatenate([self.position, self.velocity], axis=2))

    def trials(self, sampled: float) -> list[Trial]:
        """What ``simulate`` takes."""
        times, out = grid(self.duration, HELD)[:-1], grid(self.duration, sampled)
        return [
            Trial(f"{t}", times, rows, rows[0], 0.0, self.position[t, 0], out) for t, rows in enumerate(self.commands)
        ]


class InMujoco:
    """The same work in MuJoCo, with an integrator and a step [s]; all that can be allocated before is."""

    def __init__(self, work: Work, integrator: str, dt: float) -> None:
        self.model = mujoco_model(work.robot, integrator, dt)
        self.data, self.work, runs = mujoco.MjData(self.model), work, work.runs
        self.places = [axis.position for axis in work.robot.joints]
        self.qpos, self.qvel = np.zeros((runs, self.model.nq)), np.zeros((runs, self.model.nv))
        self.qpos[:, self.places] = work.position.reshape(runs, -1)
        self.qvel[:, [axis.dof for axis in work.robot.joints]] = work.velocity.reshape(runs, -1)
        self.steps = round(work.duration / dt)
        held = np.repeat(np.repeat(work.commands, round(HELD / dt), axis=1), LANES, axis=0)
        self.control = np.zeros((runs, self.steps, self.model.nu))
        self.control[:, :, [drive.control for drive in work.robot.actuators]] = held
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        self.first = np.empty((runs, mujoco.mj_stateSize(self.model, full)))
        for row, q, v in zip(self.first, self.qpos, self.qvel, strict=True):
            self.data.qpos[:], self.data.qvel[:] = q, v
            mujoco.mj_getState(self.model, self.data, row, full)
        self.state = np.empty((runs, self.steps, self.first.shape[1]))
        self.sensors = np.empty((runs, self.steps, self.model.nsensordata))
        self.pool = Rollout(nthread=1)

    @cached_property
    def batch(self) -> tuple[Any, Array, Array]:
        """The ``Batch``, its state at the start, and where it writes."""
        batch = Batch(self.model, nsim=self.work.runs, nthread=1)
        batch.bind("qpos")[:], batch.bind("qvel")[:] = self.qpos, self.qvel
        return batch, np.array(batch.state), np.empty((self.work.runs, self.steps, self.model.nq))

    def rollout(self) -> Array:
        """(runs, steps + 1, nj) by ``mujoco.rollout`` on one thread."""
        self.pool.rollout(
            [self.model] * self.work.runs,
            [self.data],
            self.first,
            self.control,
            state=self.state,
            sensordata=self.sensors,
            nstep=self.steps,
            chunk_size=LANES,
        )
        return self._with_start(self.state[:, :, 1 : 1 + self.model.nq])

    def batched(self) -> Array:
        """The same by ``mujoco.batch`` on one thread."""
        batch, first, out = self.batch
        batch.state[:] = first
        batch.rollout(self.steps, self.control, record=("qpos",), out={"qpos": out})
        return self._with_start(out)

    def loop(self, runs: int = 4) -> Array:
        """The same of the first runs, by what anyone would write."""
        out = np.empty((runs, self.steps, self.model.nq))
        for i in range(runs):
            mujoco.mj_resetData(self.model, self.data)
            self.data.qpos[:], self.data.qvel[:] = self.qpos[i], self.qvel[i]
            for k in range(self.steps):
                self.data.ctrl[:] = self.control[i, k]
                mujoco.mj_step(self.model, self.data)
                out[i, k] = self.data.qpos
        return self._with_start(out)

    def _with_start(self, found: Array) -> Array:
        return np.concatenate([self.qpos[: len(found), None], found], axis=1)[:, :, self.places]


def fastest(jobs: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """CPU time of each job [s], the jobs timed alternately, the best of all rounds."""
    best: dict[str, float] = {}
    repeats: dict[str, int] = {}
    for again in range(rounds + 1):
        for name, job in jobs.items():
            begun = time.process_time()
            for _ in range(repeats.get(name, 1)):
                job()
            took = (time.process_time() - begun) / repeats.get(name, 1)
            if again == 0:  # warms up, and tells how often it is called
                repeats[name] = max(int(np.ceil(LEAST_TIME / max(took, 1e-6))), 1)
            else:
                best[name] = min(best.get(name, np.inf), took)
    return best


def robot_files(given: list[Path], folder: Path) -> list[Path]:
    """The files given, or the built-in chains', written into a folder."""
    if given:
        return given
    files = []
    for n in (1, 2, 3, 6, 7):
        files.append(folder / f"chain{n}.xml")
        files[-1].write_text(chain(n))
    return files


def fresh_cache() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder that this process keeps its kernels in from now on."""
    folder = tempfile.TemporaryDirectory(prefix="equimus-engines-")
    os.environ["EQUIMUS_CACHE"] = str(Path(folder.name) / "cache")
    return folder
