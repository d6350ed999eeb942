"""Open-loop prediction: what a model says a recorded command history should have done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar, get_args

import numpy as np

from equimus_ctrl.effects.bodies import PayloadMass, changed_bodies
from equimus_ctrl.effects.sensors import PLAY, SCALE, SENSOR_DELAY, ahead, behind, sensor_settings
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.batch import STEP
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.engines.trials import Trial, robot_with
from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array, Recording

R = TypeVar("R", bound=Robot)
MUJOCO_STEP = 1 / 480
"""Default physics step of a single prediction in MuJoCo [s]."""

SLOPE_SPAN, SLOPE_SAMPLES = 0.1, 6
"""Half the time over which a start's velocities are read off by a parabola [s]; of less smooth motions in samples."""
SET, TIMES, PAYLOAD = "set.", "times.", "payload."
"""What notes begin with that give a number of the model for one recording, by itself or as a factor on it, or a mass
[kg] at a place of the robot."""
ZERO, FREE = "zero.", "free"
"""Note that a joint's sensor has another, unknown zero in one recording: ``zero.elbow = free``."""
SETTLED_SPAN = 0.1
"""How long at most the first measurements are averaged for the start of a trial [s]."""


def local_motion(recording: Recording, at: float, span: float) -> tuple[Array, Array]:
    """Positions and velocities at an instant t: x₀ and x₁ of the parabola x₀ + x₁ (s − t) + x₂ (s − t)² that fits best.

    It is fitted to the measurements at the instants s with |s − t| ≤ span, or to the five nearest where these are fewer
    than four.

    Args:
        recording: what was measured.
        at: the instant t [s].
        span: half the time that counts [s].
    """
    time = recording.time
    near = np.abs(time - at) <= span
    if np.count_nonzero(near) < 4:
        near[np.argsort(np.abs(time - at))[:5]] = True
    basis = np.vander(time[near] - at, 3, increasing=True)
    coefficients = np.linalg.lstsq(basis, recording.position[near], rcond=None)[0]
    return coefficients[0], coefficients[1]


def slope_span(model: Model, recording: Recording) -> float:
    """Half the time over which positions and velocities at an instant are read off a recording [s].

    A robot that a motor drives changes its speed within a tenth of a second.
    """
    if model.robot.traits.smooth_motion:
        return SLOPE_SPAN
    return SLOPE_SAMPLES * float(np.median(np.diff(recording.time)))


def noted(robot: Robot, where: str, notes: Mapping[str, str], prefix: str) -> dict[str, float]:
    """What notes say of a robot's parameters: ``set.servo.kp = 3.2``, or ``times.servo.kp = 2``.

    Or of what it carries: ``payload.tip = 0.2``.

    Args:
        robot: whose they are.
        where: they stand, for messages.
        notes: of a recording.
        prefix: of those that count.

    Raises:
        ConfigError: where there is no such number or place, or the value is none.
    """
    found: dict[str, float] = {}
    for key, text in notes.items():
        if not key.startswith(prefix):
            continue
        name = key.removeprefix(prefix)
        if prefix != PAYLOAD and not robot.has_parameters([name]):
            raise ConfigError(unknown_name("parameter", name, robot.parameters(), f"{where}: note {key}"))
        try:
            found[name] = float(text)
            if prefix == PAYLOAD:
                robot.check((PayloadMass(name, found[name]),))
                continue
            factor = 1.0 if prefix == SET else robot.parameters()[name]
            robot.with_parameters({name: found[name] * factor})
        except ValueError:
            what = {SET: "a number", TIMES: "a factor", PAYLOAD: "a mass in kg"}[prefix]
            raise ConfigError(f"{where}: note {key} is {text!r}, expected {what}") from None
        except (ConfigError, ModelError) as error:
            raise ConfigError(f"{where}: note {key}: {error}") from None
    return found


def in_its_condition(model: Model, recording: Recording, trial: Trial) -> Trial:
    """A trial with what the notes of its recording say is known to be different in it, see ``noted``."""
    settings, factors, payloads = _different(model.robot, recording.name, recording.notes)
    return replace(trial, settings=settings, factors=factors, payloads=payloads)


def robot_as_noted(robot: R, where: str, notes: Mapping[str, str]) -> R:
    """A robot with what notes say is known to be different, see ``noted``."""
    return robot_with(robot, *_different(robot, where, notes))


def _different(robot: Robot, where: str, notes: Mapping[str, str]) -> tuple[dict[str, float], ...]:
    return tuple(noted(robot, where, notes, prefix) for prefix in (SET, TIMES, PAYLOAD))


def free_zeros(model: Model, recording: Recording) -> tuple[int, ...]:
    """The joints, as indices, whose sensors have an unknown zero of their own in a recording: ``zero.elbow = free``.

    Raises:
        ConfigError: where there is no such joint, the note says something else, or trials of the robot start at rest.
    """
    joints, found = model.robot.joint_names, []
    for key, text in recording.notes.items():
        if not key.startswith(ZERO):
            continue
        name = key.removeprefix(ZERO)
        if model.robot.traits.starts_at_rest:
            raise ConfigError(f"{recording.name}: note {key!r} is for MJCF robots alone")
        if name not in joints:
            raise ConfigError(unknown_name("joint", name, joints, f"{recording.name}: note {key}"))
        if text != FREE:
            raise ConfigError(f"{recording.name}: note {key} is {text!r}, expected {FREE}")
        found.append(joints.index(name))
    return tuple(sorted(found))


def check_notes(robot: Robot, recording: Recording) -> None:
    """Raise ConfigError where a recording's notes say something of a robot that it does not have."""
    _different(robot, recording.name, recording.notes)
    free_zeros(Model(robot), recording)


def measured_start(recording: Recording) -> Array:
    """(nj,) the positions a trial starts from [rad or m]: the mean of its first 0.1 s under the command before it.

    A recording starts at rest (see the recording format), so these samples differ by noise alone. Where the command
    changes in the very first row, or a note says ``settled = no``, the first measurement stands alone.
    """
    if recording.notes.get("settled") == "no":
        return np.array(recording.position[0])
    time = recording.time
    unchanged = np.all(recording.command == recording.command_before, axis=1)
    changed = int(np.argmin(unchanged)) if not unchanged.all() else len(time)
    span = int(np.searchsorted(time, time[0] + SETTLED_SPAN, side="right"))
    return np.asarray(recording.position[: max(min(changed, span), 1)].mean(axis=0), dtype=np.float64)


def modelled_start(model: Model, recording: Recording) -> Array:
    """(nj,) the joint positions that the model's sensors show as the measured start [rad or m]."""
    return np.asarray(behind_sensors([model], measured_start(recording)[None, :])[0])


def behind_sensors(models: Sequence[Model], shown: Array, trial: Trial | None = None) -> Array:
    """(k, nj) positions, or (k, 2 nj) positions and velocities, of which each model's sensors show these values.

    Args:
        models: k of one robot.
        shown: what their sensors show, one row a model.
        trial: that begins there: inside a recording joints move as it shows.
    """
    return behind_all(models, [shown], [trial])[0]


def behind_all(models: Sequence[Model], shown: Sequence[Array], trials: Sequence[Trial | None]) -> list[Array]:
    """The same for several arrays of one row a model each."""
    names, traits = models[0].robot.joint_names, models[0].robot.traits
    nj = len(names)
    settings = {m.effects: sensor_settings(m.effects, names) for m in {m.effects: m for m in models}.values()}
    sensor = np.array([settings[m.effects] for m in models])
    found, play = [np.empty(0)] * len(shown), bool(np.any(sensor[:, :, PLAY] > 0.0))
    shapes: dict[tuple[int, ...], list[int]] = {}
    for place, rows in enumerate(shown):
        shapes.setdefault(rows.shape, []).append(place)
    for (_, n), places in shapes.items():
        true = np.stack([shown[place] for place in places])  # (t, k, n)
        true[..., :nj] = behind(sensor, true[..., :nj])
        for own, place in zip(true, places if play else (), strict=False):
            trial = trials[place]
            if trial is not None and (going := trial.going) is not None:
                own[:, :nj] += ahead(sensor, np.sign(going[1][:nj] / sensor[:, :, SCALE]))
        true[..., nj:] /= sensor[:, : n - nj, SCALE]
        if n > nj and not traits.starts_at_rest:
            for own, place in zip(true, places, strict=True):
                own += _since(sensor, own, trials[place])
        for place, own in zip(places, true, strict=True):
            found[place] = own
    return found


def _since(sensor: Array, true: Array, trial: Trial | None) -> Array:
    """(k, 2 nj) by how much joints have moved on, and are faster, since what sensors with delays show at a start.

    Inside a recording what was recorded later tells. Where nobody knows that they go on as they did.

    Args:
        sensor: (k, nj, 4), see ``effects.sensors.OFFSET``.
        true: (k, 2 nj) positions and rates that are shown.
        trial: that starts there; None where nobody knows it.
    """
    nj = sensor.shape[1]
    late = sensor[:, :, SENSOR_DELAY]
    moved = np.concatenate([true[:, nj:] * late, np.zeros_like(late)], axis=1)
    if trial is None or trial.recorded is None or not late.any():
        return moved
    motion, last = trial.recorded.motion, trial.recorded.time[-1]
    q, v, _ = motion.at(trial.start)
    for k, j in zip(*np.nonzero(late), strict=True):
        if trial.start + late[k, j] <= last:
            later = motion.at(trial.start + late[k, j])
            scale = sensor[k, j, SCALE]
            moved[k, j], moved[k, nj + j] = (later[0][j] - q[j]) / scale, (later[1][j] - v[j]) / scale
    return moved


def check_columns(model: Model, recording: Recording) -> None:
    """Raise ConfigError unless the recording's joints and actuators are the model's, in its order."""
    m = model.robot
    if (recording.joints, recording.actuators) != (m.joint_names, m.actuator_names):
        raise ConfigError(
            f"{recording.name}: has joints {', '.join(recording.joints)} and actuators "
            f"{', '.join(recording.actuators)}, but the model {m.name} has {', '.join(m.joint_names)} and "
            f"{', '.join(m.actuator_names)}"
        )


def predict(
    model: Model,
    recording: Recording,
    *,
    engine: EngineName | None = None,
    start: Array | None = None,
    dt: float | None = None,
) -> Array:
    """(n, nj) joint positions at the recording's times under its commands [rad or m], from rest at ``start``.

    Args:
        model: what is simulated.
        recording: whose commands and times.
        engine: ``"reduced"`` (compiled equations of motion) or ``"mujoco"``; by default what suits the robot, see
            ``engines.choice.engine_for``.
        start: (nj,) first positions [rad or m]; by default those that the model's sensors show as the measured start.
            Of a robot that need not start at rest also (2 nj,) positions and velocities, by default those measured.
        dt: physics step [s]; by default 1 ms (reduced) or 1/480 s (MuJoCo), divided for quick robots.

    Raises:
        ConfigError: where names do not match or the engine is unknown.
        SimulationDiverged: where the simulation does.
    """
    check_columns(model, recording)
    if engine is not None and engine not in get_args(EngineName):
        raise ConfigError(unknown_name("engine", engine, get_args(EngineName)))
    if not model.robot.traits.starts_at_rest:
        return _predict_moving(model, recording, start, engine, dt)
    q0 = modelled_start(model, recording) if start is None else np.asarray(start, dtype=np.float64)
    if q0.shape != (len(recording.joints),) or not np.all(np.isfinite(q0)):
        raise ConfigError(
            f"{recording.name}: the start is {q0.tolist()}, expected one finite angle in rad for each of "
            f"{', '.join(recording.joints)}"
        )
    if dt is not None and not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    trial = in_its_condition(model, recording, Trial.of(recording, q0))
    step = dt
    if step is None:
        usual = MUJOCO_STEP if engine == "mujoco" else STEP
        step = usual / step_divisor(changed_bodies(model.effects, model.morphology), model.phase, [q0], usual)
    return _followed(model, recording, trial, np.concatenate([q0, np.zeros(len(q0))]), engine, step)


def _predict_moving(
    model: Model, recording: Recording, start: Array | None, engine: EngineName | None, dt: float | None
) -> Array:
    nj = len(recording.joints)
    if start is None:
        shown = np.concatenate(local_motion(recording, float(recording.time[0]), slope_span(model, recording)))
        start = behind_sensors([model], shown[None, :])[0]
    given = np.asarray(start, dtype=np.float64)
    if given.shape not in ((nj,), (2 * nj,)) or not np.all(np.isfinite(given)):
        raise ConfigError(
            f"{recording.name}: the start is {given.tolist()}, expected one finite coordinate for each of "
            f"{', '.join(recording.joints)}, or these and their rates"
        )
    begin = np.zeros(2 * nj)
    begin[: len(given)] = given
    trial = in_its_condition(model, recording, Trial.of(recording, begin[:nj]))
    return _followed(model, recording, trial, begin, engine, dt)


def _followed(
    model: Model, recording: Recording, trial: Trial, start: Array, engine: EngineName | None, dt: float | None
) -> Array:
    found = engine_for(model, engine, dt, [recording.poses]).simulate([model], [trial], [start[None, :]], threads=1)[0]
    reached = int(found.reached[0])
    if reached < len(recording.time):
        raise SimulationDiverged(
            f"{recording.name}: the simulation of {model.name} diverged at {recording.time[reached]:.3f} s"
        )
    return np.asarray(found.position[0])
