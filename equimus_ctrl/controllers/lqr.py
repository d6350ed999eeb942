"""A linear quadratic regulator of any robot along a reference, on what an observer knows from angles and commands.

    u = w + c − K(q_r) (x̂ − x_r),    K minimises ½ Σ (xᵀQx + uᵀRu) dt    about q_r, sampled

x are angles, velocities, pressures behind valves with a lag, commands still under way and the integral of the angles'
errors; w is what the inverse model asks of the valves along the reference, and c holds against the torque that the
observer cannot explain. x̂ is predicted to when the command arrives. Gains are worked out on a grid of poses and
interpolated in between. Of a robot whose commands are no pressures, these take their place, a servo's own feedback is
part of what K is found for, and as much of a reference's motion is fed forward as the actuators can do.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.allowances import Allowances, allowances, settable
from equimus_ctrl.controllers.inverse import Inverse, InverseState, Target
from equimus_ctrl.controllers.valve_estimation import ObservedState, ValveEstimation, bank_of, found_out
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import Estimate, Observer, ObserverSettings, require_model
from equimus_ctrl.estimation.valve_bank import ValveBank
from equimus_ctrl.models.linear import sampled, valve_lag
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.settings import OTHERS, PRESSURES, FileSettings, both, setting
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

FORMAT = "equimus-ctrl/lqr/1"
CALM = 0.005
"""What unknown torques walk in a second, see ``ObserverSettings``."""
MOST_POSES = 200
"""Of a grid that is worked out beforehand."""
COARSER = 2.0
"""By so much poses are further apart where these are more: gains are then worked out on the way."""
MISSED = 1e-3
"""A command by this share of its acceptable deviation off what was asked for is no longer taken as given."""


@dataclass(frozen=True)
class LqrSettings(FileSettings):
    """Settings of the regulator. An error as large as is acceptable costs as much as an effort as large as is.

    Attributes:
        angle: acceptable error of angles [rad]; of a robot whose commands are no pressures by half the joints' ranges.
        rate: of velocities [rad/s], where commands are pressures.
        pressure: of commands beyond what the reference asks for [Pa], where they are pressures.
        bandwidth: of any other robot, from which these two and the observer follow (``controllers.allowances``) [Hz]; 0
            for as much as what is late allows.
        integral: of the integral of an angle's error [rad·s]; 0 for none, which leaves the way to no offset at rest to
            ``disturbance``: an integral also keeps what gathered while nothing could be done, as before a first command
            has arrived.
        disturbance: whether torques that the observer cannot explain are held against.
        estimate_valves: whether dead times and lags up to the usual ones are found that nobody told of, see
            ``controllers.valve_estimation``.
        spacing: of the grid of poses that gains are worked out at [rad].
        start_time: over which the first pose fades out of the reference, where every joint has an actuator [s].
        observer: covariances of the Kalman filter; by default unknown torques walk slowly. What compensates them is an
            integral action, which would oscillate with valves of more delay than the model has.

    Raises:
        ConfigError: for numbers that are none of these.
    """

    form: ClassVar[str] = FORMAT

    angle: float = 0.03
    rate: float = setting(1.0, PRESSURES)
    pressure: float = setting(1e3, PRESSURES)
    bandwidth: float = setting(0.0, OTHERS)
    integral: float = 0.0
    disturbance: bool = True
    estimate_valves: bool = True
    spacing: float = 0.2
    start_time: float = 0.3
    observer: ObserverSettings = field(default_factory=lambda: ObserverSettings(disturbance=CALM))

    def __post_init__(self) -> None:
        for key in ("angle", "rate", "pressure", "spacing"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{key} is {value:g}, expected more than 0")
        for key in ("bandwidth", "integral", "start_time"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected at least 0")

    def alike(self, nj: int, na: int) -> Allowances:
        """Acceptable deviations that are alike for all of nj joints and na actuators."""
        return Allowances(np.full(nj, self.angle), np.full(nj, self.rate), np.full(na, self.pressure))


@dataclass(frozen=True, eq=False)
class Regulator:
    """The regulator about one pose.

    Attributes:
        a: (n, n) of the sampled robot: angles, velocities, pressures behind a lag, commands under way (the next to
            arrive first), integrals.
        b: (n, na).
        q: (n, n) cost of a sample's state, times dt.
        r: (na, na) of its command.
        gain: (na, n) K.
        cost: (n, n) P: from a state x on it all costs ½ xᵀPx.
        effort: (na,) acceptable deviations of commands there.
    """

    a: Array
    b: Array
    q: Array
    r: Array
    gain: Array
    cost: Array
    effort: Array


def regulator(
    model: Model,
    pose: Array,
    settings: LqrSettings,
    dt: float,
    allowed: Allowances | None = None,
) -> Regulator:
    """The regulator of a model about a pose (nj,) [rad], sampled with dt [s].

    Args:
        model: what is known of the robot.
        pose: about which.
        settings: of the regulator.
        dt: of the sampling.
        allowed: in place of the settings' acceptable deviations of angles, rates and pressures.

    Raises:
        ControllerError: where no gains make the robot stable there.
    """
    about, own = sampled(model, tuple(pose.tolist()), dt), allowed or settings.alike(*_sizes(model))
    weights = own.angle, own.rate, own.efforts(about.authority)
    return _regulator(model, tuple(pose.tolist()), dt, settings.integral, *(tuple(w.tolist()) for w in weights))


def _sizes(model: Model) -> tuple[int, int]:
    """How many joints and how many actuators."""
    return len(model.robot.joint_names), len(model.robot.actuator_names)


@lru_cache(maxsize=512)
def _regulator(
    model: Model,
    pose: tuple[float, ...],
    dt: float,
    integral: float,
    angle: tuple[float, ...],
    rate: tuple[float, ...],
    effort: tuple[float, ...],
) -> Regulator:
    """The same by its numbers: who drives many robots with one model works it out once."""
    import control  # takes half a second, which most commands can do without

    about = sampled(model, pose, dt)
    (n, na), nj = about.b.shape, len(pose)
    under_way = waiting(model, dt)
    m = n + int(under_way.sum()) + (nj if integral else 0)
    full_a, full_b, q = np.zeros((m, m)), np.zeros((m, na)), np.zeros((m, m))
    full_a[:n, :n] = about.a
    first = n
    for i, count in enumerate(under_way):
        if count:
            full_a[:n, first] = about.b[:, i]
            full_a[first : first + count - 1, first + 1 : first + count] = np.eye(count - 1)
            full_b[first + count - 1, i] = 1.0
        else:
            full_b[:n, i] = about.b[:, i]
        first += count
    if integral:
        full_a[first:, :nj], full_a[first:, first:] = dt * np.eye(nj), np.eye(nj)
        q[first:, first:] = np.eye(nj) / integral**2
    q[:nj, :nj], q[nj : 2 * nj, nj : 2 * nj] = np.diag(1 / np.array(angle) ** 2), np.diag(1 / np.array(rate) ** 2)
    q, r = q * dt, np.diag(dt / np.array(effort) ** 2)
    try:
        gain, cost, _ = control.dlqr(full_a, full_b, q, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        shown = ", ".join(f"{value:.3g}" for value in pose)
        raise ControllerError(f"{model.name}: no regulator was found about the pose {shown} ({error})") from error
    return Regulator(*(frozen_array(own) for own in (full_a, full_b, q, r, gain, cost, effort)))


def waiting(model: Model, dt: float) -> NDArray[np.int64]:
    """(na,) how many samples longer a command is under way than one of the quickest actuator."""
    delay = valves_of(model)[:, DELAY]
    return np.asarray(np.rint((delay - delay.min()) / dt), dtype=np.int64)


class Schedule:
    """Gains between the poses of a grid, each worked out when it is first asked for.

    Args:
        model: what is known of the robot.
        settings: of the regulator.
        dt: of the sampling [s].
        allowed: in place of the settings' acceptable deviations.
    """

    def __init__(self, model: Model, settings: LqrSettings, dt: float, allowed: Allowances | None = None) -> None:
        self.model, self.settings, self.dt = model, settings, dt
        self.allowed = allowed or settings.alike(*_sizes(model))
        # A joint without ends has its poses a spacing apart, as many as are asked for.
        low, high = (np.asarray(side) for side in model.robot.joint_range)
        ends, spacing = np.isfinite(low) & np.isfinite(high), settings.spacing
        cells = np.maximum(np.ceil((high - low) / spacing), 1)
        self._is_small = bool(np.all(ends) and np.prod(cells + 1) <= MOST_POSES)
        if not self._is_small:
            spacing *= COARSER
        low, high = np.where(ends, low, 0.0), np.where(ends, high, spacing)
        self._ends: list[bool] = ends.tolist()
        self._low, self._high = low.tolist(), high.tolist()
        self._cells: list[int] = np.maximum(np.ceil((high - low) / spacing), 1).astype(int).tolist()
        self._lagging = np.flatnonzero(valve_lag(valves_of(model)) > 0)
        self._known: dict[tuple[int, ...], Regulator] = {}

    def gain(self, pose: Array) -> Array:
        """(na, n) gains at a pose (nj,) [rad], or at the nearest within the joint ranges."""
        return self._between(pose, lambda found: found.gain)

    def cost(self, pose: Array) -> Array:
        """(n, n) P at a pose, as of ``gain``."""
        return self._between(pose, lambda found: found.cost)

    def effort(self, pose: Array) -> Array:
        """(na,) acceptable deviations of commands at a pose, as of ``gain``."""
        return self._between(pose, lambda found: found.effort) if self.allowed.bandwidth else self.allowed.effort

    def correction(self, known: Estimate, target: Target, against: Array, others: Sequence[Array]) -> Array:
        """(na,) by how much more is to reach the valves than the reference asks for [Pa].

        Args:
            known: where the robot is when the next command first arrives.
            target: where it is to be then.
            against: (na,) what holds against torques that the model does not explain [Pa].
            others: commands under way beyond what was asked for, actuator by actuator, and the integrals where the
                settings have them.
        """
        pressure = (known.pressure - target.pressure - against)[self._lagging]
        off = [known.position - target.position, known.velocity - target.velocity, pressure, *others]
        return np.asarray(-self.gain(target.position) @ np.concatenate(off))

    def prepare(self) -> None:
        """Work out the gains of every pose of the grid, unless these are too many; where there are none, go on."""
        if self._is_small:
            for key in itertools.product(*(range(count + 1) for count in self._cells)):
                with suppress(ControllerError):
                    self._node(key)

    def _between(self, pose: Array, read: Callable[[Regulator], Array]) -> Array:
        sides = []
        for at, low, high, cells, ends in zip(
            pose.tolist(), self._low, self._high, self._cells, self._ends, strict=True
        ):
            if ends:
                place = min(max((at - low) / (high - low), 0.0), 1.0) * cells
                below = min(int(place), cells - 1)
            else:
                place = (at - low) / (high - low)
                below = math.floor(place)
            sides.append(((below, 1 - (place - below)), (below + 1, place - below)))
        found = np.zeros(())
        for corner, weight in _corners(sides) if self._is_small else _nearest_corners(sides):
            if weight > 0:
                found = found + weight * read(self._node(corner))
        return found

    def _node(self, key: tuple[int, ...]) -> Regulator:
        if key not in self._known:
            low, high = np.array(self._low), np.array(self._high)
            pose = low + (high - low) * np.array(key) / self._cells
            self._known[key] = regulator(self.model, pose, self.settings, self.dt, self.allowed)
        return self._known[key]


Sides = Sequence[tuple[tuple[int, float], tuple[int, float]]]
"""Of each joint the numbers of the poses below and above, and their shares."""


def _corners(sides: Sides) -> Iterator[tuple[tuple[int, ...], float]]:
    """All corners of a cell, and their shares."""
    for corner in itertools.product(*sides):
        yield tuple(index for index, _ in corner), math.prod(share for _, share in corner)


def _nearest_corners(sides: Sides) -> Iterator[tuple[tuple[int, ...], float]]:
    """Corners of the simplex of a cell that holds the place, one more than joints (Kuhn's triangulation)."""
    key = [below for (below, _), _ in sides]
    shares = [share for _, (_, share) in sides]
    order = sorted(range(len(sides)), key=lambda joint: -shares[joint])
    before = 1.0
    for joint in order:
        yield tuple(key), before - shares[joint]
        before = shares[joint]
        key[joint] += 1
    yield tuple(key), before


@dataclass(frozen=True, eq=False)
class LqrState(ObservedState):
    """What the regulator carries from step to step.

    Attributes:
        inverse: how far the reference has been followed.
        integral: (nj,) of the angles' errors [rad·s].
        under_way: for each actuator commands beyond what the reference asked for, the next to arrive first [Pa].
        possible: of the latest instants, what share of the reference's motion can be done.
    """

    tools: LqrTools
    inverse: InverseState
    integral: Array
    under_way: tuple[Array, ...]
    possible: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class LqrTools:
    """What is made once for a plant."""

    observer: Observer
    inverse: Inverse
    schedule: Schedule
    dt: float

    def nothing_under_way(self) -> tuple[Array, ...]:
        """For each actuator, see ``LqrState``: what was asked for is what the reference asks for."""
        return tuple(np.zeros(count) for count in waiting(self.observer.model, self.dt))

    def taken_over(self, state: LqrState) -> dict[str, Any]:
        """The fields of a state that these tools' valves change."""
        followed = self.inverse.taken_over(state.inverse)
        return {"inverse": followed, "under_way": self.nothing_under_way(), "possible": ()}


class LqrController:
    """The regulator; its state is a ``LqrState``.

    Args:
        settings: of it.
        in_time: whether gains are worked out before the first step, else as they are needed.
        said: of its settings, for a person to read; stands before what it says itself.
    """

    name = "lqr"

    def __init__(self, settings: LqrSettings | None = None, in_time: bool = True, said: str = "") -> None:
        self.settings = settings or LqrSettings()
        self._in_time, self._said = in_time, said

    def init(self, spec: PlantSpec, observation: Observation) -> LqrState:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model, or one without equations, or no regulator keeps the robot
                where it is.
            ConfigError: where a setting changes nothing of the robot.
        """
        s, position = self.settings, np.array(observation.position)
        require_model(spec)
        s.check_idle(settable(spec.model), self.name, spec.model.name)
        allowed = allowances(spec, s, position, bounded=True)

        def made(own: PlantSpec, bank: ValveBank | None = None) -> LqrTools:
            observer = Observer.of(own, s.observer, noise_model=allowed.noise_model, bank=bank)
            model, dt = observer.model, own.control_dt
            inverse = Inverse(model, dt, s.start_time if allowed.driven.all() else 0.0)
            return LqrTools(observer, inverse, Schedule(model, s, dt, allowed), dt)

        bank = bank_of(spec, s.estimate_valves)
        tools = made(spec, bank)
        if self._in_time:
            tools.schedule.prepare()
        begun = tools.observer.init(observation)
        followed, none = tools.inverse.start(observation.time, position), np.zeros(len(position))
        note = both(self._said, allowed.note)
        estimation = None if bank is None else ValveEstimation(spec, tools, made, note)
        watched = None if bank is None else begun
        return LqrState(begun, tools, note, estimation, watched, followed, none, tools.nothing_under_way())

    def step(self, observation: Observation, reference: Reference, state: LqrState) -> tuple[Array, LqrState]:
        """The next command, within the plant's limits.

        Raises:
            ObserverFault: where a joint was not measured for longer than the observer has patience.
        """
        state = found_out(observation, state)
        t, s, known = state.tools, self.settings, state.observer
        t.observer.require_sound(known)
        ahead = t.observer.foresee(known, observation.time + float(t.observer.delays.min()))
        target, followed = t.inverse.target(reference, observation.time, state.inverse)
        # A step is differentiated to a motion there and back, of which half may be possible.
        possible = t.inverse.possible(reference, observation.time, state.inverse, state.possible)
        target = t.inverse.toned(target, min(possible), reference, observation.time, state.inverse)
        against = np.zeros(len(t.observer.delays))
        if s.disturbance:
            against = -t.inverse.counter(ahead.position, ahead.disturbance)
        error = ahead.position - target.position
        others = [*state.under_way, state.integral] if s.integral else state.under_way
        asked = target.feed + against + t.schedule.correction(ahead, target, against, others)
        command = t.inverse.commands(asked[None])[0]
        arriving = t.inverse.arriving(command[None])[0]
        integral = state.integral
        missed = np.abs(arriving - asked) / t.schedule.allowed.usual
        if missed.max() < MISSED:  # else it would wind up against a limit
            integral = integral + t.dt * error
        beyond = arriving - target.feed - against
        under_way = tuple(
            np.append(old[1:], new) if len(old) else old for old, new in zip(state.under_way, beyond, strict=True)
        )
        return frozen_array(command), replace(
            state, inverse=followed, integral=integral, under_way=under_way, possible=possible
        )
