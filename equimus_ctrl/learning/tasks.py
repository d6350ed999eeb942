"""What is to be learned: where episodes begin, what of the task is seen, what is rewarded, and when they end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.learning.observing import ReferenceAhead, Scaling, Sight
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.plants.batch import BatchPlant, Finish, Step
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.types import Array, Start

Rows = NDArray[np.int64]


class Task(ABC):
    """A task of n robots, each in an episode of its own.

    Attributes:
        name: what it is called.
        duration: of an episode that does not end before [s].
        scene: adds what stands around a robot.
        sight: what of it a policy sees, where a controller has that too; set by ``prepare``.
        blind: else, what a policy sees that no controller has; a phrase.
    """

    scene: Scene | None = None
    sight: Sight | None = None
    blind: str = ""
    finite: ClassVar[bool] = False
    """Whether the task is over with its time, which policies see, and not only the simulation."""
    seen_size: int = 0
    """Numbers beside positions that are measured, with noise of their own."""

    def __init__(self, name: str, duration: float) -> None:
        self.name, self.duration = name, duration

    @abstractmethod
    def prepare(self, plant: BatchPlant, scaling: Scaling) -> None:
        """Get ready for a plant's robots, before the first episode."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Of ``observed``."""

    @property
    def hidden_size(self) -> int:
        """Of ``hidden``."""
        return 0

    @abstractmethod
    def begin(self, row: int, rng: np.random.Generator) -> tuple[Start, Finish | None]:
        """Where a robot begins, and what puts the scene into its place."""

    @abstractmethod
    def observed(self, rows: Rows, periods: NDArray[np.int64], noise: Array) -> Array:
        """(r, size) what is seen after so many control periods (r,), with noise (r, ``seen_size``)."""

    def hidden(self, rows: Rows) -> Array:
        """(r, hidden_size) what no sensor shows."""
        return np.zeros((len(rows), 0))

    @abstractmethod
    def judge(self, rows: Rows, periods: NDArray[np.int64], steps: list[Step]) -> tuple[Array, NDArray[np.bool_]]:
        """(r,) rewards of a control period, and (r,) whether the task is over."""

    @abstractmethod
    def info(self, rows: Rows) -> dict[str, Array]:
        """What has been reached, (r,) each."""

    def success(self, info: Mapping[str, Array]) -> NDArray[np.bool_] | None:
        """(r,) whether episodes that ended so have done what they should; None where only the return counts."""
        return None


class Follow(Task):
    """Keep the joints at a scenario's reference.

    The reward of a control period is −mean |q − reference| in units of half the joints' ranges (π of hinges without).

    Args:
        scenario: whose.

    Raises:
        ConfigError: where something befalls the robot in it, or it is known to be another there.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario.name, scenario.duration)
        if scenario.events or scenario.different:
            raise ConfigError(
                f"scenario {scenario.name}: something befalls the robot or is different of it, which learning "
                "environments do not simulate; expected one with a reference alone"
            )
        self._scenario = scenario

    def prepare(self, plant: BatchPlant, scaling: Scaling) -> None:
        """As of any task."""
        self._plant, self._scaling = plant, scaling
        dt = plant.spec.control_dt
        self.sight = ReferenceAhead.of(dt)
        self._ahead = np.array(self.sight.periods)
        times = np.arange(plant.longest + 1 + self._ahead[-1]) * dt
        self._reference = np.array([self._scenario.reference.position(float(t)) for t in times])
        self._turns = self._scenario.arrival is not None
        self._error = np.zeros(plant.n)

    @property
    def size(self) -> int:
        """As of any task."""
        return int(len(self._ahead) * self._reference.shape[1])

    def begin(self, row: int, rng: np.random.Generator) -> tuple[Start, Finish | None]:
        """As the scenario says."""
        self._error[row] = 0.0
        return self._scenario.start, None

    def observed(self, rows: Rows, periods: NDArray[np.int64], noise: Array) -> Array:
        """The reference now and ahead."""
        wanted = self._scaling.position(self._reference[periods[:, None] + self._ahead])
        return wanted.reshape(len(rows), -1)

    def judge(self, rows: Rows, periods: NDArray[np.int64], steps: list[Step]) -> tuple[Array, NDArray[np.bool_]]:
        """As of any task; it is never over."""
        off = self._plant.position[rows] - self._reference[periods]
        # Where a pose is to be reached, whole turns more are as good.
        scaled = self._scaling.difference(off) if self._turns else off / self._scaling.half
        self._error[rows] = np.abs(scaled).mean(axis=1)
        return -self._error[rows], np.zeros(len(rows), dtype=bool)

    def info(self, rows: Rows) -> dict[str, Array]:
        """``error``, in units of half the ranges."""
        return {"error": self._error[rows]}
