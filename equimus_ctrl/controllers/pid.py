"""PID on actuator lengths or joint angles, fed forward by the static pressures or the inverse of the model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from equimus_ctrl.controllers import pid_kernel
from equimus_ctrl.controllers.inverse import Inverse, InverseState
from equimus_ctrl.engines import compiled
from equimus_ctrl.errors import ConfigError, ControllerError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

FORMAT = "equimus-ctrl/pid/1"
Space = Literal["length", "joint"]


@dataclass(frozen=True)
class PidGains:
    """One channel's gains. Efforts are forces [N] on a length [m], or torques [N·m] on an angle [rad].

    Attributes:
        kp: effort per error.
        ki: effort per error and second.
        kd: effort per rate of error.
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0

    def __post_init__(self) -> None:
        for key, value in asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected a finite number of at least 0")


@dataclass(frozen=True)
class PidSettings:
    """Settings of a PID; the law is in ``controllers.pid_kernel``.

    Attributes:
        gains: channel name (actuator or joint) → gains.
        space: ``"length"`` closes a loop round each actuator's length, ``"joint"`` round each joint's angle.
        derivative_time: time constant of the derivative filter [s].
        tracking_time: how fast the integrator follows a saturated command (anti-windup) [s].
        proportional_weight: share of the reference in the proportional term.
        derivative_weight: share of the reference in the derivative term.
        start_time: over which the first measured pose fades out of the reference (bumpless start) [s].
        feedforward: whether pressures are added that follow from the reference alone.
        inverse: whether these pressures are the inverse of all that is known of the plant: motion, forces, valves
            and sensors (``controllers.inverse``); else they hold the reference pose at rest.
    """

    gains: Mapping[str, PidGains]
    space: Space = "length"
    derivative_time: float = 0.02
    tracking_time: float = 0.2
    proportional_weight: float = 1.0
    derivative_weight: float = 1.0
    start_time: float = 0.3
    feedforward: bool = True
    inverse: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "gains", dict(self.gains))
        if self.space not in get_args(Space):
            raise ConfigError(unknown_name("PID space", str(self.space), get_args(Space)))
        for key in ("derivative_time", "tracking_time", "proportional_weight", "derivative_weight", "start_time"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{key} is {value:g}, expected a finite number of at least 0")
        if self.inverse and not self.feedforward:
            raise ConfigError("inverse is true, which is a way to feed forward, but feedforward is false")

    def channels(self, spec_or_model: PlantSpec | Morphology) -> tuple[str, ...]:
        """Names of the channels on a robot: its actuators or its joints."""
        if isinstance(spec_or_model, Morphology):
            m = spec_or_model
            return m.actuator_names if self.space == "length" else m.joint_names
        return spec_or_model.actuators if self.space == "length" else spec_or_model.joints

    def gain_matrix(self, channels: tuple[str, ...]) -> Array:
        """(7, n_channels) rows k_p, k_i, k_d, T_f, T_t, b, c, as the kernel takes them.

        Raises:
            ConfigError: where a channel has no gains or gains have no channel.
        """
        for name in self.gains:
            if name not in channels:
                raise ConfigError(unknown_name(f"{self.space} channel", name, channels, "PID gains"))
        for name in channels:
            if name not in self.gains:
                raise ConfigError(f"PID gains: channel {name!r} has none (given: {', '.join(self.gains) or 'none'})")
        shared = [self.derivative_time, self.tracking_time, self.proportional_weight, self.derivative_weight]
        return np.array([[g.kp, g.ki, g.kd, *shared] for g in (self.gains[name] for name in channels)]).T.copy()

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str = "PID settings") -> PidSettings:
        """Settings from what a TOML file holds.

        Raises:
            ConfigError: for an unknown or missing key or a value of the wrong kind, in a sentence with ``where``.
        """
        names = [f.name for f in fields(cls)]
        values: dict[str, Any] = {}
        for key, value in data.items():
            if key == "format":
                if value != FORMAT:
                    raise ConfigError(f"{where}: format is {value!r}, expected {FORMAT!r}")
                continue
            if key not in names:
                raise ConfigError(unknown_name("key", key, names, where))
            values[key] = value
            if key in ("space", "gains"):
                continue
            switch = key in ("feedforward", "inverse")
            if isinstance(value, bool) != switch or not isinstance(value, int | float):
                kind = "true or false" if switch else "a number"
                raise ConfigError(f"{where}: {key} is {value!r}, expected {kind}")
        gains = values.get("gains")
        if not isinstance(gains, Mapping) or not gains:
            raise ConfigError(f"{where}: there is no [gains.<channel>] table")
        values["gains"] = {name: _gains(table, f"{where}: gains.{name}") for name, table in gains.items()}
        try:
            return cls(**values)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """What a TOML file of these settings holds."""
        data = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "gains"}
        return {"format": FORMAT, **data, "gains": {name: asdict(gains) for name, gains in self.gains.items()}}


def _gains(table: Any, where: str) -> PidGains:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is {table!r}, expected a table with kp, ki and kd")
    known = [f.name for f in fields(PidGains)]
    for key, value in table.items():
        if key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{where}: {key} is {value!r}, expected a number")
    if "kp" not in table:
        raise ConfigError(f"{where}: 'kp' is missing")
    try:
        return PidGains(**{key: float(value) for key, value in table.items()})
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


@dataclass(frozen=True, eq=False)
class PidState:
    """What a PID carries from step to step.

    Attributes:
        memory: (3, n_channels) integral, filtered derivative, previous weighted error.
        offset: (n_joints,) first measured pose minus first reference [rad].
        begun: time of the first observation [s].
        spec: of the plant.
        constants: the nominal model's prepared numbers.
        gains: (7, n_channels).
        law: the compiled kernel module.
        low: (n_actuators,) lowest command of any use [Pa].
        high: (n_actuators,) highest [Pa].
        inverse: of the model, where it is what feeds forward.
        inverse_state: how far that has followed the reference.
    """

    memory: Array
    offset: Array
    begun: float
    spec: PlantSpec
    constants: Array
    gains: Array
    law: Any
    low: Array
    high: Array
    inverse: Inverse | None = None
    inverse_state: InverseState | None = None


@dataclass(frozen=True)
class PidController:
    """PID with filtered derivative, anti-windup, bumpless start and feed-forward.

    Attributes:
        settings: gains and the rest.
    """

    settings: PidSettings

    def init(self, spec: PlantSpec, observation: Observation) -> PidState:
        """Start so that the first command is the one in force.

        Raises:
            ControllerError: where the plant carries no nominal model, or a joint-space PID has not as many
                actuators as joints.
            ConfigError: where the gains do not match the plant's channels.
        """
        if not isinstance(spec.model, Morphology):
            raise ControllerError(
                "the PID computes lengths and static pressures from a nominal model, and this plant carries none"
            )
        if self.settings.space == "joint" and len(spec.joints) > len(spec.actuators):
            raise ControllerError(
                f"a joint-space PID needs at least as many actuators as joints, this plant has {len(spec.actuators)} "
                f'for {len(spec.joints)}; use space = "length"'
            )
        s = self.settings
        law = compiled.load(spec.model, spec.phase, pid_kernel)
        gains = s.gain_matrix(s.channels(spec))
        constants = compiled.prepared(spec.model, spec.phase)
        memory = np.zeros((3, gains.shape[1]))
        # Writable copies: numba compiles anew for read-only arrays.
        y, low, high = np.array(observation.position), np.array(spec.command_low), np.array(spec.command_high)
        inverse, following = None, None
        if s.inverse:
            inverse = Inverse(Model(spec.model, spec.effects, spec.phase), spec.control_dt, s.start_time)
            following = inverse.start(observation.time, y)
            low, high = np.maximum(low, inverse.low), np.minimum(high, inverse.high)
            surplus = inverse.surplus(following, observation.command)
        else:
            fed = np.empty(len(low))
            law.static_feed(y, s.feedforward, constants, fed)
            surplus = observation.command - fed
        law.pid_start(y, surplus, gains, s.space == "length", constants, memory)
        offset = np.full(len(spec.joints), np.nan)
        return PidState(memory, offset, observation.time, spec, constants, gains, law, low, high, inverse, following)

    def step(self, observation: Observation, reference: Reference, state: PidState) -> tuple[Array, PidState]:
        """The next command, within the plant's limits.

        What was measured is compared with where the robot was to be then; pressures are fed forward for now.
        """
        s, spec = self.settings, state.spec
        offset, following, fed = state.offset, state.inverse_state, np.empty(len(spec.actuators))
        now, measured = observation.time, max(observation.stamp, state.begun)
        if state.inverse is not None and following is not None:
            instants = np.array([now]), np.array([measured])
            shown, planned, following = state.inverse.follow(reference, instants[0], following, instants[1])
            r, fed = shown[0], planned[0]
        else:
            if np.isnan(offset).any():
                offset = observation.position - reference.position(measured)

            def pose(time: float) -> Array:
                weight = state.law.blend(time - state.begun, s.start_time)
                return np.asarray(reference.position(time) + weight * offset)

            r = pose(measured)
            state.law.static_feed(r if measured == now else pose(now), s.feedforward, state.constants, fed)
        memory = state.memory.copy()
        command = np.empty(len(spec.actuators))
        state.law.pid_command(
            r,
            np.array(observation.position),
            fed,
            state.gains,
            s.space == "length",
            state.low,
            state.high,
            spec.control_dt,
            state.constants,
            memory,
            command,
        )
        return frozen_array(command), replace(state, memory=memory, offset=offset, inverse_state=following)
