"""A structure's equations of motion solved for the pressures, force effects included, in CasADi.

    P = (Jᵀ diag(A))⁺ (M(q) a + h(q, v) − T(q, v, z) − JᵀF(l, l̇, z) + Gᵀ b tanh(G v / s)),    dz/dt = g

A is the area with what effects make of it; T and F are what they exert, z their states; b is the size of dry friction,
which works against the rates G v. Joint stops do not count, as in the static pressures: what presses on one needs no
pressure to stay there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters, sliding_friction
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import pseudo_solve
from equimus_ctrl.robots.elastic.morphology import Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """Compiled functions of one structure with its laws.

    Attributes:
        pressure: (q, v, a, z, p) → (na,) under which the robot moves so [Pa].
        counter: (q, torque, p) → (na,) that exerts a torque on the joints [Pa].
        advanced: (q, v, z, p, dt) → (nz,) the effects' states after dt of such motion.
        rest: (q, p) → (nz,) the same after a long rest.
    """

    pressure: ca.Function
    counter: ca.Function
    advanced: ca.Function
    rest: ca.Function


def holding_pressure(model: Model, pose: ArrayLike) -> Array:
    """(na,) pressures behind the valves that hold a model at rest at a pose (nj,) [rad], its effects included [Pa].

    They may lie outside the range; stops take no part, dry friction neither.
    """
    robot = changed_bodies(model.effects, model.morphology)
    laws = laws_of(model.effects)
    form = structure(robot)
    slots = augmented_model(form, model.phase, laws).slots
    parameters = [*pack(robot), *law_parameters(slots, model.effects, robot.joint_names, robot.actuator_names)]
    law, q, still = inverse_dynamics(form, model.phase, laws), np.array(pose), np.zeros(len(robot.joints))
    return np.array(law.pressure(q, still, still, law.rest(q, parameters), parameters)).ravel()


@lru_cache(maxsize=16)
def inverse_dynamics(form: Structure, phase: Phase, laws: Laws) -> InverseDynamics:
    """The inverse of ``models.augmented.augmented_model``; p is that model's parameter vector."""
    m, base = augmented_model(form, phase, laws), build(form, phase)
    a, dt = ca.SX.sym("a", m.q.numel()), ca.SX.sym("dt")
    own = ca.vertcat(base.q, base.v, base.p), ca.vertcat(m.q, m.v, m.p[: base.p.numel()])
    mass, bias, jacobian = (ca.substitute(x, *own) for x in (base.mass, base.smooth_bias, base.jacobian))
    torque = mass @ a + bias - m.torque - jacobian.T @ m.force - sliding_friction(m)
    # An implicit step, for states may follow faster than commands are given.
    drive, wanted = jacobian.T @ ca.diag(m.area), ca.SX.sym("torque", m.q.numel())
    system = ca.SX.eye(m.z.numel()) - dt * ca.jacobian(m.z_rate, m.z)
    return InverseDynamics(
        ca.Function("pressure", [m.q, m.v, a, m.z, m.p], [pseudo_solve(drive, torque)]),
        ca.Function("counter", [m.q, wanted, m.p], [pseudo_solve(drive, wanted)]),
        ca.Function("advanced", [m.q, m.v, m.z, m.p, dt], [m.z + dt * ca.solve(system, m.z_rate)]),
        ca.Function("rest", [m.q, m.p], [m.rest_state]),
    )
