"""Ground truths of an MJCF robot: its free parameters off, driven as it was.

An MJCF robot has no workspace that a proof could know of. So what is done with it is what was done with it: commands,
times and first angles are those of recordings that somebody has, and the proof is one of these experiments too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.drawing import (
    ALIKE_SHARE,
    Draws,
    Excess,
    GroundTruth,
    Kind,
    Site,
    draw_case,
    noise,
)
from equimus_ctrl.proof.mjcf_simulation import FINER, driven_mjcf, mjcf_excess, mjcf_recordings
from equimus_ctrl.proof.seal import digest
from equimus_ctrl.proof.sizes import Table, measured_by, mjcf_table
from equimus_ctrl.proof.sources import CaseSource, Driven
from equimus_ctrl.proof.tracking import Tracking
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, Recording

LITTLE_KNOWN = {"damping": 0.4, "quadratic_damping": 0.4, "frictionloss": 0.4, "armature": 0.4}
SPREAD = 0.15
"""± share of a robot's free parameters."""
NOISE = (5e-4, 2e-3)
"""Standard deviation of each joint's noise, in units of what it covers."""
CORRELATION = (0.5, 8.0)
"""Correlation time of coloured noise in sampling intervals."""


@dataclass(frozen=True, eq=False)
class Experiment(CaseSource):
    """An MJCF robot and what is done with it.

    Attributes:
        model: the nominal robot.
        recordings: whose commands, times, first angles and notes are used; what else was measured only gives scales,
            and what is tracked.
        track: frequency of the controllers that keep drawn robots near the recorded motion [Hz], see ``Tracking``; by
            default commands are given as they were.
    """

    model: Model
    recordings: tuple[Recording, ...]
    track: float | None = None

    def __post_init__(self) -> None:
        require_bare_mjcf(self.model)
        split(self.model, self.recordings)  # what cannot be diagnosed makes no proof
        _ = self.tracking  # nor does what cannot be tracked

    @cached_property
    def tracking(self) -> tuple[Tracking, ...]:
        """The controller of each trial; none where commands are given as they were."""
        if self.track is None:
            return ()
        return tuple(Tracking.of(self.model, recording, self.track) for recording in self.recordings)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """As a diagnosis of these recordings would cut them."""
        parts = split(self.model, self.recordings)
        return (*parts.train, *parts.validation, *parts.test)

    @cached_property
    def draws(self) -> Draws:
        """How ground truths of this robot are drawn."""
        model = self.model
        excitation = excitation_of(model, self.segments)
        joints = model.robot.joint_names
        interval = excitation[joints[0]].interval
        spread = {
            name: LITTLE_KNOWN.get(name.rpartition(".")[2], SPREAD) for name in default_free_parameters(model).names
        }
        table = mjcf_table(model, excitation)
        sizes = [(NOISE[0] * excitation[joint].span, NOISE[1] * excitation[joint].span) for joint in joints]
        times = CORRELATION[0] * interval, CORRELATION[1] * interval
        return Draws(model, spread, table, _choose, partial(_place, table), sizes, times)

    @property
    def nominal(self) -> Model:
        return self.model

    @property
    def trial_names(self) -> list[str]:
        return [recording.name for recording in self.recordings]

    @property
    def rate(self) -> float:
        """Physics steps a second."""
        return FINER / mjcf_of(self.model.robot).timestep

    def draw(self, seed: int, case: int, kind: Kind | None = None, attempt: int = 0) -> GroundTruth:
        trials = [
            TrialDesign(r.name, "as recorded", r.time, r.command, np.array(r.position[0]), dict(r.notes))
            for r in self.recordings
        ]
        found = draw_case(self.draws, trials, np.zeros((len(trials), 0)), seed, case, kind, attempt)
        scales = {
            (effect.name, size.parameter): measured_by(size, type(effect), float(getattr(effect, size.parameter)))
            for effect in (*found.effects, *found.outside)
            for size in self.draws.table[effect.name]
            if size.at == effect.location
        }
        return replace(found, scales=scales)

    def driven(self, ground_truth: GroundTruth) -> Driven:
        return driven_mjcf(ground_truth, self.tracking)

    @property
    def open_loop(self) -> Experiment:
        return replace(self, track=None)

    def recorded(self, ground_truth: GroundTruth, clean: Sequence[Array]) -> list[Recording]:
        return mjcf_recordings(ground_truth, clean, noise(ground_truth))

    def excess(
        self, ground_truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = (), refit: bool = True
    ) -> Excess:
        return mjcf_excess(ground_truth, clean, effects)

    def made_of(self) -> dict[str, Any]:
        robot = mjcf_of(self.model.robot)
        hashes = {"recordings_sha256": digest(self.recordings), "model_sha256": robot.digest}
        return {**hashes, "track_hz": self.track}


def require_bare_mjcf(model: Model) -> None:
    """Raise ConfigError where a model is of no MJCF robot, has effects already, or is moved as it was measured."""
    try:
        mjcf_of(model.robot)
    except ConfigError as error:
        raise ConfigError(f"{error}; a leg's experiments are drawn") from None
    if model.robot.prescribed_names:
        raise ConfigError(
            f"{model.name}: the motion of {', '.join(model.robot.prescribed_names)} is prescribed, expected a robot "
            "whose joints all move by themselves: its ground truths are simulated"
        )
    if model.robot.unmeasured_names:
        raise ConfigError(
            f"{model.name}: {', '.join(model.robot.unmeasured_names)} is not measured, expected a robot whose joints "
            "all are"
        )
    if model.effects:
        raise ConfigError(f"{model.name} has effects already; prove with the robot alone")


def _choose(rng: np.random.Generator, names: Sequence[str], count: int) -> list[str]:
    return [names[k] for k in rng.choice(len(names), count, replace=False)]


def _place(table: Table, rng: np.random.Generator, cls: type[Effect]) -> Site:
    """One of all places that the table has sizes for."""
    sites = sorted({size.at for size in table[cls.name]})
    location = sites[int(rng.integers(len(sites)))]
    everywhere = len(sites) > 1 and cls.alike and "link" not in cls.sits_at and rng.random() < ALIKE_SHARE
    return Site(location, "", tuple(sites) if everywhere else (location,))
