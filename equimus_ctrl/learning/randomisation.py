"""Robots that episodes are on: the nominal one, others like it, or those that a diagnosis leaves possible."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.spread import groups, perturbed

VARYING = ("stiffness", "area", "damping", "mass")
"""What is off by a share where nobody has measured it, as in the tuner's ensembles."""


class Draws(Protocol):
    """Some robots, numbered."""

    @property
    def count(self) -> int:
        """How many."""
        ...

    def model(self, k: int) -> Model:
        """Robot ``k``; the same whichever were asked for before."""
        ...


@dataclass(frozen=True, eq=False)
class Same:
    """One model alone."""

    nominal: Model
    count: int = 1

    def model(self, k: int) -> Model:
        """As of any draws."""
        return self.nominal


@dataclass(frozen=True, eq=False)
class Spread:
    """Robots whose parameters are off by a share at most, evenly; those that vary together do.

    Attributes:
        nominal: about which.
        share: at most.
        count: how many robots.
        seed: of the draws.

    Raises:
        ConfigError: where nothing of the robot varies.
    """

    nominal: Model
    share: float
    count: int
    seed: int

    def __post_init__(self) -> None:
        if not groups(self.nominal.robot, dict.fromkeys(VARYING, self.share)):
            raise ConfigError(f"{self.nominal.name}: nothing of it varies by a share, expected another randomise")

    def model(self, k: int) -> Model:
        """As of any draws."""
        robot = changed_bodies(self.nominal.effects, self.nominal.robot)
        rest = tuple(effect for effect in self.nominal.effects if not isinstance(effect, BodyEffect))
        spread = groups(robot, dict.fromkeys(VARYING, self.share))
        row = _generator(self.seed, k).random(len(spread))
        return replace(self.nominal, robot=perturbed(robot, spread, row), effects=rest)


@dataclass(frozen=True, eq=False)
class Diagnosed:
    """Robots as a diagnosis leaves them possible.

    Each is one of the explanations that it accepts, all equally likely, with parameters from their joint distribution
    (``diagnosis.rivals.Rival.draws``): what the recordings showed together stays together. Where parameters are others
    in some groups of trials, it is as in one of these.

    Attributes:
        rivals: the explanations.
        count: how many robots.
        seed: of the draws.

    Raises:
        ConfigError: where no explanation is accepted.
    """

    rivals: Rivals
    count: int
    seed: int

    def __post_init__(self) -> None:
        if not any(rival.accepted for rival in self.rivals.rivals):
            raise ConfigError(f"{self.rivals.model.name}: the diagnosis accepts no explanation to draw robots from")

    def model(self, k: int) -> Model:
        """As of any draws."""
        rng = _generator(self.seed, k)
        accepted = [rival for rival in self.rivals.rivals if rival.accepted]
        rival = accepted[int(rng.integers(len(accepted)))]
        model = rival.model_at(rival.draws(rng, 1)[0])
        own = [group for group, _ in model.by_group]
        return model.in_group(own[int(rng.integers(len(own)))]) if own else model


def _generator(seed: int, k: int) -> np.random.Generator:
    return np.random.default_rng([seed, k])
