"""Robots for tests, and an oracle for their motion that shares no derivation with the library.

The oracle is d'Alembert's principle over particles and rigid links, in complex numbers: no Lagrangian, no symbolic
differentiation. Its stance phase is a floating base whose foot is held by Lagrange multipliers.
"""

from __future__ import annotations

import cmath
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.morphology import (
    BASE,
    ElasticActuator,
    Joint,
    JointStop,
    Link,
    Morphology,
    Phase,
    Point,
)
from equimus_ctrl.types import Array

STRUCTURES: dict[str, tuple[tuple[int, ...], tuple[tuple[int, int], ...]]] = {
    "one_joint": ((-1,), ((-1, 0),)),
    "mono_and_bi": ((-1, 0), ((-1, 0), (-1, 1))),
    "more_drives_than_joints": ((-1, 0), ((-1, 0), (0, 1), (-1, 1))),
    "branched": ((-1, 0, 0), ((-1, 0), (0, 1), (-1, 2))),
    "fewer_drives_than_joints": ((-1, 0, 1, 2), ((-1, 1), (1, 3))),
}
"""Name → parents of the joints and (origin, insertion) bodies of the actuators; −1 is the base."""


def random_morphology(structure: str, seed: int, *, damped: bool = True, stops: bool = False) -> Morphology:
    """A robot of one of ``STRUCTURES`` with every number drawn at random."""
    parents, spans = STRUCTURES[structure]
    rng = np.random.default_rng(seed)

    def u(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    body = [*(f"link{i}" for i in range(len(parents))), BASE]  # body[-1] is the base
    links, joints = [], []
    for i, parent in enumerate(parents):
        links.append(Link(body[i], u(0.15, 0.35), u(0.05, 0.3), u(0.05, 0.2), u(2e-4, 2e-3)))
        at = Point(body[parent], u(0.0, 0.05), u(-3, 3)) if parent < 0 and i == 0 else None
        if rng.random() < 0.5 and parent >= 0:
            at = Point(body[parent], u(0.1, 0.3), u(-0.5, 0.5))
        stop = JointStop(-u(0.7, 1.0), u(50, 300), u(0.2, 2))
        joints.append(
            Joint(
                f"joint{i}",
                body[parent],
                body[i],
                damping=u(0.01, 0.3) if damped else 0.0,
                lower=stop if stops else None,
                # MuJoCo's joint limits have one stiffness for both sides.
                upper=replace(stop, angle=u(0.7, 1.0)) if stops else None,
                at=at,
            )
        )
    actuators = [
        ElasticActuator(
            f"drive{i}",
            Point(body[origin], u(0.15, 0.2), u(-3, 3)),
            Point(body[insertion], u(0.05, 0.1), u(-3, 3)),
            mass=u(0.05, 0.3),
            stiffness=u(50, 300),
            damping=u(2, 20) if damped else 0.0,
            rest_length=u(0.1, 0.3),
            area=u(2e-4, 6e-4),
        )
        for i, (origin, insertion) in enumerate(spans)
    ]
    return Morphology(
        f"{structure}_{seed}",
        tuple(links),
        tuple(joints),
        tuple(actuators),
        foot=body[-2],
        base_mass=u(0.1, 0.5),
        gravity=u(5, 12),
        tilt=u(-0.3, 0.3),
    )


def random_poses(
    morphology: Morphology, rng: np.random.Generator, n: int, low: float = -1.2, high: float = 1.2
) -> Array:
    """(n, nj) poses at which no actuator is shorter than 3 cm, where its direction would be ill defined."""
    kinematics = Kinematics(morphology)
    found: list[Array] = []
    while len(found) < n:
        q = rng.uniform(low, high, len(morphology.joints))
        if kinematics.lengths(q).min() > 0.03:
            found.append(q)
    return np.array(found)


def pendulum(length: float = 0.4, mass: float = 0.7, com: float = 0.25, inertia: float = 4e-3) -> Morphology:
    """One link; its actuator has no mass, stiffness or damping, so that only pressure makes it felt."""
    return Morphology(
        "pendulum",
        (Link("rod", length, mass, com, inertia),),
        (Joint("pivot", BASE, "rod"),),
        (_idle("drive", Point(BASE, 0.3), Point("rod", 0.1)),),
        foot="rod",
    )


def double_pendulum() -> Morphology:
    """Two links of different mass and inertia under an actuator that is felt only under pressure."""
    return Morphology(
        "double_pendulum",
        (Link("first", 0.3, 0.5, 0.13, 5e-3), Link("second", 0.2, 0.3, 0.08, 1.5e-3)),
        (Joint("shoulder", BASE, "first"), Joint("elbow", "first", "second")),
        (_idle("drive", Point(BASE, 0.5), Point("second", 0.1)),),
        foot="second",
        gravity=9.81,
    )


def _idle(name: str, origin: Point, insertion: Point) -> ElasticActuator:
    return ElasticActuator(name, origin, insertion, mass=0, stiffness=0, damping=0, rest_length=0.2, area=4e-4)


@dataclass(frozen=True)
class Motion:
    """A point of the robot: where it is, how it moves with the coordinates, and its acceleration were those steady.

    Coordinates are the base's x and y, then the joint angles; a position x + iy is a complex number.
    """

    at: complex
    per_rate: Array  # (2 + nj,) complex: velocity for each unit of a coordinate's rate
    turning: complex  # acceleration with all coordinates' rates held


@dataclass(frozen=True)
class Skeleton:
    """The robot in one state, in floating-base coordinates; the base stands at the origin."""

    morphology: Morphology
    q: Array
    v: Array

    def heading(self, body: str) -> tuple[float, float]:
        """Angle of a body's first axis and its rate."""
        chain = [self.morphology.joint_names.index(joint.name) for joint in self.morphology.chain(body)]
        return float(self.q[chain].sum()), float(self.v[chain].sum())

    def point(self, body: str, local: complex) -> Motion:
        """The point at ``local`` of a body's frame."""
        angle, rate = self.heading(body)
        arm = local * cmath.exp(1j * angle)
        if body == BASE:
            per_rate = np.zeros(2 + len(self.q), dtype=complex)
            per_rate[:2] = 1, 1j
            return Motion(arm, per_rate, 0j)
        m = self.morphology
        joint = m.chain(body)[-1]
        pivot = m.joint_point(joint)
        origin = self.point(joint.parent, cmath.rect(pivot.radius, pivot.angle))
        per_rate = origin.per_rate.copy()
        for turned in m.chain(body):
            per_rate[2 + m.joint_names.index(turned.name)] += 1j * arm
        return Motion(origin.at + arm, per_rate, origin.turning - rate**2 * arm)

    def end(self, point: Point) -> Motion:
        """A point given in the library's terms."""
        return self.point(point.body, cmath.rect(point.radius, point.angle))

    def velocity(self, motion: Motion) -> complex:
        """Of a point, the base standing still."""
        return complex(motion.per_rate[2:] @ self.v)

    def spin(self, body: str) -> Array:
        """(2 + nj,) rate of a body's heading for each coordinate's rate."""
        row = np.zeros(2 + len(self.q))
        for joint in self.morphology.chain(body):
            row[2 + self.morphology.joint_names.index(joint.name)] = 1
        return row


def stop_torque(joint: Joint, q: float, v: float) -> float:
    """What a joint's stops exert: springs and dampers that push and never pull."""
    torque = 0.0
    if joint.lower is not None and q < joint.lower.angle:
        torque += max(joint.lower.stiffness * (joint.lower.angle - q) - joint.lower.damping * v, 0.0)
    if joint.upper is not None and q > joint.upper.angle:
        torque -= max(joint.upper.stiffness * (q - joint.upper.angle) + joint.upper.damping * v, 0.0)
    return torque


def newton_acceleration(
    morphology: Morphology, q: Array, v: Array, pressure: Array, torque: Array | None = None, phase: Phase = "swing"
) -> Array:
    """(nj,) joint accelerations by d'Alembert's principle.

    Σ m Jᵀ(J a + turning − g) + Σ I σᵀσ a = Qᵀ over the parts; rods are two particles of half their mass at the
    Gauss points, which is exact for velocities that vary linearly along them.
    """
    still = Skeleton(morphology, q, v)
    nj = len(morphology.joints)
    mass = np.zeros((2 + nj, 2 + nj))
    force = np.zeros(2 + nj)
    gravity = morphology.gravity * 1j * cmath.exp(1j * morphology.tilt)

    def along(motion: Motion, push: complex) -> Array:
        return (motion.per_rate.conj() * push).real

    def particle(motion: Motion, weight: float) -> None:
        nonlocal mass, force
        mass = mass + weight * (motion.per_rate.conj()[:, None] * motion.per_rate[None, :]).real
        force = force + along(motion, weight * (gravity - motion.turning))

    particle(still.point(BASE, 0j), morphology.base_mass)
    for link in morphology.links:
        particle(still.point(link.name, link.com), link.mass)
        spin = still.spin(link.name)
        mass = mass + link.inertia * np.outer(spin, spin)
    for drive, p in zip(morphology.actuators, pressure, strict=True):
        a, b = still.end(drive.origin), still.end(drive.insertion)
        for share in (0.5 - np.sqrt(1 / 12), 0.5 + np.sqrt(1 / 12)):
            mix = Motion(
                (1 - share) * a.at + share * b.at,
                (1 - share) * a.per_rate + share * b.per_rate,
                (1 - share) * a.turning + share * b.turning,
            )
            particle(mix, drive.mass / 2)
        axis = b.at - a.at
        length = abs(axis)
        axis /= length
        rate = ((still.velocity(b) - still.velocity(a)) * axis.conjugate()).real
        push = drive.area * p - drive.stiffness * (length - drive.rest_length) - drive.damping * rate
        force = force + along(b, push * axis) - along(a, push * axis)
    for i, joint in enumerate(morphology.joints):
        force[2 + i] += stop_torque(joint, q[i], v[i]) - joint.damping * v[i]
        force[2 + i] += 0.0 if torque is None else torque[i]
    if phase == "swing":
        return np.linalg.solve(mass[2:, 2:], force[2:])
    # In stance the base moves, but does not turn: its velocity enters neither `turning` nor any actuator's length.
    foot = still.point(morphology.foot, morphology.link(morphology.foot).length)
    pinned = np.array([foot.per_rate.real, foot.per_rate.imag])  # (2, 2 + nj)
    system = np.block([[mass, pinned.T], [pinned, np.zeros((2, 2))]])
    rhs = np.concatenate([force, [-foot.turning.real, -foot.turning.imag]])
    return np.linalg.solve(system, rhs)[2 : 2 + nj]


def integrate(
    acceleration: Callable[[float, Array, Array], Array],
    q0: Array,
    v0: Array,
    times: Array,
    *,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> tuple[Array, Array]:
    """Angles and rates (n, nj) at ``times``, by an adaptive method of order eight."""
    n = len(q0)
    found = solve_ivp(
        lambda t, x: np.concatenate([x[n:], acceleration(t, x[:n], x[n:])]),
        (times[0], times[-1]),
        np.concatenate([q0, v0]),
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=atol,
    )
    assert found.success, found.message
    return found.y[:n].T, found.y[n:].T
