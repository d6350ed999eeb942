"""Recordings cut into what is simulated from one start and compared with what was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.predict import (
    SLOPE_SPAN,
    behind_sensors,
    check_columns,
    free_zeros,
    in_its_condition,
    local_motion,
    measured_start,
    modelled_start,
    slope_span,
)
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.channels import NOTHING, Channels, channels_of, measured_channels
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.smoothing import RecordedMotion, recorded_motion
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Recording

LEAST_SAMPLES = 10
DELAY_SHARE = 0.2
"""Longest delay or lag that is looked for, as a share of the longest shooting interval."""
INSTANTS = 200
"""At most so many instants of a recording show how well initial states can be read off it."""
WIDE = 3.0
"""A start that was read off has a prior of so many times the standard deviation that it seems to have."""
LEAST_REACH = 1e-3
"""Of what is measured and hardly moves, in its unit: residuals of it are larger than its motion."""
LEAST_TRUST = 1e-4
"""In units of that in a sample."""


@dataclass(frozen=True, eq=False, repr=False)
class Segment(Short):
    """One start and what was measured from there on.

    Attributes:
        trial: commands, start and sample times.
        measured: (m, nj) positions of the joints at the sample times [rad or m].
        recording: which of the recordings it was cut from.
        recording_name: of that recording; trials of shooting intervals have names of their own.
        start: (2 nj + nz + 2 nl,) positions and velocities at the start as the sensors show them, how far their zeros
            are off, and positions and velocities of unmeasured joints that begin anywhere [rad, rad/s, rad or m, m/s,
            m].
        free_start: how many components of the initial state are free: none, the angles (nj), angles and velocities
            (2 nj), or all. What was read off the measurements then counts as one more sample, see
            ``start_weights``.
        slope_span: half the time over which a start was read off [s].
        trust: (2 nj,) in a start that was read off, in units of that in a sample [1, s]; None for what a parabola
            through white noise deserves, see ``start_trust``.
        zeros: (nz) joints whose sensors' zeros are unknown.
        channels: what is compared beside joint positions.
        also: (m, ne) what was measured of these; none by default.
        reach: (ne,) how far each goes, in units of the joint that goes farthest.
        group: of trials that it belongs to, such as those of one unit of the robot; "" where there are none.
        unknown: (nm,) places in ``start`` of what effects that begin anywhere begin with, see ``with_unknown``.
        may_remember: whether they are to be free in fits: nobody knows what was before the trial.
    """

    trial: Trial
    measured: Array
    recording: int
    recording_name: str
    start: Array
    free_start: int = 0
    slope_span: float = SLOPE_SPAN
    trust: Array | None = None
    zeros: tuple[int, ...] = ()
    channels: Channels = NOTHING
    also: Array | None = None
    reach: Array | None = None
    group: str = ""
    unknown: tuple[int, ...] = ()
    may_remember: bool = False

    @cached_property
    def outputs(self) -> Array:
        """(m, nj + ne) all that is compared with predictions: positions of the joints, and what was measured beside."""
        return self.measured if self.also is None else np.column_stack([self.measured, self.also])

    @property
    def poses(self) -> Array:
        """(m, nj + np + nu) ``measured``, and behind it where prescribed joints are and unmeasured ones may be."""
        moved, supposed = self.trial.moved, self.trial.supposed
        beside = [] if moved is None else [moved]
        beside += [] if supposed is None else [supposed.at(self.trial.sample_times)[0]]
        return np.column_stack([self.measured, *beside]) if beside else self.measured

    @cached_property
    def scales(self) -> Array:
        """(nj + ne,) how large residuals of each are beside those of joints [1, 1/s or m]."""
        return np.append(np.ones(self.measured.shape[1]), () if self.reach is None else self.reach)

    def first(self, count: int) -> Segment:
        """Its first samples alone."""
        trial = replace(self.trial, sample_times=self.trial.sample_times[:count])
        also = None if self.also is None else self.also[:count]
        return replace(self, trial=trial, measured=self.measured[:count], also=also)

    @property
    def start_weights(self) -> Array:
        """(s,) what a free component's distance from the measured one weighs, in units of a sample's residual."""
        nj = self.measured.shape[1]
        trust = np.repeat([1.0, self.slope_span / 2], nj) if self.trust is None else self.trust
        return np.append(trust, np.full(len(self.start) - 2 * nj, LEAST_TRUST))[self.free_at]

    @cached_property
    def free_at(self) -> list[int]:
        """(s,) which components of ``start`` are free."""
        return [*range(self.free_start), *(k for k in self.unknown if k >= self.free_start)]

    @property
    def start_joints(self) -> list[int]:
        """(s,) by which joint's noise each free component is judged: an unmeasured one's by the first's."""
        nj = self.measured.shape[1]
        known = [*range(nj), *range(nj), *self.zeros]
        whole = [*known, *[0] * (len(self.start) - len(known))]
        return [whole[k] for k in self.free_at]

    def with_unknown(self, count: int) -> Segment:
        """The same with so many more components of its start, free and 0: what is hidden begins as after a long rest.

        They are numbers of any size, whose tanh the states of effects are, see ``engines.hidden.with_unknown``.
        """
        if not (self.may_remember and count):
            return self
        first = len(self.start)
        return replace(self, start=np.append(self.start, np.zeros(count)), unknown=tuple(range(first, first + count)))

    def from_start(self, start: Array) -> Array:
        """What another hypothesis' fit has of a start, as far as this one has it; the rest is as here."""
        known = min(len(start), len(self.start))
        return np.append(start[:known], self.start[known:])

    def parted(self, starts: Array) -> tuple[Array, Array, Array]:
        """Starts (k, 2 nj + nz + 2 nl + nm) in three parts.

        (k, 2 nj) what the sensors would show with a right zero, (k, nj) their zeros, and (k, 2 nl + nm) the unmeasured
        joints and what else is unknown.
        """
        nj = self.measured.shape[1]
        first = 2 * nj + len(self.zeros)
        shown, offsets = np.array(starts[:, : 2 * nj]), np.zeros((len(starts), nj))
        offsets[:, self.zeros] = starts[:, 2 * nj : first]
        shown[:, :nj] -= offsets
        return shown, offsets, np.array(starts[:, first:])


def cut(
    model: Model,
    recordings: Sequence[Recording],
    *,
    window: tuple[float, float] | None = None,
    shoot: float | None = None,
    fit_start: bool = False,
    from_first_row: bool = False,
    trust: Array | None = None,
) -> list[Segment]:
    """The segments of some recordings.

    Args:
        model: whose names the recordings must have.
        recordings: what was measured.
        window: (from, to) what is compared [s]; all of it by default. The motion starts with the recording.
        shoot: cut what is compared into shooting intervals of this length, each from its own free positions and
            velocities [s]. Of a robot that need not start at rest each whole trial is one by default.
        fit_start: let each recording's first angles be free.
        from_first_row: compare from the first row on, also where commands before it are unknown, see ``unknown_for``.
        trust: (2 nj,) in starts that are read off, see ``Segment.trust``; as the recordings say by default.

    Raises:
        ConfigError: where names do not match, or a recording or a shooting interval is too short to identify from.
    """
    at_rest = model.robot.traits.starts_at_rest
    if shoot is not None and not (0.05 <= shoot < math.inf or (shoot == math.inf and not at_rest)):
        raise ConfigError(f"shooting intervals of {shoot:g} s are too short, expected at least 0.05 s")
    segments = []
    for index, recording in enumerate(recordings):
        check_columns(model, recording)
        zeros, channels = free_zeros(model, recording), channels_of(model, recording)
        time = recording.time
        low, high = window or (float(time[0]), float(time[-1]))
        inside = (time >= low) & (time <= high)
        if np.count_nonzero(inside) < LEAST_SAMPLES:
            raise ConfigError(
                f"{recording.name}: has {np.count_nonzero(inside)} samples between {low:g} and {high:g} s, too few to "
                f"identify from; expected at least {LEAST_SAMPLES} (it lasts from {time[0]:g} to {time[-1]:g} s)"
            )
        if shoot is None and at_rest:
            whole = in_its_condition(model, recording, Trial.of(recording, modelled_start(model, recording)))
            start = np.concatenate([measured_start(recording), np.zeros(len(recording.joints))])
            trial = _sampled(whole, np.array(time[inside]))
            nj = len(recording.joints)
            measured = np.array(recording.position[inside])
            segments.append(Segment(trial, measured, index, recording.name, start, nj if fit_start else 0))
        else:
            length = min(shoot or math.inf, float(time[inside][-1] - time[inside][0]))
            if not from_first_row:
                inside = inside & (time >= time[0] + unknown_for(model, recording, length))
            segments += _shooting_intervals(model, recording, index, inside, length, zeros, channels, trust)
    return segments


def _sampled(trial: Trial, times: Array) -> Trial:
    return replace(trial, sample_times=times)


def _shooting_intervals(
    model: Model,
    recording: Recording,
    index: int,
    inside: NDArray[np.bool_],
    length: float,
    zeros: tuple[int, ...],
    channels: Channels,
    trust: Array | None,
) -> list[Segment]:
    """What is compared cut into intervals of about a length [s], each from its own free positions and velocities."""
    time = recording.time
    low, high = time[inside][0], time[inside][-1]
    edges = np.linspace(low, high, max(round((high - low) / length), 1) + 1)
    span = slope_span(model, recording)
    if trust is None and not model.robot.traits.smooth_motion:
        trust = start_trust(recording, span)
    also, reach = None, None
    if channels:
        also = measured_channels(channels, recording)
        reach = np.maximum(np.ptp(also, axis=0), LEAST_REACH) / np.ptp(recording.position, axis=0).max()
    # All intervals share these arrays, by which engines know that they share one history of commands.
    times, command, before = np.array(time), np.array(recording.command), np.array(recording.command_before)
    # Robots that start at rest were there before, too.
    recorded = None if model.robot.traits.starts_at_rest else recorded_motion(recording, span)
    segments: list[Segment] = []
    for a, b in pairwise(edges):
        chosen = inside & (time >= a) & ((time < b) | (b == high))
        if np.count_nonzero(chosen) < LEAST_SAMPLES:
            continue
        start = np.concatenate(local_motion(recording, float(a), span))
        trial = Trial(
            name=f"{recording.name} from {a:.3f} s" if len(edges) > 2 else recording.name,
            times=times,
            commands=command,
            before=before,
            start=float(a),
            position=start[: len(start) // 2],
            sample_times=np.array(time[chosen]),
            linear=recording.linear,
            inner=bool(channels),
            forces=bool(channels.forces),
            prescribed=recording.prescribed,
            supposed=recording.supposed,
            recorded=recorded,
        )
        trial = in_its_condition(model, recording, trial)
        position, velocity = np.split(behind_sensors([model], start[None, :], trial)[0], 2)
        trial = replace(trial, position=position, velocity=velocity)
        measured = np.array(recording.position[chosen])
        beside = trial.loose_start(model.robot) if model.robot.loose_count else ()
        whole = np.concatenate([start, np.zeros(len(zeros)), beside])
        segments.append(
            Segment(
                trial, measured, index, recording.name, whole, len(whole), span, trust, zeros, channels,
                None if also is None else also[chosen], reach,
            )
        )  # fmt: skip
    if not segments:
        raise ConfigError(
            f"{recording.name}: no shooting interval of {length:g} s holds {LEAST_SAMPLES} samples; expected at least "
            f"{2 * LEAST_SAMPLES * np.median(np.diff(time)):.2g} s"
        )
    return segments


def unknown_for(model: Model, recording: Recording, length: float) -> float:
    """How long after its first row a recording may still show commands from before it, which nobody knows [s].

    A robot that was in motion at the first row (``settled = no``) had other commands before: what a delay or a lag
    brings of them it does within the longest one that is looked for. 0 where they are known, or the robot had settled.

    Args:
        model: of the robot.
        recording: of it.
        length: of the shooting intervals into which it is cut [s].
    """
    return DELAY_SHARE * length if begins_in_motion(recording) and not model.robot.traits.starts_at_rest else 0.0


def begins_in_motion(recording: Recording) -> bool:
    """Whether a robot moved at the first row, and nobody knows what was commanded before."""
    return recording.notes.get("settled") == "no" and recording.before is None


def led_along(segments: Sequence[Segment], residuals: Sequence[Array]) -> list[Segment]:
    """Segments that the motion predicted for them leads to, in place of the measured one, see ``Trial.recorded``.

    Args:
        segments: of some recordings.
        residuals: for each (m, nj + ne) measured − predicted; what none of them covers stays as it was measured.
    """
    known: dict[RecordedMotion, Array] = {}
    for segment, residual in zip(segments, residuals, strict=True):
        recorded, nj = segment.trial.recorded, segment.measured.shape[1]
        if recorded is not None:
            position = known.setdefault(recorded, recorded.position.copy())
            position[np.searchsorted(recorded.time, segment.trial.sample_times)] = segment.measured - residual[:, :nj]
    led = {old: replace(old, position=position) for old, position in known.items()}
    return [
        s if s.trial.recorded is None else replace(s, trial=replace(s.trial, recorded=led[s.trial.recorded]))
        for s in segments
    ]


def start_trust(recording: Recording, span: float) -> Array:
    """(2 nj,) how much starts that are read off a recording are to weigh, in units of a sample's residual [1, s].

    A parabola is no good likeness of a motion that changes quickly: how far it is off is seen from what half its span
    says at the same instants. The prior of a start is some times as wide.

    Args:
        recording: of motion that need not be smooth.
        span: half the time over which starts are read off [s].
    """
    time = recording.time
    chosen = np.unique(np.linspace(0, len(time) - 1, min(INSTANTS, len(time))).round().astype(int))
    changes, residuals = [], []
    for at in time[chosen]:
        whole, part = (np.concatenate(local_motion(recording, float(at), s)) for s in (span, span / 2))
        changes.append(whole - part)
        residuals.append(recording.position[np.argmin(np.abs(time - at))] - whole[: len(whole) // 2])
    noise, sizes = np.sqrt(np.mean(np.square(residuals), axis=0)), np.sqrt(np.mean(np.square(changes), axis=0))
    return np.asarray(np.maximum(np.tile(noise, 2) / (WIDE * np.maximum(sizes, 1e-300)), LEAST_TRUST))


def groups_of(segments: Sequence[Segment]) -> tuple[str, ...]:
    """The groups of some trials, in order; none where there is one alone."""
    found = tuple(dict.fromkeys(s.group for s in segments))
    return found if len(found) > 1 else ()


def groups_with_own(groups: Sequence[str]) -> tuple[str, ...]:
    """Groups that may get a value of their own: of two the second alone, for the first one's is the common one then."""
    return tuple(groups[1:] if len(groups) == 2 else groups)
