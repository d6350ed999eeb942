"""What the equations of a MuJoCo model look like: a tree of hinges and slides, its tendons, constraints and actuators.

What the form holds are fixed: how things hang together, where joints, sites and tendons sit. Numbers that may vary from
model to model (masses, gains, friction and so on) are read off an ``mujoco.MjModel`` by ``pack``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from equimus_ctrl.types import Array

FAR = 1e300
"""Stands for no bound, so that nothing times infinity is formed."""
N_LINK, N_FLOAT, N_JOINT, N_TENDON, N_LIMIT, N_EQUALITY, N_ACTUATOR, N_MOTOR = 10, 4, 9, 10, 10, 12, 10, 40
"""Parameters of each link, link with weight taken off, joint, tendon, limit, equality, and actuator with a gain and a
bias or with a law of its own."""
N_TETHER = 8
"""Of a spring between a link and the room: stiffness, free length, its end in the link's frame, its end in the room."""
N_SURFACE, N_TOUCH = 11, 4
"""Of a surface in the room: the way up, its height, stiffness, damping and impedance of contact, the inverse inertia of
what touches it. Of each link: whether it may touch it, and its point there."""
N_COUPLING = 4
"""Of friction over two links: the sign with which the second's rate counts for the dry one, its size, and the damping
of the sum and of the difference of the rates."""
N_DRIVE = 8
"""Of a drive that may turn by itself: whether it does, its inertia, stiffness and damping of its spring, half its play,
stiffness and damping of the play's ends, and the inverse of the inertia that its motion against the joint has."""
FRICTION, TENDON_FRICTION = 8, 9
"""Place of dry friction among the parameters of a joint, and among those of a tendon."""
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
        hooks: (body, link, place, turn row by row) of all that moves, its frame in the link's, where it may be tethered
            or touch a surface; none where it may not.
        tethered: whether springs to points of the room may hang on it.
        surfaced: whether a point of it may touch a level surface in the room.
        coupled: pairs of links, the second carried by the first, over which friction may act.
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
    hooks: tuple[tuple[int, int, Vector, Vector], ...] = ()
    tethered: bool = False
    surfaced: bool = False
    coupled: tuple[tuple[int, int], ...] = ()
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
        """Name of a block such as ``link 2`` → where its parameters stand in the parameter vector."""
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
        yield from ((f"tether {i}", N_TETHER) for i in range(len(self.links)) if self.tethered)
        if self.surfaced:
            yield "surface", N_SURFACE
            yield from ((f"touch {i}", N_TOUCH) for i in range(len(self.links)))
        yield from ((f"coupling {k}", N_COUPLING) for k in range(len(self.coupled)))
        yield from ((f"clamp {j}", 2) for j, _ in self.clamped)
        yield from ((f"clamp tendon {t}", 2) for t in self.clamped_tendons)

    @property
    def n_links(self) -> int:
        """How many links move."""
        return len(self.links)

    @property
    def n_parameters(self) -> int:
        """How many entries the parameter vector has."""
        return max(block.stop for block in self.layout.values())

    @cached_property
    def friction_at(self) -> dict[tuple[str, int], int]:
        """(kind, index) of places at which the robot itself can have dry friction → where its size stands."""
        if "frictionloss" in self.off:
            return {}
        found = {("joint", i): self.layout[f"joint {i}"][FRICTION] for i in range(len(self.links))}
        found |= {("tendon", t): self.layout[f"tendon {t}"][TENDON_FRICTION] for t in self.rubbing}
        return found | {("coupling", k): self.layout[f"coupling {k}"][1] for k in range(len(self.coupled))}

    def unlimited(self, parameters: Array, commands: bool = False) -> Array:
        """(n_parameters,) the same parameters with no bounds of forces, nor of commands where that is asked."""
        found = np.array(parameters)
        for i, own in enumerate(self.actuators):
            plain = own.law == "affine"
            first = self.layout[f"actuator {i}"][6 if plain else 30]
            pairs = 1 + commands * (1 if plain else len(own.inputs))  # the force's, then one for each command
            found[first : first + 2 * pairs] = [-FAR, FAR] * pairs
        for block, places in self.layout.items():
            if block.startswith("clamp"):
                found[list(places)] = -FAR, FAR
        return found

    @property
    def stiff(self) -> bool:
        """As of any form: drives, dry friction and ends of ranges are as stiff as a file has them."""
        return True

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
