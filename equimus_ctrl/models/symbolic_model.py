"""The equations of motion of a robot as CasADi expressions, whatever kind of robot they were made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from equimus_ctrl.models.parts import Actuation, Held, Inside, Limit, Rubbing, constrained, gaps, grips


@dataclass(frozen=True, eq=False)
class SymbolicModel:
    """CasADi SX expressions of one structure; symbols are q, v, f, tau, p.

    Attributes:
        q: (nj,) joint coordinates [rad or m].
        v: (nj,) their rates.
        f: (na,) drive forces along the actuators [N].
        tau: (nj,) torques on the joints [N·m or N].
        p: parameter vector of the structure.
        mass: (nj, nj) mass matrix M(q).
        bias: (nj,) h(q, v), limits included.
        smooth_bias: (nj,) h(q, v) without the limits.
        static_bias: (nj,) h(q, 0) without the limits.
        acceleration: (nj,) under f and tau, each limit pressed as it would be by itself.
        lengths: (na,) actuator lengths [m].
        jacobian: (na, nj) moment arms, ∂lengths/∂q.
        foot: (2,) the foot's position relative to the base, where there is one [m].
        knots: (2 or 3, nj + 1) the base's origin, then a point of each link, relative to the base [m].
        kinetic: T [J].
        potential: V [J], without the limits.
        area: (na,) force for each unit of command.
        rest_length: (na,) [m].
        stop_torque: (nj,) what limits that are springs exert [N·m].
        actuation: how commands become torques.
        limits: (nl) ends of coordinates.
        held: equalities.
        rubbing: coordinates at which the robot itself can have dry friction.
        inside: states of its own beside its motion.
        u: (nu,) commands.
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
    actuation: Actuation
    limits: tuple[Limit, ...]
    held: tuple[Held, ...]
    rubbing: tuple[Rubbing, ...]
    inside: Inside
    u: ca.SX

    @property
    def static_pressure(self) -> ca.SX:
        """(na,) commands that hold q at rest: the least-squares, least-norm solution of Jᵀ diag(s) P = h(q, 0)."""
        drive = self.jacobian.T @ ca.diag(self.area)  # (nj, na)
        return pseudo_solve(drive, self.static_bias)

    @classmethod
    def assembled(
        cls,
        q: ca.SX,
        v: ca.SX,
        p: ca.SX,
        *,
        mass: ca.SX,
        bias: ca.SX,
        actuation: Actuation,
        lengths: ca.SX,
        rest_length: ca.SX,
        limits: Sequence[Limit],
        held: Sequence[Held],
        rubbing: Sequence[Rubbing],
        foot: ca.SX,
        knots: ca.SX,
        potential: ca.SX,
        inside: Inside | None = None,
        commands: int | None = None,
    ) -> SymbolicModel:
        """The model with what follows from its parts.

        Args:
            q: symbols of the joint coordinates.
            v: symbols of their rates.
            p: symbols of the parameters.
            mass: (nj, nj).
            bias: (nj,) without the limits.
            actuation: see the attributes, as what follows.
            lengths: of the actuators.
            rest_length: of the actuators.
            limits: of coordinates.
            held: equalities.
            rubbing: of the robot itself.
            foot: where there is one.
            knots: to draw.
            potential: of gravity and springs.
            inside: states of its own; none by default.
            commands: how many there are; one for each actuator by default.
        """
        na = lengths.numel()
        f, tau = ca.SX.sym("f", na), ca.SX.sym("tau", q.numel())
        springs = [k.row.T * (ca.fmin(k.depth, k.force) > 0) * k.force for k in limits if k.force is not None]
        stop_torque = sum(springs, ca.SX(q.numel(), 1))
        load = actuation.jacobian.T @ f + tau - bias
        open_ended, none = ca.SX(len(limits), 1), ca.SX(0, 1)
        free = acceleration = ldl_solve(*constrained(mass, load, held, limits, open_ended, open_ended))
        if limits:
            alone = grips(limits, gaps(limits, free) > 0)
            acceleration = ldl_solve(*constrained(mass, load, held, limits, *alone))
        return cls(
            q, v, f, tau, p, mass, bias - stop_torque, bias, ca.substitute(bias, v, ca.SX.zeros(v.shape)),
            acceleration, lengths, actuation.jacobian, foot, knots, v.T @ mass @ v / 2, potential, actuation.gain,
            rest_length, stop_torque, actuation, tuple(limits), tuple(held), tuple(rubbing),
            inside or Inside(none, lambda u: none, none, none), ca.SX.sym("u", na if commands is None else commands),
        )  # fmt: skip


def ldl_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve A x = b for a small symmetric positive definite A by LDLᵀ, written out as scalar operations.

    From the last row to the first: zeros between the branches of a tree stay zeros (Featherstone, *Rigid Body Dynamics
    Algorithms*, 2008, chapter 6).
    """
    n = matrix.shape[0]
    order = list(reversed(range(n)))
    a, y = matrix[order, order], ca.vertsplit(rhs[order])
    lower, scaled = ca.SX(n, n), ca.SX(n, n)  # L and L·D below their diagonals
    inverse: list[ca.SX] = []
    for j in range(n):
        inverse.append(1 / (a[j, j] - sum((lower[j, k] * scaled[j, k] for k in range(j)), ca.SX(0))))
        for i in range(j + 1, n):
            scaled[i, j] = a[i, j] - sum((lower[i, k] * scaled[j, k] for k in range(j)), ca.SX(0))
            lower[i, j] = scaled[i, j] * inverse[j]
    for i in range(n):
        y[i] -= sum((lower[i, k] * y[k] for k in range(i)), ca.SX(0))
    x = [y[i] * inverse[i] for i in range(n)]
    for i in reversed(range(n)):
        x[i] -= sum((lower[k, i] * x[k] for k in range(i + 1, n)), ca.SX(0))
    return ca.vertcat(*reversed(x))


def eliminate(matrix: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Columns b → A⁻¹ b of a small A by LU without pivots, written out.

    Pivots are ratios of leading minors of A. Of 1 + M⁻¹D with a diagonal D not below 0 these are above 0; of any other
    A, as with damping that couples joints, nothing says so, but they tend to 1 with the step.
    """
    n = matrix.shape[0]
    a = [[matrix[i, j] for j in range(n)] for i in range(n)]
    for k in range(n):
        a[k][k] = 1 / a[k][k]
        for i in range(k + 1, n):
            a[i][k] = a[i][k] * a[k][k]
            for j in range(k + 1, n):
                a[i][j] = a[i][j] - a[i][k] * a[k][j]

    def solve(rhs: ca.SX) -> ca.SX:
        y = [rhs[i, :] for i in range(n)]
        for i in range(n):
            for k in range(i):
                y[i] = y[i] - a[i][k] * y[k]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                y[i] = y[i] - a[i][k] * y[k]
            y[i] = y[i] * a[i][i]
        return ca.vertcat(*y)

    return solve


def pseudo_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """A⁺b of a small full-rank A, written out as scalar operations: exact where A is square."""
    rows, columns = matrix.shape
    if rows == columns:
        return ca.inv_minor(matrix) @ rhs
    if rows < columns:
        return matrix.T @ ldl_solve(matrix @ matrix.T, rhs)
    return ldl_solve(matrix.T @ matrix, matrix.T @ rhs)
