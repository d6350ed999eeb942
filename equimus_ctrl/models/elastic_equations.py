"""The equations of motion of planar robots with elastic actuators, from the exact Lagrangian.

    M(q) a + h(q, v) = J(q)ᵀ f + tau

h gathers ∂V/∂q with V = Σ −m g·y + Σ ½ k (l − l0)², joint damping, the actuators' own damping Jᵀ c J v and the joint
stops; an actuator's mass is spread evenly along its length (Zhu et al., "EquiMus", 2025).
"""

from __future__ import annotations

import casadi as ca

from equimus_ctrl.models.parts import Actuation, Limit
from equimus_ctrl.models.symbolic_model import SymbolicModel
from equimus_ctrl.models.tree import Link, Spot, SpreadMass, Tree, equations
from equimus_ctrl.robots.elastic.form import N_ACTUATOR, N_GLOBAL, N_JOINT, ElasticForm
from equimus_ctrl.robots.elastic.morphology import Phase

NO_STOP = 1e3
"""Where a stop that is absent is put instead of at infinity [rad], so that nothing times infinity is formed."""


def elastic_equations(form: ElasticForm, phase: Phase) -> SymbolicModel:
    """The equations of a form, in swing or in stance; parameters stay symbols."""
    parents, spans, foot_body = form
    nj, na = len(parents), len(spans)
    q, v = ca.SX.sym("q", nj), ca.SX.sym("v", nj)
    p = ca.SX.sym("p", N_GLOBAL + nj * N_JOINT + na * N_ACTUATOR)
    gravity, tilt, base_mass = p[0], p[1], p[2]
    joints = [p[N_GLOBAL + i * N_JOINT : N_GLOBAL + (i + 1) * N_JOINT] for i in range(nj)]
    first = N_GLOBAL + nj * N_JOINT
    actuators = [p[first + i * N_ACTUATOR : first + (i + 1) * N_ACTUATOR] for i in range(na)]
    none = ca.SX(1, 1)

    def polar(radius: ca.SX, angle: ca.SX) -> ca.SX:
        # The products of parameters alone are formed here so that they can be evaluated once for a whole run.
        return ca.vertcat(radius * ca.cos(angle), radius * ca.sin(angle), none)

    def tip(i: int) -> Spot:
        return Spot(i, ca.vertcat(joints[i][9], none, none))

    links = []
    for joint, parent in zip(joints, parents, strict=True):
        mass, com, inertia = joint[10], joint[11], joint[12]
        six = ca.vertcat(none, none, inertia + mass * com**2, none, none, none)
        first_moment = ca.vertcat(mass * com, none, none)
        links.append(Link(parent, polar(joint[0], joint[1]), ca.SX.eye(3), False, mass, first_moment, six))
    ends = [
        (Spot(a, polar(own[0], own[1])), Spot(b, polar(own[2], own[3])))
        for (a, b), own in zip(spans, actuators, strict=True)
    ]
    down = gravity * ca.vertcat(-ca.sin(tilt), ca.cos(tilt), none)
    spread = [SpreadMass(*pair, own[4]) for pair, own in zip(ends, actuators, strict=True)]
    pinned = tip(foot_body) if phase == "stance" else None
    rigid = equations(Tree(links, down, spread, pinned, base_mass), q, v)
    frames, bias = rigid.frames, rigid.bias

    lengths, rows = [], []
    for (a, b), own in zip(ends, actuators, strict=True):
        way = frames.position(b) - frames.position(a)
        length = ca.sqrt(ca.sumsqr(way))
        row = (way / length).T @ (frames.jacobian(b) - frames.jacobian(a))
        lengths.append(length)
        rows.append(row)
        stiffness, damping, rest = own[5], own[6], own[7]
        bias += row.T * (stiffness * (length - rest) + damping * (row @ v))
    bias += ca.vertcat(*[joints[i][2] * v[i] for i in range(nj)])
    area, rest_length = (ca.vertcat(*[a[k] for a in actuators]) for k in (8, 7))
    shift = frames.position(pinned) if pinned is not None else ca.SX(3, 1)
    potential = base_mass * ca.dot(down, shift)
    for i, link in enumerate(links):
        potential -= ca.dot(down, link.mass * (frames.origin[i] - shift) + frames.rotation[i] @ link.first)
    for (a, b), own, length in zip(ends, actuators, lengths, strict=True):
        potential -= own[4] * ca.dot(down, (frames.position(a) + frames.position(b)) / 2 - shift)
        potential += own[5] * (length - own[7]) ** 2 / 2
    return SymbolicModel.assembled(
        q, v, p, mass=rigid.mass, bias=bias, actuation=Actuation(ca.vertcat(*rows), area, ca.SX(na, 1)),
        lengths=ca.vertcat(*lengths), rest_length=rest_length,
        limits=[limit for i in range(nj) for limit in _stops(q, v, joint_stops(p, i), i)], held=(), rubbing=(),
        foot=frames.position(tip(foot_body))[:2],
        knots=ca.horzcat(ca.SX.zeros(2), *[frames.position(tip(i))[:2] for i in range(nj)]), potential=potential,
    )  # fmt: skip


def joint_stops(p: ca.SX, joint: int) -> ca.SX:
    """(6,) a joint's stops in the parameter vector: angle, stiffness and damping of the lower, then of the upper."""
    first = N_GLOBAL + joint * N_JOINT + 3
    return p[first : first + 6]


def stops_in_mode(q: ca.SX, v: ca.SX, stops: ca.SX, pressed: ca.SX) -> tuple[ca.SX, ca.SX]:
    """A joint's stops with what is pressed held fixed, so that the motion is smooth until that changes.

    Args:
        q: angle [rad].
        v: velocity [rad/s].
        stops: lower angle, stiffness, damping, then the upper's.
        pressed: (2,) 1 where the lower, the upper stop is pressed, else 0.

    Returns:
        The torque on the joint [N·m], and (2,) numbers that are above 0 where a stop would be pressed: the depth, or
        the force where that is less, for a stop never pulls.
    """
    low, low_k, low_c, high, high_k, high_c = ca.vertsplit(stops)
    below, above = ca.fmax(low, -NO_STOP) - q, q - ca.fmin(high, NO_STOP)
    of_lower, of_upper = low_k * below - low_c * v, high_k * above + high_c * v
    return pressed[0] * of_lower - pressed[1] * of_upper, ca.vertcat(ca.fmin(below, of_lower), ca.fmin(above, of_upper))


def _stops(q: ca.SX, v: ca.SX, stops: ca.SX, joint: int) -> tuple[Limit, Limit]:
    """A joint's lower and upper stop."""
    low, low_k, low_c, high, high_k, high_c = ca.vertsplit(stops)
    up = ca.SX(1, q.numel())
    up[joint] = 1
    below, above = ca.fmax(low, -NO_STOP) - q[joint], q[joint] - ca.fmin(high, NO_STOP)
    return (
        Limit(below, up, low_k * below - low_c * v[joint]),
        Limit(above, -up, high_k * above + high_c * v[joint]),
    )
