"""What every controller has to keep to, as a test that users can call on their own."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.errors import FAILURES, ConfigError, ControllerError, EquimusError
from equimus_ctrl.loop import checked_command
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.scenarios.references import HoldReference, SampledReference
from equimus_ctrl.types import Array, Controller, Observation, Plant, Reference

STEPS = 60
FAR = 0.5
"""How far outside the joint ranges a reference is tried [rad]."""


@dataclass(frozen=True)
class ContractReport:
    """What was found of a controller that keeps the contract.

    Attributes:
        name: of the controller.
        kept: what it was tried for, in words.
        notes: what need not be wrong but may be worth a look, in words.
        step_time: (median, longest) of its step [s].
    """

    name: str
    kept: tuple[str, ...]
    notes: tuple[str, ...]
    step_time: tuple[float, float]


def check_controller(
    controller: Any, plant: Plant | None = None, *, steps: int = STEPS, reference: Reference | None = None
) -> ContractReport:
    """Try a controller for what plants, ``run`` and ``compare`` expect of it.

    It is made, begun and stepped in closed loop; each command must be one finite pressure for each actuator. A step
    must depend on its arguments alone: asked again with an earlier state it must command the same again, and begun anew
    it must do the same run again, bit for bit. A reference out of reach, a measurement that is late and one that is no
    number must be answered with a command or with a ``ControllerError``, which is a sentence, but not with another
    exception.

    Args:
        controller: a class that can be made without arguments, a controller, or a function, as ``run`` takes them.
        plant: what it drives; the simulated nominal leg by default.
        steps: of each try.
        reference: what it follows; by default from the pose at rest to the middle of the workspace and back.

    Returns:
        What was tried, and how long its steps took.

    Raises:
        ControllerError: in one sentence, for the first thing that is wrong.
        ConfigError: for too few steps.
    """
    if steps < 10:
        raise ConfigError(f"steps is {steps}, expected at least 10")
    name = str(getattr(controller, "name", None) or getattr(controller, "__name__", type(controller).__name__))
    made = as_controller(controller, name)
    plant = plant or MujocoPlant(nominal_model())
    wanted = reference or _there_and_back(plant, steps)
    first = _driven(made, plant, wanted, steps, name)
    kept = [f"a finite pressure for each actuator at each of {steps} steps"]
    for k in (0, steps // 2, steps - 1):
        again = _asked(made, first.observations[k], wanted, first.states[k], name)[0]
        if not np.array_equal(again, first.commands[k]):
            raise ControllerError(
                f"{name}: asked again with the state of {first.observations[k].time:.3f} s it commands {_kpa(again)} "
                f"instead of {_kpa(first.commands[k])} kPa; a step must change nothing that an earlier state holds and "
                "draw on nothing but its arguments"
            )
    kept.append("the same command from the same state")
    second = _driven(made, plant, wanted, steps, name)
    off = np.flatnonzero(np.any(first.commands != second.commands, axis=1))
    if len(off):
        raise ControllerError(
            f"{name}: begun anew it commands {_kpa(second.commands[off[0]])} instead of "
            f"{_kpa(first.commands[off[0]])} kPa at {first.observations[off[0]].time:.3f} s; what evolves belongs into "
            "the state that init returns"
        )
    kept.append("the same run, begun anew")
    notes = _odd_input(made, plant, first, steps, name)
    kept.append("a command or a sentence for a reference out of reach, for late measurements and for none")
    times = np.array(first.times[1:])
    median, longest, period = float(np.median(times)), float(times.max()), plant.spec.control_dt
    if median > period:
        notes.append(f"a step takes {median * 1e3:.3g} ms, but there is one each {period * 1e3:.3g} ms")
    share = float(np.mean((first.commands < plant.spec.command_low) | (first.commands > plant.spec.command_high)))
    if share > 0:
        notes.append(f"{100 * share:.0f} % of its commands lie outside the limits and are clipped")
    return ContractReport(name, tuple(kept), tuple(notes), (median, longest))


@dataclass(frozen=True, eq=False)
class _Drive:
    """What was seen, known before and commanded at each step, and how long that took [s]."""

    observations: list[Observation]
    states: list[Any]
    commands: Array
    times: list[float]


def _driven(controller: Controller, plant: Plant, reference: Reference, steps: int, name: str) -> _Drive:
    observation = plant.reset(None, 0)
    state = _sentence(lambda: controller.init(plant.spec, observation), f"{name}.init")
    seen, known, commands, times = [], [], [], []
    for _ in range(steps):
        begun = clock.perf_counter()
        command, following = _asked(controller, observation, reference, state, name)
        times.append(clock.perf_counter() - begun)
        seen.append(observation)
        known.append(state)
        commands.append(checked_command(command, plant.spec, observation.time, name))
        observation, state = plant.step(commands[-1]), following
    return _Drive(seen, known, np.array(commands), times)


def _asked(
    controller: Controller, observation: Observation, reference: Reference, state: Any, name: str
) -> tuple[Any, Any]:
    result = _sentence(
        lambda: controller.step(observation, reference, state), f"{name}.step at {observation.time:.3f} s"
    )
    if not (isinstance(result, tuple) and len(result) == 2):
        raise ControllerError(f"{name}.step returned {result!r}, expected (command, state)")
    return result


def _sentence(call: Callable[[], Any], what: str) -> Any:
    try:
        return call()
    except EquimusError:
        raise
    except FAILURES as error:
        raise ControllerError(f"{what} fails: {type(error).__name__}: {error}") from error


def _odd_input(controller: Controller, plant: Plant, drive: _Drive, steps: int, name: str) -> list[str]:
    """What it says to input that is out of the ordinary, where that is not a command."""
    low, high = (np.clip(side, -math.pi, math.pi) for side in (plant.spec.joint_low, plant.spec.joint_high))
    k = steps // 2
    seen, state = drive.observations[k], drive.states[k]
    tries: dict[str, tuple[Observation, Reference]] = {
        "a reference above the joint ranges": (seen, HoldReference(high + FAR)),
        "a reference below the joint ranges": (seen, HoldReference(low - FAR)),
        "a measurement that is late": (replace(seen, stamp=drive.observations[k - 1].stamp), HoldReference(low)),
        "a measurement that is no number": (
            replace(seen, position=np.full(len(low), math.nan)),
            HoldReference((low + high) / 2),
        ),
    }
    notes = []
    for what, (observation, reference) in tries.items():
        try:
            command, _ = _asked(controller, observation, reference, state, name)
            checked_command(command, plant.spec, observation.time, name)
        except ControllerError as error:
            if "fails: " in str(error):
                raise ControllerError(f"{name} with {what}: {error}") from error
            notes.append(f"{what} is an error: {error}")
    return notes


def _there_and_back(plant: Plant, steps: int) -> Reference:
    low, high = (np.clip(side, -math.pi, math.pi) for side in (plant.spec.joint_low, plant.spec.joint_high))
    start, end = np.array(plant.reset(None, 0).position), (low + high) / 2
    period = steps * plant.spec.control_dt
    return SampledReference(np.array([0.0, period / 2, period]), np.array([start, start + 0.2 * (end - start), start]))


def _kpa(command: Any) -> str:
    return "(" + ", ".join(f"{value / 1e3:.6g}" for value in np.asarray(command, dtype=np.float64).ravel()) + ")"
