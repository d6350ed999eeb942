"""What the equations of a MuJoCo model look like: a tree of hinges and slides, its tendons, constraints and actuators.

What the form holds are fixed: how things hang together, where joints, sites and tendons sit. Numbers that may vary from
model to model (masses, gains, friction and so on) are read off an ``mujoco.MjModel`` by ``pack``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.types import Array

DUST = 1e-14
"""Entries of directions that are rounding errors."""
FAR = 1e300
"""Stands for no bound, so that nothing times infinity is formed."""
N_LINK, N_FLOAT, N_JOINT, N_TENDON, N_LIMIT, N_EQUALITY, N_ACTUATOR, N_MOTOR = 10, 4, 9, 10, 10, 12, 10, 40
"""How many numbers belong to each link, link with weight taken off, joint, tendon, limit, equality, and actuator with a
gain and a bias or with a law of its own."""
N_DRIVE = 8
"""Of a drive that may turn by itself: whether it does, its inertia, stiffness and damping of its spring, half its play,
stiffness and damping of the play's ends, and the inverse of the inertia that its motion against the joint has."""
FRICTION, TENDON_FRICTION = 8, 9
"""Place of dry friction among the numbers of a joint, and among those of a tendon."""
Vector = tuple[float, ...]
Dynamics = Literal["none", "integrator", "filter", "slew"]
Transmission = Literal["joint", "tendon", "site", "between", "crank"]


@dataclass(frozen=True)
class LinkForm:
    """How a joint's link hangs, see ``models.tree.Link``; ``turn`` row by row."""

    name: str
    parent: int
    place: Vector
    turn: Vector
    slides: bool
    reference: float


@dataclass(frozen=True)
class SpotForm:
    """A frame fixed to a link: where, and its axes row by row, in the link's frame."""

    link: int
    place: Vector
    turn: Vector


@dataclass(frozen=True)
class TendonForm:
    """A tendon: joints with their coefficients, or branches of sites with their divisors.

    Attributes:
        name: of the tendon.
        index: in the MuJoCo model.
        joints: (joint, coefficient) of a fixed tendon.
        branches: (divisor, spots along it) of a spatial one.
    """

    name: str
    index: int
    joints: tuple[tuple[int, float], ...] = ()
    branches: tuple[tuple[float, tuple[SpotForm, ...]], ...] = ()


@dataclass(frozen=True)
class LimitForm:
    """A coordinate with ends: of which kind, which one, and the power of its impedance."""

    kind: Literal["joint", "tendon"]
    index: int
    power: float


@dataclass(frozen=True)
class EqualityForm:
    """A coordinate that follows another by a polynomial, or stays where it is.

    Attributes:
        kind: of both coordinates.
        first: what follows.
        second: what is followed, −1 for none.
        index: of the constraint in the MuJoCo model.
        rest: what both are measured from.
        power: of the impedance.
    """

    kind: Literal["joint", "tendon"]
    first: int
    second: int
    index: int
    rest: tuple[float, float]
    power: float


@dataclass(frozen=True)
class ActuatorForm:
    """What an actuator acts on, and which terms its law has.

    Attributes:
        name: of the actuator.
        index: in the MuJoCo model.
        transmission: at a joint, along a tendon, at a site, at a site in another's frame, or by a slider and a crank.
        target: which joint or tendon.
        spots: of the sites.
        gear: (6,).
        rod: length of a crank's rod [m].
        law: gain and bias affine in length and rate, MuJoCo's ``pid``, or its ``dcmotor``.
        affine_gain: whether its gain depends on length and rate.
        dynamics: what comes between its command and its force.
        limited_act: whether that is clamped.
        control: the first of its commands.
        inputs: what its commands are.
        states: what it has of its own: ``integral``, ``temperature``, ``bristle``, ``current``.
        limited_voltage: whether a controller's voltage is.
    """

    name: str
    index: int
    transmission: Transmission
    target: int
    spots: tuple[SpotForm, ...]
    gear: Vector
    rod: float
    affine_gain: bool
    dynamics: Dynamics
    limited_act: bool
    law: Literal["affine", "pid", "dcmotor"] = "affine"
    control: int = 0
    inputs: tuple[str, ...] = ("command",)
    states: tuple[str, ...] = ()
    limited_voltage: bool = False


@dataclass(frozen=True, eq=False)
class TreeForm:
    """What the equations of a MuJoCo model look like; equal where all of it is.

    Attributes:
        links: one for each joint, in MuJoCo's order.
        bodies: (body, link, place, turn row by row) of all that moves, its frame in the link's.
        tendons: those that do something.
        limits: of joints and tendons.
        equalities: of joints and tendons.
        actuators: in MuJoCo's order.
        rubbing: tendons, as indices into ``tendons``, that may have dry friction.
        clamped: (joint, whether its share of gravity compensation counts) where the actuators' sum is limited.
        clamped_tendons: tendons, as indices into ``tendons``, where it is.
        floats: links from which weight is taken off.
        off: what the XML's flags switch off.
        flexible: whether drives of joints may turn by themselves, behind a spring or with play.
    """

    links: tuple[LinkForm, ...]
    bodies: tuple[tuple[int, int, Vector, Vector], ...]
    tendons: tuple[TendonForm, ...]
    limits: tuple[LimitForm, ...]
    equalities: tuple[EqualityForm, ...]
    actuators: tuple[ActuatorForm, ...]
    rubbing: tuple[int, ...]
    clamped: tuple[tuple[int, bool], ...]
    clamped_tendons: tuple[int, ...]
    floats: tuple[int, ...]
    off: frozenset[str]
    flexible: bool = False
    key: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        parts = {k: v for k, v in vars(self).items() if k not in ("key", "off")}
        object.__setattr__(self, "key", repr((sorted(self.off), parts)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TreeForm) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    @cached_property
    def layout(self) -> dict[str, range]:
        """Name of a block such as ``link 2`` → where its numbers stand in the parameter vector."""
        found, begin = {}, 0
        for name, count in self._blocks():
            found[name] = range(begin, begin + count)
            begin += count
        return found

    def _blocks(self) -> Iterator[tuple[str, int]]:
        yield "gravity", 3
        yield from ((f"link {i}", N_LINK) for i in range(len(self.links)))
        yield from ((f"float {i}", N_FLOAT) for i in self.floats)
        yield from ((f"joint {i}", N_JOINT) for i in range(len(self.links)))
        yield from ((f"tendon {i}", N_TENDON) for i in range(len(self.tendons)))
        yield from ((f"limit {i}", N_LIMIT) for i in range(len(self.limits)))
        yield from ((f"equality {i}", N_EQUALITY) for i in range(len(self.equalities)))
        sizes = (N_ACTUATOR if a.law == "affine" else N_MOTOR for a in self.actuators)
        yield from ((f"actuator {i}", size) for i, size in enumerate(sizes))
        yield from ((f"drive {i}", N_DRIVE) for i in range(len(self.links)) if self.flexible)
        yield from ((f"clamp {j}", 2) for j, _ in self.clamped)
        yield from ((f"clamp tendon {t}", 2) for t in self.clamped_tendons)

    @property
    def n_numbers(self) -> int:
        """How many entries the parameter vector has."""
        return max(block.stop for block in self.layout.values())

    @cached_property
    def friction_at(self) -> dict[tuple[str, int], int]:
        """(kind, index) of places at which the robot itself can have dry friction → where its size stands."""
        if "frictionloss" in self.off:
            return {}
        found = {("joint", i): self.layout[f"joint {i}"][FRICTION] for i in range(len(self.links))}
        return found | {("tendon", t): self.layout[f"tendon {t}"][TENDON_FRICTION] for t in self.rubbing}

    def unlimited(self, numbers: Array) -> Array:
        """(n_numbers,) the same numbers with no bounds of forces."""
        found = np.array(numbers)
        for i, own in enumerate(self.actuators):
            first = self.layout[f"actuator {i}"][6 if own.law == "affine" else 30]
            found[first : first + 2] = -FAR, FAR
        for block, places in self.layout.items():
            if block.startswith("clamp"):
                found[list(places)] = -FAR, FAR
        return found

    @property
    def n_inside(self) -> int:
        """How many states the robot has beside its motion."""
        return sum(len(a.states) for a in self.actuators) + (2 * len(self.links) if self.flexible else 0)

    @property
    def n_commands(self) -> int:
        """How many commands its actuators take."""
        return sum(len(a.inputs) for a in self.actuators)

    @property
    def law_places(self) -> dict[str, int]:
        """Kind of place → how many there are at which force laws act."""
        return {"joint": len(self.links), "actuator": 0}


SWITCHES = ("constraint", "equality", "frictionloss", "limit", "spring", "damper", "gravity", "clampctrl", "actuation")


def switched_off(model: Any) -> frozenset[str]:
    """Which of ``SWITCHES`` a MuJoCo model has off; what is a constraint is off where all constraints are."""
    found = {
        name
        for name in SWITCHES
        if int(model.opt.disableflags) & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    }
    return frozenset(found | ({"equality", "frictionloss", "limit"} if "constraint" in found else set()))


def obstacles(model: Any) -> list[str]:
    """What a MuJoCo model has that these equations cannot hold, a phrase each; none where they hold it all.

    Contacts are not looked at: whether there are any depends on what the robot does.
    """
    m, found = model, []
    kinds = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball"}
    found += [f"{kinds[int(t)]} joint {m.joint(i).name or i!r}" for i, t in enumerate(m.jnt_type) if int(t) in kinds]
    found += [f"plastic spring of joint {m.joint(i).name!r}" for i in np.flatnonzero(m.jnt_plasticadr >= 0)]
    found += [f"plastic spring of tendon {m.tendon(int(i)).name!r}" for i in np.flatnonzero(m.tendon_plasticadr >= 0)]
    off = switched_off(m)
    wrapping = {int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)}
    for t in range(m.ntendon):
        path = m.wrap_type[m.tendon_adr[t] : m.tendon_adr[t] + m.tendon_num[t]]
        if wrapping & set(map(int, path)):
            found.append(f"tendon {m.tendon(t).name or t!r} that wraps around a geom")
    usable = {int(mujoco.mjtEq.mjEQ_JOINT): "joint", int(mujoco.mjtEq.mjEQ_TENDON): "tendon"}
    for e in range(m.neq) if "equality" not in off else ():
        if m.eq_active0[e] and int(m.eq_type[e]) not in usable:
            kind = mujoco.mjtEq(int(m.eq_type[e])).name.removeprefix("mjEQ_").lower()
            found.append(f"equality constraint {m.equality(e).name or e!r} of kind {kind}")
    found += list(_actuator_obstacles(m))
    for count, what in (("nflex", "a flex"), ("nplugin", "a plugin")):
        if getattr(m, count):
            found.append(what)
    if m.opt.density > 0 or m.opt.viscosity > 0:
        found.append("a fluid around it (density, viscosity)")
    for flag in ("OVERRIDE", "DIAGEXACT", "SLEEP"):
        if int(m.opt.enableflags) & int(getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}")):
            found.append(f'<flag {flag.lower()}="enable"/>')
    if int(m.opt.disableactuator):
        found.append("actuators that are switched off by group")
    return found


def _actuator_obstacles(m: Any) -> Iterator[str]:
    gains, biases, kinds = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtTrn
    simple = {
        (int(g), int(b)) for g in (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE) for b in (0, int(biases.mjBIAS_AFFINE))
    }
    simple |= {
        (int(gains.mjGAIN_PID), int(biases.mjBIAS_AFFINE)),
        (int(gains.mjGAIN_DCMOTOR), int(biases.mjBIAS_DCMOTOR)),
    }
    transmissions = {
        int(kind)
        for kind in (
            kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT, kinds.mjTRN_TENDON, kinds.mjTRN_SITE, kinds.mjTRN_SLIDERCRANK
        )
    }  # fmt: skip
    dynamics = {int(d) for d in _DYNAMICS}
    for i in range(m.nactuator):
        who = f"actuator {m.actuator(i).name or i!r}"
        if int(m.actuator_trntype[i]) not in transmissions:
            yield f"{who} with the transmission {mujoco.mjtTrn(int(m.actuator_trntype[i])).name[6:].lower()}"
        elif m.actuator_plugin[i] >= 0:
            yield f"{who}, a plugin"
        elif (int(m.actuator_gaintype[i]), int(m.actuator_biastype[i])) not in simple:
            gain = mujoco.mjtGain(int(m.actuator_gaintype[i])).name.removeprefix("mjGAIN_").lower()
            bias = mujoco.mjtBias(int(m.actuator_biastype[i])).name.removeprefix("mjBIAS_").lower()
            yield f"{who} with the gain {gain} and the bias {bias}"
        elif _winds(m, i):
            yield f"{who}, a servo of a direction, whose goal may be any of many turns"
        elif int(m.actuator_dyntype[i]) not in dynamics:
            yield f"{who} with the dynamics {mujoco.mjtDyn(int(m.actuator_dyntype[i])).name[6:].lower()}"


def _winds(m: Any, i: int) -> bool:
    """Whether MuJoCo takes the turn of an actuator's goal that is nearest."""
    site = int(m.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_SITE) and int(m.actuator_trnid[i, 1]) >= 0
    if not site or m.actuator_gear[int(m.actuator_outadr[i]), :3].any():
        return False
    if int(m.actuator_gaintype[i]) in (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR)):
        return bool(int(m.actuator_ctrlspec[i]) & 1)
    stiffness = m.actuator_biasprm[i, 1]
    return bool(stiffness and m.actuator_gainprm[i, 0] == -stiffness)


_DYNAMICS: dict[Any, Dynamics] = {
    mujoco.mjtDyn.mjDYN_NONE: "none",
    mujoco.mjtDyn.mjDYN_INTEGRATOR: "integrator",
    mujoco.mjtDyn.mjDYN_FILTER: "filter",
    mujoco.mjtDyn.mjDYN_FILTEREXACT: "filter",
    mujoco.mjtDyn.mjDYN_PID: "none",
    mujoco.mjtDyn.mjDYN_DCMOTOR: "none",
}
INPUTS = {1: "pos", 2: "vel", 4: "ff", 8: "voltage"}
"""Bits of MuJoCo's ``actuator_ctrlspec`` of pid and dcmotor."""


def form_of(model: Any, flexible: bool = False) -> TreeForm:
    """The form of an ``mujoco.MjModel``.

    Args:
        model: whose.
        flexible: whether drives of its joints may turn by themselves.

    Raises:
        ModelError: where it has what the equations cannot hold.
    """
    if wrong := obstacles(model):
        raise ModelError(f"the equations cannot hold {wrong[0]}")
    off = switched_off(model)
    links, frames = _links(model)
    bodies = tuple(
        (b, link, _snapped(place), _snapped(turn))
        for b, (link, place, turn) in enumerate(frames)
        if link >= 0 and (model.body_mass[b] > 0 or model.body_inertia[b].max() > 0)
    )
    tendons = tuple(_tendon(model, t, frames) for t in range(model.ntendon))
    limits: list[LimitForm] = []
    if "limit" not in off:
        limits += [
            LimitForm("joint", j, float(model.jnt_solimp[j, 4])) for j in range(model.njnt) if model.jnt_limited[j]
        ]
        limits += [
            LimitForm("tendon", t, float(model.tendon_solimp_lim[t, 4]))
            for t in range(model.ntendon)
            if model.tendon_limited[t]
        ]
    return TreeForm(
        links,
        bodies,
        tendons,
        tuple(limits),
        () if "equality" in off else tuple(_equalities(model)),
        tuple(_actuator(model, i, frames) for i in range(model.nactuator)),
        () if "frictionloss" in off else tuple(int(t) for t in np.flatnonzero(model.tendon_frictionloss > 0)),
        tuple((int(j), bool(model.jnt_actgravcomp[j])) for j in np.flatnonzero(model.jnt_actfrclimited)),
        tuple(int(t) for t in np.flatnonzero(model.tendon_actfrclimited)),
        tuple(sorted({link for b, link, *_ in bodies if model.body_gravcomp[b] != 0})),
        off,
        flexible,
    )


def quaternion_matrix(quaternion: Array) -> Array:
    """(3, 3) of a unit quaternion (4,)."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def _snapped(values: Array) -> Vector:
    """Flat, with rounding errors around 0 and ±1 taken off, so that generated code leaves those terms out."""
    flat = np.array(values, dtype=np.float64).ravel()
    for whole in (0.0, 1.0, -1.0):
        flat[np.abs(flat - whole) < DUST] = whole
    return tuple(float(v) for v in flat)


def _upright(axis: Array) -> Array:
    """(3, 3) a rotation whose third column is an axis; its entries are 0 and ±1 where that can be."""
    z = np.array(_snapped(axis / np.linalg.norm(axis)))
    x = np.roll(np.eye(3)[int(np.argmax(np.abs(z)))], 1)
    x = x - z * (z @ x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


Frame = tuple[int, Array, Array]
"""Link, place and axes in the link's frame of a body's frame."""


def _links(m: Any) -> tuple[tuple[LinkForm, ...], list[Frame]]:
    """The links, and for each body the link that it is fixed to and its frame there."""
    links: list[LinkForm] = []
    frames: list[Frame] = [(-1, np.zeros(3), np.eye(3))]
    for b in range(1, m.nbody):
        link, place, turn = frames[int(m.body_parentid[b])]
        place = place + turn @ m.body_pos[b]
        turn = turn @ quaternion_matrix(m.body_quat[b])
        for j in range(int(m.body_jntadr[b]), int(m.body_jntadr[b]) + int(m.body_jntnum[b])):
            slides = int(m.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            stand, anchor = _upright(m.jnt_axis[j]), np.zeros(3) if slides else np.array(m.jnt_pos[j])
            links.append(
                LinkForm(
                    m.joint(j).name,
                    link,
                    _snapped(place + turn @ anchor),
                    _snapped(turn @ stand),
                    slides,
                    float(m.qpos0[m.jnt_qposadr[j]]),
                )
            )
            link, turn = len(links) - 1, stand.T
            place = -turn @ anchor
        frames.append((link, place, turn))
    return tuple(links), frames


def _spot(m: Any, site: int, frames: Sequence[Frame]) -> SpotForm:
    link, place, turn = frames[int(m.site_bodyid[site])]
    own = turn @ quaternion_matrix(m.site_quat[site])
    return SpotForm(link, _snapped(place + turn @ m.site_pos[site]), _snapped(own))


def _tendon(m: Any, t: int, frames: Sequence[Frame]) -> TendonForm:
    path = range(int(m.tendon_adr[t]), int(m.tendon_adr[t]) + int(m.tendon_num[t]))
    if int(m.wrap_type[path[0]]) == int(mujoco.mjtWrap.mjWRAP_JOINT):
        return TendonForm(m.tendon(t).name, t, joints=tuple((int(m.wrap_objid[k]), float(m.wrap_prm[k])) for k in path))
    branches: list[tuple[float, list[SpotForm]]] = [(1.0, [])]
    for k in path:
        if int(m.wrap_type[k]) == int(mujoco.mjtWrap.mjWRAP_PULLEY):
            branches.append((float(m.wrap_prm[k]), []))
        else:
            branches[-1][1].append(_spot(m, int(m.wrap_objid[k]), frames))
    return TendonForm(m.tendon(t).name, t, branches=tuple((divisor, tuple(s)) for divisor, s in branches if len(s) > 1))


def _equalities(m: Any) -> Iterator[EqualityForm]:
    for e in range(m.neq):
        if not m.eq_active0[e]:
            continue
        first, second = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
        joint = int(m.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT)
        rest = [
            0.0 if k < 0 else float(m.qpos0[m.jnt_qposadr[k]] if joint else m.tendon_length0[k])
            for k in (first, second)
        ]
        yield EqualityForm(
            "joint" if joint else "tendon", first, second, e, (rest[0], rest[1]), float(m.eq_solimp[e, 4])
        )


def _actuator(m: Any, i: int, frames: Sequence[Frame]) -> ActuatorForm:
    kinds, (first, second) = mujoco.mjtTrn, (int(k) for k in m.actuator_trnid[i])
    kind = int(m.actuator_trntype[i])
    spots: tuple[SpotForm, ...] = ()
    transmission: Transmission = "joint"
    if kind == int(kinds.mjTRN_TENDON):
        transmission = "tendon"
    elif kind == int(kinds.mjTRN_SLIDERCRANK):
        transmission, spots = "crank", (_spot(m, first, frames), _spot(m, second, frames))
    elif kind == int(kinds.mjTRN_SITE):
        transmission = "site" if second < 0 else "between"
        spots = tuple(_spot(m, k, frames) for k in (first, second) if k >= 0)
    law: Literal["affine", "pid", "dcmotor"] = "affine"
    gain, spec = int(m.actuator_gaintype[i]), int(m.actuator_ctrlspec[i])
    inputs: tuple[str, ...] = ("command",)
    states: tuple[str, ...] = ()
    own = m.actuator_dynprm[i]
    dynamics = _DYNAMICS[mujoco.mjtDyn(int(m.actuator_dyntype[i]))]
    if gain in (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR)):
        law = "pid" if gain == int(mujoco.mjtGain.mjGAIN_PID) else "dcmotor"
        inputs = tuple(name for bit, name in INPUTS.items() if spec & bit)
        integral = m.actuator_gainprm[i, 0 if law == "pid" else 5] > 0
        slewed = own[1 if law == "pid" else 7] > 0
        dynamics = "slew" if slewed and inputs else "none"
        further = (("temperature", own[2] > 0), ("bristle", own[5] > 0), ("current", own[0] > 0))
        states = ("integral",) if integral else ()
        states += tuple(name for name, there in further if there) if law == "dcmotor" else ()
    return ActuatorForm(
        m.actuator(i).name,
        i,
        transmission,
        first,
        spots,
        tuple(float(g) for g in m.actuator_gear[int(m.actuator_outadr[i])]),
        float(m.actuator_cranklength[i]),
        gain == int(mujoco.mjtGain.mjGAIN_AFFINE),
        dynamics,
        bool(m.actuator_actlimited[i]),
        law,
        int(m.actuator_ctrladr[i]),
        inputs,
        states,
        law == "dcmotor" and bool(m.actuator_gainprm[i, 7] > 0),
    )
