"""How measured angles answer to small torques that a model does not have, to first order along its motion.

With δx = (δq, δv, δz) about the motion and a small joint torque τ,

    d/dt δx = A(t) δx + B(t) τ,    δy(t) = scale · δq(t − delay)

A and B are those of the middle of each interval between samples, where the torque is constant; over the interval the
solution is a matrix exponential, so that stiff joint stops do no harm. A stop is pressed or not as the motion says; in
the interval where it is hit, its damper's push, which jumps from nothing to c·|v| at the stop's angle, counts as the
spring that gives the same impulse, c·δq. Dry friction of a sliding place is constant; over an interval with a turn the
slope of its sign is the secant through the interval's ends; a place that sticks is all but locked by damping. Play in a
sensor is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.force import force_laws
from equimus_ctrl.effects.sensors import LATE, SCALE
from equimus_ctrl.engines.batch import encode
from equimus_ctrl.engines.motion import Motion, hermite_arrays
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.augmented import Laws, augmented_model
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.morphology import Phase, structure
from equimus_ctrl.models.symbolic import Structure, build, joint_stops, ldl_solve
from equimus_ctrl.types import Array

STILL = 1e-6
"""Rate [rad/s or m/s] up to which a place with dry friction sticks."""
LOCK = 1e6
"""Rate at which the motion of a place that sticks dies away [1/s]."""
SPEED = 30.0
"""A velocity about as large as an angle of 1 rad in the motions of legs [rad/s]."""
LARGEST, TERMS = 0.5, 10
"""Largest row sum of a matrix for the series, and its terms: the rest is below 1e-11."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """A model linearised along its motions through some trials.

    Attributes:
        motions: along which.
        transitions: for each trial (m − 1, nx, nx + nj), from (δx, τ) at the start of an interval to δx at its end.
        scale: (nj,) of the sensors.
        delay: (nj,) of the sensors [s].
    """

    motions: tuple[Motion, ...]
    transitions: tuple[Array, ...]
    scale: Array
    delay: Array

    def response(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m, nj, k) the change of the measured angles for small torques [rad].

        Args:
            torques: for each trial (m − 1, nj, k), constant over each interval between samples, or (m, nj, k) at the
                samples and linear between [N·m].

        Raises:
            ConfigError: where their shapes are not these.
        """
        if len(torques) != len(self.motions):
            raise ConfigError(f"torques are for {len(torques)} trials, expected {len(self.motions)}")
        nj, found = len(self.scale), []
        for i, (motion, torque) in enumerate(zip(self.motions, torques, strict=True)):
            n = len(motion.time) - 1
            if torque.ndim != 3 or torque.shape[1] != nj or len(torque) not in (n, n + 1):
                raise ConfigError(
                    f"{motion.name}: torques have shape {torque.shape}, expected ({n}, {nj}, k) or ({n + 1}, {nj}, k)"
                )
            found.append(self._path(i, torque if len(torque) == n else (torque[1:] + torque[:-1]) / 2))
        return found

    def _path(self, trial: int, torque: Array) -> Array:
        """(m, nj, k) under torques (m − 1, nj, k)."""
        transition, late = self.transitions[trial], bool(self.delay.any())
        nj, nx, k = len(self.scale), transition.shape[1], torque.shape[2]
        shown = 2 * nj if late else nj
        path = np.empty((len(transition) + 1, shown, k))
        path[0] = 0.0
        given, reached = np.empty((nx + nj, k)), np.zeros((nx, k))
        for step, push, out in zip(transition, torque, path[1:], strict=True):
            given[:nx], given[nx:] = reached, push
            np.matmul(step, given, out=reached)
            out[:] = reached[:shown]
        if late:
            path = self._late(self.motions[trial].time, path)
        path *= self.scale[:, None]
        return path

    def _late(self, time: Array, path: Array) -> Array:
        """(m, nj, k) angles as old as the sensors show them, of a path (m, 2 nj, k) of angles and velocities."""
        nj = len(self.scale)
        seen = np.empty((len(path), nj, path.shape[2]))
        for j, delay in enumerate(self.delay):
            at = np.maximum(time - delay, time[0])
            i = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
            step = (time[i + 1] - time[i])[:, None]
            q, v = path[:, j], path[:, nj + j]
            seen[:, j] = hermite_arrays(q[i], v[i], q[i + 1], v[i + 1], step, (at - time[i])[:, None] / step)
        return seen


def response(model: Model, motion: Motion, torque: Array) -> Array:
    """(m, nj, k) the change of the measured angles for small torques in one trial, see ``Linearised.response``."""
    return linearise(model, [motion]).response([torque])[0]


def along_actuator(motion: Motion, actuator: int, force: Array) -> Array:
    """(n, nj, k) joint torques [N·m] of forces (n, k) along an actuator [N]: Jᵀf.

    Args:
        motion: whose moment arms.
        actuator: which.
        force: m rows at the samples, or m − 1 constant between them.

    Raises:
        ConfigError: for any other number of rows.
    """
    rows = {len(part.time): part.arm[:, actuator] for part in (motion, motion.between)}
    if len(force) not in rows:
        raise ConfigError(f"{motion.name}: forces have {len(force)} rows, expected {' or '.join(map(str, rows))}")
    return np.asarray(rows[len(force)][:, :, None] * force[:, None, :])


def linearise(model: Model, motions: Sequence[Motion]) -> Linearised:
    """A model's equations of motion linearised along its motions.

    Args:
        model: what moves.
        motions: of this model.

    Raises:
        ConfigError: where there is none.
    """
    if not motions:
        raise ConfigError(f"{model.name}: no motion was given to linearise along")
    coded = encode([model])
    form, laws = structure(model.morphology), force_laws()
    pieces = [_intervals(model, motion, coded.parameters[0], coded.rubbing) for motion in motions]
    m = augmented_model(form, model.phase, laws)
    names = {"joint": model.morphology.joint_names, "actuator": model.morphology.actuator_names}
    present = {(type(e), e.location) for e in model.effects}
    nj = len(names["joint"])
    state = 0
    kept = list(range(2 * nj))
    for slot in m.slots:
        own = range(2 * nj + state, 2 * nj + state + slot.law.n_states)
        kept += own if (slot.law, names[slot.kind][slot.index]) in present else []
        state += slot.law.n_states
    nx = len(kept)
    transitions = []
    for motion, (a, b) in zip(motions, pieces, strict=True):
        system = np.zeros((len(a), nx + nj, nx + nj))
        system[:, :nx, :nx] = a[:, kept][:, :, kept]
        system[:, :nx, nx:] = b[:, kept]
        system *= np.diff(motion.time)[:, None, None]
        transitions.append(exponentials(system, nj, 2 * nj)[:, :nx].copy())
    sensor = coded.sensor[0]
    return Linearised(tuple(motions), tuple(transitions), sensor[:, SCALE].copy(), sensor[:, LATE].copy())


def exponentials(matrices: Array, first: int, last: int) -> Array:
    """(n, s, s) exponentials of matrices, by Taylor's series of halved matrices, squared again.

    A hundred times as fast as one by one. Rows ``first`` to ``last`` are counted in units of SPEED meanwhile, for
    angles and velocities differ in size, and more halvings cost accuracy.
    """
    unit = np.ones(matrices.shape[1])
    unit[first:last] = SPEED
    scaled = matrices * (unit / unit[:, None])
    size = np.abs(scaled).sum(axis=2).max(axis=1)
    halvings = np.maximum(np.ceil(np.log2(np.maximum(size, 1e-300) / LARGEST)), 0).astype(int)
    scaled /= np.exp2(halvings)[:, None, None]
    eye = np.eye(len(unit))
    found = eye + scaled / TERMS
    for term in range(TERMS - 1, 0, -1):
        found = eye + scaled @ found / term
    for done in range(int(halvings.max(initial=0))):
        left = halvings > done
        found[left] = found[left] @ found[left]
    return np.asarray(found * (unit[:, None] / unit))


def _intervals(model: Model, motion: Motion, parameters: Array, rubbing: NDArray[np.int64]) -> tuple[Array, Array]:
    """A (n, nx, nx) and B (n, nx, nj) of each interval, the states of all laws included."""
    form, laws = structure(model.morphology), force_laws()
    m = augmented_model(form, model.phase, laws)
    at, n = motion.between, len(motion.between.time)
    side, slope, stuck = (np.zeros((n, len(m.rubbing))) for _ in range(3))
    for r in rubbing:
        kind, i = m.rubbing[r]
        here, ends = ((part.velocity if kind == "joint" else part.rate)[:, i] for part in (at, motion))
        signs = np.where(np.abs(ends) > STILL, np.sign(ends), 0.0)
        change = np.diff(signs)
        side[:, r] = np.where(np.abs(here) > STILL, np.sign(here), 0.0)
        slope[:, r] = np.divide(change, np.diff(ends), out=np.zeros(n), where=change != 0)
        stuck[:, r] = (np.abs(here) <= STILL) & (change == 0)
    robot = changed_bodies(model.effects, model.morphology)
    low, high = robot.joint_range
    outside = np.stack([motion.position < low, motion.position > high], axis=2).reshape(n + 1, -1)
    hit = (outside[1:] & ~outside[:-1]) / np.diff(motion.time)[:, None]
    found = _slopes(form, model.phase, laws)(
        at.position.T, at.velocity.T, at.state.T, at.pressure.T, side.T, slope.T, stuck.T, hit.T, parameters
    )
    nj = at.position.shape[1]
    rows, inverse = (np.array(part) for part in found)
    nx = rows.shape[1] // n
    a = np.zeros((n, nx, nx))
    a[:, range(nj), range(nj, 2 * nj)] = 1.0
    a[:, nj:] = rows.reshape(nx - nj, n, nx).transpose(1, 0, 2)
    b = np.zeros((n, nx, nj))
    b[:, nj : 2 * nj] = inverse.reshape(nj, n, nj).transpose(1, 0, 2)
    return a, b


@lru_cache(maxsize=32)
def _slopes(form: Structure, phase: Phase, laws: Laws) -> ca.Function:
    """Derivatives of acceleration and effect states by (q, v, z), and the inverse of the mass matrix.

    Arguments are q, v, z, pressure, then for each row of dry friction the sign of its rate, by how much that sign
    changes for each change of the rate, and 1 where it sticks; then for each joint's lower and upper stop 1/(length of
    the interval) where it is hit, else 0; then the parameters.
    """
    m, base = augmented_model(form, phase, laws), build(form, phase)
    nr = m.phi.numel()
    side, slope, stuck = (ca.SX.sym(name, nr) for name in ("side", "slope", "stuck"))
    x = ca.vertcat(m.q, m.v, m.z)
    bound = ca.substitute(m.bound, m.v0, m.v)
    motion = ca.substitute(ca.vertcat(m.smooth_acceleration, m.z_rate), m.phi, -side * bound)
    rows = ca.jacobian(motion, x)
    by_v = ca.jacobian(m.rows, m.v)
    nj = m.q.numel()
    own = ca.fmax(ca.diag(m.delassus), 1e-12)
    lock = ca.fmin(stuck * (bound > 0) * LOCK + slope * bound * own, LOCK) / own
    brake = -m.push @ ca.diag(lock) @ by_v
    rows[:nj, nj : 2 * nj] += brake
    hit = ca.SX.sym("hit", 2 * nj)
    stops = [joint_stops(m.p, i) for i in range(nj)]
    blow = ca.vertcat(*[hit[2 * i] * stop[2] + hit[2 * i + 1] * stop[5] for i, stop in enumerate(stops)])
    inverse = ca.horzcat(*[ldl_solve(base.mass, ca.SX.eye(nj)[:, j]) for j in range(nj)])
    inverse = ca.substitute(inverse, base.p, m.p[: base.p.numel()])
    rows[:nj, :nj] -= inverse @ ca.diag(blow)
    rows = ca.substitute(rows, m.pressed, ca.fmax(m.gaps > 0, hit > 0))
    inputs = [m.q, m.v, m.z, m.pressure, side, slope, stuck, hit, m.p]
    return ca.Function("slopes", inputs, [ca.densify(rows), ca.densify(inverse)], {"cse": True})
