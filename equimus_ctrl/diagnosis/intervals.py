"""How long shooting intervals are: as long as a model's predictions stay close to what was measured.

Errors grow along a trial where nothing holds a robot in place, and a fit over long intervals ends in one of many local
minima. Where drives hold it, by the loops of position servos, a state is forgotten soon: errors stay as they are
however long an interval is, and short ones would only give the measured states away.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.residuals import DIVERGED, residuals_of
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator, simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, Recording

LENGTHS = (8.0, 4.0, 2.0, 1.0, 0.5)
"""Lengths of shooting intervals that are tried [s]."""
CLOSE_TO_MEASURED, MOSTLY = 0.5, 0.8
"""A model's error, in units of the usual trial's standard deviation, is to stay below the first in the second's share
of the intervals. Where it does not, fits end in one of many local minima."""
LOOKED_AT = 30
"""So many intervals of a length decide."""
ONCE = 1.5
"""Length of short intervals in times that a joint takes to cross its range: errors stay linear in changes there."""
FORGOTTEN = 0.2
"""A change of the initial state is forgotten where less than this share of it is left, in half of the intervals: dry
friction may keep it where a joint stands."""


@dataclass(frozen=True)
class Longest:
    """How long shooting intervals are.

    Attributes:
        length: None for whole trials [s].
        steady: whether errors do not grow along them, for the initial state is forgotten (``forgets``), or, of trials
            too long to be fitted whole, predictions stay close over the longest intervals: shorter ones tell no more.
    """

    length: float | None
    steady: bool = False


def motion_length(model: Model, segments: Sequence[Segment]) -> float:
    """The longest intervals in which the fastest joint crosses its range hardly more than once [s]."""
    time = _crossing(model, segments).min()
    return next((length for length in LENGTHS if length <= ONCE * time), LENGTHS[-1])


def _crossing(model: Model, segments: Sequence[Segment]) -> Array:
    """(nj,) in what time each joint crosses what it covers [s]."""
    excitation = excitation_of(model, segments)
    return np.array([excitation[joint].span / excitation[joint].speed for joint in model.robot.joint_names])


def longest_interval(
    model: Model,
    recordings: Sequence[Recording],
    window: tuple[float, float] | None = None,
    simulator: Simulator | None = None,
    whole: bool = True,
) -> Longest:
    """The longest shooting intervals over which the nominal model's predictions stay close to the measurements [s].

    Whole trials are the most informative. Where nothing holds a joint in place, errors grow along a
    trial and intervals are short. Not where the model forgets its initial state, see ``forgets``.

    Args:
        model: that is judged.
        recordings: what was measured.
        window: (from, to) of each trial that counts at all [s].
        simulator: that follows it.
        whole: whether whole trials are tried too.

    Raises:
        SimulationDiverged: where the model diverges in all intervals, however short.
    """
    follow, sound = simulator or simulator_for(model, [r.poses for r in recordings]), False
    spread = np.median([r.position.std(axis=0) for r in recordings], axis=0)
    lengths = (None, *LENGTHS) if whole else LENGTHS
    if forgets(model, recordings, window, follow):
        return Longest(lengths[0], steady=True)
    for length in lengths:
        if length is not None and all(length > r.time[-1] - r.time[0] for r in recordings):
            continue
        for errors in _errors_over(model, recordings, window, length, follow):
            sound = sound or bool(np.any(errors < DIVERGED / 2))
            if np.mean(np.all(errors < CLOSE_TO_MEASURED * spread, axis=1)) >= MOSTLY:
                return Longest(length, steady=not whole and length == lengths[0])
    if not sound:
        raise SimulationDiverged(
            f"{model.name}: the model diverges on the recorded commands, even over intervals of {LENGTHS[-1]:g} s; "
            "check the signs and units of the commands, masses, inertias and the physics step"
        )
    return Longest(LENGTHS[-1])


def intervals_of(
    model: Model,
    recordings: Sequence[Recording],
    apart: Collection[int] = (),
    but: Collection[int] = (),
    window: tuple[float, float] | None = None,
    simulator: Simulator | None = None,
    whole: bool = True,
    known: Model | None = None,
) -> tuple[list[float | None], bool]:
    """How long the shooting intervals of each recording are [s], and whether short ones would tell more of any.

    Args:
        model: as in ``longest_interval``, as are the others.
        recordings: what was measured.
        apart: places of those whose intervals are as long as each by itself allows; of the others all are alike.
        but: of those that have no say.
        window: (from, to) of each trial that counts at all [s].
        simulator: that follows it.
        whole: whether whole trials are tried too.
        known: the model by which those apart are judged; the same by default.

    Raises:
        SimulationDiverged: as there.
    """
    places = range(len(recordings))
    together, alone = ([k for k in places if k not in but and (k in apart) is by_itself] for by_itself in (False, True))
    found, steady = list[float | None]([None] * len(recordings)), True
    for own in [together, *([k] for k in alone)]:
        if not own:
            continue
        by, follow = (model, simulator) if own is together or known is None else (known, None)
        longest = longest_interval(by, [recordings[k] for k in own], window, follow, whole=whole)
        steady = steady and longest.steady
        for k in (*own, *(but if own is together else ())):
            found[k] = longest.length
    return found, not steady


def forgets(
    model: Model, recordings: Sequence[Recording], window: tuple[float, float] | None, simulator: Simulator
) -> bool:
    """Whether a model forgets its initial state before a joint has crossed its range, as one held by its servos does.

    By a change of all joints by half of what they usually move. A free pendulum forgets it much later, if ever. Where
    dry friction holds a joint it keeps the change, and lets go of it as soon as the joint moves: so a joint is judged
    by the intervals in which it moves as far, of all where it does in none.

    Args:
        model: that is judged.
        recordings: what was measured.
        window: (from, to) of each trial that counts at all [s].
        simulator: that follows the model.
    """
    whole = [s for r in recordings for s in cut(model, [r], window=window)]
    time = _crossing(model, whole)
    segments = [s for r in recordings for s in cut(model, [r], window=window, shoot=2 * float(time.max()))]
    chosen = [segments[k] for k in _some(len(segments))]
    spread, nj = np.median([r.position.std(axis=0) for r in recordings], axis=0), len(model.robot.joint_names)
    shift = CLOSE_TO_MEASURED * spread
    low, high = model.robot.joint_range
    # Away from the nearer end of the range, whose stop would hide the change.
    toward = [np.where(high - s.start[:nj] < s.start[:nj] - low, -1.0, 1.0) for s in chosen]
    moved = [
        replace(s, start=s.start + np.concatenate([shift * side, np.zeros(len(s.start) - nj)]))
        for s, side in zip(chosen, toward, strict=True)
    ]
    here, there = (residuals_of(model, own, simulator, 0) for own in (chosen, moved))
    if not all(np.abs(own).max() < DIVERGED / 2 for own in (*here, *there)):
        return False
    for j, length in enumerate(time):
        moving = [float(np.ptp(s.measured[:, j])) > shift[j] for s in chosen]
        left = [
            float(np.max(np.abs(a - b)[s.trial.sample_times > s.trial.start + length, j], initial=0.0))
            for s, a, b, moves in zip(chosen, here, there, moving, strict=True)
            if moves or not any(moving)
        ]
        if not np.median(left) < FORGOTTEN * shift[j]:
            return False
    return True


def _some(count: int) -> list[int]:
    """Places of a few of so many intervals, evenly."""
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, LOOKED_AT)).round())]


def _errors_over(
    model: Model,
    recordings: Sequence[Recording],
    window: tuple[float, float] | None,
    length: float | None,
    simulator: Simulator,
) -> Iterator[Array]:
    """(n, nj) RMSE of predictions over some intervals [rad or m], from measured starts, then from better ones.

    Where measured starts are good enough, better ones need not be looked for.
    """
    segments = [s for r in recordings for s in cut(model, [r], window=window, shoot=length)]
    chosen = [segments[k] for k in _some(len(segments))]
    for improved in (0, 1):
        residuals = residuals_of(model, chosen, simulator, improved)
        nj = len(model.robot.joint_names)
        yield np.array([np.sqrt((r[:, :nj] ** 2).mean(axis=0)) for r in residuals])
