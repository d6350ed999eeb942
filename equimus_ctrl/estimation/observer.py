"""An extended Kalman filter: velocities, pressures and unknown torques from measured angles and commands.

The state is that of ``models.prediction`` with a torque on each joint that walks at random, the constant disturbance of
offset-free control (Pannocchia and Rawlings, 2003). Commands count when they have passed their valves' delay, angles
when they were measured: the filter stands where the latest of all sensors has arrived, and predicts from there.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.sensors import OFFSET, SCALE, SENSOR_DELAY, behind
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.engines.native import native
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation import filter_kernel
from equimus_ctrl.estimation.noise_model import NoiseModel, pressed
from equimus_ctrl.estimation.valve_bank import BankState, Carried, Sent, ValveBank
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import Prediction, followed_rates, prediction, steps_in
from equimus_ctrl.settings import PRESSURES, setting
from equimus_ctrl.types import Array, Observation, PlantSpec

Status = Literal["tracking", "coasting", "fault"]

STABLE = 2.0
"""Fastest rate times step that a Runge–Kutta step is given; it would be stable to 2.78."""
AT_REST = 1e-2
"""How sure it is at the start that nothing moves [rad/s]."""
EARLY = 1e-9
"""Times that differ by less are the same [s]."""


@dataclass(frozen=True)
class ObserverSettings:
    """Covariances of the Kalman filter; shares are of the largest torque that the actuators can exert on a joint.

    Shares hold where commands are pressures; what is assumed of other robots stands in ``estimation.noise_model``.

    Attributes:
        noise: standard deviation of a measured angle [rad].
        torque: density of the white torque noise on the joints, in shares times √s.
        disturbance: standard deviation of the unknown torques' random walk after a second, in shares.
        pressure: standard deviation of the pressures' random walk after a second, in shares of the commands' range.
        patience: how long it goes on without a measurement of some joint before that is a fault [s].

    Raises:
        ConfigError: for a number that is none of these.
    """

    noise: float = 2e-3
    torque: float = setting(5e-4, PRESSURES)
    disturbance: float = setting(0.02, PRESSURES)
    pressure: float = setting(0.05, PRESSURES)
    patience: float = 0.1

    def __post_init__(self) -> None:
        for key, least in (
            ("noise", 1e-9),
            ("torque", 0.0),
            ("disturbance", 0.0),
            ("pressure", 0.0),
            ("patience", 0.0),
        ):
            value = getattr(self, key)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= least):
                raise ConfigError(f"observer: {key} is {value!r}, expected a number of at least {least:g}")


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known of a robot at one instant.

    Attributes:
        time: [s].
        position: (nj,) [rad].
        velocity: (nj,) [rad/s].
        pressure: (na,) behind the valves [Pa].
        disturbance: (nj,) torque that the model does not explain [N·m].
        state: (nx,) of ``models.prediction``.
        covariance: (nx + nj, nx + nj) of the state and the disturbance.
    """

    time: float
    position: Array
    velocity: Array
    pressure: Array
    disturbance: Array
    state: Array
    covariance: Array

    @property
    def deviation(self) -> Array:
        """(nx + nj,) standard deviations of the state and the disturbance."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class ObserverState:
    """All that an observer remembers.

    Attributes:
        time: where the filter stands [s].
        mean: (nx + nj,) state and disturbance there.
        covariance: (nx + nj, nx + nj).
        now: the latest control instant [s].
        sent: commands.
        stamp: of the latest measurement [s].
        seen: (nj,) when each joint was last measured [s].
        waiting: (time, joint, angle) of measurements newer than where the filter stands.
        status: ``"tracking"``; ``"coasting"`` while some joint was not measured anew, ``"fault"`` after too long.
        bank: what is known of valves that nobody told of; None without a bank.
    """

    time: float
    mean: Array
    covariance: Array
    now: float
    sent: Sent
    stamp: float
    seen: Array
    waiting: tuple[tuple[float, int, float], ...] = ()
    status: Status = "tracking"
    bank: BankState | None = None


def require_model(spec: PlantSpec) -> None:
    """Nothing where a plant offers a model.

    Raises:
        ControllerError: where it does not.
    """
    if spec.model is None:
        raise ControllerError("the observer needs a model of the robot, but the plant's spec has none")


class ObserverFault(ControllerError):
    """A joint was not measured for too long."""


class Observer:
    """The filter of one model.

    Args:
        model: what is known of the robot.
        control_dt: time between two control instants [s].
        settings: its covariances.
        compiled: whether a C compiler is used where there is one.
        noise_model: in place of the settings' shares; needed where commands are no pressures.
        bank: hypotheses of valves that are later than is known; what the filter itself says does not depend on it.

    Attributes:
        prediction: the model's step.
        delays: (na,) between commands and what they do [s].
    """

    def __init__(
        self,
        model: Model,
        control_dt: float,
        settings: ObserverSettings | None = None,
        compiled: bool = False,
        noise_model: NoiseModel | None = None,
        bank: ValveBank | None = None,
    ) -> None:
        self.bank = bank
        self.settings = s = settings or ObserverSettings()
        self.prediction: Prediction = prediction(model)
        p = self.prediction
        self.model, self._names = model, model.robot.actuator_names
        self.delays: Array = p.valve[:, DELAY].copy()
        self._each: list[float] = self.delays.tolist()
        self._late = sorted(set(self._each))
        self._sensor_delay: Array = p.sensor[:, SENSOR_DELAY].copy()
        longest = control_dt / steps_in(model, control_dt)
        self._substep = min(longest, STABLE / max(*followed_rates(model), STABLE / control_dt))
        self.noise_model = own = noise_model or pressed(model, s.torque, s.disturbance, s.pressure, s.noise)
        walk = np.zeros(p.nx + p.nj)
        walk[2 * p.nj : 2 * p.nj + p.na] = own.pressure
        walk[p.nx :] = own.walk
        self._walk = walk**2
        self._kick = np.array(np.broadcast_to(own.torque, p.nj), dtype=np.float64) ** 2
        fast = [native(function, function.name()) for function in (p.step, p.slopes)] if compiled else [None, None]
        self._step, self._slopes = Buffered(fast[0] or p.step), Buffered(fast[1] or p.slopes)

    @classmethod
    def of(
        cls,
        spec: PlantSpec,
        settings: ObserverSettings | None = None,
        compiled: bool = False,
        noise_model: NoiseModel | None = None,
        bank: ValveBank | None = None,
    ) -> Observer:
        """For what a controller may know of a plant; arguments are those of the class.

        Raises:
            ControllerError: where the plant offers no model.
        """
        require_model(spec)
        return cls(Model(spec.model, spec.effects, spec.phase), spec.control_dt, settings, compiled, noise_model, bank)

    def init(self, observation: Observation) -> ObserverState:
        """A robot that has long been at rest under the command in force.

        Raises:
            ControllerError: where the first angles are no numbers.
        """
        p, s = self.prediction, self.settings
        if not np.all(np.isfinite(observation.position)):
            raise ControllerError(
                f"the first measured angles are {observation.position.tolist()}, expected numbers in rad"
            )
        q = behind(p.sensor, observation.position)
        arriving = self._arriving(observation.command)[None]
        mean: Array = np.concatenate([p.at_rest(q, arriving[0]), np.zeros(p.nj)])
        deviation = np.full(p.nx + p.nj, 1e-6)
        deviation[: p.nj] = s.noise
        deviation[p.nj : 2 * p.nj] = AT_REST
        deviation[2 * p.nj : 2 * p.nj + p.na] = self.noise_model.pressure
        deviation[p.nx :] = self.noise_model.first
        start = observation.stamp - float(self._sensor_delay.max())
        sent = Sent(np.array([-math.inf]), arriving)
        seen = np.full(p.nj, observation.stamp)
        bank = None if self.bank is None else self.bank.begin(len(mean), arriving[0])
        return ObserverState(
            start, mean, np.diag(deviation**2), observation.time, sent, observation.stamp, seen, bank=bank
        )

    def update(self, observation: Observation, state: ObserverState) -> ObserverState:
        """What is known after one more control instant."""
        arriving = self._arriving(observation.command)
        state = replace(state, sent=self._remembered(state, arriving), now=observation.time)
        fresh = observation.stamp > state.stamp
        good = np.isfinite(observation.position) & fresh
        seen = np.where(good, observation.stamp, state.seen)
        new = tuple(
            (observation.stamp - float(self._sensor_delay[j]), int(j), float(observation.position[j]))
            for j in np.flatnonzero(good)
        )
        waiting = tuple(sorted((*state.waiting, *new)))
        stamp = observation.stamp if fresh else state.stamp
        ready = stamp - float(self._sensor_delay.max()) + EARLY
        mean, covariance, time, bank = state.mean, state.covariance, state.time, state.bank
        for at, joint, angle in (w for w in waiting if w[0] <= ready):
            if at > time + EARLY:  # joints that are measured together need this once
                by = None if bank is None else Carried.nothing(len(mean), len(self.delays))
                mean, covariance = self._ahead(mean, covariance, time, at, state.sent, by)
                if self.bank is not None and bank is not None and by is not None:
                    bank = self.bank.carried(bank, by, time, at, state.sent)
                time = at
            offset, scale = self.prediction.sensor[joint, OFFSET], self.prediction.sensor[joint, SCALE]
            mean, covariance, gain = mean.copy(), covariance.copy(), np.empty(len(mean))
            off, variance = filter_kernel.corrected(
                mean, covariance, joint, angle, offset, scale, self.settings.noise, gain
            )
            if self.bank is not None and bank is not None:
                row = np.zeros(len(mean))
                row[joint] = scale
                bank = self.bank.corrected(bank, row, gain, off, variance)
        if self.bank is not None and bank is not None:
            bank = self.bank.chosen(bank)
        status: Status = "tracking" if good.all() else "coasting"
        if observation.time - seen.min() > self.settings.patience:
            status = "fault"
        return replace(
            state, time=time, mean=mean, covariance=covariance, stamp=stamp, seen=seen, status=status, bank=bank,
            waiting=tuple(w for w in waiting if w[0] > ready),
        )  # fmt: skip

    def require_sound(self, state: ObserverState) -> None:
        """Nothing where it goes on.

        Raises:
            ObserverFault: where a joint was not measured for longer than there is patience.
        """
        if state.status == "fault":
            joint = int(np.argmin(state.seen))
            raise ObserverFault(
                f"{self.model.robot.joint_names[joint]} was last measured at {state.seen[joint]:.3f} s and it is "
                f"{state.now:.3f} s, expected a number at least every {self.settings.patience:g} s"
            )

    def estimate(self, state: ObserverState, time: float | None = None) -> Estimate:
        """What is known of an instant.

        Args:
            state: what is remembered.
            time: not before where the filter stands, by default the latest control instant [s]; the commands sent so
                far are taken to stay in force.
        """
        until = state.now if time is None else time
        mean, covariance = self._ahead(state.mean, state.covariance, state.time, until, state.sent)
        return self._estimate(max(until, state.time), mean, covariance)

    def foresee(self, state: ObserverState, time: float) -> Estimate:
        """As ``estimate``, several times as fast: the covariance is that of where the filter stands."""
        x, u, d, h = self._step.arguments
        x[:], d[:] = state.mean[: self.prediction.nx], state.mean[self.prediction.nx :]
        for part, span, steps in self._parts(state.time, time, state.sent):
            u[:], h[:] = part, span
            for _ in range(steps):
                self._step()
                x[:] = self._step.results[0]
        return self._estimate(max(time, state.time), np.concatenate([x, d]), state.covariance)

    def _arriving(self, command: Array) -> Array:
        """(na,) what reaches the valves of commands (na,)."""
        ranges = self.model.robot.command_ranges
        return np.asarray(shaped_commands(self.model.effects, self._names, command[None], ranges)[0])

    def _estimate(self, time: float, mean: Array, covariance: Array) -> Estimate:
        p = self.prediction
        x = mean[: p.nx]
        q, v, pressure = x[: p.nj], x[p.nj : 2 * p.nj], x[2 * p.nj : 2 * p.nj + p.na]
        return Estimate(time, q, v, pressure, mean[p.nx :], x, covariance)

    def _remembered(self, state: ObserverState, arriving: Array) -> Sent:
        """The commands with what was in force since the last instant, those forgotten that have all arrived."""
        times, values = state.sent.times, state.sent.values
        if times[-1] < state.now - EARLY:
            if not np.array_equal(values[-1], arriving):
                times, values = np.append(times, state.now), np.vstack([values, arriving])
        else:
            values = np.vstack([values[:-1], arriving])
        oldest = state.time - float(self.delays.max()) - (0.0 if self.bank is None else self.bank.longest)
        first = max(int(np.searchsorted(times, oldest, side="right")) - 1, 0)
        return Sent(times[first:], values[first:])

    def _parts(self, start: float, until: float, sent: Sent) -> Iterator[tuple[list[float], float, int]]:
        """(what reaches the valves, step, how many steps) from start to until, each time a command arrives anew."""
        low, high, edges = start + EARLY, until - EARLY, [start]
        instants = sent.instants
        late = self._late
        # The first command has been in force since ever, and what arrived before is over.
        recent = instants[max(bisect_right(instants, start - late[-1] - EARLY) - 1, 0) :]
        for at in sorted(time + delay for time in recent for delay in late):
            if low < at < high and at > edges[-1] + EARLY:
                edges.append(at)
        edges.append(until)
        for begin, end in itertools.pairwise(edges):
            if end > begin + EARLY:
                steps = max(math.ceil((end - begin) / self._substep - 1e-6), 1)
                yield [sent.at(begin - delay, i) for i, delay in enumerate(self._each)], (end - begin) / steps, steps

    def _ahead(
        self, mean: Array, covariance: Array, start: float, until: float, sent: Sent, carried: Carried | None = None
    ) -> tuple[Array, Array]:
        """Mean and covariance at ``until``; how these were carried on goes to ``carried``."""
        p = self.prediction
        n, m = p.nx, len(mean)
        x, u, d, h = self._slopes.arguments
        after = self._slopes.results[0]
        # By rows, also where there is one actuator, or joint.
        by_x, by_u, by_d = (found.reshape(n, -1).T for found in self._slopes.results[1:])
        f, g = (np.empty((0, m)), np.empty((0, p.na))) if carried is None else (carried.state, carried.pressure)
        x[:], d[:], covariance = mean[:n], mean[n:], covariance.copy()
        for part, span, steps in self._parts(start, until, sent):
            u[:], h[:] = part, span
            # A random torque over the step moves the velocities as the disturbance does over it.
            walk, kick = self._walk * span, self._kick / span
            for _ in range(steps):
                self._slopes()
                filter_kernel.carried_on(by_x, by_u, by_d, walk, kick, 2 * p.nj, covariance, f, g)
                x[:] = after
        return np.concatenate([x, d]), covariance

    def others(self, state: ObserverState) -> ObserverState:
        """What the observer of the bank's choice remembers where this one remembers ``state``.

        Args:
            state: of this observer, with a bank.
        """
        assert self.bank is not None and state.bank is not None
        p = self.prediction
        mean = state.mean + self.bank.deviation(state.bank)
        mean[2 * p.nj : 2 * p.nj + p.na] = self.bank.pressures(state.bank)
        return replace(state, mean=mean, bank=None)
