"""Inverse dynamics of MJCF robots along measured motions: the generalised forces that a model lacks.

    r = M(q) a + c(q, v) − passive(q, v) − drives(q, v, u) − laws(q, v)

Measurements y at even intervals dt are smoothed by B∗B, B the mean of ``width`` samples, before it is evaluated, and r
is smoothed by B∗B once more: with q = B∗B∗y, a = B∗B∗(y₊ − 2y + y₋)/dt². What is linear in the motion is so weighted
by one test function, the cubic B-spline B∗B∗B∗B, and accelerations cost no differentiation of noise beyond its second
derivative: modulating functions (Shinbrot, 1957), or the weak form of the equations of motion (Messenger & Bortz, "Weak
SINDy for partial differential equations", 2021). Commands are smoothed alike, so that no filter delays one side alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import casadi as ca
import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.command import DELAY, FILL, VENT, pressure_history
from equimus_ctrl.effects.force import ForceEffect, force_effects
from equimus_ctrl.effects.sensors import SCALE, SENSOR_DELAY, behind
from equimus_ctrl.effects.valves import shaping_effects, valve_settings
from equimus_ctrl.engines.mjcf import commands_on
from equimus_ctrl.engines.mjcf_kernel import called
from equimus_ctrl.engines.mjcf_realised import Realised, function_address, realise, scratch
from equimus_ctrl.engines.trials import Condition, Trial
from equimus_ctrl.models.augmented import state_change
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array

STILL = 3.0
"""Rate below which a joint counts as standing, in standard deviations of the rate's noise."""
MOVES = 0.8
"""Share of what a test function weighs in which a joint has to move."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """A recording, or a part of one, at even times.

    Attributes:
        trial: its commands and its condition.
        time: (n,) evenly spaced [s].
        position: (n, nj) as measured [rad or m].
        noise: (nj,) standard deviation of the measurements' noise [rad or m].
        zeros: joints whose sensors' zeros are unknown.
    """

    trial: Trial
    time: Array
    position: Array
    noise: Array
    zeros: tuple[int, ...] = ()

    @property
    def interval(self) -> float:
        """Time between samples [s]."""
        return float(self.time[1] - self.time[0])


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """What is needed to move a robot as it was measured, against what the model says, at n instants.

    Attributes:
        position: (n, nj) smoothed [rad or m].
        rate: (n, nj) smoothed [rad/s or m/s].
        drives: (n, nj) forces of the drives at the joints [N·m or N].
        missing: (n, nj) r [N·m or N].
        moving: (n, nj) whether a joint moves within its range: of one that stands, dry friction may exert anything, and
            at the end of its range its stop.
        parts: so many instants lie in one width.
        time: (n,) since the recording began [s].
    """

    position: Array
    rate: Array
    drives: Array
    missing: Array
    moving: NDArray[np.bool_]
    parts: int
    time: Array

    def weighted(self, values: Array) -> Array:
        """(m, …) values (n, …) smoothed by B∗B, one a width."""
        return _smoothed(values, self.parts)[:: self.parts]

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(m, nj) of the smoothed ones, whether a joint moved while they were weighed."""
        return np.asarray(self.weighted(self.moving.astype(float)) > MOVES)


def inverse_dynamics(model: Model, motions: Sequence[MeasuredMotion], width: int) -> list[InverseDynamics]:
    """The generalised forces that a model lacks along each measured motion, see the module's law.

    Effects that move without being measured, such as a drive's compliance, count as rigid (``Effect.in_torques``).

    Args:
        model: of a robot that ``has_torque_domain``.
        motions: what was measured.
        width: of B, in samples.
    """
    laws = force_effects(model.effects)
    seen = tuple(e for e in model.effects if e not in laws and (e.in_torques or e.side == "measurement"))
    rigid, known = replace(model, effects=seen), dict[Condition, Realised]()
    for motion in motions:
        if motion.trial.condition not in known:
            known[motion.trial.condition] = realise(rigid, motion.trial)
    return [_along_motion(known[motion.trial.condition], laws, motion, width) for motion in motions]


def weighed_as_motion(values: Array, width: int) -> Array:
    """(m, …) values (n, …) at a measured motion's times, smoothed and picked as the motion is."""
    return np.asarray(_smoothed(values[1:-1], width)[:: max(width // 2, 1)])


def _along_motion(own: Realised, laws: Sequence[ForceEffect], motion: MeasuredMotion, width: int) -> InverseDynamics:
    """The same of one of them, of a robot with its effects but the laws at joints."""
    dt, stride, nj = motion.interval, max(width // 2, 1), motion.position.shape[1]
    q, v, a = _motion_behind(motion, width, own.sensor.tobytes(), own.robot.prescribed_names)
    u = _commands_of(motion, width, _Way.of(own)).copy()
    missing, drives = (forces[:, :nj].copy() for forces in _evaluated(own, q, v, a, u))
    q, v = q[:, :nj].copy(), v[:, :nj].copy()
    missing += own.loss * np.sign(v)
    names = own.robot.joint_names
    time = motion.time[0] - motion.trial.times[0] + dt * (width + stride * np.arange(len(q)))
    for coupling in own.robot.couplings:
        first, second = names.index(coupling.joint), names.index(coupling.other)
        against = coupling.friction * np.sign(v[:, first] + coupling.sign * v[:, second])
        missing[:, first] += against
        missing[:, second] += coupling.sign * against
    for law in laws:
        j = names.index(law.location)
        missing[:, j] -= law_force(type(law), law.parameters(), q[:, j], v[:, j], drives[:, j], time)
    # The rate's noise: of (y₊ − y₋)/2dt smoothed by a triangle of the width.
    noise = motion.noise / own.sensor[:, SCALE] / (dt * width**1.5)
    low, high = own.robot.joint_range
    moving = (np.abs(v) > STILL * noise) & (q > low) & (q < high)
    return InverseDynamics(q, v, drives, missing, moving, max(round(width / stride), 1), time)


@lru_cache(maxsize=32)
def _motion_behind(
    motion: MeasuredMotion, width: int, sensor: bytes, prescribed: tuple[str, ...]
) -> tuple[Array, Array, Array]:
    """(n, nj + np) positions, rates and accelerations behind sensors (nj, 4) as bytes; most models have the same."""
    dt, stride = motion.interval, max(width // 2, 1)
    settings = np.frombuffer(sensor).reshape(motion.position.shape[1], -1)
    moved = motion.trial.motion_of(prescribed).at(motion.time)[0] if prescribed else np.empty((len(motion.time), 0))
    shown = np.column_stack([behind(settings, motion.position), moved])
    late = np.append(settings[:, SENSOR_DELAY], np.zeros(moved.shape[1])) / dt
    rows = np.arange(1, len(shown) - 1)
    q, v, a = (
        _earlier(late, _smoothed(values, width))[::stride].copy()
        for values in (
            shown[rows],
            (shown[rows + 1] - shown[rows - 1]) / (2 * dt),
            (shown[rows + 1] - 2 * shown[rows] + shown[rows - 1]) / dt**2,
        )
    )
    return q, v, a


def law_force(
    law: type[ForceEffect], parameters: Mapping[str, float], position: Array, rate: Array, drive: Array,
    time: Array | None = None,
) -> Array:  # fmt: skip
    """(n,) what a law exerts at a joint that moves so, under a drive's force [N·m or N].

    Args:
        law: which.
        parameters: of the law.
        position: (n,) of the joint [rad or m].
        rate: (n,) of it.
        drive: (n,) the drive's force [N·m or N].
        time: (n,) since the recording began, evenly spaced [s]; laws without states need none.
    """
    own, values = _functions(law), np.array(list(parameters.values()))
    return own.force(position, rate, drive, own.states(position, rate, time, values), values)


def law_slopes(
    law: type[ForceEffect], parameters: Mapping[str, float], position: Array, rate: Array, drive: Array,
    time: Array | None = None,
) -> Array:  # fmt: skip
    """(n, p) its derivatives by the parameters, its states held; see ``law_force``."""
    own, values = _functions(law), np.array(list(parameters.values()))
    return own.slopes(position, rate, drive, own.states(position, rate, time, values), values)


@dataclass(frozen=True, eq=False)
class _Law:
    """A law's force and its derivatives by the parameters, as compiled functions of scalars.

    Attributes:
        n_states: of the law.
        one: the force.
        slope: (1, p).
        start: its states where a motion starts.
        step: them after a step in which the motion is held.
    """

    n_states: int
    one: ca.Function
    slope: ca.Function
    start: ca.Function
    step: ca.Function

    def force(self, position: Array, rate: Array, drive: Array, states: Array, values: Array) -> Array:
        """(n,) at n instants."""
        return np.asarray(self.one(position[None], rate[None], drive[None], states, values[:, None])).ravel()

    def slopes(self, position: Array, rate: Array, drive: Array, states: Array, values: Array) -> Array:
        """(n, p) at n instants."""
        n = len(position)
        found = self.slope.map(n)(position[None], rate[None], drive[None], states, np.tile(values[:, None], n))
        return np.asarray(found).reshape(n, len(values))

    def states(self, position: Array, rate: Array, time: Array | None, values: Array) -> Array:
        """(nz, n) along a motion, evenly sampled; between two instants it is half way between them."""
        n = len(position)
        if not self.n_states:
            return np.zeros((0, n))
        assert time is not None
        first = np.asarray(self.start(position[0], rate[0], time[0], values))
        if n < 2:
            return first
        middle = [(part[1:] + part[:-1])[None] / 2 for part in (position, rate)]
        dt = np.full((1, n - 1), time[1] - time[0])
        later = self.step.mapaccum("states", n - 1)(first, *middle, dt, np.tile(values[:, None], n - 1))
        return np.hstack([first, np.asarray(later)])


_KNOWN: dict[type[ForceEffect], _Law] = {}


def _functions(law: type[ForceEffect]) -> _Law:
    if law not in _KNOWN:
        x, rate, drive, time, dt = (ca.SX.sym(name) for name in ("x", "rate", "drive", "time", "dt"))
        p = {key: ca.SX.sym(key) for key in law.parameter_info()}
        z = [ca.SX.sym(f"z{k}") for k in range(law.n_states)]
        whole, states = ca.vertcat(*p.values()), ca.vertcat(*z, ca.SX(0, 1))
        force = law.sliding_force(x, rate, z, drive, p)
        symbols = [x, rate, drive, states, whole]
        rates = law.state_rate(x, rate, z, p)
        after = [own + state_change(ca.SX(r), own, dt) for own, r in zip(z, rates, strict=True)]
        start = ca.vertcat(*law.start_state(x, rate, time, p), ca.SX(0, 1))
        _KNOWN[law] = _Law(
            law.n_states,
            ca.Function("force", symbols, [force]),
            ca.Function("slope", symbols, [ca.jacobian(force, whole)]),
            ca.Function("start", [x, rate, time, whole], [start]),
            ca.Function("step", [states, x, rate, dt, whole], [ca.vertcat(*after, ca.SX(0, 1))]),
        )
    return _KNOWN[law]


def _earlier(samples: Array, values: Array) -> Array:
    """(n, nj) what was when late sensors showed it, so many samples later; at the end as it was last.

    Of smoothed values, for interpolation between noisy ones would smooth them.
    """
    if not samples.any():
        return values
    at = np.arange(len(values))
    return np.column_stack([np.interp(at + late, at, values[:, j]) for j, late in enumerate(samples)])


@dataclass(frozen=True)
class _Way:
    """What is on the way from commands to a robot's drives, and a robot that has it.

    Attributes:
        shaping: effects that shape commands.
        ranges: between what drives clip them, as bytes.
        valve: (na, 6) of the actuators, as bytes.
        filters: (nu, …) numbers of actuators' own filters, as bytes.
        dt: the physics step on which commands are evaluated [s].
        own: the robot.
    """

    shaping: tuple[Effect, ...]
    ranges: bytes
    valve: bytes
    filters: bytes
    dt: float
    own: Realised = field(compare=False)

    @classmethod
    def of(cls, own: Realised) -> _Way:
        """That of a robot."""
        ranges, numbers = own.robot.command_ranges, own.mujoco.actuator_dynprm
        return cls(
            tuple(shaping_effects(own.effects)),
            b"" if ranges is None else np.asarray(ranges).tobytes(),
            own.valve.tobytes(),
            numbers.tobytes(),
            float(own.mujoco.opt.timestep),
            own,
        )


@lru_cache(maxsize=32)
def _commands_of(motion: MeasuredMotion, width: int, way: _Way) -> Array:
    """(n, na) ``_commands`` weighed as the motion is; most models have the same."""
    return weighed_as_motion(_commands(way.own, motion), width)


def _commands(own: Realised, motion: MeasuredMotion) -> Array:
    """(n, na) means, between the middles of the intervals, of what drives make their forces of."""
    times, dt = motion.time, float(own.mujoco.opt.timestep)
    trial = replace(motion.trial, start=float(times[0]), sample_times=times + motion.interval)
    steps = commands_on(own, trial)[:, : len(own.robot.actuators)]
    filtered = [drive for drive in own.robot.actuators if drive.state is not None]
    if filtered:
        lags = valve_settings((), own.robot.actuator_names)
        for drive in filtered:
            lags[drive.control, [FILL, VENT]] = own.mujoco.actuator_dynprm[drive.index, 0]
        lags[:, DELAY] = 0.0
        out = np.empty((len(steps), 2, steps.shape[1]))
        grid = np.asarray(trial.start + dt * np.arange(len(steps)), dtype=np.float64)
        pressure_history(grid, steps.copy(), steps[0].copy(), lags, trial.start, dt, out)
        steps = np.ascontiguousarray(out[:, 0])
    whole = np.vstack([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0) * dt])
    edges = trial.start + dt * np.arange(len(whole))
    half = motion.interval / 2
    low, high = np.maximum(times - half, edges[0]), times + half
    columns = [(np.interp(high, edges, c) - np.interp(low, edges, c)) / (high - low) for c in whole.T]
    return np.column_stack(columns) if columns else np.empty((len(times), 0))


def _smoothed(values: Array, width: int) -> Array:
    """(n − 2 width + 2, …) values (n, …) smoothed by B∗B."""
    for _ in range(2):
        if width > 1:
            whole = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0)
            values = (whole[width:] - whole[:-width]) / width
    return np.asarray(values)


def _evaluated(own: Realised, q: Array, v: Array, a: Array, u: Array) -> tuple[Array, Array]:
    """(n, nj + np) M a + c − passive − drives, and the drives' forces at the joints, of motions (n, nj + np)."""
    model = own.mujoco
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = scratch.data(model)
    joints = np.vstack([own.places[:, :2], own.moved])
    states = np.array(
        [(d.state, d.control) for d in own.robot.actuators if d.state is not None], dtype=np.int64
    ).reshape(-1, 2)
    missing, drives = np.empty(q.shape), np.empty(q.shape)
    with quietly():
        _along(
            function_address("mj_inverse"), function_address("mj_fwdActuation"), model._address, data._address, joints,
            states, q, v, a, np.ascontiguousarray(u), data.qpos, data.qvel, data.qacc, data.ctrl, data.act,
            data.qfrc_inverse, data.qfrc_actuator, missing, drives,
        )  # fmt: skip
    return missing, drives


@njit(cache=True, nogil=True, error_model="numpy")
def _along(
    inverse: int,
    actuation: int,
    model: int,
    data: int,
    joints: NDArray[np.int64],
    states: NDArray[np.int64],
    q: Array,
    v: Array,
    a: Array,
    u: Array,
    qpos: Array,
    qvel: Array,
    qacc: Array,
    control: Array,
    activation: Array,
    needed: Array,
    driven: Array,
    missing: Array,
    drives: Array,
) -> None:
    for k in range(len(q)):
        for j in range(len(joints)):
            qpos[joints[j, 0]], qvel[joints[j, 1]], qacc[joints[j, 1]] = q[k, j], v[k, j], a[k, j]
        for i in range(u.shape[1]):
            control[i] = u[k, i]
        for s in range(len(states)):
            activation[states[s, 0]] = u[k, states[s, 1]]
        called(inverse, model, data)
        called(actuation, model, data)
        for j in range(len(joints)):
            drives[k, j] = driven[joints[j, 1]]
            missing[k, j] = needed[joints[j, 1]] - drives[k, j]


def motions_of(
    trials: Sequence[Trial], measured: Sequence[Array], noise: Array, zeros: Sequence[tuple[int, ...]] = ()
) -> list[MeasuredMotion]:
    """Recordings at even times, by linear interpolation where their own are uneven.

    Shooting intervals that follow one another in one recording are one.

    Args:
        trials: of the segments, in order.
        measured: for each (m, nj) [rad or m].
        noise: (nj,) standard deviation of the measurements' noise [rad or m].
        zeros: for each the joints whose sensors' zeros are unknown; none by default.
    """
    runs: list[list[int]] = []
    for k, trial in enumerate(trials):
        before = trials[runs[-1][-1]] if runs else None
        follows = before is not None and before.history == trial.history and before.condition == trial.condition
        if before is not None and follows:
            step = float(np.median(np.diff(trial.sample_times)))
            follows = 0 < trial.sample_times[0] - before.sample_times[-1] < 2.5 * step
        if follows:
            runs[-1].append(k)
        else:
            runs.append([k])
    found = []
    for run in runs:
        time = np.concatenate([trials[k].sample_times for k in run])
        position = np.concatenate([measured[k] for k in run])
        step = float(np.median(np.diff(time)))
        even = time[0] + step * np.arange(int(np.floor((time[-1] - time[0]) / step + 1e-6)) + 1)
        columns = [np.interp(even, time, column) for column in position.T]
        found.append(
            MeasuredMotion(trials[run[0]], even, np.column_stack(columns), noise, zeros[run[0]] if zeros else ())
        )
    return found
