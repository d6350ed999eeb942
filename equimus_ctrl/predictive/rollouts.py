"""Where many plans lead a robot that begins in one state: in MuJoCo, or by the exact equations in machine code.

Both carry the pressures behind the valves, take torques that the model does not explain as lasting, and leave the
joints' stops out: ranges are the cost's, as in ``predictive.problem``. The exact equations simulate all effects of any
robot, MuJoCo those of elastic actuators that exert no force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import casadi as ca
import numpy as np

from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.command import pressure_rollouts
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.mujoco_batch import MujocoBatch
from equimus_ctrl.engines.native import native
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.linear import fastest_rates
from equimus_ctrl.models.mjcf import SolverSettings
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import FOLLOWED, parts_in, prediction
from equimus_ctrl.models.spread import groups, latin_hypercube, perturbed
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array

MUJOCO_SETTINGS = SolverSettings(timestep=1 / 120, integrator="implicitfast", softness=0.01)
"""Over a third of a second within 1 mrad at the leg's hip and 6 mrad at its knee; a quarter of the time of RK4."""


class Rollouts(Protocol):
    """Many plans at once."""

    def __call__(self, start: Array, disturbance: Array, inputs: Array) -> Array:
        """Where plans lead.

        Args:
            start: (nx,) of ``models.prediction``.
            disturbance: (nj,) torques that the model does not explain [N·m].
            inputs: (n, steps, na) what reaches the valves [Pa].

        Returns:
            (members, n, steps + 1, k) angles [rad], velocities [rad/s] and pressures [Pa], by the exact equations also
            the effects' own states; NaN from where a run diverges.
        """


def members_of(model: Model, count: int, spread: float, seed: int) -> tuple[Model, ...]:
    """A model and others like it, where anything of it can vary.

    Args:
        model: the first.
        count: how many, the first included.
        spread: by which share what varies of the robot is perturbed at most, by a Latin hypercube.
        seed: of the draws.
    """
    robot = changed_bodies(model.effects, model.robot)
    rest = tuple(effect for effect in model.effects if not isinstance(effect, BodyEffect))
    spreads = groups(robot, dict.fromkeys(("stiffness", "area", "damping", "mass"), spread))
    if count < 2 or not spreads:
        return (model,)
    rows = latin_hypercube(count - 1, len(spreads), np.random.default_rng(seed))
    return (model, *(Model(perturbed(robot, spreads, row), rest, model.phase) for row in rows))


def make_rollouts(
    models: Sequence[Model], samples: int, steps: int, step: float, engine: str = "auto", compiled: bool = True
) -> Rollouts:
    """Rollouts of models that differ in parameters alone.

    Args:
        models: the members of an ensemble, or one.
        samples: how many plans at once.
        steps: of each.
        step: [s].
        engine: ``"mujoco"``; ``"exact"``; or ``"auto"``, MuJoCo where it simulates all that the model has.
        compiled: whether a C compiler is used where there is one.

    Raises:
        ConfigError: for an effect that the engine does not simulate here.
        ModelError: where MuJoCo cannot simulate the robot.
    """
    with_forces = [effect for effect in models[0].effects if isinstance(effect, ForceEffect)]
    if engine == "mujoco" and with_forces:
        raise ConfigError(
            f"engine is 'mujoco', which does not simulate {with_forces[0].name} in many rollouts at once; expected "
            "'auto' or 'exact'"
        )
    if engine == "exact" or with_forces or "lengths" not in models[0].robot.offers:
        return ExactRollouts(models, samples, steps, step, compiled)
    return MujocoRollouts(models, samples, steps, step)


def _fastest(robot: Morphology, model: Model) -> float:
    middle = np.clip(np.array(robot.joint_range), -np.pi, np.pi).mean(axis=0)
    return float(fastest_rates(robot, middle, model.phase)[0])


class MujocoRollouts:
    """In MuJoCo on all processors, the 3-2-1 elements as in the simulated plant, pressures held over each step."""

    def __init__(self, models: Sequence[Model], samples: int, steps: int, step: float) -> None:
        model = models[0]
        robots = [changed_bodies(one.effects, one.morphology).without_stops() for one in models]
        self._members, self._nj = len(models), len(robots[0].joints)
        rate = max(_fastest(robot, model) for robot in robots)
        parts = max(math.ceil(step / MUJOCO_SETTINGS.timestep - 1e-9), math.ceil(rate * step / FOLLOWED))
        settings = replace(MUJOCO_SETTINGS, timestep=step / parts)
        if len(robots) == 1:
            self._batch = MujocoBatch(robots[0], model.phase, settings)
        else:
            self._batch = MujocoBatch.of(robots * samples, model.phase, settings)
        self._valve, self._parts = valve_settings(model.effects, robots[0].actuator_names), parts
        na = len(robots[0].actuators)
        self._means = np.empty((samples, steps * parts, na))
        self._ends = np.empty((samples, steps + 1, na))
        self._step = step

    def __call__(self, start: Array, disturbance: Array, inputs: Array) -> Array:
        nj, members, samples = self._nj, self._members, len(inputs)
        first = start[2 * nj : 2 * nj + inputs.shape[2]].copy()
        pressure_rollouts(first, inputs, self._valve, self._step / self._parts, self._means, self._ends)
        n = samples * members
        q, v = self._batch.run(
            np.tile(start[:nj], (n, 1)), np.tile(start[nj : 2 * nj], (n, 1)), np.repeat(self._means, members, axis=0),
            np.tile(disturbance, (n, 1)),
        )  # fmt: skip
        moved = np.concatenate([q, v], axis=2)[:, :: self._parts].reshape(samples, members, -1, 2 * nj)
        ends = np.broadcast_to(self._ends[:, None], (*moved.shape[:3], inputs.shape[2]))
        return np.concatenate([moved, ends], axis=3).transpose(1, 0, 2, 3)


class ExactRollouts:
    """By the step of ``models.prediction``, all plans of a member in one call."""

    def __init__(self, models: Sequence[Model], samples: int, steps: int, step: float, compiled: bool = True) -> None:
        predictions = [prediction(model, stops=False) for model in models]
        self._parts = max(parts_in(model, step) for model in models)
        self._nx, self._steps = predictions[0].nx, steps
        self._calls: list[Buffered] = []
        for one in predictions:
            fast = native(one.step, "step") if compiled else None
            call = Buffered(_many(fast or one.step, samples))
            call.arguments[3][:] = step / self._parts
            self._calls.append(call)

    def __call__(self, start: Array, disturbance: Array, inputs: Array) -> Array:
        samples = len(inputs)
        found = np.empty((len(self._calls), samples, self._steps + 1, self._nx))
        found[:, :, 0] = start
        for call, states in zip(self._calls, found, strict=True):
            x, u, d, _ = call.arguments
            after, before = call.results[0].T, x.reshape(samples, self._nx)
            before[:], d.reshape(samples, -1)[:] = start, disturbance
            for k in range(self._steps):
                u.reshape(samples, -1)[:] = inputs[:, k]
                for _ in range(self._parts):
                    call()
                    before[:] = after
                states[:, k + 1] = after
        return found


def _many(step: ca.Function, samples: int) -> ca.Function:
    return step.map(samples) if samples > 1 else step
