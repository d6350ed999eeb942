"""A linear quadratic regulator along a reference, on what an observer knows from angles and commands.

    u = w + c − K(q_r) (x̂ − x_r),    K minimises ½ Σ (xᵀQx + uᵀRu) dt    about q_r, sampled

x are angles, velocities, pressures behind valves with a lag, commands still under way and the integral of the angles'
errors; w is what the inverse model asks of the valves along the reference, and c holds against the torque that the
observer cannot explain. x̂ is predicted to when the command arrives. Gains are worked out on a grid of poses and
interpolated in between.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.inverse import Inverse, InverseState, Target
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import Estimate, Observer, ObserverSettings, ObserverState
from equimus_ctrl.models.linear import linearise, valve_lag
from equimus_ctrl.models.model import Model
from equimus_ctrl.settings import FileSettings
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

FORMAT = "equimus-ctrl/lqr/1"
CALM = 0.005
"""What unknown torques walk in a second, see ``ObserverSettings``."""
MOST_POSES = 200
"""Of a grid that is worked out beforehand."""
MISSED = 1.0
"""A command by so much off what was asked for is no longer taken as given [Pa]."""


@dataclass(frozen=True)
class LqrSettings(FileSettings):
    """Settings of the regulator. An error as large as its allowance costs as much as an effort as large as its own.

    Attributes:
        angle: allowance of angles [rad].
        rate: of velocities [rad/s].
        pressure: of commands beyond what the reference asks for [Pa].
        integral: of the integral of an angle's error [rad·s]; 0 for none, which leaves the way to no offset at rest to
            ``disturbance``: an integral also keeps what gathered while nothing could be done, as before a first command
            has arrived.
        disturbance: whether torques that the observer cannot explain are held against.
        spacing: of the grid of poses that gains are worked out at [rad].
        start_time: over which the first pose fades out of the reference [s].
        observer: covariances of the Kalman filter; by default unknown torques walk slowly. What compensates them is an
            integral action, which would oscillate with valves of more delay than the model has.

    Raises:
        ConfigError: for numbers that are none of these.
    """

    form: ClassVar[str] = FORMAT

    angle: float = 0.03
    rate: float = 1.0
    pressure: float = 1e3
    integral: float = 0.0
    disturbance: bool = True
    spacing: float = 0.2
    start_time: float = 0.3
    observer: ObserverSettings = field(default_factory=lambda: ObserverSettings(disturbance=CALM))

    def __post_init__(self) -> None:
        for key in ("angle", "rate", "pressure", "spacing"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{key} is {value:g}, expected more than 0")
        for key in ("integral", "start_time"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected at least 0")


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
    """

    a: Array
    b: Array
    q: Array
    r: Array
    gain: Array
    cost: Array


def regulator(model: Model, pose: Array, settings: LqrSettings, dt: float) -> Regulator:
    """The regulator of a model about a pose (nj,) [rad], sampled with dt [s].

    Raises:
        ControllerError: where no gains make the robot stable there.
    """
    import control  # takes half a second, which most commands can do without

    sampled = control.c2d(linearise(model, pose), dt)
    n, na, nj = sampled.nstates, sampled.ninputs, len(pose)
    under_way = waiting(model, dt)
    m = n + int(under_way.sum()) + (nj if settings.integral else 0)
    full_a, full_b, q = np.zeros((m, m)), np.zeros((m, na)), np.zeros((m, m))
    full_a[:n, :n] = sampled.A
    first = n
    for i, count in enumerate(under_way):
        if count:
            full_a[:n, first] = sampled.B[:, i]
            full_a[first : first + count - 1, first + 1 : first + count] = np.eye(count - 1)
            full_b[first + count - 1, i] = 1.0
        else:
            full_b[:n, i] = sampled.B[:, i]
        first += count
    if settings.integral:
        full_a[first:, :nj], full_a[first:, first:] = dt * np.eye(nj), np.eye(nj)
        q[first:, first:] = np.eye(nj) / settings.integral**2
    q[:nj, :nj] = np.eye(nj) / settings.angle**2
    q[nj : 2 * nj, nj : 2 * nj] = np.eye(nj) / settings.rate**2
    q, r = q * dt, np.eye(na) * dt / settings.pressure**2
    try:
        gain, cost, _ = control.dlqr(full_a, full_b, q, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        shown = ", ".join(f"{value:.3g}" for value in pose)
        raise ControllerError(f"{model.name}: no regulator was found about the pose {shown} rad ({error})") from error
    return Regulator(full_a, full_b, q, r, np.asarray(gain), np.asarray(cost))


def waiting(model: Model, dt: float) -> NDArray[np.int64]:
    """(na,) how many samples longer a command is under way than one of the quickest actuator."""
    delay = valve_settings(model.effects, model.morphology.actuator_names)[:, DELAY]
    return np.asarray(np.rint((delay - delay.min()) / dt), dtype=np.int64)


class Schedule:
    """Gains between the poses of a grid, each worked out when it is first asked for.

    Args:
        model: what is known of the robot.
        settings: of the regulator.
        dt: of the sampling [s].
    """

    def __init__(self, model: Model, settings: LqrSettings, dt: float) -> None:
        self.model, self.settings, self.dt = model, settings, dt
        low, high = (np.clip(side, -np.pi, np.pi) for side in model.morphology.joint_range)
        self._low, self._high = low.tolist(), high.tolist()
        self._cells: list[int] = np.maximum(np.ceil((high - low) / settings.spacing), 1).astype(int).tolist()
        self._lagging = np.flatnonzero(valve_lag(valve_settings(model.effects, model.morphology.actuator_names)) > 0)
        self._known: dict[tuple[int, ...], Regulator] = {}

    def gain(self, pose: Array) -> Array:
        """(na, n) gains at a pose (nj,) [rad], or at the nearest within the joint ranges."""
        return self._between(pose, lambda found: found.gain)

    def cost(self, pose: Array) -> Array:
        """(n, n) P at a pose, as of ``gain``."""
        return self._between(pose, lambda found: found.cost)

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
        if math.prod(count + 1 for count in self._cells) <= MOST_POSES:
            for key in itertools.product(*(range(count + 1) for count in self._cells)):
                with suppress(ControllerError):
                    self._node(key)

    def _between(self, pose: Array, read: Callable[[Regulator], Array]) -> Array:
        sides = []
        for at, low, high, cells in zip(pose.tolist(), self._low, self._high, self._cells, strict=True):
            place = min(max((at - low) / (high - low), 0.0), 1.0) * cells
            below = min(int(place), cells - 1)
            sides.append(((below, 1 - (place - below)), (below + 1, place - below)))
        found = np.zeros(())
        for corner in itertools.product(*sides):
            weight = math.prod(share for _, share in corner)
            if weight > 0:
                found = found + weight * read(self._node(tuple(index for index, _ in corner)))
        return found

    def _node(self, key: tuple[int, ...]) -> Regulator:
        if key not in self._known:
            low, high = np.array(self._low), np.array(self._high)
            pose = low + (high - low) * np.array(key) / self._cells
            self._known[key] = regulator(self.model, pose, self.settings, self.dt)
        return self._known[key]


@dataclass(frozen=True, eq=False)
class LqrState:
    """What the regulator carries from step to step.

    Attributes:
        observer: what is known of the robot.
        inverse: how far the reference has been followed.
        integral: (nj,) of the angles' errors [rad·s].
        under_way: for each actuator commands beyond what the reference asked for, the next to arrive first [Pa].
        tools: made for the plant once.
    """

    observer: ObserverState
    inverse: InverseState
    integral: Array
    under_way: tuple[Array, ...]
    tools: LqrTools


@dataclass(frozen=True, eq=False)
class LqrTools:
    """What is made once for a plant."""

    observer: Observer
    inverse: Inverse
    schedule: Schedule
    dt: float


class LqrController:
    """The regulator; its state is a ``LqrState``.

    Args:
        settings: of it.
    """

    name = "lqr"

    def __init__(self, settings: LqrSettings | None = None) -> None:
        self.settings = settings or LqrSettings()

    def init(self, spec: PlantSpec, observation: Observation) -> LqrState:
        """A robot that has long been at rest.

        Raises:
            ControllerError: where the plant offers no model.
        """
        s = self.settings
        observer = Observer.of(spec, s.observer)
        model = observer.model
        inverse = Inverse(model, spec.control_dt, s.start_time)
        tools = LqrTools(
            observer,
            inverse,
            Schedule(model, s, spec.control_dt),
            spec.control_dt,
        )
        tools.schedule.prepare()
        position = np.array(observation.position)
        under_way = tuple(np.zeros(count) for count in waiting(model, spec.control_dt))
        begun = observer.init(observation)
        return LqrState(begun, inverse.start(observation.time, position), np.zeros(len(position)), under_way, tools)

    def step(self, observation: Observation, reference: Reference, state: LqrState) -> tuple[Array, LqrState]:
        """The next command, within the plant's limits.

        Raises:
            ObserverFault: where a joint was not measured for longer than the observer has patience.
        """
        t, s = state.tools, self.settings
        model = t.observer.model
        known = t.observer.update(observation, state.observer)
        t.observer.require_sound(known)
        ahead = t.observer.foresee(known, observation.time + float(t.observer.delays.min()))
        target, followed = t.inverse.target(reference, observation.time, state.inverse)
        against = np.zeros(len(t.observer.delays))
        if s.disturbance:
            against = -t.inverse.counter(ahead.position, ahead.disturbance)
        error = ahead.position - target.position
        others = [*state.under_way, state.integral] if s.integral else state.under_way
        asked = target.feed + against + t.schedule.correction(ahead, target, against, others)
        command = t.inverse.commands(asked[None])[0]
        arriving = shaped_commands(model.effects, t.inverse.actuators, command[None])[0]
        integral = state.integral
        if np.abs(arriving - asked).max() < MISSED:  # else it would wind up against a limit
            integral = integral + t.dt * error
        beyond = arriving - target.feed - against
        under_way = tuple(
            np.append(old[1:], new) if len(old) else old for old, new in zip(state.under_way, beyond, strict=True)
        )
        return frozen_array(command), replace(
            state, observer=known, inverse=followed, integral=integral, under_way=under_way
        )
