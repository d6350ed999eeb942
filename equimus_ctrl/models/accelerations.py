"""The exact equations of motion as one CasADi function, for solvers and estimators of one's own."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.models.augmented import augmented_model, law_parameters, sliding_friction
from equimus_ctrl.models.dynamics import computable
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import ldl_solve


@lru_cache(maxsize=16)
def accelerations(model: Model) -> ca.Function:
    """(q, v, u) → a, the accelerations of a robot's joints under commands; SX inside, so that it expands anywhere.

        M(q) a + h(q, v) = B(q) u + τ₀(q, v)

    Bodies, springs, damping, drives and effects that push are in it; states that drives and effects have are as after
    a long rest at q. Dry friction is smoothed about v = 0, for it is to have derivatives. Limits of commands and
    forces are not, for a solver takes them as constraints, and would meet a kink at each; nor are ends of joints,
    contacts, and what is between a command and its drive (dead time, lag, limited rate).

    Args:
        model: the robot, with what is known to be attached to it.

    Returns:
        Of q (nj,) [rad or m], v (nj,) [rad/s or m/s] and u (na,) in the robot's own unit to a (nj,) [rad/s² or m/s²];
        joints and actuators are in the robot's order.

    Raises:
        NotAvailable: where no equations hold the robot, or it has joints that are not measured.
    """
    robot, laws = computable(model), laws_of(model.effects)
    mechanics = robot.mechanics()
    form = mechanics.form
    m, base = augmented_model(form, model.phase, laws), build(form, model.phase)
    own = law_parameters(m.slots, model.effects, mechanics.law_places["joint"], mechanics.law_places["actuator"])
    inside = base.inside.state.numel()
    here = ca.vertcat(base.p, base.inside.state), ca.vertcat(m.p[: base.p.numel()], m.z[:inside, 0])
    absent = ca.vertcat(m.phi, m.pressed)
    free = ca.substitute(m.smooth_acceleration, absent, ca.SX.zeros(absent.shape))
    found = free + ldl_solve(ca.substitute(base.mass, *here), sliding_friction(m))
    # The equations have the joints in an order of their own.
    order, back = np.argsort(mechanics.joints).tolist(), mechanics.joints.tolist()
    nj = len(order)
    q, v, u = ca.SX.sym("q", nj), ca.SX.sym("v", nj), ca.SX.sym("u", m.pressure.numel())
    at_rest = ca.substitute(found, m.z, m.rest_state)
    whole = ca.Function("whole", [m.q, m.v, m.pressure, m.p], [ca.cse(at_rest)])
    after = whole(q[order], v[order], u, ca.DM([*form.unlimited(mechanics.parameters, commands=True), *own]))
    return ca.Function("accelerations", [q, v, u], [ca.densify(after)[back]], ["q", "v", "u"], ["a"])
