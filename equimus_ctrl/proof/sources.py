"""What cases of a proof are made from: a nominal robot, and what is done with those that are like it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.drawing import Excess, GroundTruth, Kind
from equimus_ctrl.types import Array, Recording


@dataclass(frozen=True, eq=False)
class Driven:
    """A ground truth on its trials.

    Attributes:
        ground_truth: with the commands that were given.
        shown: for each trial (n, nj) what sensors without noise show [rad or m].
        motion: for each trial (n, 2 nj) where the joints truly are, and their rates [rad or m, and that each second].
    """

    ground_truth: GroundTruth
    shown: list[Array]
    motion: list[Array]


class CaseSource(ABC):
    """A nominal robot and what is done with it: what cases are made from."""

    @property
    @abstractmethod
    def nominal(self) -> Model:
        """What a diagnosis takes the robot to be."""

    @property
    @abstractmethod
    def trial_names(self) -> list[str]:
        """Of every case."""

    @abstractmethod
    def draw(self, seed: int, case: int, kind: Kind | None = None, attempt: int = 0) -> GroundTruth:
        """The ground truth of a case.

        Args:
            seed: of the whole proof.
            case: its number.
            kind: by default one of ``SHARES``.
            attempt: how many ground truths of this case could not be simulated.

        Raises:
            ConfigError: for an unknown kind, a seed or case below 0, or where none of many draws can be.
        """

    @abstractmethod
    def driven(self, ground_truth: GroundTruth) -> Driven:
        """The ground truth as it was driven, what sensors show and how the joints truly move.

        Raises:
            SimulationDiverged: where the robot's parameters are none.
        """

    def simulate(self, ground_truth: GroundTruth) -> tuple[GroundTruth, list[Array]]:
        """The ground truth as it was driven, and for each trial (n, nj) what sensors without noise show [rad or m].

        Raises:
            SimulationDiverged: where the robot's parameters are none.
        """
        found = self.driven(ground_truth)
        return found.ground_truth, found.shown

    @property
    def open_loop(self) -> CaseSource:
        """The same for trials whose commands are given as they are, whatever controllers its own trials have."""
        return self

    def sample_times(self, rng: np.random.Generator, duration: float, rate: float) -> Array:
        """(n,) when a further trial is sampled, from 0 on [s].

        Args:
            rng: of jitter, where sampling has some.
            duration: of the trial [s].
            rate: of the recordings so far [1/s].
        """
        return np.asarray(np.arange(max(math.ceil(duration * rate - 1e-9), 1)) / rate)

    @abstractmethod
    def recorded(self, ground_truth: GroundTruth, clean: Sequence[Array]) -> list[Recording]:
        """What a diagnosis may see: what ``simulate`` gave, with noise."""

    @abstractmethod
    def excess(
        self, ground_truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = (), refit: bool = True
    ) -> Excess:
        """Excess residual variance of the fitted robot with ``effects`` alone, see ``strength.excess``."""

    def made_of(self) -> dict[str, Any]:
        """What cases are made from beside seeds and settings, as JSON."""
        return {}
