"""The vocabulary shared by plants, controllers, scenarios and recordings: frozen data and protocols.

Units are SI throughout: seconds, radians, pascals, metres. Arrays held by these classes are read-only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.frames import dataframe
from equimus_ctrl.shown import Short, listed

if TYPE_CHECKING:
    from pandas import DataFrame

Array = NDArray[np.float64]
Sense = Literal["velocities", "torques"]
"""What a plant may measure beside positions, and a controller may need: see ``Observation``."""


def frozen_array(values: ArrayLike, ndim: int | None = None, name: str = "array") -> Array:
    """A read-only float64 copy of ``values``; raises ConfigError if it has not ``ndim`` dimensions."""
    array = np.array(values, dtype=np.float64)
    if ndim is not None and array.ndim != ndim:
        raise ConfigError(f"{name}: expected {ndim} dimension(s), got an array of shape {array.shape}")
    array.flags.writeable = False
    return array


def _columns(parts: Iterable[tuple[str, Sequence[str], Array]]) -> dict[str, Array]:
    """Kind, names and values (n, k) of each part → ``kind.name`` → (n,)."""
    return {f"{kind}.{name}": values[:, k] for kind, names, values in parts for k, name in enumerate(names)}


@dataclass(frozen=True, eq=False, repr=False)
class PrescribedMotion(Short):
    """How joints move whose motion is an input, taken as it was measured: cubic splines with knots at some instants.

    Accelerations are linear between the instants, so positions and rates there say all.

    Attributes:
        joints: their names.
        times: (n,) ascending instants [s].
        position: (n, np) there [rad or m].
        velocity: (n, np) [rad/s or m/s].
        acceleration: (n, np) [rad/s² or m/s²].
        noise: (np,) standard deviation of what was measured about it [rad or m].
    """

    joints: tuple[str, ...]
    times: Array
    position: Array
    velocity: Array
    acceleration: Array
    noise: Array

    def __post_init__(self) -> None:
        for key in ("position", "velocity", "acceleration"):
            array = frozen_array(getattr(self, key), 2, key)
            object.__setattr__(self, key, array)
            if array.shape != (len(self.times), len(self.joints)):
                raise ConfigError(f"{key} has shape {array.shape}, expected {(len(self.times), len(self.joints))}")

    @classmethod
    def at_rest(cls, joints: tuple[str, ...]) -> PrescribedMotion:
        """Joints that stay at 0."""
        still = np.zeros((2, len(joints)))
        return cls(joints, np.array([0.0, 1.0]), still, still, still, still[0])

    def at(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """(…, np) positions, rates and accelerations at some instants (…) [s]; beyond the ends as the last piece."""
        wanted = np.asarray(times, dtype=np.float64)
        k = np.clip(np.searchsorted(self.times, wanted, side="right") - 1, 0, len(self.times) - 2)
        s, h = (wanted - self.times[k])[..., None], (self.times[k + 1] - self.times[k])[..., None]
        q, v, a = self.position[k], self.velocity[k], self.acceleration[k]
        jerk = (self.acceleration[k + 1] - a) / h
        return q + s * (v + s * (a / 2 + s * jerk / 6)), v + s * (a + s * jerk / 2), a + s * jerk


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Short):
    """One trial: commands in force and angles measured, row by row.

    A command holds from its row until the next one (zero-order hold), or goes along a line to it where a note says
    ``interpolation = linear``.

    Attributes:
        name: what the trial is called, usually the file's stem.
        time: (n,) strictly ascending sample times [s].
        command: (n, n_actuators) commanded pressures [Pa].
        position: (n, n_joints) measured joint angles [rad].
        actuators: names of the command columns.
        joints: names of the position columns.
        velocity: (n, n_joints) measured joint velocities [rad/s], where the sensor gives them.
        measured: (n, n_actuators) measured pressures [Pa], of an MJCF robot measured forces before the gear [N·m or N],
            where a sensor gives them; a column of nan where none does.
        sites: (n,) each, measured coordinates of sites in the room [m], such as ``tip.x``, where something sees them.
        before: (n_actuators,) command in force before the first row, long enough for the robot to have
            settled [Pa]; the first row's command where the recording does not say.
        notes: provenance and whatever else the file says of itself.
        prescribed: how joints moved whose motion is an input; they are none of ``joints``.
        supposed: how joints may have moved that were not measured, for where their motion begins.
        inputs: (n,) each, the columns of a file that ``prescribed`` was made of, such as ``pos.base.x``.
    """

    name: str
    time: Array
    command: Array
    position: Array
    actuators: tuple[str, ...]
    joints: tuple[str, ...]
    velocity: Array | None = None
    measured: Array | None = None
    before: Array | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    sites: Mapping[str, Array] = field(default_factory=dict)
    prescribed: PrescribedMotion | None = None
    supposed: PrescribedMotion | None = None
    inputs: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, ndim in (("time", 1), ("command", 2), ("position", 2)):
            object.__setattr__(self, key, frozen_array(getattr(self, key), ndim, f"{self.name}: {key}"))
        for key, ndim in (("velocity", 2), ("measured", 2), ("before", 1)):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, frozen_array(getattr(self, key), ndim, f"{self.name}: {key}"))
        object.__setattr__(self, "notes", dict(self.notes))
        sites = {name: frozen_array(values, 1, f"{self.name}: site.{name}") for name, values in self.sites.items()}
        object.__setattr__(self, "sites", sites)
        inputs = {name: frozen_array(values, 1, f"{self.name}: {name}") for name, values in self.inputs.items()}
        object.__setattr__(self, "inputs", inputs)
        n = len(self.time)
        shapes: dict[str, tuple[Array | None, tuple[int, ...]]] = {
            "command": (self.command, (n, len(self.actuators))),
            "position": (self.position, (n, len(self.joints))),
            "velocity": (self.velocity, (n, len(self.joints))),
            "measured": (self.measured, (n, len(self.actuators))),
            "before": (self.before, (len(self.actuators),)),
            **{f"site.{name}": (values, (n,)) for name, values in sites.items()},
            **{name: (values, (n,)) for name, values in inputs.items()},
        }
        for key, (array, shape) in shapes.items():
            if array is not None and array.shape != shape:
                raise ConfigError(f"{self.name}: {key} has shape {array.shape}, expected {shape}")

    def told(self) -> str:
        """Length, joints and actuators."""
        lasts = float(self.time[-1] - self.time[0]) if len(self.time) else 0.0
        named = f"{listed(self.joints, 'joint')}, {listed(self.actuators, 'actuator')}"
        return f" {self.name!r}: {len(self.time)} rows over {lasts:.6g} s, {named}"

    def to_dataframe(self) -> DataFrame:
        """A row for each sample by its ``time`` [s], columns as in a recording's file: ``cmd.maa``, ``pos.hip``.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        parts = [("cmd", self.actuators, self.command), ("pos", self.joints, self.position)]
        for kind, names, values in (("vel", self.joints, self.velocity), ("meas", self.actuators, self.measured)):
            parts += [] if values is None else [(kind, names, values)]
        sites = {f"site.{name}": values for name, values in self.sites.items()}
        return dataframe({"time": self.time, **_columns(parts), **self.inputs, **sites}, "time")

    @property
    def poses(self) -> Array:
        """(n, nj + np + nu) measured positions, behind them those of prescribed and of unmeasured joints."""
        beside = [own.at(self.time)[0] for own in (self.prescribed, self.supposed) if own is not None]
        return np.column_stack([self.position, *beside]) if beside else self.position

    @property
    def command_before(self) -> Array:
        """(n_actuators,) the command in force before the first row [Pa]."""
        return self.command[0] if self.before is None else self.before

    @property
    def force_columns(self) -> tuple[int, ...]:
        """The places of actuators of which something was measured."""
        if self.measured is None:
            return ()
        return tuple(int(i) for i in np.flatnonzero(~np.isnan(self.measured).all(axis=0)))

    @property
    def linear(self) -> bool:
        """Whether commands go along a line from each row to the next (first-order hold)."""
        return self.notes.get("interpolation") == "linear"


@dataclass(frozen=True, eq=False, repr=False)
class PlantSpec(Short):
    """What a controller may know of the plant it drives.

    Attributes:
        joints: joint names, in the order of every position array.
        actuators: actuator names, in the order of every command array.
        command_low: (n_actuators,) lowest command [Pa].
        command_high: (n_actuators,) highest command [Pa].
        control_dt: time between two commands [s].
        model: the nominal robot the controller may compute with (a ``robots.base.Robot``), or None.
        phase: ``"swing"`` (base fixed) or ``"stance"`` (foot pinned), which the model's statics depend on.
        joint_low: (n_joints,) lower end of the joint range [rad].
        joint_high: (n_joints,) upper end of the joint range [rad].
        effects: what is known to be attached to the model (``effects.Effect``).
        joint_units: SI units of the joints' positions; rad by default, and whatever is said of rad holds for them.
        command_units: SI units of the commands; Pa by default, alike.
        command_rate: (n_actuators,) how fast what a command asks for can change, ±inf by default [its unit/s].
        goals: of each actuator whether its command is a goal for where something is.
        senses: what is measured of the joints beside their positions.
    """

    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    command_low: Array
    command_high: Array
    control_dt: float
    joint_low: Array
    joint_high: Array
    model: Any = None
    phase: Literal["swing", "stance"] = "swing"
    effects: tuple[Any, ...] = ()
    joint_units: tuple[str, ...] = ()
    command_units: tuple[str, ...] = ()
    command_rate: Array = field(default_factory=lambda: np.empty(0))
    goals: tuple[bool, ...] = ()
    senses: frozenset[Sense] = frozenset()

    def __post_init__(self) -> None:
        na = len(self.actuators)
        object.__setattr__(self, "joint_units", self.joint_units or ("rad",) * len(self.joints))
        object.__setattr__(self, "command_units", self.command_units or ("Pa",) * na)
        object.__setattr__(self, "goals", self.goals or (False,) * na)
        rate = self.command_rate if len(self.command_rate) else np.full(na, np.inf)
        object.__setattr__(self, "command_rate", frozen_array(rate, 1, "command rate"))


@dataclass(frozen=True, eq=False, repr=False)
class Observation(Short):
    """What the sensors and the command interface give at one control instant.

    Attributes:
        time: the control instant [s].
        position: (n_joints,) latest measured joint angles [rad].
        stamp: when ``position`` was measured [s]; never later than ``time``.
        command: (n_actuators,) the command in force until now, after clipping [Pa].
        clipped: (n_actuators,) True where the last command asked for had to be clipped.
        velocity: (n_joints,) measured with ``position`` [rad/s or m/s], of a plant that senses ``"velocities"``.
        torque: (n_joints,) what actuators exert on the joints, measured alike [N·m or N], of one that senses
            ``"torques"``.
    """

    time: float
    position: Array
    stamp: float
    command: Array
    clipped: NDArray[np.bool_]
    velocity: Array | None = None
    torque: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Start(Short):
    """Where a run begins: at rest, the command having been in force long enough for the pressures to have settled.

    Attributes:
        command: (n_actuators,) in force before the start [Pa]; None means the lowest command.
        position: (n_joints,) joint angles [rad]; None means the equilibrium under ``command``.
        velocity: (n_joints,) joint velocities [rad/s]; None means none.
    """

    command: Array | None = None
    position: Array | None = None
    velocity: Array | None = None

    def __post_init__(self) -> None:
        for key in ("command", "position", "velocity"):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, frozen_array(getattr(self, key), 1, f"start {key}"))


@dataclass(frozen=True, eq=False, repr=False)
class Run(Short):
    """What happened in one run, one row a control instant.

    Attributes:
        spec: of the plant.
        time: (n,) control instants [s].
        position: (n, nj) angles as measured [rad].
        reference: (n, nj) angles wanted [rad].
        command: (n, na) commands applied from each instant on, after clipping [Pa].
        asked: (n, na) commands the controller asked for [Pa].
        clipped: (n, na) True where the two differ.
        solve_time: (n,) how long each controller step took [s]; a statistic, never part of the physics.
        before: (na,) command in force before the start [Pa].
        truth: (n, nj) true angles [rad], where the plant knows them; what is measured has noise and sensor effects.
        status: (n,) what the controller's state calls its ``status`` after each step; "" where it has none.
        note: what its state says of itself in the end, a sentence for a person; "" where it says nothing.
    """

    spec: PlantSpec
    time: Array
    position: Array
    reference: Array
    command: Array
    asked: Array
    clipped: NDArray[np.bool_]
    solve_time: Array
    before: Array
    truth: Array | None = None
    status: tuple[str, ...] = ()
    note: str = ""

    def told(self) -> str:
        """Length, joints and actuators."""
        lasts = float(self.time[-1]) if len(self.time) else 0.0
        named = f"{listed(self.spec.joints, 'joint')}, {listed(self.spec.actuators, 'actuator')}"
        return f": {len(self.time)} control instants over {lasts:.6g} s, {named}"

    @property
    def columns(self) -> dict[str, Array]:
        """Column → values (n,), SI.

        They are ``time``, ``cmd.*`` as applied, ``pos.*`` as measured, ``ref.*``, ``true.*`` where the plant knows
        them, and ``asked.*`` as the controller had it.
        """
        joints, actuators = self.spec.joints, self.spec.actuators
        parts = [("cmd", actuators, self.command), ("pos", joints, self.position), ("ref", joints, self.reference)]
        parts += [] if self.truth is None else [("true", joints, self.truth)]
        return {"time": self.time, **_columns([*parts, ("asked", actuators, self.asked)])}

    def to_dataframe(self) -> DataFrame:
        """A row for each control instant by its ``time`` [s], of ``columns``.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        return dataframe(self.columns, "time")

    def recording(self, name: str, notes: Mapping[str, str] | None = None) -> Recording:
        """The run in the recording vocabulary."""
        spec = self.spec
        return Recording(
            name,
            self.time,
            self.command,
            self.position,
            spec.actuators,
            spec.joints,
            before=self.before,
            notes=notes or {},
        )


@dataclass(frozen=True, eq=False, repr=False)
class FeedbackLaw(Short):
    """Feedback by which a robot tracks references of its joints: a feed-forward, and PD on the error of tracking.

        u_k = f_k + K e_k + D d_k,    e_k = r_k − y_k,    d_k = d_{k−1} + h/(T + h) ((e_k − e_{k−1})/h − d_{k−1})

    r_k is the reference, y_k what sensors show, f_k the feed-forward, h the time between commands. d_k is the filtered
    rate of the error, 0 at first. Commands are clipped to their ranges. It is PD with feed-forward of computed torques
    (Siciliano et al., *Robotics*, 2009, section 8.5.2).

    Attributes:
        stiffness: K (n_actuators, n_joints) [unit of each command per rad or m].
        damping: D (n_actuators, n_joints) [the same in a second].
        smoothing: T, time constant of the filter of the error's rate [s].

    Raises:
        ConfigError: for matrices of two shapes, or numbers that cannot be.
    """

    stiffness: Array
    damping: Array
    smoothing: float

    def __post_init__(self) -> None:
        for key in ("stiffness", "damping"):
            value = frozen_array(getattr(self, key), 2, key)
            object.__setattr__(self, key, value)
            if value.shape != self.stiffness.shape or not np.all(np.isfinite(value)):
                raise ConfigError(f"{key} of a feedback law is no matrix of finite numbers like its stiffness")
        if not 0 <= self.smoothing < np.inf:
            raise ConfigError(f"the smoothing of a feedback law is {self.smoothing:g} s, expected at least 0")

    def told(self) -> str:
        """Its size."""
        return f" from {self.stiffness.shape[1]} joints to {self.stiffness.shape[0]} commands"


@runtime_checkable
class Reference(Protocol):
    """Where the joints should be."""

    def position(self, time: float) -> Array:
        """(n_joints,) wanted joint angles at ``time`` [rad]."""
        ...


class Plant(Protocol):
    """Something that takes pressures and gives joint angles: simulated, replayed or real.

    It may also be a ``KnowsTruth``, an ``Ends`` or a ``CountsInstants``, and is asked for no more than it is.
    """

    @property
    def spec(self) -> PlantSpec:
        """What a controller may know of this plant."""
        ...

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        """Go to ``start`` and return what is seen there; the same seed gives the same bits."""
        ...

    def step(self, command: ArrayLike) -> Observation:
        """Hold ``command`` (n_actuators,) [Pa] for one control period; return what is seen then."""
        ...

    def close(self) -> None:
        """Let go of files, threads or devices."""
        ...


@runtime_checkable
class KnowsTruth(Protocol):
    """What a plant may be able to do beside: tell where its joints truly are, as one that is simulated can."""

    @property
    def truth(self) -> Array:
        """(n_joints,) true angles now [rad]; sensors show them late, with noise, or otherwise wrong."""
        ...


@runtime_checkable
class KnowsContacts(Protocol):
    """The same: tell what of it has touched."""

    @property
    def touched(self) -> str:
        """Which two geoms were the first since the reset, and when, a phrase; empty where none have."""
        ...


@runtime_checkable
class Ends(Protocol):
    """The same: come to an end by itself, as a recording does; it is driven no longer than that."""

    @property
    def duration(self) -> float:
        """From its reset on [s]."""
        ...


class Counts(Protocol):
    """What a loop saw of itself."""

    def to_dict(self) -> dict[str, Any]:
        """For people and machines, see ``run --json``."""
        ...


@runtime_checkable
class CountsInstants(Protocol):
    """The same: count what became of its control instants, as one that has to keep up with the clock does."""

    @property
    def counts(self) -> Counts:
        """Since its reset."""
        ...


class Controller(Protocol):
    """Immutable settings plus two functions; whatever evolves lives in the state they hand on.

    One that needs more than positions says so: ``senses = ("velocities",)``, an attribute of the class or the function.
    A plant that does not measure that is refused before it moves, see ``simulate.check_senses``.
    """

    def init(self, spec: PlantSpec, observation: Observation) -> Any:
        """The state to start from, given the plant and its first observation."""
        ...

    def step(self, observation: Observation, reference: Reference, state: Any) -> tuple[ArrayLike, Any]:
        """The next command (n_actuators,) [Pa] and the next state."""
        ...
