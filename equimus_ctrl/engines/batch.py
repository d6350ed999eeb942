"""Many models through many trials at once, on the reduced engine."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl import computer
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.following import FOLLOW_KIND, arrived
from equimus_ctrl.effects.sensors import PLAY, SPED_UP, STOOD, WENT_ON
from equimus_ctrl.effects.valves import ShapingEffect, shaped_commands
from equimus_ctrl.engines.drive_forces import drive_forces
from equimus_ctrl.engines.encoding import Encoded, grouped
from equimus_ctrl.engines.hidden import Commands, first_activations, lead, led_states, with_unknown
from equimus_ctrl.engines.lane_functions import LANES
from equimus_ctrl.engines.limits import MOST_DIVISOR
from equimus_ctrl.engines.steps import warn_if_coarse
from equimus_ctrl.engines.trials import Predicted, Trial, check_size
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import elastic_of
from equimus_ctrl.types import Array, PrescribedMotion

STEP = 1e-3
"""Default physics step [s]."""
BATCHES_A_THREAD = 4
"""In so many parts for each thread work is divided, so that none waits long for the others."""


def simulate(
    models: Sequence[Model] | Encoded,
    trials: Sequence[Trial],
    *,
    starts: Sequence[Array] | None = None,
    dt: float = STEP,
    threads: int | None = None,
    check: bool = True,
) -> list[Predicted]:
    """Every model through every trial, by Runge–Kutta steps of order four with dry friction at velocity level.

    Where a joint's stop is hit or left a step is cut, and while one is pressed it is divided as its stiffness asks for.

    Args:
        models: of one robot; they may differ in all parameters and effects. Encoded beforehand they are the same in
            every trial.
        trials: what is predicted.
        starts: for each trial (k, nj) joint positions at the start, or (k, 2 nj) positions and velocities, one row a
            model [rad or m, rad/s or m/s]; the trial's own by default. What else may begin anywhere follows them, see
            ``Trial.begun`` and ``hidden.with_unknown``.
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
    coded = models if isinstance(models, Encoded) else None
    return _simulated(
        models.models if isinstance(models, Encoded) else models, coded, trials, starts, dt, threads, check
    )


def _simulated(
    models: Sequence[Model],
    coded: Encoded | None,
    trials: Sequence[Trial],
    starts: Sequence[Array] | None,
    dt: float,
    threads: int | None,
    check: bool,
) -> list[Predicted]:
    if not models:
        raise ConfigError("no model was given to simulate")
    check_size(trials, dt)
    k, nj = len(models), len(models[0].robot.joint_names)
    for model in models:
        same = model.robot.joint_names, model.robot.actuator_names, model.phase
        if same != (models[0].robot.joint_names, models[0].robot.actuator_names, models[0].phase):
            raise ConfigError(
                f"{model.name} and {models[0].name} differ in structure or phase, so they cannot run together"
            )
    results = [Predicted.empty(k, trial, nj) for trial in trials]
    tasks: list[tuple[_Block, _Part]] = []
    histories = _Histories()
    count = computer.worker_count(threads, name="threads")
    for condition in dict.fromkeys(trial.condition for trial in trials):
        own_trials = [index for index, trial in enumerate(trials) if trial.condition == condition]
        groups = grouped(models, trials[own_trials[0]]) if coded is None else [(list(range(k)), coded)]
        for chosen, arrays in groups:
            blocks = [
                _Block(arrays, np.array(chosen[first : first + LANES]), slice(first, first + LANES), histories)
                for first in range(0, len(chosen), LANES)
            ]
            # Of trials that a recording leads to, each part follows it from its beginning.
            led = arrays.lanes.n_states > 0 and any(trials[index].led is not None for index in own_trials)
            parts_a_thread = 1 if led else BATCHES_A_THREAD
            size = max(math.ceil(len(own_trials) * len(blocks) / (parts_a_thread * count)), 1)
            for together in _shared(trials, own_trials):
                for first in range(0, len(together), size):
                    indices = together[first : first + size]
                    own, at = [trials[i] for i in indices], None if starts is None else [starts[i] for i in indices]
                    part = _Part.of(own, _begun(arrays, chosen, own, at), dt, [results[i] for i in indices])
                    tasks += [(block, part) for block in blocks]

    def work(task: tuple[_Block, _Part]) -> None:
        task[0].run(task[1], dt)

    count = min(count, len(tasks))
    if count <= 1:
        for task in tasks:
            work(task)
    else:
        if not tasks[0][0].lanes.kernel.run_trials.signatures:  # what has to be compiled is compiled once
            work(tasks.pop(0))
        list(computer.threads(count).map(work, tasks))
    poses = [trial.position for trial in trials]
    robot = changed_bodies(models[0].effects, models[0].robot)
    # A divergence is visible by itself.
    if check and robot.traits.held_in_place and all(found.sound[0] for found in results):
        reached = [found.position[0] for found in results]
        warn_if_coarse(elastic_of(robot), models[0].phase, poses, dt, reached, MOST_DIVISOR)
    return results


def _shared(trials: Sequence[Trial], chosen: Sequence[int]) -> list[list[int]]:
    """Trials, as indices, that share one history of commands: such as shooting intervals of one recording."""
    groups: dict[Hashable, list[int]] = {}
    for index in chosen:
        groups.setdefault(trials[index].history, []).append(index)
    return list(groups.values())


def _begun(
    coded: Encoded, chosen: Sequence[int], trials: Sequence[Trial], starts: Sequence[Array] | None
) -> tuple[Array, Array, Array]:
    """(trials, k, nv) positions and velocities with which some models begin, and (trials, k, nm) what else is unknown.

    See ``Trial.begun`` and ``hidden.with_unknown``.

    Args:
        coded: the models.
        chosen: which rows of starts are theirs.
        trials: what is done.
        starts: for each trial (·, nj), (·, 2 nj), (·, 2 nj + 2 nl) or (·, 2 nj + 2 nl + nm); the trial's own by
            default.
    """
    robot, k = coded.models[0].robot, len(chosen)
    nj, rows = len(robot.joint_names), _run_of(np.array(chosen))
    beside = len(robot.prescribed_names) + len(robot.unmeasured_names)
    if starts is not None and not beside and all(own.shape == (len(own), 2 * nj) for own in starts):
        whole = np.stack([own[rows] for own in starts])
        return whole[:, :, :nj], whole[:, :, nj:], whole[:, :, 2 * nj :]
    q0, v0 = np.empty((2, len(trials), k, nj + beside))
    known = 2 * (nj + robot.loose_count)
    widest = 0 if starts is None else max(own.shape[-1] - known for own in starts)
    unknown = np.zeros((len(trials), k, max(widest, 0)))
    for t, trial in enumerate(trials):
        row = trial.position if starts is None else starts[t][rows]
        q, speed = np.broadcast_to(row[..., :nj], (k, nj)), row[..., nj : 2 * nj]
        if not speed.size:
            speed = np.zeros(nj) if trial.velocity is None else trial.velocity
        q0[t], v0[t] = trial.begun(robot, q, np.broadcast_to(speed, (k, nj)), row[..., 2 * nj : known])
        unknown[t, :, : row[..., known:].shape[-1]] = row[..., known:]
    return q0, v0, unknown


@dataclass(frozen=True, eq=False)
class _Part:
    """Trials of one history of commands, with what of them is the same for all models.

    Attributes:
        trials: what is done.
        position: (trials, k, nv) with which k models begin [rad or m].
        velocity: the same [rad/s or m/s].
        unknown: (trials, k, nm) what else they begin with, see ``hidden.with_unknown``.
        start: (trials,) [s].
        steps: (trials,) physics steps.
        times: (m,) sample times of all trials [s].
        place: (trials + 1,) where in these each begins, and its end.
        results: for each trial, written.
    """

    trials: Sequence[Trial]
    position: Array
    velocity: Array
    unknown: Array
    start: Array
    steps: NDArray[np.int64]
    times: Array
    place: NDArray[np.int64]
    results: Sequence[Predicted]

    @classmethod
    def of(
        cls, trials: Sequence[Trial], begun: tuple[Array, Array, Array], dt: float, results: Sequence[Predicted]
    ) -> _Part:
        """Trials in which models begin so, in steps of dt [s]."""
        times = [trial.sample_times for trial in trials]
        spans = [own[-1] - trial.start if len(own) else 0.0 for own, trial in zip(times, trials, strict=True)]
        return cls(
            trials,
            *begun,
            np.array([trial.start for trial in trials], dtype=np.float64),
            np.maximum(np.ceil(np.array(spans) / dt - 1e-9), 1).astype(np.int64),
            np.concatenate(times),
            np.concatenate([[0], np.cumsum([len(own) for own in times])]),
            results,
        )


class _Histories:
    """What reaches the valves in trials, each worked out once for all models and shooting intervals that share it."""

    def __init__(self) -> None:
        self._known: dict[tuple[Hashable, ...], Array] = {}

    def of(self, model: Model, counting: Array, trial: Trial) -> Array:
        """(1 + n, na) what reaches a model's valves: before the first row, then row by row, between (2, na)."""
        key = (*trial.history, *shaping_of(model, counting))
        if key not in self._known:
            self._known[key] = np.clip(shaped_for(model, trial), *counting)
        return self._known[key]


def shaping_of(model: Model, counting: Array) -> tuple[Hashable, ...]:
    """All of a model that decides what reaches its valves between (2, na)."""
    return tuple(effect for effect in model.effects if isinstance(effect, ShapingEffect)), counting.tobytes()


class _Block:
    """Up to LANES models of one structure, with what of them is the same in all trials.

    Args:
        coded: they and others of their structure.
        models: which of all models they are.
        rows: which of ``coded``.
        histories: of what reaches valves.
    """

    def __init__(self, coded: Encoded, models: NDArray[np.int64], rows: slice, histories: _Histories) -> None:
        self.coded, self.rows, self.lanes = coded, rows, coded.lanes
        self.models, self.model_places = _run_of(models), models
        self.histories = histories
        own = coded.mechanics[0]
        self.joints, self.moved, self.still = own.joints, own.starts, _run_of(own.joints)
        self.parameters, self.valve, self.follow = (
            np.ascontiguousarray(part[rows]) for part in (coded.parameters, coded.valve, coded.follow)
        )
        self.sensor = coded.sensors_of_coordinates(rows)
        self.at_rest = coded.models[0].robot.traits.starts_at_rest
        pairs = list(zip(coded.models[rows], coded.between[rows], strict=True))
        kinds = {shaping_of(*pair): pair for pair in pairs}
        self.shaped, order = list(kinds.values()), list(kinds)
        self.kinds = [order.index(shaping_of(*pair)) for pair in pairs] if len(order) > 1 else [0] * len(pairs)
        self._commands: dict[tuple[Hashable, ...], tuple[Array, Array]] = {}

    def commands(self, trial: Trial) -> tuple[Array, Array]:
        """(k, n, na) what reaches the valves, and (k, na) before the first row."""
        key = trial.history
        if key not in self._commands:
            whole = np.array([self.histories.of(model, counting, trial) for model, counting in self.shaped])[self.kinds]
            self._commands[key] = np.ascontiguousarray(whole[:, 1:]), np.ascontiguousarray(whole[:, 0])
        return self._commands[key]

    def run(self, part: _Part, dt: float) -> None:
        """Simulate trials of one history of commands, by physics steps of dt [s]."""
        trials, results, place, start, steps = part.trials, part.results, part.place, part.start, part.steps
        k, nj, robot = len(self.kinds), results[0].position.shape[2], self.coded.models[0].robot
        q0, v0 = part.position[:, self.rows], part.velocity[:, self.rows]
        commands, before = self.commands(trials[0])
        given = Commands(commands, before, self.valve, self.follow)
        first = np.zeros((len(trials), *self.follow.shape[:2]))
        if self.follow[:, :, FOLLOW_KIND].any():
            first[:] = [first_activations(self.coded, self.rows, own, q) for own, q in zip(trials, q0, strict=True)]
        led = lead(self.coded, self.rows, trials, given, self.sensor, first, dt)
        position = np.empty((k, place[-1], len(self.moved)))
        reached = np.zeros((len(trials), k), np.int64)
        forces = any(trial.forces for trial in trials)
        inner = forces or any(trial.inner for trial in trials)
        numbers = self.lanes.n_state if forces else 2 * len(self.moved)
        motion = np.empty((k, place[-1] if inner else 0, numbers))
        q, v, linear = q0[:, :, self.moved].copy(), v0[:, :, self.moved].copy(), trials[0].lines(robot)
        hidden = led_states(
            self.lanes, self.parameters, trials[0].times, given, self.sensor, led, (start, q, v), dt, linear
        )
        hidden = with_unknown(self.coded, self.rows, hidden, part.unknown[:, self.rows])
        self.lanes.kernel.run_trials(
            self.lanes.robot,
            self.parameters,
            trials[0].times,
            commands,
            before,
            self.valve,
            self.follow,
            first,
            self.sensor,
            q,
            v,
            self.coded.rubbing,
            np.array([STOOD if self.at_rest else WENT_ON if own.led is None else SPED_UP for own in trials]),
            self._shown(trials),
            start,
            dt,
            steps,
            part.times,
            place,
            position,
            reached,
            linear,
            motion,
            hidden,
        )
        position = position[:, :, self.still]
        for t, result in enumerate(results):
            result.position[self.models] = position[:, place[t] : place[t + 1]]
            result.reached[self.models] = reached[t]
            if result.motion is not None:
                own = motion[:, place[t] : place[t + 1]]
                result.motion[self.models, :, :nj] = own[:, :, self.still]
                result.motion[self.models, :, nj:] = own[:, :, len(self.moved) : 2 * len(self.moved)][:, :, self.still]
        if forces:
            self._write_forces(trials, dt, first, motion, place, results)

    def _shown(self, trials: Sequence[Trial]) -> Array:
        """(trials, nv) what sensors showed at the starts, of those with play inside recordings; nan of all others."""
        found = np.full((len(trials), len(self.moved)), np.nan)
        if np.any(self.sensor[:, :, PLAY] > 0.0):
            for row, trial in zip(found, trials, strict=True):
                if trial.going is not None:
                    row[:] = trial.going[0][self.moved]
        return found

    def _write_forces(
        self,
        trials: Sequence[Trial],
        dt: float,
        first: Array,
        motion: Array,
        place: NDArray[np.int64],
        results: Sequence[Predicted],
    ) -> None:
        """The drives' forces along motions (k, m, 2 nv + nz), see ``run``."""
        robot, (commands, before) = self.coded.models[0].robot, self.commands(trials[0])
        arriving = np.empty((place[-1], commands.shape[2]))
        models = np.arange(len(self.coded.models))[self.rows]
        for lane, index in enumerate(models):
            valve, follow = self.valve[lane], self.follow[lane]
            for t, own in enumerate(trials):
                arrived(
                    own.times, commands[lane], before[lane], valve, follow, first[t, lane], own.start, dt,
                    own.sample_times, arriving[place[t] : place[t + 1]], own.lines(robot),
                )  # fmt: skip
            found = drive_forces(self.coded, int(index), motion[lane], arriving)
            for t, result in enumerate(results):
                if result.forces is not None:
                    result.forces[self.model_places[lane]] = found[place[t] : place[t + 1]]


def _run_of(indices: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """The same as a slice, where they follow each other: arrays are read and written faster by it."""
    first = int(indices[0])
    follow = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if follow else indices


def compile_kernel(model: Model) -> None:
    """Compile what ``simulate`` needs for a model's structure and force laws, or find it in the cache of kernels."""
    nj, na = len(model.robot.joint_names), len(model.robot.actuator_names)
    rest = np.zeros((1, na))
    moved = PrescribedMotion.at_rest(model.robot.prescribed_names)
    beside = PrescribedMotion.at_rest(model.robot.unmeasured_names)
    pose, times = np.full(nj, 0.5), np.array([0.0, 1e-3])
    trial = Trial("first", np.zeros(1), rest, rest[0], 0.0, pose, times, prescribed=moved, supposed=beside)
    simulate([model], [trial], dt=1e-3, threads=1, check=False)


def shaped_for(model: Model, trial: Trial) -> Array:
    """(1 + n, na) what reaches the valves, before the first row, then row by row [Pa or unit of the commands]."""
    given, robot = np.vstack([trial.before, trial.commands]), model.robot
    shaped = shaped_commands(model.effects, robot.actuator_names, given, robot.command_ranges)
    return trial.with_accelerations(robot, shaped)
