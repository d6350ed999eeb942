"""A simulated robot: a model in MuJoCo behind valves and a sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.command import advance_pressure
from equimus_ctrl.effects.sensors import PLAY, SCALE, SENSOR_DELAY, follow, recall
from equimus_ctrl.effects.sensors import shown as seen_by
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.engines.contacts import touching_now
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.errors import ConfigError, SimulationDiverged, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.points import Points, points_of
from equimus_ctrl.plants.body import body_of
from equimus_ctrl.plants.events import Event, Load, PointForce, Push
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.reading import shown
from equimus_ctrl.types import Array, Observation, PlantSpec, Sense, Start, frozen_array


def whole_ratio(fast: float, slow: float, what: str) -> int:
    """fast/slow as a whole number.

    Raises:
        ConfigError: where it is not one.
    """
    ratio = fast / slow
    if not 1 <= ratio < float("inf") or abs(ratio - round(ratio)) > 1e-9 * ratio:
        raise ConfigError(f"{what}: {fast:g} Hz is not a whole multiple of {slow:g} Hz")
    return round(ratio)


@dataclass(frozen=True)
class PlantRates:
    """How often things happen, in Hz; physics must be a whole multiple of both others.

    Attributes:
        control: commands.
        sensor: measurements; a controller sees the latest.
        physics: MuJoCo steps.
    """

    control: float = 120.0
    sensor: float = 120.0
    physics: float = 480.0

    def __post_init__(self) -> None:
        for key in ("control", "sensor", "physics"):
            if not 0 < getattr(self, key) < float("inf"):
                raise ConfigError(f"{key} rate is {getattr(self, key):g} Hz, expected more than 0")
        whole_ratio(self.physics, self.control, "physics rate over control rate")
        whole_ratio(self.physics, self.sensor, "physics rate over sensor rate")


USUAL_CONTROL = 120.0
"""Commands a second where a robot's own physics step allows it [Hz]."""

MOST_NOISE = 1.0
"""Of a measured position [rad or m]: with more, nothing of an angle is left to be measured."""


def rates_of(robot: Robot) -> PlantRates:
    """The rates of a robot's plant: physics as its description asks for, commands and measurements near 120 Hz."""
    if robot.timestep is None:
        return PlantRates()
    physics = 1 / robot.timestep
    control = physics / max(round(physics / USUAL_CONTROL), 1)
    return PlantRates(control, control, physics)


def check_nominal(known: Robot, robot: Robot) -> None:
    """Raise ConfigError where a nominal model is of a robot with other joints or actuators than the robot."""
    if (known.joint_names, known.actuator_names) != (robot.joint_names, robot.actuator_names):
        raise ConfigError(
            f"the nominal model {known.name} has joints {', '.join(known.joint_names)} and actuators "
            f"{', '.join(known.actuator_names)}, but {robot.name} has {', '.join(robot.joint_names)} and "
            f"{', '.join(robot.actuator_names)}"
        )


def make_spec(robot: Robot, control_dt: float, nominal: Robot | Model | None, phase: Phase = "swing") -> PlantSpec:
    """What a controller may know of a robot: its names, limits, control period and a nominal model with its effects.

    Raises:
        ConfigError: where the nominal model is of a robot with other joints or actuators.
    """
    known = nominal.robot if isinstance(nominal, Model) else nominal
    if known is not None:
        check_nominal(known, robot)
    low, high = robot.joint_range
    least, most = robot.command_limits
    return PlantSpec(
        joints=robot.joint_names,
        actuators=robot.actuator_names,
        command_low=least,
        command_high=most,
        control_dt=control_dt,
        joint_low=low,
        joint_high=high,
        model=known,
        phase=phase,
        effects=nominal.effects if isinstance(nominal, Model) else (),
        joint_units=robot.joint_units,
        command_units=robot.command_units,
        command_rate=robot.command_rates,
        goals=robot.goals,
    )


class MujocoPlant:
    """Any robot in MuJoCo: commands in, positions out at the sensor's rate.

    What moves is a ``plants.body.Body``: elastic actuators are 3-2-1 elements, an MJCF robot has all that is
    in there. Events, valves, sensors and noise are alike for all.

    Args:
        model: what is simulated, with its effects and phase.
        nominal: what controllers may compute with; the model itself by default.
        rates: control, sensor and physics rates; ``rates_of`` the robot by default.
        noise: standard deviation of white noise on each position [rad or m]; velocities and torques have none.
        events: what befalls the robot, see ``plants.events``.
    """

    def __init__(
        self,
        model: Model,
        *,
        nominal: Robot | Model | None = None,
        rates: PlantRates | None = None,
        noise: float = 0.0,
        events: Sequence[Event] = (),
    ) -> None:
        self.rates = rates or rates_of(model.robot)
        if not 0 <= noise <= MOST_NOISE:
            raise ConfigError(f"noise is {noise:g} rad or m, expected 0 to {MOST_NOISE:g}")
        require_simulated(model.effects, f"{model.name}: the MuJoCo plant")
        self.model = model
        self.noise = noise
        self._dt = 1 / self.rates.physics
        self._steps = whole_ratio(self.rates.physics, self.rates.control, "physics rate over control rate")
        self._sensor_steps = whole_ratio(self.rates.physics, self.rates.sensor, "physics rate over sensor rate")
        self._body = body = body_of(model, self._dt)
        self.mujoco_model, self.data = body.mujoco_model, body.data
        self._qpos, self._dof, self._control = body.qpos, body.dof, body.control
        self._valve, self._sensor = body.valve, body.sensor
        self._remembers = bool(np.any(self._sensor[:, [SENSOR_DELAY, PLAY]] > 0))
        spec = make_spec(model.robot, 1 / self.rates.control, nominal or model, model.phase)
        senses: tuple[Sense, ...] = ("velocities",) if body.exerted() is None else ("velocities", "torques")
        self._spec = replace(spec, senses=frozenset(senses))
        self._step_count = -1
        self._diverged: str | None = None
        self._events = tuple(events)
        self._loads = self._loaded()
        self._points = self._pushed_points()

    def _loaded(self) -> list[tuple[float, Mapping[str, Array]]]:
        """When loads are taken up [s], the last first, and MuJoCo's numbers of the bodies from then on."""
        found: list[tuple[float, Mapping[str, Array]]] = [(-math.inf, self._body.numbers())]
        for event in self._events:
            if isinstance(event, Push) and event.torque.shape != (len(self.spec.joints),):
                raise ConfigError(
                    f"{self.model.name}: a push has {len(event.torque)} torques, expected one for each of "
                    f"{', '.join(self.spec.joints)}"
                )
        loads = sorted((e for e in self._events if isinstance(e, Load)), key=lambda e: e.time)
        for k, load in enumerate(loads):
            found.append((load.time, self._body.loaded([(own.location, own.mass) for own in loads[: k + 1]])))
        return found[::-1]

    def _pushed_points(self) -> Points | None:
        """The robot's named points, where a force acts at one of them."""
        places = [event.location for event in self._events if isinstance(event, PointForce)]
        if not places:
            return None
        points = points_of(self.model)
        for place in places:
            if place not in points.names:
                raise ConfigError(unknown_name("site or body", place, points.names, self.model.name))
        return points

    def _befall(self, time: float) -> list[Array]:
        """Torques on the joints from a time on, loads taken up."""
        numbers = next(values for begins, values in self._loads if begins <= time + EARLY)
        for name, values in numbers.items():
            getattr(self.mujoco_model, name)[:] = values
        pushes = [event for event in self._events if not isinstance(event, Load)]
        return [self._torque(own) for own in pushes if own.time <= time + EARLY < own.time + own.duration]

    def _torque(self, event: Push | PointForce) -> Array:
        """(nj,) what an event exerts on the joints where they are [N·m or N]: Jᵀ F of a force at a point."""
        if isinstance(event, Push):
            return event.torque
        assert self._points is not None
        return np.asarray(self._points.at(event.location, self.position)[1].T @ event.force)

    @property
    def spec(self) -> PlantSpec:
        """What a controller may know."""
        return self._spec

    @property
    def truth(self) -> Array:
        """(nj,) true joint angles now [rad], see ``types.KnowsTruth``."""
        return self.position

    @property
    def touched(self) -> str:
        """What has touched since the reset, see ``types.KnowsContacts``."""
        return self._touched

    @property
    def position(self) -> Array:
        """(nj,) true joint angles [rad]; for figures and tests, not for controllers."""
        return np.array(self.data.qpos[self._qpos])

    @property
    def pressure(self) -> Array:
        """(na,) true pressures [Pa]; for figures and tests, not for controllers."""
        self._require_reset()
        return self._pressure.copy()

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        """Go to ``start`` at time 0, closed and at rest.

        Args:
            start: see ``Start``.
            seed: of the measurement noise.

        Raises:
            ConfigError: for a start of the wrong size or outside the command range.
            ModelError: where the first command has no equilibrium.
        """
        start = start or Start()
        na, nj = len(self.spec.actuators), len(self.spec.joints)
        command = self._body.command_before(start.position) if start.command is None else start.command
        for key, array, size in (
            ("command", command, na),
            ("position", start.position, nj),
            ("velocity", start.velocity, nj),
        ):
            if array is not None and array.shape != (size,):
                raise ConfigError(f"start {key} has shape {array.shape}, expected ({size},)")
            if array is not None and key != "command" and not np.all(np.isfinite(array)):
                raise ConfigError(f"start {key} is {array.tolist()}, expected finite numbers")
        if not (np.all(command >= self.spec.command_low) and np.all(command <= self.spec.command_high)):
            low, high, units = self.spec.command_low, self.spec.command_high, self.spec.command_units
            raise ConfigError(
                f"start command {shown(command, units)} lies outside {shown(low, units, False)} to {shown(high, units)}"
            )
        reaches = self._shaped(np.asarray(command))
        position = self._body.rest(start.command) if start.position is None else start.position
        if self._events:
            self._befall(-math.inf)
        self._body.place(np.asarray(position), start.velocity, reaches)
        self._diverged = None
        self._touched = self._contact(0.0)
        self._rng = np.random.default_rng(seed)
        self._step_count = 0
        self._control_count = 0
        self._pressure = reaches.copy()
        self._before = reaches
        self._cursor = [-1] * na
        self._times = np.empty(256)
        self._commands = np.empty((256, na))
        self._clipped = np.zeros(na, dtype=bool)
        # As much of the motion as the latest sensor looks back, and a step more.
        self._past = np.zeros((nj, int(np.ceil(self._sensor[:, SENSOR_DELAY].max() / self._dt)) + 3, 2))
        self._remember()
        self._held = self.position
        self._measure()
        return self._observation(np.array(command))

    def step(self, command: ArrayLike) -> Observation:
        """Hold ``command`` [Pa] for one control period; it is clipped to the range and the clipping reported.

        Raises:
            ConfigError: for a command of the wrong size or not finite.
            SimulationDiverged: where MuJoCo warns or the numbers are no leg's.
        """
        self._require_reset()
        if self._diverged is not None:
            raise SimulationDiverged(self._diverged)
        asked = np.asarray(command, dtype=np.float64)
        if asked.shape != (len(self.spec.actuators),):
            raise ConfigError(f"command has shape {asked.shape}, expected ({len(self.spec.actuators)},)")
        if not np.all(np.isfinite(asked)):
            raise ConfigError(f"command at {self._control_count * self.spec.control_dt:.3f} s is {asked}, not finite")
        applied = np.clip(asked, self.spec.command_low, self.spec.command_high)
        self._clipped = applied != asked
        n = self._control_count
        if n == len(self._times):
            self._times = np.concatenate([self._times, np.empty(n)])
            self._commands = np.concatenate([self._commands, np.empty((n, applied.size))])
        self._times[n] = n * self.spec.control_dt
        self._commands[n] = self._shaped(applied)
        self._control_count = n + 1
        for _ in range(self._steps):
            self._physics_step()
            if self._step_count % self._sensor_steps == 0:
                self._measure()
        return self._observation(applied)

    def close(self) -> None:
        """Nothing to let go of."""

    def _require_reset(self) -> None:
        if self._step_count < 0:
            raise ConfigError(f"{self.model.name}: the plant was stepped before it was reset")

    def _physics_step(self) -> None:
        n = self._control_count
        t = self._step_count * self._dt
        for i in range(len(self._cursor)):
            self._pressure[i], self.data.ctrl[self._control[i]], _, self._cursor[i] = advance_pressure(
                self._times[:n],
                self._commands[:n, i],
                self._before[i],
                self._cursor[i],
                t,
                self._dt,
                self._pressure[i],
                self._valve[i],
            )
        self._body.exert()
        pushes = self._befall(t) if self._events else []
        slow = self._is_slow()
        sound = self._body.advance(pushes)
        self._step_count += 1
        if not self._touched and self.data.ncon:
            self._touched = self._contact(t)
        if self._remembers:
            self._remember()
            for j, row in enumerate(self._sensor):
                self._held[j] = follow(self._held[j], self._seen(j), row[PLAY])
        if not (slow and sound and self._is_slow()):
            self._diverged = (
                f"{self.model.name}: the simulation diverged at {self._step_count * self._dt:.3f} s under commands of "
                f"{shown(self._commands[n - 1], self.spec.command_units)}; a shorter physics step or gentler gains "
                "would be needed"
            )
            raise SimulationDiverged(self._diverged)

    def _contact(self, time: float) -> str:
        found = touching_now(self.mujoco_model, self.data)
        return "" if found is None else f"{found[0]} touches {found[1]} at {time:.3g} s"

    def _is_slow(self) -> bool:
        return all(abs(speed) < MAX_SPEED for speed in self.data.qvel[self._dof].tolist())

    def _shaped(self, command: Array) -> Array:
        robot = self.model.robot
        return np.array(
            shaped_commands(self.model.effects, robot.actuator_names, command[None, :], robot.command_ranges)[0]
        )

    def _remember(self) -> None:
        newest = self._step_count % self._past.shape[1]
        self._past[:, newest, 0], self._past[:, newest, 1] = self.position, self.data.qvel[self._dof]

    def _seen(self, j: int) -> float:
        """Where joint j was its sensor's delay ago [rad]."""
        sensor_delay = self._sensor[j, SENSOR_DELAY]
        if sensor_delay == 0.0:
            return float(self.position[j])
        return float(recall(self._past[j], self._step_count, sensor_delay / self._dt, self._dt))

    def _rate(self, j: int) -> float:
        """How fast joint j was its sensor's delay ago [rad/s or m/s]."""
        age = self._sensor[j, SENSOR_DELAY] / self._dt
        if age == 0.0:
            return float(self.data.qvel[self._dof[j]])
        place = self._step_count - age
        if place < 0:  # before the start it stood still
            return 0.0
        step = min(int(place), self._step_count - 1)
        before, after = (float(self._past[j, k % self._past.shape[1], 1]) for k in (step, step + 1))
        return float(before + (place - step) * (after - before))

    def _measure(self) -> None:
        self._stamp = self._step_count * self._dt
        seen = np.array([self._held[j] if row[PLAY] > 0 else self._seen(j) for j, row in enumerate(self._sensor)])
        noise = self._rng.normal(0.0, self.noise, len(self._qpos)) if self.noise > 0 else 0.0
        self._measured = frozen_array(seen_by(self._sensor, seen) + noise)
        self._velocity = frozen_array(self._sensor[:, SCALE] * [self._rate(j) for j in range(len(self._sensor))])
        exerted = self._body.exerted()
        self._exerted = None if exerted is None else frozen_array(exerted)

    def _observation(self, applied: Array) -> Observation:
        clipped = self._clipped.copy()
        clipped.flags.writeable = False
        return Observation(
            time=self._control_count * self.spec.control_dt,
            position=self._measured,
            stamp=self._stamp,
            command=frozen_array(applied),
            clipped=clipped,
            velocity=self._velocity,
            torque=self._exerted,
        )


EARLY = 1e-9
"""Times that differ by less are the same [s]."""
