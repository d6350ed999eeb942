"""Gains of a PID for the joints of a robot that nobody has tuned, by pole placement.

Decoupled by the mass matrix (``PidSettings.decoupled``), each joint gets the characteristic polynomial

    (s² + 2 ζ ω s + ω²)(s + p),    p = max(α ω, δ − 2 ζ ω)

    k_p = ω² + 2 ζ ω p − κ,    k_d = (2 ζ + α) ω − δ₀,    k_i = ω² p

none below 0. κ and δ are the least stiffness and damping by inertia that the joint has by itself in any pose looked at,
δ₀ the least damping in any direction (D v = δ₀ M v). A joint that is damped more than placed poles would be keeps that:
its third pole is fast, and its gains grow with δ. One that is stiffer by itself keeps that too, and gets the integral
alone, k_i = α ω κ/(1 + 2 ζ α) (Åström & Hägglund, *Advanced PID Control*, 2006, chapter 6). Where a robot falls by
itself in some direction (K v = κ M v with κ < 0), that κ counts for all joints.

ω begins at a share of what dead times, lags, late sensors and the control period allow. It is halved until the sampled
loop of all joints is stable in every pose, with its gains raised and with what usually stands between commands and
forces unknown, and until it dies away where it begins, as placed poles do; where no ω does that in all poses, in the
pose in which it begins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, expm

from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings
from equimus_ctrl.effects.command import DELAY, FILL, VENT
from equimus_ctrl.effects.sensors import SENSOR_DELAY, sensor_settings
from equimus_ctrl.errors import ControllerError
from equimus_ctrl.models.dynamics import Dynamics, Linear
from equimus_ctrl.models.linear import valve_lag, with_valves
from equimus_ctrl.models.solved import known_lateness, valves_of
from equimus_ctrl.models.spread import latin_hypercube
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array, PlantSpec

DAMPING, THIRD = 0.8, 0.5
"""ζ, and the third pole's share α of the others' frequency."""
PHASE = 0.25
"""ω times all that is late: some half a radian is lost then where the loop's gain is 1."""
RAISED = 2.0
"""Factor on all gains with which the loop has to be stable too: a gain margin."""
SLOWEST = 0.05
"""Lowest ω that is tried [rad/s]."""
POSES = 12
"""How many are looked at beside the first."""
HELD = 1e-6
"""Torque that a joint lacks in a pose at rest, at most [N·m or N]."""
DECAYS = 0.1
"""Share of α ω, the slowest pole that is placed, that the slowest of the sampled loop reaches at least."""
GROWS = 1e-9
"""Of an eigenvalue beyond 1 that is none."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Gains, and what they came from.

    Attributes:
        settings: the gains.
        bandwidth: ω [rad/s].
        everywhere: whether they were found stable in all poses looked at, else only in the first.
    """

    settings: PidSettings
    bandwidth: float
    everywhere: bool = True

    @property
    def searched(self) -> PidSettings:
        """Gains for factors of a tuning: none is below what a robot without stiffness and damping would get."""
        bare = _gains(self.bandwidth, 0.0, 0.0, 0.0, 0.0)
        gains = {
            joint: PidGains(max(own.kp, bare.kp), max(own.ki, bare.ki), max(own.kd, bare.kd)) if own.ki > 0 else own
            for joint, own in self.settings.gains.items()
        }
        return replace(self.settings, gains=gains)

    @property
    def sentence(self) -> str:
        """For a person: where the gains come from."""
        only = "" if self.everywhere else ", stable about where it begins but not in all poses of its range"
        return (
            "PID gains are placed by the mass matrix for a bandwidth of "
            f"{self.bandwidth / (2 * np.pi):.2g} Hz{only}: none are tuned for this robot"
        )


def placed_gains(dynamics: Dynamics, spec: PlantSpec, pose: Array) -> Placed:
    """Gains for a robot.

    Args:
        dynamics: what is known of it.
        spec: of its plant.
        pose: (nj,) where it begins [rad or m].

    Raises:
        ControllerError: where none keep it where it is; the sentence says which joint moves away.
    """
    valve, dt = valves_of(dynamics.model), spec.control_dt
    sensor = sensor_settings(dynamics.model.effects, spec.joints)[:, SENSOR_DELAY]
    traits = dynamics.robot.traits
    usual = valve.copy()
    usual[:, DELAY] = np.maximum(valve[:, DELAY], traits.usual_delay)
    usual[:, [FILL, VENT]] = np.maximum(valve[:, [FILL, VENT]], traits.usual_lag)
    known = known_lateness(dynamics.model)
    late = 1.5 * dt + known
    still, driven = looked_at(dynamics, spec, pose)
    # Of a mode that turns far within a period, less delay or gain may be worse than more: all in between count.
    late_by = [DELAY, FILL, VENT]
    more = usual[:, late_by] - valve[:, late_by]
    parts = max(int(np.ceil(float(more[:, :2].max(axis=0).sum()) / dt - 1e-9)), 1)
    valves = [usual] * parts
    for k in range(1, parts):
        valves[k] = valve.copy()
        valves[k][:, late_by] += more * k / parts
    joint, most = 0, PHASE / (2 * late)
    for part in (still, still[:1]):
        own = Own.of([linear for _, linear in part], driven)
        loops = []
        for q, linear in part:
            known_loop = Loop(q, linear, driven, dynamics, valve, dt, sensor)
            later = [(Loop(q, linear, driven, dynamics, between, dt, sensor), 1.0) for between in valves]
            loops.append([*later, *((known_loop, RAISED**share) for share in (0.0, 0.5, 1.0))])
        omega = most
        while omega >= SLOWEST:
            settings = _settings(spec, driven, omega, own, late)
            growth = [loop.growth(settings, factor) for own_loops in loops for loop, factor in own_loops]
            # What joints without actuator do dies away as slowly as it does.
            slowest = np.exp(-DECAYS * THIRD * omega * dt) if driven.all() else 1 + GROWS
            if max(size for size, _ in growth) <= 1 + GROWS and max(growth[:parts])[0] <= slowest:
                return Placed(settings, omega, everywhere=part is still)
            omega /= 2
        joint = max(growth)[1]
    place = reading(spec.joint_units[joint]).text(pose[joint])
    where = f"{dynamics.robot.name}: {spec.joints[joint]} moves away from {place}"
    if driven.all() and known > 0:
        raise ControllerError(
            f"{where} under any PID placed for {SLOWEST / (2 * np.pi):.2g} to {most / (2 * np.pi):.2g} Hz, while "
            f"commands and sensors are known to be up to {known:.3g} s late; expected less, or gains of one's own"
        )
    why = "" if driven[joint] else ", and it has no actuator"
    raise ControllerError(
        f"{where}{why}; no PID of the driven joints "
        f"({', '.join(np.array(spec.joints)[driven])}) keeps it there, which takes a controller of all states together"
    )


def looked_at(dynamics: Dynamics, spec: PlantSpec, pose: Array) -> tuple[list[tuple[Array, Linear]], NDArray[np.bool_]]:
    """The robot about where it begins and about other poses, and (nj,) joints on which an actuator acts.

    Raises:
        ControllerError: where none acts on any.
    """
    found = [(q, dynamics.linear(q)) for q in _poses(dynamics, spec, pose)]
    driven = np.any([np.any(own.drive != 0, axis=1) for _, own in found], axis=0)
    if not driven.any():
        raise ControllerError(
            f"{dynamics.robot.name}: no command exerts anything on a joint at rest, in any pose looked at; "
            "a controller needs an actuator that does"
        )
    # Where a joint without actuator does not rest, nothing can be said of a linear loop.
    rests = [np.all(np.abs(dynamics.holding(q)[1])[~driven] < HELD) for q, _ in found]
    return [own for k, own in enumerate(found) if k == 0 or rests[k]], driven


def _poses(dynamics: Dynamics, spec: PlantSpec, pose: Array) -> Iterator[Array]:
    yield pose
    turn = np.array([np.pi if unit == "rad" else 0.0 for unit in spec.joint_units])
    low = np.where(np.isfinite(spec.joint_low), np.maximum(spec.joint_low, pose - turn), pose - turn)
    high = np.where(np.isfinite(spec.joint_high), np.minimum(spec.joint_high, pose + turn), pose + turn)
    for row in latin_hypercube(POSES, len(pose), np.random.default_rng(0)):
        yield low + row * (high - low)


@dataclass(frozen=True, eq=False)
class Own:
    """What driven joints have by themselves in the poses looked at, by inertia.

    Attributes:
        stiffness: (nj,) the least of each joint, others at rest [1/s²].
        damping: (nj,) alike [1/s].
        falls: the least stiffness in any direction, 0 where that is not below 0 [1/s²].
        undamped: the least damping in any direction [1/s].
    """

    stiffness: Array
    damping: Array
    falls: float
    undamped: float

    @classmethod
    def of(cls, poses: Sequence[Linear], driven: NDArray[np.bool_]) -> Own:
        """Of a robot about poses."""
        inertia = np.array([np.diag(own.mass) for own in poses])
        stiffness = np.array([np.diag(own.stiffness) for own in poses]) / inertia
        damping = np.array([np.diag(own.damping) for own in poses]) / inertia
        each = np.ix_(driven, driven)

        def least(matrix: Array, mass: Array) -> float:
            return float(eigh(((matrix + matrix.T) / 2)[each], mass[each], eigvals_only=True)[0])

        falls = min(least(own.stiffness, own.mass) for own in poses)
        undamped = min(least(own.damping, own.mass) for own in poses)
        return cls(stiffness.min(axis=0), damping.min(axis=0), min(falls, 0.0), undamped)


def _settings(spec: PlantSpec, driven: NDArray[np.bool_], omega: float, own: Own, late: float) -> PidSettings:
    gains = {}
    for j, joint in enumerate(spec.joints):
        stiffness, damping = float(own.stiffness[j]), float(own.damping[j])
        placed = _gains(omega, stiffness, damping, own.falls or stiffness, own.undamped)
        gains[joint] = placed if driven[j] else PidGains(0.0)
    return PidSettings(gains, "joint", derivative_time=late, tracking_time=2 / omega, inverse=True, decoupled=True)


def _gains(omega: float, stiffness: float, damping: float, falls: float, undamped: float) -> PidGains:
    """Of a joint with stiffness and damping of its own, and the least of both in any direction."""
    third = max(THIRD * omega, damping - 2 * DAMPING * omega)
    whole = omega**2 + 2 * DAMPING * omega * third
    kp = max(whole - falls, 0.0)
    ki = max(omega**2 * third, stiffness * THIRD * omega / (1 + 2 * DAMPING * THIRD))
    return PidGains(kp, ki, max((2 * DAMPING + THIRD) * omega - undamped, 0.0))


class Loop:
    """The sampled loop of all joints about a pose.

    Args:
        q: (nj,) the pose [rad or m].
        linear: the robot there.
        driven: (nj,) joints on which an actuator acts.
        dynamics: of the robot.
        valve: (na, 6) between commands and actuators.
        dt: control period [s].
        sensor: (nj,) by how much measurements are late [s].
    """

    def __init__(
        self, q: Array, linear: Linear, driven: NDArray[np.bool_], dynamics: Dynamics, valve: Array, dt: float,
        sensor: Array,
    ) -> None:  # fmt: skip
        a, b, _ = with_valves(*linear.matrices(), valve_lag(valve))
        n, na = b.shape
        whole = np.zeros((n + na, n + na))
        whole[:n, :n], whole[:n, n:] = a, b
        stepped = expm(whole * dt)
        self._a, self._b, self._dt = stepped[:n, :n], stepped[:n, n:], dt
        self._joints = len(linear.mass)
        # Accelerations of joints → commands, as ``controllers.exact_pid`` has it.
        weight = dynamics.effective_mass(q, driven)
        self._map = np.column_stack([dynamics.answer(linear.drive, column) for column in weight.T])
        self._periods, self._seen = (np.ceil(x / dt - 1e-9).astype(int) for x in (valve[:, DELAY], sensor))

    def growth(self, settings: PidSettings, factor: float) -> tuple[float, int]:
        """Largest |eigenvalue| of the sampled loop with gains so many times as large, and the joint it moves most."""
        gains = [settings.gains[name] for name in settings.gains]
        kp, ki, kd = (factor * np.array([getattr(g, key) for g in gains]) for key in ("kp", "ki", "kd"))
        nj, n, (na, held), dt = self._joints, len(self._a), (len(self._map), int(self._periods.max())), self._dt
        share = dt / (settings.derivative_time + dt)
        size, behind = n + 3 * nj + na * held, int(self._seen.max())

        def after(state: Array) -> Array:
            x, (i, d, before) = state[:n], np.split(state[n : n + 3 * nj], 3)
            late, before_now = state[n + 3 * nj : size].reshape(held, na), state[size:].reshape(behind, nj)
            angles = np.vstack([x[None, :nj], before_now])
            y = angles[self._seen, np.arange(nj)]
            d = d + share * ((before - y) / dt - d)
            u = self._map @ (-kp * y + i + kd * d)
            line = np.vstack([u[None], late])
            arrives = line[self._periods, np.arange(na)]
            x = self._a @ x + self._b @ arrives
            return np.concatenate([x, (ki > 0) * (i - dt * ki * y), d, y, line[:held].ravel(), angles[:behind].ravel()])

        matrix = np.column_stack([after(column) for column in np.eye(size + nj * behind)])
        values, vectors = np.linalg.eig(matrix)
        k = int(np.argmax(np.abs(values)))
        return float(np.abs(values[k])), int(np.argmax(np.abs(vectors[:nj, k])))
