"""How measured angles respond to small unmodelled torques, to first order along the model's motion.

With δx = (δq, δv, δz) about the motion and a small joint torque τ,

    d/dt δx = A(t) δx + B(t) τ,    δy(t) = scale · δq(t − delay)

A and B are those of the midpoint of each interval between samples. The torque is constant over an interval, and the
solution is a matrix exponential, so that stiff joint stops do no harm. Whether a stop is pressed follows from the
motion. In the interval where it is hit, its damper's force steps from 0 to c·|v| at the stop's angle; it counts as the
spring that gives the same impulse, c·δq. Play in a sensor is neglected.

Dry friction φ = −b sign(w) at a place with rate w, bound b and inverse inertia d along the place (the diagonal of the
Delassus matrix) responds by δφ = −k δw,

    slip:      k = 0
    reversal:  k = min(b Δsign(w)/Δw, LOCK/d),  the secant through the interval's ends
    stick:     k = LOCK/d,  so that δw dies away at the rate LOCK: the place is nearly locked
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.sensors import SCALE, SENSOR_DELAY
from equimus_ctrl.engines.drive_forces import drive_slopes
from equimus_ctrl.engines.encoding import Encoded
from equimus_ctrl.engines.field import Field, States
from equimus_ctrl.engines.motion import Inner, Motion, hermite_arrays
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.augmented import rubbing_places, slots_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

STILL = 1e-6
"""Rate [rad/s or m/s] up to which a place with dry friction sticks."""
LOCK = 1e6
"""Rate at which the motion of a place that sticks dies away [1/s]."""
SPEED = 30.0
"""A velocity about as large as a position of 1 rad or 1 m in the motions of legs [rad/s or m/s]; scaling by it costs
other robots at most accuracy."""
SMALL = 1e-6
"""Step of the finite difference of a limit's depth [rad or m]."""
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
        joints: (nj,) which of the nv coordinates of the equations each joint's is.
        coordinates: how many there are, nv.
    """

    motions: tuple[Motion, ...]
    transitions: tuple[Array, ...]
    scale: Array
    delay: Array
    joints: NDArray[np.int64]
    coordinates: int

    def response(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m, nj, k) the change of the measured positions for small forces at the joints [rad or m].

        Args:
            torques: for each trial (m − 1, nj, k), constant over each interval between samples, or (m, nj, k) at the
                samples and linear between [N·m].

        Raises:
            ConfigError: where their shapes are not these.
        """
        paths = [self._path(i, torque, bool(self.delay.any())) for i, torque in enumerate(self._between(torques))]
        if self.delay.any():
            paths = [self._sensor_delayed(m.time, path) for m, path in zip(self.motions, paths, strict=True)]
        return [path * self.scale[:, None] for path in paths]

    def inner_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, 2 nj, k) of the true positions and rates."""
        return [self._path(i, torque, True) for i, torque in enumerate(self._between(torques))]

    def drive_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, na, k) of the forces of each command's actuator; states of its own are held."""
        found = []
        for i, torque in enumerate(self._between(torques)):
            motion, coordinates = self.motions[i], np.arange(2 * self.coordinates)
            assert motion.coded is not None  # it was linearised
            along = np.column_stack([motion.coordinates, motion.rates, motion.state])
            slopes = drive_slopes(motion.coded, 0, along, motion.pressure)
            changes = _propagated(self.transitions[i], np.ascontiguousarray(torque), coordinates)
            found.append(slopes @ changes)
        return found

    def _between(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m − 1, nj, k), constant over each interval."""
        if len(torques) != len(self.motions):
            raise ConfigError(f"torques are for {len(torques)} trials, expected {len(self.motions)}")
        nj, answers = len(self.scale), []
        for motion, torque in zip(self.motions, torques, strict=True):
            n = len(motion.time) - 1
            if torque.ndim != 3 or torque.shape[1] != nj or len(torque) not in (n, n + 1):
                raise ConfigError(
                    f"{motion.name}: torques have shape {torque.shape}, expected ({n}, {nj}, k) or ({n + 1}, {nj}, k)"
                )
            answers.append(torque if len(torque) == n else (torque[1:] + torque[:-1]) / 2)
        return answers

    def _path(self, trial: int, torque: Array, rates: bool) -> Array:
        """(m, nj, k) true positions under torques (m − 1, nj, k), or (m, 2 nj, k) these and their rates."""
        transition = self.transitions[trial]
        shown = np.concatenate([self.joints, self.coordinates + self.joints]) if rates else self.joints
        return _propagated(transition, np.ascontiguousarray(torque), shown)

    def _sensor_delayed(self, time: Array, path: Array) -> Array:
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


@njit(cache=True, nogil=True, error_model="numpy")
def _propagated(transition: Array, torque: Array, shown: NDArray[np.int64]) -> Array:
    """(m, len(shown), k) of the states x, from rest: x ← T (x, τ) over each interval.

    Args:
        transition: (m − 1, nx, nx + nj) T.
        torque: (m − 1, nj, k) τ.
        shown: which states.
    """
    n, nx, width = transition.shape
    k = torque.shape[2]
    path = np.zeros((n + 1, len(shown), k))
    given, reached = np.zeros((width, k)), np.zeros((nx, k))
    for i in range(n):
        given[:nx] = reached
        given[nx:] = torque[i]
        for row in range(nx):
            out = reached[row]
            out[:] = transition[i, row, 0] * given[0]
            for column in range(1, width):
                share, of = transition[i, row, column], given[column]
                for c in range(k):
                    out[c] += share * of[c]
        for place in range(len(shown)):
            path[i + 1, place] = reached[shown[place]]
    return path


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
    transitions = []
    for motion in motions:
        if motion.coded is None:
            raise ConfigError(f"{motion.name}: there are no compiled equations of motion to linearise")
        a, b = _intervals(motion, motion.coded)
        nv, nj = motion.coordinates.shape[1], b.shape[2]
        kept = _kept(motion.coded, nv)
        nx = len(kept)
        system = np.zeros((len(a), nx + nj, nx + nj))
        system[:, :nx, :nx] = a[:, kept][:, :, kept]
        system[:, :nx, nx:] = b[:, kept]
        system *= np.diff(motion.time)[:, None, None]
        transitions.append(exponentials(system, nv, 2 * nv)[:, :nx].copy())
    first = motions[0].coded
    assert first is not None
    sensor, joints = first.sensor[0], first.mechanics[0].joints
    return Linearised(
        tuple(motions), tuple(transitions), sensor[:, SCALE].copy(), sensor[:, SENSOR_DELAY].copy(), joints,
        motions[0].coordinates.shape[1],
    )  # fmt: skip


def _kept(coded: Encoded, nv: int) -> list[int]:
    """Of all states those of motion, and of the laws that the model has."""
    model, places = coded.models[0], coded.mechanics[0].law_places
    present = {(type(e), e.location) for e in model.effects}
    kept, state = list(range(2 * nv)), 2 * nv
    for slot in slots_of(coded.form, coded.laws):
        of_law = range(state, state + slot.law.n_states)
        kept += of_law if (slot.law, places[slot.kind][slot.index]) in present else []
        state += slot.law.n_states
    return kept


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
    exponential = eye + scaled / TERMS
    for term in range(TERMS - 1, 0, -1):
        exponential = eye + scaled @ exponential / term
    for done in range(int(halvings.max(initial=0))):
        halved = halvings > done
        exponential[halved] = exponential[halved] @ exponential[halved]
    return np.asarray(exponential * (unit[:, None] / unit))


def _intervals(motion: Motion, coded: Encoded) -> tuple[Array, Array]:
    """A (n, nx, nx) and B (n, nx, nj) of each interval, the states of all laws included."""
    field, lasts = Field.of(coded), np.diff(motion.time)
    between, n = motion.between, len(lasts)
    middle = _states(field, between)
    depths, pressed = field.limits(middle)
    beyond = field.limits(_states(field, motion))[0] > 0
    hit = beyond[1:] & ~beyond[:-1]
    free = States(middle.q, middle.v, middle.z, middle.pressure, pressed * ~hit, middle.side)
    rates, rates_at_ends = field.rub(free).rate, field.rub(_states(field, motion)).rate
    signs = np.where(np.abs(rates_at_ends) > STILL, np.sign(rates_at_ends), 0.0)
    reversal, used = np.diff(signs, axis=0), np.zeros(rates.shape[1], dtype=bool)
    used[coded.rubbing] = True
    sliding = np.where((np.abs(rates) > STILL) & used, np.sign(rates), 0.0)
    secant = np.divide(reversal, np.diff(rates_at_ends, axis=0), out=np.zeros_like(rates), where=(reversal != 0) & used)
    stuck = (np.abs(rates) <= STILL) & (reversal == 0) & used
    states = States(middle.q, middle.v, middle.z, middle.pressure, np.maximum(pressed, hit), sliding)
    slopes, friction = field.slopes(states), field.rub(states)
    nv = middle.q.shape[1]
    if used.any():
        inverse_inertia = np.maximum(np.diagonal(friction.delassus, axis1=1, axis2=2), 1e-12)
        rate_of_decay = stuck * (friction.bound > 0) * LOCK + secant * friction.bound * inverse_inertia
        damping = np.minimum(rate_of_decay, LOCK) / inverse_inertia
        slopes[:, :nv, nv : 2 * nv] -= (friction.per_impulse * damping[:, None]) @ field.rows(states)
    for limit in np.flatnonzero(hit.any(axis=0)):
        _count_blow(field, states, depths[:, limit], hit[:, limit], int(limit), lasts, slopes)
    nx = slopes.shape[2]
    a = np.zeros((n, nx, nx))
    a[:, range(nv), range(nv, 2 * nv)] = 1.0
    a[:, nv:] = slopes
    places = rubbing_places(coded.form, coded.laws)
    columns = [places.index(("joint", int(joint))) for joint in coded.mechanics[0].joints]
    b = np.zeros((n, nx, len(columns)))
    b[:, nv : 2 * nv] = friction.per_impulse[:, :, columns]
    return a, b


def _states(field: Field, at: Inner) -> States:
    return field.states(at.coordinates, at.rates, at.state, at.pressure)


def _count_blow(
    field: Field, states: States, depth: Array, hit: NDArray[np.bool_], limit: int, lasts: Array, slopes: Array
) -> None:
    """Count what a limit does at once where it is hit: by δq it is hit earlier by row·δq/(row·v).

    Args:
        field: the equations.
        states: (n) in the middle of the intervals, the limit pressed where it is hit.
        depth: (n,) how far beyond the limit they are.
        hit: (n,) where it is hit.
        limit: which.
        lasts: (n,) of the intervals [s].
        slopes: (n, …) derivatives, changed.
    """
    k = np.flatnonzero(hit)
    q = states.q[k]
    row = np.empty_like(q)
    for j in range(q.shape[1]):
        moved = [q.copy(), q.copy()]
        moved[0][:, j] += SMALL
        moved[1][:, j] -= SMALL
        ends = [field.limits(field.states(m, states.v[k]))[0][:, limit] for m in moved]
        row[:, j] = -(ends[0] - ends[1]) / (2 * SMALL)
    # At that instant the limit is not yet pressed in: its force is that of its damper alone.
    q = q + row * (depth[k] / (row**2).sum(axis=1))[:, None]
    pressed = states.pressed[k].copy()
    exerted = field.at(States(q, states.v[k], states.z[k], states.pressure[k], pressed, states.side[k]))
    pressed[:, limit] = 0.0
    before = field.at(States(q, states.v[k], states.z[k], states.pressure[k], pressed, states.side[k]))
    rate = (row * states.v[k]).sum(axis=1)
    usable = rate < 0
    nv = q.shape[1]
    jump = (exerted - before)[:, :nv]
    blow = np.zeros((len(k), nv, nv))
    np.divide(jump[:, :, None] * row[:, None], (rate * lasts[k])[:, None, None], out=blow, where=usable[:, None, None])
    slopes[k, :nv, :nv] += blow
