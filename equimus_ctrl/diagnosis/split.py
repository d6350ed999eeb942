"""Which trials are fitted and which judge."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.engines.predict import check_columns
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Recording

EVERY = 4
"""One trial in so many is held out."""
LAST = 0.25
"""Share of a single trial that is held out, its end."""
LEAST_DURATION, LEAST_SAMPLES = 1.0, 60
"""Of a trial to be of use [s] and in samples."""
LEAST_STEP = 500.0
"""Commands that stay within this do not move a robot [Pa]."""
LEAST_MOTION = 5e-3
"""A joint that stays within this does not move [rad]."""
MOST_ANGLE = 12.6
"""Angles beyond two turns are degrees [rad]."""


@dataclass(frozen=True, eq=False)
class Split:
    """Trials to fit and to judge by.

    Attributes:
        train: fitted.
        heldout: not seen by any fit or choice.
    """

    train: tuple[Segment, ...]
    heldout: tuple[Segment, ...]


def check(model: Model, recordings: Sequence[Recording]) -> None:
    """Raise ConfigError where recordings cannot tell what a model leaves out."""
    if not recordings:
        raise ConfigError("no recording was given to diagnose")
    names = (*model.morphology.actuator_names, *model.morphology.joint_names)
    for r in recordings:
        if not (np.all(np.isfinite(r.position)) and np.all(np.isfinite(r.command)) and np.all(np.isfinite(r.time))):
            raise ConfigError(f"{r.name}: holds numbers that are not finite; leave out the rows where nothing was seen")
        duration = float(r.time[-1] - r.time[0])
        if duration < LEAST_DURATION or len(r.time) < LEAST_SAMPLES:
            raise ConfigError(
                f"{r.name}: has {len(r.time)} samples over {duration:.3g} s, too short to diagnose; expected at least "
                f"{LEAST_SAMPLES} samples over {LEAST_DURATION:g} s"
            )
        largest = float(np.abs(r.position).max())
        if largest > MOST_ANGLE:
            j = int(np.abs(r.position).max(axis=0).argmax())
            raise ConfigError(
                f"{r.name}: {r.joints[j]} reaches {largest:.4g} rad, more than two turns; are the angles in degrees? "
                "They are expected in rad"
            )
    moved = np.max([np.ptp(np.vstack([r.command, r.command_before]), axis=0) for r in recordings], axis=0)
    if moved.max() < LEAST_STEP:
        raise ConfigError(
            f"the commands never move: they change by at most {moved.max():.3g} Pa in any trial, expected at least "
            f"{LEAST_STEP:g} Pa; record steps, staircases or sweeps"
        )
    everything = np.concatenate([r.position for r in recordings])
    for j, name in enumerate(recordings[0].joints):
        span = float(np.ptp(everything[:, j]))
        if span < LEAST_MOTION:
            raise ConfigError(
                f"joint {name} never moves: it stays within {span:.2g} rad in all trials, expected at least "
                f"{LEAST_MOTION:g} rad (columns: {', '.join(names)})"
            )


def split(
    model: Model,
    recordings: Sequence[Recording],
    *,
    heldout: Sequence[str] = (),
    until: float | None = None,
    window: tuple[float, float] | None = None,
) -> Split:
    """Decide which trials are fitted and which judge.

    Args:
        model: whose names the recordings must have.
        recordings: all of them.
        heldout: patterns of names of trials that judge; every fourth by default, of two or three the last, of a single
            one its end.
        until: of every trial only what comes before this time is fitted, and the rest judges too [s].
        window: (from, to) of each trial that counts at all [s].

    Raises:
        ConfigError: where recordings cannot be used, a pattern fits none, or nothing is left to fit.
    """
    for r in recordings:
        check_columns(model, r)
    check(model, recordings)
    names = [r.name for r in recordings]
    for pattern in heldout:
        if not fnmatch.filter(names, pattern):
            raise ConfigError(unknown_name("trial", pattern, names, "held out"))
    judging = {k for k, name in enumerate(names) if any(fnmatch.fnmatchcase(name, p) for p in heldout)}
    if not heldout and until is None:
        if len(recordings) == 1:
            low, high = window or (float(recordings[0].time[0]), float(recordings[0].time[-1]))
            until = high - LAST * (high - low)
        elif len(recordings) < EVERY:
            judging = {len(recordings) - 1}
        else:
            judging = set(range(EVERY - 1, len(recordings), EVERY))
    train, unseen = [], []
    for k, r in enumerate(recordings):
        low, high = window or (float(r.time[0]), float(r.time[-1]))
        if k in judging:
            unseen += _cut(model, r, k, (low, high))
            continue
        edge = high if until is None else min(until, high)
        if edge > low:
            train += _cut(model, r, k, (low, edge), fit_start=True)
        if edge < high and np.count_nonzero(r.time > edge) >= LEAST_SAMPLES:
            unseen += _cut(model, r, k, (float(np.nextafter(edge, high)), high))
    if not train:
        raise ConfigError("every trial is held out, so there is nothing to fit; hold out fewer")
    return Split(tuple(train), tuple(unseen))


def _cut(model: Model, r: Recording, k: int, window: tuple[float, float], fit_start: bool = False) -> list[Segment]:
    return [replace(s, recording=k) for s in cut(model, [r], window=window, fit_start=fit_start)]
