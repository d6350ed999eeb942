"""The equations of motion of a tree of rigid links, in CasADi: the one place where rigid-body mechanics stands.

Recursive Newton–Euler for the bias and composite rigid bodies for the mass matrix, in the links' own frames
(Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapters 5 and 6):

    M(q) a + h(q, v) = τ

Before that, inertial parameters go to the parent where both move alike (Gautier & Khalil, "Direct calculation of
minimum set of inertial parameters of serial robots", 1990): the equations stay the same and become a third shorter.

Every joint turns about, or slides along, the third axis of its link's frame. Beside the links there may be mass that is
spread evenly along a straight line between two points, as of elastic actuators (Zhu et al., "EquiMus", 2025), and the
base may translate such that a point of a link rests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca

BASE = -1
"""The parent of links that hang on the base."""


@dataclass(frozen=True, eq=False)
class Link:
    """A link and the joint that carries it; symbols or numbers.

    Attributes:
        parent: index of the link that carries it, or BASE.
        place: (3,) origin of its frame where the joint is at its reference, in the parent's frame [m].
        turn: (3, 3) its axes there, as columns, in the parent's frame.
        slides: whether the joint slides along the frame's third axis, else it turns about it.
        mass: [kg].
        first: (3,) mass times centre of mass, in its own frame [kg·m].
        inertia: (6,) about the frame's origin: xx, yy, zz, xy, xz, yz [kg·m²].
        armature: inertia of what turns with the joint's coordinate alone [kg·m² or kg].
        reference: the joint's coordinate at which the frame stands as said [rad or m].
        floated: (4,) mass and first moment whose weight is taken off, None for none.
    """

    parent: int
    place: ca.SX
    turn: ca.SX
    slides: bool
    mass: ca.SX
    first: ca.SX
    inertia: ca.SX
    armature: ca.SX = field(default_factory=lambda: ca.SX(0))
    reference: float = 0.0
    floated: ca.SX | None = None


@dataclass(frozen=True, eq=False)
class Spot:
    """A point fixed to a link: its index or BASE, and (3,) where in the link's frame [m]."""

    link: int
    place: ca.SX


@dataclass(frozen=True, eq=False)
class SpreadMass:
    """Mass spread evenly along the line between two points [kg]."""

    first: Spot
    second: Spot
    mass: ca.SX


@dataclass(frozen=True, eq=False)
class Tree:
    """A tree of links.

    Attributes:
        links: parents before children.
        gravity: (3,) in the base's frame [m/s²].
        spread: mass along lines.
        pinned: a point that rests while the base translates; None where the base rests.
        base_mass: of the base, which counts where it translates [kg].
    """

    links: Sequence[Link]
    gravity: ca.SX
    spread: Sequence[SpreadMass] = ()
    pinned: Spot | None = None
    base_mass: ca.SX = field(default_factory=lambda: ca.SX(0))


class Frames:
    """Where links are, and how they move without joint accelerations.

    Args:
        tree: whose.
        q: (n,) joint coordinates.
        v: (n,) their rates.
        start: (3,) acceleration of the base [m/s²].
    """

    def __init__(self, tree: Tree, q: ca.SX, v: ca.SX, start: ca.SX) -> None:
        self.tree, self.q, self.v = tree, q, v
        self.rotation: list[ca.SX] = []
        self.origin: list[ca.SX] = []
        self.axis: list[ca.SX] = []
        self.spin: list[ca.SX] = []  # angular velocities
        self.turning: list[ca.SX] = []  # angular accelerations
        self.rise: list[ca.SX] = []  # accelerations of the origins
        self._start = start
        for i, link in enumerate(tree.links):
            basis, corner, spin, turning, rise = self.of(link.parent)
            stand, arm = basis @ link.turn, basis @ link.place
            axis, coordinate = stand[:, 2], q[i] - link.reference
            here, way = corner + arm, arm
            if link.slides:
                way = arm + axis * coordinate
                here = corner + way
            rise = rise + ca.cross(turning, way) + ca.cross(spin, ca.cross(spin, way))
            if link.slides:
                rise = rise + 2 * v[i] * ca.cross(spin, axis)
            else:
                c, s = ca.cos(coordinate), ca.sin(coordinate)
                stand = ca.horzcat(stand[:, 0] * c + stand[:, 1] * s, stand[:, 1] * c - stand[:, 0] * s, axis)
                turning = turning + ca.cross(spin, axis) * v[i]
                spin = spin + axis * v[i]
            self.rotation.append(stand)
            self.origin.append(here)
            self.axis.append(axis)
            self.spin.append(spin)
            self.turning.append(turning)
            self.rise.append(rise)

    def of(self, link: int) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """Axes, origin, angular velocity, angular acceleration and acceleration of a link's frame, or of the base."""
        if link == BASE:
            return ca.SX.eye(3), ca.SX(3, 1), ca.SX(3, 1), ca.SX(3, 1), self._start
        return self.rotation[link], self.origin[link], self.spin[link], self.turning[link], self.rise[link]

    def position(self, spot: Spot) -> ca.SX:
        """(3,) relative to the base [m]."""
        rotation, origin, *_ = self.of(spot.link)
        return origin + rotation @ spot.place

    def acceleration(self, spot: Spot) -> ca.SX:
        """(3,) without joint accelerations [m/s²]."""
        rotation, _, spin, turning, rise = self.of(spot.link)
        arm = rotation @ spot.place
        return rise + ca.cross(turning, arm) + ca.cross(spin, ca.cross(spin, arm))

    def carriers(self, link: int) -> list[int]:
        """Joints that move a link, from it to the base."""
        found = []
        while link != BASE:
            found.append(link)
            link = self.tree.links[link].parent
        return found

    def jacobian(self, spot: Spot) -> ca.SX:
        """(3, n) ∂position/∂q."""
        at = self.position(spot)
        rows = ca.SX(3, len(self.tree.links))
        for i in self.carriers(spot.link):
            rows[:, i] = self.axis[i] if self.tree.links[i].slides else ca.cross(self.axis[i], at - self.origin[i])
        return rows

    def turn_jacobian(self, link: int) -> ca.SX:
        """(3, n) angular velocity by joint rates."""
        rows = ca.SX(3, len(self.tree.links))
        for i in self.carriers(link):
            if not self.tree.links[i].slides:
                rows[:, i] = self.axis[i]
        return rows


@dataclass(frozen=True, eq=False)
class Equations:
    """M(q) a + bias = τ.

    Attributes:
        mass: (n, n) M.
        bias: (n,) Coriolis, centrifugal and gravity terms.
        floated: (n,) what holds the weight that is taken off; it is not in ``bias`` [N·m or N].
        frames: where the links are.
    """

    mass: ca.SX
    bias: ca.SX
    floated: ca.SX
    frames: Frames


class _Step:
    """From a link's frame to that of its parent and back.

    Args:
        link: whose.
        coordinate: of its joint, from its reference.
    """

    def __init__(self, link: Link, coordinate: ca.SX) -> None:
        self.link = link
        self.c, self.s = ca.cos(coordinate), ca.sin(coordinate)
        self.way = link.place + link.turn[:, 2] * coordinate if link.slides else link.place
        self.about_x = link.turn[0, 0].is_one()

    def down(self, x: ca.SX) -> ca.SX:
        """(3,) a vector of the parent's frame in the link's."""
        y = self.link.turn.T @ x
        if self.link.slides:
            return y
        return ca.vertcat(self.c * y[0] + self.s * y[1], self.c * y[1] - self.s * y[0], y[2])

    def up(self, x: ca.SX) -> ca.SX:
        """(3,) a vector of the link's frame in the parent's."""
        if not self.link.slides:
            x = ca.vertcat(self.c * x[0] - self.s * x[1], self.s * x[0] + self.c * x[1], x[2])
        return self.link.turn @ x

    def inertia_up(self, six: ca.SX, first: ca.SX, mass: ca.SX) -> tuple[ca.SX, ca.SX]:
        """First moment and inertia (6,) about the parent's origin, in its frame."""
        if not self.link.slides:
            six = _turned(six, self.c, self.s, "z")
        turn = self.link.turn
        six = _turned(six, turn[1, 1], turn[2, 1], "x") if self.about_x else _six(turn @ symmetric(six) @ turn.T)
        moved = self.up(first)
        return moved + mass * self.way, six + _of_shift(self.way, moved, mass)


def _turned(six: ca.SX, c: ca.SX, s: ca.SX, axis: str) -> ca.SX:
    """(6,) R·I·Rᵀ of an inertia, R turning about one of the axes x and z by an angle with cosine c and sine s."""
    xx, yy, zz, xy, xz, yz = ca.vertsplit(six)
    a, b, across, first, second = (xx, yy, xy, xz, yz) if axis == "z" else (yy, zz, yz, xy, xz)
    turned = s * (a - b) + 2 * c * across
    more = s * turned
    a, b, across = a - more, b + more, c * turned - across
    first, second = c * first - s * second, s * first + c * second
    return ca.vertcat(a, b, zz, across, first, second) if axis == "z" else ca.vertcat(xx, a, b, first, second, across)


def _of_shift(way: ca.SX, first: ca.SX, mass: ca.SX) -> ca.SX:
    """(6,) what an inertia gains about a point from which its own origin is at ``way``."""
    g = first + (mass / 2) * way
    x, y, z = (2 * way[k] * g[k] for k in range(3))
    xy, xz, yz = (-way[j] * g[k] - way[k] * g[j] for j, k in ((0, 1), (0, 2), (1, 2)))
    return ca.vertcat(y + z, x + z, x + y, xy, xz, yz)


def _grouped(tree: Tree) -> tuple[list[ca.SX], list[ca.SX], list[ca.SX], ca.SX]:
    """Mass, first moment and inertia of each link, and mass of the base, with as much as can be further to the base.

    What is spread about a hinge's axis such that turning leaves it where it is — mass on the axis, an inertia
    (y, y, 0) — moves as if it were fixed to the parent, and so does the inertia of a link that slides.
    """
    links = tree.links
    mass, first, inertia = ([getattr(link, key) for link in links] for key in ("mass", "first", "inertia"))
    base = tree.base_mass
    for i in reversed(range(len(links))):
        link, up, none = links[i], links[i].parent, ca.SX(1, 1)
        axis = link.turn[:, 2]
        if link.slides:
            given, fixed, moment = none, ca.SX(3, 1), _six(link.turn @ symmetric(inertia[i]) @ link.turn.T)
            inertia[i] = ca.SX(6, 1)
        else:
            (hx, hy, hz), (xx, yy, zz, xy, xz, yz) = ca.vertsplit(first[i]), ca.vertsplit(inertia[i])
            given, along = mass[i], hz * axis
            moment = yy * _six(ca.SX.eye(3) - axis @ axis.T) + _of_shift(link.place, along, given)
            fixed = along + given * link.place
            mass[i], first[i] = none, ca.vertcat(hx, hy, none)
            inertia[i] = ca.vertcat(xx - yy, none, zz, xy, xz, yz)
        if up == BASE:
            base = base + given
        else:
            mass[up], first[up], inertia[up] = mass[up] + given, first[up] + fixed, inertia[up] + moment
    return mass, first, inertia, base


def equations(tree: Tree, q: ca.SX, v: ca.SX) -> Equations:
    """The equations of motion of a tree, worked out in the links' own frames.

    Args:
        tree: of n joints.
        q: (n,) joint coordinates [rad or m].
        v: (n,) their rates.
    """
    n, links = len(tree.links), tree.links
    start = -tree.gravity
    if tree.pinned is not None:
        # The base accelerates against the pinned point.
        start = start - Frames(tree, q, v, ca.SX(3, 1)).acceleration(tree.pinned)
    frames = Frames(tree, q, v, start)
    steps = [_Step(link, q[i] - link.reference) for i, link in enumerate(links)]
    mass, first, inertia, base_mass = _grouped(tree)
    force, moment = _inertial(tree, steps, (mass, first, inertia), v, start)
    matrix, momentum = ca.SX(n, n), ca.SX(3, n)
    rest = base_mass * start  # force on the base
    bias: list[ca.SX] = [ca.SX(0)] * n
    for i in reversed(range(n)):
        link, step = links[i], steps[i]
        bias[i] = force[i][2] if link.slides else moment[i][2]
        h, six, none = first[i], inertia[i], ca.SX(1, 1)
        f = ca.vertcat(none, none, mass[i]) if link.slides else ca.vertcat(-h[1], h[0], none)
        t = ca.vertcat(h[1], -h[0], none) if link.slides else ca.vertcat(six[4], six[5], six[2])
        matrix[i, i] += (f if link.slides else t)[2] + link.armature
        k = i
        while True:
            f, t = steps[k].up(f), steps[k].up(t)
            t += ca.cross(steps[k].way, f)
            k = links[k].parent
            if k == BASE:
                break
            entry = (f if links[k].slides else t)[2]
            matrix[i, k] += entry
            matrix[k, i] += entry
        momentum[:, i] += f
        carried_force = step.up(force[i])
        if link.parent == BASE:
            rest += carried_force
            continue
        up = link.parent
        force[up] += carried_force
        moment[up] += step.up(moment[i]) + ca.cross(step.way, carried_force)
        moved, carried = step.inertia_up(six, h, mass[i])
        mass[up], first[up], inertia[up] = mass[up] + mass[i], first[up] + moved, inertia[up] + carried
    h = ca.vertcat(*bias)
    for spread in tree.spread:
        ends = (spread.first, spread.second)
        rises, arms = [frames.acceleration(spot) for spot in ends], [frames.jacobian(spot) for spot in ends]
        for k in range(2):
            carried_force = spread.mass / 6 * (2 * rises[k] + rises[1 - k])
            matrix += spread.mass / 6 * (2 * arms[k].T @ arms[k] + arms[k].T @ arms[1 - k])
            momentum += spread.mass / 2 * arms[k]
            h += arms[k].T @ carried_force
            rest += carried_force
    if tree.pinned is not None:
        arm = frames.jacobian(tree.pinned)
        whole = base_mass + sum((m for m in _roots(links, mass)), ca.SX(0))
        whole += sum((s.mass for s in tree.spread), ca.SX(0))
        matrix += whole * (arm.T @ arm) - arm.T @ momentum - momentum.T @ arm
        h -= arm.T @ rest
    return Equations(matrix, h, _floated(tree, frames), frames)


def _inertial(
    tree: Tree, steps: Sequence[_Step], inertial: tuple[list[ca.SX], list[ca.SX], list[ca.SX]], v: ca.SX, start: ca.SX
) -> tuple[list[ca.SX], list[ca.SX]]:
    """Force and moment about its origin that each link takes without joint accelerations, in its own frame.

    Args:
        tree: whose links.
        steps: from each to its parent.
        inertial: mass, first moment and inertia of each.
        v: (n,) joint rates.
        start: (3,) acceleration of the base.
    """
    base = ca.SX(3, 1)
    state: dict[int, tuple[ca.SX, ca.SX, ca.SX, ca.SX]] = {BASE: (base, base, start, ca.SX(3, 3))}
    force, moment = [], []
    for i, (link, step, mass, first, six) in enumerate(zip(tree.links, steps, *inertial, strict=True)):
        spin, turning, rise, field_ = state[link.parent]
        spin, turning, rise = step.down(spin), step.down(turning), step.down(rise + field_ @ step.way)
        across = ca.vertcat(spin[1] * v[i], -spin[0] * v[i], ca.SX(1, 1))
        if link.slides:
            rise = rise + 2 * across
        else:
            turning, spin = turning + across, spin + ca.vertcat(ca.SX(2, 1), v[i])
        # Of a point at r the acceleration is rise + (turning× + spin×spin×) r.
        (x, y, z), (p, q, r) = ca.vertsplit(spin), ca.vertsplit(turning)
        field_ = ca.vertcat(
            ca.horzcat(-(y * y + z * z), x * y - r, x * z + q),
            ca.horzcat(x * y + r, -(x * x + z * z), y * z - p),
            ca.horzcat(x * z - q, y * z + p, -(x * x + y * y)),
        )
        state[i] = spin, turning, rise, field_
        xx, yy, zz, xy, xz, yz = ca.vertsplit(six)
        # ∫ r rᵀ dm, of which the inertia is the trace less itself.
        second = symmetric(ca.vertcat((yy + zz - xx) / 2, (xx + zz - yy) / 2, (xx + yy - zz) / 2, -xy, -xz, -yz))
        flow = field_ @ second
        force.append(mass * rise + field_ @ first)
        moment.append(
            ca.vertcat(flow[2, 1] - flow[1, 2], flow[0, 2] - flow[2, 0], flow[1, 0] - flow[0, 1])
            + ca.cross(first, rise)
        )
    return force, moment


def symmetric(six: ca.SX) -> ca.SX:
    """(3, 3) of xx, yy, zz, xy, xz, yz."""
    return ca.vertcat(
        ca.horzcat(six[0], six[3], six[4]), ca.horzcat(six[3], six[1], six[5]), ca.horzcat(six[4], six[5], six[2])
    )


def _six(matrix: ca.SX) -> ca.SX:
    """(6,) xx, yy, zz, xy, xz, yz of a symmetric matrix."""
    return ca.vertcat(*[matrix[j, k] for j, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])


def _roots(links: Sequence[Link], mass: Sequence[ca.SX]) -> list[ca.SX]:
    return [m for link, m in zip(links, mass, strict=True) if link.parent == BASE]


def _floated(tree: Tree, frames: Frames) -> ca.SX:
    """(n,) joint forces that hold what ``Link.floated`` weighs."""
    n = len(tree.links)
    found = ca.SX(n, 1)
    for i, link in enumerate(tree.links):
        if link.floated is None:
            continue
        arm = frames.rotation[i] @ link.floated[1:4]
        for k in frames.carriers(i):
            if tree.links[k].slides:
                found[k] -= link.floated[0] * ca.dot(frames.axis[k], tree.gravity)
            else:
                lever = link.floated[0] * (frames.origin[i] - frames.origin[k]) + arm
                found[k] -= ca.dot(frames.axis[k], ca.cross(lever, tree.gravity))
    return found
