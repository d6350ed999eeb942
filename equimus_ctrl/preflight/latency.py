"""How late a joint moves after a step of a command, from recordings alone: bounds, and no model.

Behind a dead time d a joint at rest begins to move as c·(t − d)ⁿ, n = 1 where the command is a speed, 2 where it is a
force on a mass, 3 and 4 where a lag or an elastic drive comes between. Nobody knows n, and motion shows late the more the
higher it is. So for each n the d is found at which

    χ²(d) = min over c, a   Σ (x − a − c·max(t − d, 0)ⁿ)²/σ²

is least, in a window behind the step that ends where motion stands out of the noise by ``CLEAR``, all steps of an actuator
together. All d within ``FALL`` of the least χ² of any n are possible: what is told is the lowest and the highest of them.
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

REST_BEFORE = 0.1
"""A joint rests, and no command changes, for so long before a step that counts [s]."""
LEAST_BEFORE = 6
"""Rows of that at least."""
HORIZON = 0.6
"""Motion that begins later than so long after a step is not its [s]."""
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
    """

    since: Array
    moved: Array


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
    changes = np.flatnonzero(np.any(np.diff(command, axis=0) != 0, axis=1)) + 1
    steps = np.flatnonzero(np.diff(command[:, k]) != 0) + 1
    found = []
    for row in steps:
        before = time[row] - REST_BEFORE
        first = int(np.searchsorted(time, before))
        earlier = changes[changes < row]
        if row - first < LEAST_BEFORE or time[first] > time[row] - REST_BEFORE / 2:
            continue
        if (len(earlier) and time[earlier[-1]] > before) or not signals.resting[first:row].all():
            continue
        # The next change of any command may be another beginning; it only ends what is looked at.
        later = changes[changes > row]
        end = min(time[row] + HORIZON, time[later[0]] if len(later) else math.inf)
        # A command that goes on changing from here, as along a ramp, is one beginning too.
        if len(later) and later[0] == row + 1:
            end = time[row] + HORIZON
        own = (
            _onset(time, recording.position[:, j], float(signals.noise[j]), first, row, end, limits)
            for j in _of(recording, joints)
        )
        seen = [onset for onset in own if onset is not None]
        if seen:
            found.append(min(seen, key=lambda onset: float(onset.since[-1])))
    return found


def _of(recording: Recording, joints: frozenset[str]) -> list[int]:
    return [j for j, name in enumerate(recording.joints) if name in joints]


def _onset(
    time: Array, x: Array, noise: float, first: int, row: int, end: float, limits: CheckLimits
) -> _Onset | None:
    """What was measured of a joint from its rest to clear motion; None where it moves too little until an end."""
    last = int(np.searchsorted(time, end, side="right"))
    # The command is recorded when it was in force, so what was measured in its row is still from before it.
    behind = (x[row:last] - x[first:row].mean()) / noise
    # Of so many instants one is as far out by chance with the level alone.
    level = -float(ndtri(limits.significance / max(2 * len(behind), 1)))
    clear = np.flatnonzero(np.abs(behind) > max(CLEAR, level))
    if not len(clear):
        return None
    stop = row + max(int(clear[0]) + 1, LEAST_BEHIND)
    if stop > last:
        return None
    return _Onset(time[first:stop] - time[row], (x[first:stop] - x[first:row].mean()) / noise)


def _latency(actuator: str, onsets: Sequence[_Onset]) -> Latency:
    """The bounds that all steps together leave, see the module's law."""
    if not onsets:
        return Latency(actuator, 0.0, math.inf, 0)
    longest = max(float(onset.since[-1]) for onset in onsets)
    delays = np.linspace(0.0, longest, GRID)
    costs = np.array([np.sum([_costs(onset, delays, n) for onset in onsets], axis=0) for n in ORDERS])
    # Where no power describes the motion, what is left over counts as noise.
    samples = sum(len(onset.since) for onset in onsets)
    spread = max(float(costs.min()) / max(samples - 2 * len(onsets) - 1, 1), 1.0)
    possible = np.any(costs <= costs.min() + FALL * spread, axis=0)
    # A delay is known no better than rows are apart.
    apart = float(np.median(np.concatenate([np.diff(onset.since) for onset in onsets])))
    low, high = float(delays[possible].min()), float(delays[possible].max())
    return Latency(actuator, max(min(low, high - apart), 0.0), high, len(onsets))


def _costs(onset: _Onset, delays: Array, order: int) -> Array:
    """(k,) χ² of beginnings at delays (k,), the level and the size of the motion the best."""
    shapes = np.maximum(onset.since[:, None] - delays, 0.0) ** order
    shapes -= shapes.mean(axis=0)
    moved = onset.moved - onset.moved.mean()
    squares = np.maximum((shapes**2).sum(axis=0), 1e-300)
    return np.asarray(moved @ moved - (moved @ shapes) ** 2 / squares)
