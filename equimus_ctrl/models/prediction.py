"""One step of a model with its valves, in CasADi: what observers and predictive controllers compute with.

    x = (q, v, P, z),    M(q) a + h(q, v) = Jᵀ(A(l) P + F(l, l̇, z)) + T(q, v, z) − Gᵀ b tanh(G v / s) + d,    dz/dt = g

d is a torque on each joint that the model does not know. Angles, velocities and the effects' states take one
Runge–Kutta step of order four. Pressures follow what reaches their valves, u, over the step in closed form: exact for a
lag, and for a limited rate. Dry friction is smoothed, for it is to have derivatives; what sticks in fact creeps here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import FILL, FLOW, POWER, RATE, REFERENCE, VENT
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters, sliding_friction
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import ldl_solve
from equimus_ctrl.robots.elastic.morphology import Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

UNLIMITED = 1e9
"""A rate [Pa/s] that is none: no infinity enters a product."""
SMALL = 1e-9
"""Time constant that is none [s]."""
LEAST = 1.0
"""Commands below count as this where their power is taken [Pa]: it would have no slope at 0."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A model's step.

    Attributes:
        model: whose.
        nj: joints.
        na: actuators.
        nx: states: 2 nj of the joints, na pressures, then the effects' own.
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


@lru_cache(maxsize=16)
def prediction(model: Model, stops: bool = True) -> Prediction:
    """The step of a model.

    Args:
        model: its effects on valves, bodies and sensors and its force effects are its own.
        stops: whether joints press on their stops; without them they turn freely, and a long step stays stable.
    """
    robot, effects = changed_bodies(model.effects, model.morphology), model.effects
    laws = laws_of(effects)
    form = structure(robot)
    slots = augmented_model(form, model.phase, laws).slots
    own = law_parameters(slots, effects, robot.joint_names, robot.actuator_names)
    held = robot if stops else robot.without_stops()
    valve = valve_settings(effects, robot.actuator_names)
    parameters = ca.DM([*pack(held), *own])
    whole, sloped, rest = _step(form, model.phase, laws)
    nj, na = len(robot.joints), len(robot.actuators)
    nx = whole.size1_in(0)
    x, u, d, h = ca.SX.sym("x", nx), ca.SX.sym("u", na), ca.SX.sym("d", nj), ca.SX.sym("h")
    given = (x, u, d, h, parameters, ca.DM(np.minimum(valve, UNLIMITED)))
    outputs = ca.cse([ca.densify(value) for value in sloped.call([*given])])
    q = ca.SX.sym("q", nj)
    return Prediction(
        model,
        nj,
        na,
        nx,
        valve,
        sensor_settings(effects, robot.joint_names),
        ca.Function("step", [x, u, d, h], [whole(*given)]),
        ca.Function("slopes", [x, u, d, h], outputs),
        ca.Function("rest", [q], [rest(q, parameters)]),
    )


@lru_cache(maxsize=16)
def _step(form: Structure, phase: Phase, laws: Laws) -> tuple[ca.Function, ca.Function, ca.Function]:
    """(x, u, d, h, p, valves) → x after h; the same with its derivatives by x, u and d; (q, p) → z after a long rest.

    Derivatives are carried along by the chain rule, stage by stage: that takes half the operations of differentiating
    the whole step.
    """
    m, base = augmented_model(form, phase, laws), build(form, phase)
    nj, na, nz = m.q.numel(), m.pressure.numel(), m.z.numel()
    nx = 2 * nj + na + nz
    d = ca.SX.sym("d", nj)
    mass = ca.substitute(base.mass, base.p, m.p[: base.p.numel()])
    free = ca.substitute(m.acceleration, m.phi, ca.SX.zeros(m.phi.shape))
    moving = ca.vertcat(free + ldl_solve(mass, d + sliding_friction(m)), m.z_rate)
    by = ca.vertcat(m.q, m.v, m.z, m.pressure, d)
    rates = ca.Function("rates", [m.q, m.v, m.z, m.pressure, d, m.p], [moving, ca.jacobian(moving, by)])
    x, u, h, valves = ca.SX.sym("x", nx), ca.SX.sym("u", na), ca.SX.sym("h"), ca.SX.sym("valves", na, 6)
    pressure, places = x[2 * nj : 2 * nj + na], ca.SX(ca.DM.eye(nx + na + nj))
    later = [ca.vertcat(*[_pressure(pressure[i], u[i], valves[i, :], t * h) for i in range(na)]) for t in (0, 0.5, 1)]
    # Every pressure follows its own command alone.
    follows = []
    for value in later:
        own = [ca.diag(ca.vertcat(*[ca.jacobian(value[i], y[i]) for i in range(na)])) for y in (pressure, u)]
        follows.append(own[0] @ places[2 * nj : 2 * nj + na, :] + own[1] @ places[nx : nx + na, :])
    first = (x[:nj, 0], x[nj : 2 * nj, 0], x[2 * nj + na :, 0])
    moves = ca.vertcat(places[: 2 * nj, :], places[2 * nj + na : nx, :])  # of (q, v, z), by (x, u, d)

    def slope(at: tuple[ca.SX, ...], along: ca.SX, k: int) -> tuple[tuple[ca.SX, ...], ca.SX]:
        """Rates of (q, v, z), and their derivatives by (x, u, d)."""
        found, jacobian = rates(*at, later[k], d, m.p)
        moved = jacobian @ ca.vertcat(along, follows[k], places[nx + na :, :])
        return (at[1], found[:nj, 0], found[nj:, 0]), ca.vertcat(along[nj : 2 * nj, :], moved)

    def ahead(by: tuple[tuple[ca.SX, ...], ca.SX], share: float) -> tuple[tuple[ca.SX, ...], ca.SX]:
        step = share * h
        return tuple(value + step * change for value, change in zip(first, by[0], strict=True)), moves + step * by[1]

    k1 = slope(first, moves, 0)
    k2 = slope(*ahead(k1, 0.5), 1)
    k3 = slope(*ahead(k2, 0.5), 1)
    k4 = slope(*ahead(k3, 1.0), 2)

    def whole(one: ca.SX, two: ca.SX, three: ca.SX, four: ca.SX) -> ca.SX:
        return h / 6 * (one + 2 * two + 2 * three + four)

    q, v, z = (value + whole(*k) for value, *k in zip(first, k1[0], k2[0], k3[0], k4[0], strict=True))
    after = ca.vertcat(q, v, later[2], z)
    total = moves + whole(k1[1], k2[1], k3[1], k4[1])
    total = ca.vertcat(total[: 2 * nj, :], follows[2], total[2 * nj :, :])
    given = [x, u, d, h, m.p, valves]
    parts = [total[:, :nx], total[:, nx : nx + na], total[:, nx + na :]]
    return (
        ca.Function("step", given, [after]),
        ca.Function("slopes", given, [after, *parts]),
        ca.Function("rest", [m.q, m.p], [m.rest_state]),
    )


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
