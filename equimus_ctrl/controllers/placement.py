"""Gains of a PID for the joints of a robot that nobody has tuned, by pole placement.

Decoupled by the mass matrix (``PidSettings.decoupled``), each joint gets the characteristic polynomial

    (s² + 2 ζ ω s + ω²)(s + α ω)

    k_p = ω² (1 + 2 ζ α) − κ,    k_d = ω (2 ζ + α) − δ,    k_i = α ω (k_p + κ)/(1 + 2 ζ α)

none below 0. κ and δ are the least stiffness and damping by inertia that the robot has by itself in any pose looked
at, the least eigenvalues of K v = κ M v and D v = δ M v: a servo that is stiffer by itself keeps what it has, and gets
the integral alone (Åström & Hägglund, *Advanced PID Control*, 2006, chapter 6). ω begins at a share of what dead times,
lags and the control period allow, and is halved until the sampled loop of all joints, delays included, is stable in
every pose, with its gains as they are and raised; where no ω does that, in the pose in which it begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, expm

from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.errors import ControllerError
from equimus_ctrl.models.dynamics import Dynamics, Linear
from equimus_ctrl.models.linear import valve_lag, with_valves
from equimus_ctrl.models.solved import valves_of
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
        bare = _gains(self.bandwidth, 0.0, 0.0)
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
    valve = valves_of(dynamics.model)
    late = 1.5 * spec.control_dt + float(valve[:, DELAY].max()) + float(valve_lag(valve).max())
    found = [(q, dynamics.linear(q)) for q in _poses(dynamics, spec, pose)]
    driven = np.any([np.any(own.drive != 0, axis=1) for _, own in found], axis=0)
    # Where a joint without actuator does not rest, nothing can be said of a linear loop.
    rests = [np.all(np.abs(dynamics.holding(q)[1])[~driven] < HELD) for q, _ in found]
    still = [own for k, own in enumerate(found) if k == 0 or rests[k]]
    joint = 0
    for part in (still, still[:1]):
        stiffness = min(_least(own.stiffness, own.mass, driven) for _, own in part)
        damping = min(_least(own.damping, own.mass, driven) for _, own in part)
        loops = [Loop(q, own, driven, dynamics, valve, spec.control_dt) for q, own in part]
        omega = PHASE / (2 * late)
        while omega >= SLOWEST:
            settings = _settings(spec, driven, omega, stiffness, damping, late)
            growth = [loop.growth(settings, factor) for loop in loops for factor in (1.0, RAISED)]
            if max(size for size, _ in growth) <= 1 + GROWS:
                return Placed(settings, omega, everywhere=part is still)
            omega /= 2
        joint = growth[0][1]
    place = reading(spec.joint_units[joint]).text(pose[joint])
    why = "" if driven[joint] else ", and it has no actuator"
    raise ControllerError(
        f"{dynamics.robot.name}: {spec.joints[joint]} moves away from {place}{why}; no PID of the driven joints "
        f"({', '.join(np.array(spec.joints)[driven])}) keeps it there, which takes a controller of all states together"
    )


def _poses(dynamics: Dynamics, spec: PlantSpec, pose: Array) -> Iterator[Array]:
    yield pose
    turn = np.array([np.pi if unit == "rad" else 0.0 for unit in spec.joint_units])
    low = np.where(np.isfinite(spec.joint_low), np.maximum(spec.joint_low, pose - turn), pose - turn)
    high = np.where(np.isfinite(spec.joint_high), np.minimum(spec.joint_high, pose + turn), pose + turn)
    for row in latin_hypercube(POSES, len(pose), np.random.default_rng(0)):
        yield low + row * (high - low)


def _least(matrix: Array, mass: Array, driven: NDArray[np.bool_]) -> float:
    """The least eigenvalue of a matrix by the mass matrix, of driven joints."""
    own = np.ix_(driven, driven)
    even = ((matrix + matrix.T) / 2)[own]
    return float(eigh(even, mass[own], eigvals_only=True)[0])


def _settings(
    spec: PlantSpec, driven: NDArray[np.bool_], omega: float, stiffness: float, damping: float, late: float
) -> PidSettings:
    own = _gains(omega, stiffness, damping)
    gains = {joint: own if acts else PidGains(0.0) for joint, acts in zip(spec.joints, driven, strict=True)}
    return PidSettings(gains, "joint", derivative_time=late, tracking_time=2 / omega, inverse=True, decoupled=True)


def _gains(omega: float, stiffness: float, damping: float) -> PidGains:
    whole = 1 + 2 * DAMPING * THIRD
    kp = max(omega**2 * whole - stiffness, 0.0)
    kd = max(omega * (2 * DAMPING + THIRD) - damping, 0.0)
    return PidGains(kp, max((kp + stiffness) * THIRD * omega / whole, 0.0), kd)


class Loop:
    """The sampled loop of all joints about a pose.

    Args:
        q: (nj,) the pose [rad or m].
        linear: the robot there.
        driven: (nj,) joints on which an actuator acts.
        dynamics: of the robot.
        valve: (na, 6) between commands and actuators.
        dt: control period [s].
    """

    def __init__(
        self, q: Array, linear: Linear, driven: NDArray[np.bool_], dynamics: Dynamics, valve: Array, dt: float
    ) -> None:
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
        self._periods = np.ceil(valve[:, DELAY] / dt - 1e-9).astype(int)

    def growth(self, settings: PidSettings, factor: float) -> tuple[float, int]:
        """Largest |eigenvalue| of the sampled loop with gains so many times as large, and the joint it moves most."""
        gains = [settings.gains[name] for name in settings.gains]
        kp, ki, kd = (factor * np.array([getattr(g, key) for g in gains]) for key in ("kp", "ki", "kd"))
        nj, n, (na, held), dt = self._joints, len(self._a), (len(self._map), int(self._periods.max())), self._dt
        share = dt / (settings.derivative_time + dt)
        size = n + 3 * nj + na * held

        def after(state: Array) -> Array:
            x, (i, d, before) = state[:n], np.split(state[n : n + 3 * nj], 3)
            y, late = x[:nj], state[n + 3 * nj :].reshape(held, na)
            d = d + share * ((before - y) / dt - d)
            u = self._map @ (-kp * y + i + kd * d)
            line = np.vstack([u[None], late])
            arrives = line[self._periods, np.arange(na)]
            x = self._a @ x + self._b @ arrives
            return np.concatenate([x, (ki > 0) * (i - dt * ki * y), d, y, line[:held].ravel()])

        matrix = np.column_stack([after(column) for column in np.eye(size)])
        values, vectors = np.linalg.eig(matrix)
        k = int(np.argmax(np.abs(values)))
        return float(np.abs(values[k])), int(np.argmax(np.abs(vectors[:nj, k])))
