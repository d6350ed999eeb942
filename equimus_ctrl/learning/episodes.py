"""Episodes of n robots: what learning environments of one or many robots are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.identification.noise import Noise, drawn_noise
from equimus_ctrl.learning.observing import Memory, Scaling, bounded
from equimus_ctrl.learning.randomisation import Draws
from equimus_ctrl.learning.settings import EnvSettings
from equimus_ctrl.learning.tasks import Rows, Task
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.batch import BatchPlant
from equimus_ctrl.plants.batch_group import Unit
from equimus_ctrl.plants.mujoco_plant import rates_of
from equimus_ctrl.types import Array

ROBOT = "robot"
"""The option of a reset that says which of the robots an episode has."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a control period, one row a robot.

    Attributes:
        reward: (r,).
        terminated: (r,) whether the task is over, or the simulation lost its numbers.
        truncated: (r,) whether the time is.
    """

    reward: Array
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Episodes:
    """n robots at one task, each in an episode of its own.

    Args:
        n: how many.
        model: the nominal one.
        task: what is to be done, of these robots alone.
        draws: robots that episodes are on.
        settings: see ``EnvSettings``.
        noise: of each measured position.
        threads: to use; nothing depends on it.

    Raises:
        ConfigError: where a command has no limits, or the control rate does not fit.
    """

    def __init__(
        self,
        n: int,
        model: Model,
        task: Task,
        draws: Draws,
        settings: EnvSettings,
        noise: Noise,
        threads: int | None = None,
    ) -> None:
        if n < 1:
            raise ConfigError(f"the number of environments is {n}, expected at least 1")
        control = settings.control or rates_of(model.robot).control
        self.periods = max(round(task.duration * control), 1)
        self.plant = BatchPlant(
            n, model, self.periods, control=settings.control, scene=task.scene, integrator=settings.integrator,
            threads=threads,
        )  # fmt: skip
        self.n, self.task, self.settings, self._draws = n, task, settings, draws
        self.scaling = Scaling(self.plant.spec)
        task.prepare(self.plant, self.scaling)
        self._memory = Memory(n, self.scaling, settings.history)
        self._noise = (*noise, *(max(noise, key=lambda own: own.sigma),) * task.seen_size)
        self._times = np.arange(self.periods + 1) / control
        self._drawn = np.zeros((n, self.periods + 1, len(self._noise)))
        self._known: dict[int, Unit] = {}
        self.robots, self._count = np.full(n, -1), np.zeros(n, dtype=np.int64)
        self._diverged = np.zeros(n, dtype=bool)

    @property
    def count(self) -> int:
        """How many robots there are to be drawn."""
        return self._draws.count

    @property
    def size(self) -> int:
        """Of an observation."""
        hidden = 2 * self.scaling.half.size + self.scaling.command_low.size + self.task.hidden_size
        return self._memory.size + self.task.size + (hidden if self.settings.privileged else 0)

    @property
    def action_size(self) -> int:
        """Of an action: one number for each actuator."""
        return int(self.scaling.command_low.size)

    def unit(self, k: int) -> Unit:
        """Robot ``k`` of the draws, made when it is first needed."""
        if k not in self._known:
            self._known[k] = self.plant.prepare(self._draws.model(k))
        return self._known[k]

    def begin(self, row: int, rng: np.random.Generator, options: Mapping[str, Any] | None = None) -> None:
        """Begin an episode.

        Args:
            row: of which robot.
            rng: draws the robot, where the episode begins and the noise, in this order.
            options: ``robot``, which of the draws it is.

        Raises:
            ConfigError: for an unknown option, or a robot that there is not.
        """
        drawn = int(rng.integers(self._draws.count))
        for key in options or {}:
            if key != ROBOT:
                raise ConfigError(unknown_name("option", str(key), (ROBOT,), "reset"))
        k = (options or {}).get(ROBOT, drawn)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 0 <= k < self._draws.count:
            raise ConfigError(f"reset: robot is {k!r}, expected a whole number from 0 to {self._draws.count - 1}")
        self.robots[row] = k
        start, finish = self.task.begin(row, rng)
        command = self.plant.begin(row, self.unit(int(k)), start, finish)
        if any(own.sigma for own in self._noise):
            normal = rng.standard_normal((2, *self._drawn.shape[1:]))
            self._drawn[row] = drawn_noise(self._noise, self._times, normal)
        self._count[row], self._diverged[row] = 0, False
        rows = np.array([row])
        self._memory.begin(rows, self._measured(rows), command[None])

    def step(self, rows: Rows, actions: ArrayLike) -> Outcome:
        """One control period.

        Args:
            rows: of which robots, ascending.
            actions: (r, na) within ±1; beyond, they are the nearest.

        Raises:
            ConfigError: for actions of the wrong shape or not finite, or where an episode has to begin first.
        """
        given = np.asarray(actions, dtype=np.float64)
        wanted = (len(rows), self.action_size)
        if given.shape != wanted:
            raise ConfigError(f"actions have shape {given.shape}, expected {wanted}, one number for each actuator")
        if not np.isfinite(given).all():
            row = int(rows[np.argmin(np.isfinite(given).all(axis=1))])
            raise ConfigError(f"the action of environment {row} is {given[np.flatnonzero(rows == row)[0]]}, not finite")
        if np.any(self.robots[rows] < 0):
            raise ConfigError(f"environment {rows[np.argmin(self.robots[rows])]} is stepped before it was reset")
        command = self.scaling.command(given)
        steps = self.plant.step(rows, command)
        self._count[rows] += 1
        for step in steps:
            self._diverged[step.rows] |= ~step.moved.sound
        self._memory.add(rows, self._measured(rows), command)
        reward, over = self.task.judge(rows, self._count[rows], steps)
        lost = self._diverged[rows]
        terminated = over | lost
        return Outcome(np.where(lost, 0.0, reward), terminated, ~terminated & (self._count[rows] >= self.periods))

    def observation(self, rows: Rows) -> NDArray[np.float32]:
        """(r, size) what policies see."""
        noise = self._drawn[rows, self._count[rows], self._joints :]
        parts = [self._memory.seen(rows), self.task.observed(rows, self._count[rows], noise)]
        if self.settings.privileged:
            plant, scaling = self.plant, self.scaling
            parts += [
                scaling.position(plant.position[rows]), plant.velocity[rows] / scaling.half,
                scaling.action(plant.pressure[rows]), self.task.hidden(rows),
            ]  # fmt: skip
        return bounded(parts)

    def info(self, rows: Rows) -> dict[str, Array]:
        """(r,) each: what the task says, which ``robot`` it is, whether the simulation ``diverged``."""
        return {**self.task.info(rows), ROBOT: self.robots[rows], "diverged": self._diverged[rows]}

    @property
    def _joints(self) -> int:
        return int(self.scaling.half.size)

    def _measured(self, rows: Rows) -> Array:
        return np.asarray(self.plant.measured[rows] + self._drawn[rows, self._count[rows], : self._joints])
