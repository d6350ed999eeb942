"""What regulators allow: errors, velocities and efforts that cost as much as one another.

Where commands are pressures, the settings say it. Any other robot is weighed by Bryson's rule (Bryson & Ho, *Applied
Optimal Control*, 1975, section 5.2): an error by a share of the half range of its joint, and a command by how far it
accelerates any joint compared with

    ρ_j = ω² α_j,    β_j = ω α_j / √(4 ζ² − 2)

so that a joint that an actuator of its own drives gets the poles s² + 2 ζ ω s + ω², and its acceptable
deviation α_j takes no part;
where joints outnumber actuators, α says which of them matters. ω begins at a share of what dead times, late sensors
and the control period allow; lags are states that the regulator knows. It is lowered until the sampled loop, observer
and unknown torques included, is stable in every pose looked at: as it is, with gains raised, and with what usually
stands between commands and forces unknown, when it also has to die away where the robot begins. Where commands are cut
off, a robot that falls has to be brought back from a share of where that can be done at all (``controllers.catching``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from equimus_ctrl.controllers.catching import CAUGHT, Falls
from equimus_ctrl.controllers.placement import DAMPING, DECAYS, GROWS, PHASE, RAISED, SLOWEST, THIRD, looked_at
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.sensors import SENSOR_DELAY, sensor_settings
from equimus_ctrl.errors import ControllerError, NotAvailable
from equimus_ctrl.estimation.noise_model import NoiseModel, followed
from equimus_ctrl.estimation.observer import ObserverSettings
from equimus_ctrl.models.dynamics import LOST, Dynamics, Linear
from equimus_ctrl.models.linear import valve_lag, with_valves
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import known_lateness, valves_of
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.settings import OTHERS, PRESSURES
from equimus_ctrl.types import Array, PlantSpec

FINER = 2**0.25
"""By so much ω is made smaller each time."""
WHOLE = {"rad": np.pi, "m": 1.0}
"""Longest half range that counts: half a turn, 1 m."""


def settable(robot: Robot) -> tuple[str, ...]:
    """What settings may be for of a regulator that drives a robot, see ``settings.setting``."""
    return (PRESSURES,) if robot.traits.commands_are_pressures else (OTHERS,)


class Settings(Protocol):
    """What settings of regulators have in common."""

    @property
    def angle(self) -> float: ...
    @property
    def rate(self) -> float: ...
    @property
    def pressure(self) -> float: ...
    @property
    def bandwidth(self) -> float: ...
    @property
    def observer(self) -> ObserverSettings: ...


@dataclass(frozen=True, eq=False)
class Allowances:
    """What costs as much as one another.

    Attributes:
        angle: (nj,) errors [rad or m].
        rate: (nj,) velocities [rad/s or m/s].
        effort: (na,) commands beyond what the reference asks for, in their unit; with ω at most, see ``efforts``.
        noise_model: of the observer; None where its settings say it.
        bandwidth: ω [rad/s]; 0 where settings say all.
        late: ω was found stable with what usually stands between commands and forces unknown.
        everywhere: and in all poses looked at, else only where the robot begins.
        dies: what is off dies away about as fast as ω says, all that is slow in the robot included.
        catches: within the limits of commands it brings back what is to be caught, see ``controllers.catching``.
        is_set: somebody set ω.
        usual: (na,) efforts where the robot begins; ``effort`` by default.
        driven: (nj,) joints on which an actuator acts; all by default. Where some have none, a first pose that fades
            out of a reference would be a motion which nothing can do; it is an error then, as any other.
    """

    angle: Array
    rate: Array
    effort: Array
    noise_model: NoiseModel | None = None
    bandwidth: float = 0.0
    late: bool = True
    everywhere: bool = True
    dies: bool = True
    catches: bool = True
    is_set: bool = False
    usual: Array = field(default_factory=lambda: np.empty(0))
    driven: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

    def __post_init__(self) -> None:
        if not len(self.usual):
            object.__setattr__(self, "usual", self.effort)
        if not len(self.driven):
            object.__setattr__(self, "driven", np.ones(len(self.angle), dtype=bool))

    def efforts(self, acceleration: Array) -> Array:
        """(na,) acceptable deviations of commands in a pose.

        Args:
            acceleration: (nj, na) of the joints there, by command.
        """
        if not self.bandwidth:
            return self.effort
        share = np.sqrt(((acceleration / (self.bandwidth**2 * self.angle)[:, None]) ** 2).sum(axis=0))
        works = share > LOST * share.max()  # what does nothing costs nothing either way
        return np.minimum(1 / np.where(works, share, 1.0), np.where(np.isfinite(self.effort) | works, self.effort, 1.0))

    @property
    def note(self) -> str:
        """For a person: where they come from; empty where settings say it."""
        if not self.bandwidth:
            return ""
        only = "" if self.everywhere else ", stable about where it begins but not in all poses of its range"
        slow = "" if self.late else ", and not where commands are later than is known"
        by = " that was set" if self.is_set else ""
        dies = "" if self.dies else ", though what is off may take longer to die away"
        short = (
            ""
            if self.catches
            else f"; limits of commands let it catch less than {100 * CAUGHT:.0f} % of what they let be caught"
        )
        return (
            "weights and observer follow from the masses and ranges for a bandwidth of "
            f"{self.bandwidth / (2 * np.pi):.2g} Hz{by}{only}{slow}{dies}{short}"
        )


def allowances(spec: PlantSpec, settings: Settings, pose: Array, bounded: bool = False) -> Allowances:
    """Of a robot.

    Args:
        spec: of its plant, with a model.
        settings: of the regulator.
        pose: (nj,) where it begins [rad or m].
        bounded: whether commands are cut off at their limits, and nothing else heeds them, so that ω has to.

    Raises:
        ControllerError: where no regulator keeps it where it is, or no equations hold it.
    """
    model, s, nj = Model(spec.model, spec.effects, spec.phase), settings, len(spec.joints)
    if model.robot.traits.commands_are_pressures:
        return Allowances(np.full(nj, s.angle), np.full(nj, s.rate), np.full(len(spec.actuators), s.pressure))
    try:
        dynamics = Dynamics(model)
    except NotAvailable as error:
        raise ControllerError(str(error)) from None
    return _followed(spec, s, pose, dynamics, bounded)


def _followed(spec: PlantSpec, settings: Settings, pose: Array, dynamics: Dynamics, bounded: bool) -> Allowances:
    dt, model = spec.control_dt, dynamics.model
    still, driven = looked_at(dynamics, spec, pose)
    half = _half_ranges(spec)
    angle = settings.angle * half
    loops = [Loop(linear, dynamics, model, dt) for _, linear in still]
    falls: Falls | None = None
    if bounded and not driven.all():
        reach = np.array([dynamics.low, dynamics.high]) - dynamics.holding(pose)[0]
        falls = Falls.of(*loops[0].rates, len(pose), half, reach)
    fastest = PHASE / (1.5 * dt + known_lateness(model, lags=False))
    tried = 2 * np.pi * settings.bandwidth or fastest

    def of(bandwidth: float) -> Allowances:
        own = _of_bandwidth(bandwidth, angle, [own for _, own in still], dynamics, settings.observer.noise, dt)
        return replace(own, driven=driven)

    if settings.bandwidth:
        return _judged(of(tried), loops, dynamics, falls)
    kept: Allowances | None = None
    slow: Allowances | None = None
    risky: Allowances | None = None
    narrow: Allowances | None = None
    while tried >= SLOWEST:
        own = of(tried)
        dies = np.exp(-DECAYS * THIRD * tried * dt) if driven.all() else 1 + GROWS
        first, *others = loops
        if first.stands(own, dies) and not first.catches(own, falls):
            narrow = narrow or replace(
                own, catches=False, everywhere=all(loop.stands(own, 1 + GROWS) for loop in others)
            )
        elif first.stands(own, dies):
            if all(loop.stands(own, 1 + GROWS) for loop in others):
                return own
            kept = kept or replace(own, everywhere=False)
        elif slow is None and first.stands(own, 1 + GROWS):
            every = all(loop.stands(own, 1 + GROWS) for loop in others)
            slow = replace(own, everywhere=every, dies=False)
        elif risky is None and first.growth(own, 0, 1.0) <= 1 + GROWS:
            risky = replace(own, late=False, everywhere=False)
        tried /= FINER
    found = kept or slow or narrow or risky
    if found is not None:
        return found
    joint = int(np.argmax(~driven)) if not driven.all() else 0
    place = reading(spec.joint_units[joint]).text(pose[joint])
    why = (
        f"while commands and sensors are known to be up to {known_lateness(model):.3g} s late; expected less"
        if driven.all()
        else f"for it has no actuator, and {', '.join(np.array(spec.joints)[driven])} cannot hold it"
    )
    raise ControllerError(
        f"{dynamics.robot.name}: no regulator of {SLOWEST / (2 * np.pi):.2g} to {fastest / (2 * np.pi):.2g} Hz keeps "
        f"{spec.joints[joint]} at {place}, where it begins, {why}"
    )


def _judged(own: Allowances, loops: Sequence[Loop], dynamics: Dynamics, falls: Falls | None) -> Allowances:
    """Those of an ω that somebody set, with what holds of it.

    Raises:
        ControllerError: where it does not keep the robot where it begins.
    """
    first, *others = loops
    if first.growth(own, 0, 1.0) > 1 + GROWS:
        raise ControllerError(
            f"{dynamics.robot.name}: with bandwidth {own.bandwidth / (2 * np.pi):.3g} Hz the loop is unstable where "
            "the robot begins; expected another, or 0 for the highest that is stable"
        )
    late = first.stands(own, 1 + GROWS)
    everywhere = late and all(loop.stands(own, 1 + GROWS) for loop in others)
    return replace(own, late=late, everywhere=everywhere, catches=first.catches(own, falls), is_set=True)


def _half_ranges(spec: PlantSpec) -> Array:
    """(nj,) half the joints' ranges, at most half a turn or 1 m [rad or m]."""
    whole = np.array([WHOLE[unit] for unit in spec.joint_units])
    half: Array = (np.asarray(spec.joint_high) - np.asarray(spec.joint_low)) / 2
    return np.asarray(np.minimum(half, whole))


def _of_bandwidth(
    bandwidth: float, angle: Array, poses: Sequence[Linear], dynamics: Dynamics, noise: float, dt: float
) -> Allowances:
    """Those of ω; the observer's by the joints' middling inertia."""
    rate = bandwidth * angle / np.sqrt(4 * DAMPING**2 - 2)
    span = (dynamics.high - dynamics.low) / 2
    bare = Allowances(angle, rate, np.where(span > 0, span, np.inf), None, bandwidth)
    inertia = np.median([1 / np.diag(np.linalg.inv(own.mass)) for own in poses], axis=0)
    usual = bare.efforts(np.linalg.inv(poses[0].mass) @ poses[0].drive)
    return replace(bare, usual=usual, noise_model=followed(inertia, usual, bandwidth, noise, dt))


class Loop:
    """The sampled loop of a robot, its observer and its regulator about a pose.

    Args:
        linear: the robot there.
        dynamics: of the robot.
        model: what is known of it.
        dt: control period [s].

    Attributes:
        unknown: periods by which commands usually are later than is known.
        rates: A (n, n) and B (n, na) of d/dt x, x having what lags behind drives beside angles and velocities.
    """

    def __init__(self, linear: Linear, dynamics: Dynamics, model: Model, dt: float) -> None:
        valve, traits, nj = valves_of(model), model.robot.traits, len(linear.mass)
        a, b, self._slow = with_valves(*linear.matrices(), valve_lag(valve))
        n, na = b.shape
        pushed = np.zeros((n, nj))
        pushed[nj : 2 * nj] = np.linalg.inv(linear.mass)
        whole = np.zeros((n + na + nj, n + na + nj))
        whole[:n] = np.hstack([a, b, pushed])
        stepped = expm(whole * dt)
        self.rates = a, b
        self._a, self._b, self._pushed = stepped[:n, :n], stepped[:n, n : n + na], stepped[:n, n + na :]
        self._f = np.block([[self._a, self._pushed], [np.zeros((nj, n)), np.eye(nj)]])
        self._counter = np.column_stack([dynamics.answer(linear.drive, column) for column in np.eye(nj)])
        self._acceleration = pushed[nj : 2 * nj] @ linear.drive
        self._dt, self._nj = dt, nj
        late = float(valve[:, DELAY].max())
        sensor = sensor_settings(model.effects, model.robot.joint_names)[:, SENSOR_DELAY]
        self._known, self._seen = _periods(late, dt), _periods(float(sensor.max()), dt)
        usual = max(traits.usual_delay - late, 0.0) + max(traits.usual_lag - float(valve_lag(valve).max()), 0.0)
        self.unknown = _periods(usual, dt)

    def stands(self, own: Allowances, most: float) -> bool:
        """Whether it is stable as it is and with gains raised, and grows no more than this where commands are later.

        Of a mode that turns far within a period, less delay or gain may be worse than more: all in between count.
        """
        found = self._gains(own)
        if found is None:
            return False
        raised = all(self._growth(found, 0, RAISED**share) <= 1 + GROWS for share in (0.0, 0.5, 1.0))
        return raised and all(self._growth(found, late, 1.0) <= most for late in range(self.unknown + 1))

    def growth(self, own: Allowances, unknown: int, factor: float) -> float:
        """Largest |eigenvalue| with commands so many periods later than is known, and gains so many times as large."""
        found = self._gains(own)
        return np.inf if found is None else self._growth(found, unknown, factor)

    def catches(self, own: Allowances, falls: Falls | None) -> bool:
        """Whether it brings back what is to be caught within the limits of commands, also where these are later."""
        found = self._gains(own)
        if falls is None or found is None:
            return falls is None
        return all(falls.caught(self, found, own.bandwidth, self._dt, late) for late in {0, self.unknown})

    def run(self, gains: tuple[Array, Array], first: Array, reach: Array, steps: int, unknown: int) -> Array:
        """(steps, n, k) states from (n, k) on, commands cut off at (2, na), so many periods later than is known."""
        nj, a, b, f = self._nj, self._a, self._b, self._f
        (n, na), count = b.shape, first.shape[1]
        low, high = reach[0][:, None], reach[1][:, None]
        fed = np.vstack([b, np.zeros((nj, na))])
        x, mean = first.copy(), np.vstack([first, np.zeros((nj, count))])
        line = [np.zeros((na, count))] * (self._known + self._seen + unknown)
        past = [first[:nj]] * self._seen
        found = np.empty((steps, n, count))
        with np.errstate(over="ignore", invalid="ignore"):  # what falls grows without end
            for k in range(steps):
                y = past[-1] if past else x[:nj]
                mean = mean + gains[1] @ (y - mean[:nj])
                line = [np.clip(self._asked(gains[0], mean, line), low, high), *line]
                x, past = a @ x + b @ line[self._known + unknown], [x[:nj], *past][: self._seen]
                mean, line = f @ mean + fed @ line[self._known + self._seen], line[:-1]
                found[k] = x
        return found

    def _asked(self, gain: Array, mean: Array, line: Sequence[Array]) -> Array:
        """(na, k) what is asked for under estimates (n + nj, k), the latest commands first."""
        nj, (n, na) = self._nj, self._b.shape
        fed = np.vstack([self._b, np.zeros((nj, na))])
        ahead = mean
        for k in range(-self._seen, self._known):
            ahead = self._f @ ahead + fed @ line[self._known - k - 1]
        against = -self._counter @ ahead[n:]
        state = ahead[:n].copy()
        state[2 * nj :] -= against[self._slow]
        return np.asarray(against - gain @ state)

    def _gains(self, own: Allowances) -> tuple[Array, Array] | None:
        """Of the regulator (na, n) and of the observer (n + nj, nj); None where there are none."""
        nj, dt, a, b = self._nj, self._dt, self._a, self._b
        weight = np.zeros(len(a))
        weight[: 2 * nj] = dt / np.concatenate([own.angle, own.rate]) ** 2
        effort = np.diag(dt / own.efforts(self._acceleration) ** 2)
        try:
            cost = solve_discrete_are(a, b, np.diag(weight), effort)
            return np.linalg.solve(effort + b.T @ cost @ b, b.T @ cost @ a), self._filter(own)
        except (np.linalg.LinAlgError, ValueError):
            return None

    def _growth(self, gains: tuple[Array, Array], unknown: int, factor: float) -> float:
        nj, a, b = self._nj, self._a, self._b
        n, na = b.shape
        gain, found, f = factor * gains[0], gains[1], self._f
        fed = np.vstack([b, np.zeros((nj, na))])
        known, seen = self._known, self._seen
        held = known + seen + unknown
        m = n + nj
        size = n + m + na * held + nj * seen
        x, mean, commands, angles = np.split(np.eye(size), np.cumsum([n, m, na * held]))
        line, past = np.split(commands, held) if held else [], np.split(angles, seen) if seen else []
        y = past[-1] if seen else x[:nj]
        mean = mean + found @ (y - mean[:nj])
        line = [self._asked(gain, mean, line), *line]
        later = [*([x[:nj]] if seen else []), *past][:seen]
        after = [a @ x + b @ line[known + unknown], f @ mean + fed @ line[known + seen], *line[:held], *later]
        return float(np.abs(np.linalg.eigvals(np.vstack(after))).max())

    def _filter(self, own: Allowances) -> Array:
        """(n + nj, nj) the settled gain of the observer."""
        assert own.noise_model is not None
        nj, dt, n, assumed, f = self._nj, self._dt, len(self._a), own.noise_model, self._f
        kick = self._pushed * (assumed.torque / np.sqrt(dt))
        noise = np.zeros_like(f)
        noise[:n, :n] = kick @ kick.T
        lagging = np.arange(2 * nj, n)
        noise[lagging, lagging] += dt * assumed.pressure[self._slow] ** 2
        noise[n:, n:] = np.diag(dt * assumed.walk**2)
        see = np.eye(nj, len(f))
        error = np.diag(np.full(nj, assumed.noise**2))
        spread = solve_discrete_are(f.T, see.T, noise, error)
        return np.asarray(np.linalg.solve(spread[:nj, :nj] + error, spread[:nj]).T)


def _periods(time: float, dt: float) -> int:
    return int(np.ceil(time / dt - 1e-9))
