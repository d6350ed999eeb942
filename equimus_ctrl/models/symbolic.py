"""The exact reduced-coordinate Lagrangian of a morphology, in CasADi: the one place where its physics stands.

With joint angles q, velocities v, drive forces f (positive when they push an actuator's ends apart) and joint
torques tau:

    M(q) a + h(q, v) = J(q)ᵀ f + tau

T = Σ ½ m|v_com|² + ½ I ω²  over the links  + Σ m/6 (v_A·v_B + v_A² + v_B²)  over the actuators,
V = Σ −m g·y  + Σ ½ k (l − l0)², and h gathers the Coriolis terms, ∂V/∂q, joint damping, the actuators' own damping
Jᵀ c J v and the joint stops. The actuators' kinetic energy is that of mass spread evenly along the length
(Zhu et al., "EquiMus", 2025).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca

from equimus_ctrl.models.morphology import Morphology, Phase, structure

N_GLOBAL, N_JOINT, N_ACTUATOR = 3, 13, 9
"""How many entries of the parameter vector belong to the whole, to each joint and to each actuator."""

Structure = tuple[tuple[int, ...], tuple[tuple[int, int], ...], int]


@dataclass(frozen=True, eq=False)
class SymbolicModel:
    """CasADi SX expressions of one structure; symbols are q, v, f, tau, p.

    Attributes:
        q: (nj,) joint angles [rad].
        v: (nj,) joint velocities [rad/s].
        f: (na,) drive forces along the actuators [N].
        tau: (nj,) torques on the joints [N·m].
        p: parameter vector, see ``morphology.pack``.
        mass: (nj, nj) mass matrix M(q).
        bias: (nj,) h(q, v), stops included.
        smooth_bias: (nj,) h(q, v) without the stops.
        static_bias: (nj,) ∂V/∂q without the stops.
        acceleration: (nj,) M⁻¹(Jᵀf + tau − h).
        lengths: (na,) actuator lengths [m].
        jacobian: (na, nj) J = ∂lengths/∂q.
        foot: (2,) the foot's position relative to the base [m].
        knots: (2, nj + 1) the base's origin, then the tip of each joint's link, relative to the base [m].
        kinetic: T [J].
        potential: V [J], without the stops.
        area: (na,) force per pressure [m²].
        rest_length: (na,) [m].
        stop_torque: (nj,) what the joint stops exert [N·m].
    """

    q: ca.SX
    v: ca.SX
    f: ca.SX
    tau: ca.SX
    p: ca.SX
    mass: ca.SX
    bias: ca.SX
    smooth_bias: ca.SX
    static_bias: ca.SX
    acceleration: ca.SX
    lengths: ca.SX
    jacobian: ca.SX
    foot: ca.SX
    knots: ca.SX
    kinetic: ca.SX
    potential: ca.SX
    area: ca.SX
    rest_length: ca.SX
    stop_torque: ca.SX

    @property
    def static_pressure(self) -> ca.SX:
        """(na,) pressures that hold q at rest [Pa]: the least-squares, least-norm solution of Jᵀ diag(s) P = ∂V/∂q."""
        drive = self.jacobian.T @ ca.diag(self.area)  # (nj, na)
        return pseudo_solve(drive, self.static_bias)


def ldl_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve A x = b for a small symmetric positive definite A by LDLᵀ, written out as scalar operations."""
    n = matrix.shape[0]
    lower = ca.SX.eye(n)
    d: list[ca.SX] = []
    for j in range(n):
        d.append(matrix[j, j] - sum((lower[j, k] ** 2 * d[k] for k in range(j)), ca.SX(0)))
        for i in range(j + 1, n):
            partial = sum((lower[i, k] * lower[j, k] * d[k] for k in range(j)), ca.SX(0))
            lower[i, j] = (matrix[i, j] - partial) / d[j]
    y: list[ca.SX] = []
    for i in range(n):
        y.append(rhs[i] - sum((lower[i, k] * y[k] for k in range(i)), ca.SX(0)))
    x: list[ca.SX] = [y[i] / d[i] for i in range(n)]
    for i in reversed(range(n)):
        x[i] = x[i] - sum((lower[k, i] * x[k] for k in range(i + 1, n)), ca.SX(0))
    return ca.vertcat(*x)


def pseudo_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """A⁺b of a small full-rank A, written out as scalar operations: exact where A is square."""
    rows, columns = matrix.shape
    if rows == columns:
        return ca.inv_minor(matrix) @ rhs
    if rows < columns:
        return matrix.T @ ldl_solve(matrix @ matrix.T, rhs)
    return ldl_solve(matrix.T @ matrix, matrix.T @ rhs)


def symbolic_model(morphology: Morphology, phase: Phase = "swing") -> SymbolicModel:
    """The equations of motion of ``morphology``; parameters stay symbols (``SymbolicModel.p``)."""
    return build(structure(morphology), phase)


@lru_cache(maxsize=32)
def build(form: Structure, phase: Phase) -> SymbolicModel:
    """The equations of motion of a structure (see ``morphology.structure``) in swing or stance."""
    parents, spans, foot_body = form
    nj, na = len(parents), len(spans)
    q, v = ca.SX.sym("q", nj), ca.SX.sym("v", nj)
    f, tau = ca.SX.sym("f", na), ca.SX.sym("tau", nj)
    p = ca.SX.sym("p", N_GLOBAL + nj * N_JOINT + na * N_ACTUATOR)
    gravity, tilt, base_mass = p[0], p[1], p[2]
    joints = [p[N_GLOBAL + i * N_JOINT : N_GLOBAL + (i + 1) * N_JOINT] for i in range(nj)]
    first = N_GLOBAL + nj * N_JOINT
    actuators = [p[first + i * N_ACTUATOR : first + (i + 1) * N_ACTUATOR] for i in range(na)]

    def polar(radius: ca.SX, angle: ca.SX) -> ca.SX:
        # The products of parameters alone are formed here so that they can be evaluated once for a whole run.
        return ca.vertcat(radius * ca.cos(angle), radius * ca.sin(angle))

    heading: list[ca.SX] = []
    origin: list[ca.SX] = []

    def rotated(body: int, local: ca.SX) -> ca.SX:
        if body < 0:
            return local
        c, s = ca.cos(heading[body]), ca.sin(heading[body])
        return origin[body] + ca.vertcat(c * local[0] - s * local[1], s * local[0] + c * local[1])

    for i, parent in enumerate(parents):
        at = rotated(parent, polar(joints[i][0], joints[i][1]))
        heading.append(q[i] if parent < 0 else heading[parent] + q[i])
        origin.append(at)

    def along(body: int, distance: ca.SX) -> ca.SX:
        return rotated(body, ca.vertcat(distance, ca.SX(0)))

    foot = along(foot_body, joints[foot_body][9])
    shift = -foot if phase == "stance" else ca.SX.zeros(2)
    gravity_vector = gravity * ca.vertcat(-ca.sin(tilt), ca.cos(tilt))

    kinetic, potential = ca.SX(0), ca.SX(0)

    def velocity(point: ca.SX) -> ca.SX:
        return ca.jtimes(point, q, v)

    if phase == "stance":
        kinetic += base_mass * ca.sumsqr(velocity(shift)) / 2
        potential -= base_mass * ca.dot(gravity_vector, shift)
    for i in range(nj):
        mass, com, inertia = joints[i][10], joints[i][11], joints[i][12]
        centre = along(i, com) + shift
        kinetic += mass * ca.sumsqr(velocity(centre)) / 2 + inertia * velocity(heading[i]) ** 2 / 2
        potential -= mass * ca.dot(gravity_vector, centre)

    lengths: list[ca.SX] = []
    for i, (from_body, to_body) in enumerate(spans):
        o_radius, o_angle, i_radius, i_angle, mass, stiffness, _, rest, _ = ca.vertsplit(actuators[i])
        a = rotated(from_body, polar(o_radius, o_angle)) + shift
        b = rotated(to_body, polar(i_radius, i_angle)) + shift
        va, vb = velocity(a), velocity(b)
        kinetic += mass / 6 * (ca.dot(va, vb) + ca.sumsqr(va) + ca.sumsqr(vb))
        potential -= mass * ca.dot(gravity_vector, a + b) / 2
        lengths.append(ca.sqrt(ca.sumsqr(b - a)))
        potential += stiffness * (lengths[-1] - rest) ** 2 / 2

    length = ca.vertcat(*lengths)
    jacobian = ca.jacobian(length, q)
    momentum = ca.gradient(kinetic, v)
    mass_matrix = ca.jacobian(momentum, v)
    coriolis = ca.jtimes(momentum, q, v) - ca.gradient(kinetic, q)
    static_bias = ca.gradient(potential, q)
    joint_damping = ca.vertcat(*[joints[i][2] * v[i] for i in range(nj)])
    actuator_damping = ca.vertcat(*[a[6] for a in actuators]) * (jacobian @ v)
    stop_torque = ca.vertcat(*[_stop_torque(q[i], v[i], joint_stops(p, i)) for i in range(nj)])
    smooth_bias = coriolis + static_bias + joint_damping + jacobian.T @ actuator_damping
    bias = smooth_bias - stop_torque
    acceleration = ldl_solve(mass_matrix, jacobian.T @ f + tau - bias)
    knots = ca.horzcat(ca.SX.zeros(2), *[along(i, joints[i][9]) for i in range(nj)])
    area, rest_length = (ca.vertcat(*[a[k] for a in actuators]) for k in (8, 7))
    return SymbolicModel(
        q, v, f, tau, p, mass_matrix, bias, smooth_bias, static_bias, acceleration, length, jacobian, foot, knots,
        kinetic, potential, area, rest_length, stop_torque,
    )  # fmt: skip


NO_STOP = 1e3
"""Where a stop that is absent is put instead of at infinity [rad], so that nothing times infinity is formed."""


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
        the push where that is less, for a stop never pulls.
    """
    low, low_k, low_c, high, high_k, high_c = ca.vertsplit(stops)
    below, above = ca.fmax(low, -NO_STOP) - q, q - ca.fmin(high, NO_STOP)
    push_up, push_down = low_k * below - low_c * v, high_k * above + high_c * v
    return pressed[0] * push_up - pressed[1] * push_down, ca.vertcat(ca.fmin(below, push_up), ca.fmin(above, push_down))


def _stop_torque(q: ca.SX, v: ca.SX, stops: ca.SX) -> ca.SX:
    """What a joint's stops exert, pressed as the state says."""
    _, gaps = stops_in_mode(q, v, stops, ca.SX.zeros(2))
    return stops_in_mode(q, v, stops, gaps > 0)[0]
