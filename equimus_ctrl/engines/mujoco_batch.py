"""Many open-loop runs in MuJoCo at once: same 3-2-1 elements, same motion, hundreds of times faster than real time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from mujoco import batch as mjbatch
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.computer import worker_count
from equimus_ctrl.engines.limits import FOLLOWED, MAX_SPEED
from equimus_ctrl.engines.steps import STABLE, rates_at
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.models.mjcf import (
    ABSENT_STOP,
    POINT_INERTIA,
    SolverSettings,
    compile_model,
    element_slides,
    stop_tendon,
)
from equimus_ctrl.quiet import quietly
from equimus_ctrl.robots.elastic.morphology import BASE, JointStop, Morphology, Phase, pack, structure
from equimus_ctrl.types import Array

FAST_SETTINGS = SolverSettings(timestep=1 / 120, integrator="RK4", softness=0.01)
"""``MujocoBatch`` is then within 1e-5 rad RMSE of the exact Lagrangian in swing and 5e-5 rad in stance, on stops too.

At the moment of a blow a run may be 1e-3 rad off, and a fall through an unstable pose 1e-2 rad. By itself this step is
too long to follow a stop's force.
"""

NEAR_STOP = 5e-3
"""A run is near a stop where a joint is less than this and what it turns in a step from it [rad]."""
MOST_FINER = 64
"""Steps are not made shorter than by this for the sake of a stop."""
FINE_VALUES = 2**23
"""At most so many recorded values are held of runs at shorter steps."""

JOINT_PARAMETERS, ACTUATOR_PARAMETERS, FIRST_JOINT = 13, 9, 3  # the layout of robots.elastic.morphology.pack

Complex = NDArray[np.complex128]


class MujocoBatch:
    """Many runs of one morphology in MuJoCo at once.

    The model is that of ``models.mjcf.compile_model``; an actuator's ends and, in stance, the foot are closed before
    the first step. A run that comes near a joint's stop is simulated anew with steps short enough for the stop's force,
    see ``stop_divisor``. The same inputs give the same bits whatever the number of threads and whichever runs are
    beside.

    Args:
        morphology: what is simulated; see ``of`` for one with other parameters in each run.
        phase: base fixed (swing) or foot pinned (stance).
        settings: of the solver; ``FAST_SETTINGS`` by default.
        threads: how many to use at most; all usable processors by default.

    Raises:
        ModelError: where MuJoCo cannot simulate the morphology, or the settings cannot be.
        ConfigError: for less than one thread.
    """

    def __init__(
        self,
        morphology: Morphology,
        phase: Phase = "swing",
        settings: SolverSettings | None = None,
        threads: int | None = None,
    ) -> None:
        self.morphologies: tuple[Morphology, ...] = (morphology,)
        self.phase: Phase = phase
        self.settings = settings or FAST_SETTINGS
        self.threads = worker_count(threads, name="threads")
        self._model_of = morphology
        self.mujoco_model = compile_model(morphology, phase, self.settings)
        # A reset would hide a divergence; there is only one island to find.
        for flag in ("AUTORESET", "ISLAND"):
            self.mujoco_model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}").value
        self._parameters, self._of_parameters = pack(morphology)[None], False
        self._batch: mjbatch.Batch | None = None
        self._joints = self._addresses(morphology.joint_names)
        self._finer: dict[int, tuple[tuple[Morphology, ...], MujocoBatch]] = {}

    @classmethod
    def of(
        cls,
        morphologies: Sequence[Morphology],
        phase: Phase = "swing",
        settings: SolverSettings | None = None,
        threads: int | None = None,
    ) -> MujocoBatch:
        """A batch whose run i is of ``morphologies[i]``.

        Only one model is compiled; each run's has its fields with other parameters, and moves as the one that
        ``compile_model`` would have made to within the solver's tolerance.

        Args:
            morphologies: of one structure, with the same names; each with the stops of its own.
            phase: base fixed (swing) or foot pinned (stance).
            settings: of the solver; ``FAST_SETTINGS`` by default.
            threads: how many to use at most; all usable processors by default.

        Raises:
            ModelError: where there is none, one differs in more than its parameters, or one cannot be simulated.
            ConfigError: for less than one thread.
        """
        morphologies = tuple(morphologies)
        if not morphologies:
            raise ModelError("a batch needs at least one morphology")
        first = morphologies[0]
        for i, other in enumerate(morphologies):
            if _form(other) != _form(first):
                raise ModelError(
                    f"morphology {i}, {other.name!r}, differs from the first, {first.name!r}, in more than its "
                    "parameters and its stops; a batch takes one structure and the same names"
                )
        parameters = np.array([pack(m) for m in morphologies])
        for other, massless in zip(morphologies, _massless(first, parameters), strict=True):
            if massless:
                compile_model(other, phase, settings)  # raises, and says why
        made = cls(_generic(morphologies), phase, settings, threads)
        made._take(morphologies, parameters)
        return made

    def _take(self, morphologies: tuple[Morphology, ...], parameters: Array) -> None:
        self.morphologies, self._parameters, self._of_parameters = morphologies, parameters, True

    def run(
        self, q0: ArrayLike, v0: ArrayLike, pressure: ArrayLike, torque: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Simulate all runs.

        A run diverges where MuJoCo warns or a joint's speed is no number below ``engines.limits.MAX_SPEED``: its rows
        are NaN from that step on, and the others are as if it had not been there.

        Args:
            q0: (n, nj) first joint angles [rad].
            v0: (n, nj) first joint velocities [rad/s].
            pressure: (n, steps, na) [Pa]; row k is held during step k of ``settings.timestep``, or all the shorter
                ones in its place, and, as in the plant, clipped to the morphology's command range.
            torque: (n, nj) on the joints beside all else, throughout [N·m]; none by default.

        Returns:
            q (n, steps + 1, nj) [rad] and v (n, steps + 1, nj) [rad/s], the first rows as given.

        Raises:
            ConfigError: for arrays of the wrong shape or with numbers that are not finite.
            ModelError: where an actuator has no length at the start.
        """
        start, rate, held, applied = self._checked(q0, v0, pressure, torque)
        q, v = self._rolled_out(start, rate, held, applied)
        dt, model = self.settings.timestep, self.mujoco_model
        divisors = np.ones(len(q), dtype=np.int64)
        for i in np.flatnonzero(near_stop(self.morphologies, q, v, dt)):
            own = self.morphologies[i if len(self.morphologies) > 1 else 0]
            divisors[i] = stop_divisor(own, self.phase, start[i], dt)
        for divisor in np.unique(divisors[divisors > 1]):
            rows = np.flatnonzero(divisors == divisor)
            values = int(divisor) * held.shape[1] * (model.nq + model.nv)
            most = max(FINE_VALUES // values, self.threads)
            for some in np.split(rows, range(most, len(rows), most)):
                fine = self._with_shorter_steps(int(divisor), some)
                found = fine._rolled_out(start[some], rate[some], np.repeat(held[some], divisor, axis=1), applied[some])
                q[some], v[some] = (x[:, ::divisor] for x in found)
        return q, v

    def _with_shorter_steps(self, divisor: int, rows: NDArray[np.int64]) -> MujocoBatch:
        """The batch of some of the runs at a step shorter by a whole factor; the last one is kept."""
        several = len(self.morphologies) > 1
        own = tuple(self.morphologies[i] for i in rows) if several else self.morphologies
        known, fine = self._finer.get(divisor, ((), self))
        if len(known) != len(own) or any(a is not b for a, b in zip(known, own, strict=True)):
            shorter = replace(self.settings, timestep=self.settings.timestep / divisor)
            fine = MujocoBatch(self._model_of, self.phase, shorter, self.threads)
            if self._of_parameters:
                fine._take(own, self._parameters[rows] if several else self._parameters)
            self._finer[divisor] = own, fine
        return fine

    def _rolled_out(self, start: Array, rate: Array, held: Array, applied: Array) -> tuple[Array, Array]:
        """All runs at the settings' step, as ``run`` returns them."""
        qpos, qvel = self._closed(start, rate)
        n, steps = held.shape[:2]
        runs = self._batch_of(n)
        runs.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        runs.bind("qpos")[:] = qpos
        runs.bind("qvel")[:] = qvel
        runs.bind("qfrc_applied")[:, self._joints[1]] = applied
        clock = mujoco.mjtState.mjSTATE_TIME
        model = self.mujoco_model
        record = {"qpos": np.empty((n, steps, model.nq)), "qvel": np.empty((n, steps, model.nv))}
        record[clock] = np.empty((n, steps, 1))
        sound = np.full(n, steps)
        try:
            with quietly():
                runs.rollout(steps, held, record=tuple(record), out=record)
        except mjbatch.SimulationError as error:
            sound[error.ids] = 0
        qs, vs = self._joints
        q = np.concatenate([start[:, None], record["qpos"][:, :, qs]], axis=1)
        v = np.concatenate([rate[:, None], record["qvel"][:, :, vs]], axis=1)
        for i in np.flatnonzero(runs.warning[:, :, 1].sum(axis=1)):
            # A warned run stops: its clock last advances in the step that warned.
            ticks = np.diff(record[clock][i, :, 0], prepend=0.0) > 0
            sound[i] = min(sound[i], max(int(ticks.sum()) - 1, 0))
        slow = np.all(np.isfinite(q) & (np.abs(v) < MAX_SPEED), axis=2)
        slow &= np.arange(steps + 1) <= sound[:, None]
        lost = ~np.logical_and.accumulate(slow, axis=1)
        q[lost] = v[lost] = np.nan
        return q, v

    def _checked(
        self, q0: ArrayLike, v0: ArrayLike, pressure: ArrayLike, torque: ArrayLike | None
    ) -> tuple[Array, Array, Array, Array]:
        m = self.morphologies[0]
        nj, na = len(m.joints), len(m.actuators)
        start, rate, held = (np.asarray(x, dtype=np.float64) for x in (q0, v0, pressure))
        applied = np.zeros_like(start) if torque is None else np.asarray(torque, dtype=np.float64)
        n = len(start) if len(self._parameters) == 1 and start.ndim == 2 else len(self._parameters)
        steps = held.shape[1] if held.ndim == 3 else 0
        for key, array, shape, names in (
            ("q0", start, (n, nj), m.joint_names),
            ("v0", rate, (n, nj), m.joint_names),
            ("pressure", held, (n, max(steps, 1), na), m.actuator_names),
            ("torque", applied, (n, nj), m.joint_names),
        ):
            if n < 1 or array.shape != shape:
                wanted = shape if key != "pressure" else f"({n}, steps, {na}) with at least one step"
                raise ConfigError(
                    f"{m.name}: {key} has shape {array.shape}, expected {wanted} for runs of {', '.join(names)}"
                )
            if not np.all(np.isfinite(array)):
                run = int(np.argmin(np.isfinite(array).reshape(n, -1).all(axis=1)))
                raise ConfigError(f"{m.name}: {key} of run {run} holds numbers that are not finite")
        return start, rate, held, applied

    def _addresses(self, names: Sequence[str]) -> tuple[list[int], list[int]]:
        joints = [self.mujoco_model.joint(name) for name in names]
        return [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]

    def _closed(self, q: Array, v: Array) -> tuple[Array, Array]:
        """(n, nq) and (n, nv): all of the model's coordinates and rates for those of the skeleton.

        Positions in the plane are complex numbers x + iy, so a turn is a factor.
        """
        m, n = self.morphologies[0], len(q)
        parents, spans, foot = structure(m)
        joints, actuators = _split(m, self._parameters)
        qpos, qvel = np.zeros((n, self.mujoco_model.nq)), np.zeros((n, self.mujoco_model.nv))

        def put(names: Sequence[str], position: Sequence[Array], speed: Sequence[Array]) -> None:
            at, dof = self._addresses(names)
            qpos[:, at], qvel[:, dof] = np.stack(position, axis=1), np.stack(speed, axis=1)

        still, one = np.zeros(n, dtype=np.complex128), np.ones(n, dtype=np.complex128)
        # Of the body of each joint and, at the end (index −1), of the base: origin, its velocity, axis, turning rate.
        bodies: list[tuple[Complex, Complex, Complex, Array]] = [(still, still, one, np.zeros(n))]

        def point(body: int, local: Complex) -> tuple[Complex, Complex]:
            origin, velocity, axis, turning = bodies[body]
            return origin + local * axis, velocity + 1j * turning * local * axis

        for i, parent in enumerate(parents):
            _, _, axis, turning = bodies[parent]
            here = point(parent, _polar(joints[:, i, 0], joints[:, i, 1]))
            bodies.insert(-1, (*here, axis * np.exp(1j * q[:, i]), turning + v[:, i]))
        put(m.joint_names, list(q.T), list(v.T))
        if self.phase == "stance":
            at, velocity = point(foot, joints[:, foot, 9].astype(np.complex128))
            put([f"{BASE}/x", f"{BASE}/y"], [-at.real, -at.imag], [-velocity.real, -velocity.imag])
        for a, (origin, insertion) in enumerate(spans):
            start, start_velocity = point(origin, _polar(actuators[:, a, 0], actuators[:, a, 1]))
            end, end_velocity = point(insertion, _polar(actuators[:, a, 2], actuators[:, a, 3]))
            reach = end - start
            length = np.abs(reach)
            name = m.actuators[a].name
            if np.any(length < 1e-9):
                raise ModelError(
                    f"run {int(np.argmin(length))}: actuator {name!r} has no length at the start, so its direction is "
                    "undefined"
                )
            rate = (end_velocity - start_velocity) * reach.conj() / length  # lengthening + i·(length × turning)
            _, _, axis, turning = bodies[origin]
            put(
                [f"{name}/hinge", f"{name}/middle", f"{name}/lower"],
                [np.angle(reach * axis.conj()), length / 2, length / 2],
                [rate.imag / length - turning, rate.real / 2, rate.real / 2],
            )
        return qpos, qvel

    def _batch_of(self, n: int) -> mjbatch.Batch:
        if self._batch is None or self._batch.nsim != n:
            self._batch = mjbatch.Batch(self.mujoco_model, n, min(self.threads, n))
            if self._of_parameters:
                self._fill(self._batch)
        return self._batch

    def _fill(self, runs: mjbatch.Batch) -> None:
        """Give each run the fields that ``compile_model`` makes of its parameters."""
        m, model, parameters = self.morphologies[0], self.mujoco_model, self._parameters
        joints, actuators = _split(m, parameters)
        gravity, tilt = parameters[:, 0], parameters[:, 1]
        field = runs.expand
        limits = [bool(model.jnt_limited[model.joint(joint.name).id]) for joint in m.joints]
        field("opt.gravity")[:] = np.stack([-gravity * np.sin(tilt), 0 * tilt, -gravity * np.cos(tilt)], axis=1)
        if self.phase == "stance":
            field("body_mass")[:, model.body(BASE).id] = np.maximum(parameters[:, 2], 1e-6)
        for i, joint in enumerate(m.joints):
            body, index = model.body(joint.child).id, model.joint(joint.name).id
            field("body_pos")[:, body] = _spatial(joints[:, i, 0], joints[:, i, 1])
            field("body_mass")[:, body] = joints[:, i, 10]
            field("body_ipos")[:, body, 0] = joints[:, i, 11]
            field("body_inertia")[:, body] = np.maximum(joints[:, i, 12], POINT_INERTIA)[:, None]
            field("dof_damping")[:, model.jnt_dofadr[index]] = joints[:, i, 2]
            lower, upper = np.clip(joints[:, i, [3, 6]], -ABSENT_STOP, ABSENT_STOP).T
            if limits[i]:
                field("jnt_range")[:, index, 0] = lower
                field("tendon_range")[:, model.tendon(stop_tendon(joint.name)).id, 1] = upper
            if joint.child == m.foot:
                field("site_pos")[:, model.site("foot").id, 0] = joints[:, i, 9]
        for a, actuator in enumerate(m.actuators):
            name, (mass, stiffness, damping, rest, area) = actuator.name, actuators[:, a, 4:].T
            origin = _spatial(actuators[:, a, 0], actuators[:, a, 1])
            field("body_pos")[:, model.body(f"{name}/upper").id] = origin
            field("site_pos")[:, model.site(f"{name}/origin").id] = origin
            insertion = _spatial(actuators[:, a, 2], actuators[:, a, 3])
            field("site_pos")[:, model.site(f"{name}/insertion").id] = insertion
            for part, share in (("upper", 1 / 6), ("middle", 2 / 3), ("lower", 1 / 6)):
                field("body_mass")[:, model.body(f"{name}/{part}").id] = mass * share
            for half in ("middle", "lower"):
                slide = model.joint(f"{name}/{half}")
                field("jnt_stiffness")[:, slide.id] = 2 * stiffness
                field("dof_damping")[:, slide.dofadr[0]] = 2 * damping
                field("qpos_spring")[:, slide.qposadr[0]] = rest / 2
            field("actuator_gainprm")[:, model.actuator(name).id, 0] = area
            field("tendon_lengthspring")[:, model.tendon(f"{name}/length").id] = rest[:, None]
            ranges = [(other.command_low, other.command_high) for other in self.morphologies]
            field("actuator_ctrlrange")[:, model.actuator(name).id] = ranges
        dof_inverse, body_inverse = field("dof_invweight0"), field("body_invweight0")
        tendon_inverse = field("tendon_invweight0")
        runs.set_const()
        for i, joint in enumerate(m.joints):
            if limits[i]:
                index, tendon = model.joint(joint.name).id, model.tendon(stop_tendon(joint.name)).id
                dof = model.jnt_dofadr[index]
                field("jnt_solref")[:, index] = -joints[:, i, [4, 5]] * dof_inverse[:, dof, None]
                field("tendon_solref_lim")[:, tendon] = -joints[:, i, [7, 8]] * tendon_inverse[:, tendon, None]
        if self.settings.softness != 1.0:
            body_inverse *= self.settings.softness
            dof_inverse[:, element_slides(model)] *= self.settings.softness


def near_stop(morphologies: Sequence[Morphology], q: Array, v: Array, dt: float) -> NDArray[np.bool_]:
    """Which runs come so near a stop that they may touch it, whether or not the step follows its force.

    Args:
        morphologies: of all runs, or one for each.
        q: (n, m, nj) [rad]; NaN is near nothing.
        v: (n, m, nj) [rad/s].
        dt: from one row to the next [s].

    Returns:
        (n,) whether any joint is less than ``NEAR_STOP`` + |v|·dt from a stop, or beyond it.
    """
    ranges = np.array([m.joint_range for m in morphologies])[:, :, None]  # (1 or n, 2, 1, nj)
    if not np.isfinite(ranges).any():
        return np.zeros(len(q), dtype=bool)
    reach = NEAR_STOP + np.abs(v) * dt
    return np.asarray(((q < ranges[:, 0] + reach) | (q > ranges[:, 1] - reach)).any(axis=(1, 2)))


def stop_divisor(morphology: Morphology, phase: Phase, pose: Array, dt: float) -> int:
    """By which whole number a step dt [s] is to be divided to follow the forces of a robot's stops.

    It is the least that brings the fastest rate λ with stops pressed, at the pose and at the joints' ends
    (``engines.steps.rates_at``), to |λ|·dt ≤ ``FOLLOWED``; ``MOST_FINER`` at most, with a warning where
    the method is unstable even so.

    Args:
        morphology: the robot.
        phase: base fixed or foot pinned.
        pose: (nj,) where it starts [rad].
        dt: [s].
    """
    rate = max(rates_at(morphology, phase, [pose])) * dt
    if rate / MOST_FINER > STABLE:
        warnings.warn(
            f"{morphology.name}: a joint stop is too stiff even for a physics step of {dt / MOST_FINER * 1e3:.2g} ms; "
            f"expected at most {FOLLOWED / rate * dt * 1e3:.2g} ms",
            stacklevel=3,
        )
    return math.ceil(min(max(rate / FOLLOWED, 1.0), MOST_FINER))


def _split(m: Morphology, parameters: Array) -> tuple[Array, Array]:
    """(n, nj, JOINT_PARAMETERS) and (n, na, ACTUATOR_PARAMETERS) of packed morphologies (n, ·)."""
    end = FIRST_JOINT + JOINT_PARAMETERS * len(m.joints)
    joints = parameters[:, FIRST_JOINT:end].reshape(len(parameters), len(m.joints), JOINT_PARAMETERS)
    return joints, parameters[:, end:].reshape(len(parameters), len(m.actuators), ACTUATOR_PARAMETERS)


def _polar(radius: Array, angle: Array) -> Complex:
    return np.asarray(radius * np.exp(1j * angle), dtype=np.complex128)


def _spatial(radius: Array, angle: Array) -> Array:
    """(n, 3) points of the plane in MuJoCo's coordinates."""
    return np.stack([radius * np.cos(angle), 0 * radius, -radius * np.sin(angle)], axis=1)


def _form(m: Morphology) -> tuple[object, ...]:
    """All that shapes a morphology's model but its parameters."""
    return structure(m), tuple((j.name, j.child) for j in m.joints), m.actuator_names


def _massless(m: Morphology, parameters: Array) -> NDArray[np.bool_]:
    """(n,) which have an actuator without mass, which MuJoCo cannot simulate."""
    return np.asarray(np.any(_split(m, parameters)[1][:, :, 4] <= 0, axis=1))


def _generic(morphologies: Sequence[Morphology]) -> Morphology:
    """The first with nothing at zero of which MuJoCo's compiler would take advantage for good, and with all stops.

    Both stops, and unlike, stand at every joint where any morphology has one, so that a run does not depend on the
    stops of those beside it.
    """
    first = morphologies[0]
    stopped = [any(m.joints[i].lower or m.joints[i].upper for m in morphologies) for i in range(len(first.joints))]
    lower, upper = JointStop(-ABSENT_STOP, 1.0), JointStop(ABSENT_STOP, 2.0)
    joints = [
        replace(joint, lower=lower, upper=upper) if has else joint
        for joint, has in zip(first.joints, stopped, strict=True)
    ]
    m = replace(first, joints=tuple(joints))
    moved = {key: 0.0123 for key, value in m.parameters().items() if value == 0 and key.endswith((".radius", ".com"))}
    return m.with_parameters(moved)
