"""Recordings of MJCF robots that show little: small chirps about a level, within limits, of the nominal robot.

They take the place of recordings that somebody has, where only their commands, times and first angles count.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import CommandBounds
from equimus_ctrl.experiments.first import unrecorded
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.predicted import Commands, predicted_recordings
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.chirps import chirp
from equimus_ctrl.types import Array, Recording

SOMEWHERE, SMALL = (0.4, 0.6), (0.1, 0.2)
"""Between what levels of chirps are, and how far they swing, in shares of the commands' ranges."""
FADED = 1 / 6
"""Share of a trial over which it is faded in, and out."""
DRAWS = 99
"""Of the robot's parameters through which trials are taken."""
DIGITS = 6
"""To which commands and positions are rounded: other processors differ in later ones."""


def poor_recordings(model: Model, limits: Limits, count: int, seed: int) -> tuple[Recording, ...]:
    """Small chirps of the nominal robot.

    Args:
        model: of the robot.
        limits: that are kept, with the duration.
        count: how many.
        seed: of levels, swings and frequencies.

    Raises:
        ConfigError: where the robot does not come to rest.
    """
    rivals = unrecorded(model)
    ground = Ground.of(rivals, limits, KnownCondition(), rivals.simulator(1))
    rng, bounds = np.random.default_rng(seed), ground.bounds
    crowd, made = crowd_of(ground, rng, DRAWS), list[Commands]()
    span = bounds.high - bounds.low
    for _ in range(count):
        level = bounds.low + rng.uniform(*SOMEWHERE) * span
        course = from_rest(chirp(rng, ground.times, level, rng.uniform(*SMALL) * span, bounds.before), bounds)
        made.append(kept(crowd, course))
    found = predicted_recordings(rivals, model, made, rivals.simulator(1))
    return tuple(_rounded(own, f"trial_{k:02d}") for k, own in enumerate(found))


def from_rest(course: Array, bounds: CommandBounds) -> Array:
    """A course (n, na) that begins and ends at rest, faded in and out."""
    share = np.linspace(0.0, 1.0, len(course))
    envelope = np.clip(np.minimum(share, 1 - share) / FADED, 0.0, 1.0)[:, None]
    return np.asarray(bounds.rest + envelope * (np.clip(course, bounds.low, bounds.high) - bounds.rest))


def crowd_of(ground: Ground, rng: np.random.Generator, draws: int) -> Crowd:
    """What is named first, with draws of its parameters."""
    first = ground.rivals.rivals[0]
    return ground.crowd([first.model, *(first.model_at(theta) for theta in first.draws(rng, draws))])


def kept(crowd: Crowd, course: Array) -> Commands:
    """A course (n, na), shrunk about rest until it keeps the limits."""
    ground, share = crowd.ground, crowd.within(course)[0]
    return ground.trial(ground.rest + share * (course - ground.rest))


def _rounded(recording: Recording, name: str) -> Recording:
    command, position = (np.round(values, DIGITS) for values in (recording.command, recording.position))
    return replace(recording, name=name, command=command, position=position, before=command[0])
