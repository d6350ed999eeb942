"""A simulated robot: the MuJoCo model of a morphology behind valves and a sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.bodies import PayloadMass, changed_bodies
from equimus_ctrl.effects.command import advance_pressure
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, follow, recall, sensor_settings, shown
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_forces import ForceStepper
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import compile_model, place
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.quiet import step_quietly
from equimus_ctrl.plants.events import Event, Load, Push
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array, Observation, PlantSpec, Start, frozen_array


def whole_ratio(fast: float, slow: float, what: str) -> int:
    """fast/slow as a whole number.

    Raises:
        ConfigError: where it is not one.
    """
    ratio = fast / slow
    if ratio < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
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


def make_spec(
    morphology: Morphology, control_dt: float, nominal: Morphology | Model | None, phase: Phase = "swing"
) -> PlantSpec:
    """What a controller may know of a robot: its names, limits, control period and a nominal model with its effects.

    Raises:
        ConfigError: where the nominal model is of a robot with other joints or actuators.
    """
    known = nominal.morphology if isinstance(nominal, Model) else nominal
    if known is not None and (known.joint_names, known.actuator_names) != (
        morphology.joint_names,
        morphology.actuator_names,
    ):
        raise ConfigError(
            f"the nominal model {known.name} has joints {', '.join(known.joint_names)} and actuators "
            f"{', '.join(known.actuator_names)}, but {morphology.name} has {', '.join(morphology.joint_names)} and "
            f"{', '.join(morphology.actuator_names)}"
        )
    low, high = morphology.joint_range
    n = len(morphology.actuators)
    return PlantSpec(
        joints=morphology.joint_names,
        actuators=morphology.actuator_names,
        command_low=frozen_array(np.full(n, morphology.command_low)),
        command_high=frozen_array(np.full(n, morphology.command_high)),
        control_dt=control_dt,
        joint_low=low,
        joint_high=high,
        model=known,
        phase=phase,
        effects=nominal.effects if isinstance(nominal, Model) else (),
    )


class MujocoPlant:
    """The leg (or any morphology) in MuJoCo: pressures in, angles out at the sensor's rate.

    The equalities of the 3-2-1 elements are held as hard as in ``engines.mujoco_batch`` and integrated by RK4, which
    keeps the angles within 1e-5 rad of the exact Lagrangian at 480 Hz (about 1e-3 rad while a joint hits a stop).

    Args:
        model: what is simulated, with its effects and phase.
        nominal: what controllers may compute with; the model itself by default.
        rates: control, sensor and physics rates.
        noise: standard deviation of white noise on each angle [rad].
        events: what befalls the robot, see ``plants.events``.
    """

    def __init__(
        self,
        model: Model,
        *,
        nominal: Morphology | Model | None = None,
        rates: PlantRates | None = None,
        noise: float = 0.0,
        events: Sequence[Event] = (),
    ) -> None:
        self.rates = rates or PlantRates()
        if not 0 <= noise < float("inf"):
            raise ConfigError(f"noise is {noise:g} rad, expected 0 or more")
        require_simulated(model.effects, f"{model.name}: the MuJoCo plant")
        self.model = model
        self.noise = noise
        robot = changed_bodies(model.effects, model.morphology)
        self._dt = 1 / self.rates.physics
        self._steps = whole_ratio(self.rates.physics, self.rates.control, "physics rate over control rate")
        self._sensor_steps = whole_ratio(self.rates.physics, self.rates.sensor, "physics rate over sensor rate")
        self._kinematics = Kinematics(robot, model.phase)
        self.mujoco_model = compile_model(robot, model.phase, replace(FAST_SETTINGS, timestep=self._dt))
        self.mujoco_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        self._forces = ForceStepper(model, robot, self.mujoco_model)
        self.data = mujoco.MjData(self.mujoco_model)
        joints = [self.mujoco_model.joint(name) for name in model.morphology.joint_names]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._valve = valve_settings(model.effects, model.morphology.actuator_names)
        self._sensor = sensor_settings(model.effects, model.morphology.joint_names)
        self._spec = make_spec(model.morphology, 1 / self.rates.control, nominal or model, model.phase)
        self._step_count = -1
        self._diverged: str | None = None
        self._events = tuple(events)
        self._loads = self._loaded(robot)

    def _loaded(self, robot: Morphology) -> list[tuple[float, dict[str, Array]]]:
        """When loads are taken up [s], the last first, and MuJoCo's numbers of the bodies from then on."""
        found = [(-math.inf, _bodies(self.mujoco_model))]
        for event in self._events:
            if isinstance(event, Push) and event.torque.shape != (len(robot.joints),):
                raise ConfigError(
                    f"{self.model.name}: a push has {len(event.torque)} torques, expected one for each of "
                    f"{', '.join(robot.joint_names)}"
                )
        for load in sorted((e for e in self._events if isinstance(e, Load)), key=lambda e: e.time):
            robot = changed_bodies((PayloadMass(load.location, load.mass),), robot)
            compiled = compile_model(robot, self.model.phase, replace(FAST_SETTINGS, timestep=self._dt))
            found.append((load.time, _bodies(compiled)))
        return found[::-1]

    def _befall(self, time: float) -> None:
        """What the events do from a time on."""
        numbers = next(values for begins, values in self._loads if begins <= time + EARLY)
        for name, values in numbers.items():
            getattr(self.mujoco_model, name)[:] = values
        torque = self.data.qfrc_applied
        if not self._forces.active:
            torque[:] = 0.0
        for event in self._events:
            if isinstance(event, Push) and event.time <= time + EARLY < event.time + event.duration:
                torque[self._dof] += event.torque

    @property
    def spec(self) -> PlantSpec:
        """What a controller may know."""
        return self._spec

    @property
    def truth(self) -> Array:
        """(nj,) true joint angles now [rad], see ``types.KnowsTruth``."""
        return self.position

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
        command = self.spec.command_low if start.command is None else start.command
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
            raise ConfigError(
                f"start command {_kpa(command)} kPa lies outside {_kpa(self.spec.command_low)} to "
                f"{_kpa(self.spec.command_high)} kPa"
            )
        reaches = self._shaped(np.asarray(command))
        position = rest_pose(self.model, command) if start.position is None else start.position
        mujoco.mj_resetData(self.mujoco_model, self.data)
        if self._events:
            self._befall(-math.inf)
        self._place(np.asarray(position), start.velocity)
        self._forces.reset(np.asarray(position))
        self._diverged = None
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

    def _place(self, position: Array, velocity: Array | None) -> None:
        place(self.mujoco_model, self.data, self._kinematics, position, velocity)

    def _physics_step(self) -> None:
        n = self._control_count
        t = self._step_count * self._dt
        for i in range(len(self._cursor)):
            self._pressure[i], self.data.ctrl[i], _, self._cursor[i] = advance_pressure(
                self._times[:n],
                self._commands[:n, i],
                self._before[i],
                self._cursor[i],
                t,
                self._dt,
                self._pressure[i],
                self._valve[i],
            )
        self._forces.apply(self.data)
        if self._events:
            self._befall(t)
        slow = self._is_slow()
        sound = step_quietly(self.mujoco_model, self.data)
        self._step_count += 1
        if self._sensor_remembers():
            self._remember()
            for j, row in enumerate(self._sensor):
                self._held[j] = follow(self._held[j], self._seen(j), row[PLAY])
        if not (slow and sound and self._is_slow()):
            self._diverged = (
                f"{self.model.name}: the simulation diverged at {self._step_count * self._dt:.3f} s under commands of "
                f"{_kpa(self._commands[n - 1])} kPa; a shorter physics step or gentler gains would be needed"
            )
            raise SimulationDiverged(self._diverged)

    def _is_slow(self) -> bool:
        return bool(np.all(np.abs(self.data.qvel[self._dof]) < MAX_SPEED))

    def _shaped(self, command: Array) -> Array:
        names = self.model.morphology.actuator_names
        return np.array(shaped_commands(self.model.effects, names, command[None, :])[0])

    def _sensor_remembers(self) -> bool:
        return bool(np.any(self._sensor[:, SENSOR_DELAY] > 0) or np.any(self._sensor[:, PLAY] > 0))

    def _remember(self) -> None:
        newest = self._step_count % self._past.shape[1]
        self._past[:, newest, 0], self._past[:, newest, 1] = self.position, self.data.qvel[self._dof]

    def _seen(self, j: int) -> float:
        """Where joint j was its sensor's delay ago [rad]."""
        sensor_delay = self._sensor[j, SENSOR_DELAY]
        if sensor_delay == 0.0:
            return float(self.position[j])
        return float(recall(self._past[j], self._step_count, sensor_delay / self._dt, self._dt))

    def _measure(self) -> None:
        self._stamp = self._step_count * self._dt
        seen = np.array([self._held[j] if row[PLAY] > 0 else self._seen(j) for j, row in enumerate(self._sensor)])
        noise = self._rng.normal(0.0, self.noise, len(self._qpos)) if self.noise > 0 else 0.0
        self._measured = frozen_array(shown(self._sensor, seen) + noise)

    def _observation(self, applied: Array) -> Observation:
        clipped = self._clipped.copy()
        clipped.flags.writeable = False
        return Observation(
            time=self._control_count * self.spec.control_dt,
            position=self._measured,
            stamp=self._stamp,
            command=frozen_array(applied),
            clipped=clipped,
        )


BODIES = (
    "body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0", "dof_invweight0",
    "dof_M0", "tendon_invweight0", "actuator_acc0",
)  # fmt: skip
"""What MuJoCo works out of the bodies' masses."""
EARLY = 1e-9
"""Times that differ by less are the same [s]."""


def _bodies(model: mujoco.MjModel) -> dict[str, Array]:
    return {name: np.array(getattr(model, name)) for name in BODIES}


def _kpa(pressure: Array) -> str:
    return "(" + ", ".join(f"{value / 1e3:g}" for value in pressure) + ")"
