"""Many models through many trials at once, on the reduced engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.effects.base import Effect, require_kinds
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.force import ForceEffect, force_laws
from equimus_ctrl.effects.sensors import SensorEffect, sensor_settings
from equimus_ctrl.effects.valves import ShapingEffect, ValveEffect, shaped_commands, valve_settings
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.engines.limits import MOST_DIVISOR
from equimus_ctrl.engines.steps import warn_if_coarse
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.machine import processors
from equimus_ctrl.models.augmented import augmented_model, law_parameters, slots_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.morphology import pack, structure
from equimus_ctrl.types import Array, Recording

STEP = 1e-3
"""Default physics step [s]."""

KNOWN_KINDS = (BodyEffect, ForceEffect, SensorEffect, ShapingEffect, ValveEffect)


@dataclass(frozen=True, eq=False)
class Trial:
    """A command history and the times at which the angles are wanted.

    Attributes:
        name: for messages.
        times: (n,) ascending instants from which each command holds [s].
        commands: (n, na) [Pa].
        before: (na,) command in force before times[0] [Pa], the pressures settled under it.
        start: when the motion starts [s].
        position: (nj,) angles there [rad].
        sample_times: (m,) ascending, none before ``start`` [s].
        velocity: (nj,) joint velocities at the start [rad/s]; none by default.
        settings: numbers of the model that are known to be others in this trial, by dotted name.
        factors: the same, in units of what the model has.
    """

    name: str
    times: Array
    commands: Array
    before: Array
    start: float
    position: Array
    sample_times: Array
    velocity: Array | None = None
    settings: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, recording: Recording, position: ArrayLike, window: tuple[float, float] | None = None) -> Trial:
        """A recording's commands and times, the motion starting at its first row, or at the window's beginning.

        Args:
            recording: whose.
            position: (nj,) angles at the start [rad].
            window: (from, to) what is sampled and simulated [s]; the whole recording by default.
        """
        time = recording.time
        inside = np.ones(len(time), dtype=bool)
        if window is not None:
            inside = (time >= window[0]) & (time <= window[1])
        start = time[0] if window is None else max(window[0], time[0])
        return cls(
            recording.name,
            np.array(time),
            np.array(recording.command),
            np.array(recording.command_before),
            float(start),
            np.array(position, dtype=np.float64),
            np.array(time[inside]),
        )

    def starting_from(self, position: ArrayLike) -> Trial:
        """The same from other angles (nj,) [rad]."""
        return replace(self, position=np.array(position, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Predicted:
    """What ``simulate`` found for one trial.

    Attributes:
        position: (k, m, nj) measured angles of each model [rad]; numbers after a divergence mean nothing.
        reached: (k,) m where all is well, else the index of the first sample that could not be had.
    """

    position: Array
    reached: NDArray[np.int64]

    @property
    def sound(self) -> NDArray[np.bool_]:
        """(k,) which models went through without diverging."""
        return np.asarray(self.reached == self.position.shape[1])


@dataclass(frozen=True, eq=False)
class EncodedModels:
    """Models of one structure as the arrays that the kernels take.

    Attributes:
        models: (k) whose.
        parameters: (k, np).
        valve: (k, na, 6).
        sensor: (k, nj, 4).
        rubbing: rows of dry friction in use.
    """

    models: Sequence[Model]
    parameters: Array
    valve: Array
    sensor: Array
    rubbing: NDArray[np.int64]


def encode(models: Sequence[Model]) -> EncodedModels:
    """The arrays of some models.

    Raises:
        ConfigError: where there is none, they differ in structure or phase, or an effect is of no kind known here.
    """
    if not models:
        raise ConfigError("no model was given to simulate")
    first = models[0]
    m = first.morphology
    form, laws = structure(m), force_laws()
    slots = slots_of(form, laws)
    places = augmented_model(form, first.phase, laws).rubbing
    names = {"joint": m.joint_names, "actuator": m.actuator_names}
    in_use: set[int] = set()
    rows, valves, sensors = [], [], []
    for model in models:
        if model.phase != first.phase or structure(model.morphology) != form:
            raise ConfigError(
                f"{model.name} and {first.name} differ in structure or phase, so they cannot run together"
            )
        require_kinds(model.effects, KNOWN_KINDS, f"{model.name}: the reduced engine")
        for effect in model.effects:
            if isinstance(effect, ForceEffect) and effect.rubs:
                in_use |= {r for r, (kind, i) in enumerate(places) if names[kind][i] == effect.location}
        robot = changed_bodies(model.effects, model.morphology)
        rows.append(np.concatenate([pack(robot), law_parameters(slots, model.effects, *names.values())]))
        valves.append(valve_settings(model.effects, m.actuator_names))
        sensors.append(sensor_settings(model.effects, m.joint_names))
    return EncodedModels(
        models, np.array(rows), np.array(valves), np.array(sensors), np.array(sorted(in_use), dtype=np.int64)
    )


def simulate(
    models: Sequence[Model] | EncodedModels,
    trials: Sequence[Trial],
    *,
    starts: Sequence[Array] | None = None,
    dt: float = STEP,
    threads: int | None = None,
    check: bool = True,
) -> list[Predicted]:
    """Every model through every trial, by Runge–Kutta steps of order four with dry friction at velocity level.

    Where a joint's stop is hit or left a step is cut, and while one is pressed it is divided as its push asks for.

    Args:
        models: of one structure and phase; they may differ in all numbers and effects.
        trials: what is predicted.
        starts: for each trial (k, nj) angles at the start, or (k, 2 nj) angles and velocities, one row a model [rad,
            rad/s]; the trial's own by default.
        dt: physics step [s].
        threads: to use; as many as there are cores by default. The result does not depend on it.
        check: warn where the step is too long for the first model.

    Returns:
        One ``Predicted`` for each trial.

    Raises:
        ConfigError: where models do not go together or ``dt`` is no step.
    """
    if not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    coded = models if isinstance(models, EncodedModels) else encode(models)
    m = coded.models[0].morphology
    kernel = compiled.load_lanes(structure(m), coded.models[0].phase, force_laws())
    k, nj = len(coded.models), len(m.joints)
    results = [Predicted(np.empty((k, len(trial.sample_times), nj)), np.zeros(k, dtype=np.int64)) for trial in trials]

    def work(task: tuple[int, int]) -> None:
        index, first = task
        trial = trials[index]
        block = slice(first, min(first + LANES, k))
        chosen = coded.models[block]
        q0 = np.tile(trial.position, (len(chosen), 1))
        v0 = np.zeros((len(chosen), nj)) if trial.velocity is None else np.tile(trial.velocity, (len(chosen), 1))
        if starts is not None:
            q0 = np.array(starts[index][block, :nj])
            v0 = np.array(starts[index][block, nj:]) if starts[index].shape[1] > nj else v0
        once = {effects: _shaped(effects, m.actuator_names, trial) for effects in {model.effects for model in chosen}}
        history = [once[model.effects] for model in chosen]
        span = trial.sample_times[-1] - trial.start if len(trial.sample_times) else 0.0
        steps = max(int(np.ceil(span / dt - 1e-9)), 1)
        position, reached = np.empty((len(chosen), *results[index].position.shape[1:])), np.zeros(len(chosen), np.int64)
        kernel.run_block(
            coded.parameters[block].copy(),
            trial.times,
            np.array([h[1:] for h in history]),
            np.array([h[0] for h in history]),
            coded.valve[block].copy(),
            coded.sensor[block].copy(),
            q0,
            v0,
            coded.rubbing,
            trial.start,
            dt,
            steps,
            trial.sample_times,
            position,
            reached,
        )
        results[index].position[block] = position
        results[index].reached[block] = reached

    tasks = [(index, first) for index in range(len(trials)) for first in range(0, k, LANES)]
    count = min(threads or processors(), len(tasks))
    if count <= 1:
        for task in tasks:
            work(task)
    else:
        if not kernel.run_block.signatures:
            work(tasks.pop(0))  # what has to be compiled is compiled once
        with ThreadPoolExecutor(count) as pool:
            list(pool.map(work, tasks))
    poses = [trial.position for trial in trials]
    if check and all(found.sound[0] for found in results):  # a divergence tells by itself
        robot = changed_bodies(coded.models[0].effects, m)
        reached = [found.position[0] for found in results]
        warn_if_coarse(robot, coded.models[0].phase, poses, dt, reached, MOST_DIVISOR)
    return results


def compile_kernel(model: Model) -> None:
    """Compile what ``simulate`` needs for a model's structure and force laws, or find it in the cache of kernels."""
    nj, na = len(model.morphology.joints), len(model.morphology.actuators)
    rest = np.zeros((1, na))
    trial = Trial("first", np.zeros(1), rest, rest[0], 0.0, np.full(nj, 0.5), np.array([0.0, 1e-3]))
    simulate([model], [trial], dt=1e-3, threads=1, check=False)


def _shaped(effects: Sequence[Effect], actuators: Sequence[str], trial: Trial) -> Array:
    """(1 + n, na) what reaches the valves: before the first row, then row by row [Pa]."""
    return shaped_commands(effects, actuators, np.vstack([trial.before, trial.commands]))
