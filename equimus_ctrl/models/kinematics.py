"""Geometry and statics of a morphology, numerically: what the symbolic model says, as plain functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array


@lru_cache(maxsize=32)
def _functions(form: Structure, phase: Phase) -> dict[str, ca.Function]:
    m = build(form, phase)
    torque = ca.substitute(m.mass @ m.acceleration, m.v, ca.SX.zeros(m.v.shape))
    return {
        "lengths": ca.Function("lengths", [m.q, m.p], [m.lengths]),
        "jacobian": ca.Function("jacobian", [m.q, m.p], [m.jacobian]),
        "foot": ca.Function("foot", [m.q, m.p], [m.foot]),
        "foot_jacobian": ca.Function("foot_jacobian", [m.q, m.p], [ca.jacobian(m.foot, m.q)]),
        "knots": ca.Function("knots", [m.q, m.p], [m.knots]),
        "tips": ca.Function("tips", [m.q, m.p], [m.knots[:, 1:], ca.jacobian(ca.vec(m.knots[:, 1:]), m.q)]),
        "static_pressure": ca.Function("static_pressure", [m.q, m.p], [m.static_pressure]),
        "mass": ca.Function("mass", [m.q, m.p], [m.mass]),
        "energy": ca.Function("energy", [m.q, m.v, m.p], [m.kinetic, m.potential]),
        "acceleration": ca.Function("acceleration", [m.q, m.v, m.f, m.tau, m.p], [m.acceleration]),
        "rest_torque": ca.Function("rest_torque", [m.q, m.f, m.tau, m.p], [torque, ca.jacobian(torque, m.q)]),
    }


NEWTON_STEPS = 8
"""Towards a pose at rest from one close by; what is not at rest after so many is looked for by itself."""
CLOSE_BY = 1.0
"""A pose farther away than this from the one before was not followed but jumped to [rad]."""


@lru_cache(maxsize=32)
def _followed(form: Structure, phase: Phase, n: int) -> tuple[ca.Function, ca.Function]:
    """Poses (nj, n), each by Newton's method from the one before, of (pose (nj,), forces (na, n), p).

    The other function checks whether they rest: (poses, forces, p) → torque (nj, n), its slope by the pose and the mass
    matrix, (nj, n nj) each.
    """
    m = build(form, phase)
    torque, slope = _functions(form, phase)["rest_torque"](m.q, m.f, ca.SX.zeros(m.tau.shape), m.p)
    step = ca.Function("step", [m.q, m.f, m.p], [m.q - ca.solve(slope, torque)])
    q, force, p = ca.MX.sym("q", m.q.shape), ca.MX.sym("f", m.f.shape), ca.MX.sym("p", m.p.shape)
    pose = q
    for _ in range(NEWTON_STEPS):
        pose = step(pose, force, p)
    follow = ca.Function("follow", [q, force, p], [pose])
    judge = ca.Function("judge", [m.q, m.f, m.p], [torque, slope, m.mass])
    return follow.mapaccum(n), judge.map(n)


@lru_cache(maxsize=32)
def _foot_followed(form: Structure, phase: Phase, n: int) -> ca.Function:
    """(pose, feet (2, n), p) → poses (nj, n), each by Newton's method, its steps the least, from the one before."""
    m = build(form, phase)
    slope, foot = ca.jacobian(m.foot, m.q), ca.SX.sym("foot", 2)
    step = slope.T @ ca.solve(slope @ slope.T, foot - m.foot) if slope.shape[1] > 1 else ca.SX.nan(1)
    newton = ca.Function("newton", [m.q, foot, m.p], [m.q + step])
    q, target, p = ca.MX.sym("q", m.q.shape), ca.MX.sym("foot", 2), ca.MX.sym("p", m.p.shape)
    pose = q
    for _ in range(NEWTON_STEPS):
        pose = newton(pose, target, p)
    found = ca.Function("follow", [q, target, p], [pose]).mapaccum(n)
    assert isinstance(found, ca.Function)
    return found


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Lengths, positions and rest states of one morphology.

    Attributes:
        morphology: whose.
        phase: base fixed (swing) or foot pinned (stance).
    """

    morphology: Morphology
    phase: Phase = "swing"
    parameters: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", pack(self.morphology))

    def _call(self, name: str, *arguments: ArrayLike) -> Any:
        function = _functions(structure(self.morphology), self.phase)[name]
        return function(*(np.asarray(a, dtype=np.float64) for a in arguments), self.parameters)

    def lengths(self, q: ArrayLike) -> Array:
        """(na,) actuator lengths at the pose q [m]."""
        return np.array(self._call("lengths", q)).ravel()

    def jacobian(self, q: ArrayLike) -> Array:
        """(na, nj) moment arms ∂length/∂q [m]."""
        return np.array(self._call("jacobian", q))

    def foot(self, q: ArrayLike) -> Array:
        """(2,) the foot relative to the base: x to the right, y down [m]."""
        return np.array(self._call("foot", q)).ravel()

    def feet(self, q: ArrayLike) -> Array:
        """(n, 2) the foot at poses (n, nj), see ``foot`` [m]."""
        poses = np.asarray(q, dtype=np.float64)
        function = _functions(structure(self.morphology), self.phase)["foot"].map(len(poses))
        return np.array(function(poses.T, self.parameters)).T

    def follow_foot(self, feet: ArrayLike, near: ArrayLike) -> Array:
        """(n, nj) poses by a few steps of Newton's method, each from the one before, towards feet (n, 2) [m].

        Whether they are there, and within the joint ranges, is for the caller to look.
        """
        wanted = np.asarray(feet, dtype=np.float64)
        follow = _foot_followed(structure(self.morphology), self.phase, len(wanted))
        return np.array(follow(np.asarray(near, dtype=np.float64), wanted.T, self.parameters)).T

    def foot_jacobian(self, q: ArrayLike) -> Array:
        """(2, nj) ∂foot/∂q [m]."""
        return np.array(self._call("foot_jacobian", q))

    def knots(self, q: ArrayLike) -> Array:
        """(nj + 1, 2) the base's origin and the tip of each joint's link [m]."""
        return np.array(self._call("knots", q)).T

    def tips(self, q: ArrayLike) -> tuple[Array, Array]:
        """(nj, 2) the tip of each joint's link [m] as in ``knots``, and (nj, 2, nj) its slope by q."""
        places, slopes = (np.array(part) for part in self._call("tips", q))
        nj = places.shape[1]
        return places.T, slopes.reshape(nj, 2, nj)

    def mass(self, q: ArrayLike) -> Array:
        """(nj, nj) mass matrix [kg·m²]."""
        return np.array(self._call("mass", q))

    def energy(self, q: ArrayLike, v: ArrayLike) -> tuple[float, float]:
        """Kinetic and potential energy [J], without the stops."""
        kinetic, potential = self._call("energy", q, v)
        return float(kinetic), float(potential)

    def acceleration(self, q: ArrayLike, v: ArrayLike, pressure: ArrayLike, torque: ArrayLike | None = None) -> Array:
        """(nj,) joint accelerations under pressures [Pa] and joint torques [N·m]."""
        torque = np.zeros(len(self.morphology.joints)) if torque is None else torque
        return np.array(self._call("acceleration", q, v, self.drive_force(pressure), torque)).ravel()

    def drive_force(self, pressure: ArrayLike) -> Array:
        """(na,) force along each actuator that pressures [Pa] make [N]."""
        return np.array([a.area for a in self.morphology.actuators]) * np.asarray(pressure, dtype=np.float64)

    def rest_torque(self, q: ArrayLike, pressure: ArrayLike | None = None) -> tuple[Array, Array]:
        """(nj,) torque that would move the joints from rest at q [N·m], stops included, and (nj, nj) its slope by q."""
        na, nj = len(self.morphology.actuators), len(self.morphology.joints)
        force = np.zeros(na) if pressure is None else self.drive_force(pressure)
        torque, slope = self._call("rest_torque", q, force, np.zeros(nj))
        return np.array(torque).ravel(), np.array(slope)

    def static_pressure(self, q: ArrayLike) -> Array:
        """(na,) pressures that would hold q at rest without touching a stop [Pa]; they may lie outside the range."""
        return np.array(self._call("static_pressure", q)).ravel()

    def holds(self, q: ArrayLike, tolerance: float = 1e-6) -> bool:
        """Whether pressures within the command range hold the pose q, to ``tolerance`` [N·m]."""
        pressure = self.static_pressure(q)
        m = self.morphology
        inside = bool(np.all(pressure >= m.command_low) and np.all(pressure <= m.command_high))
        torque = self._call("rest_torque", q, self.drive_force(pressure), np.zeros(len(m.joints)))[0]
        return inside and float(np.abs(np.array(torque)).max()) <= tolerance

    def equilibrium(self, pressure: ArrayLike, start: ArrayLike | None = None) -> Array:
        """(nj,) the pose at rest under constant pressures [Pa], stops included.

        Args:
            pressure: (na,) [Pa].
            start: (nj,) where to look from; the middle of the joint ranges by default.

        Raises:
            ModelError: where no pose at rest is found.
        """
        given = np.asarray(pressure, dtype=np.float64)
        if given.shape != (len(self.morphology.actuators),) or not np.all(np.isfinite(given)):
            raise ModelError(
                f"{self.morphology.name}: pressures are {given.tolist()}, expected one finite number of Pa for each of "
                f"{', '.join(self.morphology.actuator_names)}"
            )
        force = self.drive_force(given)
        zero = np.zeros(len(self.morphology.joints))
        low, high = (np.clip(side, -np.pi, np.pi) for side in self.morphology.joint_range)
        starts = [np.asarray(start, dtype=np.float64)] if start is not None else []
        starts += [low + share * (high - low) for share in (0.5, 0.25, 0.75, 0.1, 0.9)]
        for guess in starts:
            found = least_squares(
                lambda q: np.array(self._call("rest_torque", q, force, zero)[0]).ravel(),
                guess,
                jac=lambda q: np.array(self._call("rest_torque", q, force, zero)[1]),
                xtol=1e-15,
                ftol=1e-15,
                gtol=1e-15,
            )
            torque, slope = self._call("rest_torque", found.x, force, zero)
            if _at_rest(np.array(torque).T, np.array(slope)[None], self.mass(found.x)[None])[0]:
                return np.asarray(found.x, dtype=np.float64)
        commands = ", ".join(f"{value / 1e3:g}" for value in np.atleast_1d(np.asarray(pressure, dtype=np.float64)))
        raise ModelError(f"{self.morphology.name}: no pose at rest was found under pressures of {commands} kPa")

    def equilibria(self, pressures: ArrayLike, start: ArrayLike | None = None) -> Array:
        """(n, nj) poses at rest under pressures that change little by little, each looked for from the one before.

        Args:
            pressures: (n, na) [Pa].
            start: (nj,) where the first is looked for from; the middle of the joint ranges by default.

        Raises:
            ModelError: where one is not found, or pressures cannot be.
        """
        given = np.asarray(pressures, dtype=np.float64)
        if given.ndim != 2 or not len(given):
            raise ModelError(
                f"{self.morphology.name}: pressures have shape {given.shape}, expected (n, na), n at least 1"
            )
        poses = [self.equilibrium(given[0], start)]
        if len(given) > 1 and np.all(np.isfinite(given)):
            n = len(given) - 1
            follow, judge = _followed(structure(self.morphology), self.phase, n)
            forces = self.drive_force(given[1:]).T
            found = follow(poses[0], forces, self.parameters)
            torque, slope, mass = (np.array(part) for part in judge(found, forces, self.parameters))
            nj = len(poses[0])
            slopes, masses = (part.reshape(nj, n, nj).swapaxes(0, 1) for part in (slope, mass))
            rows = np.array(found).T
            steps = np.abs(np.diff(np.vstack([poses[0], rows]), axis=0)).max(axis=1)
            good = _at_rest(torque.T, slopes, masses) & (steps < CLOSE_BY)
            poses += list(rows[: n if good.all() else int(np.argmin(good))])
        for pressure in given[len(poses) :]:
            poses.append(self.equilibrium(pressure, poses[-1]))
        return np.array(poses)


def _at_rest(torque: Array, slope: Array, mass: Array) -> NDArray[np.bool_]:
    """(n,) whether poses are at rest and stable.

    At rest means no torque, and stable means that torque acts against any small displacement.

    Args:
        torque: (n, nj) [N·m].
        slope: (n, nj, nj) by the pose [N·m/rad].
        mass: (n, nj, nj) [kg·m²].
    """
    still = np.abs(torque).max(axis=1) < 1e-8  # false of nan
    found = np.zeros(len(torque), dtype=bool)
    rates = np.linalg.eigvals(np.linalg.solve(mass[still], slope[still]))
    found[still] = np.all(rates.real < 0, axis=1)
    return found
