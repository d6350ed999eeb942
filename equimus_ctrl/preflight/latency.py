"""How late a joint moves after a step of a command, from recordings alone: bounds, and no model.

The dead time is at most what passes until motion is first seen beyond the noise, from the row before the step's on:
that is the upper bound, whatever the robot. How much less it can be depends on how motion begins. Behind a dead time d
a joint at rest moves as c·(t − d)ⁿ, n = 1 where the command is a speed, 2 where it is a force on a mass, 3 and 4 where
a lag or an elastic drive comes between;
and it shows the later the higher n is. For each n the d are found whose

    χ²(d) = min over c, a   Σ (x − a − c·max(t − d, 0)ⁿ)²/σ²

is within ``FALL`` of the least, all steps of an actuator together, in a window behind the step that ends where motion
stands out of the noise by ``CLEAR``. The lower bound is the lowest of all n: which n it is nobody knows, and damping
makes
high ones look like low ones that begin later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.preflight.signals import Signals
from equimus_ctrl.types import Array, Recording

REST_BEFORE = 0.25
"""A joint rests for so long before a step that counts [s]."""
LEAST_BEFORE = 6
"""Rows of that at least."""
HORIZON = 0.6
"""Motion that begins later than so long after a step is not its; and no command changes for so long before one that
counts, nor another at the same row, for what moves then could be of either [s]."""
CLEAR = 15.0
"""Standard deviations of the noise by which motion stands out at the end of what is looked at: beyond, powers of time
describe no motion."""
LEAST_BEHIND = 3
"""Rows behind the first with clear motion that are looked at least, for as many unknowns."""
ORDERS = (1, 2, 3, 4)
"""Powers n."""
FALL = 9.0
"""Of χ² about the best: three standard deviations of one unknown."""
GRID = 400
"""Dead times tried."""
MOST_STEPS = 40
"""Steps of an actuator that are looked at."""


@dataclass(frozen=True)
class Latency:
    """When motion begins after steps of an actuator's command.

    Attributes:
        actuator: whose command.
        low: lowest dead time that the recordings allow [s].
        high: highest one [s].
        steps: how many steps say so; 0 where none does: then ``low`` is 0 and ``high`` inf.
    """

    actuator: str
    low: float
    high: float
    steps: int

    @property
    def shows(self) -> bool:
        """Whether any step says something."""
        return self.steps > 0


@dataclass(frozen=True, eq=False)
class _Onset:
    """What was measured about one step.

    Attributes:
        since: (m,) time since the step [s].
        moved: (m,) position in standard deviations.
        seen: when motion is first beyond the noise [s].
        before: from the row before the step's to it: what is logged at a row may have been sent since then [s].
    """

    since: Array
    moved: Array
    seen: float
    before: float


def latencies(
    recordings: Sequence[Recording],
    signals: Sequence[Signals],
    driven: Mapping[str, frozenset[str]],
    limits: CheckLimits = LIMITS,
) -> tuple[Latency, ...]:
    """For each actuator how late joints move after its steps.

    Args:
        recordings: what was measured.
        signals: of each.
        driven: actuator → joints that it drives.
        limits: by which motion is told from noise.
    """
    found = []
    for k, actuator in enumerate(recordings[0].actuators):
        onsets = [
            onset
            for recording, own in zip(recordings, signals, strict=True)
            for onset in _onsets(recording, own, k, driven[actuator], limits)
        ]
        found.append(_latency(actuator, onsets[:MOST_STEPS]))
    return tuple(found)


def _onsets(
    recording: Recording, signals: Signals, k: int, joints: frozenset[str], limits: CheckLimits
) -> list[_Onset]:
    """What was measured about the steps of an actuator from rest, of the joint where motion shows first."""
    time, command = np.array(recording.time), np.array(recording.command)
    span = float(np.ptp(command[:, k]))
    if recording.linear or span == 0:
        return []
    moves = np.diff(command, axis=0) != 0
    own, any_of, others = (
        np.flatnonzero(moving) + 1
        for moving in (moves[:, k], moves.any(axis=1), np.delete(moves, k, axis=1).any(axis=1))
    )
    found = []
    for row in own.tolist():
        # Motion may begin up to the horizon late, and of whichever command changed since then.
        before = any_of[np.searchsorted(time[any_of], time[row] - HORIZON) :]
        if before[0] < row or row in others:
            continue
        first = int(np.searchsorted(time, time[row] - REST_BEFORE))
        if row - first < LEAST_BEFORE or time[first] > time[row] - REST_BEFORE / 2:
            continue
        if not signals.resting[first:row].all():
            continue
        # A command that goes on changing from here, as along a ramp, is one beginning; the next other change ends what
        # is looked at, for it may be another.
        ramp = row
        while ramp < len(moves) and moves[ramp, k]:
            ramp += 1
        later = np.concatenate([time[own[own > ramp]], time[others[others > row]]])
        end = min(time[row] + HORIZON, float(later.min(initial=math.inf)))
        each = (
            _onset(time, recording.position[:, j], float(signals.noise[j]), first, row, end, limits)
            for j in _of(recording, joints)
        )
        seen = [onset for onset in each if onset is not None]
        if seen:
            found.append(min(seen, key=lambda onset: float(onset.since[-1])))
    return found


def _of(recording: Recording, joints: frozenset[str]) -> list[int]:
    return [j for j, name in enumerate(recording.joints) if name in joints]


def _onset(time: Array, x: Array, noise: float, first: int, row: int, end: float, limits: CheckLimits) -> _Onset | None:
    """What was measured of a joint from its rest to clear motion; None where it moves too little until an end."""
    last = int(np.searchsorted(time, end, side="right"))
    # Slow noise, and what is left of an earlier motion, show in the rest before.
    noise = max(noise, float(x[first:row].std()))
    behind = (x[row:last] - x[first:row].mean()) / noise
    # Of so many instants one is as far out by chance with the level alone; what moves is so in the next row too.
    level = -float(ndtri(limits.significance / max(2 * len(behind), 1)))
    stays = np.sign(behind[1:]) == np.sign(behind[:-1])
    beyond, clear = (
        np.flatnonzero(stays & (np.minimum(np.abs(behind[1:]), np.abs(behind[:-1])) > size))
        for size in (level, max(CLEAR, level))
    )
    if not len(clear):
        return None
    stop = row + max(int(clear[0]) + 2, LEAST_BEHIND)
    if stop > last:
        return None
    moved = (x[first:stop] - x[first:row].mean()) / noise
    since = time - time[row]
    return _Onset(since[first:stop], moved, float(since[row + beyond[0]]), float(-since[row - 1]))


def _latency(actuator: str, onsets: Sequence[_Onset]) -> Latency:
    """The bounds that all steps together leave, see the module's law."""
    if not onsets:
        return Latency(actuator, 0.0, math.inf, 0)
    seen = min(onset.seen for onset in onsets)
    delays = np.linspace(0.0, seen, GRID)
    samples = sum(len(onset.since) for onset in onsets)
    freedom = max(samples - 2 * len(onsets) - 1, 1)
    low = seen
    for order in ORDERS:
        costs = np.sum([_costs(onset, delays, order) for onset in onsets], axis=0)
        # Where the power does not describe the motion, what is left over counts as noise.
        spread = max(float(costs.min()) / freedom, 1.0)
        low = min(low, float(delays[costs <= costs.min() + FALL * spread][0]))
    # A delay is known no better than rows are apart.
    apart = float(np.median(np.concatenate([np.diff(onset.since) for onset in onsets])))
    high = min(onset.seen + onset.before for onset in onsets)
    return Latency(actuator, max(min(low, seen - apart), 0.0), high, len(onsets))


def _costs(onset: _Onset, delays: Array, order: int) -> Array:
    """(k,) χ² of beginnings at delays (k,), the level and the size of the motion the best."""
    shapes = np.maximum(onset.since[:, None] - delays, 0.0) ** order
    shapes -= shapes.mean(axis=0)
    moved = onset.moved - onset.moved.mean()
    squares = np.maximum((shapes**2).sum(axis=0), 1e-300)
    return np.asarray(moved @ moved - (moved @ shapes) ** 2 / squares)
