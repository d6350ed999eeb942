"""The exact equations of motion of any robot, as functions of arrays that controllers compute with.

    M(q) a + h(q, v) = τ(q, v, u),    τ = B(q, v) u + τ₀(q, v) within the limits of forces

h has all that is passive, τ is what the drives exert under commands u, with what effects exert beside them, their
states as after a long rest at q. Ends of joints take no part; dry friction acts against motion, not on what rests.
Nothing is compiled: CasADi evaluates ``models.augmented``'s expressions, which takes some microseconds a joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters, sliding_friction
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

FAR = 1e150
"""Stands for no limit of a command."""
LOST = 1e-9
"""Share of a torque, and of 1 N·m or N, that is lost by rounding."""
SHARINGS = 20
"""How often what some actuators cannot exert is given to others, at most."""
SOUND = 1e-6
"""Smallest singular value of B that counts, as a share of the largest: below it commands exert nothing there."""


@lru_cache(maxsize=32)
def _functions(form: Structure, phase: Phase, laws: Laws) -> dict[str, ca.Function]:
    m, base = augmented_model(form, phase, laws), build(form, phase)
    a = ca.SX.sym("a", m.q.numel())
    inside = base.inside.state.numel()
    own = ca.vertcat(base.p, base.inside.state), ca.vertcat(m.p[: base.p.numel()], m.z[:inside, 0])
    mass, bias = (ca.substitute(x, *own) for x in (base.mass, base.smooth_bias))
    still = ca.SX.zeros(m.v.shape)

    def at_rest(*expressions: ca.SX) -> list[ca.SX]:
        return ca.substitute(list(expressions), [m.z], [m.rest_state])

    mass, bias, drive, rubbed, bound = at_rest(mass, bias, m.drive + m.torque, sliding_friction(m), m.bound_here)
    needed = mass @ a + bias
    # Of what the joints need against what the drives give: how it changes with the motion, dry friction apart.
    open_ended = ca.substitute(needed, a, ca.SX.zeros(a.shape)) - drive
    grip, bound = ca.SX(m.q.numel(), 1), ca.substitute(bound, m.v, still)
    for k, (kind, i) in enumerate(m.rubbing):
        if kind == "joint":
            grip[i] = bound[k]
    if ca.depends_on(needed - rubbed, m.pressure):
        names = ", ".join(law.name for law in laws if law.loads)
        raise NotAvailable(
            f"{names}: dry friction that grows with what a drive exerts; equations of motion cannot be solved for what "
            "it has to exert then, expected a model without that"
        )
    given = [m.q, m.v, m.pressure, m.p]
    outputs = {
        "mass": ([m.q, m.p], [mass]),
        "needed": ([m.q, m.v, a, m.p], [needed - rubbed]),
        "drive": (given, [drive, ca.jacobian(drive, m.pressure)]),
        "slopes": (given, [ca.jacobian(open_ended, m.q), ca.jacobian(open_ended, m.v)]),
        "grip": ([m.q, m.pressure, m.p], [grip]),
    }
    return {name: ca.Function(name, symbols, [ca.densify(x) for x in own]) for name, (symbols, own) in outputs.items()}


def computable(model: Model) -> Robot:
    """A model's robot with all effects on bodies and drives, whose equations of motion controllers compute with.

    Raises:
        NotAvailable: where the equations cannot hold the robot, or it has joints that are not measured.
    """
    robot = changed_bodies(model.effects, model.robot)
    if robot.uninvertible:
        raise NotAvailable(
            f"{robot.name}: controllers compute with exact equations of motion, which cannot hold its "
            f"{robot.uninvertible[0]}"
        )
    others = (*robot.prescribed_names, *robot.unmeasured_names)
    if others:
        raise NotAvailable(
            f"{robot.name}: the motion of {', '.join(others)} is not measured or not its own, expected all joints "
            "of a robot that is controlled to be measured"
        )
    return robot


@dataclass(frozen=True, eq=False)
class Linear:
    """A robot about a pose at rest: M δa + D δv + K δq = B δu.

    Attributes:
        mass: M (nj, nj).
        damping: D (nj, nj).
        stiffness: K (nj, nj), of springs, of gravity and of drives that hold where they are.
        drive: B (nj, na).
    """

    mass: Array
    damping: Array
    stiffness: Array
    drive: Array

    def matrices(self) -> tuple[Array, Array]:
        """A (2 nj, 2 nj) and B (2 nj, na) of d/dt (δq, δv)."""
        n = len(self.mass)
        inverse = np.linalg.inv(self.mass)
        a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ self.stiffness, -inverse @ self.damping]])
        return a, np.vstack([np.zeros((n, self.drive.shape[1])), inverse @ self.drive])


class Dynamics:
    """The exact equations of motion of a model.

    Args:
        model: a robot with what is known to be attached to it.

    Attributes:
        model: the same.
        robot: with all effects on bodies and drives.

    Raises:
        NotAvailable: where the equations cannot hold the robot, it has joints that are not measured, or dry friction
            that grows with what a drive exerts.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.robot = robot = computable(model)
        mechanics = robot.mechanics()
        form, laws = mechanics.form, laws_of(model.effects)
        slots = augmented_model(form, model.phase, laws).slots
        names = (mechanics.law_places["joint"], mechanics.law_places["actuator"])
        own = law_parameters(slots, model.effects, *names)
        self._order = np.argsort(mechanics.joints)  # of the joints in the form's order
        self._joints = mechanics.joints
        found = _functions(form, model.phase, laws)
        self._mass, self._needed, self._slopes = (Buffered(found[key]) for key in ("mass", "needed", "slopes"))
        self._bounded_slopes = Buffered(found["slopes"])
        self._bounded, self._free = Buffered(found["drive"]), Buffered(found["drive"])
        self._grip = Buffered(found["grip"])
        within = np.array([*mechanics.parameters, *own])
        beyond = np.array([*form.unlimited(mechanics.parameters), *own])
        for call in (self._mass, self._needed, self._bounded, self._bounded_slopes, self._grip):
            call.arguments[-1][:] = within
        for call in (self._free, self._slopes):
            call.arguments[-1][:] = beyond
        self.low, self.high = robot.command_limits
        self._anything = np.full(len(self.low), np.inf)
        ends = np.nan_to_num(self.low, neginf=-FAR), np.nan_to_num(self.high, posinf=FAR)
        both = np.isfinite(self.low) & np.isfinite(self.high)
        self._inside = np.where(both, (ends[0] + ends[1]) / 2, np.clip(0.0, *ends))
        self._weights = np.where(both & (ends[0] < ends[1]), (ends[1] - ends[0]) / 2, 1.0)

    def __reduce__(self) -> tuple[type[Dynamics], tuple[Model]]:
        # CasADi's buffers stay in their process; what was worked out is worked out again elsewhere.
        return Dynamics, (self.model,)

    def _joint(self, values: Array) -> Array:
        """(nj, …) of the form's coordinates as the robot's joints are ordered."""
        return np.array(values[self._joints])

    def mass(self, q: ArrayLike) -> Array:
        """(nj, nj) M [kg·m², kg·m or kg]."""
        self._mass.arguments[0][:] = np.asarray(q)[self._order]
        self._mass()
        return self._joint(self._joint(self._mass.results[0].reshape(len(self._joints), -1)).T)

    def needed(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """(nj,) what the drives have to exert for a motion, dry friction that slides included [N·m or N].

        Args:
            q: (nj,) positions [rad or m].
            v: (nj,) rates.
            a: (nj,) accelerations.
        """
        for argument, values in zip(self._needed.arguments, (q, v, a), strict=False):
            argument[:] = np.asarray(values)[self._order]
        self._needed()
        return self._joint(self._needed.results[0])

    def exerted(self, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> Array:
        """(nj,) what the drives exert under commands u (na,), limits of forces included [N·m or N]."""
        return self._driven(self._bounded, q, v, u)[0]

    def authority(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """B (nj, na) and τ₀ (nj,) of what the drives would exert if nothing limited them."""
        torque, slope = self._driven(self._free, q, v, self._inside)
        return slope, torque - slope @ self._inside

    def _driven(self, call: Buffered, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        call.arguments[0][:], call.arguments[1][:] = np.asarray(q)[self._order], np.asarray(v)[self._order]
        call.arguments[2][:] = u
        call()
        slope = call.results[1].reshape(len(self._joints), -1)
        return self._joint(call.results[0]), self._joint(slope)

    def effective_mass(self, q: ArrayLike, driven: NDArray[np.bool_]) -> Array:
        """(nj, nj) the mass matrix of driven joints (nj,), those without actuator free; 0 for these."""
        found, inverse = np.zeros((len(driven), len(driven))), np.linalg.inv(self.mass(q))
        found[np.ix_(driven, driven)] = np.linalg.inv(inverse[np.ix_(driven, driven)])
        return found

    def answer(self, drive: Array, torque: Array) -> Array:
        """(na,) the commands of least size, by their ranges, that exert a torque as nearly as can be.

        Args:
            drive: B (nj, na).
            torque: (nj,) [N·m or N].
        """
        scaled = np.linalg.pinv(drive * self._weights, rcond=SOUND) @ torque
        return np.asarray(self._weights * scaled)

    def commands(self, q: ArrayLike, v: ArrayLike, torque: ArrayLike) -> Array:
        """(na,) commands, whatever their limits, that exert a torque (nj,) [N·m or N] as nearly as can be.

        Where such a limit stops one actuator, others that act on the same joints exert what it does not.
        """
        drive, own = self.authority(q, v)
        command = self.answer(drive, np.asarray(torque) - own)
        return self.shared(q, v, command, drive @ command + own, -self._anything, self._anything)

    def shared(self, q: ArrayLike, v: ArrayLike, command: Array, torque: Array, low: Array, high: Array) -> Array:
        """Commands within bounds, so that actuators that no limit stops exert what others cannot.

        As given where none is stopped. Newton's method on what is exerted; what is stopped has no slope, and stays.

        Args:
            q: (nj,) positions [rad or m].
            v: (nj,) rates.
            command: (na,) to begin with.
            torque: (nj,) to be exerted [N·m or N].
            low: (na,) lowest commands.
            high: (na,) highest.
        """
        within = np.clip(command, low, high)
        for _ in range(SHARINGS):
            given, slope = self._driven(self._bounded, q, v, within)
            off = torque - given
            if not _apart(off, torque):
                break
            stopped = np.zeros(len(within), dtype=bool)
            change = self.answer(slope, off)
            while np.any(outward := ((within <= low) & (change < 0) | (within >= high) & (change > 0)) & ~stopped):
                stopped |= outward
                change = self.answer(np.where(stopped, 0.0, slope), off)
            if not _apart(slope @ np.where(stopped, 0.0, change), torque):
                break
            within = np.clip(within + change, low, high)
        return np.asarray(within)

    def holding(self, q: ArrayLike) -> tuple[Array, Array]:
        """The commands within their limits that come nearest to holding a pose at rest, and what is lacking then.

        Args:
            q: (nj,) the pose [rad or m].

        Returns:
            Commands (na,), and (nj,) the torque that each joint lacks beyond its dry friction [N·m or N].
        """
        still = np.zeros(len(self._joints))
        drive, own = self.authority(q, still)
        wanted = self.needed(q, still, still) - own
        command = self.answer(drive, wanted)
        if np.any((command < self.low) | (command > self.high)):
            ends = (self.low / self._weights, self.high / self._weights)
            command = self._weights * lsq_linear(drive * self._weights, wanted, ends).x
        whole = drive @ command + own
        if _apart(self.exerted(q, still, command) - whole, whole):
            command = self.shared(q, still, command, wanted + own, self.low, self.high)
        self._grip.arguments[0][:], self._grip.arguments[1][:] = np.asarray(q)[self._order], command
        self._grip()
        grip = self._joint(self._grip.results[0])
        off = wanted + own - self.exerted(q, still, command)
        return np.asarray(command), np.sign(off) * np.maximum(np.abs(off) - grip, 0.0)

    def possible(self, q: Array, v: Array, a: Array) -> float:
        """The share of a motion (nj,) each, beside what holds its pose, that the actuators can do."""
        still = np.zeros_like(q)
        moving, resting = self.needed(q, v, a), self.needed(q, still, still)
        drive, own = self.authority(q, v)
        commands = np.column_stack([self.answer(drive, torque - own) for torque in (moving, resting)])
        asked, at_rest = (drive @ commands + own[:, None]).T
        given, held = (
            self.exerted(q, v, self.shared(q, v, command, torque, self.low, self.high))
            for command, torque in zip(commands.T, (asked, at_rest), strict=True)
        )
        most = float(np.linalg.norm(asked - at_rest))
        lost = float(np.linalg.norm((asked - given) - (at_rest - held)))
        return share_left(lost, most)

    def linear(self, q: ArrayLike, u: ArrayLike | None = None) -> Linear:
        """The robot about a pose at rest, no limit of forces near but of actuators whose part others exert.

        Args:
            q: (nj,) the pose [rad or m].
            u: (na,) what is commanded there; what holds it by default.
        """
        still = np.zeros(len(self._joints))
        needed = self.needed(q, still, still)
        command = self.commands(q, still, needed) if u is None else np.asarray(u)
        (given, bounded), (drive, own) = self._driven(self._bounded, q, still, command), self.authority(q, still)
        stopped = _apart(given - (drive @ command + own), given) and not _apart(given - needed, needed)
        call, drive = (self._bounded_slopes, bounded) if stopped else (self._slopes, drive)
        call.arguments[0][:], call.arguments[1][:] = np.asarray(q)[self._order], 0.0
        call.arguments[2][:] = command
        call()
        by_q, by_v = (self._joint(self._joint(part.reshape(len(still), -1)).T).T for part in call.results)
        return Linear(self.mass(q), by_v, by_q, drive)


def share_left(lost: float, most: float, unit: float = 1.0) -> float:
    """The share of a size that is left where some of it is lost; all where that is rounding, of it or of a unit."""
    return 1.0 if lost <= LOST * max(most, unit) else max(1.0 - lost / max(most, LOST * unit), 0.0)


def _apart(off: Array, torque: Array) -> bool:
    """Whether torques are off by more than rounding."""
    return bool(np.any(np.abs(off) > LOST * np.maximum(np.abs(torque), 1.0)))
