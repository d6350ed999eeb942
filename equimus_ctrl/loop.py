"""The one closed loop: a plant driven by a controller along a reference."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import get_args

import numpy as np

from equimus_ctrl.errors import FAILURES, ConfigError, ControllerError, EquimusError, SimulationDiverged, unknown_name
from equimus_ctrl.robots.reading import command_words, position_word
from equimus_ctrl.types import Array, Controller, KnowsTruth, Plant, PlantSpec, Reference, Run, Sense, Start

MOST_INSTANTS = 20_000_000
"""Control instants of a run, all of which are kept: 46 hours at 120 Hz."""


def run(
    plant: Plant,
    controller: Controller,
    reference: Reference,
    duration: float,
    *,
    start: Start | None = None,
    seed: int | None = 0,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Drive ``plant`` with ``controller`` along ``reference`` for ``duration`` seconds.

    Args:
        plant: reset first.
        controller: asked at every control instant from 0 to the last one before ``duration``.
        reference: handed to the controller and recorded.
        duration: [s].
        start: where the plant begins.
        seed: of the plant's noise.
        progress: called with the share done.

    Raises:
        ConfigError: for a duration shorter than one control period, or a reference that does not fit the robot.
        ControllerError: where the controller needs what the plant does not measure or fails, or its command has the
            wrong size, is not finite or not a pair with a state.
        SimulationDiverged: where the plant's simulation did; it has the run until then.
    """
    spec = plant.spec
    check_senses(controller, spec)
    n = round(duration / spec.control_dt) if math.isfinite(duration) else 0
    if n < 1:
        raise ConfigError(f"duration is {duration:g} s, expected at least one control period of {spec.control_dt:g} s")
    if n > MOST_INSTANTS:
        raise ConfigError(
            f"duration is {duration:g} s, {n:.3g} control periods of {spec.control_dt:g} s; expected at most "
            f"{MOST_INSTANTS:,} of them"
        )
    nj, na = len(spec.joints), len(spec.actuators)
    times, solve_time = np.empty(n), np.empty(n)
    position, wanted = np.empty((n, nj)), np.empty((n, nj))
    command, asked, clipped = np.empty((n, na)), np.empty((n, na)), np.zeros((n, na), dtype=bool)
    knowing = plant if isinstance(plant, KnowsTruth) else None
    truth = np.empty((n, nj)) if knowing is not None else None
    status: list[str] = []
    observation = plant.reset(start, seed)
    before = np.array(observation.command)
    with _blamed(controller, "init", 0.0):
        state = controller.init(spec, observation)
    note = str(getattr(state, "note", ""))

    def whole(count: int) -> Run:
        true = None if truth is None else truth[:count]
        kept = {"time": times, "position": position, "reference": wanted, "command": command, "asked": asked}
        made = Run(
            spec, clipped=clipped[:count], solve_time=solve_time[:count], before=before, truth=true,
            status=tuple(status), note=note, **{key: part[:count] for key, part in kept.items()},
        )  # fmt: skip
        for array in (*kept, "clipped", "solve_time", "before"):
            getattr(made, array).flags.writeable = False
        if true is not None:
            true.flags.writeable = False
        return made

    for k in range(n):
        wanted[k] = wanted_pose(reference, spec, observation.time)
        begun = clock.perf_counter()
        with _blamed(controller, "step", observation.time):
            result = controller.step(observation, reference, state)
        solve_time[k] = clock.perf_counter() - begun
        if not (isinstance(result, tuple) and len(result) == 2):
            raise ControllerError(f"{_name(controller)}.step returned {result!r}, expected (command, state)")
        state = result[1]
        note = str(getattr(state, "note", ""))
        asked[k] = checked_command(result[0], spec, observation.time, _name(controller))
        times[k], position[k] = observation.time, observation.position
        status.append(str(getattr(state, "status", "")))
        if truth is not None and knowing is not None:
            truth[k] = knowing.truth
        command[k] = np.clip(asked[k], spec.command_low, spec.command_high)
        try:
            observation = plant.step(asked[k])
        except SimulationDiverged as error:
            clipped[k] = command[k] != asked[k]
            error.run = whole(k + 1)
            raise
        clipped[k] = observation.clipped
        if progress is not None:
            progress((k + 1) / n)
    return whole(n)


def check_senses(controller: Controller, spec: PlantSpec) -> None:
    """Raise ControllerError where a controller needs what a plant does not measure.

    Args:
        controller: what it needs beside positions is its ``senses``, see ``types.Sense``.
        spec: of the plant.
    """
    given = getattr(controller, "senses", ())
    known = get_args(Sense)
    for sense in (given,) if isinstance(given, str) else given:
        if sense not in known:
            raise ControllerError(unknown_name("sense", str(sense), known, _name(controller)))
        if sense not in spec.senses:
            has = ", ".join(("positions", *(own for own in known if own in spec.senses)))
            raise ControllerError(
                f"{_name(controller)} needs measured {sense}, which this plant does not give; it gives {has}"
            )


@contextmanager
def _blamed(controller: Controller, method: str, at: float) -> Iterator[None]:
    """Turn an exception from inside a controller into a sentence that says whose, where and when."""
    try:
        yield
    except EquimusError:
        raise
    except FAILURES as error:
        raise ControllerError(
            f"{_name(controller)}.{method} failed at {at:.3f} s: {type(error).__name__}: {error}"
        ) from error


def wanted_pose(reference: Reference, spec: PlantSpec, at: float) -> Array:
    """(nj,) the reference at a time.

    Raises:
        ConfigError: where it fails, or is not one finite angle for each joint.
    """
    try:
        pose = np.asarray(reference.position(at), dtype=np.float64)
    except EquimusError:
        raise
    except FAILURES as error:
        raise ConfigError(f"the reference fails at {at:.3f} s: {type(error).__name__}: {error}") from error
    if pose.shape != (len(spec.joints),) or not np.all(np.isfinite(pose)):
        wanted = f"one finite {position_word(spec.joint_units)} for each of {', '.join(spec.joints)}"
        raise ConfigError(f"the reference is {pose.tolist()} at {at:.3f} s, expected {wanted}")
    return pose


def checked_command(command: object, spec: PlantSpec, at: float, who: str) -> Array:
    """``command`` as an array (na,).

    Raises:
        ControllerError: where it is not one finite number for each actuator.
    """
    words, one = command_words(spec.command_units)
    try:
        given = np.asarray(command)
        if given.dtype.kind not in "biufO":  # complex numbers would lose a part of theirs, texts may read as numbers
            raise TypeError
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ControllerError(f"{who} returned {command!r} at {at:.3f} s, expected {words}") from None
    if array.shape != (len(spec.actuators),):
        raise ControllerError(
            f"{who} returned a command of shape {array.shape} at {at:.3f} s, expected {one} for each of "
            f"{', '.join(spec.actuators)}"
        )
    if not np.all(np.isfinite(array)):
        raise ControllerError(f"{who} returned {array} at {at:.3f} s, expected finite {words}")
    return array


def _name(controller: object) -> str:
    return getattr(controller, "name", None) or type(controller).__name__
