"""What predictive controllers share: where the robot will be, what is wanted of it then, and what to do without a plan.

An observer predicts where the robot will be when the next command arrives. The inverse model gives the commands of the
reference over a horizon, and the regulator of ``controllers.lqr`` the cost beyond it. Where a plan fails or overruns
its deadline, there is a fallback: the plan of the instant before, shifted, else the regulator, else the command in
force.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.allowances import Allowances, allowances
from equimus_ctrl.controllers.inverse import Inverse, InverseState, Target
from equimus_ctrl.controllers.lqr import CALM, LqrSettings, Schedule, waiting
from equimus_ctrl.controllers.preview import Ahead, Preview, Sight
from equimus_ctrl.controllers.valve_estimation import ObservedState, bank_of
from equimus_ctrl.engines.native import native
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import Estimate, Observer, ObserverSettings, ObserverState, require_model
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.linear import valve_lag
from equimus_ctrl.models.prediction import Prediction, parts_in, prediction
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.predictive.costs import Wanted, Weights
from equimus_ctrl.settings import OTHERS, PRESSURES, setting
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

Status = Literal["converged", "iterated", "sampled", "shifted", "lqr", "hold"]
FALLBACKS = ("shifted", "lqr", "hold")
"""Statuses of commands that no plan of this instant stands behind."""


@dataclass(frozen=True)
class HorizonSettings:
    """What predictive controllers allow. An error as large as is acceptable costs as much as an effort as large as is.

    Attributes:
        angle: acceptable error of angles [rad]; of a robot whose commands are no pressures by half the joints' ranges.
        rate: of velocities [rad/s], where commands are pressures.
        pressure: of pressures beyond what the reference asks for [Pa], where commands are pressures.
        bandwidth: of any other robot, from which these two and the observer follow (``controllers.allowances``) [Hz]; 0
            for as much as what is late allows.
        limit: of angles beyond a joint's range [rad], as ``angle``; such ranges are soft.
        margin: by how much that range is narrower than from stop to stop [rad].
        pressure_rate: how fast what reaches the valves may change [Pa/s], where commands are pressures; 0 for any.
        deadline: what is not solved by then after the step began falls back [s]; 0 for no deadline, as in simulation,
            where a run is to give the same bits each time.
        disturbance: whether torques that the observer cannot explain are taken to last.
        estimate_valves: whether dead times and lags up to the usual ones are found that nobody told of, see
            ``controllers.valve_estimation``.
        spacing: of the grid of poses that the regulator behind the horizon is worked out at [rad].
        start_time: over which the first pose fades out of the reference, where every joint has an actuator [s].
        compiled: whether a C compiler is used where there is one.
        observer: covariances of the Kalman filter.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    angle: float = 0.03
    rate: float = setting(1.0, PRESSURES)
    pressure: float = setting(1e3, PRESSURES)
    bandwidth: float = setting(0.0, OTHERS)
    limit: float = 0.003
    margin: float = 0.0
    pressure_rate: float = setting(0.0, PRESSURES)
    deadline: float = 0.0
    disturbance: bool = True
    estimate_valves: bool = True
    spacing: float = 0.2
    start_time: float = 0.3
    compiled: bool = True
    observer: ObserverSettings = field(default_factory=lambda: ObserverSettings(disturbance=CALM))

    def __post_init__(self) -> None:
        self._require(("angle", "rate", "pressure", "limit", "spacing"), above=0.0)
        self._require(("bandwidth", "margin", "pressure_rate", "deadline", "start_time"), least=0.0)

    def _require(self, keys: tuple[str, ...], least: float = -math.inf, above: float = -math.inf) -> None:
        for key in keys:
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= least and value > above):
                wanted = f"more than {above:g}" if above > -math.inf else f"at least {least:g}"
                raise ConfigError(f"{key} is {value:g}, expected {wanted}")

    def _count(self, key: str, least: int, most: int) -> None:
        value = getattr(self, key)
        if not least <= value <= most:
            raise ConfigError(f"{key} is {value}, expected {least} to {most}")

    def regulator(self) -> LqrSettings:
        """The regulator that goes on behind the horizon."""
        return LqrSettings(self.angle, self.rate, self.pressure, self.bandwidth, spacing=self.spacing)

    def weights(self) -> Weights:
        """What errors and efforts cost."""
        return Weights(self.angle, self.rate, self.pressure, self.limit)

    def joint_range(self, spec: PlantSpec) -> Array:
        """(2, nj) the soft range of the joints [rad or m].

        Raises:
            ConfigError: where the margin leaves nothing of it.
        """
        low, high = np.array(spec.joint_low) + self.margin, np.array(spec.joint_high) - self.margin
        for name, unit, least, most in zip(spec.joints, spec.joint_units, low, high, strict=True):
            if least >= most:
                moves = "slides" if unit == "m" else "turns"
                raise ConfigError(
                    f"margin is {self.margin:g} {unit}, but {name} {moves} from {least - self.margin:.4g} to "
                    f"{most + self.margin:.4g} {unit} only"
                )
        return np.vstack([low, high])


@dataclass(frozen=True, eq=False)
class HorizonState(ObservedState):
    """What every predictive controller carries from step to step.

    Attributes:
        followed: where the reference was begun.
        sight: what is known of the reference ahead.
        status: of the latest command: ``"converged"``, ``"iterated"`` (time or iterations ended it first, and always
            in real-time iteration) or ``"sampled"`` where a plan of this instant stands behind it, ``"shifted"`` (the
            plan of an instant before), ``"lqr"`` or ``"hold"`` where none does.
        reason: why it fell back; empty where it did not.
        under_way: for each actuator commands beyond what the reference asked for, the next to arrive first [Pa].
        expected: what an iteration is known to take, where there is a deadline [s].
        plan: the latest one, or None.
    """

    followed: InverseState
    sight: Sight | None
    status: Status
    reason: str
    under_way: tuple[Array, ...]
    expected: float
    plan: Any

    @property
    def fell_back(self) -> bool:
        """Whether no plan of this instant stands behind the command."""
        return self.status in FALLBACKS


AnyState = TypeVar("AnyState", bound=HorizonState)


@dataclass(frozen=True, eq=False)
class Outlook:
    """What a plan is to be made from.

    Attributes:
        observer: what is known of the robot.
        arrival: when the next command first takes hold [s].
        known: of the robot then.
        disturbance: (nj,) torques that the model does not explain, taken as lasting [N·m].
        against: (na,) what holds against them [Pa].
        path: a robot that follows.
        sight: what is known of the reference ahead.
        wanted: where the robot is to be, and what the end of the horizon costs.
        fixed: (n, na) inputs that commands under way have settled, NaN for those still free [Pa]; None where all are.
        first: (na,) the first free interval of each actuator.
        before: (na,) what reached the valves last [Pa].
        effort: (na,) acceptable deviations of commands where the robot is to be.
    """

    observer: ObserverState
    arrival: float
    known: Estimate
    disturbance: Array
    against: Array
    path: Ahead
    sight: Sight
    wanted: Wanted
    fixed: Array | None
    first: NDArray[np.intp]
    before: Array
    effort: Array


class Horizon:
    """What is made once for a plant.

    Args:
        spec: of the plant.
        settings: of the controller.
        periods: returns (n,) how many control periods each interval lasts, given the number of periods by which each
            actuator obeys the next command later than the first one does.
        pose: (nj,) where the robot begins [rad]; its home by default.
        banked: whether the observer keeps a bank of valves, where there is anything to be found.
        known: another one, of the same robot without what was found of its valves: what it allows is kept, and gains
            are worked out as they are needed; by default gains of a whole grid of poses are beforehand.

    Attributes:
        allowed: what errors and efforts are allowed.
        observer: of the plant.
        inverse: what it takes to follow.
        schedule: the regulator behind the horizon.
        prediction: the robot's step, its joints without stops.
        dt: control period [s].
        times: (n + 1,) when intervals begin and end after the arrival of the next command [s].
        durations: (n,) [s].
        reached: (2, na) range of what can reach the valves [Pa].
        weights: of errors and efforts.
        rate: (na,) how fast what reaches the valves may change [Pa/s].

    Raises:
        ControllerError: where the plant offers no model.
    """

    def __init__(
        self,
        spec: PlantSpec,
        settings: HorizonSettings,
        periods: Callable[[NDArray[np.int64]], NDArray[np.int64]],
        pose: Array | None = None,
        banked: bool = False,
        known: Horizon | None = None,
    ) -> None:
        self.settings, self.dt = settings, spec.control_dt
        require_model(spec)
        begins = spec.model.home if pose is None else pose
        # These are stable with what is usually late: finding that out is no reason to ask less.
        allowed = known.allowed if known else allowances(
            spec, settings, np.zeros(len(spec.joints)) if begins is None else begins
        )  # fmt: skip
        self.allowed: Allowances = allowed
        bank = bank_of(spec, banked)
        self.observer = Observer.of(spec, settings.observer, settings.compiled, allowed.noise_model, bank)
        model = self.observer.model
        self._waiting = waiting(model, self.dt)
        lasting = periods(self._waiting)
        self.durations: Array = np.asarray(self.dt * lasting, dtype=np.float64)
        self.times: Array = np.concatenate([[0.0], np.cumsum(self.durations)])
        self.prediction: Prediction = prediction(model, stops=False)
        self.inverse = Inverse(model, self.dt, settings.start_time if allowed.driven.all() else 0.0)
        limits = np.vstack([self.inverse.low, self.inverse.high])
        reached = self.inverse.arriving(limits)
        self.reached: Array = np.vstack([np.minimum(*reached), np.maximum(*reached)])
        limit: float | Array = settings.limit
        rate = settings.pressure_rate or math.inf
        if allowed.bandwidth:
            limit, rate = settings.limit / settings.angle * allowed.angle, math.inf
        self.weights = Weights(allowed.angle, allowed.rate, allowed.usual, limit)
        self.rate: Array = np.minimum(spec.command_rate, rate)
        self._note, self._driven = allowed.note, allowed.driven
        self.schedule = Schedule(model, settings.regulator(), self.dt, allowed)
        if known is None:
            self.schedule.prepare()
        lagging = np.flatnonzero(valve_lag(valves_of(model)) > 0)
        nj = self.prediction.nj
        self._seen: NDArray[np.intp] = np.concatenate([np.arange(2 * nj), 2 * nj + lagging])
        self._delay = float(self.observer.delays.min())
        self._preview = Preview(self.inverse, lasting, self.dt, self._delay)

    def begin(self, observation: Observation) -> dict[str, Any]:
        """The fields of a ``HorizonState`` for a robot that has long been at rest."""
        return {
            "observer": self.observer.init(observation),
            "followed": self.inverse.start(observation.time, np.array(observation.position)),
            "sight": None, "status": "hold", "reason": "",
            "under_way": self._nothing_under_way(), "expected": 0.0, "note": self._note,
        }  # fmt: skip

    def taken_over(self, state: HorizonState) -> dict[str, Any]:
        """The fields of a ``HorizonState`` that another model's valves change."""
        return {
            "followed": self.inverse.taken_over(state.followed), "sight": None, "plan": None,
            "under_way": self._nothing_under_way(), "expected": 0.0,
        }  # fmt: skip

    def _nothing_under_way(self) -> tuple[Array, ...]:
        return tuple(np.zeros(count) for count in self._waiting)

    def look(self, observation: Observation, reference: Reference, state: HorizonState) -> Outlook:
        """What a plan is to be made from at a control instant.

        Args:
            observation: of it.
            reference: of the true angles.
            state: of the controller, which knows of the observation.

        Raises:
            ObserverFault: where a joint was not measured for longer than the observer has patience.
        """
        p, observer = self.prediction, state.observer
        self.observer.require_sound(observer)
        arrival = observation.time + self._delay
        ahead = self.observer.foresee(observer, arrival)
        # The effects' own states are the observer's: what is asked of the valves ahead goes on from them.
        own = ahead.state[2 * p.nj + p.na :][: state.followed.states.shape[1]]
        followed = replace(state.followed, states=np.tile(own, (len(state.followed.states), 1)))
        path, sight = self._preview.look(reference, observation.time, followed, state.sight)
        # What acts on a joint without actuator cannot be held against, and would only make plans swing.
        disturbance = np.where(self._driven, ahead.disturbance, 0.0) * float(self.settings.disturbance)
        against = -self.inverse.counter(ahead.position, disturbance)
        path = replace(path, feed=path.feed + against, pressure=path.pressure + against)
        fixed, first = self._fixed(observer, arrival)
        wanted = Wanted(
            np.hstack([path.position, path.velocity, path.pressure]), path.feed, self._behind(path.position[-1])
        )
        before = observer.sent.values[-1]
        effort = self._effort(path.position[0])
        return Outlook(
            observer, arrival, ahead, disturbance, against, path, sight, wanted, fixed, first, before, effort
        )

    def regulated(self, view: Outlook) -> Array:
        """(n, na) by how much more than the reference asks for is to reach the drives where the regulator acts.

        Its gains are those of where the path begins. Nothing where the pose has no regulator, or the model diverges.
        """
        found = np.zeros(view.wanted.feed.shape)
        try:
            gain = self.schedule.gain(view.path.position[0])[:, : len(self._seen)]
        except ControllerError:
            return found
        states, step = view.wanted.states, self._forward
        x, u, d, h = step.arguments
        x[:], d[:] = view.known.state, view.disturbance
        with np.errstate(all="ignore"):  # what diverges may overflow
            for k, (feed, lasts) in enumerate(zip(view.wanted.feed, self.durations, strict=True)):
                off = (x[: states.shape[1]] - states[k])[self._seen]
                u[:] = np.clip(feed - gain @ off, *self.reached)
                if view.fixed is not None:
                    u[:] = np.where(np.isfinite(view.fixed[k]), view.fixed[k], u)
                found[k] = u - feed
                h[:] = lasts / self.parts
                for _ in range(self.parts):
                    step()
                    x[:] = step.results[0]
        return found if np.isfinite(found).all() else np.zeros(found.shape)

    @cached_property
    def parts(self) -> int:
        """Into how many steps of the model an interval is divided."""
        return parts_in(self.observer.model, float(self.durations.max()))

    @cached_property
    def _forward(self) -> Buffered:
        step = self.prediction.step
        return Buffered((native(step, "step") if self.settings.compiled else None) or step)

    def choose(
        self,
        view: Outlook,
        planned: Array | None,
        status: Status,
        reason: str,
        fallback: Array | None,
        state: HorizonState,
    ) -> tuple[Status, str, Array | None]:
        """Which command to send.

        Args:
            view: what the plan was made from.
            planned: (n, na) inputs of a plan of this instant, None where there is none [Pa].
            status: of that plan.
            reason: why there is none.
            fallback: (n, na) of the plan of the instant before, shifted [Pa].
            state: of the controller.

        Returns:
            Status, why it fell back, and (na,) what is to reach the valves, None for the command in force.
        """  # fmt: skip
        own = np.arange(len(view.first))
        if planned is not None and not reason:
            return status, "", planned[view.first, own]
        if fallback is not None and np.isfinite(fallback).all():
            return "shifted", reason, fallback[view.first, own]
        target = Target(
            view.path.position[0], view.path.velocity[0], view.path.pressure[0] - view.against, view.path.feed[0]
        )
        try:
            asked = view.path.feed[0] + self.schedule.correction(view.known, target, view.against, state.under_way)
        except ControllerError:
            return "hold", reason, None
        return ("lqr", reason, asked) if np.isfinite(asked).all() else ("hold", reason, None)

    def send(
        self, view: Outlook, asked: Array | None, observation: Observation, state: AnyState
    ) -> tuple[Array, AnyState]:
        """The command for what is to reach the valves (na,) [Pa], and the state with what is under way then."""
        if asked is None:
            command = np.asarray(observation.command)
        else:
            reach = self.rate * self.dt
            asked = np.clip(asked, view.before - reach, view.before + reach)
            command = self.inverse.commands(asked[None])[0]
        arriving = self.inverse.arriving(command[None])[0]
        beyond = arriving - view.path.feed[view.first, np.arange(len(view.first))]
        under_way = tuple(
            np.append(old[1:], new) if len(old) else old for old, new in zip(state.under_way, beyond, strict=True)
        )
        return frozen_array(command), replace(state, observer=view.observer, sight=view.sight, under_way=under_way)

    def overrun(self, after: float) -> str:
        """That a plan came too long after the step began [s], in words; empty where it did not."""
        deadline = self.settings.deadline
        if not deadline or after <= deadline:
            return ""
        return (
            f"the solution came {after * 1e3:.3g} ms after the step began, but the deadline is {deadline * 1e3:.3g} ms"
        )

    def _fixed(self, observer: ObserverState, arrival: float) -> tuple[Array | None, NDArray[np.intp]]:
        """(n, na) inputs that commands under way have settled, NaN for those still free, and (na,) the first free."""
        delays = self.observer.delays
        first = np.zeros(len(delays), dtype=np.intp)
        later = delays - delays.min()
        if not later.any():
            return None, first
        fixed = np.full((len(self.durations), len(delays)), np.nan)
        for i in np.flatnonzero(later > 0):
            # An interval most of which is over when the command arrives is no longer free.
            middle = self.times[:-1] + self.durations / 2
            taken = np.flatnonzero(middle < later[i])
            for k in taken:
                fixed[k, i] = observer.sent.at(arrival + float(middle[k]) - float(delays[i]), int(i))
            first[i] = min(len(taken), len(fixed) - 1)
        return fixed, first

    def _effort(self, pose: Array) -> Array:
        """(na,) acceptable deviations of commands in a pose (nj,); where it begins if it has no regulator."""
        try:
            return self.schedule.effort(pose)
        except ControllerError:
            return np.asarray(self.weights.pressure)

    def _behind(self, pose: Array) -> Array:
        """(nx, nx) a root of what the state at the end of the horizon costs where the robot is to be in a pose."""
        nx, nj = self.prediction.nx, self.prediction.nj
        last = np.zeros((nx, nx))
        k = len(self._seen)
        try:
            cost = self.schedule.cost(pose)[:k, :k]
            last[np.ix_(self._seen, self._seen)] = np.linalg.cholesky(cost).T
        except (ControllerError, np.linalg.LinAlgError):
            # Without a regulator there the last state counts as all others do.
            scale = np.concatenate([np.broadcast_to(x, nj) for x in (self.weights.angle, self.weights.rate)])
            last[np.diag_indices(2 * nj)] = math.sqrt(self.durations[-1]) / scale
        return last
