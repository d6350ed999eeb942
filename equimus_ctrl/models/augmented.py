"""A structure's equations of motion with pushing effects at every place where they can sit, in CasADi.

    M(q) a + h(q, v) = Jᵀ (A(l)·P + F(l, l̇, z) + φ_drive) + T(q, v, z) + φ_joint,    dz/dt = g

A is an actuator's area, which effects may change. F and T are the effects' own forces and torques, z their states.
φ is dry friction; it is held over a time step and found at velocity level (see ``engines.lane_kernel``), for it is no
function of the state where something sticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.models.morphology import Phase
from equimus_ctrl.models.symbolic import Structure, build, joint_stops, ldl_solve, stops_in_mode

Laws = tuple[type[ForceEffect], ...]


@dataclass(frozen=True)
class Slot:
    """One law at one place.

    Attributes:
        law: the effect's class.
        kind: ``"joint"`` or ``"actuator"``.
        index: which of them.
        first: where its parameters begin in the parameter vector.
    """

    law: type[ForceEffect]
    kind: str
    index: int
    first: int


@dataclass(frozen=True, eq=False)
class AugmentedModel:
    """CasADi SX expressions; symbols are q, v, z, pressure, phi, v0, pressed, p.

    Attributes:
        q: (nj,) joint angles [rad].
        v: (nj,) joint velocities [rad/s].
        z: (nz,) states of the effects.
        pressure: (na,) [Pa].
        phi: (nr,) dry friction held over a step: at the joints that can have it [N·m], then the actuators [N].
        v0: (nj,) velocities at the start of a step [rad/s].
        pressed: (2 nj,) 1 where a joint's lower, upper stop is pressed, else 0.
        p: the structure's parameter vector, then those of the slots.
        slots: the laws in the order of their parameters.
        rubbing: (kind, index) of the place of each row of dry friction.
        torque: (nj,) what the effects exert on the joints, friction left out [N·m].
        force: (na,) what they exert along the actuators whatever the pressures [N].
        area: (na,) force per pressure [m²].
        more_area: (na,) how much of it comes of effects [m²].
        acceleration: (nj,) [rad/s²].
        smooth_acceleration: (nj,) the same with the stops that ``pressed`` says [rad/s²].
        z_rate: (nz,) dz/dt.
        rest_state: (nz,) z after a long rest at q.
        rows: (nr,) rates that friction acts against, G(q) v.
        push: (nj, nr) velocities that a unit impulse at each row makes, M⁻¹Gᵀ.
        delassus: (nr, nr) G M⁻¹ Gᵀ.
        gaps: (2 nj,) above 0 where a stop would be pressed, see ``symbolic.stops_in_mode``.
        quickness: (1,) a bound, near to it, of the fastest rate of the motion with ``pressed`` stops [1/s].
        bound: (nr,) the greatest friction at the mean of the speeds v0 and v.
        rows_before: (nr,) rates at the start of a step, G(q) v0.
    """

    q: ca.SX
    v: ca.SX
    z: ca.SX
    pressure: ca.SX
    phi: ca.SX
    v0: ca.SX
    pressed: ca.SX
    p: ca.SX
    slots: tuple[Slot, ...]
    rubbing: tuple[tuple[str, int], ...]
    torque: ca.SX
    force: ca.SX
    area: ca.SX
    more_area: ca.SX
    acceleration: ca.SX
    smooth_acceleration: ca.SX
    z_rate: ca.SX
    rest_state: ca.SX
    rows: ca.SX
    push: ca.SX
    delassus: ca.SX
    gaps: ca.SX
    quickness: ca.SX
    bound: ca.SX
    rows_before: ca.SX


@lru_cache(maxsize=32)
def slots_of(form: Structure, laws: Laws) -> tuple[Slot, ...]:
    """Every law at every place of its kinds; their parameters follow the structure's own."""
    counts = {"joint": len(form[0]), "actuator": len(form[1])}
    first = int(build(form, "swing").p.numel())
    found = []
    for law in laws:
        for kind in law.sits_at:
            for index in range(counts[kind]):
                found.append(Slot(law, kind, index, first))
                first += len(law.parameter_info())
    return tuple(found)


@lru_cache(maxsize=32)
def augmented_model(form: Structure, phase: Phase, laws: Laws) -> AugmentedModel:
    """The equations of a structure with ``laws`` wherever they can sit."""
    m = build(form, phase)
    nj, na = m.q.numel(), m.f.numel()
    slots = slots_of(form, laws)
    base = m.p.numel()
    p = ca.SX.sym("p", base + sum(len(slot.law.parameter_info()) for slot in slots))
    nz = sum(slot.law.n_states for slot in slots)
    z, pressure, v0 = ca.SX.sym("z", nz), ca.SX.sym("pressure", na), ca.SX.sym("v0", nj)
    lengths, jacobian = m.lengths, m.jacobian
    coordinates = {"joint": (m.q, m.v), "actuator": (lengths, jacobian @ m.v)}
    push = {"joint": [ca.SX(0)] * nj, "actuator": [ca.SX(0)] * na}
    shares = [ca.SX(0)] * na
    speed = {"joint": m.v, "actuator": jacobian @ m.v}
    mean = {kind: ca.fabs(ca.substitute(rate, m.v, (m.v + v0) / 2)) for kind, rate in speed.items()}
    bounds: dict[tuple[str, int], ca.SX] = {}
    rates: list[ca.SX] = []
    rests: list[ca.SX] = []
    for slot in slots:
        law, kind, i = slot.law, slot.kind, slot.index
        own = {key: p[slot.first + k] for k, key in enumerate(law.parameter_info())}
        x, rate = coordinates[kind][0][i], coordinates[kind][1][i]
        states = [z[len(rates) + k] for k in range(law.n_states)]
        push[kind][i] = push[kind][i] + law.force(x, rate, states, own)
        if law.scales:
            shares[i] = shares[i] + law.more_area(x, m.rest_length[i], own)
        rates += law.state_rate(x, rate, states, own)
        rests += law.rest_state(x, own)
        if law.rubs:
            bounds[kind, i] = bounds.get((kind, i), ca.SX(0)) + law.dry_friction(x, mean[kind][i], own)
    rubbing = sorted(bounds, key=lambda row: (row[0] != "joint", row[1]))
    phi = ca.SX.sym("phi", len(rubbing))
    gradient = ca.vertcat(
        *[ca.SX.eye(nj)[i, :] if kind == "joint" else jacobian[i, :] for kind, i in rubbing], ca.SX(0, nj)
    )
    torque, force = ca.vertcat(*push["joint"]), ca.vertcat(*push["actuator"])
    more_area = ca.vertcat(*shares) * m.area
    area = m.area + more_area
    drive = jacobian.T @ (area * pressure + force)
    pressed = ca.SX.sym("pressed", 2 * nj)
    stops = [stops_in_mode(m.q[i], m.v[i], joint_stops(m.p, i), pressed[2 * i : 2 * i + 2]) for i in range(nj)]
    load = drive + torque + gradient.T @ phi
    acceleration = ldl_solve(m.mass, load - m.bias)
    push_of_stops = ca.vertcat(*[push for push, _ in stops])
    smooth_acceleration = ldl_solve(m.mass, load - m.smooth_bias + push_of_stops)
    stiffness = -ca.jacobian(push_of_stops, m.q)
    springs = ca.horzcat(*[ldl_solve(m.mass, stiffness[:, i]) for i in range(nj)])
    reach = ca.horzcat(*[ldl_solve(m.mass, gradient[r, :].T) for r in range(len(rubbing))], ca.SX(nj, 0))
    outputs = [
        torque,
        force,
        area,
        more_area,
        acceleration,
        smooth_acceleration,
        ca.vertcat(*rates, ca.SX(0, 1)),
        ca.vertcat(*rests, ca.SX(0, 1)),
        gradient @ m.v,
        reach,
        gradient @ reach,
        ca.vertcat(*[gap for _, gap in stops]),
        _quickness(ca.jacobian(smooth_acceleration, m.v), springs),
        ca.vertcat(*[bounds[row] for row in rubbing], ca.SX(0, 1)),
        gradient @ v0,
    ]
    outputs = [ca.substitute(output, m.p, p[:base]) for output in outputs]
    return AugmentedModel(m.q, m.v, z, pressure, phi, v0, pressed, p, slots, tuple(rubbing), *outputs)


SLIDING = {"joint": 0.02, "actuator": 0.002}
"""Rate on which three quarters of dry friction are counted where it is smoothed [rad/s, m/s]."""


def sliding_friction(m: AugmentedModel) -> ca.SX:
    """(nj,) torque of dry friction as a smooth function of the rates, −Gᵀ b tanh(G v / s) [N·m]; none at rest."""
    slow = ca.DM([SLIDING[kind] for kind, _ in m.rubbing])
    rubbing = ca.substitute(m.bound, m.v0, m.v) * ca.tanh(m.rows / slow)
    return -ca.jacobian(m.rows, m.v).T @ rubbing


def _quickness(by_speed: ca.SX, springs: ca.SX) -> ca.SX:
    """How fast damping and the stops' springs may make a motion, (1,) [1/s].

    Args:
        by_speed: (nj, nj) ∂a/∂v [1/s].
        springs: (nj, nj) M⁻¹K of the stops [1/s²].
    """

    def largest(matrix: ca.SX) -> ca.SX:
        # Of real eigenvalues above zero: at most the root of the sum of their squares.
        return ca.sqrt(ca.fmax(ca.trace(matrix @ matrix), 0.0))

    return ca.fmax(largest(by_speed), ca.sqrt(largest(springs)))


def law_parameters(
    slots: Sequence[Slot], effects: Sequence[Effect], joints: Sequence[str], actuators: Sequence[str]
) -> list[float]:
    """The slots' parameters for the effects that a model has; slots without an effect do nothing."""
    names = {"joint": joints, "actuator": actuators}
    attached = {(type(e), e.location): e for e in effects}
    values: list[float] = []
    for slot in slots:
        effect = attached.get((slot.law, names[slot.kind][slot.index]))
        info = slot.law.parameter_info()
        if effect is not None:
            values += effect.parameters().values()
        else:
            values += [slot.law.neutral.get(key, meta["high"]) for key, meta in info.items()]
    return values
