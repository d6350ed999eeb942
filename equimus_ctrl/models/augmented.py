"""A structure's equations of motion with force effects at every place where they can sit, in CasADi.

    M(q) a + h(q, v) = Jᵀ (A(l)·P + F(l, l̇, z) + φ_drive) + T(q, v, z) + φ_joint,    dz/dt = g

A is an actuator's area, which effects may change. F and T are the effects' own forces and torques, z their states.
φ is dry friction; it is held over a time step and found at velocity level (see ``engines.lane_dry_friction``), for it
is no function of the state where something sticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.models.parts import constrained, gaps, grips
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import SymbolicModel, ldl_solve
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure

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
    """CasADi SX expressions; symbols are q, v, z, pressure, phi, q0, v0, pressed, time, p.

    Units are those of hinges. Of slides m takes the place of rad and N of N·m. Where commands are no pressures their
    own unit takes the place of Pa.

    Attributes:
        q: (nj,) joint angles [rad].
        v: (nj,) joint velocities [rad/s].
        z: (nz,) states of the robot's own, then those of the effects.
        pressure: (nu,) commands as they arrive [Pa], or what else they are.
        phi: (nr,) dry friction held over a step: at the joints that can have it [N·m], then the actuators [N].
        q0: (nj,) joint angles at the start of a step [rad].
        v0: (nj,) velocities there [rad/s].
        pressed: (nl,) 1 where a limit is pressed, else 0.
        time: (1,) since the recording began, at a start [s].
        grip: (nl,) what limits add to the mass matrix, see ``parts.grips``.
        pull: (nl,) what they add to the load.
        a: (nj,) accelerations [rad/s²].
        p: the structure's parameter vector, then those of the slots.
        slots: the laws in the order of their parameters.
        rubbing: (kind, index) of the place of each row of dry friction.
        torque: (nj,) what the effects exert on the joints, without friction [N·m].
        force: (na,) what they exert along the actuators whatever the pressures [N].
        area: (na,) force per pressure [m²].
        more_area: (na,) how much of it comes of effects [m²].
        acceleration: (nj,) [rad/s²].
        smooth_acceleration: (nj,) the same with the limits that ``pressed`` says [rad/s²].
        gripped_acceleration: (nj,) the same with what ``grip`` and ``pull`` say.
        grips: (2 nl,) grip and pull of the limits that ``pressed`` says.
        z_rate: (nz,) dz/dt.
        rest_state: (nz,) z after a long rest at q.
        start_state: (nz,) z where a trial starts at q and v.
        rows: (nr,) rates that friction acts against, G(q) v.
        per_impulse: (nj, nr) change of the velocities per unit impulse at each row, M⁻¹Gᵀ, limits gripping.
        delassus: (nr, nr) G M⁻¹ Gᵀ.
        gaps: (nl,) above 0 where a limit would be pressed at the accelerations ``a``, see ``parts.gaps``.
        depths: (nl,) above 0 beyond a limit; below it no gap is above 0.
        quickness: (1,) a bound, near to it, of the fastest rate of the motion with ``pressed`` stops [1/s].
        bound: (nr,) the greatest friction at the means of the angles q0 and q and of the speeds v0 and v.
        rows_before: (nr,) rates at the start of a step, G(q) v0.
        drive: (nj,) what the actuators exert on the joints.
        kept: (nz,) the states of the robot's own within their bounds.
    """

    q: ca.SX
    v: ca.SX
    z: ca.SX
    pressure: ca.SX
    phi: ca.SX
    q0: ca.SX
    v0: ca.SX
    pressed: ca.SX
    time: ca.SX
    grip: ca.SX
    pull: ca.SX
    a: ca.SX
    p: ca.SX
    slots: tuple[Slot, ...]
    rubbing: tuple[tuple[str, int], ...]
    torque: ca.SX
    force: ca.SX
    area: ca.SX
    more_area: ca.SX
    acceleration: ca.SX
    smooth_acceleration: ca.SX
    gripped_acceleration: ca.SX
    grips: ca.SX
    z_rate: ca.SX
    rest_state: ca.SX
    start_state: ca.SX
    rows: ca.SX
    per_impulse: ca.SX
    delassus: ca.SX
    gaps: ca.SX
    depths: ca.SX
    quickness: ca.SX
    bound: ca.SX
    rows_before: ca.SX
    drive: ca.SX
    kept: ca.SX

    @property
    def bound_here(self) -> ca.SX:
        """(nr,) ``bound`` of a step of nothing."""
        return ca.substitute(self.bound, ca.vertcat(self.q0, self.v0), ca.vertcat(self.q, self.v))


@lru_cache(maxsize=32)
def slots_of(form: Structure, laws: Laws) -> tuple[Slot, ...]:
    """Every law at every place of its kinds; their parameters follow the structure's own."""
    counts = form.law_places
    first = form.n_parameters
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
    a = ca.SX.sym("a", nj)
    p = ca.SX.sym("p", base + sum(len(slot.law.parameter_info()) for slot in slots))
    ny = m.inside.state.numel()
    nz = ny + sum(slot.law.n_states for slot in slots)
    z, pressure = ca.SX.sym("z", nz), ca.SX.sym("pressure", m.u.numel())
    q0, v0, time = ca.SX.sym("q0", nj), ca.SX.sym("v0", nj), ca.SX.sym("time")
    lengths, jacobian = m.lengths, m.jacobian
    coordinates = {"joint": (m.q, m.v), "actuator": (lengths, jacobian @ m.v)}
    exerted = {"joint": [ca.SX(0)] * nj, "actuator": [ca.SX(0)] * na}
    shares = [ca.SX(0)] * na
    rates = ca.vertsplit(m.inside.rate(pressure)) if ny else []
    rests = ca.vertsplit(m.inside.rest) if ny else []
    starts, quick = list(rests), list[ca.SX]()
    for slot in slots:
        law, kind, i = slot.law, slot.kind, slot.index
        own = _own(slot, p)
        x, rate = coordinates[kind][0][i], coordinates[kind][1][i]
        states = [z[len(rates) + k] for k in range(law.n_states)]
        own_rates = [ca.SX(r) for r in law.state_rate(x, rate, states, own)]
        if law.quick_states:
            quick += [ca.fabs(ca.jacobian(r, s)) for r, s in zip(own_rates, states, strict=True)]
        exerted[kind][i] = exerted[kind][i] + law.force(x, rate, states, own)
        if law.scales:
            shares[i] = shares[i] + law.more_area(x, m.rest_length[i], own)
        rates += own_rates
        rests += law.rest_state(x, own)
        starts += law.start_state(x, rate, time, own)
    force = ca.vertcat(*exerted["actuator"], ca.SX(0, 1))
    more_area = ca.vertcat(*shares, ca.SX(0, 1)) * m.area
    area = m.area + more_area
    drive = m.actuation.torque(pressure, area, force)
    at_joints, others = m.actuation.drive(pressure, area, force)
    for slot in slots:
        if slot.law.loads:
            by_drive = slot.law.force_of_drive((at_joints + others)[slot.index], _own(slot, p))
            exerted["joint"][slot.index] += by_drive
    torque = ca.vertcat(*exerted["joint"])
    rows, bounds = _rubbing(m, slots, p, (q0, v0), at_joints + others)
    rubbing = rubbing_places(form, laws)
    phi = ca.SX.sym("phi", len(rubbing))
    gradient = ca.vertcat(*[rows[row] for row in rubbing], ca.SX(0, nj))
    pressed = ca.SX.sym("pressed", len(m.limits))
    load = drive + torque + gradient.T @ phi
    rigid = m.mass, load - m.smooth_bias, m.held, m.limits
    free = acceleration = ldl_solve(*constrained(*rigid, *grips(m.limits, ca.SX(len(m.limits), 1))))
    if m.limits:
        acceleration = ldl_solve(*constrained(*rigid, *grips(m.limits, gaps(m.limits, free) > 0)))
    in_mode = grips(m.limits, pressed)
    smooth_acceleration = ldl_solve(*constrained(*rigid, *in_mode))
    grip, pull = ca.SX.sym("grip", len(m.limits)), ca.SX.sym("pull", len(m.limits))
    mass, loaded = constrained(*rigid, grip, pull)
    gripped_acceleration = ldl_solve(mass, loaded)
    reach = ca.horzcat(*[ldl_solve(mass, gradient[r, :].T) for r in range(len(rubbing))], ca.SX(nj, 0))
    outputs = [
        torque,
        force,
        area,
        more_area,
        acceleration,
        smooth_acceleration,
        gripped_acceleration,
        ca.vertcat(*in_mode),
        ca.vertcat(*rates, ca.SX(0, 1)),
        ca.vertcat(*rests, ca.SX(0, 1)),
        ca.vertcat(*starts, ca.SX(0, 1)),
        gradient @ m.v,
        reach,
        gradient @ reach,
        gaps(m.limits, a),
        ca.vertcat(*[limit.depth for limit in m.limits], ca.SX(0, 1)),
        _quickness(m, smooth_acceleration, pressed, quick),
        ca.vertcat(*[bounds[row] for row in rubbing], ca.SX(0, 1)),
        gradient @ v0,
        drive,
        ca.vertcat(m.inside.kept, z[ny:, 0]),
    ]
    symbols, places = ca.vertcat(m.p, m.inside.state), ca.vertcat(p[:base], z[:ny, 0])
    outputs = [ca.substitute(output, symbols, places) for output in outputs]
    return AugmentedModel(m.q, m.v, z, pressure, phi, q0, v0, pressed, time, grip, pull, a, p, slots, rubbing, *outputs)


Place = tuple[str, int]


def _own(slot: Slot, p: ca.SX) -> dict[str, ca.SX]:
    """The parameters of a law at a place, of all of a structure."""
    return {key: p[slot.first + k] for k, key in enumerate(slot.law.parameter_info())}


def rubbing_places(form: Structure, laws: Laws) -> tuple[Place, ...]:
    """(kind, index) of each row of dry friction: where the robot itself or a law can have it."""
    found = set(form.friction_at)
    found |= {(slot.kind, slot.index) for slot in slots_of(form, laws) if slot.law.dry}
    order = {"joint": 0, "actuator": 1}
    return tuple(sorted(found, key=lambda at: (order.get(at[0], 2), *at)))


def expressions(law: type[ForceEffect]) -> str:
    """What a law says, as text: two laws of one text are one."""
    x, rate, speed, load, rest, time = (ca.SX.sym(n) for n in ("x", "rate", "speed", "load", "rest", "time"))
    z = [ca.SX.sym(f"z{k}") for k in range(law.n_states)]
    p = {key: ca.SX.sym(key) for key in law.parameter_info()}
    said = [law.force(x, rate, z, p), *law.state_rate(x, rate, z, p), *law.rest_state(x, p)]
    said += law.start_state(x, rate, time, p)
    said += [law.dry_friction(x, speed, p)] if law.rubs else []
    said += [law.friction_of_load(load, speed, p), law.force_of_drive(load, p)] if law.loads else []
    said += [law.more_area(x, rest, p)] if law.scales else []
    kinds = (law.name, law.sits_at, law.n_states, law.quick_states, law.rubs, law.loads, law.scales, tuple(p))
    return repr((kinds, [str(ca.SX(part)) for part in said]))


def _rubbing(
    m: SymbolicModel, slots: Sequence[Slot], p: ca.SX, start: tuple[ca.SX, ca.SX], drive: ca.SX
) -> tuple[dict[Place, ca.SX], dict[Place, ca.SX]]:
    """Places that can have dry friction: ∂/∂q (1, nj) of each, and the greatest friction at means over a step."""
    nj, (q0, v0) = m.q.numel(), start
    rows: dict[Place, ca.SX] = {("joint", i): ca.SX.eye(nj)[i, :] for i in range(nj)}
    rows |= {("actuator", i): m.jacobian[i, :] for i in range(m.f.numel())}
    coordinates: dict[Place, ca.SX] = {("joint", i): m.q[i] for i in range(nj)}
    coordinates |= {("actuator", i): m.lengths[i] for i in range(m.f.numel())}
    bounds: dict[Place, ca.SX] = {}
    for own in m.rubbing:
        place = own.kind, own.index
        rows[place], bounds[place] = own.row, own.bound
    for slot in slots:
        law, place = slot.law, (slot.kind, slot.index)
        if not law.dry:
            continue
        own_p = _own(slot, p)
        speed = ca.fabs(ca.substitute(rows[place] @ m.v, m.v, (m.v + v0) / 2))
        x = ca.substitute(coordinates[place], m.q, (m.q + q0) / 2)
        more = law.dry_friction(x, speed, own_p) if law.rubs else ca.SX(0)
        if law.loads:
            more = more + law.friction_of_load(ca.fabs(drive[slot.index]), speed, own_p)
        bounds[place] = bounds.get(place, ca.SX(0)) + more
    return rows, bounds


def state_change(rate: ca.SX, state: ca.SX, dt: ca.SX) -> ca.SX:
    """What a law's state changes by over a step in which its coordinate's motion is held: rate·(e^{b·dt} − 1)/b.

    With b = ∂rate/∂state, as exponential integrators have it: exact for dz/dt = a + b·z, however long the step.
    """
    decay = ca.jacobian(rate, state) * dt
    if decay.is_zero():
        return dt * rate
    nearly_none = ca.fabs(decay) < NEARLY_NONE
    share = ca.expm1(decay) / ca.if_else(nearly_none, 1, decay)
    return dt * rate * ca.if_else(nearly_none, 1 + decay / 2, share)


NEARLY_NONE = 1e-6
"""A decay over a step below which its series is taken."""
SLIDING = {"joint": 0.02, "coupling": 0.02, "actuator": 0.002}
"""Rate on which three quarters of dry friction are counted where it is smoothed [rad/s, m/s]."""


def sliding_friction(m: AugmentedModel) -> ca.SX:
    """(nj,) torque of dry friction as a smooth function of the rates, −Gᵀ b tanh(G v / s) [N·m]; none at rest."""
    slow = ca.DM([SLIDING[kind] for kind, _ in m.rubbing])
    rubbing = m.bound_here * ca.tanh(m.rows / slow)
    return -ca.jacobian(m.rows, m.v).T @ rubbing


def _quickness(m: SymbolicModel, acceleration: ca.SX, pressed: ca.SX, laws: Sequence[ca.SX]) -> ca.SX:
    """How fast damping, the limits that are pressed and states of laws may make a motion, (1,) [1/s]."""

    def largest(matrix: ca.SX) -> ca.SX:
        # Of real eigenvalues above zero: at most the root of the sum of their squares.
        return ca.sqrt(ca.fmax(ca.trace(matrix @ matrix), 0.0))

    found = m.inside.quickness
    springs_of_limits = [
        limit.row.T * (pressed[k] * limit.force) for k, limit in enumerate(m.limits) if limit.force is not None
    ]
    if springs_of_limits:
        stiffness = -ca.jacobian(sum(springs_of_limits, ca.SX(m.q.numel(), 1)), m.q)
        springs = ca.horzcat(*[ldl_solve(m.mass, stiffness[:, i]) for i in range(m.q.numel())])
        found = ca.fmax(found, ca.fmax(largest(ca.jacobian(acceleration, m.v)), ca.sqrt(largest(springs))))
    for k, limit in enumerate(m.limits):
        if limit.force is None:
            found = ca.fmax(found, pressed[k] * limit.quickness)
    for one in laws:
        found = ca.fmax(found, one)
    return found


def law_parameters(
    slots: tuple[Slot, ...], effects: Sequence[Effect], joints: Sequence[str], actuators: Sequence[str]
) -> list[float]:
    """The slots' parameters for the effects that a model has; slots without an effect do nothing."""
    idle, places = _idle(slots)
    values = list(idle)
    for effect in effects:
        for kind, names in (("joint", joints), ("actuator", actuators)):
            if effect.location in names:
                own = places.get((type(effect), kind, list(names).index(effect.location)))
                if own is not None:
                    values[own] = effect.parameters().values()
    return values


def unknown_starts(effects: Sequence[Effect]) -> int:
    """How many states of effects may begin anywhere, see ``ForceEffect.begins_anywhere``."""
    return sum(effect.n_states for effect in _remembering(effects))


def unknown_states(
    slots: tuple[Slot, ...], effects: Sequence[Effect], joints: Sequence[str], actuators: Sequence[str]
) -> list[int]:
    """Which of the laws' states these are, effect by effect."""
    names, first, count = {"joint": joints, "actuator": actuators}, dict[tuple[type[Effect], str], int](), 0
    for slot in slots:
        first[slot.law, names[slot.kind][slot.index]] = count
        count += slot.law.n_states
    return [
        first[type(effect), effect.location] + k for effect in _remembering(effects) for k in range(effect.n_states)
    ]


def _remembering(effects: Sequence[Effect]) -> list[ForceEffect]:
    return [effect for effect in effects if isinstance(effect, ForceEffect) and effect.begins_anywhere]


@lru_cache(maxsize=32)
def _idle(slots: tuple[Slot, ...]) -> tuple[list[float], dict[tuple[type[Effect], str, int], slice]]:
    """Parameters with which no slot does anything, and (law, kind, index) → where a slot's own stand among them."""
    values: list[float] = []
    places: dict[tuple[type[Effect], str, int], slice] = {}
    for slot in slots:
        info = slot.law.parameter_info()
        places[slot.law, slot.kind, slot.index] = slice(len(values), len(values) + len(info))
        values += [slot.law.neutral.get(key, meta["high"]) for key, meta in info.items()]
    return values, places
