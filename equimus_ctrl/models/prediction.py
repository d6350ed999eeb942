"""One step of a model with its valves, in CasADi: what observers and predictive controllers compute with.

    x = (q, v, P, z),    M(q) a + h(q, v) = Jᵀ(A(l) P + F(l, l̇, z)) + T(q, v, z) − Gᵀ b tanh(G v / s) + d,    dz/dt = g

d is a torque on each joint that the model does not know. Of a robot whose commands are no pressures, P are the commands
as they arrive at its drives. Angles, velocities and the states z of drives and effects take one Runge–Kutta step of
order four; where a structure may be stiff (servos, dry friction, ends of ranges), one step of ROS2 (Verwer, Spee, Blom
and Hundsdorfer, SIAM J. Sci. Comput. 20, 1999), of order two and stable however long it is. Pressures follow what
reaches their valves, u, over the step in closed form: exact for a lag, and for a limited rate. Dry friction is
smoothed, for it is to have derivatives; what sticks in fact creeps here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import FILL, FLOW, POWER, RATE, REFERENCE, VENT
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters, sliding_friction
from equimus_ctrl.models.dynamics import Dynamics, computable
from equimus_ctrl.models.linear import fastest_rates
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.models.spread import latin_hypercube
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import eliminate, ldl_solve
from equimus_ctrl.robots.elastic.morphology import Phase, elastic_of
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

UNLIMITED = 1e9
"""A rate [Pa/s] that is none: no infinity enters a product."""
SMALL = 1e-9
"""Time constant that is none [s]."""
LEAST = 1.0
"""Commands below count as this where their power is taken [Pa]: it would have no slope at 0."""
GAMMA = 1 - 2**-0.5
"""γ of ROS2 with which it forgets what is infinitely fast."""
FOLLOWED = 2.0
"""Fastest rate times step that a Runge–Kutta step is given; it would be stable to 2.78. Spans are divided."""
FOLLOWS = 0.05
"""Share of its size by which a mode may be off after a control period or an interval of a plan."""
MOST_STEPS = 50
"""Into which either is divided, at most."""
POSES = 12
"""In which modes are looked at, beside the middle of the joints' ranges."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A model's step.

    Attributes:
        model: whose.
        nj: joints.
        na: commands.
        nx: states: 2 nj of the joints, na pressures, then those of drives and effects.
        valve: (na, 6), see ``effects.command.advance_pressure``; the delays take no part in a step.
        sensor: (nj, 4), see ``effects.sensors``.
        step: (x, u, d, h) → x after h.
        slopes: (x, u, d, h) → x after h and its derivatives by x, u and d.
        rest: q → z after a long rest.
    """

    model: Model
    nj: int
    na: int
    nx: int
    valve: Array
    sensor: Array
    step: ca.Function
    slopes: ca.Function
    rest: ca.Function

    def at_rest(self, q: Array, pressure: Array) -> Array:
        """(nx,) a robot that has long been at q (nj,) [rad] under pressures (na,) [Pa]."""
        return np.concatenate([q, np.zeros(self.nj), pressure, np.array(self.rest(q)).ravel()])


@lru_cache(maxsize=64)
def prediction(model: Model, stops: bool = True) -> Prediction:
    """The step of a model.

    Args:
        model: its effects on valves, bodies and sensors and its force effects are its own.
        stops: whether joints press on their stops; without them they turn freely, and a long step stays stable.

    Raises:
        NotAvailable: where no equations hold the robot, or it has joints that are not measured.
    """
    robot, effects, laws = computable(model), model.effects, laws_of(model.effects)
    mechanics = robot.mechanics()
    form = mechanics.form
    slots = augmented_model(form, model.phase, laws).slots
    own = law_parameters(slots, effects, mechanics.law_places["joint"], mechanics.law_places["actuator"])
    valve = valves_of(model)
    parameters = ca.DM([*mechanics.parameters, *own])
    whole, sloped, rest = _step(form, model.phase, laws, stops)
    nj, na, nx = len(robot.joint_names), len(valve), whole.size1_in(0)
    x, u, d, h = ca.SX.sym("x", nx), ca.SX.sym("u", na), ca.SX.sym("d", nj), ca.SX.sym("h")
    # The equations have the joints in an order of their own.
    order, back = np.argsort(mechanics.joints).tolist(), mechanics.joints.tolist()
    inwards = [*order, *(nj + k for k in order), *range(2 * nj, nx)]
    outwards = [*back, *(nj + k for k in back), *range(2 * nj, nx)]
    given = (x[inwards], u, d[order], h, parameters, ca.DM(np.minimum(valve, UNLIMITED)))
    after, by_x, by_u, by_d = sloped.call([*given])
    found = [after[outwards], by_x[outwards, outwards], by_u[outwards, :], by_d[outwards, back]]
    q = ca.SX.sym("q", nj)
    return Prediction(
        model,
        nj,
        na,
        nx,
        valve,
        sensor_settings(effects, robot.joint_names),
        ca.Function("step", [x, u, d, h], [whole(*given)[outwards]]),
        ca.Function("slopes", [x, u, d, h], ca.cse([ca.densify(value) for value in found])),
        ca.Function("rest", [q], [rest(q[order], parameters)]),
    )


def followed_rates(model: Model) -> tuple[float, float]:
    """Fastest rates [1/s] that explicit steps of a model have to follow, see ``fastest_rates``; 0 where none are."""
    robot = changed_bodies(model.effects, model.robot)
    if robot.mechanics().form.stiff:
        return 0.0, 0.0
    middle = np.clip(robot.joint_range, -np.pi, np.pi).mean(axis=0)
    return fastest_rates(elastic_of(robot), middle, model.phase)


def steps_in(model: Model, span: float) -> int:
    """Into how many implicit steps a span [s] is divided, so that what oscillates is followed; 1 of explicit ones.

    ROS2 is stable however long a step is, but turns a mode λ by R(λ h) in place of exp(λ h). Of modes that oscillate
    about poses at rest, none may be off by more than ``FOLLOWS`` of its size at the end of the span; those that do not
    die away in any case.
    """
    robot = changed_bodies(model.effects, model.robot)
    if not robot.mechanics().form.stiff:
        return 1
    modes = _modes(model)
    modes = span * modes[np.abs(modes.imag) * span > FOLLOWS]
    count = 1
    while count < MOST_STEPS and len(modes):
        part = modes / count
        once = (1 + (1 - 2 * GAMMA) * part) / (1 - GAMMA * part) ** 2
        if np.abs(once**count - np.exp(modes)).max() <= FOLLOWS:
            break
        count += 1
    return count


def parts_in(model: Model, span: float) -> int:
    """Into how many steps a span [s] is divided, explicit or implicit, so that the model is followed and is stable."""
    return max(math.ceil(followed_rates(model)[0] * span / FOLLOWED), steps_in(model, span))


@lru_cache(maxsize=16)
def _modes(model: Model) -> Array:
    """(n,) eigenvalues of the motion about poses at rest across the joints' ranges [1/s]."""
    dynamics = Dynamics(model)
    low, high = np.clip(dynamics.robot.joint_range, -np.pi, np.pi)
    places = np.vstack([np.full(len(low), 0.5), latin_hypercube(POSES, len(low), np.random.default_rng(0))])
    poses = low + places * (high - low)
    return np.concatenate([np.linalg.eigvals(dynamics.linear(pose).matrices()[0]) for pose in poses])


@dataclass(frozen=True, eq=False)
class _Stages:
    """What a step is made of.

    Attributes:
        rates: (q, v, z, P, d, p) → dv/dt and dz/dt, and their derivatives by (q, v, z, P, d).
        first: q, v and z at its begin.
        moves: their derivatives by (x, u, d).
        pressure: P at its begin, middle and end.
        follows: their derivatives alike.
        others: derivatives of d alike.
        d: torques that the model does not know.
        p: parameters.
        h: its duration.
    """

    rates: ca.Function
    first: tuple[ca.SX, ...]
    moves: ca.SX
    pressure: list[ca.SX]
    follows: list[ca.SX]
    others: ca.SX
    d: ca.SX
    p: ca.SX
    h: ca.SX


@lru_cache(maxsize=32)
def _step(form: Structure, phase: Phase, laws: Laws, stops: bool) -> tuple[ca.Function, ca.Function, ca.Function]:
    """(x, u, d, h, p, valves) → x after h; the same with its derivatives by x, u and d; (q, p) → z after a long rest.

    Derivatives are carried along by the chain rule, stage by stage: that takes half the operations of differentiating
    the whole step.
    """
    m, base = augmented_model(form, phase, laws), build(form, phase)
    nj, na, nz = m.q.numel(), m.pressure.numel(), m.z.numel()
    nx = 2 * nj + na + nz
    d = ca.SX.sym("d", nj)
    inside = base.inside.state.numel()
    own = ca.vertcat(base.p, base.inside.state), ca.vertcat(m.p[: base.p.numel()], m.z[:inside, 0])
    mass = ca.substitute(base.mass, *own)
    nothing = ca.vertcat(m.phi, ca.SX(0, 1) if stops else m.pressed)
    free = m.acceleration if stops else m.smooth_acceleration
    free = ca.substitute(free, nothing, ca.SX.zeros(nothing.shape))
    moving = ca.vertcat(free + ldl_solve(mass, d + sliding_friction(m)), m.z_rate)
    by = ca.vertcat(m.q, m.v, m.z, m.pressure, d)
    rates = ca.Function("rates", [m.q, m.v, m.z, m.pressure, d, m.p], [moving, ca.jacobian(moving, by)])
    x, u, h, valves = ca.SX.sym("x", nx), ca.SX.sym("u", na), ca.SX.sym("h"), ca.SX.sym("valves", na, 6)
    pressure, places = x[2 * nj : 2 * nj + na], ca.SX(ca.DM.eye(nx + na + nj))
    later = [ca.vertcat(*[_pressure(pressure[i], u[i], valves[i, :], t * h) for i in range(na)]) for t in (0, 0.5, 1)]
    # Every pressure follows its own command alone.
    follows = []
    for value in later:
        slopes = [ca.diag(ca.vertcat(*[ca.jacobian(value[i], y[i]) for i in range(na)])) for y in (pressure, u)]
        follows.append(slopes[0] @ places[2 * nj : 2 * nj + na, :] + slopes[1] @ places[nx : nx + na, :])
    first = (x[:nj, 0], x[nj : 2 * nj, 0], x[2 * nj + na :, 0])
    moves = ca.vertcat(places[: 2 * nj, :], places[2 * nj + na : nx, :])  # of (q, v, z), by (x, u, d)
    stages = _Stages(rates, first, moves, later, follows, places[nx + na :, :], d, m.p, h)
    (q, v, z), total = (_implicit if form.stiff else _explicit)(stages)
    after = ca.vertcat(q, v, later[2], z)
    total = ca.vertcat(total[: 2 * nj, :], follows[2], total[2 * nj :, :])
    given = [x, u, d, h, m.p, valves]
    parts = [total[:, :nx], total[:, nx : nx + na], total[:, nx + na :]]
    still = ca.substitute(m.rest_state, m.v, ca.SX.zeros(m.v.shape))
    return (
        ca.Function("step", given, [after]),
        ca.Function("slopes", given, [after, *parts]),
        ca.Function("rest", [m.q, m.p], [still]),
    )


Stepped = tuple[tuple[ca.SX, ...], ca.SX]
"""q, v and z after a step, and their derivatives by (x, u, d)."""


def _explicit(s: _Stages) -> Stepped:
    """Runge and Kutta's step of order four."""
    nj = s.d.numel()

    def slope(at: tuple[ca.SX, ...], along: ca.SX, k: int) -> Stepped:
        """Rates of (q, v, z), and their derivatives by (x, u, d)."""
        found, jacobian = s.rates(*at, s.pressure[k], s.d, s.p)
        moved = jacobian @ ca.vertcat(along, s.follows[k], s.others)
        return (at[1], found[:nj, 0], found[nj:, 0]), ca.vertcat(along[nj : 2 * nj, :], moved)

    def ahead(by: Stepped, share: float) -> Stepped:
        step = share * s.h
        moved = tuple(value + step * change for value, change in zip(s.first, by[0], strict=True))
        return moved, s.moves + step * by[1]

    k1 = slope(s.first, s.moves, 0)
    k2 = slope(*ahead(k1, 0.5), 1)
    k3 = slope(*ahead(k2, 0.5), 1)
    k4 = slope(*ahead(k3, 1.0), 2)

    def whole(one: ca.SX, two: ca.SX, three: ca.SX, four: ca.SX) -> ca.SX:
        return s.h / 6 * (one + 2 * two + 2 * three + four)

    after = tuple(value + whole(*k) for value, *k in zip(s.first, k1[0], k2[0], k3[0], k4[0], strict=True))
    return after, s.moves + whole(k1[1], k2[1], k3[1], k4[1])


def _implicit(s: _Stages) -> Stepped:
    """ROS2's step: W k₁ = f(y), W k₂ = f(y + h k₁) − 2 k₁, y + h (3 k₁ + k₂)/2 with W = 1 − γ h ∂f/∂y.

    Pressures count as in the middle of the step. The derivatives have W as it is at the begin, and no second ones.
    """
    nj, nz = s.d.numel(), s.first[2].numel()
    rows = nj + nz
    slope, jacobian = s.rates(*s.first, s.pressure[1], s.d, s.p)
    own, beside = jacobian[:, : 2 * nj + nz], jacobian[:, 2 * nj + nz :]
    by_q, by_rest = own[:, :nj], own[:, nj:]
    g = GAMMA * s.h
    kept = ca.SX.eye(rows) - g * by_rest
    kept[:, :nj] -= g**2 * by_q
    solve: Callable[[ca.SX], ca.SX] = eliminate(kept)

    def solved(f: ca.SX) -> ca.SX:
        """W⁻¹ of columns (2 nj + nz, …): rates of positions are velocities."""
        rest = solve(f[nj:, :] + g * (by_q @ f[:nj, :]))
        return ca.vertcat(f[:nj, :] + g * rest[:nj, :], rest)

    y = ca.vertcat(*s.first)
    k1 = solved(ca.vertcat(s.first[1], slope))
    there = y + s.h * k1
    at = (there[:nj, 0], there[nj : 2 * nj, 0], there[2 * nj :, 0])
    then, _ = s.rates(*at, s.pressure[1], s.d, s.p)
    k2 = solved(ca.vertcat(at[1], then) - 2 * k1)
    after = y + s.h / 2 * (3 * k1 + k2)
    forced = beside @ ca.vertcat(s.follows[1], s.others)

    def moved(along: ca.SX) -> ca.SX:
        return ca.vertcat(along[nj : 2 * nj, :], own @ along + forced)

    d1 = solved(moved(s.moves))
    d2 = solved(moved(s.moves + s.h * d1) - 2 * d1)
    return (after[:nj, 0], after[nj : 2 * nj, 0], after[2 * nj :, 0]), s.moves + s.h / 2 * (3 * d1 + d2)


def _pressure(before: ca.SX, u: ca.SX, valve: ca.SX, t: ca.SX) -> ca.SX:
    """Behind a valve (1, 6) a time t after u took hold [Pa]; where both rate and lag limit it, whichever is slower."""
    tau = ca.if_else(u > before, valve[FILL], valve[VENT])
    decay = ca.if_else(tau > SMALL, ca.exp(-t / ca.fmax(tau, SMALL)), 0)
    flow = ca.if_else(valve[FLOW] < UNLIMITED, valve[FLOW] * (ca.fmax(u, LEAST) / REFERENCE) ** valve[POWER], UNLIMITED)
    up, down = (_way(rate, t) for rate in (ca.fmin(valve[RATE], flow), valve[RATE]))
    return before + ca.fmax(-down, ca.fmin(up, (u - before) * (1 - decay)))


def _way(rate: ca.SX, t: ca.SX) -> ca.SX:
    """How far a pressure can come in a time t [Pa]; all the way at once where no rate limits it."""
    return t * rate + ca.if_else(rate < UNLIMITED, 0, UNLIMITED)
