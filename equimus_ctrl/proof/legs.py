"""Ground truths of legs: the nominal leg with perturbed actuators, on trials that are drawn too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.predict import robot_as_noted
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.chirps import leg_chirps
from equimus_ctrl.proof.designs import DURATION, TRIALS, design, sample_times
from equimus_ctrl.proof.drawing import (
    ALIKE_SHARE,
    DESIGN,
    REST,
    Draws,
    Excess,
    GroundTruth,
    Kind,
    Site,
    draw_case,
    stream,
)
from equimus_ctrl.proof.leg_simulation import RATE, driven, recordings
from equimus_ctrl.proof.sizes import leg_table
from equimus_ctrl.proof.sources import CaseSource, Driven
from equimus_ctrl.proof.strength import excess
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Recording

SPREAD = {"stiffness": 0.15, "area": 0.15, "rest_length": 0.02, "damping": 0.4}
"""± relative perturbation of the nominal leg's parameters."""

NOISE = (1e-3, 3e-3)
"""Standard deviation of each joint's noise [rad]."""
CORRELATION = (5e-3, 80e-3)
"""Correlation time of coloured noise [s]."""

Excitation = Literal["rich", "poor"]
"""Of trials: steps, staircases, multisines and releases over the whole workspace; or small chirps."""


@dataclass(frozen=True, eq=False)
class Legs(CaseSource):
    """Legs whose trials are drawn.

    Attributes:
        trials: how many of each case.
        duration: of each [s].
        rate: physics steps a second.
        excitation: how much the trials show.
    """

    trials: int = TRIALS
    duration: float = DURATION
    rate: float = RATE
    excitation: Excitation = "rich"

    @property
    def nominal(self) -> Model:
        return nominal_model()

    @property
    def trial_names(self) -> list[str]:
        return [f"trial_{k:02d}" for k in range(self.trials)]

    def draw(self, seed: int, case: int, kind: Kind | None = None, attempt: int = 0) -> GroundTruth:
        leg = nominal_leg()
        bias = stream(seed, case, REST).uniform(-0.8, 0.8, (self.trials, len(leg.joints) + len(leg.actuators)))
        trials = leg_chirps if self.excitation == "poor" else design
        designs = trials(stream(seed, case, DESIGN), self.trials, self.duration)
        return draw_case(leg_draws(), designs, bias, seed, case, kind, attempt)

    def driven(self, ground_truth: GroundTruth) -> Driven:
        # What notes say is known to be different is so of all trials that are driven side by side.
        (notes,) = {tuple(sorted(trial.notes.items())) for trial in ground_truth.trials}
        robot = robot_as_noted(ground_truth.robot, ground_truth.trials[0].name, dict(notes))
        found = driven(replace(ground_truth, robot=robot), self.rate)
        return replace(found, ground_truth=ground_truth)

    def sample_times(self, rng: np.random.Generator, duration: float, rate: float) -> Array:
        return sample_times(rng, duration)

    def recorded(self, ground_truth: GroundTruth, clean: Sequence[Array]) -> list[Recording]:
        return recordings(ground_truth, clean)

    def excess(
        self, ground_truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = (), refit: bool = True
    ) -> Excess:
        return excess(ground_truth, clean, effects, refit)

    def made_of(self) -> dict[str, Any]:
        return {"excitation": self.excitation}


def draw(
    seed: int, case: int, *, kind: Kind | None = None, trials: int = TRIALS, duration: float = DURATION
) -> GroundTruth:
    """A leg's ground truth, see ``Legs`` and ``CaseSource.draw``."""
    return Legs(trials, duration).draw(seed, case, kind)


def leg_draws() -> Draws:
    """How ground truths of legs are drawn."""
    leg = nominal_leg()
    spread = {f"{a.name}.{key}": share for a in leg.actuators for key, share in SPREAD.items()}
    spread |= {f"{j.name}.damping": SPREAD["damping"] for j in leg.joints}
    noise = [NOISE] * len(leg.joints)
    return Draws(nominal_model(), spread, leg_table(), _choose, _place, noise, CORRELATION)


def _choose(rng: np.random.Generator, names: Sequence[str], count: int) -> list[str]:
    while True:
        chosen = [names[int(rng.integers(len(names)))] for _ in range(count)]
        if len(set(chosen)) == count:
            return chosen


def _place(rng: np.random.Generator, cls: type[Effect]) -> Site:
    """A kind of place first, then one of its places."""
    leg = nominal_leg()
    kind = cls.sits_at[int(rng.integers(len(cls.sits_at)))]
    # The last link's tip is the foot: one place is not to have two names.
    sites = [site for site in leg.places()[kind] if kind != "link" or site != leg.foot]
    everywhere = len(sites) > 1 and cls.leg_alike and rng.random() < ALIKE_SHARE
    location = sites[int(rng.integers(len(sites)))]
    return Site(location, kind, tuple(sites) if everywhere else (location,))
