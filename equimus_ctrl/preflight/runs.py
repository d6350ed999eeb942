"""What recordings of one robot say together: repeats of one run, and where runs differ though they should not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.preflight.signals import Signals
from equimus_ctrl.types import Array, Recording

SAME_LENGTH = 0.98
"""Share of a run's length that a repeat of it has at least."""
LATE = 1.5
"""Rows by which commands of a repeat come earlier or later at most: one, and what times between rows scatter."""
SAME = 1e-6
"""Of the range of a command: nearer ones are the same."""
INSTANTS = 2000
"""At most so many instants of a run are compared."""


@dataclass(frozen=True)
class Repeats:
    """Runs with the same commands.

    Attributes:
        names: of the recordings.
        spread: of each joint, standard deviation of the runs about their mean [rad or m].
        offset: of each joint, the part of it that does not change along a run [rad or m].
        noise: of each joint, by the signals alone [rad or m].
    """

    names: tuple[str, ...]
    spread: tuple[float, ...]
    offset: tuple[float, ...]
    noise: tuple[float, ...]


@dataclass(frozen=True)
class RestPose:
    """Where a joint rested under one command in several recordings, each before its first change of a command.

    Attributes:
        joint: its name.
        names: of the recordings.
        positions: mean in each [rad or m].
        deviation: standard deviation of these means by the noise within each, were it white [rad or m].
    """

    joint: str
    names: tuple[str, ...]
    positions: tuple[float, ...]
    deviation: float

    @property
    def difference(self) -> float:
        """Between the two that are farthest from each other [rad or m]."""
        return max(self.positions) - min(self.positions)


def repeats_of(recordings: Sequence[Recording], signals: Sequence[Signals]) -> tuple[Repeats, ...]:
    """Sets of recordings with the same commands, two at least; runs whose commands never change are none."""
    span = np.ptp(np.concatenate([r.command for r in recordings]), axis=0)
    groups: list[list[int]] = []
    for k, recording in enumerate(recordings):
        if not np.any(np.ptp(recording.command, axis=0) > SAME * span):
            continue
        own = next((g for g in groups if _same(recordings[g[0]], recording, span)), None)
        if own is None:
            groups.append([k])
        else:
            own.append(k)
    return tuple(_spread([recordings[k] for k in g], [signals[k] for k in g], span) for g in groups if len(g) > 1)


def _instants(first: Recording, length: float) -> Array:
    rows = min(len(first.time), INSTANTS)
    return np.linspace(0.0, length, rows)


def _row(recordings: Sequence[Recording]) -> float:
    """Longest usual time between rows [s]."""
    return max(float(np.median(np.diff(r.time))) for r in recordings)


def _same(first: Recording, other: Recording, span: Array) -> bool:
    """Whether two runs were given the same commands, each within ``LATE`` rows."""
    lengths = [float(r.time[-1] - r.time[0]) for r in (first, other)]
    late = LATE * _row((first, other))
    if abs(lengths[0] - lengths[1]) > max(late, (1 - SAME_LENGTH) * lengths[0]):
        return False
    until = min(lengths) - late
    return _given(first, other, until, late, span) and _given(other, first, until, late, span)


def _given(first: Recording, other: Recording, until: float, late: float, span: Array) -> bool:
    """Whether each command of a run, until so long after its first row, is one of another's about the same time."""
    since, theirs = (r.time - r.time[0] for r in (first, other))
    changed = np.concatenate([[True], np.any(np.abs(np.diff(first.command, axis=0)) > SAME * span, axis=1)])
    wanted = changed & (since <= until)
    low = np.maximum(np.searchsorted(theirs, since[wanted] - late, side="right") - 1, 0)
    high = np.searchsorted(theirs, since[wanted] + late, side="right")
    left = first.command[wanted]
    unmet = np.ones(len(left), dtype=bool)
    for k in range(int((high - low).max(initial=0))):
        rows = np.minimum(low + k, high - 1)
        unmet &= np.any(np.abs(other.command[rows] - left) > SAME * span, axis=1)
    return not unmet.any()


def _late(recordings: Sequence[Recording], span: Array) -> float:
    """By how much time commands of repeats may differ; 0 where they change at the same times [s]."""
    first = recordings[0]
    since = first.time - first.time[0]
    same = all(
        r.command.shape == first.command.shape
        and np.allclose(r.time - r.time[0], since, rtol=0, atol=SAME * _row([first]))
        and bool(np.all(np.abs(r.command - first.command) <= SAME * span))
        for r in recordings[1:]
    )
    return 0.0 if same else LATE * _row(recordings)


def _spread(recordings: Sequence[Recording], signals: Sequence[Signals], span: Array) -> Repeats:
    """How far repeats are apart, less what commands that came a little earlier or later make at the joints' speeds."""
    since = _instants(recordings[0], min(float(r.time[-1] - r.time[0]) for r in recordings))
    moved = np.array(
        [[np.interp(since, r.time - r.time[0], column) for column in r.position.T] for r in recordings]
    )  # (runs, nj, m)
    free = len(recordings) / (len(recordings) - 1)
    away = moved - moved.mean(axis=0)
    if late := _late(recordings, span):
        shift = late * np.abs(np.gradient(moved, since, axis=2)).max(axis=0)
        away = np.sign(away) * np.maximum(np.abs(away) - shift, 0.0)
    spread = np.sqrt(free * (away**2).mean(axis=(0, 2)))
    offset = np.sqrt(free * (away.mean(axis=2) ** 2).mean(axis=0))
    noise = np.sqrt(np.mean([s.noise**2 for s in signals], axis=0))
    names = tuple(r.name for r in recordings)
    return Repeats(names, *(tuple(map(float, own)) for own in (spread, offset, noise)))


def rest_poses(recordings: Sequence[Recording], signals: Sequence[Signals]) -> tuple[RestPose, ...]:
    """Joints at rest under the same command at the start of two recordings or more."""
    span = np.maximum(np.ptp(np.concatenate([r.command for r in recordings]), axis=0), 1e-300)
    found: dict[tuple[float, ...], list[tuple[str, Array, Array]]] = {}
    for recording, own in zip(recordings, signals, strict=True):
        changes = np.flatnonzero(np.any(np.diff(recording.command, axis=0) != 0, axis=1))
        end = int(changes[0]) + 1 if len(changes) else len(recording.time)
        still = own.resting[:end]
        rows = int(np.argmin(still)) if not still.all() else end
        if rows * own.clock.interval < 0.1 or rows < 8:
            continue
        if recording.before is not None and np.any(np.abs(recording.before - recording.command[0]) > SAME * span):
            continue
        key = tuple(np.round(recording.command[0] / (SAME * span)).tolist())
        mean, noise = (
            recording.position[:rows].mean(axis=0),
            np.maximum(recording.position[:rows].std(axis=0), own.noise),
        )
        found.setdefault(key, []).append((recording.name, mean, noise))
    poses = []
    for own_poses in found.values():
        if len(own_poses) < 2:
            continue
        for j, joint in enumerate(recordings[0].joints):
            # Noise may be correlated over all of a rest: a mean is no better known than one sample then.
            deviation = float(np.sqrt(np.mean([noise[j] ** 2 for _, _, noise in own_poses])))
            names = tuple(name for name, *_ in own_poses)
            poses.append(RestPose(joint, names, tuple(float(mean[j]) for _, mean, _ in own_poses), deviation))
    return tuple(poses)
