"""Which trials are fitted, which confirm or reject effects, and which are touched for the report alone."""

from __future__ import annotations

import fnmatch
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.intervals import intervals_of, motion_length
from equimus_ctrl.engines.predict import check_columns
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.identification.parameters import FreeParameters, place_unit
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, Recording

EVERY = 4
"""One trial in so many is held out."""
LAST = 0.25
"""Share of a trial that is alone, or alone of its kind, which is held out: its end."""
LEAST_DURATION, LEAST_SAMPLES = 1.0, 60
"""Shortest trial that is of use [s], and the fewest samples of one."""
MOST_TIME, ENOUGH = 240.0, 8.0
"""Longest time that is fitted whole, times joints [s], and the length of the intervals that are fitted of longer
recordings, see ``_some`` [s]. More takes longer in proportion, and intervals of estimates shrink by its root alone."""


@dataclass(frozen=True, eq=False)
class Split:
    """Training, validation and test set (Hastie, Tibshirani & Friedman, *The Elements of Statistical Learning*, 7.2).

    Attributes:
        train: fitted.
        validation: not fitted; effects are confirmed or rejected by them.
        test: whose errors no fit and no choice sees, for the error that is reported; empty where there are too few
            trials.
        short_segments: the fitted trials in intervals so short that errors do not grow in them; none if alike.
        of: how many shooting intervals the fitted trials have, of which ``train`` may be some alone, see ``MOST_TIME``.
        other: the same trials with others of them held out, for where those show what the rest does not; None where
            somebody said which are for validation, or there are too few.
    """

    train: tuple[Segment, ...]
    validation: tuple[Segment, ...]
    test: tuple[Segment, ...] = ()
    short_segments: tuple[Segment, ...] = ()
    of: int = 0
    other: Split | None = None


@dataclass(frozen=True)
class Holdout:
    """Which of some trials are held out, by their places.

    Attributes:
        validation: confirm or reject effects.
        test: touched for the report alone.
        other: for validation in the place of the first, where those show what the rest does not; empty where somebody
            said which judge, or there are too few.
        ends: trials of which the end alone is held out: those that are alone, or alone of their kind. It is for
            validation.
        last: those of ``ends`` of which the last part is for the test, half of ``LAST``.
        share: of each of ``ends`` that is held out.
        apart: trials whose shooting intervals are as long as each by itself allows; of the others all are alike.
    """

    validation: frozenset[int] = frozenset()
    test: frozenset[int] = frozenset()
    other: frozenset[int] = frozenset()
    ends: frozenset[int] = frozenset()
    last: frozenset[int] = frozenset()
    share: float = LAST
    apart: frozenset[int] = frozenset()

    def differs(self, other: Holdout) -> bool:
        """Whether other trials are fitted than with another, or other parts of them."""
        own, theirs = ((h.validation, h.test, h.ends, h.share) for h in (self, other))
        return own != theirs


def kind_of(name: str) -> str:
    """A recording's name up to its first digit: those of which it is the same are of one kind."""
    return re.split(r"\d", name, maxsplit=1)[0].rstrip("_- .")


def choose_holdout(
    names: Sequence[str],
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    by_time: bool = False,
    groups: Sequence[str] = (),
) -> Holdout:
    """Choose trials to hold out.

    Where nobody says which are for validation: of four trials or more every fourth, of two or three the last, of one
    its end. Of every fourth the later half are the test set, where these are two or more and nobody says which are. A
    trial that is alone of its kind beside four or more of another is not among these: nothing else would show what it
    shows. Its end is held out, one half for validation and one for the test.

    Args:
        names: of all trials, in order.
        validation: patterns of names of trials.
        test: the same.
        by_time: whether each trial is divided in time, so that none need be held out whole.
        groups: of each trial the one that it belongs to; where there are several, the rule holds in each by itself.

    Raises:
        ConfigError: where a pattern fits no trial, a trial is in both sets, or all are in the test set.
    """
    judging, unseen = _matching(names, validation, "for validation"), _matching(names, test, "for the test")
    if both := sorted(judging & unseen):
        raise ConfigError(f"trial {names[both[0]]} is for validation and for the test, expected one of them")
    if validation or by_time:
        return Holdout(judging, unseen)
    fitted = [k for k in range(len(names)) if k not in unseen]
    if not fitted:
        raise ConfigError("every trial is for the test, so there is nothing to fit; name fewer")
    if len(set(groups)) > 1:
        parts = [
            _of_each_kind(names, [k for k in fitted if groups[k] == g], unseen, bool(test)) for g in sorted({*groups})
        ]

        def all_of(which: str) -> frozenset[int]:
            return frozenset[int]().union(*(getattr(part, which) for part in parts))

        return Holdout(all_of("validation"), all_of("test"), all_of("other"), all_of("ends"), all_of("last"))
    return _of_each_kind(names, fitted, unseen, bool(test))


def _of_each_kind(names: Sequence[str], fitted: Sequence[int], unseen: frozenset[int], test: bool) -> Holdout:
    """Of some trials what is held out where nobody says which, see ``choose_holdout``."""
    if len(names) == 1:
        return Holdout(ends=frozenset(fitted))
    counts = Counter(kind_of(names[k]) for k in fitted)
    if max(counts.values(), default=0) < EVERY:
        return _every_so_manieth(fitted, unseen, test)
    alone = frozenset(k for k in fitted if counts[kind_of(names[k])] == 1)
    found = _every_so_manieth([k for k in fitted if k not in alone], unseen, test)
    return replace(found, ends=alone, last=frozenset() if test or not found.test else alone)


def _every_so_manieth(fitted: Sequence[int], unseen: frozenset[int], test: bool) -> Holdout:
    """Of trials of one kind what is held out, see ``choose_holdout``."""
    if len(fitted) < EVERY:
        return Holdout(frozenset(fitted[-1:] if len(fitted) > 1 else ()), unseen)
    every, before = (frozenset(fitted[EVERY - back :: EVERY]) for back in (1, 2))
    if test:
        return Holdout(every, unseen, before)
    later = frozenset(sorted(every)[len(every) - len(every) // 2 :])
    return Holdout(every - later, later, before - later)


def check(model: Model, recordings: Sequence[Recording], still: bool = False) -> None:
    """Raise ConfigError where recordings cannot be diagnosed."""
    if not recordings:
        raise ConfigError("no recording was given to diagnose")
    for recording in recordings:
        check_samples(recording, model.robot.traits.most_angle)
    if not still and (problem := motion_problem(model, recordings)):
        raise ConfigError(problem)


def check_samples(r: Recording, most_angle: float) -> None:
    """Raise ConfigError where a recording is broken, too short, or in other units.

    Args:
        r: of any robot.
        most_angle: that a joint can have, in its unit.
    """
    if not (np.all(np.isfinite(r.position)) and np.all(np.isfinite(r.command)) and np.all(np.isfinite(r.time))):
        raise ConfigError(f"{r.name}: holds numbers that are not finite; remove the rows without measurements")
    if len(back := np.flatnonzero(np.diff(r.time) <= 0)):
        row = int(back[0]) + 1
        raise ConfigError(
            f"{r.name}: row {row + 1} is stamped {float(r.time[row])!r} s after {float(r.time[row - 1])!r} s in the "
            f"row before ({len(back)} such row{'s' * (len(back) > 1)}); times must ascend: drop rows that were written "
            "twice, or sort them"
        )
    duration = float(np.ptp(r.time)) if len(r.time) else 0.0
    if duration < LEAST_DURATION or len(r.time) < LEAST_SAMPLES:
        raise ConfigError(
            f"{r.name}: has {len(r.time)} samples over {duration:.3g} s, too short to diagnose; expected at least "
            f"{LEAST_SAMPLES} samples over {LEAST_DURATION:g} s"
        )
    largest = float(np.abs(r.position).max())
    if largest > most_angle:
        j = int(np.abs(r.position).max(axis=0).argmax())
        raise ConfigError(
            f"{r.name}: {r.joints[j]} reaches {largest:.4g} rad, more than two turns; are the angles in degrees? "
            "They are expected in rad"
        )


def motion_problem(model: Model, recordings: Sequence[Recording]) -> str:
    """What is wrong where no command moves, or a joint does not; an empty string where all do."""
    traits, first = model.robot.traits, recordings[0]
    moved = np.max([np.ptp(np.vstack([r.command, r.command_before]), axis=0) for r in recordings], axis=0)
    if moved.max(initial=0.0) < traits.least_command:
        unit = model.robot.command_unit(first.actuators[int(moved.argmax())])
        return (
            f"the commands never move: they change by at most {moved.max():.3g} {unit} in any trial, expected at least "
            f"{traits.least_command:g} {unit}; record steps, staircases or sweeps"
        )
    spans = np.ptp(np.concatenate([r.position for r in recordings]), axis=0)
    names = (*model.robot.actuator_names, *model.robot.joint_names)
    for name, span in zip(first.joints, map(float, spans), strict=True):
        if span < traits.least_motion:
            unit = place_unit(model, "rad", name)
            return (
                f"joint {name} never moves: it stays within {span:.2g} {unit} in all trials, expected at least "
                f"{traits.least_motion:g} {unit} (columns: {', '.join(names)})"
            )
    return ""


def split(
    model: Model,
    recordings: Sequence[Recording],
    *,
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    until: float | None = None,
    window: tuple[float, float] | None = None,
    shoot: float | None = None,
    simulator: Callable[[], Simulator] | None = None,
    groups: Sequence[str] = (),
    heldout: Holdout | None = None,
    still: bool = False,
    known: Model | None = None,
) -> Split:
    """Decide which trials are fitted, which are for validation and which for the test.

    Args:
        model: whose names the recordings must have.
        recordings: all of them.
        validation: patterns of names of trials, see ``choose_holdout``; of a single trial its end by default.
        test: the same.
        until: of every trial only what comes before this time is fitted, and the rest is for validation too [s].
        window: (from, to) of each trial that counts at all [s].
        shoot: length of multiple-shooting intervals [s]; by default whole trials, or where nothing holds the
            robot in place see ``intervals.longest_interval``.
        simulator: makes the one that follows it there, once the recordings are checked.
        groups: of each recording the group that it belongs to, such as a unit of the robot; none by default.
        heldout: what is held out, in the place of what these patterns and ``until`` say.
        still: whether joints and commands may never move.
        known: what the robot is taken to be by now, for how long trials apart can be followed (``Holdout.apart``).

    Raises:
        ConfigError: where recordings cannot be used, a pattern fits none, the window is none, ``until`` or ``heldout``
            leaves nothing to judge by, or nothing is left to fit.
    """
    until, given = (until, False) if heldout is None else (None, True)
    heldout = _checked_holdout(model, recordings, validation, test, until, window, groups, heldout, still)
    shoots, short = [shoot] * len(recordings), not model.robot.traits.held_in_place
    if short:
        long = _too_long(recordings, heldout, until, window)
        if shoot is None:
            follow = simulator and simulator()
            shoots, short = intervals_of(
                model, recordings, heldout.apart, heldout.test, window, follow, not long, known
            )
        shoots = [min(own or math.inf, ENOUGH) if long else own for own in shoots]
    parts = _grouped(_parted(model, recordings, heldout, until, window, shoots, short), groups)
    if given and not parts.validation:
        raise ConfigError(f"nothing is held out that has {LEAST_SAMPLES} samples, too few to judge by")
    if until is not None and not parts.validation:
        raise ConfigError(
            f"fitted is what comes before {until:g} s, and no trial has {LEAST_SAMPLES} samples after that, too few to "
            "judge by"
        )
    if not heldout.other:
        return parts
    instead = replace(heldout, validation=heldout.other)
    other = _parted(model, recordings, instead, until, window, shoots, short)
    return replace(parts, other=_grouped(other, groups))


def _checked_holdout(
    model: Model,
    recordings: Sequence[Recording],
    validation: Sequence[str],
    test: Sequence[str],
    until: float | None,
    window: tuple[float, float] | None,
    groups: Sequence[str],
    given: Holdout | None,
    still: bool,
) -> Holdout:
    """Which trials are held out, see ``split``; ConfigError where that cannot be."""
    for r in recordings:
        check_columns(model, r)
    check(model, recordings, still)
    if window is not None and not window[0] < window[1]:
        raise ConfigError(f"the window goes from {window[0]:g} to {window[1]:g} s, expected the earlier time first")
    if given is not None:
        return given
    heldout = choose_holdout([r.name for r in recordings], validation, test, by_time=until is not None, groups=groups)
    if until is not None:
        _check_until(until, recordings, window)
    return heldout


def never_held_out(
    model: Model,
    recordings: Sequence[Recording],
    *,
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    until: float | None = None,
    window: tuple[float, float] | None = None,
    groups: Sequence[str] = (),
    heldout: Holdout | None = None,
    still: bool = False,
) -> list[Segment]:
    """What ``split`` fits whichever trials are held out, uncut: for what decides on the model before there is a split.

    Neither the validation nor the test set is among it, nor what is for validation in the other split
    (``Split.other``). No simulation is needed for it.

    Args:
        model: whose names the recordings must have.
        recordings: all of them.
        validation: as in ``split``, as are the others.
        test: the same.
        until: the same [s].
        window: the same [s].
        groups: the same.
        heldout: the same.
        still: the same.

    Raises:
        ConfigError: where recordings cannot be used, a pattern fits none, or the window is none.
    """
    until = until if heldout is None else None
    heldout = _checked_holdout(model, recordings, validation, test, until, window, groups, heldout, still)
    found: list[Segment] = []
    for k, r in enumerate(recordings):
        if k in heldout.validation | heldout.test | heldout.other:
            continue
        low, high = _span(r, window)
        end = _edges(r, k, (low, high), heldout, until)[0]
        if end > low:
            found += _cut(model, r, k, (low, end), None)
    return found


def _grouped(parts: Split, groups: Sequence[str]) -> Split:
    """The same, each segment with the group of its recording."""
    if not groups:
        return parts
    whole = (parts.train, parts.validation, parts.test, parts.short_segments)
    train, validation, test, short = (tuple(replace(s, group=groups[s.recording]) for s in own) for own in whole)
    return replace(parts, train=train, validation=validation, test=test, short_segments=short)


def _too_long(
    recordings: Sequence[Recording], heldout: Holdout, until: float | None, window: tuple[float, float] | None
) -> bool:
    """Whether what is fitted lasts longer than ``MOST_TIME``, times the joints."""
    fitted = [k for k in range(len(recordings)) if k not in heldout.validation | heldout.test]
    spans = [(k, _span(recordings[k], window)) for k in fitted]
    whole = sum(_edges(recordings[k], k, span, heldout, until)[0] - span[0] for k, span in spans)
    return whole * len(recordings[0].joints) > MOST_TIME


def _span(recording: Recording, window: tuple[float, float] | None) -> tuple[float, float]:
    """(from, to) of a trial that counts [s]."""
    return window or (float(recording.time[0]), float(recording.time[-1]))


def _check_until(until: float, recordings: Sequence[Recording], window: tuple[float, float] | None) -> None:
    """Raise ConfigError where a time divides no trial."""
    spans = [_span(r, window) for r in recordings]
    first, last = min(low for low, _ in spans), max(high for _, high in spans)
    if not first < until < last:
        what = f"begins at {first:g} s" if until <= first else f"ends at {last:g} s"
        whose = "what counts" if window else f"the {'first' if until <= first else 'last'} trial"
        raise ConfigError(f"fitted is what comes before {until:g} s, but {whose} {what}")


def _matching(names: Sequence[str], patterns: Sequence[str], purpose: str) -> frozenset[int]:
    """Which of some trials' names patterns fit; ConfigError where one fits none."""
    for pattern in patterns:
        if not fnmatch.filter(names, pattern):
            raise ConfigError(unknown_name("trial", pattern, names, purpose))
    return frozenset(k for k, name in enumerate(names) if any(fnmatch.fnmatchcase(name, p) for p in patterns))


def _parted(
    model: Model,
    recordings: Sequence[Recording],
    heldout: Holdout,
    until: float | None,
    window: tuple[float, float] | None,
    shoots: Sequence[float | None],
    short: bool,
) -> Split:
    """Recordings split, see ``split``; ``short`` asks for short segments too."""
    train: list[Segment] = []
    validation: list[Segment] = []
    test: list[Segment] = []
    for k, r in enumerate(recordings):
        low, high = _span(r, window)
        if k in heldout.validation or k in heldout.test:
            into = test if k in heldout.test else validation
            into += _cut(model, r, k, (low, high), shoots[k])
            continue
        edges = _edges(r, k, (low, high), heldout, until)
        if edges[0] > low:
            train += _cut(model, r, k, (low, edges[0]), shoots[k], fit_start=True)
        for begin, end, into in zip(edges[:-1], edges[1:], (validation, test)[: len(edges) - 1], strict=True):
            if _samples(r, begin, end) >= LEAST_SAMPLES:
                into += _cut(model, r, k, (float(np.nextafter(begin, high)), end), shoots[k])
    if not train:
        raise ConfigError("every trial is held out, so there is nothing to fit; hold out fewer")
    short_segments: list[Segment] = []
    if model.robot.traits.held_in_place:
        return Split(tuple(train), tuple(validation), tuple(test), (), len(train))
    chosen = _some(train, len(recordings[0].joints))
    longest = max(shoots[s.recording] or math.inf for s in chosen)
    if short and (length := motion_length(model, chosen)) < longest:
        spans = [(s.recording, (float(s.trial.sample_times[0]), float(s.trial.sample_times[-1]))) for s in chosen]
        short_segments = [s for k, span in spans for s in _cut(model, recordings[k], k, span, length, fit_start=True)]
    return Split(tuple(chosen), tuple(validation), tuple(test), tuple(short_segments), len(train))


def end_of(r: Recording, share: float = LAST, span: tuple[float, float] | None = None) -> float | None:
    """From when on the end of a trial is, such as is held out [s]; None where that is too short to judge by.

    Args:
        r: the trial.
        share: of it that is its end.
        span: (from, to) of it that counts [s]; all by default.
    """
    low, high = _span(r, span)
    edge = high - share * (high - low)
    return edge if _samples(r, edge, high) >= LEAST_SAMPLES else None


def _edges(r: Recording, k: int, span: tuple[float, float], heldout: Holdout, until: float | None) -> tuple[float, ...]:
    """Until when a trial is fitted, and when what of it is held out ends: the validation set's, the test set's [s].

    Of one of ``ends`` that is also one of ``last`` the test set has the last part, unless that is too short to judge
    by; where all of the end is, the trial is fitted whole.
    """
    low, high = span
    if k not in heldout.ends:
        return high if until is None else min(until, high), high
    edge, middle = (high - share * (high - low) for share in (heldout.share, LAST / 2))
    if k in heldout.last and min(_samples(r, edge, middle), _samples(r, middle, high)) >= LEAST_SAMPLES:
        return edge, middle, high
    begun = end_of(r, heldout.share, span)
    return high if begun is None else begun, high


def _samples(r: Recording, begin: float, end: float) -> int:
    """How many there are after an instant, up to another."""
    return int(np.count_nonzero((r.time > begin) & (r.time <= end)))


def _some(segments: Sequence[Segment], joints: int) -> list[Segment]:
    """Shooting intervals that last ``MOST_TIME`` at most, as large a share of each recording's, of one at least.

    They go evenly through a recording's intervals in the order of how fast the joints move, from the fastest on: the
    quick end of a chirp shows what its slow beginning does not, and a rest next to nothing.
    """
    whole = joints * sum(float(s.trial.sample_times[-1] - s.trial.sample_times[0]) for s in segments)
    every = max(math.ceil(whole / MOST_TIME), 1)
    if every == 1:
        return list(segments)
    speeds = np.array([_speeds(s, joints) for s in segments])
    usual = np.sqrt(np.mean(speeds**2, axis=0))
    motion = (speeds / np.where(usual > 0, usual, 1.0)).sum(axis=1)
    chosen: list[int] = []
    for recording in dict.fromkeys(s.recording for s in segments):
        own = [k for k, s in enumerate(segments) if s.recording == recording]
        chosen += sorted(own, key=lambda k: -motion[k])[::every]
    return [segments[k] for k in sorted(chosen)]


def _speeds(segment: Segment, joints: int) -> Array:
    """(nj,) RMS of how fast the joints move."""
    time, position = segment.trial.sample_times, segment.measured[:, :joints]
    return np.asarray(np.sqrt(np.mean((np.diff(position, axis=0) / np.diff(time)[:, None]) ** 2, axis=0)))


def check_settings(free: FreeParameters, parts: Split) -> None:
    """Raise ConfigError where a number is free that every recording gives by itself."""
    segments = (*parts.train, *parts.validation, *parts.test)
    for name in free.names:
        if all(name in s.trial.settings for s in segments):
            raise ConfigError(
                f"{name} is free, but the notes of every recording set it (set.{name}); leave it out, or let the notes "
                f"give factors (times.{name})"
            )


def _cut(
    model: Model, r: Recording, k: int, window: tuple[float, float], shoot: float | None, fit_start: bool = False
) -> list[Segment]:
    return [replace(s, recording=k) for s in cut(model, [r], window=window, shoot=shoot, fit_start=fit_start)]
